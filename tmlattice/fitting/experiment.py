"""The main experiment: one magnet is weakened, one orbit is measured, the tunes are predicted.

The network has the design ring and one noisy first-turn orbit of the perturbed one. The tunes that
it predicts are compared with OCELOT's one-turn matrix of the perturbed ring.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.by_name import by_name
from tmlattice.errors import (
    MeasurementError,
    TmlatticeError,
    TooFewTurnsError,
    UnstableRingError,
    unknown_choice,
)
from tmlattice.fitting.adam import Regularization
from tmlattice.fitting.launches import FreeLaunches, with_noise
from tmlattice.fitting.methods import fine_tune
from tmlattice.fitting.outcome import METHODS, SPARSE_METHODS, MethodFit, TuneFit
from tmlattice.harmonics import MIN_TURNS, tunes
from tmlattice.lattice import Ring, middle_of_first_arc
from tmlattice.maps import element_map, ring_matrix
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork
from tmlattice.network.base import NetworkChain
from tmlattice.observe.data import NOISE_FLOOR, launch_errors
from tmlattice.optics import matrix_tunes, one_turn_optics

DEFAULT_LAUNCH = (1e-3, 0.0, 1e-3, 0.0)
"""x, px, y, py: off axis by 1 mm in both planes."""

TUNE_AMPLITUDE = 1e-9
"""Scale of the launch for the tunes: tunes shift with the square of the amplitude (1e-4 at 1 mm),
and the true ones are those of the one-turn matrix, at zero amplitude."""

CHANGES = (-0.2, -0.1, -0.05, -0.02, -0.01, -0.005, -0.002)
"""Relative changes that are tried by default: the first one with a stable ring is used."""

GROWTH_ALLOWED = 1e3
"""Largest growth of a trajectory in the turns of its tunes. A network with free weights is not
symplectic: one plane may grow by 10 % a turn and swamp the other through the second order."""


class _Stopwatch(dict[str, float]):
    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self[name] = self.get(name, 0.0) + time.perf_counter() - begun


def perturbed_ring(ring: Ring, magnet: str, change: float) -> Ring:
    """Return the ring with a relative change of one quadrupole's or sextupole's strength.

    Raises:
        TmlatticeError: a magnet of another kind, or one whose strength is zero.
        UnknownNameError: no such magnet.
    """
    element = ring[magnet]
    attribute = {"quadrupole": "k1", "sextupole": "k2"}.get(element.kind)
    if attribute is None:
        raise TmlatticeError(
            f"'{element.name}' is a {element.kind}; name a quadrupole or a sextupole, whose "
            "strength can be changed"
        )
    strength = getattr(element, attribute)
    if strength == 0:
        raise TmlatticeError(
            f"{element.kind} '{element.name}' has zero strength, which a relative change leaves at "
            "zero; name a powered one"
        )
    return ring.with_changed(element.name, **{attribute: strength * (1 + change)})


def changed_ring(ring: Ring, magnet: str, change: float | None) -> tuple[Ring, Array, float]:
    """Return the perturbed ring, its tunes [2] and the change: by default the largest usual one;
    UnstableRingError: the ring has no tunes with this change, or with any."""
    tried = CHANGES if change is None else (change,)
    for amount in tried:
        machine = perturbed_ring(ring, magnet, amount)
        try:
            return machine, matrix_tunes(ring_matrix(machine)), amount
        except UnstableRingError:
            continue
    matrix_tunes(ring_matrix(ring))  # raises if the design has no tunes either
    raise UnstableRingError(
        f"with '{magnet}' changed by {100 * tried[-1]:+g} % '{ring.name}' is unstable and has no "
        "tunes: give a smaller --change or another --magnet (in Python: change=, magnet=)"
    )


@by_name
def tune_fit(
    ring: Ring,
    magnet: str | None = None,
    change: float | None = None,
    launch: Sequence[float] = DEFAULT_LAUNCH,
    noise: float = 2e-5,
    turns: int = 500,
    seed: int = 0,
    *,
    methods: Sequence[str] = METHODS,
    candidates: Sequence[str] | None = None,
    epochs: int = 1000,
    learning_rate: float = 1e-6,
    regularization: Regularization | str = "symplectic",
    regularization_rate: float = 1e-10,
    relative_to_design: bool = False,
    free: Sequence[str] | None = None,
    clip: float = 1.0,
    patience: int | None = 200,
    progress: bool = True,
) -> TuneFit:
    """Perturb one magnet, measure one first turn, fine-tune the design's network, predict tunes.

    Args:
        magnet: a quadrupole or sextupole; else the one that `middle_of_first_arc` names.
        change: relative change of its strength; None: -20 %, or less where that is unstable.
        launch: x, px, y, py at the start of the ring, m and rad.
        noise: rms of a reading, m; drawn from the seed.
        turns: tracked for the tunes, at a vanishing amplitude.
        methods: some of `METHODS`: "adam", the paper's recipe; "sparse"; "map"; or "known".
        candidates: names of the only magnets that may have changed, of "known".
        epochs, learning_rate, regularization, regularization_rate: of "adam", see
            `fitting.adam.fit_adam`.
        relative_to_design, free, clip, patience: of the same.

    Raises:
        UnstableRingError: the design or the perturbed ring has no tune.
        BeamLostError: the launch is lost on the first turn, or the fit diverged.
        TmlatticeError: a magnet that cannot be weakened, negative noise, too few turns, or an
            unknown method.
    """
    if not noise >= 0 or not np.isfinite(noise):
        raise TmlatticeError(f"the noise is {noise:g} m; it is an rms: zero or more")
    start = np.asarray(launch, dtype=float)
    if start.shape != (4,) or not np.isfinite(start).all():
        raise TmlatticeError("a launch has four finite numbers: x, px, y, py in m and rad")
    name = middle_of_first_arc(ring).name if magnet is None else ring[magnet].name
    machine, true_tunes, change = changed_ring(ring, name, change)
    measurement = first_turn_of(machine, start[None], noise, np.random.default_rng(seed))
    found = tune_fit_measurement(
        ring, measurement, turns, methods=methods, candidates=candidates, progress=progress,
        epochs=epochs, learning_rate=learning_rate, regularization=regularization,
        regularization_rate=regularization_rate, relative_to_design=relative_to_design,
        free=free, clip=clip, patience=patience,
    )  # fmt: skip
    return replace(found, magnet=name, change=change, noise=noise, true_tunes=true_tunes, seed=seed)


def first_turn_of(
    machine: Ring, launches: Array, noise: float, random: np.random.Generator
) -> Measurement:
    """Return the first turn of a ring with noise, its launches exact.

    Args:
        launches: [shot, 4], m and rad.
        noise: rms of a reading, m; at least `NOISE_FLOOR` is stated.
    """
    truth = TaylorNetwork.from_ring(machine)
    readings = truth.readings(launches)
    readings = readings + noise * random.standard_normal(readings.shape)
    rms = np.full((len(truth.monitors), 2), max(noise, NOISE_FLOOR))
    exact = np.zeros_like(launches)
    return Measurement(launches, readings[:, None], truth.monitors, rms, exact)


@by_name
def tune_fit_measurement(
    ring: Ring,
    measurement: Measurement,
    turns: int = 500,
    *,
    methods: Sequence[str] = METHODS,
    candidates: Sequence[str] | None = None,
    source: str | None = None,
    progress: bool = True,
    **recipe: Any,
) -> TuneFit:
    """Fine-tune the design's network on the first turns of a measurement, predict the tunes.

    All shots are fitted together. Launches are fitted too, within their stated errors (none stated:
    unknown). A launch off the nominal energy needs a network of six coordinates; the tunes are
    those at the nominal energy.

    Args:
        measurement: of one shot or more; an unstated noise is estimated.
        turns: tracked for the tunes, at a vanishing amplitude.
        methods: some of `METHODS`, or "known".
        candidates: names of the only magnets that may have changed, of "known".
        source: where the data are from, for the report.

    Raises:
        MeasurementError: no reading of the first turn, every launch on the axis exactly, or shots
            with settings other than the design's.
        UnknownNameError: a monitor that is not in the ring.
        UnstableRingError: the design has no tune.
        BeamLostError: a launch is lost on the first turn, or the fit diverged.
    """
    begun = time.perf_counter()
    names = _ordered(methods)
    if turns < MIN_TURNS:
        raise TooFewTurnsError(f"{turns} turns are too few for a tune; give at least {MIN_TURNS}")
    dimension = 6 if measurement.launches[:, 4].any() else 4
    sigma = launch_errors(measurement, dimension)
    if not (measurement.launches.any() or sigma.any()):
        raise MeasurementError(
            "every launch is on the axis at the nominal energy, where no weight is determined; "
            "state the launches of the shots"
        )
    changed = [s for s, set_ in zip(measurement.shots, measurement.settings, strict=False) if set_]
    if changed:
        raise MeasurementError(
            f"shot {changed[0]} has settings other than the design's, which this fit does not "
            "model; select the shots without them"
        )
    watch = _Stopwatch()
    with watch.stage("compile"):
        for element in {e.kind: e for e in ring.elements}.values():
            element_map(element, ring.map_energy, dimension)  # OCELOT compiles some of its own code
    with watch.stage("maps"):
        network = TaylorNetwork.from_ring(ring, dimension)
        design_tunes = matrix_tunes(ring_matrix(ring))
    measurement = measurement.in_order_of(network.monitors)
    measurement, estimated = with_noise(ring, measurement, dimension)
    noise = measurement.noise
    assert noise is not None
    nominal = measurement.states(dimension)
    read = measurement.readings[:, 0]
    if not np.isfinite(read).any():
        raise MeasurementError("no reading of the first turn (turn 0); nothing can be fitted")
    shown = int(np.isfinite(read).any(axis=(1, 2)).argmax())  # the first shot with a reading
    with watch.stage("compile"):
        compile_kernels(network, names)
    before = network.readings(FreeLaunches(nominal, sigma, read, noise).fitted(network))
    own = {"adam": recipe, "known": {"candidates": candidates}}
    columns = []
    for name in names:
        options = {"launch_sigma": sigma, "progress": progress, **own.get(name, {})}
        columns.append(fit_and_track(name, network, measurement, turns, shown, **options))
    columns.sort(key=lambda column: column.fit is None)
    if columns[0].fit is None:
        raise UnstableRingError(columns[0].problem or "no method found a ring with tunes")
    watch["fit"] = sum(column.fit.seconds for column in columns if column.fit is not None)
    watch["tunes"] = sum(column.seconds for column in columns) - watch["fit"]
    watch["total"] = time.perf_counter() - begun
    return TuneFit(
        ring=ring,
        magnet=None,
        change=None,
        launch=nominal[shown],
        noise=float(np.sqrt(np.nanmean(noise**2))),
        design_tunes=design_tunes,
        true_tunes=None,
        s=network.maps.s_monitors,
        measured=read[shown],
        before=before[shown],
        rms_before=float(np.sqrt(np.nanmean((read - before) ** 2))),
        methods=tuple(columns),
        seconds=dict(watch),
        seed=0,
        turns=turns,
        shots=len(nominal),
        source=source,
        noise_estimated=estimated,
    )


def _ordered(methods: Sequence[str]) -> tuple[str, ...]:
    """In the order of `METHODS`, "known" last, each once."""
    known = (*METHODS, *(name for name in SPARSE_METHODS if name not in METHODS))
    unknown = [name for name in methods if name not in known]
    if unknown:
        raise unknown_choice("method", unknown[0], METHODS)
    if not methods:
        raise TmlatticeError(f"no method is named; there are {', '.join(METHODS)}")
    return tuple(name for name in known if name in methods)


def fit_and_track(
    name: str,
    network: TaylorNetwork,
    measurement: Measurement,
    turns: int,
    shown: int = 0,
    **options: Any,
) -> MethodFit:
    """Return one method's fit, its tunes, and its residual."""
    read, noise = measurement.readings[:, 0], measurement.noise
    assert noise is not None
    begun = time.perf_counter()
    tune, signal, growth, problem = None, None, None, None
    fit = None
    start = np.zeros(network.dimension)
    start[:4] = DEFAULT_LAUNCH  # both planes move, whatever the shots did
    try:
        fit = fine_tune(network, measurement, method=name, **options)
        tune, signal, growth = network_tunes(fit.network, start, turns)
    except (UnstableRingError, TooFewTurnsError) as error:
        problem = f"the fine-tuned network has no tune: {error}"
    if fit is not None and fit.tunes is not None:
        tune = fit.tunes  # of its matrix, without turns
    readings = np.full_like(read, np.nan)
    if fit is not None:
        nominal = measurement.states(network.dimension)
        launches = nominal if fit.launches is None else fit.launches
        readings = fit.network.readings(launches)
    left = read - readings
    pulls = (left / noise) ** 2
    return MethodFit(
        method=name,
        fit=fit,
        tunes=tune,
        tune_sigma=None if fit is None else fit.tune_sigma,
        signal=signal,
        growth=growth,
        after=readings[shown],
        rms=float(np.sqrt(np.nanmean(left**2))) if fit is not None else float("nan"),
        readings=int(np.isfinite(read).sum()),
        noise=float(np.sqrt(np.nanmean(noise**2))),
        chi2=float(np.nanmean(pulls)) if fit is not None else None,
        seconds=time.perf_counter() - begun,
        problem=problem,
    )


def network_tunes(network: NetworkChain, launch: Array, turns: int) -> tuple[Array, Array, float]:
    """Return tunes of a network by tracking it, at a small share of the launch [n].

    Returns:
        Fractions (x, y) [2]; the states they come from, [1, turns + 1, n], fewer where the motion
        grew; the growth of the amplitude in a turn, 1 for a symplectic network.
    """
    optics = one_turn_optics(network)
    first = (optics.closed_orbit + TUNE_AMPLITUDE * launch)[None]
    states = network.track(first, turns, keep_lost=True)
    # transverse coordinates: off the nominal energy tau drifts
    size = np.abs(states[0] - optics.closed_orbit)[:, :4].max(axis=1)
    grown = ~(size < GROWTH_ALLOWED * np.abs(launch).max() * TUNE_AMPLITUDE)
    signal = states[:, : int(grown.argmax()) if grown.any() else None]
    return tunes(signal, optics).fraction[0], signal, optics.growth


def compile_kernels(network: TaylorNetwork, methods: Sequence[str]) -> None:
    """Compile, or load from the cache, the kernels that a fit of one shot uses."""
    readings = np.zeros((1, 1, len(network.monitors), 2))
    still = Measurement(np.zeros((1, 5)), readings, network.monitors)
    if "adam" in methods:
        fine_tune(network, still, epochs=1, progress=False, launch_sigma=0.0)
    network.track(still.states(network.dimension), 1)
