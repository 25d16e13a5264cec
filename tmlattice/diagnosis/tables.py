"""A diagnosis as pandas DataFrames: `diagnosis.tables["errors"]`.

pandas is imported when the first table is asked for.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from tmlattice.diagnosis.consequences import optics_with
from tmlattice.diagnosis.records import record_of
from tmlattice.effects import find
from tmlattice.errors import MeasurementError, UnstableRingError, unknown_name

Diagnosis = Any
"""A `Diagnosis`, which knows this file."""

SCORES = [
    "effect", "parameters", "heldout_rms_in_plane", "heldout_rms_position",
    "heldout_rms_coupling", "heldout_rms_roll", "heldout_chi2_per_dof", "dispersion_rms",
]  # fmt: skip
"""Columns of a `Step`."""


class Tables(Mapping[str, Any]):
    """The DataFrames of a diagnosis by name. Amounts are in the effect's unit, lengths in m.

    - `findings`: a row a finding: verdict, effect, element, device, s, amount, sigma, unit,
      share_from_data, probability, statistic, p_value, s_from, s_to, action.
    - `errors`: a row an amount: effect, element, device, s, amount, sigma, unit, share_from_data,
      determined.
    - `bpms`, `correctors`: a row an element: device, s, rejected_channels (its planes, or
      "xy"), and of each fitted effect a column of that name, one `_sigma` and one `_share`;
      `attrs["units"]` has their units.
    - `optics`: beta, dispersion and closed orbit of the design and of the estimated ring at the
      start and at the exit of each magnet; `attrs["tunes"]` has the fractional tunes of both.
    - `steps`: a row for the design, the fit, and the fit given faults, of an orbit response.
    - `families`: a row a family of errors, with the decision on it reversed, of an orbit response;
      else empty.
    - `covariance`: of the errors' amounts, by (effect, element).
    """

    def __init__(self, diagnosis: Diagnosis) -> None:
        self._of = diagnosis

    def __getitem__(self, name: str) -> Any:
        """The table of this name.

        Raises:
            UnknownNameError: no such table.
            UnstableRingError: `optics`, where the design or the estimated ring stores no beam.
            MeasurementError: `covariance`, where none is stated.
        """
        if name not in _TABLES:
            raise unknown_name("table", name, _TABLES)
        return _TABLES[name](self._of)

    def __iter__(self) -> Iterator[str]:
        return iter(_TABLES)

    def __len__(self) -> int:
        return len(_TABLES)

    def _ipython_key_completions_(self) -> list[str]:
        return list(_TABLES)


def _frame(rows: list[Any], columns: list[str]) -> Any:
    import pandas as pd

    return pd.DataFrame(rows, columns=columns)


def _findings(diagnosis: Diagnosis) -> Any:
    columns = [
        "verdict", "effect", "element", "device", "s", "amount", "sigma", "unit",
        "share_from_data", "probability", "statistic", "p_value", "s_from", "s_to", "action",
    ]  # fmt: skip
    rows = []
    for finding in diagnosis.findings:
        row = finding.as_json() | {
            "verdict": finding.verdict,
            "device": finding.device,
            "sigma": finding.amount_sigma,
            "statistic": finding.detection.statistic,
            "p_value": finding.detection.p_value,
            "action": finding.words
            if finding.recommended_action is None
            else finding.recommended_action.action,
            **dict(zip(("s_from", "s_to"), finding.where or (np.nan, np.nan), strict=True)),
        }
        rows.append({name: row[name] for name in columns})
    return _frame(rows, columns)


def _errors(diagnosis: Diagnosis) -> Any:
    places = {element.name: element.s for element in diagnosis.ring.elements}
    rows = [
        (
            cause.effect, cause.element, diagnosis.devices.get(cause.element or ""),
            places.get(cause.element or "", np.nan), cause.amount, sigma, find(cause.effect).unit,
            support.share_from_data, support.determined,
        )
        for cause, sigma, support in diagnosis.supported
    ]  # fmt: skip
    return _frame(rows, [
        "effect", "element", "device", "s", "amount", "sigma", "unit", "share_from_data",
        "determined",
    ])  # fmt: skip


def _of_kinds(diagnosis: Diagnosis, *kinds: str) -> Any:
    """All elements of some kinds with what was fitted to them."""
    own = [e for e in diagnosis.ring.elements if e.kind in kinds]
    rejected = {name: plane or "xy" for name, plane in diagnosis.rejected_channels}
    rejected |= dict.fromkeys(diagnosis.bad_monitors, "xy")
    rows = {
        e.name: {"element": e.name, "device": diagnosis.devices.get(e.name), "s": e.s,
                 "rejected_channels": rejected.get(e.name, "")}
        for e in own
    }  # fmt: skip
    units: dict[str, str] = {}
    for cause, sigma, support in diagnosis.supported:
        row = rows.get(cause.element or "")
        if row is not None:
            units[cause.effect] = find(cause.effect).unit
            row |= {cause.effect: cause.amount, f"{cause.effect}_sigma": sigma,
                    f"{cause.effect}_share": support.share_from_data}  # fmt: skip
    columns = ["element", "device", "s", "rejected_channels"]
    columns += [f"{effect}{end}" for effect in units for end in ("", "_sigma", "_share")]
    frame = _frame(list(rows.values()), columns)
    frame.attrs["units"] = units
    return frame


def _optics(diagnosis: Diagnosis) -> Any:
    import pandas as pd

    causes = [cause for cause in diagnosis.causes if cause.element is not None]
    design, found = optics_with(diagnosis.ring, causes)
    if design is None or found is None:
        which = "design" if design is None else "estimated ring"
        raise UnstableRingError(f"the {which} has no stable closed orbit, and so no optics")
    magnets = diagnosis.ring.magnets
    values: dict[str, Any] = {
        "element": ["start", *(magnet.name for magnet in magnets)],
        "device": [None, *(diagnosis.devices.get(magnet.name) for magnet in magnets)],
        "s": [0.0, *(magnet.s + magnet.length / 2 for magnet in magnets)],
    }
    for name in ("beta", "dispersion", "orbit"):
        for plane, letter in enumerate("xy"):
            values[f"{name}_{letter}_design"] = getattr(design, name)[:, plane]
            values[f"{name}_{letter}"] = getattr(found, name)[:, plane]
    frame = pd.DataFrame(values)
    frame.attrs["tunes"] = {"design": design.tunes.tolist(), "estimated": found.tunes.tolist()}
    return frame


def _steps(diagnosis: Diagnosis) -> Any:
    return _frame([record_of(step) for step in diagnosis.steps], SCORES)


def _families(diagnosis: Diagnosis) -> Any:
    rows = [record_of(own) for own in diagnosis.families]
    return _frame(rows, ["effect", "kept", "log_evidence", *SCORES[1:]])


def _covariance(diagnosis: Diagnosis) -> Any:
    import pandas as pd

    if diagnosis.covariance is None:
        why = "diagnosis.json does not hold it" if diagnosis.stored else "this fit states none"
        raise MeasurementError(f"no covariance of the errors is there: {why}")
    names = [[c.effect for c in diagnosis.causes], [c.element or "" for c in diagnosis.causes]]
    index = pd.MultiIndex.from_arrays(names, names=["effect", "element"])
    return pd.DataFrame(diagnosis.covariance, index=index, columns=index)


_TABLES = {
    "findings": _findings,
    "errors": _errors,
    "bpms": lambda diagnosis: _of_kinds(diagnosis, "monitor"),
    "correctors": lambda diagnosis: _of_kinds(diagnosis, "hcorrector", "vcorrector"),
    "optics": _optics,
    "steps": _steps,
    "families": _families,
    "covariance": _covariance,
}
