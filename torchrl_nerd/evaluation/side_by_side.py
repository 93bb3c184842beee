"""One task from one start in two dynamics, side by side in a GIF or MP4 video."""

from collections.abc import Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_nerd.checkpoint import model_name
from torchrl_nerd.envs import make_env
from torchrl_nerd.envs.actor import Actor
from torchrl_nerd.envs.frame_stack import frame_stack_of, stack_frames
from torchrl_nerd.files import check_writable, write_atomically
from torchrl_nerd.keys import ACTION

FixedActions = Literal["random", "zero"]
TITLES = {"mujoco": "MuJoCo", "mujoco_warp": "MuJoCo Warp"}
FRAMES_PER_SECOND = 25  # a GIF counts in hundredths of a second
SHADES = (np.arange(256) // 8 * 255 / 31).astype(np.uint8)  # 32: half the GIF
INK, GRAY = (30, 30, 30), (110, 110, 110)
FORMATS: dict[str, dict[str, Any]] = {  # options of imageio's writers
    ".gif": {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0},
    ".mp4": {
        "fps": FRAMES_PER_SECOND,
        "macro_block_size": 2,
        "output_params": ["-f", "mp4"],
    },
}


class SideBySide:
    """Two envs of one task from one start; a policy acts in each.

    ``returns`` are sums of the rewards so far; ``ending`` is that of the first episode that
    ended, its dynamics and how.

    Args:
        task: id of a registered task.
        dynamics: two, as `make_env` takes them; the second one is the ground truth.
        actor: a policy, whose mean action is taken; or ``"random"`` actions, uniform in
            [-1, 1], or ``"zero"`` ones, the same in both.
        seed: of the start and of random actions.
        closed_loop: the policy acts on each env's own observation. In open loop the first
            env repeats the actions of the second.
        device: of the envs.
    """

    def __init__(
        self,
        task: str,
        dynamics: Sequence[str | Path],
        actor: Actor | FixedActions,
        seed: int = 0,
        closed_loop: bool = True,
        device: torch.device | str = "cpu",
    ) -> None:
        frames = 1 if isinstance(actor, str) else frame_stack_of(actor)
        bare = [make_env(task, name, 1, seed, device) for name in dynamics]
        self.envs = [stack_frames(env, frames) for env in bare]
        models = [model_name(name, bare[1].scene) for name in dynamics]
        self.names = [TITLES.get(name, name) for name in models]
        self.kinds = [env.dynamics.kind for env in bare]
        self.returns, self.steps, self.ending = [0.0, 0.0], 0, ""
        self._dynamics, self._actor, self._closed_loop = dynamics, actor, closed_loop
        self._generator = torch.Generator().manual_seed(seed)
        self._shown = [env.reset() for env in self.envs]  # one seed, one start

    @property
    def seconds(self) -> float:
        """Simulated time."""
        return self.envs[1].task.step_size * self.steps

    @torch.no_grad()
    def step(self) -> None:
        """One action in each env."""
        if isinstance(self._actor, str):
            u = torch.rand(self.envs[1].action_spec.shape, generator=self._generator)
            size = 1.0 if self._actor == "random" else 0.0
            actions = [(size * (2.0 * u - 1.0)).to(self.envs[1].device)] * 2
        else:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                actions = [self._actor(td.clone())[ACTION] for td in self._shown]
        if not self._closed_loop:
            actions[0] = actions[1]  # those of MuJoCo
        self.steps += 1
        for i, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            td = TensorDict({ACTION: action}, env.batch_size, device=env.device)
            after = self._shown[i] = env.step(td)["next"]
            self.returns[i] += float(after["reward"])
            if after["done"].item():  # the ground truth's, where both end
                how = "terminated" if after["terminated"].item() else "truncated"
                self.ending = f"{self._dynamics[i]} {how}"

    def image(self, width: int) -> np.ndarray:
        """Both robots under their captions, ``(height, width, 3)``, uint8.

        The width, pixels, is rounded down to a multiple of 4.
        """
        side, both = width // 4 * 2, []
        for i, env in enumerate(self.envs):
            image = env.render(height=side * 2 // 5 * 2, width=side)[0]
            text = f"{self.kinds[i]}, {self.seconds:.2f} s"
            if self.returns[i]:
                text += f", return {self.returns[i]:.0f}"
            both.append(np.vstack((_caption(self.names[i], text, side), image)))
        return np.hstack(both)


def check_video(path: Path) -> None:
    """Refuse, before any work, a file that cannot be written here.

    Raises:
        ValueError: another suffix than .gif or .mp4, or a file that cannot be written.
        ModuleNotFoundError: imageio or its ffmpeg is not installed.
    """
    if path.suffix not in FORMATS:
        raise ValueError(f"expected a file named .gif or .mp4, got '{path}'")
    if not all(map(find_spec, ("imageio", "imageio_ffmpeg"))):
        raise ModuleNotFoundError(
            "videos need imageio and imageio-ffmpeg: in the clone, "
            "pip install -e '.[examples]'"
        )
    check_writable(path)


def write_video(
    pair: SideBySide,
    path: Path,
    steps: int,
    width: int = 720,
    slowdown: float = 1.0,
    quiet: bool = False,
) -> int:
    """Roll out, write a video, whole or not at all, and return its number of frames.

    It ends with the first episode of the pair, after at most so many ``steps``. ``width``
    is of a frame with both robots, pixels; a ``slowdown`` of 2 plays at half speed.

    Raises:
        ValueError: see `check_video`, or no OpenGL library works on this machine.
        ModuleNotFoundError: imageio or its ffmpeg is not installed.
    """
    check_video(path)
    import imageio

    how = {"format": path.suffix, "mode": "I", **FORMATS[path.suffix]}
    is_gif, written = path.suffix == ".gif", 0

    def write(aside: Path) -> None:
        nonlocal written
        bar = tqdm(range(steps + 1), "video", unit=" steps", disable=quiet)
        with imageio.get_writer(aside, **how) as opened:
            writer: Any = opened
            for frame in _frames(pair, bar, width, slowdown):
                writer.append_data(SHADES[frame] if is_gif else frame)
                written += 1

    write_atomically(path, write)
    return written


def _frames(
    pair: SideBySide, steps: Iterable[int], width: int, slowdown: float
) -> Iterator[np.ndarray]:
    """As many images of each step as fall due until then, and the first."""
    shown = 0
    for step in steps:
        if step:
            pair.step()
        due = int(pair.seconds * slowdown * FRAMES_PER_SECOND + 1e-6) + 1
        if due > shown:
            yield from [pair.image(width)] * (due - shown)
        shown = due
        if pair.ending:
            break


def _caption(title: str, text: str, width: int) -> np.ndarray:
    """The strip over one image: two lines of text, ``(height, width, 3)``, uint8."""
    from PIL import Image, ImageDraw
    from PIL.ImageFont import load_default

    size = max(10, width // 16)
    strip = Image.new("RGB", (width, 5 * size // 4 * 2), "white")
    pen = ImageDraw.Draw(strip)
    pen.text((size // 2, size // 8), title, INK, load_default(size))
    pen.text((size // 2, 11 * size // 8), text, GRAY, load_default(0.85 * size))
    return np.asarray(strip)
