"""Training data from trajectories of a saved policy."""

import hashlib
from functools import partial
from pathlib import Path

from torchrl_nerd.data.generate import Draw
from torchrl_nerd.data.policy_data import policy_data
from torchrl_nerd.evaluation.policy import (
    WEIGHTS,
    load_policy,
    make_actor,
    policy_task,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.settings import expect_at_least


def along_policy(scene: Scene, folder: Path, noise: float = 0.5) -> tuple[str, Draw]:
    """A saved policy as a strategy for `generate`: its name, and what it draws.

    The name contains a hash of the weights and the noise: no data set mixes two policies.

    Args:
        scene: the robot.
        folder: of a policy that `save_policy` wrote; its card names the task.
        noise: as for `policy_data`.

    Raises:
        ValueError: in one sentence, no such policy, one for another scene, or a
            negative noise.
    """
    expect_at_least(0.0, noise=noise)
    task = policy_task(folder)
    if task.scene.hash != scene.hash:
        raise ValueError(
            f"the policy in {folder} acts in scene '{task.scene.name}' "
            f"({task.scene.hash}), expected '{scene.name}' ({scene.hash})"
        )
    policy = load_policy(folder, task)
    digest = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()[:16]
    draw = partial(policy_data, task, make_actor(policy), noise=noise)
    return f"policy {digest} with noise {noise:g}", draw
