"""A checkpoint that is damaged or foreign is refused in one clear sentence."""

import shutil
from pathlib import Path

import pytest
import torch
from dynamics_helpers import edit_card, random_model
from safetensors.torch import load_file, save_file

from torchrl_nerd import from_pretrained, load_scene
from torchrl_nerd.checkpoint import (
    CARD,
    WEIGHTS,
    load_checkpoint,
    make_card,
    save_checkpoint,
)
from torchrl_nerd.scenes import Scene
from torchrl_nerd.selfcheck import PREFIX

SCENE, OTHER = (load_scene(name) for name in ("cartpole", "double_pendulum"))


@pytest.fixture
def folder(tmp_path, generator) -> Path:
    """A sound checkpoint."""
    model = random_model(SCENE, generator)
    return save_checkpoint(model, tmp_path / "model", make_card(model))


def refusal(folder: Path, scene: Scene | None = None) -> str:
    with pytest.raises(ValueError) as caught:
        load_checkpoint(folder, scene)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    return str(caught.value)


def weights_in(folder: Path) -> dict[str, torch.Tensor]:
    """Without the steps that are stored with them."""
    tensors = load_file(folder / WEIGHTS)
    return {k: v for k, v in tensors.items() if not k.startswith(PREFIX)}


def edit_weights(folder: Path, change) -> None:
    tensors = load_file(folder / WEIGHTS)
    change(tensors)
    save_file(tensors, folder / WEIGHTS)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_truncated_weights(folder, share):
    content = (folder / WEIGHTS).read_bytes()
    (folder / WEIGHTS).write_bytes(content[: int(share * len(content))])
    assert WEIGHTS in refusal(folder)


def test_git_lfs_pointers(folder):
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
    (folder / WEIGHTS).write_text(pointer)
    assert "git lfs pull" in refusal(folder)
    (folder / CARD).write_text(pointer)
    assert CARD in refusal(folder)


def test_weights_of_a_wrong_shape_or_name(folder):
    weights = weights_in(folder)
    key = sorted(k for k, v in weights.items() if v.ndim == 2)[0]
    shape = tuple(weights[key].shape)
    edit_weights(folder, lambda t: t.update({key: torch.zeros(3, 1)}))
    said = refusal(folder)
    assert key in said and str(shape) in said and "(3, 1)" in said
    edit_weights(folder, lambda t: t.pop(key))
    assert key in refusal(folder)
    dtype = random_model(SCENE, torch.Generator()).state_dict()[key].dtype
    edit_weights(folder, lambda t: t.update({key: torch.zeros(shape, dtype=dtype)}))
    load_checkpoint(folder)
    edit_weights(folder, lambda t: t.update(aaa=torch.zeros(1)))
    assert "aaa" in refusal(folder)


@pytest.mark.parametrize("junk", [float("nan"), float("inf")])
def test_weights_that_are_not_finite(folder, junk, generator):
    keys = sorted(weights_in(folder))
    key = keys[int(torch.randint(len(keys), (), generator=generator))]
    edit_weights(folder, lambda t: t[key].view(-1)[-1:].fill_(junk))
    assert "finite" in refusal(folder)


def test_weights_of_another_robot(folder):
    said = refusal(folder, OTHER)
    assert SCENE.name in said and OTHER.name in said
    edit_card(folder, scene=OTHER.name)
    with pytest.warns(UserWarning, match="other physics"):
        said = refusal(folder)
    assert OTHER.name in said and "shape" in said


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe\x00", b"[1, 2]", b'"card"', b"null", b"[" * 10**5]
)
def test_a_card_that_is_no_json_object(folder, content):
    (folder / CARD).write_bytes(content)
    assert "JSON" in refusal(folder)


@pytest.mark.parametrize(
    "changes",
    [
        {"network": None},
        {"network": 7},
        {"network": "transformer-2x64"},
        {"network": ["transformer-2x64"]},
        {"network": {}},
        {"network": {"kind": "rnn"}},
        {"network": {"kind": ["mlp"]}},
        {"network": {"kind": "mlp", "breadth": 3}},
        {"network": {"kind": "mlp", "width": "wide"}},
        {"network": {"kind": "mlp", "width": -1}},
        {"network": {"kind": "mlp", "width": 1.5}},
        {"network": {"kind": "transformer", "heads": 0}},
        {"network": {"kind": "transformer", "heads": 7}},
        {"network": {"kind": "transformer", "layers": None}},
        {"network": {"kind": "transformer", "width": 10**12}},
        {"format": 1},
        {"kind": None},
        {"kind": "oracle"},
        {"kind": "analytic"},
        {"kind": "hybrid", "step": {"kind": "free-body", "num_substeps": -1}},
        {"kind": "hybrid", "step": {"kind": "penalty-contact", "precision": "half"}},
        {"features": None},
        {"features": {"predicted_force": "yes"}},
        {"scene": None},
        {"scene": ["cartpole"]},
        {"scene": "unicycle"},
    ],
    ids=str,
)
def test_a_card_that_describes_no_model(folder, changes):
    edit_card(folder, **changes)
    assert next(iter(changes)) in refusal(folder)


def test_missing_files_and_folders(folder, tmp_path):
    for missing in (WEIGHTS, CARD):
        half = shutil.copytree(folder, tmp_path / f"without {missing}")
        (half / missing).unlink()
        said = refusal(half)
        assert WEIGHTS in said and CARD in said
    refusal(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="found no folder .*nowhere"):
        from_pretrained(tmp_path / "nowhere")
