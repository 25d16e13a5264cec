"""A measurement as an inference sees it: rows, what moves them, and what is likely beforehand.

A kind of measurement (see `observe`) is a `Problem`: at given causes it says what is left of its
readings in units of their noise, how that depends on its own nuisances (launches, say), and what a
little more of a cause would do. Fit, scan and search know no more of it.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause
from tmlattice.inference.judgement import DEFAULT, Judgement
from tmlattice.inference.metric import Metric
from tmlattice.inference.priors import LOG_UNIFORM, AmountPrior
from tmlattice.inference.root import Root
from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Hypothesis = tuple[str, str | None]
"""An effect and the place where it might sit."""

Kicks = Mapping[int, Array]
"""Something without a name: its parameters, by place."""

NO_KICKS: Kicks = {}


@dataclass(frozen=True)
class Point:
    """The model at some causes, free kicks and nuisances.

    Attributes:
        causes, nuisances, kicks: where it is.
        residual: what is left, whitened, with the rows of what is known of the nuisances, [row].
        projection: of the nuisances' directions; None where the model has no answer.
        orbit: what slopes depend on beside their amount.
        view: the problem's own picture of the point.
        lost: why the model has no answer, in words; empty where it has one.
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
        """Of the rows; infinite where the model has no answer."""
        return np.inf if self.projection is None else float(self.residual @ self.residual)


@dataclass(frozen=True, kw_only=True)
class Problem(ABC):
    """What a search needs and does not change.

    Attributes:
        places: number of places of each effect, for the prior.
        rare: hypotheses that are less likely than others of their kind, and by which factor.
        fixed: causes that are there and are not fitted.
        amounts: prior of an amount.
        judgement: thresholds.
    """

    places: Mapping[str, float]
    rare: Mapping[Hypothesis, float] = field(default_factory=dict, repr=False)
    fixed: tuple[Cause, ...] = ()
    amounts: AmountPrior = LOG_UNIFORM
    judgement: Judgement = DEFAULT

    def prior(self, hypothesis: Hypothesis) -> float:
        """Log probability of one effect at one place, before the data."""
        count = len(self.places) * self.places.get(hypothesis[0], 1)
        odds = self.rare.get(hypothesis, 1.0)
        return float(np.log((1 - self.judgement.unknown) * odds / count))

    def unknown_prior(self, places: int) -> float:
        """The same for something unknown at one of so many places."""
        return float(np.log(self.judgement.unknown / 2 / places))

    # --- the model ------------------------------------------------------------------------------
    @property
    @abstractmethod
    def first(self) -> Array:
        """A first guess of the nuisances."""

    @property
    def free(self) -> int:
        """Number of coordinates of the projection."""
        return int(np.size(self.first))

    @property
    def freedom(self) -> int:
        """Readings, and what is known of nuisances, less the nuisances."""
        return int(self.valid.sum()) - self.free

    @property
    def alone(self) -> bool:
        """Whether what is sought acts on all readings: there is no reference among them."""
        return True

    def reference(self, nuisances: Array) -> "tuple[Problem | None, Array]":
        """Return the part without what is sought, and its nuisances; None: there is none."""
        return None, nuisances

    @property
    def log_scale(self) -> float:
        """Log density of the rows at their peak, over that of the readings' noise alone."""
        return 0.0

    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether the kind knows what such a cause would do: of another one it reads nothing."""
        return True

    def everywhere(self) -> "Problem":
        """The same with causes that act in all of its measurements, those of a reference too."""
        return self

    def with_fixed(self, causes: Sequence[Cause]) -> Self:
        """The same with further fixed causes: the kind may put them into its model once for all."""
        return replace(self, fixed=(*self.fixed, *causes))

    @abstractmethod
    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """The model there."""

    @abstractmethod
    def slope(self, point: Point, cause: int) -> Array:
        """d rows / d amount of one of the point's causes, [row]."""

    @abstractmethod
    def moved(self, nuisances: Array, change: Array) -> Array:
        """Nuisances moved by the projection's coordinates."""

    @abstractmethod
    def metric(self, point: Point) -> Metric:
        """Products of signatures about a point."""

    def certainty(self, point: Point, hypothesis: Hypothesis) -> float:
        """Degrees of freedom with which the variance of readings along a hypothesis is known;
        infinite where nothing of it was learnt from them."""
        return np.inf

    def metric_among(self, point: Point, root: Root, projection: Projection) -> Metric | None:
        """Return the products among distributed errors, if the kind has a fast way to form them.

        Args:
            point: of this problem.
            root: whitens its rows.
            projection: of the nuisances, in white rows.
        """
        return None

    @abstractmethod
    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Those that sit between the same monitors."""

    # --- what has no name -----------------------------------------------------------------------
    @property
    def kick_places(self) -> Sequence[str]:
        """Names of where a free kick may sit; empty where the kind knows none: a stored beam closes
        on itself, and several measurements have no kick in common."""
        return ()

    def kick_rows(self, point: Point, place: int) -> Array:
        """d rows / d parameters of a free kick, [parameter, row]."""
        raise NotImplementedError("this kind of measurement knows no free kick")

    @property
    @abstractmethod
    def monitors(self) -> Sequence[str]:
        """Names of whose readings may be set aside."""

    # --- readings -------------------------------------------------------------------------------
    @property
    @abstractmethod
    def valid(self) -> Flags:
        """Which readings there are, of the kind's own shape."""

    @abstractmethod
    def owner(self) -> NDArray[np.int64]:
        """The monitor of each reading, of the shape of `valid`."""

    @abstractmethod
    def as_rows(self, readings: Array) -> Array:
        """Readings, or changes of them, [..., *shape of `valid`], as whitened rows [..., row]."""

    def noise_rows(self) -> list[Flags]:
        """Return which rows share a noise that may be a guess, [row] each; empty: it is known."""
        return []

    def noisier(self, factors: Array) -> Self:
        """Return the same problem with the noise of each such part multiplied."""
        return self

    def disagreement(self, point: Point) -> float:
        """Return the median misfit between neighbouring monitors in units of the noise; 0 where the
        kind cannot tell."""
        return 0.0

    @abstractmethod
    def left(self, point: Point) -> tuple[Array, Array]:
        """What is left of each reading in its noise, nuisances out; and its own variance there
        (1, but for what the nuisances take), both of the shape of `valid`."""

    @abstractmethod
    def without(self, dropped: Flags) -> "Problem":
        """The same with these readings missing."""
