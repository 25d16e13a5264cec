"""Findings of a response that are no effect of the catalogue's: exchanged correctors or monitors,
and correctors that stand elsewhere than in the lattice.

>>> found = unnamed(ring, put_right, displaced(fit.state))

That exchanged ones are put right is told by whoever does it. They are located, and
say in words what they are.
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
"""Of the ring: two that stand nearer have one place."""


def label_findings(
    ring: Ring, swaps: Swaps, misplaced: Sequence[Misplaced] = (), other: str = "should"
) -> list[Finding]:
    """All of them.

    Args:
        ring: the design.
        exchanged: pairs that were put right.
        displaced: correctors that stand elsewhere.
        other: what the other one of a pair does as each of them: it "should", by the model, or it
            "did" in a measurement before.
    """
    found = []
    for what, pairs in (("correctors", swaps.correctors), ("monitors", swaps.monitors)):
        for (a, b), gain in pairs.items():
            words = f"{what} {a} and {b} answer each as the other one {other}"
            check = "Follow the cables of both, and look at the table of their names."
            found.append(_finding(ring, (a, b), Detection.among(gain, len(ring.elements)), words,
                                  check))  # fmt: skip
    for own in misplaced:
        words = f"corrector {own.name} answers as if it stood {moved_text(own)}"
        check = (
            "Check its place in the lattice, which magnet the name is, and that no other one is "
            "driven with it."
        )
        found.append(_finding(ring, (own.name,), Detection.among(own.gain, len(ring.elements)),
                              words, check))  # fmt: skip
    return found


def _finding(
    ring: Ring, elements: tuple[str, ...], seen: Detection, words: str, to_check: str
) -> Finding:
    """Of one element, at its place in the lattice; of two, from one to the other where they stand
    near, else at the first."""
    found = located(ring, ring[elements[0]], seen)
    found = replace(found, words=words, to_check=to_check, elements=elements)
    if len(elements) == 1:
        return found
    places = [ring[name].s for name in elements]
    if max(places) - min(places) > NEAR * ring.length:
        return replace(found, s=None)
    where, near = between(ring, places)
    return replace(found, s=None, where=where, near=near)
