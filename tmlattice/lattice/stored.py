"""A ring as it is kept between two calls: its elements as data, without OCELOT.

A lattice in Python is code, and what is kept is read instead of run. So only such a file is kept
that depends on nothing but itself, as far as its text shows: `depends_on_nothing`.
"""

import ast
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice import cache
from tmlattice.errors import LatticeError
from tmlattice.lattice.json_file import described
from tmlattice.lattice.ring import KEPT, NO_ERRORS, Element, Ring, Source, number_names
from tmlattice.lattice.source import NOT_PHYSICS, source_of

_MODULES = {"ocelot", "numpy", "math", "cmath"}
_REACHES_OUT = {
    "open", "exec", "eval", "compile", "input", "globals", "vars", "getattr", "random", "load",
    "loadtxt", "genfromtxt", "fromfile", "memmap", "datetime64", "os", "sys", "io",
}  # fmt: skip


def depends_on_nothing(code: bytes) -> bool:
    """Whether a file of Python imports only OCELOT's elements and mathematics, reads no file and
    draws no random number: as far as the text shows without running it."""
    try:
        tree = ast.parse(code)
    except (SyntaxError, ValueError):
        return False
    for node in ast.walk(tree):
        names: Sequence[str] = ()
        if isinstance(node, ast.Import):
            if not {alias.name.split(".")[0] for alias in node.names} <= _MODULES:
                return False
        elif isinstance(node, ast.ImportFrom):
            if node.level or (node.module or "").split(".")[0] not in _MODULES:
                return False
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Name):
            names = [node.id]
        elif isinstance(node, ast.Attribute):
            names = [node.attr]
        if any(name in _REACHES_OUT or name.startswith("__") for name in names):
            return False
    return True


def key_of(path: Path, sequence: str | None, energy: float | None) -> str | None:
    """What a ring of this file is kept under; None where it may depend on more than the file."""
    if cache.folder() is None or path.suffix.lower() not in (".py", ".json", ".mat"):
        return None
    content = path.read_bytes()
    if path.suffix.lower() == ".py":
        neighbours = {neighbour.stem for neighbour in path.absolute().parent.iterdir()}
        if neighbours & _MODULES or not depends_on_nothing(content):
            return None
    return cache.key("ring with mass", path.suffix.lower(), content, sequence, energy)


def load(key: str, name: str) -> Ring | None:
    """The ring that is kept under this key, if one is."""
    ring = cache.load(key, partial(_read, name))
    if ring is not None:
        ring.memory[KEPT] = key
    return ring


def _read(name: str, content: bytes) -> Ring:
    kept = json.loads(content)
    _check(kept)
    definitions = [(*numbers, Source(text)) for *numbers, text in kept["definitions"]]
    elements = []
    start = 0.0
    families = kept["families"]
    for own, family, k in zip(number_names(families), families, kept["sequence"], strict=True):
        kind, length, k1, k2, angle, tilt, source = definitions[k]
        s = start + length / 2
        elements.append(Element(own, family, kind, s, length, k1, k2, angle, tilt, source))
        start += length
    return Ring(name, tuple(elements), kept["energy"], kept["changes"], kept["mass"],
                kept["supplies"], kept["model"])  # fmt: skip


def _check(kept: Any) -> None:
    """Refuse what `save` does not write: elements are made of it without another look."""
    number, maybe, text = int | float, int | float | None, str
    forms: list[tuple[Any, Any]]
    forms = [(kept["energy"], maybe), (kept["mass"], maybe), (kept["model"], text)]
    forms += [(family, text) for family in kept["families"]]
    for own in kept["definitions"]:
        forms += zip(own, (text, *[number] * 5, text), strict=True)
    for groups in (kept["changes"], kept["supplies"] or {}):
        forms += [(group, dict | list) for group in groups.values()]
    if not all(isinstance(value, form) for value, form in forms) or min(kept["sequence"]) < 0:
        raise TypeError("an element is described in another way")


def save(key: str, ring: Ring) -> None:
    """Keep a ring, where data can describe it completely."""
    texts: dict[int, str] = {}
    back: dict[str, Any] = {}
    index: dict[tuple[Any, ...], int] = {}
    sequence = []
    for e in ring.elements:
        source = e.source
        if id(source) not in texts:
            try:
                texts[id(source)] = _text(e, back)
            except LatticeError:
                return
        own = (e.kind, e.length, e.k1, e.k2, e.angle, e.tilt, texts[id(source)])
        sequence.append(index.setdefault(own, len(index)))
    families = [e.family for e in ring.elements]
    if number_names(families) != [e.name for e in ring.elements]:
        return
    kept = {
        "energy": ring.energy,
        "mass": ring.mass,
        "changes": {name: dict(change) for name, change in ring.changes.items()},
        "supplies": ring.known_supplies,
        "model": ring.model,
        "definitions": list(index),
        "families": families,
        "sequence": sequence,
    }
    cache.save(key, json.dumps(kept).encode())
    ring.memory[KEPT] = key


def _text(element: Element, back: dict[str, Any]) -> str:
    """An element's source as data, from which the same comes back: `back` has what did."""
    if element.errors != NO_ERRORS or element.length < -1e-6:  # the latter is warned of
        raise LatticeError("not kept")
    content = described(element)
    text = json.dumps([content["class"], content["parameters"]], sort_keys=True)
    if text not in back:
        back[text] = vars(source_of(*json.loads(text)).element)
    here, made = vars(element.source.element), back[text]
    same = here.keys() == made.keys() and all(
        _same(here[k], made[k]) for k in here if k not in NOT_PHYSICS
    )
    if not same or here.get("params"):
        raise LatticeError("not kept")
    return text


def _same(a: Any, b: Any) -> bool:
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a is b or bool(a == b)
