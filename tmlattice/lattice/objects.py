"""Rings of objects in memory: each object becomes what the reader of its package's files takes.

An object is recognised by the names of its class and of its package, so that nothing is imported
that is not there already.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tmlattice.errors import LatticeError, plain
from tmlattice.lattice.ring import Ring

Read = Callable[[str | None, float | None], Ring]
"""From `sequence` and `energy` of `load_ring` to the ring."""


def reader_of(lattice: Any) -> tuple[str, Read]:
    """The name of an object of another package, and what reads it.

    Raises:
        LatticeError: an object of no class that is known.
    """
    name = plain(str(getattr(lattice, "name", None) or type(lattice).__name__), 60)
    readers: dict[str, Callable[..., Ring]] = {
        "at.Lattice": _of_at,
        "xtrack.Line": _of_xtrack,
        "xtrack.Environment": _of_xtrack,
        "ocelot.MagneticLattice": _of_ocelot,
        "cpymad.Madx": _of_madx,
    }
    for known in _classes(lattice):
        if known in readers:
            return name, partial(readers[known], lattice, name)
    first = lattice
    while isinstance(first, list | tuple) and first:
        first = first[0]
    if first is not lattice and "ocelot.OpticElement" in _classes(first):
        return name, partial(_of_ocelot, lattice, name)
    if "at.Element" in _classes(first):
        raise LatticeError(
            "elements of AT alone have no energy; give at.Lattice(elements, energy=...), in eV"
        )
    if isinstance(first, list | tuple):
        raise LatticeError(f"the {type(lattice).__name__} of elements is empty; give a ring's")
    what = plain(repr(first), 40)
    raise LatticeError(
        f"{what} ({type(first).__name__}) is no lattice; a lattice is a built-in name, a path, an "
        "open file, a Ring, an at.Lattice, an xtrack.Line or Environment, an OCELOT "
        "MagneticLattice or list of elements, or a cpymad Madx"
    )


def _classes(thing: Any) -> list[str]:
    """Package and name of an object's class and of those that it is made of."""
    return [f"{c.__module__.partition('.')[0]}.{c.__name__}" for c in type(thing).__mro__]


@contextmanager
def named_file(file: Any) -> Iterator[Path]:
    """A path to the content of an open file: its own, else that of a copy, gone at the end.

    Args:
        file: open for reading, with a `name` whose suffix states the format.

    Raises:
        LatticeError: no name, or no suffix.
    """
    path = Path(str(getattr(file, "name", "")))
    if not path.suffix:
        raise LatticeError(
            "an open file needs a name whose suffix states its format (ring.seq, ring.json); give "
            "the path, or set its .name"
        )
    if path.is_file():  # what it calls or imports is found next to it
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        content = file.read()
        copy.write_bytes(content if isinstance(content, bytes) else content.encode())
        yield copy


def _one_alone(lattice: Any, sequence: str | None) -> None:
    if sequence is not None:
        raise LatticeError(
            f"{type(lattice).__name__} is one ring; leave out sequence='{plain(sequence, 60)}'"
        )


def _of_at(lattice: Any, name: str, sequence: str | None, energy: float | None) -> Ring:
    from tmlattice.lattice.at_file import ring_from_at

    _one_alone(lattice, sequence)
    return ring_from_at(lattice, name, energy)


def _of_xtrack(lattice: Any, name: str, sequence: str | None, energy: float | None) -> Ring:
    from tmlattice.lattice.xsuite_file import ring_of_content

    if not hasattr(lattice, "lines"):
        _one_alone(lattice, sequence)
        if not len(lattice.element_names):
            raise LatticeError("the Line has no elements; give one with elements")
    elif not len(lattice.lines):
        raise LatticeError("the Environment has no line; give one with a line")
    return ring_of_content(Path(name), lattice.to_dict(), name, sequence, energy)


def _of_ocelot(lattice: Any, name: str, sequence: str | None, energy: float | None) -> Ring:
    from tmlattice.lattice.ocelot_file import ring_of_elements

    _one_alone(lattice, sequence)
    return ring_of_elements(lattice, Path(name), name, energy)


def _of_madx(madx: Any, name: str, sequence: str | None, energy: float | None) -> Ring:
    from tmlattice.lattice.madx_file import ring_of_madx

    return ring_of_madx(madx, sequence, energy)
