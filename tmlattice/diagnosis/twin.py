"""The knowledge of a machine after a diagnosis, for the next one.

The estimated ring is a lattice file. A second file has calibrations, and the distributed errors
with their posterior covariance. A diagnosis of the lattice file reads both.
"""

import binascii
import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.diagnosis.views import ResponseView
from tmlattice.effects import Cause, Hypothesis, LaunchEffect, RingEffect, background_rms, find
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.inference.distributed import DistributedErrors, DistributedProblem, posterior
from tmlattice.inference.errors import KNOWN_MEMBERS
from tmlattice.lattice import Ring
from tmlattice.measurement.documents import read_document
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response

log = logging.getLogger(__name__)

PRODUCTS = 2e12
"""Readings times errors squared up to which the covariance of all distributed errors of a response
is computed: some six minutes of processor (`docs/together.md`)."""

ROUNDED = 1e-4
"""Of the products of directions: single precision rounds them by 1e-6."""

FORMAT = "tmlattice-known"
SUFFIX = ".known.json"
"""Suffix of the knowledge of a lattice file."""


ESTIMATED = "estimated ring"
"""Model name of a lattice file with a file of knowledge."""


def knowledge_file(lattice: Path) -> Path:
    """The path of the knowledge of a lattice file."""
    return Path(f"{lattice}{SUFFIX}")


def known_of(diagnosis: Diagnosis) -> DistributedErrors | None:
    """The knowledge with the estimated ring; None: nothing on distributed errors.

    The distributed errors with their covariance. Of an orbit response they are linearised at its
    hierarchical fit. Where that stores no beam, or takes too long, each error of the fit has its
    own standard deviation, without correlations.
    """
    if diagnosis.stored:
        raise MeasurementError(
            "diagnosis.json does not hold the covariance of the errors: take the files of "
            "--lattice-out, or a pickle of the diagnosis"
        )
    if not diagnosis.by_families:
        found, causes = diagnosis.explanation, diagnosis.causes
        if not isinstance(found.problem, DistributedProblem):
            return None
        known = found.problem.learnt(found.fit if causes else found.before)
        beside = tuple(c for c in diagnosis.faults if _held_by_ring(c))
        return replace(known, causes=(*known.causes, *beside))
    view = diagnosis.response
    if not diagnosis.steps or diagnosis.since_reference:
        return None  # of a change the distributed errors are the reference's
    usual = background_rms({"all": None})
    everywhere = [(name, place) for name in usual for place in find(name).places(diagnosis.ring)]
    if view.data.size * len(everywhere) ** 2 <= PRODUCTS:
        try:
            return _together(diagnosis, view, usual, everywhere)
        except UnstableRingError:  # too far from its most probable distributed errors to be linear
            log.info("no covariance of the distributed errors", exc_info=True)
    return _each_alone(diagnosis, usual, everywhere)


def _together(
    diagnosis: Diagnosis,
    view: ResponseView,
    usual: Mapping[str, float],
    everywhere: Sequence[Hypothesis],
) -> DistributedErrors:
    """All distributed errors that the readings of a response constrain, linearised at its
    hierarchical fit."""
    ring = diagnosis.ring
    data = response_data(ring, view.measured)
    # model discrepancy enters as noise, so that no error is understated
    lacks = np.sqrt(max(diagnosis.fit_after.chi2_per_dof, 1.0))
    data = replace(data, noise=data.noise * lacks)
    found = {(finding.effect, finding.element) for finding in diagnosis.findings}
    fitted: dict[Hypothesis, float] = {
        (c.effect, c.element): c.amount for c in diagnosis.causes
        if c.element is not None and (c.effect, c.element) not in found
    }  # fmt: skip
    # what else was fitted is as little certain: a skew gradient may be a quadrupole's roll
    more = [h for h, amount in fitted.items() if h[0] not in usual and amount]
    scatter = {name: float(np.sqrt(np.mean([fitted[h] ** 2 for h in more if h[0] == name])))
               for name, _ in more}  # fmt: skip
    usual, everywhere = {**usual, **scatter}, [*everywhere, *more]
    problem = Response(
        base=Predicted(data, Errors.none(data)).bend(),
        used=np.isfinite(data.orbits) & view.good[:, None],
        places={},
        fixed=tuple(c for c in diagnosis.causes if (c.effect, c.element) not in fitted),
    )
    start = np.array([fitted.get(h, 0.0) for h in everywhere])
    known = posterior(
        problem,
        DistributedErrors.usual(everywhere, usual),
        unsure=(2 * KNOWN_MEMBERS) ** -0.5,
        linearised_at=start,
    ).known
    inside = np.array([_in_ring(Cause(*h, 0.0)) for h in everywhere])  # the estimated ring has them
    return replace(
        known,
        amounts=known.amounts - np.where(inside, start, 0.0),
        causes=tuple(c for c in problem.fixed if _held_by_ring(c)),
    )


def _each_alone(
    diagnosis: Diagnosis, usual: Mapping[str, float], everywhere: Sequence[Hypothesis]
) -> DistributedErrors:
    """Errors of a hierarchical fit with their own standard deviations."""
    own = {(c.effect, c.element): s
           for c, s in zip(diagnosis.causes, diagnosis.errors, strict=True)}  # fmt: skip
    rms = [own[h] if own.get(h, 0.0) > 0 else usual[h[0]] for h in everywhere]
    count = len(everywhere)
    return DistributedErrors(
        tuple(everywhere), np.zeros(count), np.array(rms), np.zeros((0, count)), np.zeros(0),
        tuple(c for c in diagnosis.causes if _held_by_ring(c)),
    )  # fmt: skip


def _held_by_ring(cause: Cause) -> bool:
    """Whether an error is kept with the estimated ring; a beam has an energy of its own."""
    return not _in_ring(cause) and not isinstance(find(cause.effect), LaunchEffect)


def _in_ring(cause: Cause) -> bool:
    """Whether the estimated ring has it, and not a calibration."""
    effect = find(cause.effect)
    return isinstance(effect, RingEffect) and not effect.calibrates


def known_document(known: DistributedErrors, lattice: Path) -> dict[str, Any]:
    """The content of the file that belongs to the lattice file."""
    from tmlattice import __version__

    rounded = known.seen.astype("<f4").tobytes()
    return {
        "format": FORMAT,
        "version": 1,
        "package": __version__,
        "lattice_sha256": hashlib.sha256(lattice.read_bytes()).hexdigest(),
        "causes": [
            {"effect": c.effect, "element": c.element, "amount": c.amount} for c in known.causes
        ],
        "small_errors": [
            {"effect": name, "element": place, "amount": amount, "rms": rms}
            for (name, place), amount, rms in zip(
                known.hypotheses, known.amounts.tolist(), known.rms.tolist(), strict=True
            )
        ],
        "seen": {
            "directions": len(known.share),
            "float32": binascii.b2a_base64(rounded, newline=False).decode(),
            "share": known.share.tolist(),
        },
    }


def read_known(path: Path, ring: Ring) -> DistributedErrors:
    """Read the knowledge of a lattice file.

    Raises:
        MeasurementError: it is damaged, or of another ring, or the lattice file was changed since.
    """
    document = read_document(path, "known", FORMAT)
    lattice = path.with_name(path.name.removesuffix(SUFFIX))
    made_for = document.get("lattice_sha256")
    if made_for is not None and hashlib.sha256(lattice.read_bytes()).hexdigest() != made_for:
        raise MeasurementError(
            f"{path}: '{lattice}' is not the file any more that it was written with; remove it, or "
            "write both anew (--lattice-out)"
        )
    rows = document["small_errors"]
    if len({(row["effect"], row["element"]) for row in rows}) < len(rows):
        raise MeasurementError(f"{path}: a distributed error is listed twice; write it anew")
    seen = _directions(path, document["seen"], len(rows))
    share = np.array(document["seen"]["share"], dtype=float)
    places: dict[str, set[str | None]] = {}
    for row in [*rows, *document["causes"]]:
        name = row["effect"]
        if name not in places:
            places[name] = set(find(name).places(ring))
        if row["element"] not in places[name]:
            raise MeasurementError(
                f"{path}: '{ring.name}' has no place '{row['element']}' of {name}; it is of "
                "another ring"
            )
    return DistributedErrors(
        tuple((row["effect"], row["element"]) for row in rows),
        np.array([row["amount"] for row in rows], dtype=float),
        np.array([row["rms"] for row in rows], dtype=float),
        seen,
        share,
        tuple(Cause(r["effect"], r["element"], float(r["amount"])) for r in document["causes"]),
    )


def _directions(path: Path, seen: Mapping[str, Any], errors: int) -> Array:
    """Orthonormal again after the rounding."""
    count = int(seen["directions"])
    damaged = MeasurementError(f"{path}: its directions are damaged; write it anew")
    try:
        raw = binascii.a2b_base64(seen["float32"], strict_mode=True)
        rows = np.frombuffer(raw, dtype="<f4").astype(float).reshape(count, errors)
    except ValueError:
        raise damaged from None
    if len(seen["share"]) != count or not np.isfinite(rows).all() or count > errors:
        raise damaged
    gram = rows @ rows.T
    if np.abs(gram - np.eye(count)).max(initial=0.0) > ROUNDED:
        raise damaged
    return np.asarray(
        1.5 * rows - 0.5 * gram @ rows
    )  # Newton's step: the remaining error is its square
