"""A simulated orbit response: closed orbits of a machine whose errors are known."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from tmlattice.arrays import Array, rms
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.rf import frequency_of, rf_of
from tmlattice.by_name import by_name
from tmlattice.effects import Cause, Settings, apply, monitors_with
from tmlattice.lattice import Ring
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.machine import (
    StoredSimulation,
    add_noise,
    check_engine,
    errors,
    rms_of,
    stated_noise,
)
from tmlattice.measurement import OrbitResponse, RfStep
from tmlattice.observe.calibration import corrector_scales, offset_of

NOISE = (2e-6, 1.2e-6)
"""rms of an orbit change, m: averaged readings of a stored beam (x, y)."""
RF_ORBIT = 1.3e-3
"""m; rms over the monitors of the orbit change by the RF's step: hundreds of times the noise."""


@by_name
def simulate_response(
    ring: Ring,
    causes: Sequence[Cause] = (),
    *,
    correctors: Sequence[str] | None = None,
    kick: float = 1e-4,
    rf_step: float | None = None,
    one_sided: bool = False,
    background: str | Mapping[str, float | None] | None = None,
    noise: float | Sequence[float] = NOISE,
    engine: str = "at",
    seed: int = 0,
    machine_seed: int | None = None,
    progress: bool = True,
) -> StoredSimulation:
    """Return the response of a machine with known errors to correctors and RF, one by one.

    Args:
        correctors: names; None: all, in beam order.
        kick: the whole change of each corrector, rad.
        rf_step: Hz; 0: the RF is not stepped; None: a step that raises the energy so that the
            design's orbit changes by 1.3 mm rms, to two digits.
        background: distributed errors: effect -> rms (None: the catalogue's), or "all".
        noise: rms of one orbit change, m, one number or (x, y).
        engine: "at": closed orbits of thick symplectic elements; "ocelot": of the second-order
            maps, with sextupole fields as kicks. Neither linearises.
        machine_seed: of the background; else `seed`.
    """
    check_engine(engine)
    machine = StoredMachine(ring, causes, background, seed, machine_seed)
    design = ResponseModel.of(ring)
    columns = design.columns(correctors)
    rf = rf_of(ring)
    harmonic, frequency = rf.harmonic, rf.frequency(ring)
    if rf_step is None:
        rf_step = rf_step_of(ring, design)
    low, high = (0.0, kick) if one_sided else (-kick / 2, kick / 2)
    steps: list[tuple[str | None, float, float]] = [(name, low, high) for name in columns.names]
    if rf_step:
        relative = rf_step / frequency
        steps.append((None, 0.0, relative) if one_sided else (None, -relative / 2, relative / 2))
    orbits = tqdm(
        _orbits(machine, steps, engine), total=len(steps), unit="step",
        disable=None if progress else True,
    )  # fmt: skip
    changes, known = machine.changes(orbits, noise, "response")
    count = len(columns.names)
    stepped = RfStep(frequency, harmonic, rf_step, changes[-1]) if rf_step else None
    measured = OrbitResponse(
        correctors=columns.names,
        planes=columns.planes,
        kicks=np.full(count, kick),
        response=changes[:count],
        noise=known,
        rf=stepped,
        **machine.fields,
    )
    return machine.simulation(measured, engine=engine, one_sided=one_sided)


class StoredMachine:
    """The ring with all its errors, of the arguments that all simulations of a stored beam have."""

    def __init__(
        self,
        ring: Ring,
        causes: Sequence[Cause],
        background: str | Mapping[str, float | None] | None,
        seed: int,
        machine_seed: int | None,
        radiation: bool = False,
    ) -> None:
        self.made_of = errors(ring, causes, background, seed, machine_seed)
        self.ring, self.seed, self.radiation = ring, seed, float(radiation)
        self.every = self.made_of.every()
        self.monitors = monitors_with(ring, self.every)
        names = tuple(monitor.name for monitor in ring.monitors)
        self.fields: dict[str, Any] = {
            "monitors": names, "lattice": ring.name, "energy": ring.energy
        }  # fmt: skip

    @cached_property
    def engine(self) -> AtEngine:
        """AT's ring."""
        scale = self.radiation
        return AtEngine(self.ring, self.every, radiation_bends=scale, radiation_wigglers=scale)

    def orbits(self, settings: Sequence[Settings]) -> Array:
        """Return the centroid of the stored beam, [shot, monitor, 2]: orbits depend on the
        energy."""
        each = [self.engine.closed_orbits(self.at(settings, f)) for f in self.energies[1]]
        return np.asarray(np.tensordot(self.energies[0], np.array(each), 1))

    @cached_property
    def energies(self) -> tuple[Array, Array]:
        """Weights of the Gauss-Hermite nodes of the beam's energy (three with an energy spread,
        else one), and the RF frequency (relative) that is equivalent to each."""
        spread, offset = spread_of(self.every), offset_of(self.every)
        if spread == offset == 0:
            return np.ones(1), np.zeros(1)
        nodes = np.array([-1, 0, 1]) if spread else np.zeros(1)
        weights = np.array([1, 4, 1]) / 6 if spread else np.ones(1)
        per_energy = 1 / ResponseModel(apply(self.ring, self.every)).rf_start[5]
        return weights, per_energy * (offset + np.sqrt(3) * spread * nodes)

    def at(self, settings: Sequence[Settings], frequency: float | None = None) -> list[Settings]:
        """Return the settings of each shot with a change of the RF frequency (relative); None: that
        of the beam's mean energy."""
        change = self.energies[0] @ self.energies[1] if frequency is None else frequency
        return [_with_frequency(own, float(change)) for own in settings]

    def noisy(
        self, readings: Array, noise: float | Sequence[float], purpose: str
    ) -> tuple[Array, Array | None]:
        """Return readings [shot, ..., monitor, 2] with noise, and the noise of the record."""
        size = rms_of(noise)
        add_noise(readings, size, self.seed, purpose)
        return readings, stated_noise(size, len(self.ring.monitors))

    def changes(
        self, orbits: Iterable[Array], noise: float | Sequence[float], purpose: str
    ) -> tuple[Array, Array | None]:
        """Return what the monitors read of orbits below and above each step, [step, monitor, 2],
        and the noise of the record."""
        read = [self.monitors.read(up) - self.monitors.read(down) for down, up in orbits]
        changes = np.array(read).reshape(-1, len(self.ring.monitors), 2)
        changes[:, self.monitors.frozen] = 0.0
        return self.noisy(changes, noise, purpose)

    def simulation(self, measured: Any, **more: Any) -> StoredSimulation:
        """Return the measurement with its inputs."""
        return StoredSimulation(
            **{**vars(self.made_of), "more": {"engine": "at", **more}}, measured=measured
        )


def rf_step_of(ring: Ring, design: ResponseModel | None = None) -> float:
    """Return the RF step, Hz, that raises the energy so that the design's orbit changes by 1.3 mm
    rms, to two digits; 0 without dispersion."""
    model = ResponseModel.of(ring) if design is None else design
    size = rms(model.rf_response()[:, 0])
    step = np.sign(model.rf_start[5]) * RF_ORBIT * rf_of(ring).frequency(ring)
    return float(f"{step / size:.1e}") if size else 0.0


Step = tuple[str | None, float, float]


def _orbits(machine: StoredMachine, steps: Sequence[Step], engine: str) -> Iterator[Array]:
    """Orbits [2, monitor, 2] of the centroid below and above each step of a corrector, or of the
    RF (None)."""
    ring, causes = machine.ring, machine.every
    weights, nodes = machine.energies
    if engine == "at":
        for name, *sides in steps:
            yield machine.orbits([
                rf_setting(side) if name is None else {name: {"kick": ring[name].angle + side}}
                for side in sides
            ])  # fmt: skip
        return
    each = [_map_orbits(ring, causes, steps, float(node)) for node in nodes]
    for orbits in zip(*each, strict=True):
        yield np.asarray(np.tensordot(weights, np.array(orbits), 1))


def rf_setting(relative: float) -> Settings:
    """Return the setting of a relative change of the RF frequency."""
    return {"rf": {"frequency_relative": relative}}


def _with_frequency(settings: Settings, relative: float) -> Settings:
    """A shot's settings with a change of the RF frequency."""
    if relative == 0:
        return settings
    changed = {name: own for name, own in settings.items() if name.casefold() != "rf"}
    return changed | dict(rf_setting(frequency_of(settings) + relative))


def spread_of(causes: Sequence[Cause]) -> float:
    """Relative energy spread of the beam."""
    return float(np.sqrt(sum(c.amount**2 for c in causes if c.effect == "energy_spread")))


def _map_orbits(
    ring: Ring, causes: Sequence[Cause], steps: Sequence[Step], frequency: float
) -> Iterator[tuple[Array, Array]]:
    """The same of one energy, from the second-order maps."""
    wrong = apply(ring, causes)
    model = ResponseModel(wrong, frequency=frequency)
    names = [name for name, _, _ in steps if name is not None]
    scale = corrector_scales(ring, causes, names)
    sides = np.array([own[1:] for own in steps if own[0] is not None]).reshape(-1, 2).T
    orbits = zip(*(model.closed_orbits(names, scale * side) for side in sides), strict=True)
    for name, low, high in steps:
        if name is not None:
            yield next(orbits)
        else:
            down, up = (ResponseModel(wrong, frequency=frequency + f).readings for f in (low, high))
            yield down, up
