"""Threading: steering an injected beam until it closes on itself.

The target is the trajectory of a beam that is launched on the axis, at the BPMs on two turns: if it
stays near the axis on both, it is closed.

The estimated ring comes from where the beam was read and lost. Too few readings exist to search for
single faults: all errors are distributed. Their scales have a posterior, a Gaussian of the
logarithms, which the next measurement starts from; the two planes of an error share theirs. A loss
is a reading too: behind the last BPM that read it the beam was beyond the aperture.

>>> estimate = estimate_of_turns(ring, [first, second])     # the second with the kicks after it
>>> correction = correct(estimate, targets=["first_turn"])
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from scipy.special import erfcx

from tmlattice.arrays import TINY, Array
from tmlattice.beam.model import Model
from tmlattice.beam.readouts import APERTURE
from tmlattice.correction.estimate import Estimate
from tmlattice.correction.knobs import KINDS
from tmlattice.correction.targets import TARGETS, THREADING, Weighted
from tmlattice.effects import Cause, Hypothesis, apply, background_rms, find
from tmlattice.inference.distributed import DistributedErrors, families_of, posterior
from tmlattice.inference.variance_components import prior_covariance
from tmlattice.lattice import Element, Ring
from tmlattice.measurement import Measurement
from tmlattice.observe.data import Data, of_measurement
from tmlattice.observe.first_turns import FirstTurns

TURNS = 2
LOST = 0.1
"""m; reading of a lost beam. It is beyond any aperture, so that the first readings outside of one
still show the beam's direction."""
UNREAD = 2
"""Readings at the end of a shot, at least, that a lost beam lacks: one alone may be a dead BPM."""
SURPRISE = 2.0
"""Standard deviations beyond which a loss shows that the scale of the errors along one direction is
too small: five per cent of all losses. It is then the one that makes it this far; the direction
stays uncertain, since the loss may be elsewhere."""
TRUNCATIONS = 50
"""Of the posterior, at most."""


class Trajectory:
    """A beam that is launched on the axis of a ring.

    Attributes:
        values: at the BPMs on `TURNS` turns, m, [reading, plane]; `LOST` where it is lost.
        per_energy: 0: no RF acts on it.
    """

    per_energy = 0.0

    def __init__(self, ring: Ring) -> None:
        self._model = Model(ring, [{}], TURNS)
        paths = self._model.paths(np.zeros((1, 5)))
        beam = paths.beam[0]
        there = paths.states[0, self._model.where][:, [0, 2]]  # by maps that always have a value
        beam = np.where(np.isfinite(beam), beam, there)
        self._alive = np.cumsum(~(np.abs(beam) < LOST).all(axis=1)) == 0
        self._paths = paths
        self.values = np.where(self._alive[:, None], np.nan_to_num(beam), LOST)

    def moved(self, ring: Ring, frequency: float) -> "Trajectory":
        """Return that of a ring with other elements; the RF frequency has no effect."""
        return Trajectory(ring)

    def by_frequency(self) -> Array:
        """Return zeros, [1, reading, plane]."""
        return np.zeros((1, *self.values.shape))

    def derivatives(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Return the change per unit of effects on the ring, up to a loss of the beam, m."""
        found = self._model.signatures(self._paths, list(hypotheses), np.zeros((1, 5)))[:, 0]
        return np.where(self._alive[:, None], np.nan_to_num(found), 0.0)


class Threading(Weighted):
    """The trajectory of a beam that is launched on the axis, as the one target.

    Args:
        goal: for its BPMs.
        tolerance: rms, m; None: the usual one.
    """

    def __init__(self, goal: Ring, tolerance: float | None = None) -> None:
        self.names = (THREADING,)
        self.tolerance = {THREADING: tolerance or TARGETS[THREADING].tolerance}
        places = np.array([monitor.s for monitor in goal.monitors])
        self.s = np.concatenate([places + turn * goal.length for turn in range(TURNS)])

    def determined(self, undetermined: Array) -> "Threading":
        """Return the target whose readings count the less, the less the data determine them.

        Args:
            undetermined: standard deviation of each, m, [reading, plane].
        """
        found = copy(self)
        found.undetermined = undetermined
        return found

    def begin(self, ring: Ring, energy: float) -> Trajectory:
        """Return the trajectory of a ring; the injected beam's energy is the nominal one."""
        return Trajectory(ring)

    def errors(self, values: Array) -> dict[str, Array]:
        """Return errors by target, [reading, plane], m."""
        return {THREADING: values}

    def changes(self, derivatives: Array) -> dict[str, Array]:
        """Return the derivatives of `errors`."""
        return {THREADING: derivatives}


# --- the estimated ring ---------------------------------------------------------------------------
def estimate_of_turns(
    ring: Ring, measurements: Sequence[Measurement], known: DistributedErrors | None = None
) -> Estimate:
    """Return the estimate of first turns, at the kicks of the last shot.

    Args:
        ring: the design.
        measurements: in the order of time, with the kicks in their shots' settings.
        known: posterior of the measurements before, `Estimate.known`; None: there are none.

    Raises:
        UnstableRingError: the model loses the beam before it is read.
        UnknownNameError, MeasurementError: a monitor that the ring does not have, or no reading.
    """
    kicks: dict[str, float] = {}
    for measured in measurements:
        data = of_measurement(ring, measured)
        known = given_losses(ring, _given_readings(ring, data, known), data)
        kicks = {n: own["kick"] for n, own in data.settings[-1].items() if "kick" in own}
    estimate = Estimate(ring, ring, known or DistributedErrors.usual([], {}))
    settings, causes = ring, []
    for name, kick in kicks.items():
        element = ring[name]
        change = (kick - element.angle) * estimate.calibrations.get(element.name, 1.0)
        causes.append(Cause(str(KINDS[element.kind].effect), element.name, change))
        settings = settings.with_elements({ring.index(name): replace(element, angle=kick)})
    return replace(estimate, settings=settings, found=apply(ring, causes))


def _given_readings(ring: Ring, data: Data, known: DistributedErrors | None) -> DistributedErrors:
    """The posterior given the readings: those behind a loss in the model come when it gets there,
    and as many as it explains, since it is too nonlinear far from its linearisation."""
    problem = FirstTurns(model=Model(ring, data.settings, data.turns), data=data, places={})
    usual = background_rms({"all": None})
    seen = [(n, p) for n in usual for p in find(n).places(ring) if problem.sees((n, p))]
    if known is None:
        known = DistributedErrors.usual(seen, usual)
        kinds = [name.removesuffix("_x").removesuffix("_y") for name in families_of(known)[0]]
        known = replace(known, scales=prior_covariance(kinds))
    known = known.extended(seen)
    return posterior(problem, known, partly=True).known


def given_losses(ring: Ring, known: DistributedErrors, data: Data) -> DistributedErrors:
    """Return the posterior given where the beam was lost.

    Of the places between the last BPM that read the beam and the next one, with two planes and two
    sides of the aperture each, the one with the fewest standard deviations is taken, and the
    posterior is that of a Gaussian beyond this threshold. Other losses follow, the most probable
    first, until the mean has all of them.

    Args:
        ring: the design.
        known: posterior given the readings.
        data: the shots; of those with equal settings and last readings, one is used.
    """
    read = np.asarray(data.valid.any(axis=2))  # [shot, reading]
    end = read.shape[1] - read[:, ::-1].argmax(axis=1)  # the first reading behind the last one
    shots = [
        i for i in np.flatnonzero(read.any(axis=1) & (end <= read.shape[1] - UNREAD))
        if not any(end[k] == end[i] and data.settings[k] == data.settings[i] for k in range(i))
    ]  # fmt: skip
    if not shots:
        return known
    estimate = Estimate(ring, ring, known)
    probed, behind = _probed(estimate.ring)
    model = Model(probed, [data.settings[i] for i in shots], data.turns)
    launches = data.launches[shots]
    paths = model.paths(launches)
    places = paths.states[:, model.where][..., [0, 2]]  # [shot, reading, plane]
    slopes = np.nan_to_num(model.signatures(paths, list(estimate.hypotheses), launches))
    every = np.add.outer(np.arange(data.turns) * len(probed.monitors), behind).ravel()
    losses = []
    for shot, first in enumerate(end[shots].tolist()):
        some = np.arange(every[first - 1], every[first])
        own = slopes[:, shot, some].reshape(len(slopes), -1)
        losses.append((places[shot, some].ravel(), estimate.independent(own)))
    for _ in range(TRUNCATIONS):
        nearest = []
        for at, own in losses:
            inside = (np.abs(at) < APERTURE).all()  # false for a beam that overflows
            sigma = np.linalg.norm(own, axis=0)
            distance = (APERTURE - np.abs(at)) / np.maximum(sigma, TINY)
            k = int(np.argmin(distance))
            if inside and sigma[k]:
                nearest.append((float(distance[k]), np.sign(at[k]) or 1.0, own[:, k] / sigma[k]))
        if not nearest:
            break
        distance, side, direction = min(nearest, key=lambda one: one[0])
        scale = max(distance / SURPRISE, 1.0)
        z = distance / scale
        mean = float(np.sqrt(2 / np.pi) / erfcx(z / np.sqrt(2)))  # of a Gaussian beyond z
        share = max(1 - scale**2 * (1 + z * mean - mean**2), 0.0)
        step = side * scale * mean * direction
        left = 1 - np.sqrt(1 - share)
        losses = [(at + step @ own, own - left * np.outer(direction, direction @ own))
                  for at, own in losses]  # fmt: skip
        known = known.updated(known.amounts_at(step), np.array([share]), direction[None])
    return known


def _probed(ring: Ring) -> tuple[Ring, list[int]]:
    """The ring with BPMs behind its magnets too, and the first of them behind each of its own."""
    elements: list[Element] = []
    behind, count = list[int](), 0
    for element in ring.elements:
        elements.append(element)
        if element.kind == "monitor":
            behind.append(count := count + 1)
        elif element.is_magnet and element.length:
            end = element.s + element.length / 2
            elements.append(replace(ring.monitors[0], name=f"behind {element.name}", s=end))
            count += 1
    return replace(ring, elements=tuple(elements)), behind
