"""Closed chains, tendons and props: MuJoCo's own steps, and models that learn them."""

import mujoco
import numpy as np
import pytest
import torch
from helpers import make_scene
from tensordict import TensorDict

from torchrl_nerd import NeRDEnv, make_env
from torchrl_nerd.cli import main
from torchrl_nerd.evaluation.explain import explain
from torchrl_nerd.keys import QPOS, QVEL
from torchrl_nerd.modules.nerd import SceneFeatures
from torchrl_nerd.robots import load_scene
from torchrl_nerd.tasks import SceneTask
from torchrl_nerd.transforms import StateDelta

ROWS, STEPS = 6, 5
LINK = """<body name="{0}" pos="{1}"><joint name="{0}" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.3" contype="2"
    conaffinity="0"/><site name="{0}" pos="0 0 -0.3"/>{2}</body>"""
TWO = LINK.format("a", "0 0 1", LINK.format("b", "0 0 -0.3", ""))
MOTOR = '<actuator><motor joint="a" gear="0.5"/></actuator>'
FLOOR = '<geom type="plane" size="0 0 1"/>'
TORSO = """<body name="torso" pos="0 0 0.6"><freejoint/>
  <geom type="cylinder" size="0.15 0.05" mass="2"/>{0}{1}{2}</body>"""
WALKER = TORSO.format(
    LINK.format("a", "0.1 0 0", ""), LINK.format("b", "-0.1 0 0", ""), ""
)
BALL = """<body name="ball" pos="0.5 0 0.3"><freejoint/>
  <geom type="ellipsoid" size="0.1 0.12 0.1" mass="0.2"/></body>"""
FIXED = (
    '<tendon><fixed name="t" {}><joint joint="a" coef="1"/><joint joint="b" coef="-2"/>'
)
FIXED += "</fixed></tendon>"
SPATIAL = (
    '<tendon><spatial name="t" {}><site site="a"/><site site="b"/></spatial></tendon>'
)
MECHANISMS = {
    "connect to the world": (TWO, '<equality><connect body1="b" anchor="0 0 -0.3"/>'
        "</equality>"),
    "closed chain": (LINK.format("a", "0 0 1", "") + LINK.format("b", "0.2 0 1", ""),
        '<equality><connect body1="a" body2="b" anchor="0.1 0 -0.3"/></equality>'),
    "weld": (LINK.format("a", "0 0 1", "") + LINK.format("b", "0.2 0 1", ""),
        '<equality><weld body1="a" body2="b"/></equality>'),
    "joint equality": (TWO, '<equality><joint joint1="a" joint2="b" '
        'polycoef="0 -0.5 0.1 0 0"/></equality>'),
    "tendon equality": (TWO, FIXED.format("") + '<equality><tendon tendon1="t"/>'
        "</equality>"),
    "tendon limit": (TWO, FIXED.format('range="-0.5 0.3" limited="true"')),
    "tendon spring": (TWO, SPATIAL.format('stiffness="30" damping="1" springlength="0.1"')),
    "tendon friction": (TWO, FIXED.format('frictionloss="0.1" armature="0.01"')),
    "string": (TWO + BALL.replace("ellipsoid", "sphere"), '<tendon><spatial limited="true" '
        'range="0 0.6"><site site="b"/><site site="s"/></spatial></tendon>'),
    "legs on a bar": (FLOOR + WALKER, '<equality><joint joint1="a" joint2="b"/>'
        "</equality>"),
    "ball before the robot": (FLOOR + BALL + WALKER, ""),
    "mocap target": (FLOOR + WALKER + '<body mocap="true" pos="1 0 1"><geom size="0.1" '
        'contype="0" conaffinity="0"/><site name="goal"/></body>', '<sensor><framepos '
        'objtype="site" objname="goal"/></sensor>'),
    "door and ball": (FLOOR + WALKER + BALL + '<body pos="0 0.6 0.5"><joint axis="0 0 1"/>'
        '<geom type="box" size="0.2 0.02 0.3" pos="0.2 0 0"/></body>', ""),
    "unnamed": (FLOOR + '<body pos="0 0 1"><joint axis="0 1 0"/><geom size="0.1" '
        'pos="0.3 0 0"/></body><body pos="1 0 0.5"><joint axis="0 1 0"/><geom size="0.1" '
        'pos="0.3 0 0"/></body>', ""),
}  # fmt: skip


@pytest.fixture(scope="module", params=MECHANISMS)
def path(request, tmp_path_factory):
    """A file with the mechanism."""
    world, rest = MECHANISMS[request.param]
    if "joint=" in rest or '"a"' in world:
        rest += MOTOR
    world = world.replace("</body>", '<site name="s"/></body>', 1) if "string" == (
        request.param) else world  # fmt: skip
    file = tmp_path_factory.mktemp("mechanism") / "robot.xml"
    file.write_text(f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>")
    return file


@pytest.fixture
def scene(path):
    """The mechanism, read once."""
    return load_scene(path)


def some_states(scene, generator):
    return TensorDict(scene.sample_initial(ROWS, generator)[0], [ROWS])


def test_the_env_is_mujoco(path, generator):
    env = make_env(str(path), "mujoco", num_envs=ROWS, seed=0)
    model, scene = env.scene.model, env.scene
    td = env.reset(some_states(scene, generator), set_state=True)
    data = [mujoco.MjData(model) for _ in range(ROWS)]
    for row, one in enumerate(data):
        one.qpos, one.qvel = td[QPOS][row], td[QVEL][row]
    for _ in range(STEPS):
        td = env.rand_action(td)
        action = td["action"].numpy()
        td = env.step(td)["next"].exclude("reward")
        for row, one in enumerate(data):
            one.ctrl = action[row]
            mujoco.mj_step(model, one, scene.substeps)
            for key, want in ((QPOS, one.qpos), (QVEL, one.qvel)):
                np.testing.assert_allclose(td[key][row], want, 1e-9, 1e-9)


def test_the_change_of_state_is_lossless(scene, generator):
    start, end = (some_states(scene, generator) for _ in range(2))
    change, states = (
        StateDelta(scene),
        [x[k] for x in (start, end) for k in (QPOS, QVEL)],
    )
    delta = change.delta(*states)
    again = change.integrate(*states[:2], delta)
    back = change.delta(*states[:2], *again)
    torch.testing.assert_close(back, delta, rtol=1e-12, atol=1e-12)


def test_every_joint_and_prop_is_seen(scene, generator):
    """Features tell any two states apart, up to where a floating robot stands."""
    state = some_states(scene, generator)
    tokens, torque = (
        SceneFeatures(scene),
        torch.zeros(ROWS, len(scene.actuated)).double(),
    )
    here = tokens(state[QPOS], state[QVEL], torque, None)
    for v in range(scene.model.nv):
        moved = state[QPOS].clone().numpy()
        step = 1e-3 * np.eye(scene.model.nv)[v]
        for row in moved:
            mujoco.mj_integratePos(scene.model, row, step, 1.0)
        there = tokens(torch.from_numpy(moved), state[QVEL], torque, None)
        base = scene.base.dof_address
        is_place = scene.base.is_floating and base <= v < base + 3
        if not is_place or scene.base.others:
            assert ((here - there).abs().amax(-1) > 1e-6).all(), v
        faster = tokens(state[QPOS], state[QVEL] + torch.from_numpy(step), torque, None)
        assert ((here - faster).abs().amax(-1) > 1e-6).all()


def test_explain_needs_no_names(scene):
    text = str(explain(scene))
    assert "''" not in text and "joint None" not in text


TRAINED = ("ball before the robot", "closed chain", "tendon limit", "unnamed")


@pytest.mark.slow
@pytest.mark.parametrize("path", TRAINED, indirect=True)
def test_a_model_of_seconds_steps_and_streams(path, tmp_path, short_rollouts, capsys):
    data, out = tmp_path / "data", tmp_path / "run"
    sizes = "--trajectories 40 --steps 12 --quiet".split()
    assert main(["data", str(path), "--out", str(data), *sizes]) == 0
    sizes = "--network transformer-2x64 --steps 8 --rollout-steps 0 --batch-size 16"
    sizes += " --sequence-length 8 --quiet"
    where = ["--data", str(data), "--out", str(out)]
    assert main(["train", str(path), *where, *sizes.split()]) == 0
    model = ["--model", str(out / "last")]
    assert main(["eval", str(path), *model, "--num-trajectories", "4"]) == 0
    said = capsys.readouterr().out
    assert "ball position" in said or "ball" not in path.read_text()
    paths, start = [], None
    task = SceneTask(load_scene(path))
    for inference in ("streaming", "window"):
        env = NeRDEnv(task, out / "last", 3, seed=0, inference=inference)
        start = env.reset() if start is None else start
        state, passed = env.reset(start.select(QPOS, QVEL), set_state=True), []
        for _ in range(4):
            state["action"] = torch.zeros(env.action_spec.shape)
            state = env.step(state)["next"].exclude("reward")
            passed.append(state[QPOS])
        paths.append(torch.stack(passed))
    assert paths[0].isfinite().all()
    torch.testing.assert_close(*paths, rtol=1e-5, atol=1e-5)


ARM = """<body name="arm"><joint name="a"/><geom size="0.05" pos="0.3 0 0"/>
  <body pos="0.3 0 0"><joint name="b"/><geom size="0.05" pos="0.3 0 0"/></body></body>"""
DRONE = (
    """<body name="drone" pos="0 0 2"><freejoint name="d"/><geom size="0.1"/></body>"""
)
MOTORS = '<motor joint="a"/><motor joint="b"/><motor joint="d" gear="0 0 1 0 0 0"/>'


def test_the_robot_is_the_tree_of_most_actuators(tmp_path):
    """Not that of most driven dofs: a motor of a free joint counts once."""
    for order in (ARM + DRONE, DRONE + ARM):
        text = f"<mujoco><worldbody>{order}</worldbody>"
        (tmp_path / "robots.xml").write_text(
            f"{text}<actuator>{MOTORS}</actuator></mujoco>"
        )
        scene = load_scene(str(tmp_path / "robots.xml"))
        assert scene.model.body(scene.base.body).name == "arm"


def test_closed_loops_may_have_any_solver(tmp_path):
    """Of which one that stops early depends on where the robot is, a little."""
    legs = "".join(
        f'''<body name="{x}" pos="{0.1 * i} 0 0"><joint axis="0 1 0" name="{x}"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3"/></body>'''
        for i, x in enumerate("lr")
    )
    text = f"""<mujoco><option solver="PGS" iterations="3"/><worldbody><body name="t"
      pos="0 0 1"><freejoint/><geom size="0.1"/>{legs}</body></worldbody><equality>
      <connect body1="l" body2="r" anchor="0 0 -0.3"/></equality></mujoco>"""
    (tmp_path / "loop.xml").write_text(text)
    assert load_scene(str(tmp_path / "loop.xml")).base.is_floating


def test_a_robot_that_touches_nothing_stays_where_it_is_put(generator):
    """However its props touch the ground."""
    robot = '<body pos="0 0 1"><freejoint/><geom size="0.1" contype="0"/></body>'
    prop = '<body pos="1 0 1"><freejoint/><geom size="0.1"/></body>'
    floor = '<geom type="plane" size="0 0 1" conaffinity="1"/>'
    text = f"<mujoco><worldbody>{floor}{robot}{prop}</worldbody></mujoco>"
    scene = make_scene(text.replace("contype", 'conaffinity="0" contype'))
    state = {"qpos": torch.from_numpy(scene.model.qpos0).expand(2, -1).clone()}
    before = state["qpos"].clone()
    scene.place_on_terrain(state, torch.zeros(2).double())
    assert torch.equal(state["qpos"], before)
