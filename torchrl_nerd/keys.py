"""Every tensordict key, once: meaning, shape, unit, frame.

Conventions: SI units, z up, quaternions ``wxyz``. ``qpos`` and ``qvel`` are MuJoCo's and
are *the* state: a free joint's ``qvel`` is the linear velocity of the body origin in
world axes, then the angular velocity in body axes. The suffix ``_w`` names the world
frame and ``_b`` the base frame B_t = (x_t, R_t), the pose of the robot's base body at the
token's own time. States are float64, features and observations float32.
"""

QPOS = "qpos"
"""Joint positions ``(*batch, nq)``, m and rad, float64, MuJoCo's order."""

QVEL = "qvel"
"""Joint velocities ``(*batch, nv)``, m/s and rad/s, float64, MuJoCo's order."""

TERRAIN = "terrain"
"""Ground parameters of each env ``(*batch, scene.terrain.size)``, world frame, float64.
Planes (unit normal, offset) with ``normal . x = offset``, see `Terrain`. Only where the
ground varies from env to env."""

GOAL = "goal"
"""Where the hand should go ``(*batch, 3)``, m, world frame, float64; each env
draws its own at a reset."""

TARGET = "target"
"""Where a task of the dm_control suite put its n targets ``(*batch, 3 n)``, m, in the
frame of their bodies, float64; each env draws its own at a reset."""

PARAMETERS = "parameters"
"""Physical parameters of each env ``(*batch, variation.size)``, float64; see
`Variation`. Only where they vary. The ground truth reads them, as do models that are
told."""

SENSORDATA = "sensordata"
"""What MuJoCo's sensors read during the last substep ``(*batch, nsensordata)``, float64.
Only from the ground truth of a model that senses forces; the task alone sees it."""

PIXELS = "pixels"
"""Images ``(*batch, height, width, 3)``, uint8. Only where `make_env` is asked for them."""

ACTION = "action"
"""What the policy chose ``(*batch, num_actions)``, float32, in [-1, 1]."""

OBSERVATION = "observation"
"""What the policy sees ``(*batch, D)``, float32; the task defines it."""

JOINT_TORQUE = ("next", "joint_torque")
"""Torque of the controller per actuated dof ``(*batch, num_actuated)``, N and N m, float64:
held over the step, or a servo's at the step's start. Recorded under ``next``: it belongs to
the transition."""

CTRL = ("next", "ctrl")
"""Control of each servo over the step ``(*batch, nu)``, MuJoCo's ``data.ctrl``,
float64. Only of a scene with servos, whose torque at the step's start does not tell all."""

NEXT_QPOS = ("next", "qpos")
NEXT_QVEL = ("next", "qvel")

ROBOT_STATE = "robot_state"
"""Base velocity and gravity in B_t, joint features ``(*batch, D)``; see RobotCentric."""

ROBOT_TORQUE = "robot_torque"
"""Joint torques ``(*batch, num_actuated)``, N and N m, float32."""

ROBOT_CTRL = "robot_ctrl"
"""Controls of servos ``(*batch, nu)``, float32. Only of a scene with servos."""

CONTACT_DISTANCE = "contact_distance"
"""Clearance of each contact point to the ground, minus the margin, at most zero
``(*batch, num_points)``, m: 0 beyond the margin, ``-margin`` when touching."""

CONTACT_VELOCITY = "contact_velocity"
"""Velocity of each contact point in B_t, along and across the ground's normal
``(*batch, num_points * 4)``, m/s, zero beyond the margin."""

CONTACT_DEPTH = "contact_depth"
"""Predicted penetration of each contact point at K times within the control step
``(*batch, num_points * K)``, m, at least zero, and zero beyond the margin."""

CONTACT_FORCE = "contact_force"
"""Predicted mean contact force on every dof over the control step, in B_t ``(*batch, nv)``,
N and N m. Only where the model's `FeatureConfig` asks for it."""

CONTACT_NORMAL = "contact_normal"
"""Ground normal at each point in B_t ``(*batch, num_points * 3)``, zero beyond the
margin. Only where it does not follow from gravity."""

SELF_CONTACT = "self_contact"
"""Distance, normal, velocity and predicted depth of pairs of the robot's own shapes in B_t
``(*batch, D)``; see SelfContactFeatures. Only where the model's `FeatureConfig` asks."""

STATE_DELTA = "state_delta"
"""Change of the state over one control step in B_t ``(*batch, 2 nv)``; see StateDelta."""

TRUST = "trust"
"""How familiar the last step's input was to the model ``(*batch, 1)``, float32, in [0, 1];
1: as 99% of its training data. Only in envs with a guard, see `GuardedDynamics`."""

FAULT = "fault"
"""Why an episode ended that should not have ``(*batch, 1)``, int64, see `envs.faults`;
0: no fault."""
