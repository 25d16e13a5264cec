"""What of a measurement the lattice lacks: monitors and correctors by names that it has not.

>>> measured, said = in_the_lattice(ring, measured)

A control room reads more than its lattice file has: a monitor in a transfer line, a corrector that
was added later. What the model cannot predict is left out, and told. Where most names are unknown
the lattice is another ring's, or its names are others: then the first of them is an error. So is a
magnet where a monitor should be: that is a wrong name, as whoever uses the readings says.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from tmlattice.errors import UnknownNameError, first_of
from tmlattice.lattice import Ring
from tmlattice.measurement.monitors import Names

MOST = 0.5
"""Share of the names that may be unknown."""
SHOWN = 8
"""Names that a sentence tells at most."""
MEANT = "did you mean"
"""In what is said of a name that nearly is one."""

Measured = TypeVar("Measured")


def in_the_lattice(ring: Ring, measured: Measured) -> tuple[Measured, list[str]]:
    """The measurement without monitors and correctors that the lattice lacks, and what was left
    out, a sentence each.

    Args:
        ring: the design.
        measured: of any kind.

    Raises:
        UnknownNameError: more than half of the monitors, or of the correctors, are not there.
    """
    own: Any = measured
    messages: list[str] = []
    if not ring.monitors:
        return measured, messages  # nothing can be read there, which others say
    monitors = Names("monitor", (monitor.name for monitor in ring.monitors))
    for what, find in (("monitors", monitors.__getitem__), ("correctors", ring.index)):
        names = getattr(own, what, ())
        unknown = [name for name in names if not _has(ring, monitors, name)]
        if not unknown:
            continue
        mend = _hint(find, unknown[0])
        if len(unknown) > MOST * len(names):
            raise UnknownNameError(
                f"{len(unknown)} of {len(names)} {what} are not in the lattice: {mend}"
            )
        own = own.select(**{what: [name for name in names if name not in unknown]})
        typed = MEANT in mend and len(unknown) == 1
        messages.append(
            f"not in the lattice, and left out: {len(unknown)} of {len(names)} {what} "
            f"({first_of(unknown, SHOWN)})" + (f"; {mend.partition('; ')[2]}" if typed else "")
        )
    return own, messages


def _hint(find: Callable[[str], object], name: str) -> str:
    """What is said of a name that is not there."""
    try:
        find(name)
    except UnknownNameError as error:
        return str(error)
    return ""


def _has(ring: Ring, monitors: Names, name: str) -> bool:
    """Whether there is an element of this name."""
    if monitors.find(name) is not None:
        return True
    try:
        ring.index(name)
    except UnknownNameError:
        return False
    return True
