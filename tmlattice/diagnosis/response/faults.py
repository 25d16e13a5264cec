"""One thing that is wrong alone among small errors of an orbit response, and how it is told."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.findings import finding_of
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Cause
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.common_factors import MIN_CHI2
from tmlattice.inference.judgement import Judgement
from tmlattice.lattice import Ring
from tmlattice.observe.orbit_response import Errors
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fault:
    """One that stands out.

    Attributes:
        cause: with its amount.
        sigma: standard error, with what its family scatters.
        statistic, p_value: by how much it stands out.
        rivals: other causes in its place, by falling evidence; the first is itself.
        evidence: of each.
    """

    cause: Cause
    sigma: float
    statistic: float
    p_value: float
    rivals: tuple[Cause, ...]
    evidence: Array

    def finding(self, ring: Ring, judgement: Judgement) -> Finding:
        """As it is told."""
        chance = np.exp(self.evidence - self.evidence.max())
        chance /= chance.sum()
        shown = self.rivals[: int(np.searchsorted(np.cumsum(chance), judgement.mass)) + 1]
        seen = Detection(self.statistic, MIN_CHI2, self.p_value)
        return finding_of(ring, self.rivals, chance, shown, self.sigma, seen, judgement.mass)


CLEARLY = 5.0
"""Errors of what a corrector kicks in the other plane, by which it has to be seen there."""


def as_turned(fault: Fault, errors: Errors, data: ResponseData) -> Fault:
    """A corrector that kicks more in the other plane than in its own, which has one number for
    each, is told as turned: what its own plane lacks is no calibration. One that is off kicks in
    neither."""
    if fault.cause.effect != "corrector_calibration":
        return fault
    ring, name = data.ring, fault.cause.element
    columns = [ring[own].name for own in data.measured.correctors]
    column = columns.index(ring[name or ""].name)
    if not errors.turned[column] or abs(errors.roll[column]) < CLEARLY * fault.sigma:
        return fault
    roll = Cause("corrector_roll", name, float(errors.angle[column]))
    others = [i for i, own in enumerate(fault.rivals)
              if i and (own.effect, own.element) != (roll.effect, roll.element)]  # fmt: skip
    return replace(
        fault,
        cause=roll,
        sigma=fault.sigma / float(errors.kick[column]),
        rivals=(roll, *(fault.rivals[i] for i in others)),
        evidence=fault.evidence[[0, *others]],
    )
