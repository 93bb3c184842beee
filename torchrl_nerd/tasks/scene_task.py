"""A robot without a goal: what an env of a scene alone shows and how it starts."""

import numpy as np
import torch
from torch import Generator, Tensor

from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks.rows import RowMemo, on_rows
from torchrl_nerd.tasks.task import State, Task

HORIZON = 1000  # control steps, as most tasks of the dm_control suite
SEEDS = 2**32  # that torch's generator tells apart


class SceneTask(Task):
    """Zero reward, never terminated; starts are those of the scene's training data.

    The observation is ``qpos`` and ``qvel``. An episode has 1000 control steps. Subclass it
    to give a robot of your own a reward.

    Args:
        scene: the robot and its ground.

    Examples:
        >>> task = SceneTask(Scene.from_gymnasium("HalfCheetah-v5"))
        >>> task.observation_size
        18
    """

    num_uniforms = 1
    horizon = HORIZON

    def __init__(self, scene: Scene) -> None:
        self.name, self._given = scene.name, scene
        ground, model = scene.terrain, scene.model
        self.observation_size = model.nq + model.nv
        if ground is not None and ground.is_per_row:
            self.parameters = {TERRAIN: ground.size}
        self._sizes = {QPOS: model.nq, QVEL: model.nv, **self.parameters}
        self._start = RowMemo(self._draw)

    def build_scene(self) -> Scene:
        """The scene that was given."""
        return self._given

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """See `Scene.sample_initial`, seeded with u; each env costs its Python."""
        parts = on_rows(self._start, u).split(list(self._sizes.values()), -1)
        return dict(zip(self._sizes, parts, strict=True))

    def observation(self, state: State) -> Tensor:
        """``qpos`` and ``qvel``, ``(*batch, nq + nv)``."""
        return torch.cat((state[QPOS], state[QVEL]), -1)

    def _draw(self, u: np.ndarray) -> np.ndarray:
        seeded = Generator().manual_seed(int(u[0] * SEEDS))
        state, _ = self.scene.sample_initial(1, seeded)
        return torch.cat([state[key] for key in self._sizes], -1)[0].numpy()
