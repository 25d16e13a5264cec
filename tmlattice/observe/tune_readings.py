"""Measured tunes and chromaticities, which no monitor's error affects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.stored import Moved, StoredBeam
from tmlattice.effects import apply
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import TuneReading
from tmlattice.observe.stored import Stored, stacked, states_of
from tmlattice.optics import ring_tunes, short_way

DELTA = 5e-4
"""Energy deviation dE / p0 c on both sides of the nominal one, for the chromaticity."""

TUNE, CHROMATICITY = 1e-4, 0.1
"""Errors if none is stated: a tune's from drifts of currents in minutes, a chromaticity's from
these over steps of a per mil."""

LARGEST = 10.0
"""Times 1, the design's chromaticity and its tune together, by which a chromaticity may differ from
the design's: without its sextupoles, a ring has one to four times its tune."""

WIDER = 0.01
"""Relative change of all gaps of bends, for the slope of the tunes."""


@dataclass(frozen=True, kw_only=True)
class TuneReadings(Stored):
    """Tunes and chromaticities, [shot, (Qx, Qy, Q'x, Q'y)].

    Attributes:
        energies: difference of the relative momentum deviation of the two outer states.
    """

    energies: float

    def readings_of(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """Return the tunes, and the chromaticities from the two outer states of each shot."""
        tunes = stacked(states, "tunes")
        slope = short_way(tunes[..., 1::3, :] - tunes[..., 2::3, :])
        return np.concatenate([tunes[..., ::3, :], slope / self.energies], axis=-1)


def tune_readings(ring: Ring, measured: TuneReading, places: Mapping[str, float]) -> TuneReadings:
    """Return the problem of measured tunes, each of the mode nearer to its plane.

    Raises:
        MeasurementError: a chromaticity that no error of the ring explains.
    """
    shots = len(measured.tune)
    states = states_of(measured.settings, shots)
    model = ResponseModel.of(ring)
    step = abs(DELTA / model.rf_start[5])
    # delta is the relative deviation of the momentum, p that of the energy over p0 c: beta delta
    energies = 2 * step * float(model.rf_start[5]) / ring.beta
    design = np.array(
        [StoredBeam(ResponseModel(apply(ring, (), one), 6, rf)).tunes for one, rf in states]
    )
    near = design + short_way(measured.tune - design)
    slopes = np.full((shots, 2), np.nan)
    if measured.chromaticity is not None:
        slopes = measured.chromaticity
        own = _chromaticity(ring)
        most = LARGEST * (1 + np.abs(own) + (ring_tunes(ring) or [0.0, 0.0]))
        for shot, plane in np.argwhere(np.abs(slopes - own) > most)[:1]:
            raise MeasurementError(
                f"a chromaticity of {slopes[shot, plane]:g} in {'xy'[plane]}, where the design has "
                f"{own[plane]:.3g}: no error of a ring explains it; correct it, or leave it out"
            )
    data = np.concatenate([near, slopes], axis=1)
    errors = np.concatenate(
        [_filled(measured.tune_error, TUNE, shots),
         _filled(measured.chromaticity_error, CHROMATICITY, shots)], axis=1
    )  # fmt: skip
    errors[:, 2:] = np.hypot(errors[:, 2:], chromaticity_uncertainty(ring))
    there = np.isfinite(data)
    return TuneReadings(
        ring=ring,
        states=tuple((one, rf + h) for one, rf in states for h in (0.0, step, -step)),
        values=np.where(there, data, 0.0),
        sigma=errors,
        read_by=np.full(data.shape, -1),
        used=there,
        places=places,
        energies=energies,
    )


def chromaticity_uncertainty(ring: Ring) -> Array:
    """Return the uncertainty of the model's chromaticities by the field of bends, [mode].

    The extent of a fringe field (gap g, field integral K, curvature h) changes the vertical
    focusing of an edge by K g h^2. By the equations of motion that share falls with the momentum.
    The second-order maps, as MAD-X, keep it, and in AT's exact bends it rises with the momentum.
    The chromaticities differ by dQ / d ln g, all gaps together.

    A gradient k1 that is constant across a curved bend, or across its straight poles, differs by
    the sextupole h k1. Second-order maps and AT's exact bends differ by as much.

    Raises:
        UnstableRingError: the ring, or the ring with other bends, stores no beam.
    """
    bends = {i: e for i, e in enumerate(ring.elements) if e.kind == "bend"}
    wider = {i: e.changed(gap=(1 + WIDER) * e.source.gap) for i, e in bends.items() if e.source.gap}
    curved = {
        i: e.changed(k2=e.k2 + e.angle / e.length * e.k1)
        for i, e in bends.items() if e.k1 and e.length
    }  # fmt: skip
    found = np.zeros(2)
    if wider:
        before, after = (
            StoredBeam(ResponseModel(own)).tunes for own in (ring, ring.with_elements(wider))
        )
        found = short_way(after - before) / WIDER
    if curved:
        before, after = (_chromaticity(own) for own in (ring, ring.with_elements(curved)))
        found = np.hypot(found, after - before)
    return np.abs(found)


def _chromaticity(ring: Ring) -> Array:
    """Change of the tunes by the relative deviation of the momentum, [mode]."""
    model = ResponseModel.of(ring)
    step = DELTA / float(model.rf_start[5])
    up, down = (StoredBeam(ResponseModel(ring, 6, h)).tunes for h in (step, -step))
    # p is the deviation of the energy over p0 c: beta times that of the momentum
    return short_way(up - down) * ring.beta / (2 * DELTA)


def _filled(errors: Array | None, usual: float, shots: int) -> Array:
    if errors is None:
        return np.full((shots, 2), usual)
    return np.where(np.isfinite(errors), errors, usual)
