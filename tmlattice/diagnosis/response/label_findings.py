"""Findings that are no effect of the catalogue: swapped correctors or BPMs, misplaced correctors.

>>> found = label_findings(ring, swapped, misplaced(fit.state))

They are localised and described. The correction of swaps is reported elsewhere.
"""

from collections.abc import Sequence
from dataclasses import replace

from tmlattice.diagnosis.findings import located
from tmlattice.diagnosis.places import between
from tmlattice.diagnosis.response.misplaced import Misplaced, moved_text
from tmlattice.diagnosis.response.swaps import Swaps
from tmlattice.diagnosis.result import Finding
from tmlattice.inference.alternatives import Detection
from tmlattice.lattice import Ring

NEAR = 0.25
"""Distance, m, below which two elements have one place."""


def label_findings(
    ring: Ring, swaps: Swaps, misplaced: Sequence[Misplaced] = (), other: str = "should"
) -> list[Finding]:
    """Return the findings.

    Args:
        ring: the design.
        swaps: pairs that were corrected.
        misplaced: misplaced correctors.
        other: the verb of the text: each of a pair responds as the other one "should" by the model,
            or "did" in the reference.
    """
    found = []
    for what, pairs in (("correctors", swaps.correctors), ("monitors", swaps.monitors)):
        for (a, b), gain in pairs.items():
            words = f"{what} {a} and {b} respond each as the other one {other}"
            check = "Check the cables of both, and the table of their names."
            found.append(_finding(ring, (a, b), Detection.among(gain, len(ring.elements)), words,
                                  check))  # fmt: skip
    for own in misplaced:
        words = f"corrector {own.name} responds like one {moved_text(own)}"
        check = (
            "Check its position in the lattice, its cable, and that its supply drives no other "
            "magnet."
        )
        found.append(_finding(ring, (own.name,), Detection.among(own.gain, len(ring.elements)),
                              words, check))  # fmt: skip
    return found


def _finding(
    ring: Ring, elements: tuple[str, ...], seen: Detection, words: str, to_check: str
) -> Finding:
    """The finding of one element at its place in the lattice; of two elements the range between
    them if they are near one another."""
    found = located(ring, ring[elements[0]], seen)
    found = replace(found, words=words, to_check=to_check, elements=elements)
    if len(elements) == 1:
        return found
    places = [ring[name].s for name in elements]
    if max(places) - min(places) > NEAR * ring.length:
        return replace(found, s=None)
    where, near = between(ring, places)
    return replace(found, s=None, where=where, near=near)
