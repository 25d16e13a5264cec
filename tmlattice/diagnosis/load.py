"""A diagnosis of its file: `Diagnosis.load("result")`.

The file holds findings, errors, steps and every sentence of the report. It does not hold the
readings, the scan and the covariance: functions that need them raise an error.
"""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from tmlattice.diagnosis.assessment import Block
from tmlattice.diagnosis.recommended_actions import element_kind
from tmlattice.diagnosis.records import decoded, stored_fields
from tmlattice.diagnosis.response.common_factors import CommonFactors
from tmlattice.diagnosis.response.inconsistencies import Inconsistency
from tmlattice.diagnosis.response.missing_effects import Weighed
from tmlattice.diagnosis.response.validation import Step
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.diagnosis.support import Support
from tmlattice.diagnosis.suspects import Suspect
from tmlattice.effects import Cause, apply, changes_beam
from tmlattice.errors import MeasurementError, TmlatticeError
from tmlattice.inference.validation import Gap, Misfit
from tmlattice.input_files import check_no_code
from tmlattice.lattice import Ring, load_ring
from tmlattice.measurement.documents import read_document

FORMAT, VERSION = "tmlattice-diagnosis", 2
DOCUMENT, LATTICE = "diagnosis.json", "diagnosis.lattice.json"
"""Of a folder of `save`: the result, and the lattice that it is about."""
ESTIMATED_FILE = "estimated.json"
"""Of a folder of `diagnose --out`: the estimated ring, with its files of `--lattice-out`."""

RECORDS = {own.__name__: own for own in (CommonFactors, Inconsistency, Step, Suspect, Weighed)}
"""Records of a result that its own module does not import."""


def load(cls: type, path: str | PathLike[str], ring: Ring | None = None) -> Diagnosis:
    """Return the diagnosis of a folder of `save`, or of a diagnosis.json.

    Report and tables are those of the diagnosis that was saved. The file does not hold readings,
    scan and covariance: figures of them and a correction need the diagnosis itself.

    Args:
        path: the folder, or the JSON file.
        ring: the lattice; None: of the file diagnosis.lattice.json next to it, else the one that
            the file names.

    Raises:
        MeasurementError: no diagnosis, a file of an earlier version with missing parts, or a
            lattice that does not have its elements.
        LatticeError: the lattice cannot be read.
    """
    place = Path(path)
    file = place / DOCUMENT if place.is_dir() else place
    if not file.exists():
        raise MeasurementError(f"no '{file}'; name a folder that `tmlattice diagnose --out` wrote")
    document = read_document(file, "diagnosis", FORMAT, VERSION)
    ring = _ring(file, document) if ring is None else ring
    places = {name for e in ring.elements for name in (e.name, e.family)}
    for row in document["errors"]:
        if row["element"] is not None and row["element"] not in places:
            raise MeasurementError(f"'{file}': '{ring.name}' has no element '{row['element']}'")
    try:
        return _diagnosis(cls, document, ring)
    except KeyError as error:
        raise MeasurementError(
            f"'{file}' of tmlattice {document['package']} does not hold {error}; diagnose again"
        ) from error


def _ring(file: Path, document: Mapping[str, Any]) -> Ring:
    beside, named = file.with_name(LATTICE), str(document["provenance"].get("lattice"))
    if not beside.is_file():
        instead = f"put {LATTICE} next to it, or give the lattice (in Python: ring=)"
        check_no_code(file, named, MeasurementError, instead)
    try:
        ring = load_ring(beside if beside.is_file() else named)
    except TmlatticeError as error:
        raise MeasurementError(
            f"'{file}' needs its lattice '{named}': put {LATTICE} next to it, or give the lattice "
            f"(in Python: ring=) ({error})"
        ) from error
    return replace(ring, name=named)


def _diagnosis(cls: type, d: Mapping[str, Any], ring: Ring) -> Diagnosis:
    gap, held = d["gap"], d["gap"]["heldout"] or {}
    noise = gap["readings_noise"]
    causes = tuple(Cause(row["effect"], row["element"], row["amount"]) for row in d["errors"])
    hints = get_type_hints(cls, localns=RECORDS)
    findings = []
    for row in d["findings"]:
        first = row["recommended_action"]
        stated = [] if first is None else [first, *row["alternative_actions"]]
        actions = [{**own, "kind": element_kind(ring, own["element"])} for own in stated]
        findings.append({**row, "recommended_actions": actions})
    heldout = None if not held else Gap(
        decoded(tuple[Misfit, ...], held["steps"]),
        np.zeros((0, 0, 0)),
        gap["explained"],
        decoded(tuple[float, float] | None, gap["explained_interval"]),
        held["since"],
        held["readings"],
        held["lost"],
    )  # fmt: skip
    made: Diagnosis = cls(
        findings=decoded(tuple[Finding, ...], findings),
        fit_before=decoded(Misfit, gap["fit"]["before"]),
        fit_after=decoded(Misfit, gap["fit"]["after"]),
        heldout=heldout,
        heldout_shots=tuple(held.get("shots", ())),
        noise=(decoded(float, noise["x"]), decoded(float, noise["y"])),
        noise_estimated=noise["estimated"],
        ring=ring,
        corrected=apply(ring, [cause for cause in causes if changes_beam(cause.effect)]),
        causes=causes,
        errors=tuple(decoded(float, row["amount_sigma"]) for row in d["errors"]),
        view=None,
        measured=tuple(d["assessment"]["measured"]),
        correctors_held_out=held.get("correctors"),
        compared=decoded(tuple[Block, ...], d["assessment"]["blocks"]),
        supports=decoded(tuple[Support, ...], d["errors"]),
        **{
            name: decoded(hints[name], value)
            for name, value in stored_fields(cls, d).items() if name != "findings"
        },
    )  # fmt: skip
    return made
