"""Preparation of the search: data and model, and the messages about them.

BPMs without a signal are rejected, and the noise is estimated where none is stated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tmlattice.arrays import AT_ONCE, Array, rms
from tmlattice.beam.model import Model
from tmlattice.diagnosis import signals
from tmlattice.effects import (
    Hypothesis,
    LaunchEffect,
    expected_radiation,
    find,
    modelled,
    names,
    rare,
)
from tmlattice.errors import BeamLostError, EffectError, MeasurementError, first_of
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import ITERATIONS, Fit, fit
from tmlattice.inference.problem import Problem
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.measurement.assume import in_beam_order
from tmlattice.measurement.lost_beam import beam_lost
from tmlattice.observe.data import Data, of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.noise import estimate
from tmlattice.observe.sections import KEPT

FLOOR = 2e-4
"""Lower limit of the noise, as a share of the orbit. Second-order maps leave 2e-5 of an orbit of a
millimetre and 7e-5 of one of three, the same in every reading of a turn."""
ROUGH = 1e-4
"""Noise, m, while it is unknown and the launches are fitted for the first time."""
SMALL = 1e-5
"""Amplitude, m (and a tenth of it in rad), of trajectories on which sextupoles couple no planes."""
ALONE = 1e-6
"""Square of the share of a signature in a plane below which it counts as zero. Sextupoles make 1e-8
along small trajectories; coupling of a thousandth of an orbit is detectable."""
PASSED_ON = 0.05
"""Share of a signature's square that changes sign with the other plane's orbit above which an
unknown orbit is part of the amount. It is 0.02 for a gradient with coupling of a tenth."""
COPIES = 16
"""Share of all tangents that is in memory at once: tangents, inverses, and those of every
alternative."""
MEMORY = 2e9
"""Bytes that the trajectories of a measurement may take: 3,700 shots of a turn in a hundred
magnets, 280 in fifteen hundred."""


@dataclass(frozen=True)
class Part:
    """One measurement of several.

    Attributes:
        label: what the user calls it.
        kind: as its folder has it.
        problem: what is fitted.
        heldout: the validation set; None where nothing is held out.
        estimated: whether its noise comes from the data.
        dead: monitors without a signal (1) or with a frozen one (2), (index, which).
        messages: about the data.
        hypotheses: what its readings can determine; None: what the problem sees.
        start: nuisances to start at; None: the problem's own first guess.
        shots: numbers of those of the fit, and of those that are held out.
        reference: the earlier measurement of first turns, if there is one.
    """

    label: str
    kind: str
    problem: Problem = field(repr=False)
    heldout: Problem | None = field(default=None, repr=False)
    estimated: bool = False
    dead: tuple[tuple[int, float], ...] = ()
    messages: tuple[str, ...] = ()
    hypotheses: tuple[Hypothesis, ...] | None = None
    start: Array | None = field(default=None, repr=False)
    shots: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    reference: "Part | None" = None


def prepare(
    ring: Ring,
    measurement: Measurement,
    radiation: bool,
    effects: Sequence[str] | None,
    judgement: Judgement,
) -> Part:
    """Return first turns with data, model and launches, without a validation set.

    Raises:
        MeasurementError: data that cannot be used.
        BeamLostError: the launches are lost in the design.
        EffectError: none of the effects can be looked for.
        UnknownNameError: a monitor that the ring does not have, or an effect that does not exist.
    """
    known = tuple(expected_radiation(ring)) if radiation else ()
    data = of_measurement(ring, measurement)
    chosen = chosen_effects(ring, effects, data.launch_sigma)
    places = {name: max(len(find(name).places(ring)), 1) for name in chosen}
    model = Model(ring, data.settings, data.turns, known)
    listed = {name.casefold() for name in measurement.monitors}
    dead, data, messages = _dead_monitors(model, data, listed, judgement)
    rough = data.with_sigma(np.array([ROUGH, ROUGH]))
    problem = FirstTurns(
        model=model, data=rough, places=places, rare=rare(ring, chosen), judgement=judgement
    )
    start = _on_its_way(problem, problem.first, ring)
    data, estimated = _with_noise(data, start)
    data, floor = _above_the_floor(data)
    messages = (*messages, *floor)
    problem = replace(problem, data=data)
    before = _on_its_way(problem, start.nuisances, ring)
    hypotheses = tuple(_determined(ring, model.hypotheses(chosen), data))
    return Part(
        "first turns", "trajectory", problem, None, estimated, dead, messages, hypotheses,
        before.nuisances,
    )  # fmt: skip


def batch(ring: Ring, measurement: Measurement, messages: list[str]) -> Measurement:
    """Return the readings with a signal, of as many shots as fit into memory, evenly spaced;
    `messages` receives one about omitted shots.

    Raises:
        MeasurementError: not one shot fits.
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
    messages.append(
        f"{room} of {shots} shots are used, evenly spaced: the others do not fit into memory"
    )
    return measurement.select(shots=[measurement.shots[i] for i in taken])


def _determined(ring: Ring, hypotheses: Sequence[Hypothesis], data: Data) -> list[Hypothesis]:
    """Hypotheses that the measured planes determine.

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
    count = max(AT_ONCE // paths.readings.size, 1)
    for start in range(0, len(hypotheses), count):
        some = hypotheses[start : start + count]
        made = np.nan_to_num(model.signatures(paths, some, launches))
        seen = made[..., planes]
        read, other = (np.sum(own**2, axis=(1, 2, 3)) for own in (seen, made[..., ~planes]))
        turned = np.sum((seen[:, :2] - seen[:, 2:]) ** 2, axis=(1, 2, 3))  # with the other orbit
        keep = (read >= ALONE * other) & ~(unknown & (turned > PASSED_ON * read))
        found += [h for h, own in zip(some, keep, strict=True) if own or find(h[0]).energy]
    return found


def _on_its_way(problem: FirstTurns, launches: Array, ring: Ring) -> Fit:
    """The fit of the launches alone."""
    start = fit(problem, (), launches, steps=ITERATIONS)
    if start.point.lost:
        raise BeamLostError(
            f"{start.point.lost} in the design of '{ring.name}': check the launches' units (m, "
            "rad), the settings, and whether this is the machine's lattice"
        )
    return start


def _dead_monitors(
    model: Model, data: Data, listed: set[str], judgement: Judgement
) -> tuple[tuple[tuple[int, float], ...], Data, tuple[str, ...]]:
    """BPMs without a signal (1) or with a frozen one (2), the data without the latter, and the
    messages."""
    count = len(model.at)
    readings = data.readings.reshape(-1, count, 2)
    valid = data.valid.reshape(-1, count, 2)
    # readings that are all the same twice are one shot that stands twice, and no frozen monitors
    _, own = np.unique(readings.reshape(len(readings), -1), axis=0, return_index=True)
    readings, valid = readings[own], valid[own]
    silent, frozen, half, messages = [], [], [], []
    order = [m for m, name in enumerate(model.maps.monitors) if name.casefold() in listed]
    behind = signals.not_reached(np.asarray(~valid[:, order].any(axis=2)))
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
        messages.append(f"{absent} of the ring's {count} BPMs are not in the measurement")
    unread = [plane for plane, read in zip("xy", data.planes, strict=True) if not read]
    if unread:
        messages.append(signals.one_plane(unread[0]))
    elif half:
        messages.append(f"{len(half)} BPMs read one plane only: {first_of(half, 3)}")
    if len(silent) > judgement.silent * count:
        messages.append(f"{len(silent)} BPMs have no signal; they are ignored")
        silent = []
    dropped = np.zeros(data.valid.shape, dtype=bool)
    for m in frozen:
        dropped[:, m::count] = True
    dead = (*((m, 1.0) for m in silent), *((m, 2.0) for m in frozen))
    return dead, data.without(dropped), tuple(messages)


def _with_noise(data: Data, start: Fit) -> tuple[Data, bool]:
    """The data with a noise for every reading, and whether it is estimated."""
    missing = ~np.isfinite(data.sigma) & data.valid
    if (data.sigma[data.valid & ~missing] <= 0).any():
        raise MeasurementError("a BPM's noise is zero or negative; leave it out if unknown")
    estimated = bool(missing.any())
    if estimated:
        found = estimate([(data, start.point.view)])
        if not np.isfinite(found).any():
            raise MeasurementError(
                "the noise is not given and the readings are too few to estimate it; give the "
                "noise of a reading"
            )
        data = data.with_sigma(np.where(np.isfinite(found), found, np.nanmean(found)))
    return data.with_sigma(np.ones(2)), estimated  # where nothing was read


def noise_of(data: Data) -> tuple[float, float]:
    """rms noise of a reading, m, (x, y); NaN for a plane without readings."""
    x, y = (rms(data.sigma[..., p][data.valid[..., p]]) for p in (0, 1))
    return x, y


def _above_the_floor(data: Data) -> tuple[Data, tuple[str, ...]]:
    """The data with noise not below the residual of second-order maps, and messages."""
    floor = FLOOR * rms(data.readings[data.valid])
    if not (data.sigma[data.valid] < floor).any():
        return data, ()
    message = (
        f"the noise, {1e6 * min(noise_of(data)):.2g} µm, is below the error of second-order maps "
        f"for such an orbit: {1e6 * floor:.2g} µm is taken"
    )
    return replace(data, sigma=np.maximum(data.sigma, floor)), (message,)


def chosen_effects(ring: Ring, effects: Sequence[str] | None, launch_sigma: Array) -> list[str]:
    """The effects to be fitted; none where all that are requested show in the data alone.

    Args:
        ring: the design.
        effects: names; None: all usual ones.
        launch_sigma: how well each launch is known, 0 exactly, [shot, 5].

    Raises:
        EffectError: no effect is named, or none of them can be looked for.
        UnknownNameError: an effect that does not exist.
    """
    if not names(effects):
        raise EffectError("no effect is named; leave effects out to look for all of them")
    chosen = modelled(effects)
    free = [six for six, sigma in zip(KEPT, launch_sigma.T, strict=True) if (sigma > 0).any()]
    why = [
        f"{name} shows in turns of a stored beam alone"
        for name in names(effects) if find(name).of_turns
    ]  # fmt: skip
    for name in list(chosen):
        effect = find(name)
        if not effect.places(ring):
            why.append(f"{name} has no place in '{ring.name}' (it sits on: {effect.sits_on_text})")
            chosen.remove(name)
        elif isinstance(effect, LaunchEffect) and effect.shifts in free:
            why.append(
                f"{name} cannot be separated from the launch of each shot, which is fitted too"
            )
            chosen.remove(name)
    if not chosen and len(why) == len(names(effects)):
        raise EffectError("; ".join(why) + ": name another effect")
    return chosen
