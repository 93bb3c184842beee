"""Where the time of a step goes: parts of a whole, on robots with contact and without."""

import env_overhead
import pytest


@pytest.mark.parametrize("task", ["cartpole/swingup", "ant/run"])
def test_the_parts_are_shares_of_a_whole(task):
    found = env_overhead.step_times(task, "nerd", num_envs=2, steps=3)
    assert 0.0 < found["dynamics_s"] < found["step_s"]
    for name in ("torchrl_share", "task_share"):
        assert 0.0 < found[name] < 1.0
    assert (0.0 < found["contact_share"] < 1.0) == (task == "ant/run")
