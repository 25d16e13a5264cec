"""A single fault among distributed errors of an orbit response, and its report."""

from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.findings import finding_of
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Cause
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.common_factors import MIN_CHI2
from tmlattice.inference.judgement import SIGNIFICANT, Judgement
from tmlattice.lattice import Ring
from tmlattice.observe.orbit_response import Errors
from tmlattice.observe.response_data import ResponseData


@dataclass(frozen=True, eq=False)
class Fault:
    """A detected fault.

    Attributes:
        cause: with its amount.
        sigma: standard error, including the scatter of its family.
        statistic, p_value: of its detection.
        `rivals`: alternatives, by falling evidence; the first is the cause itself.
        evidence: log evidence of each.
    """

    cause: Cause
    sigma: float
    statistic: float
    p_value: float
    rivals: tuple[Cause, ...]
    evidence: Array

    def finding(self, ring: Ring, judgement: Judgement) -> Finding:
        """The fault as a hypothesis of the report."""
        chance = np.exp(self.evidence - self.evidence.max())
        chance /= chance.sum()
        seen = Detection(self.statistic, MIN_CHI2, self.p_value)
        return finding_of(ring, self.rivals, chance, self.sigma, seen, judgement.mass)


def as_turned(fault: Fault, errors: Errors, data: ResponseData) -> Fault:
    """Return the fault, reported as a roll if the corrector kicks significantly in the other plane:
    it has one number for each plane, and the kick that is missing in one is no calibration error. A
    corrector without any kick is not rolled."""
    if fault.cause.effect != "corrector_calibration":
        return fault
    ring, name = data.ring, fault.cause.element
    columns = [ring[own].name for own in data.measured.correctors]
    column = columns.index(ring[name or ""].name)
    if not errors.turned[column] or abs(errors.roll[column]) < SIGNIFICANT * fault.sigma:
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
