"""Localisation by a network: raw weight changes, and changes normalised by their information.

One quadrupole's gradient is changed in the AT engine, for a given signal to noise of the readings.
A network is fine-tuned by the paper's recipe, with launches that were fitted to the design before.
Each ranking's first layer is compared with the true magnet.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from tmlattice.effects import Cause, find
from tmlattice.errors import TmlatticeError
from tmlattice.fitting import fine_tune
from tmlattice.fitting.weight_parts import LayerEffects, layer_effects
from tmlattice.fitting.weights import read_gradient, read_network
from tmlattice.lattice import Ring
from tmlattice.machine import simulate
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork

EFFECT = "quadrupole_gradient"

RANKINGS = ("raw change", "normalised change", "raw gradient", "normalised gradient")
"""Norm of a layer's weight change after fine-tuning; its largest score; the same of the gradient of
the loss at the design."""


@dataclass(frozen=True)
class Case:
    """One fault, its measurement and the rankings.

    Attributes:
        element, s: the changed quadrupole.
        amount: relative change of its gradient.
        signal_to_noise: wanted.
        shots: of the measurement.
        named: the first magnet of each ranking, see `RANKINGS`.
        gaps: number of monitors between it and the true one, by ranking.
        chi2_per_reading: of the design with its launch fitted, and of the fine-tuned network.
        seconds: of the fine-tuning, and of the two rankings.
    """

    element: str
    s: float
    amount: float
    signal_to_noise: float
    shots: int
    named: dict[str, str]
    gaps: dict[str, int]
    chi2_per_reading: tuple[float, float]
    seconds: tuple[float, float]


def study_localisation(
    ring: Ring,
    cases: int = 40,
    *,
    signal_to_noise: Sequence[float] = (20.0,),
    shots: Sequence[int] = (1, 4),
    amplitude: float = 1e-3,
    noise: float = 2e-5,
    epochs: int = 1000,
    learning_rate: float = 1e-6,
    seed: int = 0,
    progress: bool = True,
) -> Iterator[Case]:
    """Rank faults at random quadrupoles, each measured with every number of shots.

    A quadrupole that would need more than the effect's largest fault, or that is invisible, is
    drawn again.

    Args:
        ring: the design.
        cases: faults for each signal to noise.
        signal_to_noise: norm of the change of all readings over the noise, launch projected out.
        shots: of a measurement.
        amplitude: rms orbit, m.
        noise: rms of one reading, m.
        epochs, learning_rate: see `fine_tune`.
        seed: of faults, launches and noise.
        progress: show a bar on a terminal.

    Raises:
        TmlatticeError: no quadrupole of the ring can reach the signal to noise.
    """
    effects = layer_effects(ring)
    network = TaylorNetwork.from_ring(ring)
    places = find(EFFECT).places(ring)
    bar = tqdm(total=cases * len(signal_to_noise) * len(shots), disable=None if progress else True)
    with bar:
        for number in range(cases):
            random = np.random.default_rng([seed, number])
            own = int(random.integers(2**31))
            for _ in range(100):
                place = places[int(random.integers(len(places)))] if places else None
                sigma = {
                    n: _sigma(ring, network, effects, place, n, amplitude, noise, own)
                    for n in shots
                }
                if max(sigma.values()) * max(signal_to_noise) <= find(EFFECT).largest:
                    break
            else:
                raise TmlatticeError(
                    f"no quadrupole of '{ring.name}' reaches a signal to noise of "
                    f"{max(signal_to_noise):g}; give a smaller one"
                )
            sign = random.choice([-1.0, 1.0])
            for ratio in signal_to_noise:
                for n in shots:
                    cause = Cause(EFFECT, place, float(sign * ratio * sigma[n]))
                    measured = simulate(
                        ring, [cause], shots=n, amplitude=amplitude, noise=noise, seed=own
                    ).measurement()
                    yield _case(
                        ring, network, effects, cause, ratio, measured,
                        epochs=epochs, learning_rate=learning_rate,
                    )  # fmt: skip
                    bar.update()


def _sigma(
    ring: Ring,
    network: TaylorNetwork,
    effects: LayerEffects,
    place: str | None,
    shots: int,
    amplitude: float,
    noise: float,
    seed: int,
) -> float:
    """Standard deviation of the fault's amount, from the design's own readings."""
    drawn = simulate(ring, shots=shots, amplitude=amplitude, noise=noise, seed=seed).shots
    readings = network.readings(drawn.nominal[:, :4])[:, None]
    sigma = np.tile(drawn.sigma, (shots, 1))
    design = Measurement(
        drawn.nominal, readings, network.monitors, noise=np.full((len(network.monitors), 2), noise),
        launch_sigma=sigma,
    )  # fmt: skip
    reading = read_gradient(ring, design, effects=effects)
    where = reading.hypotheses.index((EFFECT, place))
    return float(reading.sigma[where])


def _case(
    ring: Ring,
    network: TaylorNetwork,
    effects: LayerEffects,
    cause: Cause,
    ratio: float,
    measured: Measurement,
    **recipe: Any,
) -> Case:
    begun = time.perf_counter()
    gradient = read_gradient(ring, measured, effects=effects)
    reading_seconds = time.perf_counter() - begun
    launched = replace(measured, launches=gradient.launches)
    fitted = fine_tune(network, launched, progress=False, **recipe)
    begun = time.perf_counter()
    assert isinstance(fitted.network, TaylorNetwork)
    change = read_network(ring, fitted.network, measured, effects)
    reading_seconds += time.perf_counter() - begun
    first = {
        "raw change": change.places("raw")[0],
        "normalised change": change.places("score")[0],
        "raw gradient": gradient.places("raw")[0],
        "normalised gradient": gradient.places("score")[0],
    }
    assert cause.element is not None
    true = ring[cause.element]
    monitors = np.array([monitor.s for monitor in ring.monitors])
    before = int(np.searchsorted(monitors, true.s))
    magnets = ring.magnets
    after = fitted.network.readings(launched.launches[:, :4])
    assert measured.noise is not None
    left = (measured.in_order_of(network.monitors).readings[:, 0] - after) / measured.noise
    return Case(
        element=true.name,
        s=true.s,
        amount=cause.amount,
        signal_to_noise=ratio,
        shots=len(measured.launches),
        named={name: magnets[int(k)].name for name, k in first.items()},
        gaps={
            name: abs(int(np.searchsorted(monitors, magnets[int(k)].s)) - before)
            for name, k in first.items()
        },
        chi2_per_reading=(gradient.chi2 / gradient.readings, float(np.mean(left**2))),
        seconds=(fitted.seconds, reading_seconds),
    )


def summarise(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Return how often each ranking's first layer is near the true magnet.

    Returns:
        For each signal to noise and number of shots: {"signal_to_noise", "shots", "cases",
        "rankings": {name: {"element", "within_one_gap", "median_gaps"}}, "chi2_before",
        "chi2_after", "seconds_fine_tuning", "seconds_reading"}: shares of the cases, medians.
        Within one gap: at most one monitor is between.
    """
    rows = []
    for ratio, shots in sorted({(c.signal_to_noise, c.shots) for c in cases}):
        mine = [c for c in cases if (c.signal_to_noise, c.shots) == (ratio, shots)]
        rankings = {}
        for name in RANKINGS:
            gaps = np.array([c.gaps[name] for c in mine])
            rankings[name] = {
                "element": float(np.mean([c.named[name] == c.element for c in mine])),
                "within_one_gap": float(np.mean(gaps <= 1)),
                "median_gaps": float(np.median(gaps)),
            }
        rows.append(
            {
                "signal_to_noise": ratio,
                "shots": shots,
                "cases": len(mine),
                "rankings": rankings,
                "chi2_before": float(np.median([c.chi2_per_reading[0] for c in mine])),
                "chi2_after": float(np.median([c.chi2_per_reading[1] for c in mine])),
                "seconds_fine_tuning": float(np.median([c.seconds[0] for c in mine])),
                "seconds_reading": float(np.median([c.seconds[1] for c in mine])),
            }
        )
    return rows
