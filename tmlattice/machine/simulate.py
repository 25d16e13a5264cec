"""A simulated measurement: in memory, or written shot by shot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from tmlattice.arrays import Array
from tmlattice.by_name import by_name
from tmlattice.effects import Cause, Settings
from tmlattice.lattice import Ring
from tmlattice.machine.machine import Errors, Machine, errors, stated_noise
from tmlattice.machine.shots import LAUNCH_SIGMA, Shots, draw_shots
from tmlattice.measurement import Measurement, measurement_writer


def measured(ring: Ring, shots: Shots, readings: Array, noise: Array) -> Measurement:
    """Return the record of readings [shot, turn, monitor, 2], m (noise: of x and y, m, [2])."""
    names = tuple(monitor.name for monitor in ring.monitors)
    return Measurement(
        launches=shots.nominal,
        readings=readings,
        monitors=names,
        noise=stated_noise(noise, len(names)),
        launch_sigma=np.tile(shots.sigma, (len(shots), 1)),
        settings=shots.settings,
        lattice=ring.name,
        energy=ring.energy,
    )


@dataclass(frozen=True, kw_only=True)
class Simulation(Errors):
    """A machine and the shots of its measurement.

    Attributes:
        machine: with causes and background.
        shots: launches and settings.
        turns: of the measurement.
    """

    machine: Machine
    shots: Shots
    turns: int

    def measurement(self) -> Measurement:
        """Return all shots."""
        shots = self.machine.measure(self.shots, self.turns, self.seed)
        readings = np.stack([reading for _, reading in shots])
        return measured(self.ring, self.shots, readings, self.machine.noise)

    def write(
        self, folder: Path, jobs: int = 1, progress: bool = True, force: bool = False
    ) -> None:
        """Write a measurement folder shot by shot, atomically.

        Raises:
            OutputError: it cannot be written.
            MeasurementError: the folder contains a measurement.
        """
        ring, noise, shots = self.ring, self.machine.noise, self.shots
        names = [monitor.name for monitor in ring.monitors]
        known = (float(noise[0]), float(noise[1])) if (noise > 0).all() else None
        with measurement_writer(folder, names, known, ring.name, ring.energy, force) as writer:
            measured = self.machine.measure(shots, self.turns, self.seed, jobs)
            for shot, readings in tqdm(
                measured, total=len(shots), unit="shot", disable=None if progress else True
            ):
                writer.add(shot, shots.nominal[shot], shots.sigma, shots.settings[shot], readings)

    def truth(self) -> dict[str, Any]:
        """Return the true state, for `write_truth`: effects, launches, background, seeds."""
        return {**super().truth(), "launches": self.shots.launches[:, [0, 1, 2, 3, 5]]}


@by_name
def simulate(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    background: str | Mapping[str, float | None] | None = None,
    shots: int = 6,
    turns: int = 1,
    amplitude: float = 1e-3,
    noise: float | Sequence[float] = 2e-5,
    engine: str = "at",
    radiation: bool = False,
    launch_sigma: Sequence[float] = LAUNCH_SIGMA,
    kicks: float = 0.0,
    settings: Sequence[Settings] = (),
    seed: int = 0,
    machine_seed: int | None = None,
) -> Simulation:
    """Return a machine with known causes, and the shots that measure it.

    Args:
        background: distributed errors: effect -> rms (None: the catalogue's), or "all".
        amplitude: rms orbit over monitors and planes, m.
        noise: rms of one reading, m, one number or (x, y).
        engine: "at" or "ocelot".
        radiation: bends and wigglers radiate as expected.
        launch_sigma: rms of x, px, y, py, delta about the nominal launch.
        kicks: rms of random settings of all correctors, rad.
        machine_seed: of the background; else `seed`. Measurements of one machine share it.

    Raises:
        EffectError, UnknownNameError: a cause, or a background, that the ring cannot have.
    """
    made_of = errors(
        ring, causes, background, seed, machine_seed, radiation=radiation, engine=engine
    )
    machine = Machine(ring, made_of.every(), engine=engine, radiation=radiation, noise=noise)
    drawn = draw_shots(
        ring, shots, amplitude, sigma=launch_sigma, kicks=kicks, settings=settings, seed=seed
    )
    return Simulation(machine=machine, shots=drawn, turns=turns, **vars(made_of))
