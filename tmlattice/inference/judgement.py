"""Thresholds and prior widths of a diagnosis, each with its derivation.

>>> Judgement(false_alarm=0.001)
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from tmlattice.inference.chi2 import MAD

SIGNIFICANT = 5.0
"""Standard deviations above which one amount, reading or channel is significant wherever it was
found: Gaussian noise exceeds them once in two million. Its square is a chi-square."""
GROSS = 20.0
"""The same above which no error of a ring has the effect, whatever the scatter of the others."""
FEW, ENOUGH = 4, 8
"""Values without which nothing is compared with a typical one, and whose median is known to half of
their scatter."""
OUTLIERS, WRONG = 0.1, 0.25
"""Shares of the readings that may be outliers, and of the channels or steps that may be wrong: of
more of them the model is."""
MISSTATED = 3.0
"""Ratio of a stated to a measured size, or its inverse, above which the stated one is wrong."""
BEYOND = 1.5
"""Ratio to the largest fault above which an amount is implausible."""


@dataclass(frozen=True)
class Judgement:
    """Thresholds of significance, and prior probabilities.

    Attributes:
        false_alarm: share of data sets of pure noise with any finding; with the tail simulated, 8
            of 1000 faultless machines of another engine (challenge E, seed 25).
        shares: share of the false alarms by kind of finding, most for effects of the catalogue.
        mass: coverage of credible sets.
        unknown: prior share of faults outside the catalogue.
        alternatives: hypotheses refitted at a step; more change no case of challenge A.
        window, drift: log evidence below the leader of the linear scan at which no hypothesis is
            refitted, and the share of the statistic added to it, as the scan errs by a share.
        starts: shares of a curved effect's largest fault from which it is refitted.
        most_outliers: single readings rejected at most.
        same: largest relative change of amount and orbit with which a slope is reused.
        silent: share of BPMs without signal above which they are taken as not installed.
        noise: p-values of the residual for a warning, and for no verdict.
        sparse: median misfit between neighbouring BPMs, in units of the noise, up to which faults
            may be sparse: there errors between neighbours are as large as the noise, which alone
            makes 0.674, the median of |N(0, 1)|.
        rarer: factor by which each cause beyond the first is less probable than the one before.
    """

    false_alarm: float = 0.005
    shares: Mapping[str, float] = field(
        default_factory=lambda: {"named": 0.6, "kick": 0.2, "monitor": 0.1, "reading": 0.1}
    )
    mass: float = 0.95
    unknown: float = 0.05
    alternatives: int = 24
    window: float = 12.0
    drift: float = 0.03
    starts: tuple[float, ...] = (-1.0, -0.5, -0.2, 0.2, 0.5, 1.0)
    most_outliers: int = 40
    same: float = 0.02
    silent: float = 0.2
    noise: tuple[float, float] = (1e-4, 1e-6)
    sparse: float = math.sqrt(2) / MAD
    rarer: float = 1.0

    @property
    def log_odds(self) -> float:
        """Log Bayes factor that a hypothesis without a significance of its own has to reach.

        Under the simpler hypothesis a Bayes factor exceeds 1 / p with a probability of p at most
        (Markov's inequality).
        """
        return -math.log(self.false_alarm)

    @property
    def behind(self) -> float:
        """Log evidence behind the best by which an alternative is in no credible set."""
        return -math.log(1 - self.mass)

    def outlier_prior(self, readings: int) -> float:
        """Log probability that one of these readings is an outlier: one in a data set at the rate
        of its false alarms, without another source."""
        return math.log(self.rate("reading") / max(readings, 1))

    def rate(self, kind: str) -> float:
        """False-alarm probability of one kind of finding."""
        return self.false_alarm * self.shares[kind]


DEFAULT = Judgement()
