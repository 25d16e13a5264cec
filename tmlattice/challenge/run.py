"""The diagnosis of every case from its public part alone."""

import logging
import time
from functools import partial
from pathlib import Path
from typing import Any

from tmlattice.batch import run_batch
from tmlattice.challenge.case import (
    Case,
    case_names,
    check_contents,
    check_lattice,
    made_by,
    read_set,
    ring_of,
    trusted_case,
)
from tmlattice.diagnosis import diagnose
from tmlattice.diagnosis.twin import known_of

log = logging.getLogger(__name__)


def diagnose_case(case: Case) -> dict[str, Any]:
    """Return the diagnosis of one case as JSON, with its seconds; of several kinds also the
    findings of each alone. A learnt machine is diagnosed first, and its posterior is the prior."""
    ring = ring_of(case.lattice)
    begun = time.perf_counter()
    if case.kinds:
        together = diagnose(
            ring, case.measured, reference=case.before or None, **case.options
        ).as_json()
        seconds = time.perf_counter() - begun
        alone = {}
        for kind in case.kinds if len(case.kinds) > 1 else ():
            one = diagnose(ring, case.measured[kind], **case.options).as_json()
            alone[kind] = {key: one[key] for key in ("verdict", "findings", "priors")}
        return {**together, "seconds": seconds, **({"alone": alone} if alone else {})}
    if case.learnt is not None:
        before = diagnose(ring, case.learnt)
        found = diagnose(before.as_found, case.fit, known=known_of(before))
        return {**found.as_json(), "seconds": time.perf_counter() - begun}
    found = diagnose(ring, case.fit, heldout=case.heldout, reference=case.reference, **case.options)
    return {**found.as_json(), "seconds": time.perf_counter() - begun}


def run(
    folder: Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool = True,
    lattice: str | None = None,
) -> dict[str, dict[str, Any]]:
    """Diagnose every case of a challenge that has no result yet; its truth is not read.

    Args:
        lattice: the challenge's, if it is trusted Python code, see `check_lattice`.

    Returns:
        Results by case; a failed one has "error".
    """
    public = read_set(folder)
    described = check_lattice(folder / "challenge.json", public["lattice"], lattice)
    check_contents(folder, public)
    cases = {name: partial(trusted_case, folder, name, lattice) for name in case_names(folder)}
    marks = {name: made_by(folder, name, described) for name in cases}
    return run_batch(
        diagnose_case,
        cases,
        folder / "results",
        made_by=marks,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )
