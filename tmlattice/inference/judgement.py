"""Every threshold and prior width of a diagnosis, in one place, each with where it comes from.

>>> Judgement(false_alarm=0.001)
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


def _shares() -> Mapping[str, float]:
    return {"named": 0.6, "kick": 0.2, "monitor": 0.1, "reading": 0.1}


@dataclass(frozen=True)
class Judgement:
    """When something is found, how it is named, and how likely what is before the data.

    Attributes:
        false_alarm: share of data sets of pure noise in which anything is found; with the tail
            simulated, 8 of 1000 faultless machines of another engine (challenge E, seed 25).
        shares: how the kinds of findings share the false alarms: most for what has a name.
        mass: probability that a credible set is to hold.
        unknown: prior share of faults that the catalogue does not hold.
        rivals: hypotheses that are refitted at a step; more change no case of challenge A.
        window, drift: log evidence below the linear scan's leader at which no hypothesis is
            refitted any more, and what of the statistic adds to it: the scan errs by a share of it.
        starts: shares of its largest fault from which a curved effect is refitted.
        nearly: a free kick has a parameter a shot, and so takes up some of what another cause does:
            where one with a name explains this share of it, names are tried first once more.
        spikes, spike: single readings left out at most; log probability of one being wrong once.
        same: a slope is good while amount and orbit change by no more than this share.
        silent: where more monitors than this have no signal, they are not there: no finding each.
        alien: a local misfit above this share of the orbit: the data are of another ring.
        noise: chance below which what is left is more than noise: to say so, and to decline.
        retaken: how often small errors are taken again along the orbit of a strong fault.
        rarer: each cause beyond the first is so many times less likely than the one before.
    """

    false_alarm: float = 0.005
    shares: Mapping[str, float] = field(default_factory=_shares)
    mass: float = 0.95
    unknown: float = 0.05
    rivals: int = 24
    window: float = 12.0
    drift: float = 0.03
    starts: tuple[float, ...] = (-1.0, -0.5, -0.2, 0.2, 0.5, 1.0)
    nearly: float = 0.5
    spikes: int = 40
    spike: float = -16.0
    same: float = 0.02
    silent: float = 0.2
    alien: float = 0.35
    noise: tuple[float, float] = (1e-4, 1e-6)
    retaken: int = 2
    rarer: float = 1.0

    def rate(self, kind: str) -> float:
        """False alarms of one kind of finding."""
        return self.false_alarm * self.shares[kind]


DEFAULT = Judgement()
