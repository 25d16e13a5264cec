"""Changes of BPMs and correctors on the second of two days.

All of them drift slightly; an outlier is a finding.
"""

import numpy as np

from tmlattice.diagnosis.families.family import StatedCause
from tmlattice.diagnosis.families.steps import CHANGES
from tmlattice.diagnosis.findings import finding_of
from tmlattice.diagnosis.response.fitted_causes import with_support
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.stated import unwidened
from tmlattice.diagnosis.result import Finding
from tmlattice.diagnosis.support import Support
from tmlattice.effects import Cause
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.judgement import SIGNIFICANT, Judgement
from tmlattice.inference.normal import solve

DRIFT = 0.03
"""Least change of a BPM or corrector that is a finding."""


def drifts(state: State) -> list[tuple[StatedCause, Support]]:
    """Return the changes of BPMs and correctors since the reference, with errors and support."""
    found: list[tuple[StatedCause, Support]] = []
    for block in (0, 1):
        own = {f.variable: f for f in state.of_block(block) if f.per != "ring"}
        if not own:
            continue
        there = linear(state, block)
        posterior = solve(there.normal, there.groups, there.start, rounds=0)
        found += with_support(state, own.values(), there, unwidened(posterior))
    return found


def outstanding(state: State, judgement: Judgement) -> list[Finding]:
    """Return the findings: BPMs and correctors whose change is an outlier of the usual drift."""
    changes = [row for row, _ in drifts(state)]
    found = []
    for effect in dict.fromkeys(cause.effect for cause, _ in changes):
        rows = [row for row in changes if row[0].effect == effect]
        usual = float(chi2.typical([cause.amount for cause, _ in rows]))
        for cause, sigma in rows:
            size = abs(cause.amount)
            if size > max(DRIFT, SIGNIFICANT * usual) and size > SIGNIFICANT * sigma:
                square = (size / max(sigma, 1e-12)) ** 2
                seen = Detection.among(square, len(rows))
                found.append(
                    finding_of(state.data.ring, [cause], np.ones(1), sigma, seen,
                               judgement.mass)
                )  # fmt: skip
    return found


def is_drift(cause: Cause) -> bool:
    """Return whether a change of a BPM or a corrector is within the usual drift from day to day."""
    of_each = {name for trial in CHANGES for family in trial.families if family.per != "ring"
               for name in family.effects}  # fmt: skip
    return cause.effect in of_each and abs(cause.amount) <= DRIFT
