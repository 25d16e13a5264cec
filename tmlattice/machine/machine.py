"""A machine that can be measured: a ring with causes, its monitors, their noise."""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, Settings, beams, check, monitors_with
from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.machine.shots import Shots, stream

Array = NDArray[np.float64]
EngineName = Literal["at", "ocelot"]

CHUNK = 64
"""Shots tracked at once: memory does not grow with their number."""


class Machine:
    """A ring whose cause of trouble is known.

    Args:
        ring: the design.
        causes: of all three kinds.
        engine: "at": thick symplectic tracking by accelerator-toolbox; "ocelot": second-order maps.
        radiation: bends and wigglers radiate as expected.
        noise: rms of one reading, m, one number or (x, y).

    Raises:
        EffectError, UnknownNameError: a cause that the ring cannot have.
    """

    def __init__(
        self,
        ring: Ring,
        causes: Sequence[Cause] = (),
        *,
        engine: EngineName = "at",
        radiation: bool = False,
        noise: float | Sequence[float] = 2e-5,
    ) -> None:
        causes = list(causes)
        check(ring, causes)
        self.ring = ring
        self.causes = tuple(causes)
        self.monitors = monitors_with(ring, causes)
        self.noise = np.broadcast_to(np.asarray(noise, dtype=float), (2,))
        if not (np.isfinite(self.noise).all() and (self.noise >= 0).all()):
            raise TmlatticeError(f"the noise is {noise} m; it is an rms: zero or more")
        scale = 1.0 if radiation else 0.0
        if engine == "at":
            from tmlattice.machine.at_engine import AtEngine as Engine
        elif engine == "ocelot":
            from tmlattice.machine.ocelot_engine import OcelotEngine as Engine
        else:
            raise TmlatticeError(f"no engine '{engine}'; there are at and ocelot")
        self._engine = Engine(ring, causes, radiation_bends=scale, radiation_wigglers=scale)

    def beam(
        self, launches: Array, turns: int = 1, settings: Sequence[Settings] | None = None
    ) -> Array:
        """Where the beam's centroid is at every monitor, [shot, turn, monitor, 2], m.

        Args:
            launches: OCELOT's six coordinates, [shot, 6].
            turns: at least 1.
            settings: of each shot.
        """
        weights, nodes = beams(launches, self.causes)
        flat = nodes.reshape(-1, 6)
        repeated = list(settings) * len(weights) if settings else None
        positions = self._engine.track(flat, turns, repeated)
        positions = positions.reshape(len(weights), len(launches), *positions.shape[1:])
        return np.asarray(np.tensordot(weights, positions, 1))

    def measure(self, shots: Shots, turns: int = 1, seed: int = 0) -> Iterator[tuple[int, Array]]:
        """The shots one after another: index and readings [turn, monitor, 2], m.

        Each shot's noise has a stream of its own, so that it does not depend on how many there are.
        """
        frozen = self.monitors.frozen
        first: Array | None = None
        for start in range(0, len(shots), CHUNK):
            chunk = range(start, min(start + CHUNK, len(shots)))
            beam = self.beam(
                shots.launches[chunk.start : chunk.stop],
                turns,
                shots.settings[chunk.start : chunk.stop],
            )
            readings = self.monitors.read(beam)
            for shot, reading in zip(chunk, readings, strict=True):
                noise = stream(seed, "noise", shot).standard_normal(reading.shape)
                reading += self.noise * noise  # noqa: PLW2901
                if first is None:
                    first = reading[0, frozen].copy()
                reading[:, frozen] = first
                yield shot, reading
