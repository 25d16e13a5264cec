"""Closed orbits, and their changes with the RF frequency.

A closed orbit is the sum of all dipole errors and of the monitors' offsets. Its change with the RF
frequency is the dispersion, without the offsets. It is not linearised, so that energy steps of a
per cent are exact.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.stored import Moved
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import ClosedOrbit, Dispersion
from tmlattice.observe.stored import Stored, stacked, states_of


@dataclass(frozen=True, kw_only=True)
class Orbits(Stored):
    """Closed orbits, m, [shot, monitor, 2]."""

    oscillates: ClassVar[bool] = False

    def readings_of(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """Return the readings; a shot is a state."""
        return stacked(states, "orbit")


@dataclass(frozen=True, kw_only=True)
class RfOrbits(Stored):
    """Orbit changes for steps of the RF, m, [step, monitor, 2]."""

    oscillates: ClassVar[bool] = False

    def readings_of(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """Return the change from half a step below to half a step above."""
        both = stacked(states, "orbit")
        return np.asarray(both[..., ::2, :, :] - both[..., 1::2, :, :])


def closed_orbits(ring: Ring, measured: ClosedOrbit, places: Mapping[str, float]) -> Orbits:
    """Return the problem of measured closed orbits.

    Raises:
        MeasurementError: unknown noise.
        UnknownNameError: a monitor that is not in the ring.
    """
    whole = measured.in_order_of([monitor.name for monitor in ring.monitors])
    return Orbits(
        ring=ring, places=places, states=states_of(whole.settings, len(whole.orbit)),
        **_of_monitors(whole.orbit, whole.noise, "a closed orbit"),
    )  # fmt: skip


def dispersion(ring: Ring, measured: Dispersion, places: Mapping[str, float]) -> RfOrbits:
    """Return the problem of measured orbit changes with the RF frequency.

    Raises:
        MeasurementError: unknown noise.
        UnknownNameError: a monitor that is not in the ring.
    """
    whole = measured.in_order_of([monitor.name for monitor in ring.monitors])
    steps = [step.step / step.frequency for step in whole.steps]
    return RfOrbits(
        ring=ring, places=places, **_of_monitors(whole.orbits, whole.noise, "dispersion"),
        states=tuple(({}, side * step / 2) for step in steps for side in (1, -1)),
    )  # fmt: skip


def _of_monitors(orbits: Array, noise: Array | None, kind: str) -> dict[str, Any]:
    """Values, noise, validity and monitor of each reading, all [shot, monitor, 2]."""
    there = np.isfinite(orbits)
    sigma = np.broadcast_to(np.nan if noise is None else noise, orbits.shape)
    if not np.isfinite(sigma[there]).all():
        raise MeasurementError(
            f"the noise of {kind} is unknown, and one orbit does not determine it; state it"
        )
    at = np.broadcast_to(np.arange(orbits.shape[1])[:, None], orbits.shape)
    values, sigma = np.where(there, orbits, 0.0), np.where(there, sigma, 1.0)
    return {"values": values, "sigma": sigma, "used": there, "read_by": at}
