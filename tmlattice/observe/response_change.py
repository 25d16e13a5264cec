"""Change between two orbit responses of one ring, as a measurement of its own.

>>> change = response_change(data_before, errors, data_after)
>>> change.orbits                                  # the model before plus the measured change

Model discrepancy is the same in both measurements and cancels in their difference, which is added
to the response of the model with the errors of the first.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tmlattice.arrays import Array
from tmlattice.effects import Cause, apply
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.inference.judgement import FEW
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData


def alike(
    ring: Ring, before: OrbitResponse, after: OrbitResponse
) -> tuple[OrbitResponse, OrbitResponse]:
    """Return both measurements with their common correctors and monitors, in the order of the
    first.

    Raises:
        MeasurementError: too few in common, or other planes.
        UnknownNameError: an element that is not in the ring.
    """
    before, after = (_as_the_ring_names_them(ring, one) for one in (before, after))
    columns = [name for name in before.correctors if name in set(after.correctors)]
    monitors = [name for name in before.monitors if name in set(after.monitors)]
    for what, own, all_of in (
        ("correctors", columns, after.correctors), ("BPMs", monitors, after.monitors),
    ):  # fmt: skip
        if len(own) < max(FEW, len(all_of) // 4):
            raise MeasurementError(
                f"the reference shares {len(own)} of {len(all_of)} {what}: it is not of this "
                "machine; give one with the same names"
            )
    first, second = (one.select(columns, monitors) for one in (before, after))
    other = [c for c, a, b in zip(columns, first.planes, second.planes, strict=True) if a != b]
    if other:
        raise MeasurementError(f"corrector '{other[0]}' kicks in another plane in the reference")
    return first, second


def _as_the_ring_names_them(ring: Ring, measured: OrbitResponse) -> OrbitResponse:
    monitors, correctors = (
        tuple(ring[name].name for name in names)
        for names in (measured.monitors, measured.correctors)
    )
    return replace(measured, monitors=monitors, correctors=correctors)


def response_change(
    before: ResponseData, errors: Errors, after: ResponseData, orbit_kicks: Array | None = None
) -> ResponseData:
    """Return the second measurement as it would be in the ring of the first.

    Args:
        before: of the design; correctors and monitors as in `after`.
        errors: of ring, monitors, correctors and energy, fitted to it.
        after: the second measurement.
        orbit_kicks: kicks of the closed orbit, whose dispersion acts with a changed gradient, see
            `ResponseModel`.

    Returns:
        A measurement by perfect monitors with the actual corrector steps, in the design with the
        ring's errors, energy, orbit kicks and corrector rolls: that ring's response plus the
        difference of the two measurements.
    """
    columns = before.measured.correctors
    scale = (before.kicks / after.kicks)[:, None, None]
    change = _as_the_beam(errors.monitors, after.orbits * scale - before.orbits)
    noise = np.hypot(before.noise, after.noise * np.abs(np.median(scale)))
    noise = np.sqrt(_as_the_beam(errors.monitors, noise**2, power=2))
    kicks = np.append(before.kicks[:-1] * errors.kick[:-1], before.kicks[-1])
    there = replace(
        before,
        ring=apply(before.ring, (*errors.ring, *_rolls(columns, errors.angle))),
        kicks=kicks,
        noise=noise,
        energy=errors.energy,
        orbit_kicks=orbit_kicks,
    )
    orbits = _as_stepped(there) + change
    rf = before.measured.rf
    if rf is not None and rf.orbit is not None:
        rf = replace(rf, orbit=orbits[-1])
    measured = replace(before.measured, kicks=kicks[:-1], response=orbits[:-1], noise=noise, rf=rf)
    return replace(there, measured=measured, orbits=orbits)


def _as_the_beam(monitors: Array, read: Array, power: int = 1) -> Array:
    """Readings [..., monitor, 2] as of perfect monitors; without the other plane's reading by the
    gain alone, as a mixed change is negligible.

    Args:
        monitors: gains and coupling, [monitor, 2, 2].
        read: readings.
        power: of the factors: 2 for variances.
    """
    both = np.einsum("mij,...mj->...mi", np.linalg.inv(monitors) ** power, read)
    alone = read / np.diagonal(monitors, axis1=1, axis2=2) ** power
    return np.where(np.isnan(both), alone, both)


def _as_stepped(data: ResponseData) -> Array:
    """Orbit changes of the ring for these steps, which are in both measurements."""
    there = Predicted(data, Errors.none(data))
    try:
        return there.bend().straight
    except UnstableRingError:
        return there.straight


def _rolls(columns: Sequence[str], roll: Array) -> list[Cause]:
    return [
        Cause("corrector_roll", name, float(value))
        for name, value in zip(columns, roll, strict=False)
        if value
    ]
