"""What a diagnosis says: findings with what else each could be, the gap, and the file format."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tmlattice.beam.model import Model
from tmlattice.diagnosis.next_measurement import NextMeasurement
from tmlattice.effects import Cause
from tmlattice.errors import UnstableRingError
from tmlattice.inference.judge import Gap, Misfit
from tmlattice.inference.rivals import Detection
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Ring
from tmlattice.maps.magnets import ring_matrix
from tmlattice.observe.data import Data
from tmlattice.optics import matrix_tunes

VERDICTS = ("named", "equivalent", "located", "distributed", "nothing")
"""From the most certain to the least."""


@dataclass(frozen=True)
class Member:
    """One explanation in a credible set."""

    effect: str
    element: str | None
    s: float | None
    probability: float
    amount: float

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return dict(vars(self))


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        effect, element: None where something is there and the catalogue does not explain it, and
            (the element) for the beam and for effects of all elements of a kind.
        s: middle of the element, m from the start of the sequence.
        amount, amount_sigma: in the effect's unit.
        unit: of the amount.
        probability: of this effect at this element, given that one of the catalogue is there.
        detection: how clearly it was seen.
        where: from the last monitor before to the first one behind all members of the set, m.
        near: the names of those monitors.
        credible_set: explanations that the data do not exclude, the first is this finding.
        mass: the sum of their probabilities.
    """

    effect: str | None
    element: str | None
    s: float | None
    amount: float | None
    amount_sigma: float | None
    unit: str | None
    probability: float
    detection: Detection
    where: tuple[float, float] | None
    near: tuple[str, ...]
    credible_set: tuple[Member, ...]
    mass: float

    @property
    def verdict(self) -> str:
        """Of this finding alone."""
        if self.effect is None:
            return "located"
        return "named" if len(self.credible_set) == 1 else "equivalent"

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        found = self.detection
        where = None
        if self.where is not None:
            where = {"s_from": self.where[0], "s_to": self.where[1]}
        return {
            "effect": self.effect,
            "element": self.element,
            "s": self.s,
            "amount": self.amount,
            "amount_sigma": self.amount_sigma,
            "unit": self.unit,
            "probability": self.probability,
            "detection": {
                "statistic": found.statistic,
                "threshold": found.threshold,
                "p_value": found.p_value,
            },
            "where": where,
            "near": list(self.near),
            "credible_set": [member.as_json() for member in self.credible_set],
            "mass": self.mass,
        }


@dataclass(frozen=True)
class Diagnosis:
    """What a measurement says of a ring. See `as_json` for the file format.

    Attributes:
        verdict: the least certain of the findings', see `VERDICTS`.
        findings: by falling statistic.
        fit_before, fit_after: misfit of the shots of the fit.
        heldout: of the held-out shots, before, each finding added, after; or None.
        heldout_shots: their ids.
        unexplained: p-value of what is left, and where it sits.
        tunes: fractions of Qx, Qy of the design and of the ring with the causes; None: unstable.
        next: the shot that would tell the likeliest rivals apart, or None.
        sensitivity: by effect, the amount that would be seen at half of its places.
        warnings: what a reader should know.
        left_out: single readings that the search left out: shot, turn, monitor, plane.
        noise: rms of a reading, m, (x, y).
        noise_estimated: whether it comes from the data.
        provenance: package, lattice, options, seed, seconds.
        ring: the design.
        repaired: the ring with the named causes in it.
        explanation, data, model: the search, for plots.
    """

    verdict: str
    findings: tuple[Finding, ...]
    fit_before: Misfit
    fit_after: Misfit
    heldout: Gap | None
    heldout_shots: tuple[int, ...]
    unexplained: dict[str, Any]
    tunes: dict[str, list[float] | None]
    next: NextMeasurement | None
    sensitivity: dict[str, float]
    warnings: tuple[str, ...]
    left_out: tuple[dict[str, Any], ...]
    noise: tuple[float, float]
    noise_estimated: bool
    provenance: dict[str, Any]
    ring: Ring = field(repr=False)
    repaired: Ring = field(repr=False)
    causes: tuple[Cause, ...]
    explanation: Explanation = field(repr=False)
    data: Data = field(repr=False)
    model: Model = field(repr=False)

    @property
    def gap(self) -> dict[str, Any]:
        """Before and after on the fit's shots and on the held-out ones."""

        def both(before: Misfit, after: Misfit) -> dict[str, Any]:
            return {"before": dict(vars(before)), "after": dict(vars(after))}

        gap = self.heldout
        heldout = None
        if gap is not None:
            heldout = {
                **both(gap.misfits[0], gap.misfits[-1]),
                "shots": list(self.heldout_shots),
                "monitors": "odd",
                "steps": [dict(vars(m)) for m in gap.misfits],
            }
        interval = None if gap is None or gap.interval is None else list(gap.interval)
        return {
            "noise": float(np.sqrt(np.mean(np.square(self.noise)))),
            "fit": both(self.fit_before, self.fit_after),
            "heldout": heldout,
            "closed": None if gap is None else gap.closed,  # null where nothing was put in
            "closed_interval": interval,
        }

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-diagnosis`, version 1 (see `schemas/`)."""
        from tmlattice import __version__

        return {
            "format": "tmlattice-diagnosis",
            "version": 1,
            "package": __version__,
            "verdict": self.verdict,
            "findings": [finding.as_json() for finding in self.findings],
            "gap": self.gap,
            "unexplained": self.unexplained,
            "tunes": self.tunes,
            "next_measurement": None if self.next is None else self.next.as_json(),
            "sensitivity": self.sensitivity,
            "warnings": list(self.warnings),
            "left_out": [dict(row) for row in self.left_out],
            "provenance": self.provenance,
        }


def ring_tunes(ring: Ring) -> list[float] | None:
    """Fractions of Qx, Qy about the axis; None where there are none."""
    try:
        return [float(q) for q in matrix_tunes(ring_matrix(ring))]
    except (UnstableRingError, np.linalg.LinAlgError):
        return None
