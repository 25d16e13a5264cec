"""BPMs and correctors of a measurement that are not in the lattice.

>>> measured, notes = in_the_lattice(ring, measured)

A control room reads more than its lattice file has, such as a BPM in a transfer line. Such channels
are left out, with a note. If most names are unknown, the names or the lattice are wrong: the first
one raises an error. So does a magnet in the place of a BPM.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from tmlattice.errors import UnknownNameError, first_of
from tmlattice.lattice import Ring
from tmlattice.measurement.monitors import Names

MOST = 0.5
"""Share of the names that may be unknown."""
SHOWN = 8
"""Names in a sentence at most."""
MEANT = "did you mean"
"""Phrase in the message about a misspelt name."""

Measured = TypeVar("Measured")


def in_the_lattice(ring: Ring, measured: Measured) -> tuple[Measured, list[str]]:
    """The measurement without BPMs and correctors that are not in the lattice, and a sentence for
    each kind left out.

    Args:
        ring: the design.
        measured: of any kind.

    Raises:
        UnknownNameError: more than half of the monitors, or of the correctors, are not there.
    """
    own: Any = measured
    messages: list[str] = []
    if not ring.monitors:
        return measured, messages  # nothing can be read there; reported elsewhere
    monitors = Names("monitor", (monitor.name for monitor in ring.monitors))
    for what, find in (("monitors", monitors.__getitem__), ("correctors", ring.index)):
        names = getattr(own, what, ())
        unknown = [name for name in names if not _has(ring, monitors, name)]
        if not unknown:
            continue
        fix = _hint(find, unknown[0])
        if len(unknown) > MOST * len(names):
            raise UnknownNameError(
                f"{len(unknown)} of {len(names)} {what} are not in the lattice: {fix}"
            )
        own = own.select(**{what: [name for name in names if name not in unknown]})
        typed = MEANT in fix and len(unknown) == 1
        messages.append(
            f"not in the lattice, and left out: {len(unknown)} of {len(names)} {what} "
            f"({first_of(unknown, SHOWN)})" + (f"; {fix.partition('; ')[2]}" if typed else "")
        )
    return own, messages


def _hint(find: Callable[[str], object], name: str) -> str:
    """The message about an unknown name."""
    try:
        find(name)
    except UnknownNameError as error:
        return str(error)
    return ""


def _has(ring: Ring, monitors: Names, name: str) -> bool:
    """Whether the ring has an element of this name."""
    if monitors.find(name) is not None:
        return True
    try:
        ring.index(name)
    except UnknownNameError:
        return False
    return True
