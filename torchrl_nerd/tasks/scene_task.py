"""A robot without a goal: what an env of a scene alone shows and how it starts."""

import torch
from torch import Generator, Tensor

from torchrl_nerd.keys import QPOS, QVEL, TERRAIN
from torchrl_nerd.scenes import Scene
from torchrl_nerd.tasks.task import State, Task

HORIZON = 1000  # control steps, as most tasks of the dm_control suite
NUM_STARTS = 4096


class SceneTask(Task):
    """Zero reward, never terminated; the observation is ``qpos`` and ``qvel``.

    An episode starts in one of 4096 states that are drawn as those of training data, see
    `Scene.sample_initial`, and has 1000 control steps. Subclass it to give a robot of your
    own a reward.

    Raises:
        ValueError: no state within the scene's ranges is clear of the ground.

    Examples:
        >>> task = SceneTask(Scene.from_gymnasium("HalfCheetah-v5"))
        >>> task.observation_size
        18
    """

    num_uniforms = 1
    horizon = HORIZON

    @torch.inference_mode(False)
    def __init__(self, scene: Scene) -> None:
        self.name, self._given = scene.name, scene
        self.observation_size = scene.model.nq + scene.model.nv
        seeded = Generator().manual_seed(0)
        self.starts, _ = scene.sample_initial(NUM_STARTS, seeded)
        if TERRAIN in self.starts:
            self.parameters = {TERRAIN: self.starts[TERRAIN].shape[1]}

    def build_scene(self) -> Scene:
        """The scene that was given."""
        return self._given

    def initial_state(self, u: Tensor) -> dict[str, Tensor]:
        """One of ``starts`` for each u."""
        chosen = (u[..., 0] * NUM_STARTS).long().clamp_max(NUM_STARTS - 1)
        return {key: x.to(u.device)[chosen] for key, x in self.starts.items()}

    def observation(self, state: State) -> Tensor:
        """``qpos`` and ``qvel``, ``(*batch, nq + nv)``."""
        return torch.cat((state[QPOS], state[QVEL]), -1)
