"""An OCELOT element from its class and its numbers.

Nothing of a lattice is known here: a file's reader and a ring's kept elements both ask for it.
"""

import copy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError

NOT_PHYSICS = ("id", "has_edge", "color", "width", "height", "params", "n")
"""Of what OCELOT keeps of an element."""


def element_class(cls: str) -> Any:
    """OCELOT's class of this name, or the package's own `CombinedMultipole`."""
    if cls == "CombinedMultipole":
        from tmlattice.lattice.combined import CombinedMultipole

        return CombinedMultipole
    from tmlattice.lattice.ocelot import elements

    return getattr(elements, cls)


@cache
def blank(cls: str) -> dict[str, Any]:
    """The numbers of a fresh element of an OCELOT class: what may be stored, and its defaults."""
    values = vars(element_class(cls)(eid="blank").element)
    return {k: v for k, v in values.items() if k not in NOT_PHYSICS}


def copied(source: Any) -> Any:
    """An element with numbers of its own, to be changed: a quarter of a deep copy's time.

    Arrays are shared with the first: set them, never their entries.
    """
    own = copy.copy(source)
    for name, value in (("element", copy.copy(source.element)), ("_tms", None),
                        ("_first_order_tms", None)):  # fmt: skip
        object.__setattr__(own, name, value)  # past what would clear the first one's maps
    return own


def source_of(cls: str, parameters: dict[str, Any]) -> Any:
    """The OCELOT element of a class and of those of its numbers that are not its defaults."""
    return made(Path("cache"), "", {"class": cls, "parameters": parameters})


def made(path: Path, key: str, definition: dict[str, Any]) -> Any:
    """The OCELOT element that a lattice file defines.

    Args:
        path, key: file and name, for the error.
        definition: class, family and parameters.

    Raises:
        LatticeError: a parameter that the class does not have, or of another shape.
    """
    known = blank(definition["class"])
    source = element_class(definition["class"])(eid=definition.get("family", key))
    for name, value in definition["parameters"].items():
        if name not in known:
            raise LatticeError(
                f"'{path}': '{key}' has the parameter '{name}', which OCELOT's "
                f"{definition['class']} lacks; known are {', '.join(known)}"
            )
        setattr(source, name, _value(path, key, name, value, known[name]))
    return source


def _value(path: Path, key: str, name: str, value: Any, default: Any) -> Any:
    if isinstance(value, list):
        return np.array(value, dtype=float)
    if not isinstance(value, dict):
        if isinstance(default, np.ndarray):
            raise LatticeError(f"'{path}': '{name}' of '{key}' should be a list or a table")
        return value
    array = np.zeros_like(default)
    flat = array[:, 0] if array.shape == (6, 1) else array  # a view: filled in place
    for index, entry in value.items():
        if len(index) != flat.ndim:
            raise LatticeError(
                f"'{path}': '{name}' of '{key}' has the entry '{index}'; "
                f"an entry has {flat.ndim} digits"
            )
        flat[tuple(int(digit) - 1 for digit in index)] = entry
    return array
