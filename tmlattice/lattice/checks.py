"""What a ring must be before work begins: one sentence each, with the mend."""

import math

from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import Ring

CLOSED = 1e-2
"""A ring's bends sum to a whole turn within this share of it."""


def need_monitors(ring: Ring) -> None:
    """Nothing can be read without monitors.

    Raises:
        LatticeError: the ring has none.
    """
    if not ring.monitors:
        names = dict.fromkeys(e.family for e in ring.elements if e.kind == "marker")
        mend = f", such as '{next(iter(names))}'" if names else ""
        raise LatticeError(
            f"'{ring.name}' has no monitor; say which of its elements are monitors with --monitors "
            f"'BPM*' (in Python: monitors='BPM*'): names of markers or drifts{mend}"
        )


def no_whole_turn(ring: Ring) -> str | None:
    """What to say of a ring whose bends do not sum to a turn; None where they do, or are none."""
    bends = [e for e in ring.elements if e.kind == "bend" and e.angle]
    total = sum(e.angle * math.cos(e.tilt) for e in bends)
    if not bends or abs(abs(total) / (2 * math.pi) - 1) < CLOSED:
        return None
    share = abs(total) / (2 * math.pi)
    said = f"'{ring.name}' bends by {math.degrees(abs(total)):.4g} degrees in all"
    cells = round(1 / share) if share else 0
    if cells > 1 and abs(cells * share - 1) < CLOSED:
        return f"{said}, 1/{cells} of a turn: it is taken for a ring of one such cell"
    return f"{said} and not by 360: it is taken for a ring all the same"
