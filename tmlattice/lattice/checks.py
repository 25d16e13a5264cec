"""What a ring must be before work begins: one sentence each, with the correction."""

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tmlattice.errors import LatticeError, TmlatticeError, plain
from tmlattice.lattice.ring import Ring

CLOSED = 1e-2
"""A ring's bends sum to a whole turn within this share of it."""

LONGEST = 1e5
"""m; no element is longer, and no ring has as many elements as it has metres here."""
MOST_ELEMENTS = 300_000
HIGHEST_ENERGY = {True: 1e3, False: 1e6}
"""GeV, of a ring of electrons and of one of heavier particles."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever a reader stumbles over in a file is one sentence.

    Raises:
        LatticeError: instead of any other exception.
    """
    try:
        yield
    except TmlatticeError:
        raise
    except RecursionError as error:
        raise LatticeError(f"'{path}' is nested too deeply; write it out") from error
    except Exception as error:
        reason = plain(str(error), 200) or type(error).__name__
        raise LatticeError(
            f"'{path}' holds no ring that can be read ({reason}); correct it"
        ) from error


def check_ring(ring: Ring) -> None:
    """What no ring can be, however its file is written.

    Raises:
        LatticeError: a number that is not finite, a magnet of negative length, an energy in eV, a
            name that stands twice, more elements than any ring has.

    Warns:
        Of drifts of negative length.
    """
    if len(ring.elements) > MOST_ELEMENTS:
        raise LatticeError(
            f"'{ring.name}' has {len(ring.elements)} elements; at most {MOST_ELEMENTS} are taken"
        )
    highest = HIGHEST_ENERGY[ring.radiates]
    if not ring.energy <= highest:
        raise LatticeError(
            f"'{ring.name}' has the energy {ring.energy:g} GeV, above {highest:g}; energies are in "
            "GeV, not in eV or MeV: correct it, or give energy="
        )
    seen: set[str] = set()
    backwards = 0
    for e in ring.elements:
        numbers = (e.length, e.k1, e.k2, e.angle, e.tilt)
        if not all(map(math.isfinite, numbers)) or abs(e.length) > LONGEST:
            raise LatticeError(
                f"'{plain(e.name, 60)}' of '{ring.name}' has the length {e.length:g} m and the "
                f"strengths {e.k1:g}, {e.k2:g}, {e.angle:g}, tilt {e.tilt:g}; "
                "correct it in the file"
            )
        if e.length < -SHORTEST and (e.is_magnet or e.kind == "monitor"):
            raise LatticeError(
                f"the {e.kind} '{plain(e.name, 60)}' of '{ring.name}' has the negative length "
                f"{e.length:g} m; correct it in the file"
            )
        backwards += e.length < -SHORTEST
        if e.name.casefold() in seen:
            raise LatticeError(
                f"'{plain(e.name, 60)}' stands twice in '{ring.name}'; give one another name"
            )
        seen.add(e.name.casefold())
    if backwards:
        warnings.warn(
            f"'{ring.name}' has drifts of negative length ({backwards}): they are taken as such",
            stacklevel=3,
        )


SHORTEST = 1e-6
"""m; lengths this far below zero are the rounding of positions."""


def need_monitors(ring: Ring) -> None:
    """Nothing can be read without monitors.

    Raises:
        LatticeError: the ring has none.
    """
    if not ring.monitors:
        names = dict.fromkeys(e.family for e in ring.elements if e.kind == "marker")
        example = f", such as '{next(iter(names))}'" if names else ""
        raise LatticeError(
            f"'{ring.name}' has no BPM; state which of its elements are: [lattice] monitors = "
            f"['BPM*'] in tmlattice.toml (in Python: monitors='BPM*'), names of markers or "
            f"drifts{example}"
        )


def no_whole_turn(ring: Ring) -> str | None:
    """A sentence about a ring whose bends do not sum to whole turns; None where they do."""
    total = abs(sum(e.bending * math.cos(e.tilt) for e in ring.elements))
    share = total / (2 * math.pi)
    if round(share) and abs(share - round(share)) < CLOSED:
        return None
    if share < CLOSED:
        return f"the bends of '{ring.name}' sum to 0: it is taken for a ring all the same"
    bends = f"'{ring.name}' bends by {math.degrees(total):.4g} degrees in all"
    cells = round(1 / share)
    if cells > 1 and abs(cells * share - 1) < CLOSED:
        return f"{bends}, 1/{cells} of a turn: it is taken for a ring of one such cell"
    return f"{bends} and not by 360: it is taken for a ring all the same"
