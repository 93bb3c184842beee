"""Images of an env: on demand, or as an observation."""

from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.envs.rendering import Renderer
from torchrl_nerd.keys import PIXELS
from torchrl_nerd.settings import expect_count


def image_size(given: int | tuple[int, int]) -> tuple[int, int]:
    """Height and width, from both or from one number; ValueError for anything else."""
    both = given if isinstance(given, tuple | list) else (given, given)
    if len(both) != 2:
        raise ValueError(f"expected height and width, or one number, got {given}")
    height, width = both
    expect_count(1, height=height, width=width)
    return height, width


class RenderedEnv(EnvBase):
    """An env whose state can be seen; `SceneEnv` is one."""

    render_size: tuple[int, int] = (240, 320)  # height and width of an image, pixels
    camera_id: int | str | None = None  # of an image, see `Renderer`
    from_pixels = pixels_only = False
    _renderer: Renderer

    def _state(self) -> dict[str, Tensor]:
        raise NotImplementedError

    @uncompiled
    def render(
        self,
        num_envs: int | None = None,
        *,
        height: int | None = None,
        width: int | None = None,
        camera_id: int | str | None = None,
    ) -> np.ndarray:
        """Images ``(num_envs, height, width, 3)``, uint8, of the present states.

        Needs no screen. TorchRL's `PixelRenderTransform` and `VideoRecorder` call it.

        Args:
            num_envs: so many envs, from the first; all by default.
            height: pixels; that of ``render_size`` by default, as is ``width``.
            width: pixels.
            camera_id: number or name of a camera; ``env.camera_id`` by default.

        Raises:
            ValueError: no such camera or number, or no OpenGL library works on this
                machine (what to install).

        Examples:
            >>> from torchrl_nerd import make_env
            >>> env = make_env("ant/run", "mujoco", num_envs=8)
            >>> _ = env.reset()
            >>> env.render(num_envs=2, height=64, width=96).shape
            (2, 64, 96, 3)
        """
        if num_envs is not None:
            expect_count(1, num_envs=num_envs)
            if num_envs > (count := self.batch_size.numel()):
                raise ValueError(f"expected at most {count} envs, got {num_envs}")
        state = {key: value[:num_envs] for key, value in self._state().items()}
        height = self.render_size[0] if height is None else height
        width = self.render_size[1] if width is None else width
        camera_id = self.camera_id if camera_id is None else camera_id
        return self._renderer(state, height, width, camera_id)

    def add_pixels(self, pixels_only: bool = False) -> None:
        """Show ``pixels`` of ``render_size`` at every reset and step; once is for good.

        Args:
            pixels_only: instead of all other entries that an agent could see; a state
                can then not be set through transforms.
        """
        if self.from_pixels:
            return
        self.from_pixels, self.pixels_only = True, pixels_only
        shape = torch.Size((*self.batch_size, *self.render_size, 3))
        how = {"shape": self.batch_size, "device": self.device}
        pixels = Bounded(0, 255, shape, self.device, torch.uint8)
        seen = dict(self.observation_spec.items())
        self._hidden: tuple[Any, ...] = ()
        if pixels_only:
            self.state_spec, self._hidden, seen = Composite(**how), tuple(seen), {}
        self.observation_spec = Composite({**seen, PIXELS: pixels}, **how)

    def _seen(self, result: TensorDict) -> TensorDict:
        """``result`` as an agent sees it: with pixels, or with pixels alone."""
        if not self.from_pixels:
            return result
        pixels = torch.from_numpy(self.render()).to(self.device)
        return cast(TensorDict, result.exclude(*self._hidden).set(PIXELS, pixels))

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free what images were drawn with."""
        self._renderer.close()
        super().close(raise_if_closed=raise_if_closed)
