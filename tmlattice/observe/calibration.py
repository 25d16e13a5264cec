"""Calibration of monitors and correctors: a file of effects, and the calibrated response."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.closed_orbit import CORRECTORS, Columns, ResponseModel
from tmlattice.beam.kicks import by_energy
from tmlattice.effects import CATALOGUE, Cause, apply, check, find, is_energy, monitors_with
from tmlattice.errors import EffectError, MeasurementError, TmlatticeError
from tmlattice.files import output_file, write_json
from tmlattice.lattice import Ring
from tmlattice.measurement.documents import located, read_document
from tmlattice.observe.orbit_response import DELTA

FORMAT = "tmlattice-calibration"
CALIBRATES = tuple(name for name, effect in CATALOGUE.items() if effect.calibrates)
"""Effects in a calibration file."""
Dispersion = Mapping[str, tuple[float, float]]
"""Dispersion by kicks of the closed orbit, beyond the lattice's, at monitors and correctors, x and
y, m per relative energy; see `beam.kicks`."""
Channel = tuple[str, str | None]
"""A monitor and its plane, "x" or "y"; or a corrector and None."""


@dataclass(frozen=True)
class Calibration:
    """Errors of BPMs, correctors and beam with the lattice file of an estimated ring.

    Attributes:
        causes: effects on monitors, correctors and the beam.
        dispersion: beyond that of the lattice.
        rejected: channels that are not predicted.
        errors: standard errors of the amounts, by effect and element, where known.
    """

    causes: Sequence[Cause] = ()
    dispersion: Dispersion = field(default_factory=dict)
    rejected: Iterable[Channel] = ()
    errors: Mapping[Channel, float] = field(default_factory=dict)


def read_calibration(path: str | Path, ring: Ring) -> Calibration:
    """Return the content of a calibration file.

    Args:
        path: JSON, see the schema `calibration`.
        ring: its ring.

    Raises:
        MeasurementError: no such file, not a calibration, a row that is not a number, or an element
            that cannot have it.
        EffectError, UnknownNameError: an effect or an element of another ring.
    """
    path = Path(path)
    document = read_document(path, "calibration", FORMAT)
    rows = document["effects"]
    with located(path):
        causes = [Cause(e["effect"], e["element"], float(e["amount"])) for e in rows]
    try:
        _check(causes)
        check(ring, causes)
        _once(causes)
    except TmlatticeError as error:
        raise type(error)(f"{path}: {error}") from error
    dispersion: dict[str, tuple[float, float]] = {}
    for row in document.get("dispersion", []):
        with located(path):
            element = ring[row["element"]]
        both = float(row["x"]), float(row["y"])
        if element.kind != "monitor" and element.kind not in CORRECTORS:
            wrong = f"is a {element.kind}, and has no place there"
        elif element.name in dispersion:
            wrong = "occurs twice"
        elif not np.isfinite(both).all():
            wrong = "is no number"
        else:
            dispersion[element.name] = both
            continue
        raise MeasurementError(
            f"{path}: the dispersion of '{element.name}' {wrong}; write the calibration anew "
            "(diagnose --lattice-out)"
        )
    rejected: list[Channel] = []
    for row in document.get("rejected", []):
        with located(path):
            element, plane = ring[row["element"]], row["plane"]
        if element.kind not in (("monitor",) if plane else CORRECTORS):
            raise MeasurementError(
                f"{path}: '{element.name}' is a {element.kind}, and is rejected as a "
                f"{'BPM' if plane else 'corrector'}; write the calibration anew (diagnose "
                "--lattice-out)"
            )
        rejected.append((element.name, plane))
    errors = {(e["effect"], e["element"]): e["sigma"] for e in rows if "sigma" in e}
    return Calibration(causes, dispersion, rejected, errors)


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a calibration file, atomically.

    Raises:
        EffectError: an effect that is not a calibration.
        OutputError: the file cannot be written.
    """
    from tmlattice import __version__

    errors = calibration.errors
    _check(calibration.causes)
    effects = [
        {"effect": c.effect, "element": c.element, "amount": c.amount}
        | ({"sigma": errors[c.effect, c.element]} if (c.effect, c.element) in errors else {})
        for c in calibration.causes
    ]
    document = {"format": FORMAT, "version": 1, "package": __version__, "effects": effects}
    if calibration.dispersion:
        document["dispersion"] = [
            {"element": name, "x": x, "y": y} for name, (x, y) in calibration.dispersion.items()
        ]
    if rejected := [{"element": name, "plane": plane} for name, plane in calibration.rejected]:
        document["rejected"] = rejected
    with output_file(Path(path)) as file:
        write_json(file, document)


def corrector_scales(ring: Ring, causes: Iterable[Cause], names: Sequence[str]) -> Array:
    """Actual kick over the set one of each corrector, [corrector]."""
    scale = {ring[name].name: 1.0 for name in names}
    for cause in causes:
        if cause.effect == "corrector_calibration":
            name = ring[cause.element or ""].name
            if name in scale:
                scale[name] += cause.amount
    return np.array(list(scale.values()))


def offset_of(causes: Iterable[Cause]) -> float:
    """Relative deviation of the beam's mean energy."""
    return sum(cause.amount for cause in causes if is_energy(cause.effect))


def calibrated_response(
    ring: Ring,
    causes: Sequence[Cause] = (),
    correctors: Sequence[str] | None = None,
    dispersion: Dispersion | None = None,
    rejected: Iterable[Channel] = (),
) -> tuple[Columns, Array]:
    """Return the response as the monitors of a ring with errors read it.

    Args:
        ring: the design.
        causes: on the ring, its monitors, and the beam's energy.
        correctors: names; None: all, in beam order.
        dispersion: beyond that of the ring.
        rejected: channels that are not predicted.

    Returns:
        The correctors, and m/rad [corrector, monitor, 2]; NaN for silent monitors and rejected
        channels.

    Raises:
        EffectError, UnknownNameError: a cause that the ring cannot have.
        MeasurementError: an element that is not a corrector.
        UnstableRingError: no closed orbit.
    """
    model = ResponseModel(apply(ring, causes))
    if offset := offset_of(causes):
        model = model.at_energy(offset)
    columns = model.columns(correctors)
    monitors = monitors_with(ring, causes)
    scales = corrector_scales(ring, causes, columns.names)
    beam = scales[:, None, None] * _of_centroid(model, columns, causes, dispersion or {})
    readings = np.einsum("mij,cmj->cmi", monitors.matrix(), beam)
    readings[:, monitors.silent | monitors.frozen] = np.nan
    for name, plane in rejected:
        if plane is None:
            readings[[own == name for own in columns.names]] = np.nan
        else:
            readings[:, model.monitors.index(name), "xy".index(plane)] = np.nan
    return columns, readings


def _of_centroid(
    model: ResponseModel, columns: Columns, causes: Iterable[Cause], dispersion: Dispersion
) -> Array:
    """Correction of the response, m/rad, for the centroid of an energy spread: half the second
    derivative by the energy times the mean square."""
    nothing = (0.0, 0.0)
    monitors = np.array([dispersion.get(name, nothing) for name in model.monitors])
    correctors = np.array([
        dispersion.get(name, nothing)["xy".index(plane)]
        for name, plane in zip(columns.names, columns.planes, strict=True)
    ])  # fmt: skip

    def response(model: ResponseModel) -> Array:
        own = model.response(columns.names)
        if not dispersion:
            return own
        every = np.arange(len(model.monitors))
        return own + by_energy(model, columns.names, every, monitors, correctors)

    one = response(model)
    square = sum(cause.amount**2 for cause in causes if cause.effect == "energy_spread")
    if not square:
        return one
    up, down = (response(model.at_energy(side * DELTA)) for side in (1, -1))
    return np.asarray(one + square / DELTA**2 * ((up + down) / 2 - one))


def _check(causes: Iterable[Cause]) -> None:
    for cause in causes:
        if not find(cause.effect).calibrates:
            raise EffectError(
                f"'{cause.effect}' is no calibration; those are {', '.join(CALIBRATES)}"
            )


def _once(causes: Iterable[Cause]) -> None:
    """Raise if an effect is stated twice for one element."""
    seen: set[tuple[str, str]] = set()
    for cause in causes:
        place = cause.element or "the beam"
        if (key := (cause.effect, place.casefold())) in seen:
            raise EffectError(f"the effect {cause.effect} of '{place}' occurs twice; keep one")
        seen.add(key)
