"""Tensors in safetensors files: written whole or not at all, checked when read."""

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from torchrl_nerd.files import write_atomically

LFS_POINTER = b"version https://git-lfs"


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, str] | None = None
) -> None:
    """Replace the file by these tensors, with words ``about`` them, or raise ValueError."""
    copies = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
    # save_file would leave a file of its own if it is killed
    content = save(copies, dict(about or {}))
    write_atomically(path, lambda aside: aside.write_bytes(content))


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a file by name, on the processor; a ValueError if it has none."""
    if not path.is_file():
        raise ValueError(f"expected tensors in {path}, found no file")
    with open(path, "rb") as file:
        if file.read(len(LFS_POINTER)) == LFS_POINTER:
            raise ValueError(
                f"{path} is a git-lfs pointer, not weights: run `git lfs pull`"
            )
    try:
        return load_file(path)
    except SafetensorError as error:
        said = f"{path} is truncated or no safetensors file: {error}"
        raise ValueError(said) from None


def expect_fit(
    found: Mapping[str, Tensor], expected: Mapping[str, Tensor], what: str, of: str
) -> None:
    """Raise ValueError for a tensor of another name, shape or kind, or not finite.

    For the sentence, ``what`` was read, ``"weights in FOLDER"``, and ``of`` is whom they
    must fit, ``"scene 'cartpole'"``.
    """
    shapes, own = ({k: tuple(v.shape) for k, v in x.items()} for x in (expected, found))
    for key in sorted(shapes.keys() | own.keys()):
        said = f"{what} do not fit {of}: expected {key!r} of"
        want, got = shapes.get(key), own.get(key)
        if want != got:
            raise ValueError(f"{said} shape {want}, got {got}")
        want, got = expected[key].dtype, found[key].dtype
        # loading may change the type from one kind of float to another alone
        if want != got and not (want.is_floating_point and got.is_floating_point):
            raise ValueError(f"{said} type {want}, got {got}")
        if not found[key].to(expected[key].dtype).isfinite().all():
            raise ValueError(f"expected finite {what}, got NaN or infinity in {key!r}")
