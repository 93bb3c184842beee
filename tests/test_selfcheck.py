"""What was stored among the weights is repeated, and what differs is said."""

import warnings

import pytest
import torch
from dynamics_helpers import model_of_kind, random_model
from safetensors.torch import load_file, save_file

from torchrl_nerd.checkpoint import (
    PRETRAINED,
    WEIGHTS,
    from_pretrained,
    load_checkpoint,
    make_card,
    read_checkpoint,
    save_checkpoint,
    shipped_models,
)
from torchrl_nerd.cli.main import main
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.selfcheck import PREFIX


@pytest.mark.parametrize("name", shipped_models())
def test_shipped_models_repeat_their_steps_and_know_their_data(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = from_pretrained(name)
    check = read_checkpoint(PRETRAINED / name)[1]
    assert check is not None and check.agrees
    if isinstance(model, NeRD):
        assert model.training_range.is_fitted


@pytest.mark.parametrize("kind", ["streaming", "hybrid", "analytic"])
def test_a_saved_model_repeats_its_steps(kind, scene, generator, tmp_path):
    model = model_of_kind(kind, scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    check = read_checkpoint(tmp_path, scene)[1]
    assert check is not None and check.mujoco == 0.0 and check.model < 1e-5


@pytest.mark.parametrize(("kind", "word"), [("mujoco", "MuJoCo"), ("model", "model")])
def test_other_steps_are_warned_of_with_the_number(
    scene, kind, word, generator, tmp_path
):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    stored = load_file(tmp_path / WEIGHTS)
    key = f"{PREFIX}{kind}_qpos"
    stored[key] = stored[key] + 0.1 * (1.0 + stored[key].abs().max())
    save_file(stored, tmp_path / WEIGHTS)
    with pytest.warns(UserWarning, match=rf"{word} differs|the model by") as caught:
        load_checkpoint(tmp_path, scene)
    assert "e-0" in str(caught[0].message)


def test_weights_without_stored_steps_load(scene, generator, tmp_path):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    stored = load_file(tmp_path / WEIGHTS)
    plain = {k: v for k, v in stored.items() if not k.startswith(PREFIX)}
    assert len(plain) < len(stored)
    save_file(plain, tmp_path / WEIGHTS)
    assert read_checkpoint(tmp_path, scene)[1] is None


@pytest.mark.parametrize("junk", ["other tensors", "other shapes"])
def test_stored_steps_that_are_none_are_refused(scene, junk, generator, tmp_path):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    path, changed = tmp_path / WEIGHTS, {}
    for key, value in load_file(path).items():
        is_step = key.startswith(PREFIX)
        if not is_step or junk == "other shapes":
            changed[key] = value[:, :1].clone() if is_step else value
    if junk == "other tensors":
        changed[f"{PREFIX}x"] = torch.zeros(3)
    save_file(changed, path)
    with pytest.raises(ValueError, match="expected a few steps of"):
        load_checkpoint(tmp_path, scene)


def test_the_doctor_finds_all_well(capsys):
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    for name in (*shipped_models(), "mujoco", "C++ compiler", "OpenGL"):
        assert name in shown
