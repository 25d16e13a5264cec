"""What a diagnosis leaves known of a machine, for the next one: a model that learns.

The ring as found is a lattice file; beside it stands what is known of the rest: calibrations, and
the small errors with the covariance that the readings left them. A diagnosis that starts from the
lattice file starts from both.
"""

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.result import Diagnosis, JointView, ResponseView
from tmlattice.effects import Cause, RingEffect, background_rms, find
from tmlattice.errors import MeasurementError
from tmlattice.inference.among import Known
from tmlattice.lattice import Ring
from tmlattice.measurement.documents import read_document

Array = NDArray[np.float64]

FORMAT = "tmlattice-known"
BESIDE = ".known.json"
"""What the name of a lattice file ends in besides."""


def known_beside(lattice: Path) -> Path:
    """Where the knowledge of a lattice file stands."""
    return Path(f"{lattice}{BESIDE}")


def known_of(diagnosis: Diagnosis) -> Known | None:
    """What a diagnosis knows beside the ring as found; None: nothing of small errors.

    Of a joint diagnosis the small errors with their covariance; of families that were fitted to an
    orbit response each error's own standard deviation, its correlations left out: what neighbours
    know together is known less well than it is.
    """
    view, ring = diagnosis.view, diagnosis.ring
    if isinstance(view, JointView):
        beside = tuple(c for c in diagnosis.faults if not _in_ring(c))
        if view.known is None:
            return None
        causes = (*view.known.causes, *beside)
        return Known(**{**vars(view.known), "causes": causes})
    if not isinstance(view, ResponseView) or not diagnosis.steps:
        return None
    usual = background_rms({"all": None})
    own = {(c.effect, c.element): (c.amount, s)
           for c, s in zip(diagnosis.causes, diagnosis.errors, strict=True)}  # fmt: skip
    everywhere = [(name, place) for name in usual for place in find(name).places(ring)]
    rms = [own[h][1] if h in own and own[h][1] > 0 else usual[h[0]] for h in everywhere]
    count = len(everywhere)
    return Known(
        tuple(everywhere), np.zeros(count), np.array(rms), np.zeros((0, count)), np.zeros(0),
        tuple(c for c in diagnosis.causes if not _in_ring(c) and c.effect != "energy_spread"),
    )  # fmt: skip


def _in_ring(cause: Cause) -> bool:
    """Whether the ring as found has it, and not a calibration beside."""
    effect = find(cause.effect)
    return isinstance(effect, RingEffect) and not effect.calibrates


def known_document(known: Known, lattice: Path) -> dict[str, Any]:
    """As it stands in a file, beside the lattice file that it belongs to."""
    from tmlattice import __version__

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
            "float32": base64.b64encode(known.seen.astype("<f4").tobytes()).decode(),
            "share": known.share.tolist(),
        },
    }


def read_known(path: Path, ring: Ring) -> Known:
    """What stands beside a lattice file.

    Raises:
        MeasurementError: it is damaged, or of another ring, or the lattice file was changed since.
    """
    document = read_document(path, "known", FORMAT)
    lattice = path.with_name(path.name.removesuffix(BESIDE))
    made_for = document.get("lattice_sha256")
    if made_for is not None and hashlib.sha256(lattice.read_bytes()).hexdigest() != made_for:
        raise MeasurementError(
            f"{path}: '{lattice}' is not the file any more that it was written with; remove it, or "
            "write both anew (--lattice-out)"
        )
    rows = document["small_errors"]
    if len({(row["effect"], row["element"]) for row in rows}) < len(rows):
        raise MeasurementError(f"{path}: a small error stands twice; write it anew")
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
    return Known(
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
    try:
        raw = base64.b64decode(seen["float32"], validate=True)
        rows = np.frombuffer(raw, dtype="<f4").astype(float).reshape(count, errors)
    except ValueError:
        raise MeasurementError(f"{path}: its directions are damaged; write it anew") from None
    if len(seen["share"]) != count or not np.isfinite(rows).all() or count > errors:
        raise MeasurementError(f"{path}: its directions are damaged; write it anew")
    if not count:
        return rows
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(left @ right)
