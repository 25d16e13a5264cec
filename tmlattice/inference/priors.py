"""Priors of amounts: one distribution whose degrees of freedom set its tails.

A fault has an amount of its own (`AmountPrior`). Distributed errors come in groups (`Group`), each
with a scale that follows the evidence (EM); a family may have an error in common with its members.

The tails: infinite degrees of freedom are Gauss, 4 admits a few large errors, 1 is Cauchy, and 0 is
the log-uniform limit, in which the cost of an amount is that of its relative error.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from tmlattice.arrays import Array
from tmlattice.effects import Cause, find
from tmlattice.inference import chi2


@dataclass(frozen=True)
class Student:
    """Student's distribution with zero mean.

    Attributes:
        width: in the unit of the amounts.
        freedom: degrees of freedom, above 0; infinite: Gauss.
    """

    width: float
    freedom: float

    def penalty(self, amounts: ArrayLike) -> Array:
        """Negative log density less that at zero."""
        squares = np.square(np.asarray(amounts, dtype=float) / self.width)
        if np.isinf(self.freedom):
            return np.asarray(0.5 * squares)
        return np.asarray((self.freedom + 1) / 2 * np.log1p(squares / self.freedom))

    def precision(self, amounts: ArrayLike) -> Array:
        """Precision of the Gaussian that touches the density from below at these amounts."""
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


DECADES = 4.0
"""Powers of ten of a log-uniform amount."""


@dataclass(frozen=True)
class AmountPrior:
    """Prior of the amount of one fault.

    Attributes:
        tails: its distribution; None: log-uniform in |amount| over `DECADES` up to the largest
            fault, thin beyond it.
        bound: largest possible amount.
    """

    tails: Student | None = None
    bound: float = np.inf

    def log_density(self, cause: Cause) -> float:
        """Log density of the amount; 0 for a discrete effect."""
        effect = find(cause.effect)
        if effect.discrete:
            return 0.0
        size = abs(cause.amount)
        if size > self.bound:
            return -np.inf
        if self.tails is not None:
            return self.tails.peak - float(self.tails.penalty(size))
        size = max(size, 1e-300)
        density = -np.log(2 * size * DECADES * np.log(10))
        return float(density - 8 * max(np.log(size / effect.largest), 0.0))

    def precision(self, cause: Cause) -> float:
        """Prior precision at the amount; 0 for a log-uniform prior."""
        if self.tails is None or find(cause.effect).discrete:
            return 0.0
        return float(self.tails.precision(cause.amount))


LOG_UNIFORM = AmountPrior()
"""Log-uniform prior of a fault."""


SMALLEST = 1e-9
"""Smallest rms of a prior."""
SCALE_SPREAD = 2.0
"""rms of the log of a scale relative to its first guess: a factor of seven."""
MAX_STEP = 1.5
"""Largest step of a log scale."""
FAULTY_SHARE = 0.01
"""Share of faulty members in a large group; in a smaller group one member is faulty."""
SCALES_PER_DECADE = 4
"""Scales of faulty members per decade, log-uniform."""
CORE = 5
"""Mixture components for the distribution of sound members."""
SELECTED = 1e-3
"""Smallest scale of a selected fault, as a share of its largest amount."""
FAULT_FROM = 3.0
"""Smallest scale of a faulty member over that of sound members."""


@dataclass(frozen=True)
class Group:
    """Parameters with one prior: the base parameters move by `basis` times theirs.

    Attributes:
        name: for reports.
        basis: [base parameter, parameter].
        rms: prior scale; where its estimate starts.
        freedom: degrees of freedom of Student's distribution; infinite: Gauss.
        fixed: the scale is not estimated.
        most: largest possible prior rms of one parameter.
        each: prior rms of every parameter, as last estimated; None: `rms`.
        first: guessed rms; None: `rms`.
        guessed: rms of the log scale relative to that guess.
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
        """Guessed rms."""
        return self.rms if self.first is None else self.first

    @property
    def scale(self) -> Array:
        """Prior rms of every parameter."""
        return np.full(self.basis.shape[1], self.rms) if self.each is None else self.each

    def mixture(self) -> tuple[Array, Array]:
        """Prior of one member, any of which may be faulty, as a mixture of Gaussians.

        Sound members have the group's distribution. A faulty one has a log-uniform scale from there
        up to the largest fault (West, Biometrika 74 (1987) 646, for such mixtures). A group with a
        fixed scale and a largest fault is one selected fault, in whose place may be another.

        Returns:
            Probabilities and rms of the components, [component].
        """
        core = np.full(1, self.rms)
        if np.isfinite(self.freedom):
            quantiles = (np.arange(CORE) + 0.5) / CORE
            core = self.rms * np.sqrt(self.freedom / chi2.isf(1 - quantiles, self.freedom))
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

    def learn(self, squares: Array, left: Array) -> "Group":
        """Return the group after a Fisher-scoring step of its log scale.

        EM's step is small if the data hardly determine a parameter: a scale that starts too small
        stays there for a hundred rounds. Without data the scale stays near its first guess.

        Args:
            squares: of the most probable parameters.
            left: share of each prior variance that the data leave.
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
        expected = np.sqrt(squares + left * now**2)
        share = rms**2 * Student(rms, self.freedom).precision(expected)  # less than 1 in the tails
        each = rms / np.sqrt(share)
        return replace(self, rms=rms, each=np.minimum(each, self.most), first=self.guess)
