"""The package's transforms on true envs, and what each should have written.

Importable by the workers of a ParallelEnv: nothing here is local to a test.
"""

from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_nerd.envs import GroundTruthEnv
from torchrl_nerd.keys import OBSERVATION, QPOS, QVEL, STATE_DELTA
from torchrl_nerd.robots import TASKS, load_scene, make_task
from torchrl_nerd.transforms import (
    ContactFeatures,
    Normalize,
    RobotCentric,
    StateDelta,
    Stats,
)

ENVS, STEPS = 3, 4
TASK_OF: dict[str, str] = {}
"""One task of every scene that has one."""
for _name in TASKS:
    TASK_OF.setdefault(make_task(_name).scene.name, _name)

CLASSES = {t.__name__: t for t in (RobotCentric, ContactFeatures, StateDelta)}
TRANSFORMS = (*CLASSES, "Normalize")


def plain_env(scene: str, seed: int = 0) -> GroundTruthEnv:
    return GroundTruthEnv(TASK_OF[scene], engine="mujoco", num_envs=ENVS, seed=seed)


def observation_stats(scene: str) -> Stats:
    """Some statistics, the same ones in every process."""
    size = make_task(TASK_OF[scene]).observation_size
    count = torch.arange(1.0, size + 1.0, dtype=torch.float64)
    return Stats(10, 0.1 * count, 10.0 * count)


def make_transform(name: str, scene: str) -> Transform:
    if name == "Normalize":
        return Normalize({OBSERVATION: observation_stats(scene)})
    return CLASSES[name](load_scene(scene))


def make_compose(scene: str) -> Compose:
    return Compose(*(make_transform(name, scene) for name in TRANSFORMS))


def transformed_env(scene: str, name: str | None = None) -> TransformedEnv:
    """A single env with one transform, or with all of them."""
    transform = make_compose(scene) if name is None else make_transform(name, scene)
    return TransformedEnv(plain_env(scene), transform)


def creators(scene: str, *, of_transformed: bool, name: str | None = None) -> list:
    """What SerialEnv and ParallelEnv make two envs from."""
    if of_transformed:
        return [partial(transformed_env, scene, name)] * 2
    return [partial(plain_env, scene)] * 2


def features_of(name: str, scene: str, state: TensorDictBase) -> dict:
    """What the transform should have written beside a state."""
    if name == "Normalize":
        raw = make_task(TASK_OF[scene]).observation(state).float().double()
        stats = observation_stats(scene)
        return {OBSERVATION: ((raw - stats.mean) / stats.std).float()}
    transform = make_transform(name, scene)
    inputs = state.select(*transform.in_keys)
    return dict(transform(inputs).select(*transform.out_keys, strict=False).items())


def assert_transformed(name: str, scene: str, rollout: TensorDictBase) -> None:
    """Every root and every next state of a rollout carries the right features."""
    after = rollout["next"]
    if name == "StateDelta":
        moved = StateDelta(load_scene(scene)).delta
        want = moved(rollout[QPOS], rollout[QVEL], after[QPOS], after[QVEL])
        torch.testing.assert_close(after[STATE_DELTA], want)
        return
    for state in (rollout, after):
        for key, want in features_of(name, scene, state).items():
            torch.testing.assert_close(state[key], want)


def recorded(scene: str) -> TensorDict:
    """Transitions of the env without any transform, ``[ENVS * STEPS]``."""
    return plain_env(scene).rollout(STEPS, break_when_any_done=False).reshape(-1)


def make_buffer(transform: Transform) -> TensorDictReplayBuffer:
    """A buffer twice as long as what `recorded` gives; a sample holds its ``index``."""
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(2 * ENVS * STEPS),
        transform=transform,
        batch_size=ENVS * STEPS,
    )
