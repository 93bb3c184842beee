"""Ways to spoil a file: of any kind, of JSON, of safetensors, of npz.

Each takes a file, a random generator and the path of a marker that must never appear:
only running a pickle would make it.
"""

import io
import json
import pickle
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

Spoil = Callable[[Path, Generator, Path], None]

BOMB = 2**30 + 2**26  # bytes of zeros in a zip bomb
NAMES = (
    "../../x",
    "../../x.xml",
    "/tmp/../x",
    "dm_control/../../x",
    "a\0b",
    "x" * 5000,
)
NUMBERS = (0, -1, 1, 7, 2**14, 2**31, 2**63, 10**12, 10**400, 0.5, 1e308, float("nan"))
OTHERS: tuple[Any, ...] = (
    None,
    True,
    "",
    [],
    {},
    [[]],
    "torch.uint8",
    *NAMES,
    *NUMBERS,
)
DTYPES = ("F64", "F32", "F16", "BF16", "F8_E4M3", "I64", "U8", "BOOL", "C64", "X9")


class Marker:
    """An object whose unpickling makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        """Say to unpickle by opening the file for writing."""
        return open, (str(self.path), "w")


def _flip(path: Path, rng: Generator, _: Path) -> None:
    content = bytearray(path.read_bytes() or b"\0")
    for place in rng.integers(len(content), size=int(rng.integers(1, 9))):
        content[place] ^= 1 << rng.integers(8)
    path.write_bytes(content)


def _randomise(path: Path, rng: Generator, _: Path) -> None:
    content = bytearray(path.read_bytes() or b"\0")
    start = int(rng.integers(len(content)))
    size = min(int(rng.integers(1, 65)), len(content) - start)
    content[start : start + size] = rng.bytes(size)
    path.write_bytes(content)


def _truncate(path: Path, rng: Generator, _: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(rng.integers(len(content) + 1))])


def _extend(path: Path, rng: Generator, _: Path) -> None:
    path.write_bytes(path.read_bytes() + rng.bytes(int(rng.integers(1, 1000))))


def _extend_by_a_hole(path: Path, rng: Generator, _: Path) -> None:
    with open(path, "rb+") as file:
        file.truncate(path.stat().st_size + int(rng.integers(1, 2**26)))


def _empty(path: Path, rng: Generator, _: Path) -> None:
    path.write_bytes(b"")


def _remove(path: Path, rng: Generator, _: Path) -> None:
    path.unlink()


def _folder(path: Path, rng: Generator, _: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(path: Path, rng: Generator, _: Path) -> None:
    path.unlink()
    targets = (path.name, "nowhere", "/dev/zero", "/dev/null", ".", "../../../x")
    path.symlink_to(str(rng.choice(targets)))


def _swap(path: Path, rng: Generator, _: Path) -> None:
    others = sorted(p for p in path.parent.iterdir() if p.is_file())
    path.write_bytes(others[int(rng.integers(len(others)))].read_bytes())


def _pickle(path: Path, rng: Generator, marker: Path) -> None:
    path.write_bytes(pickle.dumps(Marker(marker), protocol=int(rng.integers(5))))


def _deepen(path: Path, rng: Generator, _: Path) -> None:
    deep = int(10 ** rng.uniform(2, 6))
    text = '{"a":' * deep + "1" + "}" * deep if rng.random() < 0.5 else "[" * deep
    path.write_text(text)


def _write_name(path: Path, rng: Generator, _: Path) -> None:
    path.write_text(str(rng.choice(NAMES)))


def _write_bomb(path: Path, rng: Generator, _: Path) -> None:
    path.write_bytes(bomb())


@cache
def bomb() -> bytes:
    """A small npz file with a huge array of zeros."""
    rows, file = BOMB // 24, io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("position.npy", "w", force_zip64=True) as entry:
            about = {"descr": "<f8", "fortran_order": False, "shape": (rows, 3)}
            np.lib.format.write_array_header_1_0(entry, about)
            for _ in range(24 * rows // 2**24):
                entry.write(bytes(2**24))
            entry.write(bytes(24 * rows % 2**24))
    return file.getvalue()


def _places(node: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Every container and key (index) in it, nested ones included."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in pairs:
        found.append((node, key))
        if isinstance(value, dict | list):
            _places(value, found)
    return found


def _edit_json(path: Path, rng: Generator, marker: Path) -> None:
    content = json.loads(path.read_text())
    for _ in range(int(rng.integers(1, 4))):
        places = _places(content, [])
        if not places:
            break
        node, key = places[int(rng.integers(len(places)))]
        choice = rng.random()
        if choice < 0.6:
            node[key] = OTHERS[int(rng.integers(len(OTHERS)))]
        elif choice < 0.8 and isinstance(node, dict):
            node[str(rng.choice(NAMES))] = node.pop(key)
        elif choice < 0.9:
            del node[key]
        elif isinstance(node, dict):
            node[str(rng.choice(list(node)))] = node[key]
    path.write_text(json.dumps(content))


def _header(content: bytes) -> tuple[dict[str, Any], bytes]:
    size = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + size]), content[8 + size :]


def _edit_header(path: Path, rng: Generator, _: Path) -> None:
    header, data = _header(path.read_bytes())
    key = str(rng.choice([k for k in header if k != "__metadata__"]))
    entry, choice = header[key], rng.random()
    if choice < 0.2:
        entry["dtype"] = str(rng.choice(DTYPES))
    elif choice < 0.5:
        entry["shape"] = [OTHERS[i] for i in rng.integers(len(OTHERS), size=2)]
    elif choice < 0.7:
        entry["data_offsets"] = [NUMBERS[i] for i in rng.integers(10, size=2)]
    elif choice < 0.8:
        entry["shape"] = entry["shape"][::-1] + [1]
    else:
        header[str(rng.choice(NAMES))] = header.pop(key)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def _lengthen_header(path: Path, rng: Generator, _: Path) -> None:
    length = int(rng.choice((0, 1, 2**27, 2**31, 2**62)))
    path.write_bytes(length.to_bytes(8, "little") + path.read_bytes()[8:])


def _spoil_weights(path: Path, rng: Generator, _: Path) -> None:
    header, data = _header(path.read_bytes())
    junk, array = rng.choice((np.nan, np.inf, -np.inf)), bytearray(data)
    entries = [v for k, v in header.items() if k != "__metadata__" and v["shape"] != []]
    entry = entries[int(rng.integers(len(entries)))]
    dtype = {"F32": np.float32, "F64": np.float64}.get(entry["dtype"], np.float32)
    start, end = entry["data_offsets"]
    values = np.frombuffer(data[start:end], dtype).copy()
    values[rng.integers(len(values), size=min(3, len(values)))] = junk
    array[start:end] = values.tobytes()
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + array)


def _edit_arrays(path: Path, rng: Generator, marker: Path) -> None:
    with np.load(path) as file:
        arrays: dict[str, Any] = dict(file)
    name = str(rng.choice(sorted(arrays)))
    value = arrays[name]
    with np.errstate(all="ignore"):
        corrupted: tuple[Callable[[], Any], ...] = (
            lambda: np.array(Marker(marker), dtype=object),
            lambda: value.astype(str),
            lambda: value.astype(complex),
            lambda: value.astype(np.uint64),
            lambda: value.astype(np.float16),
            lambda: value.astype(bool),
            lambda: value.astype(np.int8),
            lambda: value.reshape(-1),
            lambda: value[..., None],
            lambda: value[: int(rng.integers(len(value)))],
            lambda: value.reshape(-1)[0],
            lambda: value[:0],
            lambda: value * float(rng.choice((np.nan, 0.0, -1.0, 1e160, 1e-310))),
            lambda: np.zeros(2, [("a", "f8"), ("b", "O")])["a"],
            lambda: np.zeros(len(value), [("a", "f8")]),
            lambda: value.astype("M8[s]"),
        )
        arrays[name] = corrupted[int(rng.integers(len(corrupted)))]()
    if rng.random() < 0.2:
        arrays[str(rng.choice(NAMES[:4]))] = arrays.pop(name)
    np.savez(path, allow_pickle=True, **arrays)


def _edit_array_header(path: Path, rng: Generator, _: Path) -> None:
    """Shapes and types that a whole zip entry claims and does not have."""
    shape = tuple(int(10 ** rng.uniform(0, 15)) for _ in range(2))
    shapes = (shape, (-1, 3), "x", (2**63, 3), None, (3.0,), (10**400,))
    descriptions = ("<f8", "|O", "<U99999999", "|V0", "garbage", None, [("a", "<f8")])
    header = {
        "descr": descriptions[int(rng.integers(len(descriptions)))],
        "fortran_order": False,
        "shape": shapes[int(rng.integers(len(shapes)))],
    }
    text = repr(header).encode() + b"\n"
    deep = b"(" * 3000 + b"\n"
    text = deep if rng.random() < 0.1 else text
    array = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(240)
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("position", "quaternion_wxyz"):
            archive.writestr(f"{name}.npy", array)


ANY: tuple[Spoil, ...] = (
    *(_flip, _flip, _randomise, _truncate, _extend, _extend_by_a_hole, _empty),
    *(_remove, _folder, _link, _swap, _pickle, _deepen, _write_name, _write_bomb),
)
BY_SUFFIX: dict[str, tuple[Spoil, ...]] = {
    ".json": (_edit_json,),
    ".safetensors": (_edit_header, _lengthen_header, _spoil_weights),
    ".npz": (_edit_arrays, _edit_array_header),
}


def corrupt(folder: Path, rng: Generator, marker: Path) -> str:
    """Spoil one file of a folder; returns what was done to which."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    path = paths[int(rng.integers(len(paths)))]
    special = BY_SUFFIX.get(path.suffix, ())
    ways = special if special and rng.random() < 0.6 else ANY
    way = ways[int(rng.integers(len(ways)))]
    way(path, rng, marker)
    return f"{way.__name__[1:]} {path.relative_to(folder)}"
