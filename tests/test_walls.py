"""Imports run one way: the order of CONTRIBUTING.md, and modules that everybody may use."""

import ast
import functools
import graphlib
from pathlib import Path

import pytest
from command import printed

PACKAGE = Path(__file__).parent.parent / "tmlattice"
ORDER = (
    "lattice", "maps", "effects", "beam", "optics", "network", "harmonics", "measurement",
    "inference", "observe", "diagnosis", "correction", "importers", "machine_file", "fitting",
    "machine",
    "challenge", "systems", "plots", "report", "cli",
)  # fmt: skip
BESIDE = {
    "arrays", "errors", "files", "input_files", "temporaries", "cache", "compiled", "by_name",
    "late", "speaks", "workers", "batch", "schemas", "version",
}  # fmt: skip
"""Everybody may use them."""

FILES = sorted(
    path for path in PACKAGE.rglob("*.py") if "lattices" not in path.relative_to(PACKAGE).parts
)


def room(parts):
    """The place in ORDER of tmlattice.<room>...; None for what is beside or above."""
    return ORDER.index(parts[0]) if parts and parts[0] in ORDER else None


@functools.cache
def imported(path):
    """Modules of the package that a file imports, as parts after `tmlattice`; (parts, line)."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            first, *rest = name.split(".")
            if first == "tmlattice":
                found.append((tuple(rest), node.lineno))
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_file_imports_upward(path):
    own = room([path.relative_to(PACKAGE).parts[0].removesuffix(".py")])
    if own is None:
        return
    upward = [
        f"line {line}: tmlattice.{'.'.join(parts)}"
        for parts, line in imported(path)
        if (there := room(parts)) is not None and there > own
    ]
    assert not upward


def test_no_circle_of_files():
    """Modules that import one another, at the top of a file or inside a function."""
    names = {}
    for path in FILES:
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        names[parts[:-1] if parts[-1] == "__init__" else parts] = path
    graph = {}
    for parts, path in names.items():
        found = set()
        for target, _ in imported(path):
            while target and target not in names:
                target = target[:-1]  # noqa: PLW2901
            if target and target != parts:
                found.add(target)
        graph[parts] = found
    graphlib.TopologicalSorter(graph).prepare()  # its error names the circle


def test_every_room_is_in_the_order():
    rooms = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in FILES}
    assert rooms - set(ORDER) - BESIDE == {"__init__", "__main__"}


def test_the_diagnosis_needs_neither_torch_nor_ocelot():
    code = (
        "import sys, tmlattice.diagnosis, tmlattice.report.plain\n"
        "import tmlattice.diagnosis.response.procedure\n"
        "print(*sorted({'torch', 'ocelot', 'at', 'matplotlib'} & set(sys.modules)))"
    )
    assert not printed("-c", code, cwd=".").strip()
