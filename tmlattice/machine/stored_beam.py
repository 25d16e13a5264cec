"""Simulated measurements of a stored beam: turns after a kick, closed orbits, dispersion, tunes.

>>> simulation = simulate_turns(ring, [Cause("quadrupole_gradient", "qd::12", -0.02)], shots=4)
>>> simulation.measured                                 # a TurnByTurn
>>> write_truth("truth.json", **simulation.truth())

AT is the machine: thick symplectic elements, the closed orbit of the ring with all its errors, and
the ring's RF. Readings have the monitors' errors, and noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.rf import rf_of
from tmlattice.effects import (
    Cause,
    Monitors,
    Settings,
    background_rms,
    check,
    monitors_with,
)
from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.lattice.checks import need_monitors
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.at_stored import Beam, tunes_of, turns_of
from tmlattice.machine.machine import true_causes
from tmlattice.machine.response import NOISE, energies, rf_step_of, spread_of
from tmlattice.machine.shots import draw_background, draw_shots, stream
from tmlattice.measurement import ClosedOrbit, Dispersion, RfStep, TuneReading, TurnByTurn

Array = NDArray[np.float64]
Noise = float | Sequence[float]

TURN_NOISE = 2e-5
"""rms of one reading of one turn, m."""
TUNE_NOISE = (2e-5, 0.05)
"""rms of a tune, and of a chromaticity."""


@dataclass(frozen=True, kw_only=True)
class StoredSimulation:
    """A simulated measurement of a stored beam and its inputs.

    Attributes:
        measured: of the simulated kind.
        ring: the design.
        causes: errors, without the background.
        background: rms by effect.
        seed, machine_seed: of the noise, of the background.
        more: further inputs: kicks, particles, ...
    """

    measured: TurnByTurn | ClosedOrbit | Dispersion | TuneReading
    ring: Ring
    causes: tuple[Cause, ...]
    background: Mapping[str, float]
    seed: int
    machine_seed: int
    more: Mapping[str, Any] = field(default_factory=dict)

    def truth(self) -> dict[str, Any]:
        """Return the true state, for `write_truth`."""
        return {
            "effects": true_causes(self.ring, self.causes),
            "launches": np.zeros((0, 5)),
            "background": {
                **self.background,
                "engine": "at",
                "machine_seed": self.machine_seed,
                **self.more,
            },
            "seed": self.seed,
        }


@dataclass(frozen=True)
class _Machine:
    """The ring with all its errors."""

    engine: AtEngine
    every: list[Cause]
    monitors: Monitors
    made_of: dict[str, Any]

    def read(self, beam: Array) -> Array:
        """Return the monitors' readings of the beam, [..., monitor, 2], without noise."""
        return self.monitors.read(beam)

    def fields(self) -> dict[str, Any]:
        """Return the records' fields of the ring."""
        ring = self.engine.ring
        names = tuple(monitor.name for monitor in ring.monitors)
        return {"monitors": names, "lattice": ring.name, "energy": ring.energy}


def _machine(
    ring: Ring,
    causes: Sequence[Cause],
    background: Mapping[str, float | None] | None,
    seed: int,
    machine_seed: int | None,
    radiation: bool = False,
) -> _Machine:
    rms = background_rms(background or {})
    machine_seed = seed if machine_seed is None else machine_seed
    every = [*draw_background(ring, rms, machine_seed), *causes]
    check(ring, every)
    need_monitors(ring)
    scale = float(radiation)
    engine = AtEngine(ring, every, radiation_bends=scale, radiation_wigglers=scale)
    made_of = {
        "ring": ring,
        "causes": tuple(causes),
        "background": rms,
        "seed": seed,
        "machine_seed": machine_seed,
    }
    return _Machine(engine, every, monitors_with(ring, every), made_of)


def simulate_turns(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    shots: int = 1,
    turns: int = 1000,
    amplitude: float = 1e-3,
    kick: Sequence[float] | None = None,
    particles: int = 1,
    emittance: Sequence[float] = (1e-9, 1e-11),
    spread: float = 1e-3,
    radiation: bool = False,
    background: Mapping[str, float | None] | None = None,
    noise: Noise = TURN_NOISE,
    settings: Sequence[Settings] = (),
    seed: int = 0,
    machine_seed: int | None = None,
) -> StoredSimulation:
    """Kick the stored beam of a machine with known errors, and read it turn by turn.

    Args:
        ring: the design.
        causes: its errors.
        shots: number of kicks.
        turns: read after each, from 16 to 10,000.
        amplitude: of the oscillation in the design, rms over monitors and planes, m; phases are
            random.
        kick: instead: the kick at the start of the ring, (x, y), rad, the same in each shot.
        particles: 1 for the centroid; some hundreds decohere.
        emittance: of the two modes, m rad, of many particles.
        spread: rms relative energy of many particles; an effect `energy_spread` adds to it.
        radiation: bends and wigglers radiate as expected.
        background: distributed errors: effect -> rms (None: the catalogue's), or "all".
        noise: rms of one reading, m, one number or (x, y).
        settings: of each shot; () for the design's.
        seed: of kicks, particles and noise.
        machine_seed: of the background; else `seed`.

    Raises:
        EffectError, UnknownNameError: a cause, or a background, that the ring cannot have.
        LatticeError: a ring without monitors.
        TmlatticeError: an energy spread of a single particle.
        UnstableRingError: no closed orbit, or no stable motion.
        MeasurementError: too few or too many turns.
    """
    machine = _machine(ring, causes, background, seed, machine_seed, radiation)
    own = spread_of(machine.every)
    if own and particles == 1:
        raise TmlatticeError(
            "one particle has no energy spread: give particles=, some hundreds (--particles)"
        )
    if kick is None:
        kicked = draw_shots(ring, shots, amplitude, sigma=(0.0,) * 5, seed=seed).launches[:, :4]
    else:
        kicked = np.tile([0.0, kick[0], 0.0, kick[1]], (shots, 1))
    beam = Beam(particles, (emittance[0], emittance[1]), float(np.hypot(spread, own)))
    each = _settings(settings, shots)
    monitors, further = machine.monitors, turns + machine.monitors.ahead
    readings = np.stack(
        [
            turns_of(
                machine.engine, kicked[i], further, each[i], beam, stream(seed, "particles", i)
            )
            for i in range(shots)
        ]
    )
    # before its kick the beam is on the closed orbit
    orbit = _orbits(machine, each)[:, None] if (monitors.late < 0).any() else np.nan
    readings = machine.read(monitors.counted(readings, turns, orbit))
    frozen = machine.monitors.frozen
    sigma, known = _noise(noise, len(ring.monitors))
    for i, reading in enumerate(readings):
        reading += sigma * stream(seed, "turns", i).standard_normal(reading.shape)  # noqa: PLW2901
    readings[:, :, frozen] = readings[0, 0, frozen]
    measured = TurnByTurn(
        readings=readings, noise=known, settings=each if settings else (), **machine.fields()
    )
    more: dict[str, Any] = {"particles": particles, "radiation": radiation}
    if particles > 1:
        more |= {"emittance": list(beam.emittance), "spread": beam.spread}
    return StoredSimulation(measured=measured, more=more, **machine.made_of)


def simulate_orbits(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    shots: int = 1,
    radiation: bool = False,
    background: Mapping[str, float | None] | None = None,
    noise: Noise = NOISE,
    settings: Sequence[Settings] = (),
    seed: int = 0,
    machine_seed: int | None = None,
) -> StoredSimulation:
    """Return closed orbits of a machine with known errors, as its monitors read them.

    Args:
        shots: number of orbits, all the same without `settings`.
        noise: rms of one averaged reading, m, one number or (x, y).

    The other arguments and the errors are as in `simulate_turns`.
    """
    machine = _machine(ring, causes, background, seed, machine_seed, radiation)
    each = _settings(settings, shots)
    orbit = machine.read(_orbits(machine, each))
    sigma, known = _noise(noise, len(ring.monitors))
    for i, reading in enumerate(orbit):
        reading += sigma * stream(seed, "orbit", i).standard_normal(reading.shape)  # noqa: PLW2901
    orbit[:, machine.monitors.frozen] = orbit[0, machine.monitors.frozen]
    measured = ClosedOrbit(
        orbit=orbit, noise=known, settings=each if settings else (), **machine.fields()
    )
    return StoredSimulation(measured=measured, more={"radiation": radiation}, **machine.made_of)


def simulate_dispersion(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    steps: Sequence[float] | None = None,
    one_sided: bool = False,
    background: Mapping[str, float | None] | None = None,
    noise: Noise = NOISE,
    seed: int = 0,
    machine_seed: int | None = None,
) -> StoredSimulation:
    """Return orbit changes of a machine with known errors for steps of its RF.

    Args:
        steps: Hz; None: one step that raises the energy so that the design's orbit changes by
            1.3 mm rms, to two digits.
        one_sided: from the ring's own frequency, else from half below it to half above.
        noise: rms of one orbit change, m, one number or (x, y).

    The other arguments and the errors are as in `simulate_turns`.
    """
    machine = _machine(ring, causes, background, seed, machine_seed)
    rf = rf_of(ring)
    frequency = rf.frequency(ring)
    chosen = [rf_step_of(ring)] if steps is None else [float(step) for step in steps]
    sigma, known = _noise(noise, len(ring.monitors))
    made = []
    for i, step in enumerate(chosen):
        low = 0.0 if one_sided else -step / 2
        down, up = machine.read(
            _orbits(machine, [_rf_setting(s / frequency) for s in (low, low + step)])
        )
        change = up - down
        change[machine.monitors.frozen] = 0.0
        change += sigma * stream(seed, "dispersion", i).standard_normal(change.shape)
        made.append(RfStep(frequency, rf.harmonic, step, change))
    measured = Dispersion(steps=tuple(made), noise=known, **machine.fields())
    return StoredSimulation(measured=measured, more={"one_sided": one_sided}, **machine.made_of)


def simulate_tunes(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    shots: int = 1,
    chromaticity: bool = True,
    background: Mapping[str, float | None] | None = None,
    noise: Sequence[float] = TUNE_NOISE,
    settings: Sequence[Settings] = (),
    seed: int = 0,
    machine_seed: int | None = None,
) -> StoredSimulation:
    """Return tunes and chromaticities of a machine with known errors.

    Args:
        shots: number of readings.
        chromaticity: read it too.
        noise: rms of a tune, and of a chromaticity.

    The other arguments and the errors are as in `simulate_turns`.
    """
    machine = _machine(ring, causes, background, seed, machine_seed)
    each = _settings(settings, shots)
    found = {key: tunes_of(machine.engine, s) for key, s in {repr(s): s for s in each}.items()}
    values = np.array([found[repr(s)] for s in each])  # [shot, tune or chromaticity, mode]
    for i, value in enumerate(values):
        value += np.reshape(noise, (2, 1)) * stream(seed, "tunes", i).standard_normal((2, 2))  # noqa: PLW2901
    fields = machine.fields()
    fields.pop("monitors")
    errors = [np.full((shots, 2), rms) if rms > 0 else None for rms in noise]
    measured = TuneReading(
        tune=values[:, 0] % 1,
        tune_error=errors[0],
        chromaticity=values[:, 1] if chromaticity else None,
        chromaticity_error=errors[1] if chromaticity else None,
        settings=each if settings else (),
        **fields,
    )
    return StoredSimulation(measured=measured, **machine.made_of)


def _orbits(machine: _Machine, settings: Sequence[Settings]) -> Array:
    """Centroid of the stored beam, [shot, monitor, 2]: orbits depend on the energy."""
    weights, frequencies = energies(machine.engine.ring, machine.every)
    each = [
        machine.engine.closed_orbits([_with_frequency(s, float(f)) for s in settings])
        for f in frequencies
    ]
    return np.asarray(np.tensordot(weights, np.array(each), 1))


def _rf_setting(relative: float) -> Settings:
    return {"rf": {"frequency_relative": relative}}


def _with_frequency(settings: Settings, relative: float) -> Settings:
    """A shot's settings with a change of the RF frequency."""
    if relative == 0:
        return settings
    changed = {name: own for name, own in settings.items() if name.casefold() != "rf"}
    before = sum(
        own.get("frequency_relative", 0.0)
        for name, own in settings.items()
        if name.casefold() == "rf"
    )
    return changed | dict(_rf_setting(before + relative))


def _settings(given: Sequence[Settings], shots: int) -> tuple[Settings, ...]:
    if given and len(given) != shots:
        raise TmlatticeError(f"{len(given)} settings do not fit {shots} shots; give one for each")
    return tuple(given) or ({},) * shots


def _noise(noise: Noise, monitors: int) -> tuple[Array, Array | None]:
    """rms in (x, y), and the noise in the record."""
    sigma = np.broadcast_to(np.asarray(noise, dtype=float), (2,))
    if not ((sigma >= 0) & (sigma < np.inf)).all():
        raise TmlatticeError(f"the noise is {noise} m; it is an rms, or two (x, y): zero or more")
    return sigma, np.tile(sigma, (monitors, 1)) if (sigma > 0).all() else None
