"""Before the search: data and model made ready, and what is said of them already.

Nothing here decides what the fault is: monitors without a signal are set aside, the noise is
estimated where nobody states it, and data of another ring are declined.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.diagnosis import signals
from tmlattice.diagnosis.choice import chosen_effects
from tmlattice.effects import Cause, expected_radiation, find, rare
from tmlattice.errors import BeamLostError, MeasurementError, first_of
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Hypothesis
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.measurement.assume import in_beam_order
from tmlattice.measurement.lost_beam import beam_lost
from tmlattice.observe.data import Data, joined, of_measurement
from tmlattice.observe.first_turns import STEPS, FirstTurns
from tmlattice.observe.noise import estimate, local_misfit

Array = NDArray[np.float64]

FLOOR = 2e-4
"""Share of the orbit below which no noise is taken: second-order maps leave 2e-5 of an orbit of a
millimetre and 7e-5 of one of three, the same in every reading of a turn. A fault that is found with
this is found with less."""
ROUGH = 1e-4
"""m; stands for a noise that is not known yet, while the launches are fitted for the first time."""
SMALL = 1e-5
"""m and, a tenth of it, rad: launches of trajectories on which sextupoles mix no planes."""
ALONE = 1e-6
"""Square of the share of a signature in a plane below which there is nothing of it: sextupoles make
1e-8 along small trajectories, and coupling of the thousandth part of an orbit is seen."""
PASSED_ON = 0.05
"""Share of a signature's square that turns its sign with the other plane's orbit, above which an
unknown orbit is part of the amount; of a gradient where a tenth of the orbit couples it is 0.02."""
CHUNK = 256
"""Hypotheses whose signatures are made at a time."""
COPIES = 16
"""Of all tangents, which are held at once: they, their inverses, and those of every rival."""
MEMORY = 2e9
"""Bytes that the trajectories of a measurement may take: 3,700 shots of a turn in a hundred
magnets, 280 in fifteen hundred, which say more than maps of second order are good for."""


@dataclass(frozen=True)
class Prepared:
    """A measurement ready for the search.

    Attributes:
        problem: launches and readings, no small errors.
        before: launches alone.
        hypotheses: what may be the cause.
        known: causes that the model holds anyway.
        dead: monitors without a signal (1) or with a frozen one (2), (index, which).
        noise: rms of a reading, m, (x, y); NaN for a plane without readings.
        estimated: whether the noise comes from the data.
        said: what a reader should know.
    """

    problem: FirstTurns
    before: Fit
    hypotheses: tuple[Hypothesis, ...]
    known: tuple[Cause, ...]
    dead: tuple[tuple[int, float], ...]
    noise: tuple[float, float]
    estimated: bool
    said: tuple[str, ...]


def prepare(
    ring: Ring,
    measurement: Measurement,
    reference: Measurement | None,
    radiation: bool,
    effects: Sequence[str] | None,
    judgement: Judgement,
) -> Prepared:
    """Data, model and launches.

    Raises:
        MeasurementError: data that cannot be used, or that are of another lattice.
        BeamLostError: the launches are lost in the design.
        EffectError: none of the effects can be looked for.
        UnknownNameError: a monitor that the ring does not have, or an effect that does not exist.
    """
    known = tuple(expected_radiation(ring)) if radiation else ()
    data = of_measurement(ring, measurement)
    if reference is not None:
        data = joined(of_measurement(ring, reference, reference=True), data)
    chosen = chosen_effects(ring, effects, data.launch_sigma)
    places = {name: max(len(find(name).places(ring)), 1) for name in chosen}
    model = Model(ring, data.settings, data.turns, known, active=data.active)
    listed = {name.casefold() for name in measurement.monitors}
    dead, data, said = _dead_monitors(model, data, listed, judgement)
    rough = data.with_sigma(np.array([ROUGH, ROUGH]))
    problem = FirstTurns(
        model=model, data=rough, places=places, rare=rare(ring, chosen), judgement=judgement
    )
    start = _on_its_way(fit(problem, (), problem.first, steps=STEPS), ring)
    data, noise, estimated = _with_noise(data, start)
    data, noise, floor = _above_the_floor(data, noise)
    _check_lattice(ring, data, start, judgement)
    said = (*said, *floor)
    problem = replace(problem, data=data, white=None)
    before = _on_its_way(fit(problem, (), start.nuisances, steps=STEPS), ring)
    hypotheses = tuple(_determined(ring, model.hypotheses(chosen), data))
    return Prepared(problem, before, hypotheses, known, dead, noise, estimated, said)


def batch(ring: Ring, measurement: Measurement, said: list[str]) -> Measurement:
    """Readings that are a signal, of as many shots as find room, evenly taken.

    Args:
        ring: the design.
        measurement: any number of shots.
        said: which shots are left out is told here.

    Raises:
        MeasurementError: not one shot finds room.
    """
    names = [monitor.name for monitor in ring.monitors]
    measurement = beam_lost(in_beam_order(measurement, names)).without
    shots, turns = measurement.readings.shape[:2]
    each = COPIES * 8 * 36 * turns * (len(ring.magnets) + 1)
    if each > MEMORY:
        raise MeasurementError(
            f"{turns} turns in {len(ring.magnets)} magnets take {each / 1e9:.0f} GB of memory a "
            "shot; give fewer turns (Measurement.select)"
        )
    room = int(MEMORY // each)
    if shots <= room:
        return measurement
    taken = np.linspace(0, shots - 1, room).round().astype(int)
    said.append(f"{room} of {shots} shots are used, evenly taken: the others find no room")
    return measurement.select(shots=[measurement.shots[i] for i in taken])


def _determined(ring: Ring, hypotheses: Sequence[Hypothesis], data: Data) -> list[Hypothesis]:
    """Those that the planes that were read determine.

    In the other plane the orbit is unknown all along the ring, so what acts there alone cannot be
    determined by what sextupoles make of it. Along small trajectories that part vanishes. The
    energy is the focusing's in both planes. Where launches in the other plane are unknown too, so
    is what passes its orbit on: a rolled BPM, a skew gradient.
    """
    planes = data.planes
    if planes.all():
        return list(hypotheses)
    unread = np.repeat(~planes, 2)
    unknown = bool(np.isinf(data.launch_sigma[:, :4][:, unread]).all())
    launches = SMALL * np.array([[1.0, 0, 1.0, 0, 0], [0, 0.1, 0, 0.1, 0]])
    launches = np.concatenate([launches, launches * np.append(np.where(unread, -1, 1), 1)])
    model = Model(ring, [{}] * len(launches))
    paths = model.paths(launches, ())
    found: list[Hypothesis] = []
    for start in range(0, len(hypotheses), CHUNK):
        some = hypotheses[start : start + CHUNK]
        made = np.nan_to_num(model.signatures(paths, some, launches))
        seen = made[..., planes]
        read, other = (np.sum(own**2, axis=(1, 2, 3)) for own in (seen, made[..., ~planes]))
        turned = np.sum((seen[:, :2] - seen[:, 2:]) ** 2, axis=(1, 2, 3))  # with the other orbit
        keep = (read >= ALONE * other) & ~(unknown & (turned > PASSED_ON * read))
        found += [h for h, own in zip(some, keep, strict=True) if own or find(h[0]).energy]
    return found


def _on_its_way(start: Fit, ring: Ring) -> Fit:
    if start.point.lost:
        raise BeamLostError(
            f"{start.point.lost} in '{ring.name}' without any fault: check the launches' units (m, "
            "rad), the settings, and whether this is the machine's lattice"
        )
    return start


def _dead_monitors(
    model: Model, data: Data, listed: set[str], judgement: Judgement
) -> tuple[tuple[tuple[int, float], ...], Data, tuple[str, ...]]:
    """Monitors without a signal (1) or with a frozen one (2), the data without the latter, and what
    is to be said."""
    count = len(model.at)
    readings = data.readings.reshape(-1, count, 2)
    valid = data.valid.reshape(-1, count, 2)
    # readings that are all the same twice are one shot that stands twice, and no frozen monitors
    _, own = np.unique(readings.reshape(len(readings), -1), axis=0, return_index=True)
    readings, valid = readings[own], valid[own]
    silent, frozen, half, said = [], [], [], []
    order = [m for m, name in enumerate(model.maps.monitors) if name.casefold() in listed]
    behind = signals.not_reached(np.asarray(~valid[:, order].any(axis=(0, 2))))
    reached = {m for m, lost in zip(order, behind, strict=True) if not lost}
    for m, name in enumerate(model.maps.monitors):
        there = valid[:, m]
        if not there.any():
            if m in reached:
                silent.append(m)
        elif not there.any(axis=0).all():
            half.append(name)
        elif there.sum() >= 4:
            values = [readings[there[:, plane], m, plane] for plane in (0, 1)]
            if all(len(v) > 1 and np.ptp(v) == 0 for v in values):
                frozen.append(m)
    absent = sum(1 for name in model.maps.monitors if name.casefold() not in listed)
    if absent:
        said.append(f"{absent} of the ring's {count} monitors are not in the measurement")
    unread = [plane for plane, read in zip("xy", data.planes, strict=True) if not read]
    if unread:
        said.append(signals.one_plane(unread[0]))
    elif half:
        said.append(f"{len(half)} monitors read one plane only: {first_of(half, 3)}")
    if len(silent) > judgement.silent * count:
        said.append(f"{len(silent)} monitors have no signal; they count as not there")
        silent = []
    dropped = np.zeros(data.valid.shape, dtype=bool)
    for m in frozen:
        dropped[:, m::count] = True
    dead = (*((m, 1.0) for m in silent), *((m, 2.0) for m in frozen))
    return dead, data.without(dropped), tuple(said)


def _with_noise(data: Data, start: Fit) -> tuple[Data, tuple[float, float], bool]:
    """The data with a noise for every reading, its rms by plane, and whether it is estimated."""
    missing = ~np.isfinite(data.sigma) & data.valid
    if (data.sigma[data.valid & ~missing] <= 0).any():
        raise MeasurementError("a monitor's noise is zero or negative; leave it out if unknown")
    estimated = bool(missing.any())
    if estimated:
        found = estimate(data, start.point.view)
        if not np.isfinite(found).any():
            raise MeasurementError(
                "the noise is not given and the readings are too few to estimate it; give the "
                "noise of a reading"
            )
        data = data.with_sigma(np.where(np.isfinite(found), found, np.nanmean(found)))
    data = data.with_sigma(np.ones(2))  # where nothing was read
    return data, noise_of(data), estimated


def noise_of(data: Data) -> tuple[float, float]:
    """rms noise of a reading, m, (x, y); NaN for a plane without readings."""
    x, y = (_rms(data.sigma[..., p][data.valid[..., p]]) for p in (0, 1))
    return x, y


def _above_the_floor(
    data: Data, noise: tuple[float, float]
) -> tuple[Data, tuple[float, float], tuple[str, ...]]:
    """The data with no noise below what second-order maps leave, its rms, and what is said."""
    floor = FLOOR * _rms(data.readings[data.valid])
    if not (data.sigma[data.valid] < floor).any():
        return data, noise, ()
    data = replace(data, sigma=np.maximum(data.sigma, floor))
    said = (
        f"the noise, {1e6 * min(noise):.2g} µm, is less than what second-order maps leave of such "
        f"an orbit: {1e6 * floor:.2g} µm is taken"
    )
    return data, (max(noise[0], floor), max(noise[1], floor)), (said,)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _check_lattice(ring: Ring, data: Data, start: Fit, judgement: Judgement) -> None:
    """A few errors leave most monitors in agreement with their neighbours."""
    local = local_misfit(data, start.point.view)
    if not np.isfinite(local).sum() > 50:
        return
    size = float(np.median(np.abs(local[np.isfinite(local)])))
    orbit = float(np.median(np.abs(data.readings[data.valid])))
    noise = float(np.median(data.sigma[data.valid]))
    if size > max(judgement.alien * orbit, 5 * noise):
        raise MeasurementError(
            f"the readings do not follow from '{ring.name}': even between neighbouring monitors "
            f"the model errs by {1e6 * size:.0f} µm where the orbit is {1e6 * orbit:.0f} µm; name "
            "the lattice of this machine, and check units and the names of the monitors"
        )


def same_monitors(other: Data, data: Data, dropped: NDArray[np.bool_]) -> Data:
    """Held-out readings of the monitors that the fit kept.

    Args:
        other: of the held-out shots.
        data: of the fit's.
        dropped: readings that the search left out, [shot, reading, 2].
    """
    lost = dropped[data.active].all(axis=0)
    never = np.asarray(lost | ~data.valid[data.active].any(axis=0))
    readings = min(len(never), other.valid.shape[1])
    outliers = np.zeros(other.valid.shape, dtype=bool)
    outliers[:, :readings] = never[None, :readings]
    return other.without(outliers)
