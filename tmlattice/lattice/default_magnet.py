"""The magnet that `tune-fit` weakens when none is named: chosen by a rule, not by its result."""

from itertools import pairwise
from statistics import median

from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import Element, Ring


def middle_of_first_arc(ring: Ring) -> Element:
    """The defocusing quadrupole nearest to the middle of the first arc.

    An arc is a run of bends with no gap wider than eight times their median distance; short
    runs (fewer than a quarter of the bends of the longest) are no arcs. A ring with no such
    quadrupole in its first arc gives the nearest quadrupole with a strength.

    Raises:
        LatticeError: the ring has no quadrupole with a strength.
    """
    powered = [e for e in ring.magnets if e.kind == "quadrupole" and e.k1 != 0]
    if not powered:
        raise LatticeError(f"'{ring.name}' has no powered quadrupole; name a magnet")
    bends = [e.s for e in ring.magnets if e.kind == "bend"]
    middle = ring.length / 2
    if len(bends) > 2:
        gap = 8 * median(b - a for a, b in pairwise(bends))
        runs = [[bends[0]]]
        for before, here in pairwise(bends):
            if here - before > gap:
                runs.append([])
            runs[-1].append(here)
        longest = max(map(len, runs))
        arc = next(run for run in runs if 4 * len(run) >= longest)
        middle = (arc[0] + arc[-1]) / 2
    defocusing = [e for e in powered if e.k1 < 0] or powered
    return min(defocusing, key=lambda e: abs(e.s - middle))
