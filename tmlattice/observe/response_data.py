"""A measured orbit response in the order and units of a ring, and its split.

>>> data = response_data(ring, measured)
>>> data.orbits                                    # [column, monitor, 2]

A column is a corrector, in the order of the measurement, or the RF, which is the last. Block 0 is
the plane in which a column kicks, block 1 the other one.

Whether an RF orbit was measured or computed by a model. A file of a response without a measured
dispersion may contain the design's. In a ring of equal cells that repeats from cell to cell to the
last digit, whereas readings have noise.

The split has readings to fit, to select families, and to validate.

>>> split = split_columns(data, 0.2, np.random.default_rng(0))
>>> split.held.sum()                               # number of held-out correctors
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tmlattice.arrays import INVISIBLE, Array, Flags, Indices, rms
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.inference.judgement import ENOUGH
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.noise import completed

NO_RF = 1e-6
"""Relative RF step for a measurement without one: its orbit is missing."""


@dataclass(frozen=True, eq=False)
class ResponseData:
    """A measured response, its monitors in the ring's order.

    Attributes:
        ring: the design.
        measured: the response.
        at: indices of the monitors among the ring's, [monitor].
        orbits: measured orbit changes, the RF's last, m, [column, monitor, 2].
        kicks: the steps, rad, the RF's relative, [column].
        plane: in which each column kicks, [column].
        noise: rms of a reading, m, [monitor, 2].
        energy: deviation of the beam from the energy of the magnets' settings, relative.
        orbit_kicks: kicks of the closed orbit, rad, see `ResponseModel`, [magnet, 2]; or None.
    """

    ring: Ring
    measured: OrbitResponse
    at: Indices
    orbits: Array
    kicks: Array
    plane: Indices
    noise: Array
    energy: float = 0.0
    orbit_kicks: Array | None = None

    @property
    def energy_of_rf(self) -> float:
        """Relative energy change of the RF's step in the design."""
        return float(self.kicks[-1] * self.design.rf_start[5])

    @cached_property
    def design(self) -> ResponseModel:
        """Model of the design; UnstableRingError without a closed orbit."""
        if self.orbit_kicks is None:
            model = ResponseModel.of(self.ring)
        else:
            model = ResponseModel(self.ring, orbit_kicks=self.orbit_kicks)
        return model.at_energy(self.energy) if self.energy else model

    @cached_property
    def bent(self) -> Array | float:
        """Third order of the steps in the design, m, [column, monitor, 2]; 0 if no beam is stored
        with each."""
        try:
            return third_order(self.design, self.measured.correctors, self.kicks[:-1], self.at)
        except UnstableRingError:
            return 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of columns and monitors."""
        return self.orbits.shape[0], self.orbits.shape[1]

    def plane_of(self, block: int) -> Indices:
        """The plane in which each column is read, [column]."""
        return self.plane if block == 0 else 1 - self.plane

    def pick(self, values: Array, block: int = 0) -> Array:
        """Values [column, monitor, 2] in one plane for each column, [column, monitor]."""
        plane = self.plane_of(block)[:, None, None]
        return np.asarray(np.take_along_axis(values, plane, 2)[..., 0])

    def noise_of(self, block: int) -> Array:
        """Noise rms of each reading, m, [column, monitor]."""
        return np.asarray(self.noise[:, self.plane_of(block)].T)


def third_order(
    model: ResponseModel, correctors: Sequence[str], kicks: Array, at: Indices
) -> Array:
    """Return the third order of two-sided steps of correctors, m, [column, monitor, 2]; 0 in the
    last column, the RF's.

    Args:
        model: of the ring.
        correctors: their names.
        kicks: the whole steps, rad, [corrector].
        at: indices of the monitors.

    Raises:
        UnstableRingError: no beam is stored with a step.
    """
    sides = np.concatenate([side * kicks for side in (1 / 2, -1 / 2, 1 / 4, -1 / 4)])
    orbits = model.closed_orbits([*correctors] * 4, sides)[:, at]
    up, down, half_up, half_down = np.split(orbits, 4)
    # the linear part of both cancels: sextupoles on a large orbit have more of it than maps
    third = (up - down - 2 * (half_up - half_down)) / (1 - 1 / 4)
    return np.concatenate([third, np.zeros((1, *third.shape[1:]))])


def response_data(ring: Ring, measured: OrbitResponse) -> ResponseData:
    """Return a measured response in the ring's order.

    Without an RF step, or with an RF orbit that was not measured (`read`), its column is
    empty, and only priors separate the scales of correctors and monitors. Unstated noise is
    estimated, see `noise.completed`.

    Raises:
        MeasurementError: no noise, and too few readings to estimate it.
        UnknownNameError: a monitor that is not in the ring.
    """
    names = [monitor.name for monitor in ring.monitors]
    known = {ring[name].name: name for name in measured.monitors}
    measured = measured.select(monitors=[known[name] for name in names if name in known])
    rf = measured.rf
    if rf is not None and not read(measured):
        rf = replace(rf, orbit=None)
        measured = replace(measured, rf=rf)
    if rf is None or rf.orbit is None or rf.step == 0:
        step, orbit = NO_RF, np.full((len(measured.monitors), 2), np.nan)
    else:
        step, orbit = rf.step / rf.frequency, rf.orbit
    measured = _without_blanks(measured)
    order = {name: i for i, name in enumerate(names)}
    data = ResponseData(
        ring=ring,
        measured=measured,
        at=np.array([order[ring[name].name] for name in measured.monitors]),
        orbits=np.concatenate([measured.response, orbit[None]]),
        kicks=np.append(measured.kicks, step),
        plane=np.append([int(p == "y") for p in measured.planes], 0),
        noise=completed(ring, measured),
    )
    if rf is not None and np.isfinite(orbit[:, 0]).any() and _computed(data):
        return response_data(ring, replace(measured, rf=replace(rf, orbit=None)))
    return data


def _without_blanks(measured: OrbitResponse) -> OrbitResponse:
    """Drop the other plane's readings if all of them are 0: they were not measured."""
    response = measured.response
    for p, plane in enumerate("xy"):
        rows = np.array([own == plane for own in measured.planes])
        across = response[rows, :, 1 - p]
        if across.size and not np.nan_to_num(across).any():
            response = response.copy()
            response[rows, :, 1 - p] = np.nan
    return measured if response is measured.response else replace(measured, response=response)


MAX_DISTINCT, MIN_DISTINCT = 0.5, 0.75
"""Share of distinct numbers: at most, in a computed orbit; at least, in the correctors' orbits,
which have the same number of digits."""
MAX_MISFIT = 0.05
"""rms misfit over noise that no measured orbit reaches."""


def read(measured: OrbitResponse) -> bool:
    """Whether an orbit of an RF step was measured: the numbers of a computed one may repeat."""
    if measured.rf is None or measured.rf.orbit is None:
        return False
    orbit = measured.rf.orbit[:, 0]
    in_x = [plane == "x" for plane in measured.planes]
    columns = [_differ(own) for own in measured.response[in_x, :, 0]]
    if np.isfinite(orbit).sum() < ENOUGH or not columns:
        return True
    return _differ(orbit) > MAX_DISTINCT or bool(np.median(columns) < MIN_DISTINCT)


def _computed(data: ResponseData) -> bool:
    """Whether the RF's orbit is the design's: nearer to it than readings are to the truth."""
    try:
        design = data.design.rf_change(data.kicks[-1])[data.at]
    except UnstableRingError:
        return False
    apart = (data.orbits[-1] - design)[:, 0] / data.noise[:, 0]
    apart = apart[np.isfinite(apart)]
    return len(apart) >= ENOUGH and rms(apart) < MAX_MISFIT


def _differ(read: Array) -> float:
    """Share of numbers that differ from all others."""
    there = np.sort(read[np.isfinite(read)])
    if not len(there):
        return 0.0
    apart = np.diff(there) > INVISIBLE * np.abs(there).max()
    return float(1 + apart.sum()) / len(there)


HELD = 0.2
"""Share of the correctors that validate."""


@dataclass(frozen=True, eq=False)
class Split:
    """Fitted and validating readings.

    Attributes:
        held: held-out correctors, [column].
        half: monitors that determine a corrector's kick, or fit the RF, [column, monitor].
    """

    held: Flags
    half: Flags


def split_columns(data: ResponseData, holdout: float, rng: np.random.Generator) -> Split:
    """Draw a split of the correctors that are read in the plane of their kick.

    Raises:
        MeasurementError: too few correctors.
    """
    columns, monitors = data.shape
    read = np.asarray(np.isfinite(data.pick(data.orbits)[:-1]).any(axis=1))
    some = int(read.sum())
    count = round(holdout * some)
    if not 0 < count < some - 1:
        raise MeasurementError(
            f"{some} correctors that are read in the plane of their kick cannot be split; "
            "measure more"
        )
    held = np.zeros(columns, dtype=bool)
    drawn = rng.permutation(columns - 1)
    drawn = drawn[np.argsort(~read[drawn], kind="stable")]  # others validate nothing
    plane = data.plane[drawn]
    alone = [np.flatnonzero(read[drawn] & (plane == p))[-1] for p in set(plane[read[drawn]])]
    drawn = np.append(np.delete(drawn, alone), drawn[alone])  # each plane has one in the fit
    held[drawn[:count]] = True
    half = np.zeros((columns, monitors), dtype=bool)
    for own in half:  # one of each two neighbours: either half covers the whole ring
        own[np.arange(0, monitors - 1, 2) + rng.integers(2, size=monitors // 2)] = True
    return Split(held, half)
