"""The study of hidden parameters: its motions, its fit, its measurements."""

import json

import pytest
import torch
from dynamics_helpers import random_model
from hidden_parameters.__main__ import HISTORIES, Options, main
from hidden_parameters.adaptation import rates, watch
from hidden_parameters.identify import identify, identify_by_mujoco
from hidden_parameters.motions import draw_parameters, motions
from hidden_parameters.policies import Options as PolicyOptions
from hidden_parameters.policies import by_part
from hidden_parameters.policies import main as learn_policies
from hidden_parameters.told import main as tell
from tables import of_hidden
from tensordict import TensorDict

from torchrl_nerd.checkpoint import (
    from_pretrained,
    load_checkpoint,
    make_card,
    save_checkpoint,
)
from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.robots import load_scene, preset_of

ROWS = 6
SCENE = load_scene("cartpole").vary(preset_of("cartpole").variation)


def test_a_fit_finds_the_parameters_of_a_motion_without_noise(generator):
    """Those that the motion shows: it follows from them to the last steps."""
    own = draw_parameters(SCENE, "inside", ROWS, generator)
    data = motions(SCENE, [own], [60], generator)
    found = identify(SCENE, data[:, :30])
    state = data[:, 30].select("qpos", "qvel").set("parameters", found)
    dynamics = MujocoDynamics(SCENE)
    for now in data[:, 30:].unbind(1):
        state = dynamics.step(state, now["next", "joint_torque"])
    middle = SCENE.variation.values(torch.full_like(own, 0.5))
    error = (state["qpos"] - data[:, -1]["next", "qpos"]).abs().amax(1)
    assert error.median() < 1e-3
    assert ((found - own).abs() <= (middle - own).abs() + 1e-6).double().mean() > 0.7


@pytest.mark.slow
def test_mujocos_own_fit_finds_them_too(generator):
    """As exactly as ours, one row after the other."""
    pytest.importorskip("plotly", reason="mujoco.sysid has packages of its own")
    own = draw_parameters(SCENE, "inside", ROWS, generator)
    data = motions(SCENE, [own], [30], generator)
    found = SCENE.variation.shares(identify_by_mujoco(SCENE, data))
    assert (found - SCENE.variation.shares(own)).abs().median() < 1e-3


@pytest.mark.parametrize("name", ["franka-mlp", "ant"])
def test_a_told_model_begins_as_the_one_that_is_not(name, tmp_path, generator):
    """Its symmetric layers too; only then does training let it heed what it is told."""
    tell(name, tmp_path)
    start = from_pretrained(name, load_scene(name.partition("-")[0]))
    model = load_checkpoint(tmp_path)
    scene = model.scene
    state = TensorDict(scene.sample_initial(ROWS, generator)[0], [ROWS])
    torque = torch.randn(ROWS, len(scene.actuated), dtype=torch.float64)
    told = state.clone().set("parameters", scene.variation.draw(ROWS, generator))
    expected = first(start, state, torque)
    torch.testing.assert_close(first(model, told, torque), expected, rtol=0, atol=1e-4)
    other = told.clone().set("parameters", scene.variation.draw(ROWS, generator))
    with torch.no_grad():
        model.network.embed.weight.add_(0.1)
    assert not first(model, told, torque).equal(first(model, other, torque))


def first(model, state, torque):
    """Velocities after one step."""
    dynamics = NeRDDynamics(model)
    dynamics.reset(state)
    return dynamics.step(state, torque)["qvel"]


@pytest.mark.parametrize(
    ("errors", "shown"),
    [
        ({"cart": 1.0, "hinge": 2.0}, {"hinge (rad)": 2.0}),
        (dict.fromkeys("abc", 3.0), {"the joints (rad)": 3.0}),
        (
            {"base_position": 1.0, "base_orientation": 2.0},
            {"base_position (m)": 1.0, "base_orientation (rad)": 2.0},
        ),
        (
            {"base_position": 1.0, "base_orientation": 2.0, "joints": 3.0},
            {"base_position (m)": 1.0, "joints (rad)": 3.0},
        ),
    ],
    ids=["two joints", "an arm", "a cube", "a walker"],
)
def test_tables_show_a_base_and_the_joints(errors, shown):
    assert of_hidden({k: {"mean": v} for k, v in errors.items()}) == shown


def test_hidden_states_of_symmetric_layers_are_vectors(generator):
    """One of each motion and step, whatever a layer's own shape is."""
    scene = load_scene("ant").vary(preset_of("ant").variation)
    own = draw_parameters(scene, "inside", ROWS, generator)
    data = motions(scene, [own], [3], generator)
    seen = watch(from_pretrained("ant-adaptive", scene), data)
    assert seen.hidden.shape == (len(data), 3, 4 * 128)


def test_a_parameter_changes_where_it_should(generator):
    before = draw_parameters(SCENE, "inside", ROWS, generator)
    after = before.clone()
    after[:, 4] *= 0.5
    data = motions(SCENE, [before, after], [7, 5], generator)
    assert torch.equal(data["parameters"][:, :7, 4], before[:, None, 4].expand(-1, 7))
    assert torch.equal(data["parameters"][:, 7:, 4], after[:, None, 4].expand(-1, 5))
    states = torch.cat((data["next", "qpos"], data["next", "qvel"]), -1)[:, :-1]
    begun = torch.cat((data["qpos"], data["qvel"]), -1)[:, 1:]
    assert torch.equal(states, begun)


@pytest.mark.parametrize("region", ["inside", "corners", "outside"])
def test_regions_are_where_their_names_say(region, generator):
    own = draw_parameters(SCENE, region, 200, generator)
    share = SCENE.variation.shares(own).abs()
    expected = {"inside": share <= 1, "corners": (share - 1).abs() < 1e-9}
    assert expected.get(region, share > 1.2).all()


def test_errors_and_hidden_states_are_those_of_the_model(generator):
    model = random_model(load_scene("cartpole"), generator)
    own = draw_parameters(SCENE, "inside", ROWS, generator)
    data = motions(SCENE, [own], [9], generator)
    errors, hidden, unlike = watch(model, data)
    assert errors.shape == (ROWS, 9) and (errors > 0).all()
    assert hidden.shape == (ROWS, 9, 2 * 64) and unlike.shape == errors.shape


def test_rates_are_of_bands_and_models_that_are_not_told(generator, monkeypatch):
    """A GRU keeps 128 numbers of 4 bytes; a band of 64 twice as much as one of 32."""
    monkeypatch.setattr("hidden_parameters.adaptation.TURNS", 1)
    scene, told = load_scene("cartpole"), FeatureConfig(parameters=True)
    models = {"gru": random_model(scene, generator, "gru")}
    models["told"] = random_model(SCENE, generator, "mlp-2x32", told)
    found = {row["name"]: row for row in rates(scene, models)}
    kib = {name: row["history_kib_per_env"] for name, row in found.items()}
    assert kib.pop("gru") == 0.5 and "told" not in kib and len(kib) == 4
    small, large = (kib[f"transformer 2x64, band {band}"] for band in (32, 64))
    assert 1.9 < large / small < 2.0  # beside the ring some numbers that stay
    assert all(row["steps_per_s"] > 0 for row in found.values())


def test_returns_are_averaged_in_equal_parts_of_a_parameter(generator):
    own = torch.rand(9, 2, generator=generator)
    found = by_part(own[:, 0], own, ["own", "other"])
    low, middle, high = found["own"]
    assert (
        low < middle < high and abs(low + middle + high - 3 * own[:, 0].mean()) < 1e-5
    )
    assert abs(sum(found["other"]) - sum(found["own"])) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "double_pendulum"])
def test_all_of_it_at_a_tiny_budget(name, generator, tmp_path, capsys):
    model = random_model(load_scene(name), generator)
    save_checkpoint(model, tmp_path / "model", make_card(model))
    path = tmp_path / "found.json"
    main(Options(name, {"model": tmp_path / "model"}, 4, 0, fit=False, json=path))
    rows = json.loads(path.read_text())["results"]["errors"]
    assert len(rows) == 3 * 2 * len(HISTORIES)
    assert capsys.readouterr().out


@pytest.mark.slow
def test_policies_of_seconds(generator, tmp_path):
    """Every way learns, and those in the varied model are measured there as well."""
    features = FeatureConfig(parameters=True)
    model = random_model(SCENE, generator, "mlp-2x32", features)
    save_checkpoint(model, tmp_path / "told", make_card(model))
    path = tmp_path / "found.json"
    sizes = {"frames": 32768, "history": 2, "seeds": (0,), "episodes": 8}
    how = PolicyOptions("cartpole/swingup", tmp_path / "told", json=path, **sizes)
    learn_policies(how)
    rows = json.loads(path.read_text())["results"]["policies"]
    assert len(rows) == 6 and all(len(row["by_parameter"]) == 5 for row in rows)
    assert ["promised" in row for row in rows] == [True, True] + 4 * [False]


def test_a_robot_is_driven_as_in_its_training_data(generator):
    """ANYmal by PD controllers, which keep it on its feet; torques let it fall."""
    scene = load_scene("anymal").vary(preset_of("anymal").variation)
    own = draw_parameters(scene, "inside", 16, generator)
    data = motions(scene, [own, own], [40, 20], generator)
    assert data.shape[1] == 60 and len(data) > 8
    height = data["qpos"][:, -1, 2]
    assert height.median() > 0.25
