"""The measurement that best separates two explanations.

Candidates are launches of other phases and amplitudes, another energy, and a changed setting of a
suspected magnet. For each the readings are predicted under both explanations. The separation is the
difference that neither the launch nor the amount can absorb.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tmlattice.arrays import TINY, Array
from tmlattice.beam.chain import Chain
from tmlattice.beam.model import LAUNCH, Model
from tmlattice.diagnosis.records import OPTIONAL, named, record_of
from tmlattice.effects import Cause, Settings, find
from tmlattice.errors import UnstableRingError
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.problem import Point, Problem
from tmlattice.lattice import Ring
from tmlattice.observe.data import Data
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.optics import one_turn_optics

PHASES = 12
CHANGES = {
    "quadrupole": {"k1_relative": 0.02},
    "sextupole": {"k2_relative": -1.0},
    "hcorrector": {"kick": 5e-5},
    "vcorrector": {"kick": 5e-5},
}
"""Relative changes of a suspected magnet's setting."""

LEAST = 2.0
"""Least separation of a recommended shot, in standard deviations."""

AMPLITUDE = 1e-3
"""Amplitude of the proposed launches where those measured are on the axis, m."""


@dataclass(frozen=True)
class NextMeasurement:
    """A recommended measurement, and its separation.

    Attributes:
        launch: x, px, y, py, delta of one more shot; None of another kind of measurement.
        settings: of the shot.
        parts: the two hypotheses, as texts.
        separation: between them, in standard deviations.
        kind: of measurement.
        minutes: of machine time that it takes; None of a shot.
    """

    launch: dict[str, float] | None
    settings: Settings
    parts: tuple[str, str] = field(metadata=named("between"))
    separation: float = field(metadata=named("separation_sigma"))
    kind: str = "trajectory"
    minutes: float | None = field(default=None, metadata=OPTIONAL)

    def as_json(self) -> dict[str, object]:
        """The entry in the file of the diagnosis."""
        own = record_of(self)
        if self.minutes is None:
            del own["kind"]
        return own


def next_measurement(
    ring: Ring,
    data: Data,
    first: Alternative,
    second: Alternative,
    known: Sequence[Cause] = (),
    seed: int = 0,
) -> NextMeasurement | None:
    """Return the shot with the largest separation of two alternatives; None where none reaches
    `LEAST`.

    Args:
        ring: the design.
        data: what was measured: its amplitudes, noise and knowledge of launches.
        first, second: refitted with everything else in place.
        known: causes that are in the model anyway.
        seed: of the candidates' phases.
    """
    launches, settings = _candidates(ring, data, (first, second), seed)
    if not settings:
        return None
    model = Model(ring, settings, data.turns, known)
    count = len(launches)
    sigma = np.nanmedian(data.sigma.reshape(-1, 2), axis=0)
    prior = data.launch_sigma[data.active][:1]
    shots = Data(
        readings=np.zeros((count, data.turns * len(model.at), 2)),
        valid=np.broadcast_to(
            data.valid[data.active].any(axis=0), (count, *data.valid.shape[1:])
        ).copy(),
        sigma=np.broadcast_to(sigma, (count, data.turns * len(model.at), 2)).copy(),
        launches=launches,
        launch_sigma=np.repeat(prior, count, axis=0),
        settings=tuple(settings),
        turns=data.turns,
        active=np.ones(count, dtype=bool),
    )
    problem = FirstTurns(model=model, data=shots, places={})
    points = [problem.at(own.fit.causes, launches) for own in (first, second)]
    if points[0].lost:
        return None
    separation = separations(problem, (first, second), points, count)
    best = int(separation.argmax())
    if not separation[best] >= LEAST:
        return None
    names = [" ".join(w for w in rival.hypothesis if w) for rival in (first, second)]
    return NextMeasurement(
        dict(zip(LAUNCH, map(float, launches[best]), strict=True)),
        settings[best],
        (names[0], names[1]),
        float(separation[best]),
    )


def separations(
    problem: Problem, pair: Sequence[Alternative], points: Sequence[Point], parts: int = 1
) -> Array:
    """Return the separation of two explanations in standard deviations, [part].

    Args:
        problem: of the proposed readings.
        pair: the explanations.
        points: of each, at the same nuisances; the first is not lost.
        parts: equal parts of the rows, such as shots.
    """
    projection = points[0].projection
    assert projection is not None
    clean = projection.out(np.nan_to_num(points[1].residual - points[0].residual))
    clean = clean.reshape(parts, -1)
    square = (clean**2).sum(axis=1)
    for own, point in zip(pair, points, strict=True):
        if find(own.cause.effect).discrete or own.cause not in point.causes:
            continue
        # another amount, given its prior, would explain a part of it
        row = projection.out(problem.slope(point, point.causes.index(own.cause)))
        row = row.reshape(parts, -1)
        known = 1 / max(float(own.fit.covariance[-1, -1]), TINY)
        square -= (row * clean).sum(axis=1) ** 2 / ((row**2).sum(axis=1) + known) / 2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def _candidates(
    ring: Ring, data: Data, rivals: Sequence[Alternative], seed: int
) -> tuple[Array, list[Settings]]:
    """Candidate launches [shot, 5] and settings; no launch starts on the axis."""
    measured = data.launches[data.active]
    launches = [row for row in measured[:2] if np.any(row[:4])]
    try:
        modes = one_turn_optics(Chain.from_ring(ring)).modes
        random = np.random.default_rng([seed, 3])
        size = np.linalg.norm(measured[:, :4] / np.abs(modes).max(axis=1), axis=1).mean()
        size = size or AMPLITUDE / float(np.abs(modes[[0, 2]]).max())
        for scale in (1.0, 2.0):
            for _ in range(PHASES):
                turn = np.exp(2j * np.pi * random.uniform(size=2))
                row = np.zeros(5)
                row[:4] = scale * size / 2 * np.real(modes @ turn)
                launches.append(row)
    except UnstableRingError:
        pass
    if not launches:
        return np.zeros((0, 5)), []
    usual = launches[0]
    for delta in (1e-3, -1e-3):
        row = usual.copy()
        row[4] += delta
        launches.append(row)
    settings: list[Settings] = [{} for _ in launches]
    elements = {element.name: element for element in ring.elements}
    for rival in rivals:
        element = elements.get(rival.hypothesis[1] or "")
        if element is None or element.kind not in CHANGES:
            continue
        if element.kind != "quadrupole" or element.k1 != 0:
            launches.append(usual.copy())
            settings.append({element.name: CHANGES[element.kind]})
    return np.array(launches), settings
