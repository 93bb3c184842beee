"""Models of varied robots: told their parameters or not, trained after a history."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from helpers import slow_but
from tensordict import TensorDict

from torchrl_nerd import NeRDEnv, make_env
from torchrl_nerd.checkpoint import load_checkpoint, make_card, save_checkpoint
from torchrl_nerd.cli import main
from torchrl_nerd.configs import FeatureConfig, TrainConfig
from torchrl_nerd.data.generate import is_sound
from torchrl_nerd.data.simulate import simulate
from torchrl_nerd.data.strategies import strategy
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.candidates import mujoco_name
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.files import read_json
from torchrl_nerd.keys import JOINT_TORQUE, PARAMETERS, QPOS, QVEL
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import load_scene, make_task, protocol_of, source_of
from torchrl_nerd.training.losses import rollout_loss
from torchrl_nerd.training.samples import data_stats
from torchrl_nerd.training.sequences import Sequences, change_times
from torchrl_nerd.training.trainer import Trainer

SCENE = load_scene("cartpole").vary({"mass:pole": (0.3, 3.0), "motor": (0.6, 1.4)})
TOLD = FeatureConfig(parameters=True)
LOSS_EPS = 0.01


@pytest.fixture
def data(generator):
    found = simulate(SCENE, 24, 20, generator)
    return found[is_sound(found)]


def model_of(data, network="transformer-2x64", features=TOLD):
    stats = data_stats(SCENE, data, features)
    return NeRD(SCENE, features, NETWORKS[network], stats).eval()


def test_only_a_told_model_sees_the_parameters(data):
    for features, is_seen in ((TOLD, True), (FeatureConfig(), False)):
        dynamics = NeRDDynamics(model_of(data, "mlp-2x32", features))
        state, torque = (
            data[:, 0].select(QPOS, QVEL, PARAMETERS),
            data[:, 0][JOINT_TORQUE],
        )
        other = state.clone()
        other[PARAMETERS] *= 1.1
        after, changed = (dynamics.step(s, torque) for s in (state, other))
        assert torch.equal(after[QVEL], changed[QVEL]) != is_seen
        assert torch.equal(changed[PARAMETERS], other[PARAMETERS])
    with pytest.raises(ValueError, match="expected parameters in the state, got none"):
        NeRDDynamics(model_of(data)).step(data[:, 0].select(QPOS, QVEL), torque)
    with pytest.raises(ValueError, match="expected a varied scene for a told"):
        NeRD(load_scene("cartpole"), TOLD, NETWORKS["mlp-2x32"])


def test_a_rollout_sees_true_states_first_and_then_its_own(data):
    model, history, seen, made = model_of(data), 4, [], []
    step = model.step

    def watched(state, *args):
        seen.append(state[1])
        found = step(state, *args)
        made.append(found[1])
        return found

    model.step = watched
    qpos = torch.cat((data[QPOS], data["next", QPOS][:, -1:]), 1)
    qvel = torch.cat((data[QVEL], data["next", QVEL][:, -1:]), 1)
    batch = qpos, qvel, data[JOINT_TORQUE], None
    loss = rollout_loss(model, *batch, LOSS_EPS, data[PARAMETERS][:, 0], history)
    assert len(seen) == 1 + data.batch_size[1] - history
    assert torch.equal(seen[0], qvel[:, :history])  # read at once
    assert torch.equal(seen[1], qvel[:, history])
    for before, state in zip(made[1:], seen[2:], strict=False):
        assert torch.equal(state, before)

    def by_steps(tokens, memory):
        steps = (model.network.step(token, memory) for token in tokens.unbind(1))
        return torch.stack(list(steps), 1)

    model.network.read = by_steps
    same = rollout_loss(model, *batch, LOSS_EPS, data[PARAMETERS][:, 0], history)
    torch.testing.assert_close(loss, same, rtol=1e-5, atol=0)
    none = rollout_loss(model, *batch, LOSS_EPS, data[PARAMETERS][:, 0])
    assert loss.isfinite() and none != same


@pytest.mark.parametrize("is_told", [True, False])
def test_a_trained_model_comes_back_with_its_variation(is_told, data, tmp_path):
    config = TrainConfig(
        network="mlp-2x32",
        parameters=is_told,
        steps=4,
        rollout_steps=2,
        rollout_history=3,
        rollout_length=2,
        batch_size=4,
        rollout_batch_size=4,
        single_step_fraction=0.0,
        validate_every=6,
    )
    how = {"horizons": (2,), "quiet": True, "logger": "csv"}
    Trainer(SCENE, data, source_of(SCENE), config, tmp_path, **how).run()
    model = load_checkpoint(tmp_path / "last")
    assert model.scene.variation.ranges == SCENE.variation.ranges
    assert model.scene_features.size == 6 + 1 + 2 * is_told
    if is_told:
        with pytest.raises(ValueError, match="expected a varied scene"):
            load_checkpoint(tmp_path / "last", load_scene("cartpole"))
    else:
        assert load_checkpoint(tmp_path / "last", load_scene("cartpole"))


OTHERS = {
    "ranges": {"mass:pole": (0.3, 3.0), "motor": (0.5, 1.4)},
    "order": {"motor": (0.6, 1.4), "mass:pole": (0.3, 3.0)},
    "names": {"mass:cart": (0.3, 3.0), "motor": (0.6, 1.4)},
    "number": {"mass:pole": (0.3, 3.0)},
}


@pytest.mark.parametrize(
    ("other", "is_told"),
    slow_but(
        [("names", True), ("names", False), ("number", True)],
        product(OTHERS, (True, False)),
    ),
)
def test_a_told_model_knows_its_own_parameters_alone(other, is_told, data, tmp_path):
    """By folder, as an object, guarded, and over another ground; others adapt to all."""
    task = make_task("cartpole/swingup").vary(OTHERS[other])
    model = model_of(data, "mlp-2x32", FeatureConfig(parameters=is_told))
    model.training_range.feature_high.fill_(1e9)  # as if fitted
    folder = save_checkpoint(model, tmp_path, make_card(model))
    for way in (
        lambda: load_checkpoint(folder, task.scene),
        lambda: make_env(task, folder),
        lambda: NeRDEnv(task, model),
        lambda: NeRDEnv(task, model, guard="flag"),
        lambda: model.with_terrain(task.scene),
    ):
        if is_told:
            with pytest.raises(
                ValueError, match=r"expected the .*0\.3.*, got"
            ) as caught:
                way()
            assert str(task.scene.variation.ranges) in str(caught.value)
        else:
            way()
    own = task.vary(SCENE.variation.ranges)
    assert NeRDEnv(own, folder, 2).rollout(2)["next", QPOS].isfinite().all()


@pytest.mark.parametrize("length", [5, 24])
def test_rollouts_are_of_one_robot_where_robots_change(length, generator):
    data = strategy(SCENE, "changing")(24, 48, generator)
    data = data[is_sound(data)]
    sequences = Sequences(model_of(data), data)
    for batch in (sequences.rollout(200, length, generator) for _ in range(3)):
        qpos, qvel, torques, _, own = batch
        state = TensorDict({QPOS: qpos[:, 0], QVEL: qvel[:, 0], PARAMETERS: own}, [200])
        dynamics = MujocoDynamics(SCENE)
        dynamics.reset(state)
        for step, torque in enumerate(torques.unbind(1), 1):
            state = dynamics.step(state, torque)
            torch.testing.assert_close(state[QPOS], qpos[:, step], rtol=0.0, atol=1e-9)
    assert sequences.change is not None
    with pytest.raises(
        ValueError, match=f"at most {sequences.longest} steps with robots"
    ):
        sequences.expect_rollouts(sequences.longest + 1)
    sequences.expect_rollouts(sequences.longest)
    none = change_times(data[: len(data) // 3])
    assert none is None and change_times(data.exclude(PARAMETERS)) is None


def test_rollouts_longer_than_one_robot_stays_are_refused_at_once(generator, tmp_path):
    """Before the single steps that would come first."""
    data = strategy(SCENE, "changing")(24, 48, generator)
    config = TrainConfig(steps=3, rollout_steps=1, rollout_history=32)
    with pytest.raises(ValueError, match="history included, of at most .* got 40"):
        Trainer(SCENE, data[is_sound(data)], SCENE, config, tmp_path)


@pytest.mark.slow
def test_the_command_line_measures_after_a_history(tmp_path, capsys, monkeypatch):
    """Beside MuJoCo, which knows every robot, and one that is nominal for all."""

    def short(scene):
        return replace(protocol_of(scene), horizons=(100,))

    monkeypatch.setattr("torchrl_nerd.cli.eval.protocol_of", short)
    path = tmp_path / "eval.json"
    how = ("--model", "cartpole-adaptive", "--num-trajectories", "16", "--quiet")
    seen = ("--vary", "preset", "--history", "20", "--json", str(path))
    assert main(["eval", "cartpole", *how, *seen]) == 0
    found = {
        (row["name"], row["quantity"]): row["mean"]
        for row in read_results(path)["results"]["errors"]
        if (row["case"], row["steps"]) == ("driven", 100)
    }
    exact = mujoco_name(SCENE)
    assert found[exact, "hinge"] == 0.0
    nominal, adapted = found[f"{exact}, nominal", "hinge"], found[how[1], "hinge"]
    assert 0.0 < adapted < 0.8 * nominal
    assert found["analytic", "hinge"] == pytest.approx(nominal, rel=0.2)
    capsys.readouterr()
    for more in (("--vary", "preset"), ("--history", "2")):
        assert main(["eval", "cartpole", "--data", "log.npz", *more]) == 2
        assert "without --data" in capsys.readouterr().err


def test_the_command_line_varies_data_and_training(tmp_path, capsys):
    where = tmp_path / "data"
    vary = ("--vary", "preset", "mass:pole=1:1")
    made = ("--trajectories", "4", "--steps", "12", "--out", str(where), "--quiet")
    assert main(["data", "cartpole", *vary, *made]) == 0
    tiny = ("--steps", "2", "--rollout-steps", "0", "--sequence-length", "8")
    run = ("--out", str(tmp_path / "run"), "--data", str(where), "--quiet")
    how = ("--network", "transformer-2x64@8", "--logger", "csv", *tiny, *run)
    assert main(["train", "cartpole", *vary, *how]) == 0
    card = load_checkpoint(tmp_path / "run" / "last").scene.variation.ranges
    assert card["mass:pole"] == [1.0, 1.0] and card["motor"] == [0.6, 1.4]
    capsys.readouterr()
    for dry in ((), ("--dry-run",)):
        assert main(["train", "cartpole", "--vary", "preset", *run, *dry]) == 2
        assert "expected data that vary" in capsys.readouterr().err
    assert main(["train", "cartpole", *vary, *how, "--dry-run"]) == 0
    changing = (
        "--strategy",
        "changing",
        "--out",
        str(tmp_path / "changing"),
        *made[:3],
        "20",
        "--quiet",
    )
    assert main(["data", "cartpole", *vary, *changing]) == 0
    assert read_json(tmp_path / "changing" / "data.json")["strategy"] == "changing"
    capsys.readouterr()
    assert main(["data", "cartpole", *changing]) == 2
    assert "expected parameters that vary" in capsys.readouterr().err
    short = ("--steps", "16", *changing[:2], "--out", str(tmp_path / "short"))
    assert main(["data", "cartpole", *vary, *short]) == 2
    assert "expected steps of at least 17, got 16" in capsys.readouterr().err
    for more in (changing[:2], ("--vary", "preset")):
        assert main(["data", "cartpole", "--from", "log.npz", *more]) == 2
        assert "--from without options" in capsys.readouterr().err
    for bad in ("mass:pole", "mass:pole=1", "mass:pole=a:b", "mass:rod=1:2"):
        assert (
            main(["data", "cartpole", "--vary", bad, "--out", str(tmp_path / "x")]) == 2
        )
        assert capsys.readouterr().err.count("\n") == 1
