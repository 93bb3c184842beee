"""A checkpoint comes back bit for bit, and a crash while saving leaves the old one."""

import json
import os
import re
import shlex
import subprocess
import warnings
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import mujoco
import pytest
import torch
from dynamics_helpers import edit_card, random_drive, random_model, roll, unequal_keys

import torchrl_nerd
from torchrl_nerd import from_pretrained, load_scene
from torchrl_nerd.analytic import FreeBodyPenaltyStep, make_step
from torchrl_nerd.checkpoint import (
    CARD,
    PRETRAINED,
    WEIGHTS,
    load_checkpoint,
    make_card,
    read_checkpoint,
    save_checkpoint,
    shipped_card,
    shipped_models,
)
from torchrl_nerd.configs import FeatureConfig, TrainConfig
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.files import check_writable, read_json, write_atomically, write_json
from torchrl_nerd.modules.networks import NETWORKS
from torchrl_nerd.robots import PRESETS, SCENES

ROOT = Path(__file__).parents[1]
SCENE = load_scene("cartpole")


@pytest.fixture
def folder(tmp_path, generator) -> Path:
    """A sound checkpoint."""
    model = random_model(SCENE, generator)
    return save_checkpoint(model, tmp_path / "model", make_card(model))


@pytest.mark.parametrize(
    "network", ["transformer-2x64", "mlp-4x64", "gru", "transformer-4x128"]
)
def test_round_trip_keeps_every_bit(scene, network, tmp_path, generator):
    model = random_model(scene, generator, network)
    card = make_card(model, {"note": "made by a test"})
    save_checkpoint(model, tmp_path, card)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copies = [load_checkpoint(tmp_path), from_pretrained(tmp_path, scene)]
    drive = random_drive(scene, 4, 5, generator)
    expected = roll(NeRDDynamics(model), *drive)
    for copy in copies:
        assert copy.config == NETWORKS[network] and copy.scene.hash == scene.hash
        assert not unequal_keys(roll(NeRDDynamics(copy), *drive), expected)
    assert sorted(path.name for path in tmp_path.iterdir()) == [CARD, WEIGHTS]
    assert json.loads((tmp_path / CARD).read_text()) == json.loads(json.dumps(card))


@pytest.mark.parametrize("config", [FeatureConfig(True), FeatureConfig(True, True)])
@pytest.mark.parametrize("name", ["ant", "double_pendulum"])
def test_a_model_keeps_the_features_it_learned_on(name, config, tmp_path, generator):
    scene = load_scene(name)
    model = random_model(scene, generator, features=config)
    card = make_card(model)
    assert card["features"] == asdict(config)
    loaded = load_checkpoint(save_checkpoint(model, tmp_path, card), scene)
    assert loaded.scene_features.config == config
    drive = random_drive(scene, 4, 5, generator)
    paths = [roll(NeRDDynamics(m), *drive) for m in (model, loaded)]
    assert not unequal_keys(*paths)


def test_an_analytic_step_keeps_its_parameters(tmp_path):
    scene = load_scene("cube_real")
    step = FreeBodyPenaltyStep(scene, num_substeps=5)
    step.set_values({"friction": 0.3, "centre_z": 0.004})
    card = make_card(step)
    assert card["kind"] == "analytic" and card["network"] is None
    loaded = load_checkpoint(save_checkpoint(step, tmp_path, card))
    assert loaded.kind == "analytic" and loaded.config == step.config
    assert loaded.values() == step.values()


@pytest.mark.parametrize("name", shipped_models())
def test_every_shipped_card_says_its_kind(name):
    card, model = shipped_card(name), from_pretrained(name)
    assert card["kind"] == model.kind
    is_hybrid = name.split("-")[1:2] == ["hybrid"]
    assert (card["kind"] == "hybrid") == is_hybrid
    assert (card["network"] is None) == (card["kind"] == "analytic")
    assert (card["step"] is None) == (card["kind"] == "learned")
    if card["kind"] == "learned":
        assert ("-mlp" in name) == (card["network"]["kind"] == "mlp")


@pytest.mark.parametrize("name", SCENES)
def test_the_name_of_a_scene_is_its_learned_model(name):
    assert from_pretrained(name).kind == "learned"


def test_saving_again_replaces_the_old_model(folder, generator):
    newer = random_model(SCENE, generator)
    save_checkpoint(newer, folder, make_card(newer))
    for key, value in load_checkpoint(folder).state_dict().items():
        assert torch.equal(value, newer.state_dict()[key])


@pytest.mark.parametrize("versions", [None, [], "3.17", {"mujoco": 3}, {}])
def test_a_card_without_versions_is_only_warned_of(folder, versions):
    edit_card(folder, versions=versions)
    with pytest.warns(UserWarning, match="mujoco is"):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"versions": {"mujoco": "2.3.7"}}, "mujoco is 2.3 there"),
        ({"scene_hash": "0" * 16}, f"scene_hash is {'0' * 16} there and {SCENE.hash}"),
        ({"control_step": 0.5}, "control_step is 0.5 there"),
    ],
)
def test_other_physics_are_warned_of_in_one_sentence(folder, changes, named):
    edit_card(folder, **changes)
    with pytest.warns(UserWarning, match=re.escape(named)) as caught:
        load_checkpoint(folder)
    assert len(caught) == 1 and "\n" not in str(caught[0].message)


def test_a_patch_release_of_mujoco_is_no_news(folder):
    version = mujoco.__version__.rsplit(".", 1)[0] + ".99"
    edit_card(folder, versions={"mujoco": version})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_checkpoint(folder)


@pytest.mark.parametrize("inside", ["", "deeper"])
def test_a_file_where_the_folder_should_be(tmp_path, inside, generator):
    path = tmp_path / "model"
    path.write_text("not a folder")
    model = random_model(SCENE, generator, "mlp-4x64")
    with pytest.raises(ValueError, match="folder that can be written") as caught:
        save_checkpoint(model, path / inside, make_card(model))
    assert str(path) in str(caught.value)
    assert path.read_text() == "not a folder"


class Killed(Exception):
    """Stands for a process that ends in the midst of writing."""


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_write_cut_short_leaves_the_old_file_whole(folder, share):
    path, content = folder / WEIGHTS, (folder / WEIGHTS).read_bytes()

    def write(aside: Path) -> None:
        aside.write_bytes(content[::-1][: int(share * len(content))])
        raise Killed

    with pytest.raises(Killed):
        write_atomically(path, write)
    assert path.read_bytes() == content
    assert sorted(p.name for p in folder.iterdir()) == [CARD, WEIGHTS]
    load_checkpoint(folder)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="not on Windows")
def test_what_is_no_regular_file_is_left_alone(tmp_path):
    """As a device is, which a rename would replace."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    (tmp_path / "link").symlink_to(pipe)
    for path in (pipe, tmp_path / "link"):
        for way in (check_writable, lambda where: write_json(where, {})):
            with pytest.raises(
                ValueError, match=r"expected a regular file .*, got a pipe"
            ):
                way(path)
    assert pipe.is_fifo() and sorted(tmp_path.iterdir()) == [tmp_path / "link", pipe]


@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_leads_to_the_file_that_is_written(is_there, tmp_path):
    target, link = tmp_path / "folder" / "target.json", tmp_path / "link.json"
    link.symlink_to(target)
    target.parent.mkdir()
    if is_there:
        target.write_text("{}")
    check_writable(link)
    write_json(link, {"a": 1})
    assert link.is_symlink() and not target.is_symlink()
    assert read_json(target) == read_json(link) == {"a": 1}
    assert [*target.parent.iterdir()] == [target]


def test_a_card_that_json_cannot_hold_leaves_the_old_one(folder):
    old = (folder / CARD).read_text()
    with pytest.raises(TypeError):
        write_json(folder / CARD, {"error": object()})
    assert (folder / CARD).read_text() == old


def test_what_is_not_finite_is_null_in_a_card(folder):
    numbers = [float("nan"), float("inf"), 1.0]
    write_json(folder / CARD, {"errors": {"mean": numbers}})
    assert read_json(folder / CARD) == {"errors": {"mean": [None, None, 1.0]}}


def test_nothing_is_ever_unpickled():
    """No checkpoint may run code; a copy in memory is another matter."""
    sources = list(Path(torchrl_nerd.__file__).parent.rglob("*.py"))
    assert len(sources) > 20
    for path in sources:
        text = path.read_text()
        found = re.search(r"\b(import pickle|pickle\.\w+\(|torch\.(load|save)\()", text)
        assert found is None, f"{path.name}: {found}"


MADE_BY_MAKE = re.findall(r"^model-([\w-]+):", (ROOT / "Makefile").read_text(), re.M)


MODELS = ("cartpole", "franka_gravity-mlp", "cube-mlp")


@pytest.mark.parametrize("name", MODELS)
def test_presets_are_those_of_the_shipped_models(name):
    made = read_json(PRETRAINED / name / CARD)["training"]
    preset = PRESETS[name.removesuffix("-mlp")]
    assert not made.get("init_from")
    expect_settings(made, asdict(preset.train))


@pytest.mark.parametrize("name", MADE_BY_MAKE)
def test_so_are_make_targets_of_models_that_take_more(name):
    made = read_json(PRETRAINED / name / CARD)["training"]
    preset = PRESETS[name.removesuffix("-mlp").removesuffix("-adaptive")]
    changes, trajectories = last_training(f"model-{name}")
    # continued, learned on a GPU, or from data along a policy as well
    is_plain = made["init_from"] is None and made["device"] == "cpu"
    assert not is_plain or trajectories != preset.data.trajectories
    assert 0 <= trajectories - made["trajectories"] <= 1e-4 * trajectories  # dropped
    expect_settings(made, {**asdict(preset.train), **changes})


def expect_settings(made: dict, settings: dict) -> None:
    # what is younger than the model has its default, which is how things were before
    younger = asdict(TrainConfig())
    assert {key: made.get(key, younger[key]) for key in settings} == settings


def last_training(target: str) -> tuple[dict, int]:
    """Settings that the last training of a make target gives, trajectories it draws."""
    plan = subprocess.run(
        ["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.replace("\\\n", " ")
    lines = [shlex.split(line) for line in plan.splitlines() if "cli" in line]
    words = next(words for words in reversed(lines) if "train" in words)
    given = {a[2:].replace("-", "_"): b for a, b in pairwise(words) if a[:2] == "--"}
    changes = {
        key: True if isinstance(value, bool) else type(value)(given[key])
        for key, value in asdict(TrainConfig()).items()
        if key in given
    }
    sets = words[words.index("--data") + 1 :]
    sets = sets[: next(i for i, x in enumerate(sets) if x.startswith("--"))]
    found = [drawn(lines, folder) for folder in sets]
    return changes, sum(count * (steps // found[0][1]) for count, steps in found)


def drawn(lines: list[list[str]], folder: str) -> tuple[int, int]:
    """Trajectories that the commands draw into a data set, and their steps."""
    for words in (x for x in lines if "--trajectories" in x):
        out = words[words.index("--out") + 1].rstrip(";")
        if re.fullmatch(re.sub(r"\$\w+", r"\\w+", out), folder):
            given = dict(pairwise(words))
            steps = int(given.get("--steps", 100))
            return int(given["--trajectories"].rstrip(";")), steps
    raise AssertionError(f"no command draws {folder}")


def test_a_model_saved_again_still_names_the_solver_it_learned_from(tmp_path):
    model = from_pretrained("cartpole-mlp-rk4")
    again, check = read_checkpoint(save_checkpoint(model, tmp_path, make_card(model)))
    card, shipped = make_card(again), shipped_card("cartpole-mlp-rk4")
    for key in ("reference_ratio", "scene_hash", "control_step"):
        assert card[key] == shipped[key], key
    assert card["reference_ratio"] > 1
    assert check is not None and check.model < 1e-6  # its steps are repeated


def test_a_folder_stands_for_no_kind_and_a_scene_is_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nerd").mkdir()
    with pytest.raises(ValueError, match="no learned model of .* is shipped: make one"):
        from_pretrained("nerd", load_scene("gymnasium/Hopper-v5"))
    with pytest.raises(ValueError, match="expected a Scene beside 'nerd', got 'ant'"):
        from_pretrained("nerd", "ant")


def test_a_folder_goes_before_the_short_name_of_a_shipped_model(tmp_path, monkeypatch):
    step = make_step(load_scene("cube_slope"))
    save_checkpoint(step, tmp_path / "cube_slope", make_card(step))
    assert from_pretrained("cube_slope").kind == "learned"
    monkeypatch.chdir(tmp_path)
    assert from_pretrained("cube_slope").kind == "analytic"
