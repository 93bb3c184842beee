"""What was stored beside the weights is repeated, and what differs is said."""

import warnings

import pytest
import torch
from dynamics_helpers import random_model
from safetensors.torch import load_file, save_file

from torchrl_nerd.checkpoint import (
    PRETRAINED,
    from_pretrained,
    load_checkpoint,
    make_card,
    save_checkpoint,
    shipped_models,
)
from torchrl_nerd.cli.main import main
from torchrl_nerd.selfcheck import FILE, self_check


@pytest.mark.parametrize("name", shipped_models())
def test_shipped_models_repeat_their_steps_and_know_their_data(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = from_pretrained(name)
    check = self_check(model, PRETRAINED / name)
    assert check is not None and check.agrees
    assert model.coverage.is_fitted


def test_a_saved_model_repeats_its_steps(scene, generator, tmp_path):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    check = self_check(load_checkpoint(tmp_path, scene), tmp_path)
    assert check is not None and check.true == 0.0 and check.learned < 1e-5


@pytest.mark.parametrize(("kind", "word"), [("true", "MuJoCo"), ("learned", "model")])
def test_other_steps_are_warned_of_with_the_number(
    scene, kind, word, generator, tmp_path
):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    stored = load_file(tmp_path / FILE)
    key = f"{kind}_qpos"
    stored[key] = stored[key] + 0.1 * (1.0 + stored[key].abs().max())
    save_file(stored, tmp_path / FILE)
    with pytest.warns(UserWarning, match=rf"{word} differs|the model by") as caught:
        load_checkpoint(tmp_path, scene)
    assert "e-0" in str(caught[0].message)


def test_weights_without_stored_steps_load(scene, generator, tmp_path):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    (tmp_path / FILE).unlink()
    assert self_check(load_checkpoint(tmp_path, scene), tmp_path) is None


@pytest.mark.parametrize("junk", ["empty", "other tensors", "other shapes"])
def test_stored_steps_that_are_none_are_refused(scene, junk, generator, tmp_path):
    model = random_model(scene, generator)
    save_checkpoint(model, tmp_path, make_card(model))
    path = tmp_path / FILE
    if junk == "empty":
        path.write_bytes(b"")
    elif junk == "other tensors":
        save_file({"x": torch.zeros(3)}, path)
    else:
        save_file({k: v[:, :1].clone() for k, v in load_file(path).items()}, path)
    with pytest.raises(ValueError, match="expected a few steps of"):
        load_checkpoint(tmp_path, scene)


def test_the_doctor_finds_all_well(capsys):
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    for name in (*shipped_models(), "mujoco", "C++ compiler"):
        assert name in shown
