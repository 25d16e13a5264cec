"""A measurement as inference sees it: rows, their derivatives, and priors.

A kind of measurement (see `observe`) is a `Problem`. At given causes it gives the residual of its
readings in units of their noise, and the derivatives by causes and by its own nuisances (such as
launches). Fit, scan and search use nothing else.

A scan needs only the squares of signatures and their products with data. A kind of measurement
gives the signatures (`rows`), and may have faster ways for some of them (`quick`).
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from tmlattice.arrays import AT_ONCE, Array, Flags, Indices
from tmlattice.effects import Cause, Hypothesis, ReadingEffect, RingEffect, find
from tmlattice.inference.judgement import DEFAULT, Judgement
from tmlattice.inference.priors import LOG_UNIFORM, AmountPrior
from tmlattice.inference.whitening import Projection, Root


def effects_on_ring(hypotheses: Sequence[Hypothesis]) -> Indices:
    """Indices of the errors of the ring."""
    return np.flatnonzero([isinstance(find(name), RingEffect) for name, _ in hypotheses])


def effects_on_readings(
    hypotheses: Sequence[Hypothesis], monitors: Sequence[str]
) -> Iterator[tuple[ReadingEffect, Indices, Indices]]:
    """Yield each effect on readings, the indices of its hypotheses at these monitors, and those of
    the monitors."""
    index: dict[str | None, int] = {name: i for i, name in enumerate(monitors)}
    found: dict[ReadingEffect, list[tuple[int, int]]] = {}
    for i, (name, place) in enumerate(hypotheses):
        effect = find(name)
        if isinstance(effect, ReadingEffect) and place in index:
            found.setdefault(effect, []).append((i, index[place]))
    for effect, own in found.items():
        which, at = np.array(own).T
        yield effect, which, at


@dataclass(frozen=True)
class Products:
    """Products of signatures [hypothesis] with themselves and with rows of data.

    Attributes:
        whole: square, [hypothesis].
        inside: its part along the nuisances' directions, [hypothesis].
        inner: with the data, [hypothesis, data].
    """

    whole: Array
    inside: Array
    inner: Array

    @classmethod
    def empty(cls, hypotheses: int, data: int) -> "Products":
        """Return zeros."""
        return cls(np.zeros(hypotheses), np.zeros(hypotheses), np.zeros((hypotheses, data)))

    def put(self, at: Indices, whole: Array, inside: Array | float, inner: Array) -> None:
        """Set the products of some hypotheses."""
        self.whole[at], self.inside[at], self.inner[at] = whole, inside, inner


class Metric:
    """Products at one point; this class forms every signature.

    Args:
        projection: of the nuisances.

    Attributes:
        chunk: hypotheses at a time, which bounds the memory of a scan.
    """

    def __init__(self, projection: Projection) -> None:
        self.projection = projection
        self.chunk = max(AT_ONCE // max(projection.rows, 1), 1)

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Whitened signatures, d rows / d amount ** power, [hypothesis, row]; of a discrete effect
        its change of the rows."""
        raise NotImplementedError

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products that need no signature; return the indices of their hypotheses."""
        return np.zeros(0, dtype=np.intp)

    def products(self, hypotheses: Sequence[Hypothesis], data: Array) -> Products:
        """Return products of each hypothesis with itself and with data [data, row]."""
        found = Products.empty(len(hypotheses), len(data))
        rest = np.ones(len(hypotheses), dtype=bool)
        rest[self.quick(hypotheses, data, found)] = False
        left = np.flatnonzero(rest)
        for start in range(0, len(left), self.chunk):
            part = left[start : start + self.chunk]
            rows = self.rows([hypotheses[i] for i in part])
            whole = np.einsum("hr,hr->h", rows, rows)
            found.put(part, whole, self.projection.inside(rows), rows @ data.T)
        return found

    def pieces(self, hypotheses: Sequence[Hypothesis]) -> Iterator[tuple[Indices, Array]]:
        """Yield every signature, some rows of all hypotheses at a time; here all rows at once.

        Yields:
            Indices of rows, [row], and the signatures there, [hypothesis, row].
        """
        some = [
            self.rows(hypotheses[start : start + self.chunk])
            for start in range(0, len(hypotheses), self.chunk)
        ]
        if some:
            rows = np.concatenate(some)
            yield np.arange(rows.shape[1]), rows

    def free_kicks(self, places: Indices, clean: Array) -> tuple[Array, Array]:
        """Information of free kicks at places, and their product with data.

        Returns:
            [place, block, p, p] and [place, block, p]; parameters of different blocks are
            independent.
        """
        raise NotImplementedError

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information of all readings of each monitor, and their product with data."""
        raise NotImplementedError


Kicks = Mapping[int, Array]
"""Free kicks: their parameters, by place."""

NO_KICKS: Kicks = {}


@dataclass(frozen=True)
class Point:
    """The model at some causes, free kicks and nuisances.

    Attributes:
        causes, nuisances, kicks: arguments.
        residual: whitened, with the prior rows of the nuisances, [row].
        projection: of the nuisances' directions; None where the model has no solution.
        orbit: what slopes depend on, except the amounts.
        view: the problem's own data of the point.
        lost: why the model has no solution; empty if it has one.
    """

    causes: tuple[Cause, ...]
    nuisances: Array
    kicks: Kicks
    residual: Array = field(repr=False)
    projection: Projection | None = field(repr=False)
    orbit: Array = field(repr=False)
    view: Any = field(repr=False)
    lost: str = ""

    @property
    def chi2(self) -> float:
        """Chi-square of the rows; infinite where the model has no solution."""
        return np.inf if self.projection is None else float(self.residual @ self.residual)


@dataclass(frozen=True, kw_only=True)
class Problem(ABC):
    """Model and data of a search.

    Attributes:
        places: number of places of each effect, for the prior.
        rare: hypotheses that are less probable than others of their effect, and the factor.
        fixed: causes that are present and not fitted.
        amounts: prior of an amount.
        judgement: thresholds.
    """

    places: Mapping[str, float]
    rare: Mapping[Hypothesis, float] = field(default_factory=dict, repr=False)
    fixed: tuple[Cause, ...] = ()
    amounts: AmountPrior = LOG_UNIFORM
    judgement: Judgement = DEFAULT

    def prior(self, hypothesis: Hypothesis) -> float:
        """Log prior probability of one effect at one place."""
        count = len(self.places) * self.places.get(hypothesis[0], 1)
        odds = self.rare.get(hypothesis, 1.0)
        return float(np.log((1 - self.judgement.unknown) * odds / count))

    def unknown_prior(self, places: int) -> float:
        """Log prior probability of an unknown fault at one of `places`."""
        return float(np.log(self.judgement.unknown / 2 / places))

    # --- the model ------------------------------------------------------------------------------
    @property
    @abstractmethod
    def first(self) -> Array:
        """First guess of the nuisances."""

    @property
    def free(self) -> int:
        """Number of coordinates of the projection."""
        return int(np.size(self.first))

    @property
    def freedom(self) -> int:
        """Degrees of freedom: readings and prior rows less nuisances."""
        return int(self.valid.sum()) - self.free

    @property
    def alone(self) -> bool:
        """Whether the causes sought act on all readings, so that none is a reference."""
        return True

    @property
    def log_scale(self) -> float:
        """Log density of the rows at their peak, relative to the readings' noise alone."""
        return 0.0

    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether the model has this cause; its signature is zero otherwise."""
        return True

    def everywhere(self) -> "Problem":
        """Return the problem with causes that act in all measurements, references included."""
        return self

    def with_fixed(self, causes: Sequence[Cause]) -> Self:
        """Return the problem with further fixed causes; a kind may build them into its model."""
        return replace(self, fixed=(*self.fixed, *causes))

    def near(self, causes: Sequence[Cause]) -> Self:
        """Return the problem with corrections of the model that are computed once computed at these
        causes; here there are none."""
        return self

    @abstractmethod
    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Return the model's point."""

    @abstractmethod
    def slope(self, point: Point, cause: int) -> Array:
        """d rows / d amount of one of the point's causes, [row]."""

    @abstractmethod
    def moved(self, nuisances: Array, change: Array) -> Array:
        """Return the nuisances moved by the projection's coordinates."""

    @abstractmethod
    def metric(self, point: Point) -> Metric:
        """Return products of signatures at a point."""

    def certainty(self, point: Point, hypothesis: Hypothesis) -> float:
        """Degrees of freedom of the variance of readings along a hypothesis; infinite if it was
        not estimated from them."""
        return np.inf

    def metric_among(
        self, point: Point, root: Root, rows: slice, projection: Projection
    ) -> Metric | None:
        """Return the products given distributed errors, if the kind has a fast way to form them.

        Args:
            point: of this problem.
            root: whitens its rows, perhaps with those of other measurements.
            rows: its own among these.
            projection: of the nuisances, in white rows.
        """
        return None

    @abstractmethod
    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return hypotheses between the same monitors."""

    # --- what has no name -----------------------------------------------------------------------
    @property
    def kick_places(self) -> Sequence[str]:
        """Places of free kicks; empty where a kind has none, as for a stored beam."""
        return ()

    def kick_rows(self, point: Point, place: int) -> Array:
        """d rows / d parameters of a free kick, [parameter, row]."""
        raise NotImplementedError("this kind of measurement has no free kick")

    @property
    @abstractmethod
    def monitors(self) -> Sequence[str]:
        """Monitors whose readings may be rejected."""

    # --- readings -------------------------------------------------------------------------------
    @property
    @abstractmethod
    def valid(self) -> Flags:
        """Valid readings, of the kind's own shape."""

    @abstractmethod
    def owner(self) -> Indices:
        """Monitor of each reading, of the shape of `valid`."""

    def way(self) -> Array:
        """Share of the beam's way that each reading sees, of the shape of `valid`; 0: all."""
        return np.zeros(self.valid.shape)

    @abstractmethod
    def as_rows(self, readings: Array) -> Array:
        """Whitened rows [..., row] of readings or their changes [..., *shape of `valid`]."""

    def noise_rows(self) -> list[Flags]:
        """Return the rows of each noise that may be a guess, [row] each; empty: noise is known."""
        return []

    def noisier(self, factors: Array) -> Self:
        """Return the problem with the noise of each such part multiplied."""
        return self

    def disagreement(self, point: Point) -> float:
        """Return the median misfit between neighbouring monitors in units of the noise; 0 where the
        kind has no estimate."""
        return 0.0

    @abstractmethod
    def left(self, point: Point) -> tuple[Array, Array]:
        """Residual of each reading over its noise, nuisances projected out, and its variance, both
        of the shape of `valid`."""

    @abstractmethod
    def without(self, dropped: Flags) -> "Problem":
        """Return the problem without some readings."""
