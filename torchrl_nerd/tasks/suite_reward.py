"""One task of the dm_control suite without its simulation: it judges states it is shown.

The suite's `Task` reads a `Physics`. Here that `Physics` is never stepped: a state is
written in and only what the suite reads is brought up to date. On a cheetah that takes 5 us
of about 80 us an env, the rest being the suite's own Python; threads gain nothing, since
they wait for each other in it.
"""

import copy
from math import ceil

import mujoco
import numpy as np

from torchrl_nerd.scenes.importer import load_suite

SEEDS = 2**32  # of NumPy's RandomState, which the suite draws from
FORCES = mujoco.mjtStage.mjSTAGE_ACC  # sensors of this stage need the contact forces
PARTS = (  # of mj_forward: positions, velocities and the sensors of both
    mujoco.mj_kinematics,
    mujoco.mj_comPos,
    mujoco.mj_comVel,
    mujoco.mj_subtreeVel,  # or its sensors would read what the env before left
    mujoco.mj_sensorPos,
    mujoco.mj_sensorVel,
)


class SuiteReward:
    """Reset distribution, reward, observation and end of ``domain-task``, env by env.

    | attribute | meaning |
    |---|---|
    | ``horizon`` | control steps until the suite's time limit |
    | ``observation_size`` | width of the suite's observation, flattened in its order |
    | ``targets`` | geoms that it places at each reset and that touch nothing |
    | ``forces`` | entries of ``sensordata`` that it reads and that need contact forces |

    Raises:
        ValueError: no such task, one without a time limit, or one that changes more at
            a reset than where its targets are.
    """

    def __init__(self, domain: str, task: str) -> None:
        env = load_suite(domain, task)
        self._task, self._physics = env.task, env.physics
        limit = env._step_limit
        if not np.isfinite(limit):
            raise ValueError(
                f"task 'dm_control/{domain}-{task}' has no time limit: not supported"
            )
        self.horizon = ceil(limit)
        self.targets = np.zeros(0, int)
        self.targets = self._moved_geoms(f"dm_control/{domain}-{task}")
        self.observation_size = len(self._observe())
        self.forces = self._forces_read()

    @property
    def _model(self) -> mujoco.MjModel:
        return self._physics.model.ptr

    @property
    def _data(self) -> mujoco.MjData:
        return self._physics.data.ptr

    def start(self, u: np.ndarray) -> np.ndarray:
        """Start of an episode by the suite's own ``initialize_episode``.

        Args:
            u: ``(1,)`` in [0, 1); the suite's random state is seeded with it.

        Returns:
            qpos, qvel and the targets' positions, ``(nq + nv + 3 targets,)``.
        """
        self._task.random.seed(int(u[0] * SEEDS))
        with self._physics.reset_context():
            self._task.initialize_episode(self._physics)
        target = self._model.geom_pos[self.targets].ravel()
        return np.concatenate((self._data.qpos, self._data.qvel, target))

    def __call__(self, row: np.ndarray) -> np.ndarray:
        """Judge one state.

        Args:
            row: qpos, qvel, the targets' positions, ctrl and the `forces` felt, NaN where
                nobody knows them: MuJoCo then computes them at this state.

        Returns:
            Reward, whether the episode ends (0 or 1), observation.
        """
        model, data = self._model, self._data
        velocity = model.nq + model.nv
        ctrl = velocity + 3 * len(self.targets)
        data.qpos, data.qvel = row[: model.nq], row[model.nq : velocity]
        data.ctrl, felt = row[ctrl : ctrl + model.nu], row[ctrl + model.nu :]
        if len(self.targets):
            model.geom_pos[self.targets] = row[velocity:ctrl].reshape(-1, 3)
        if len(felt) and np.isnan(felt).any():
            data.qacc_warmstart = 0.0  # nothing is left of the env before
            mujoco.mj_forward(model, data)
        else:
            for update in PARTS:
                update(model, data)
            data.sensordata[self.forces] = felt
        reward = self._task.get_reward(self._physics)
        is_end = self._task.get_termination(self._physics) is not None
        return np.concatenate(((reward, is_end), self._observe()))

    def _observe(self) -> np.ndarray:
        observation = self._task.get_observation(self._physics)
        return np.concatenate([np.ravel(part) for part in observation.values()])

    def _moved_geoms(self, name: str) -> np.ndarray:
        """Geoms that are elsewhere at another reset; nothing else may be different."""
        self.start(np.array([0.25]))
        first = copy.copy(self._model)
        self.start(np.array([0.75]))
        second = copy.copy(self._model)
        moved = np.flatnonzero((first.geom_pos != second.geom_pos).any(-1))
        touches = second.geom_contype[moved] | second.geom_conaffinity[moved]
        if second.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
            touches = np.zeros_like(touches)
        for place in ("geom_pos", "light_pos"):
            getattr(second, place)[:] = getattr(first, place)
        if touches.any() or not np.array_equal(_bytes(first), _bytes(second)):
            raise ValueError(
                f"task '{name}' changes its robot at every reset: not supported"
            )
        return moved

    def _forces_read(self) -> np.ndarray:
        """Entries of ``sensordata`` that need forces and that the task looks at."""
        model, sensed = self._model, self._data.sensordata
        late = np.repeat(model.sensor_needstage == FORCES, model.sensor_dim)
        before, kept = self._judged(), sensed.copy()
        read = []
        for entry in np.flatnonzero(late):
            sensed[entry] = kept[entry] + 1.0
            if not np.array_equal(self._judged(), before):
                read.append(entry)
            sensed[entry] = kept[entry]
        return np.array(read, int)

    def _judged(self) -> np.ndarray:
        return np.append(self._observe(), self._task.get_reward(self._physics))


def _bytes(model: mujoco.MjModel) -> np.ndarray:
    """All that a model is made of."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer
