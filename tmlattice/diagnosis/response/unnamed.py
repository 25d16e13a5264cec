"""Findings of a response that are no effect of the catalogue's, for they are of no single element:
exchanged correctors or monitors, and correctors that stand elsewhere than in the lattice.

>>> found = unnamed(fit.state, put_right, displaced(fit.state))

What they do to the fit (put right, or left out) is told by whoever does it; they are located, and
say in words what they are.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from tmlattice.diagnosis.places import between
from tmlattice.diagnosis.response.displaced import Displaced, moved_text
from tmlattice.diagnosis.response.exchanged import Pair, PutRight
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.result import Finding
from tmlattice.inference import chi2
from tmlattice.inference.levels import CLEAR
from tmlattice.inference.rivals import Detection
from tmlattice.lattice import Ring


def unnamed(state: State, exchanged: PutRight, displaced: Sequence[Displaced]) -> list[Finding]:
    """All of them.

    Args:
        state: of the measurement in which exchanged ones have what they should have.
        exchanged: pairs that were put right.
        displaced: correctors that stand elsewhere; of one that is there twice the first counts.
    """
    found = [_exchanged(state, pair, "correctors") for pair in exchanged.correctors]
    found += [_exchanged(state, pair, "monitors") for pair in exchanged.monitors]
    once = {own.column: own for own in reversed(displaced)}
    return found + [_displaced(state, own) for own in once.values()]


def _exchanged(state: State, pair: Pair, what: Literal["correctors", "monitors"]) -> Finding:
    data = state.data
    axis = int(what == "monitors")
    names = (data.measured.correctors, data.measured.monitors)[axis]
    at = [names.index(name) for name in pair]
    own, other, read = (
        np.take(of, places, axis)
        for of, places in ((data.orbits, at), (data.orbits, at[::-1]), (state.at.read, at))
    )
    noise = data.noise[at] if axis else data.noise
    gain = float(np.nansum(((other - read) ** 2 - (own - read) ** 2) / noise**2))
    a, b = pair
    return _finding(
        data.ring, [data.ring[name].s for name in pair], gain, len(names),
        f"{what} {a} and {b} answer each as the other one should",
        "Follow the cables of both, and look at the table of their names.",
    )  # fmt: skip


def _displaced(state: State, own: Displaced) -> Finding:
    data = state.data
    name = data.measured.correctors[own.column]
    s = data.ring[name].s
    return _finding(
        data.ring, [s, s + own.by], own.gain, len(data.measured.correctors),
        f"corrector {name} answers as if it stood {moved_text(own)}",
        "Check its place in the lattice, which magnet the name is, and that no other one is driven "
        "with it.",
    )  # fmt: skip


def _finding(
    ring: Ring, places: Sequence[float], gain: float, among: int, words: str, to_check: str
) -> Finding:
    where, near = between(ring, places)
    return Finding(
        effect=None,
        element=None,
        s=float(np.mean(places)),
        amount=None,
        amount_sigma=None,
        unit=None,
        probability=1.0,
        detection=Detection(gain, CLEAR, min(1.0, among * float(chi2.sf(gain, 1)))),
        where=where,
        near=near,
        credible_set=(),
        mass=0.0,
        words=words,
        to_check=to_check,
    )
