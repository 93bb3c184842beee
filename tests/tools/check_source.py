"""Check the package's source without importing it; part of ``make check``.

| check | what it finds |
|---|---|
| imports | a part that imports one built on it, or cycles of files |
| docstrings | a public function that raises without saying so |
"""

import ast
import re
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "torchrl_nerd"
LEAVES = {"__version__", "compat", "compiled", "files"}
LEAVES |= {"locks", "seeds", "settings"}
LEVELS = (
    {"keys", "configs", "geometry", "tensor_files"},
    {"scenes"},
    {"tasks"},
    {"robots"},
    {"transforms", "analytic"},
    {"modules"},
    {"dynamics", "selfcheck", "card", "checkpoint"},
    {"envs"},
    {"data"},
    {"evaluation"},
    {"training"},
    {"cli", "gymnasium"},
)
"""Parts of the package; each imports those of its own level and of levels before."""
LEVEL = {part: level for level, parts in enumerate(LEVELS) for part in parts}
OUTSIDE = {"tests", "examples", "benchmarks", "experiments", "helpers", "conftest"}
SAYS_SO = re.compile(r"Raises:|[Rr]efuse|[Ee]rror|raises")


def part_of(name: str) -> str:
    """First part of a dotted name within the package."""
    return name.partition(".")[0]


def imported(tree: ast.Module) -> Iterator[str]:
    """Dotted names that a file imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def check_imports(package: Path) -> Iterator[str]:
    """Sentences about imports against the order of `LEVELS`."""
    paths = {
        ".".join(path.relative_to(package).with_suffix("").parts): path
        for path in sorted(package.rglob("*.py"))
    }
    parts = {part_of(name) for name in paths}
    of_parts: dict[str, set[str]] = {}
    of_files: dict[str, set[str]] = {}
    for name, path in paths.items():
        if name in ("__init__", "__main__"):
            continue
        part = part_of(name)
        every = set(imported(ast.parse(path.read_text())))
        for other in sorted({part_of(other) for other in every} & OUTSIDE):
            yield f"{path}: imports {other}, which is outside the package"
        own = f"{package.name}."
        found = {other.removeprefix(own) for other in every if other.startswith(own)}
        modules = {other.rpartition(".")[0] for other in found} & paths.keys()
        of_files[name] = modules - {name}
        others = {part_of(other) for other in found} & parts - {part}
        if part not in LEVEL and part not in LEAVES:
            yield f"{path}: '{part}' has no place in the order of imports, see LEVELS"
            continue
        level = -1 if part in LEAVES else LEVEL[part]
        for other in sorted(others - LEAVES):
            of_parts.setdefault(part, set()).add(other)
            if LEVEL.get(other, level) > level:
                yield f"{path}: {part} imports {other}, which is built on it"
    for graph in (of_parts, of_files):
        try:
            list(TopologicalSorter(graph).static_order())
        except CycleError as error:
            yield f"imports in a circle: {' -> '.join(error.args[1])}"


def check_docstrings(package: Path) -> Iterator[str]:
    """Sentences about public functions that raise and do not say so."""
    for path in sorted(package.rglob("*.py")):
        yield from _silent(path, ast.parse(path.read_text()).body, "")


def _silent(path: Path, body: list[ast.stmt], about: str) -> Iterator[str]:
    """Of the functions and classes in ``body``; ``about``: docstring of their class."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from _silent(path, node.body, ast.get_docstring(node) or "")
        elif isinstance(node, ast.FunctionDef):
            is_constructor = node.name == "__init__"
            if node.name.startswith("_") and not is_constructor:
                continue
            said = about if is_constructor else ast.get_docstring(node) or ""
            raises = any(
                isinstance(part, ast.Raise) and "NotImplemented" not in ast.dump(part)
                for part in ast.walk(node)
            )
            if raises and not SAYS_SO.search(said):
                yield f"{path}:{node.lineno}: {node.name} raises, and no docstring says so"


def check_source(package: Path) -> list[str]:
    """All sentences about a package."""
    return [*check_imports(package), *check_docstrings(package)]


if __name__ == "__main__":
    found = check_source(PACKAGE)
    print("\n".join(found) or "source: imports and docstrings are in order")
    sys.exit(bool(found))
