"""Registers every task with Gymnasium; importing it is all.

    import gymnasium, torchrl_nerd.gymnasium
    gymnasium.make("TorchrlNerd/AntRun-v0", dynamics="mujoco")
    gymnasium.make_vec("TorchrlNerd/AntRun-v0", num_envs=512)
    gymnasium.make("TorchrlNerd/Task-v0", task="dm_control/cheetah-run", dynamics="mujoco")

Or without the import: ``gymnasium.make("torchrl_nerd.gymnasium:TorchrlNerd/AntRun-v0")``.
"""

from gymnasium import register

from torchrl_nerd.robots import TASKS

MODULE = "torchrl_nerd.envs.gymnasium_env"


def gymnasium_id(task: str) -> str:
    """Gymnasium's id of a registered task: ``TorchrlNerd/AntSpinTrack-v0``."""
    words = task.replace("/", "_").split("_")
    return f"TorchrlNerd/{''.join(word.capitalize() for word in words)}-v0"


def _register(env_id: str, **kwargs: str) -> None:
    register(
        env_id,
        entry_point=f"{MODULE}:GymnasiumEnv",
        vector_entry_point=f"{MODULE}:GymnasiumVectorEnv",
        kwargs=kwargs,
    )


_register("TorchrlNerd/Task-v0")  # any task, by its id as the argument ``task``
for _task in TASKS:
    _register(gymnasium_id(_task), task=_task)
