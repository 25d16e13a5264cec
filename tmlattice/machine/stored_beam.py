"""Simulated measurements of a stored beam: turns after a kick, closed orbits, dispersion, tunes.

>>> simulation = simulate_turns(ring, [Cause("quadrupole_gradient", "qd::12", -0.02)], shots=4)
>>> simulation.measured                                 # a TurnByTurn
>>> write_truth("truth.json", **simulation.truth())

AT is the machine: thick symplectic elements, the closed orbit of the ring with all its errors, and
the ring's RF. Readings have the monitors' errors, and noise.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from tmlattice.beam.rf import rf_of
from tmlattice.effects import Cause, Settings
from tmlattice.effects.apply import groups
from tmlattice.errors import EffectError, TmlatticeError
from tmlattice.lattice import Ring
from tmlattice.machine.at_stored import Beam, tunes_of, turns_of
from tmlattice.machine.machine import StoredSimulation, add_noise, check_engine
from tmlattice.machine.network_engine import NetworkEngine
from tmlattice.machine.response import NOISE, StoredMachine, rf_setting, rf_step_of, spread_of
from tmlattice.machine.shots import draw_shots, each_setting, stream
from tmlattice.measurement import ClosedOrbit, Dispersion, RfStep, TuneReading, TurnByTurn
from tmlattice.observe.calibration import offset_of

Noise = float | Sequence[float]

TURN_NOISE = 2e-5
"""rms of one reading of one turn, m."""
TUNE_NOISE = (2e-5, 0.05)
"""rms of a tune, and of a chromaticity."""


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
    background: str | Mapping[str, float | None] | None = None,
    noise: Noise = TURN_NOISE,
    settings: Sequence[Settings] = (),
    engine: str = "at",
    seed: int = 0,
    machine_seed: int | None = None,
) -> StoredSimulation:
    """Kick the stored beam of a machine with known errors, and read it turn by turn.

    Args:
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
        engine: "at"; or "network": the ring's second-order network, for 100,000 particles and more,
            on a graphics card where there is one; without radiation and settings.
        machine_seed: of the background; else `seed`.

    Raises:
        EffectError, UnknownNameError: a cause, or a background, that the ring cannot have.
        LatticeError: a ring without monitors.
        TmlatticeError: an energy spread of a single particle; or what the network does not have.
        UnstableRingError: no closed orbit, or no stable motion.
        MeasurementError: too few or too many turns.
    """
    machine = StoredMachine(ring, causes, background, seed, machine_seed, radiation)
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
    each = each_setting(settings, shots)
    monitors, further = machine.monitors, turns + machine.monitors.ahead
    check_engine(engine, ("at", "network"))
    if radiation and engine == "network":
        raise EffectError("the network has no radiation; take the engine 'at'")
    if offset_of(machine.every) and engine == "network":
        raise EffectError("the network has no energy offset; take the engine 'at'")
    tracker = machine.engine if engine == "at" else NetworkEngine(ring, machine.every)
    moved = machine.at(each)  # by an energy offset
    passed = np.stack([
        turns_of(tracker, kicked[i], further, moved[i], beam, stream(seed, "particles", i))
        for i in range(shots)
    ])  # fmt: skip
    # before its kick the beam is on the closed orbit
    orbit = machine.orbits(each)[:, None] if (monitors.late < 0).any() else np.nan
    read = monitors.read(monitors.counted(passed, turns, orbit))
    readings, known = machine.noisy(read, noise, "turns")
    readings[:, :, monitors.frozen] = readings[0, 0, monitors.frozen]
    measured = TurnByTurn(
        readings=readings, noise=known, settings=each if settings else (), **machine.fields
    )
    many = {"emittance": list(beam.emittance), "spread": beam.spread} if particles > 1 else {}
    return machine.simulation(
        measured, engine=engine, particles=particles, radiation=radiation, **many
    )


def simulate_orbits(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    shots: int = 1,
    radiation: bool = False,
    background: str | Mapping[str, float | None] | None = None,
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
    machine = StoredMachine(ring, causes, background, seed, machine_seed, radiation)
    each = each_setting(settings, shots)
    read = machine.monitors.read(machine.orbits(each))
    orbit, known = machine.noisy(read, noise, "orbit")
    orbit[:, machine.monitors.frozen] = orbit[0, machine.monitors.frozen]
    measured = ClosedOrbit(
        orbit=orbit, noise=known, settings=each if settings else (), **machine.fields
    )
    return machine.simulation(measured, radiation=radiation)


def simulate_dispersion(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    steps: Sequence[float] | None = None,
    one_sided: bool = False,
    background: str | Mapping[str, float | None] | None = None,
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
    machine = StoredMachine(ring, causes, background, seed, machine_seed)
    rf = rf_of(ring)
    frequency = rf.frequency(ring)
    chosen = [rf_step_of(ring)] if steps is None else [float(step) for step in steps]
    orbits = []
    for step in chosen:
        low = 0.0 if one_sided else -step / 2
        orbits.append(machine.orbits([rf_setting(s / frequency) for s in (low, low + step)]))
    changes, known = machine.changes(orbits, noise, "dispersion")
    steps_made = tuple(
        RfStep(frequency, rf.harmonic, step, change)
        for step, change in zip(chosen, changes, strict=True)
    )
    measured = Dispersion(steps=steps_made, noise=known, **machine.fields)
    return machine.simulation(measured, one_sided=one_sided)


def simulate_tunes(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    shots: int = 1,
    chromaticity: bool = True,
    background: str | Mapping[str, float | None] | None = None,
    noise: Sequence[float] = TUNE_NOISE,
    settings: Sequence[Settings] = (),
    seed: int = 0,
    machine_seed: int | None = None,
) -> StoredSimulation:
    """Return tunes and chromaticities of a machine with known errors.

    Args:
        noise: rms of a tune, and of a chromaticity.

    The other arguments and the errors are as in `simulate_turns`.
    """
    machine = StoredMachine(ring, causes, background, seed, machine_seed)
    each = each_setting(settings, shots)
    values = np.empty((shots, 2, 2))  # [shot, tune or chromaticity, mode]
    for alike, moved in groups(machine.at(each), shots):  # by an energy offset
        values[alike] = tunes_of(machine.engine, moved)
    add_noise(values, np.reshape(noise, (2, 1)), seed, "tunes")
    sigma = [np.full((shots, 2), rms) if rms > 0 else None for rms in noise]
    measured = TuneReading(
        tune=values[:, 0] % 1,
        tune_error=sigma[0],
        chromaticity=values[:, 1] if chromaticity else None,
        chromaticity_error=sigma[1] if chromaticity else None,
        settings=each if settings else (),
        lattice=ring.name,
        energy=ring.energy,
    )
    return machine.simulation(measured)
