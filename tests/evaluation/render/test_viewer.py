"""What MuJoCo's window would show, where there is no display: its frames are kept."""

from contextlib import nullcontext

import mujoco
import mujoco.viewer
import numpy as np

from torchrl_nerd.evaluation.render.pair import idle, play_pair
from torchrl_nerd.evaluation.render.viewer import view
from torchrl_nerd.robots import make_task

STEPS = 5


def test_the_window_shows_the_learned_robot_and_the_true_one_as_a_ghost(
    task_id, seed, monkeypatch
):
    pair = play_pair(
        task_id, "mujoco", idle(make_task(task_id), STEPS, seed, "random"), STEPS, seed
    )
    shown, ghosts = [], []

    class Window(nullcontext):
        """Closes itself after one showing."""

        def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
            super().__init__(self)
            self.data, self.user_scn = data, mujoco.MjvScene(model, maxgeom=500)

        def is_running(self) -> bool:
            return len(shown) < len(pair.truth)

        def lock(self) -> nullcontext:
            return nullcontext()

        def sync(self) -> None:
            shown.append(self.data.qpos.copy())
            ghosts.append([geom.pos.copy() for geom in self.user_scn.geoms])

    monkeypatch.setattr(mujoco.viewer, "launch_passive", Window)
    monkeypatch.setenv("DISPLAY", ":0")
    view(pair, slow=1e-3)
    np.testing.assert_array_equal(np.stack(shown), pair.learned)
    assert len(ghosts[0]) > 0 and {len(geoms) for geoms in ghosts} == {len(ghosts[0])}
    assert not np.array_equal(ghosts[0], ghosts[-1])
