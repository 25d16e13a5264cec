"""How likely an amount is before the data: one distribution, whose tails are a number.

The degree of freedom says how heavy they are: infinite is Gauss, 4 forgives a few large ones, 1 is
Cauchy, and 0 the limit in which every power of ten is as likely, so that the cost of an amount is
that of its relative error, whatever the effect.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln

from tmlattice.effects import Cause, find

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Student:
    """Student's distribution about zero.

    Attributes:
        width: in the unit of the amounts.
        freedom: degrees of freedom, above 0; infinite: Gauss.
    """

    width: float
    freedom: float

    def penalty(self, amounts: ArrayLike) -> Array:
        """- log density less that at zero."""
        squares = np.square(np.asarray(amounts, dtype=float) / self.width)
        if np.isinf(self.freedom):
            return np.asarray(0.5 * squares)
        return np.asarray((self.freedom + 1) / 2 * np.log1p(squares / self.freedom))

    def precision(self, amounts: ArrayLike) -> Array:
        """Of the Gaussian that touches the distribution from below at the amounts: its pull towards
        zero is this times the amount."""
        squares = np.square(np.asarray(amounts, dtype=float))
        if np.isinf(self.freedom):
            return np.full(squares.shape, self.width**-2.0)
        return np.asarray((self.freedom + 1) / (self.freedom * self.width**2 + squares))

    @property
    def peak(self) -> float:
        """Log density at zero."""
        nu = self.freedom
        if np.isinf(nu):
            return float(-np.log(self.width * np.sqrt(2 * np.pi)))
        shape = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi)
        return float(shape - np.log(self.width))


@dataclass(frozen=True)
class AmountPrior:
    """Of the amount of one fault.

    Attributes:
        tails: its distribution; None: no degree of freedom, even in log |amount|, over `decades` up
            to the largest fault, thin beyond it.
        decades: powers of ten.
        bound: no larger amount is possible.
    """

    tails: Student | None = None
    decades: float = 4.0
    bound: float = np.inf

    def log_density(self, cause: Cause) -> float:
        """Of the amount; 0 for what is there or not."""
        effect = find(cause.effect)
        if effect.discrete:
            return 0.0
        size = abs(cause.amount)
        if size > self.bound:
            return -np.inf
        if self.tails is not None:
            return self.tails.peak - float(self.tails.penalty(size))
        size = max(size, 1e-300)
        density = -np.log(2 * size * self.decades * np.log(10))
        return float(density - 8 * max(np.log(size / effect.largest), 0.0))

    def precision(self, cause: Cause) -> float:
        """Its pull towards zero over the amount; a logarithm has no zero to be pulled to."""
        if self.tails is None or find(cause.effect).discrete:
            return 0.0
        return float(self.tails.precision(cause.amount))


EVEN = AmountPrior()
"""Even in the logarithm: of a fault that may have any size."""
