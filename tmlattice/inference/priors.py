"""How likely amounts are before the data: one distribution, whose tails are a number.

A fault has an amount of its own (`AmountPrior`); small errors come in groups (`Group`): each has
its own scale, which follows the evidence (EM), and may be shared: an error of a family beside the
errors of its members.

The degree of freedom says how heavy they are: infinite is Gauss, 4 forgives a few large ones, 1 is
Cauchy, and 0 the limit in which every power of ten is as likely, so that the cost of an amount is
that of its relative error, whatever the effect.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln
from scipy.stats import chi2

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


LOG_UNIFORM = AmountPrior()
"""Even in the logarithm: of a fault that may have any size."""


SMALLEST = 1e-9
"""A prior's rms does not fall below."""
SCALE_SPREAD = 2.0
"""rms of the logarithm of a scale about its first guess: a factor of seven."""
MAX_STEP = 1.5
"""Largest step of that logarithm."""
FAULTY_SHARE = 0.01
"""Share of the members of a large group that are faulty: one in a hundred. Of a smaller group one
member is."""
SCALES_PER_DECADE = 4
"""Scales of faulty members in a power of ten, log-uniform."""
CORE = 5
"""Scales that stand for the distribution of sound members."""
SELECTED = 1e-3
"""Share of the largest fault from which on a selected fault has its scale."""
FAULT_FROM = 3.0
"""Times the scale of sound members from which on an amount is a fault."""


@dataclass(frozen=True)
class Group:
    """Parameters with one prior: the base parameters move by `basis` times theirs.

    Attributes:
        name: for people.
        basis: [base parameter, parameter].
        rms: of the prior; where the search for it starts.
        freedom: degree of freedom of Student's distribution; infinite: Gauss'.
        fixed: the scale stays.
        most: largest prior rms that physics allows one parameter.
        each: prior rms of every parameter, as last found; None: `rms`.
        first: rms that was guessed; None: `rms`.
        guessed: rms of the logarithm of the scale about that.
        largest: largest fault of one member, in the unit of the parameters; 0: no member is faulty.
    """

    name: str
    basis: Array
    rms: float
    freedom: float = np.inf
    fixed: bool = False
    most: float = np.inf
    each: Array | None = None
    first: float | None = None
    guessed: float = SCALE_SPREAD
    largest: float = 0.0

    @property
    def guess(self) -> float:
        """The rms that was guessed."""
        return self.rms if self.first is None else self.first

    @property
    def scale(self) -> Array:
        """Prior rms of every parameter."""
        return np.full(self.basis.shape[1], self.rms) if self.each is None else self.each

    def mixture(self) -> tuple[Array, Array]:
        """Prior of one member if any of them may be the faulty one, as a mixture of Gaussians.

        Sound members have the group's own distribution. A faulty one has a scale that is
        log-uniform from there up to the largest fault (West, Biometrika 74 (1987) 646, for such
        mixtures). A group with a fixed scale and a largest fault is one selected fault: another one
        may be there instead of it.

        Returns:
            Probabilities and rms of the components, [component].
        """
        core = np.full(1, self.rms)
        if np.isfinite(self.freedom):
            quantiles = (np.arange(CORE) + 0.5) / CORE
            core = self.rms * np.sqrt(self.freedom / chi2.ppf(quantiles, self.freedom))
        chances = np.full(len(core), 1 / len(core))
        members, least = self.basis.shape[1], FAULT_FROM * self.rms
        faulty = max(1 / max(members, 1), FAULTY_SHARE)
        if self.fixed and self.largest:
            core, least, faulty = np.full(1, SMALLEST), self.largest * SELECTED, FAULTY_SHARE
        elif self.fixed or members < 2 or not least < self.largest:
            return chances, core
        count = int(np.ceil(SCALES_PER_DECADE * np.log10(self.largest / least))) + 1
        chances = np.concatenate([(1 - faulty) * chances, np.full(count, faulty / count)])
        return chances, np.concatenate([core, np.geomspace(least, self.largest, count)])

    def share(self, squares: Array, rms: float) -> Array:
        """By which a parameter of this expected square counts: 1 for Gauss, less in the tails."""
        return rms**2 * Student(rms, self.freedom).precision(np.sqrt(squares))

    def learn(self, squares: Array, left: Array) -> "Group":
        """A scale that is likelier: a step of Fisher's scoring in its logarithm.

        EM's own step is as short as what the data say of a parameter is little: a scale that began
        too small stays there for a hundred rounds, and everything beside it makes up for it. Where
        the data say nothing the scale stays near its first guess.

        Args:
            squares: of the likeliest parameters.
            left: share of each one's prior variance that the data leave.
        """
        if not len(squares):
            return replace(self, each=squares)
        now, rms = self.scale, self.rms
        if not self.fixed:
            known = float(np.sum(1 - left))
            shown = float(np.sum(squares / now**2))
            own = float(np.log(rms / self.guess)) / self.guessed**2
            step = (shown - known - own) / (2 * known + self.guessed**-2)
            rms = rms * float(np.exp(np.clip(step, -MAX_STEP, MAX_STEP)))
            rms = min(max(rms, SMALLEST), self.most)
        each = rms / np.sqrt(self.share(squares + left * now**2, rms))
        return replace(self, rms=rms, each=np.minimum(each, self.most), first=self.guess)
