"""A simulated orbit response: closed orbits of a machine whose errors are known."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from tqdm.auto import tqdm

from tmlattice.arrays import Array
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.rf import rf_of
from tmlattice.by_name import by_name
from tmlattice.effects import Cause, Settings, apply, monitors_with
from tmlattice.lattice import Ring
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.machine import (
    StoredSimulation,
    check_engine,
    errors,
    rms_of,
    stated_noise,
)
from tmlattice.machine.shots import stream
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
    made_of = errors(
        ring, causes, background, seed, machine_seed, engine=engine, one_sided=one_sided
    )
    every = made_of.every()
    names = tuple(monitor.name for monitor in ring.monitors)
    design = ResponseModel(ring)
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
    orbits = _centroids(ring, every, steps, _at_orbits if engine == "at" else _map_orbits)
    monitors = monitors_with(ring, every)
    changes = np.stack(
        [
            monitors.read(up) - monitors.read(down)
            for down, up in tqdm(
                orbits, total=len(steps), unit="step", disable=None if progress else True
            )
        ]
    )
    changes[:, monitors.frozen] = 0.0
    sigma = rms_of(noise)
    for i, change in enumerate(changes):
        change += sigma * stream(seed, "response", i).standard_normal(change.shape)  # noqa: PLW2901
    count = len(columns.names)
    stepped = RfStep(frequency, harmonic, rf_step, changes[-1]) if rf_step else None
    measured = OrbitResponse(
        correctors=columns.names,
        planes=columns.planes,
        kicks=np.full(count, kick),
        monitors=names,
        response=changes[:count],
        noise=stated_noise(sigma, len(names)),
        rf=stepped,
        lattice=ring.name,
        energy=ring.energy,
    )
    return StoredSimulation(measured=measured, **vars(made_of))


def rf_step_of(ring: Ring, design: ResponseModel | None = None) -> float:
    """Return the RF step, Hz, that raises the energy so that the design's orbit changes by 1.3 mm
    rms, to two digits; 0 without dispersion."""
    model = ResponseModel(ring) if design is None else design
    size = float(np.sqrt(np.mean(model.rf_response()[:, 0] ** 2)))
    step = np.sign(model.rf_start[5]) * RF_ORBIT * rf_of(ring).frequency(ring)
    return float(f"{step / size:.1e}") if size else 0.0


Step = tuple[str | None, float, float]
Orbits = Iterator[tuple[Array, Array]]
Engine = Callable[[Ring, Sequence[Cause], Sequence[Step], float], Orbits]


def _centroids(
    ring: Ring, causes: Sequence[Cause], steps: Sequence[Step], engine: Engine
) -> Orbits:
    """Orbits of the centroid of a beam with an energy spread.

    Three Gauss-Hermite nodes; a particle's energy is that of another RF frequency.
    """
    weights, nodes = energies(ring, causes)
    if offset := offset_of(causes):
        nodes = nodes + offset / ResponseModel(apply(ring, causes)).rf_start[5]
    each = [engine(ring, causes, steps, float(node)) for node in nodes]
    for orbits in zip(*each, strict=True):
        down, up = np.tensordot(weights, np.array(orbits), 1)
        yield down, up


def spread_of(causes: Sequence[Cause]) -> float:
    """Relative energy spread of the beam."""
    return float(np.sqrt(sum(c.amount**2 for c in causes if c.effect == "energy_spread")))


def energies(ring: Ring, causes: Sequence[Cause]) -> tuple[Array, Array]:
    """Weights of the nodes of the beam's energy, and the RF frequency (relative) of each."""
    spread = spread_of(causes)
    if spread == 0:
        return np.ones(1), np.zeros(1)
    per_energy = 1 / ResponseModel(apply(ring, causes)).rf_start[5]
    nodes = np.sqrt(3) * spread * per_energy * np.array([-1, 0, 1])
    return np.array([1, 4, 1]) / 6, nodes


def _at_orbits(
    ring: Ring, causes: Sequence[Cause], steps: Sequence[Step], frequency: float
) -> Orbits:
    """Orbits below and above each step of a corrector, or of the RF (None)."""
    engine = AtEngine(ring, causes)

    def setting(name: str | None, amount: float) -> Settings:
        if name is None:
            return {"rf": {"frequency_relative": frequency + amount}}
        kick = {name: {"kick": ring[name].angle + amount}}
        return {**kick, "rf": {"frequency_relative": frequency}} if frequency else kick

    for name, low, high in steps:
        down, up = engine.closed_orbits([setting(name, low), setting(name, high)])
        yield down, up


def _map_orbits(
    ring: Ring, causes: Sequence[Cause], steps: Sequence[Step], frequency: float
) -> Orbits:
    """Orbits from the second-order maps, as `_at_orbits`."""
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
