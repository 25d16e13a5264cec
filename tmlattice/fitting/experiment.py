"""The main experiment: one magnet is weakened, one orbit is measured, the tunes are predicted.

The network knows the design ring and one noisy first-turn orbit of the perturbed one; the tunes
that it then predicts are held against OCELOT's one-turn matrix of the perturbed ring.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, TmlatticeError, TooFewTurnsError
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.methods import fine_tune
from tmlattice.harmonics import MIN_TURNS, tunes
from tmlattice.lattice import Ring, middle_of_first_arc
from tmlattice.maps import element_map, ring_matrix
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork
from tmlattice.network.base import NetworkChain
from tmlattice.optics import matrix_tunes, one_turn_optics

Array = NDArray[np.float64]

DEFAULT_LAUNCH = (1e-3, 0.0, 1e-3, 0.0)
"""x, px, y, py: off axis by 1 mm in both planes."""

TUNE_AMPLITUDE = 1e-9
"""Part of the launch at which the tunes are taken: tunes shift with the square of the amplitude
(1e-4 at 1 mm), and the truth is the one-turn matrix's, at zero amplitude."""

GROWTH_ALLOWED = 1e3
"""How much a trajectory may grow while its tunes are taken. A network with free weights is not
symplectic: one plane may grow by 10 % a turn and swamp the other through the second order."""


@dataclass(frozen=True)
class TuneFit:
    """What `tune_fit` found. Tunes are fractions (x, y); None where there is no tune.

    Attributes:
        ring: the design.
        magnet: name of the perturbed magnet; None for data from elsewhere.
        change: relative change of its strength; None for data from elsewhere.
        launch: state at the start of the ring, [n], of the shot shown.
        noise: rms of a reading, m, over monitors and planes; None where it is not known.
        design_tunes, true_tunes: of OCELOT's one-turn matrices, design and perturbed, [2]; no
            truth is known of data from elsewhere.
        network_tunes: from tracking the fine-tuned network, [2].
        tune_signal: states of that tracking, [1, turns + 1, n]; fewer where the motion grew.
        growth: of the fine-tuned network's amplitude in a turn, 1 where it is symplectic.
        s: of the monitors, m, [monitor].
        measured, before, after: readings of one shot, and the network's before and after
            fine-tuning, [monitor, 2], m; NaN where nothing was read.
        orbit_rms: of the first turn's residual before and after, over all shots, m.
        fit: the fine-tuned network and its history.
        seconds: of wall clock, by stage.
        seed: of the noise.
        turns: tracked for the tunes.
        problem: why there are no network tunes, or None.
        shots: number of shots fitted together.
        source: where the data are from; None for the experiment's own.
    """

    ring: Ring
    magnet: str | None
    change: float | None
    launch: Array
    noise: float | None
    design_tunes: Array
    true_tunes: Array | None
    network_tunes: Array | None
    tune_signal: Array | None
    growth: float | None
    s: Array
    measured: Array
    before: Array
    after: Array
    orbit_rms: tuple[float, float]
    fit: FitResult
    seconds: dict[str, float]
    seed: int
    turns: int
    problem: str | None = None
    shots: int = 1
    source: str | None = None

    @property
    def turns_alive(self) -> int:
        """Turns that the tunes come from: fewer than asked for where the motion grew."""
        return 0 if self.tune_signal is None else self.tune_signal.shape[1] - 1

    @property
    def absolute_error(self) -> Array | None:
        """|network tune - true tune|, the short way round the circle, [2]."""
        if self.network_tunes is None or self.true_tunes is None:
            return None
        return np.abs((self.network_tunes - self.true_tunes + 0.5) % 1.0 - 0.5)

    @property
    def relative_error(self) -> Array | None:
        """The absolute error over the true fraction, [2]."""
        error = self.absolute_error
        return None if error is None or self.true_tunes is None else error / self.true_tunes

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-tune-fit`, version 1 (see `schemas/`)."""
        from tmlattice import __version__

        def pair(value: Array | None) -> list[float] | None:
            return None if value is None else [float(v) for v in value]

        before, after = self.orbit_rms
        return {
            "format": "tmlattice-tune-fit",
            "version": 1,
            "package": __version__,
            "lattice": self.ring.name,
            "layers": len(self.fit.network.layers),
            "monitors": len(self.fit.network.monitors),
            "magnet": self.magnet,
            "change": self.change,
            "launch": [float(v) for v in self.launch],
            "tunes": {
                "design": pair(self.design_tunes),
                "true": pair(self.true_tunes),
                "network": pair(self.network_tunes),
            },
            "error": {
                "absolute": pair(self.absolute_error),
                "relative": pair(self.relative_error),
            },
            "orbit_rms": {"before": before, "after": after},
            "noise": self.noise,
            "loss": self.fit.loss,
            "penalty": self.fit.penalty,
            "seconds": self.seconds,
            "regularization": self.fit.options["regularization"],
            "seed": self.seed,
            "turns": self.turns,
            "turns_alive": self.turns_alive,
            "growth": self.growth,
            "options": self.fit.options,
            "problem": self.problem,
            "shots": self.shots,
            "measurement": self.source,
        }


class _Stopwatch(dict[str, float]):
    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self[name] = self.get(name, 0.0) + time.perf_counter() - begun


def perturbed_ring(ring: Ring, magnet: str, change: float) -> Ring:
    """The ring with the strength of one quadrupole or sextupole changed by a relative amount.

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
            f"{element.kind} '{element.name}' has zero strength, which no relative change "
            "changes; name a powered one"
        )
    return ring.with_changed(element.name, **{attribute: strength * (1 + change)})


def tune_fit(
    ring: Ring,
    magnet: str | None = None,
    change: float = -0.2,
    launch: Sequence[float] = DEFAULT_LAUNCH,
    noise: float = 2e-5,
    turns: int = 500,
    seed: int = 0,
    *,
    progress: bool = True,
    **options: Any,
) -> TuneFit:
    """Perturb one magnet, measure one first turn, fine-tune the design's network, predict tunes.

    Args:
        ring: the design.
        magnet: a quadrupole or sextupole; else the one that `middle_of_first_arc` names.
        change: relative change of its strength.
        launch: x, px, y, py at the start of the ring, m and rad.
        noise: rms of a reading, m; drawn from the seed.
        turns: tracked for the tunes, at a vanishing amplitude.
        seed: of the noise.
        progress: show a bar where there is a terminal.
        options: passed to `fine_tune`.

    Raises:
        UnstableRingError: the design or the perturbed ring has no tune.
        BeamLostError: the launch is lost on the first turn, or the fit diverged.
        TmlatticeError: a magnet that cannot be weakened, negative noise, too few turns.
    """
    if not noise >= 0 or not np.isfinite(noise):
        raise TmlatticeError(f"the noise is {noise:g} m; it is an rms: zero or more")
    if turns < MIN_TURNS:
        raise TooFewTurnsError(f"{turns} turns are too few for a tune; {MIN_TURNS} at least do")
    start = np.asarray(launch, dtype=float)
    if start.shape != (4,) or not np.isfinite(start).all():
        raise TmlatticeError("a launch has four finite numbers: x, px, y, py in m and rad")
    watch = _Stopwatch()
    begun = time.perf_counter()
    name = middle_of_first_arc(ring).name if magnet is None else ring[magnet].name
    with watch.stage("compile"):
        for element in {e.kind: e for e in ring.elements}.values():
            element_map(element, ring.map_energy)  # OCELOT compiles some of its own code
    with watch.stage("maps"):
        machine = perturbed_ring(ring, name, change)
        network = TaylorNetwork.from_ring(ring)
        truth = TaylorNetwork.from_ring(machine)
        design_tunes = matrix_tunes(ring_matrix(ring))
        true_tunes = matrix_tunes(ring_matrix(machine))
    with watch.stage("compile"):
        compile_kernels(network)
    readings = truth(start[None]).detach().numpy()
    readings = readings + noise * np.random.default_rng(seed).standard_normal(readings.shape)
    rms = np.full((len(network.monitors), 2), noise) if noise else None
    measurement = Measurement(start[None], readings[:, None], network.monitors, rms)
    found = _fit_and_track(network, measurement, start, turns, watch, progress, options)
    watch["total"] = time.perf_counter() - begun
    return TuneFit(
        ring=ring,
        magnet=name,
        change=change,
        noise=noise,
        design_tunes=design_tunes,
        true_tunes=true_tunes,
        seconds=dict(watch),
        seed=seed,
        **found,
    )


def tune_fit_measurement(
    ring: Ring,
    measurement: Measurement,
    turns: int = 500,
    *,
    source: str | None = None,
    progress: bool = True,
    **options: Any,
) -> TuneFit:
    """Fine-tune the design's network on the first turns of a measurement, predict the tunes.

    All shots are fitted together, from their nominal launches. A launch off the nominal energy
    takes a network of six coordinates; the tunes are those at the nominal energy.

    Args:
        ring: the design.
        measurement: of one shot or more.
        turns: tracked for the tunes, at a vanishing amplitude.
        source: where the data are from, for the report.
        progress: show a bar where there is a terminal.
        options: passed to `fine_tune`.

    Raises:
        MeasurementError: nothing of the first turn was read, every launch is on the axis, or a
            shot's settings are not the design's.
        UnknownNameError: a monitor that the ring does not have.
        UnstableRingError: the design has no tune.
        BeamLostError: a launch is lost on the first turn, or the fit diverged.
    """
    if turns < MIN_TURNS:
        raise TooFewTurnsError(f"{turns} turns are too few for a tune; {MIN_TURNS} at least do")
    if not measurement.launches.any():
        raise MeasurementError(
            "every launch is on the axis at the nominal energy, from where no weight is learnt; "
            "state the launches of the shots"
        )
    changed = [s for s, set_ in zip(measurement.shots, measurement.settings, strict=False) if set_]
    if changed:
        raise MeasurementError(
            f"shot {changed[0]} has settings other than the design's, which this fit does not "
            "model; select the shots without them"
        )
    watch = _Stopwatch()
    begun = time.perf_counter()
    dimension = 6 if measurement.launches[:, 4].any() else 4
    with watch.stage("compile"):
        for element in {e.kind: e for e in ring.elements}.values():
            element_map(element, ring.map_energy, dimension)
    with watch.stage("maps"):
        network = TaylorNetwork.from_ring(ring, dimension)
        design_tunes = matrix_tunes(ring_matrix(ring))
    measurement = measurement.in_order_of(network.monitors)
    start = np.zeros(dimension)
    start[:4] = DEFAULT_LAUNCH  # both planes move, whatever the shots did
    found = _fit_and_track(network, measurement, start, turns, watch, progress, options)
    watch["total"] = time.perf_counter() - begun
    noise = measurement.noise
    return TuneFit(
        ring=ring,
        magnet=None,
        change=None,
        noise=None if noise is None else float(np.sqrt(np.nanmean(noise**2))),
        design_tunes=design_tunes,
        true_tunes=None,
        seconds=dict(watch),
        seed=0,
        source=source,
        **found,
    )


def _fit_and_track(
    network: TaylorNetwork,
    measurement: Measurement,
    start: Array,
    turns: int,
    watch: _Stopwatch,
    progress: bool,
    options: dict[str, Any],
) -> dict[str, Any]:
    """The fit, and the tunes of what it made: the attributes of TuneFit that come from there."""
    with watch.stage("compile"):
        compile_kernels(network)
    with watch.stage("fit"):
        fit = fine_tune(network, measurement, progress=progress, **options)
    tune, signal, growth, problem = None, None, None, None
    with watch.stage("tunes"):
        try:
            tune, signal, growth = network_tunes(fit.network, start, turns)
        except TmlatticeError as error:
            problem = f"the fine-tuned network has no tune: {error}"
    launches = measurement.states(network.dimension)
    first_turn = measurement.readings[:, 0]
    models = [n(launches).detach().numpy() for n in (network, fit.network)]
    shown = int(np.isfinite(first_turn).any(axis=(1, 2)).argmax())  # the first shot with a reading
    before, after = (float(np.sqrt(np.nanmean((first_turn - m) ** 2))) for m in models)
    return {
        "launch": launches[shown],
        "network_tunes": tune,
        "tune_signal": signal,
        "growth": growth,
        "s": network.maps.s_monitors,
        "measured": first_turn[shown],
        "before": models[0][shown],
        "after": models[1][shown],
        "orbit_rms": (before, after),
        "fit": fit,
        "turns": turns,
        "problem": problem,
        "shots": len(launches),
    }


def network_tunes(network: NetworkChain, launch: Array, turns: int) -> tuple[Array, Array, float]:
    """Tunes of a network by tracking it, at a vanishing part of the launch [n].

    Returns:
        Fractions (x, y) [2]; the states they come from, [1, turns + 1, n], fewer where the motion
        grew; the growth of the amplitude in a turn, 1 for a symplectic network.

    Raises:
        UnstableRingError: no closed orbit, or no tune.
        TooFewTurnsError: the motion grew too fast.
    """
    optics = one_turn_optics(network)
    first = (optics.closed_orbit + TUNE_AMPLITUDE * launch)[None]
    states = network.track(first, turns, keep_lost=True)
    # the transverse plane: off the nominal energy, tau drifts without end
    size = np.abs(states[0] - optics.closed_orbit)[:, :4].max(axis=1)
    grown = ~(size < GROWTH_ALLOWED * np.abs(launch).max() * TUNE_AMPLITUDE)
    signal = states[:, : int(grown.argmax()) if grown.any() else None]
    return tunes(signal, optics).fraction[0], signal, optics.growth


def compile_kernels(network: TaylorNetwork) -> None:
    """Compile, or load from the cache, every kernel that a fit of one shot uses."""
    readings = np.zeros((1, 1, len(network.monitors), 2))
    still = Measurement(np.zeros((1, 5)), readings, network.monitors)
    fine_tune(network, still, epochs=1, progress=False)
    network.track(still.states(network.dimension), 1)
