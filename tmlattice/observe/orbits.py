"""Closed orbits, and their changes for steps of the RF.

A closed orbit is the sum of all dipole errors and of the monitors' zeros. Its change for a step of
the RF is the dispersion, in which the zeros cancel; it is not linearised, so that a step of a per
cent in energy is right.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.stored import Moved
from tmlattice.effects import Settings
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import ClosedOrbit, Dispersion
from tmlattice.observe.steady import NOTHING
from tmlattice.observe.stored import Stored, rf_of, stacked

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Orbits(Stored):
    """Closed orbits, m, [shot, monitor, 2]."""

    @property
    def first(self) -> Array:
        """No nuisances."""
        return NOTHING

    def told(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """A shot is a state."""
        return stacked(states, "orbit")


@dataclass(frozen=True, kw_only=True)
class RfOrbits(Stored):
    """Orbit changes for steps of the RF, m, [step, monitor, 2]."""

    @property
    def first(self) -> Array:
        """No nuisances."""
        return NOTHING

    def told(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """From half a step below to half a step above."""
        both = stacked(states, "orbit")
        return np.asarray(both[..., ::2, :, :] - both[..., 1::2, :, :])


def closed_orbits(ring: Ring, measured: ClosedOrbit, places: Mapping[str, float]) -> Orbits:
    """What a measured closed orbit is for an inference.

    Raises:
        MeasurementError: its noise is not known.
        UnknownNameError: a monitor that the ring does not have.
    """
    whole = measured.in_order_of([monitor.name for monitor in ring.monitors])
    settings: tuple[Settings, ...] = whole.settings or ({},) * len(whole.orbit)
    data, errors, used, read_by = _of_monitors(whole.orbit, whole.noise, "a closed orbit")
    return Orbits(
        ring=ring, places=places, data=data, errors=errors, used=used, read_by=read_by,
        states=tuple((one, rf_of(one)) for one in settings),
    )  # fmt: skip


def dispersion(ring: Ring, measured: Dispersion, places: Mapping[str, float]) -> RfOrbits:
    """What measured orbit changes for the RF's steps are for an inference.

    Raises:
        MeasurementError: their noise is not known.
        UnknownNameError: a monitor that the ring does not have.
    """
    whole = measured.in_order_of([monitor.name for monitor in ring.monitors])
    data, errors, used, read_by = _of_monitors(whole.orbits, whole.noise, "dispersion")
    steps = [step.step / step.frequency for step in whole.steps]
    return RfOrbits(
        ring=ring, places=places, data=data, errors=errors, used=used, read_by=read_by,
        states=tuple(({}, side * step / 2) for step in steps for side in (1, -1)),
    )  # fmt: skip


def _of_monitors(
    orbits: Array, noise: Array | None, kind: str
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Data, errors, which there are, and whose they are, all [shot, monitor, 2]."""
    there = np.isfinite(orbits)
    sigma = np.broadcast_to(np.nan if noise is None else noise, orbits.shape)
    if not np.isfinite(sigma[there]).all():
        raise MeasurementError(
            f"the noise of {kind} is not known, and one orbit does not tell it; add it"
        )
    at = np.broadcast_to(np.arange(orbits.shape[1])[:, None], orbits.shape)
    return np.where(there, orbits, 0.0), np.where(there, sigma, 1.0), there, at
