"""What speaks for a global error: terms with a scale of their own, and when they are believed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Names = tuple[str, ...]

GAIN, CERTAIN = 12.0, 15.0
"""Log evidence from which a global error is told, and from which it is certain: no healthy
measurement of `benchmarks/data_checks.py` gains as much."""
SHARE = 0.65
"""Of all that it changes, how much it has to change for the better: a fault's section may win much
by chance, but then many others lose."""
CLEAR, CLEAR_UNIT, AGAINST = 3.0, 30.0, 10.0
"""Factors by which chi-square of sections or launches falls with what was wrong undone: at least;
with a unit undone; of sections where launches say the contrary. Units are powers of a thousand."""
RIGHT = 5.0
"""Chi-square of launches that are right then."""
FINE, FINE_GAIN = 0.1, 30.0
"""Share of the orbit that sections leave from which they agree anyhow, and log evidence that
curvature, or a few correctors that were set, have to gain then."""


@dataclass(frozen=True)
class Terms:
    """How far the parts of a measurement miss one another, and their freedom.

    Attributes:
        local, joints: mean squares in units of the noise alone, of sections and of where they
            meet; those between turns are joints too.
        freedom: of the sections' terms.
        launch: mean squares of launches, each plane's own, in units of noise and stated rms, by
            the scale of the noise: see `Judge`.
        stated: log of what the stated noise differs by, or 0 where it is not stated; log of the
            orbit over a usual one; each in standard deviations.
        blur: log of how little the readings tell of launches and joints: with next to none of them
            anything agrees.
        level, share: of the sections: see `Found`.
        unit: chi-square per reading of a mean square of 1: of the noise as it is stated, or where
            it is not, as the best assumption leaves it.
    """

    local: Array
    joints: Array
    freedom: NDArray[np.int64]
    launch: Array
    stated: Array
    blur: float
    level: float
    share: float
    unit: float

    def cost(self, square: float) -> Array:
        """Minus the log likelihood of each term, all scales their own, none below the noise's."""
        return np.concatenate([
            self.freedom / 2 * _robust(self.local / square),
            2 * _robust(self.joints / square),
            np.log(np.maximum(self.launch, 1.0)),  # their information differs
            self.stated**2 / 2,
        ])  # fmt: skip


def _robust(misfit: Array) -> Array:
    return np.where(misfit < 1, misfit - 1, np.log(np.maximum(misfit, 1.0)))


@dataclass(frozen=True)
class Verdict:
    """A global error that makes the data far better.

    Attributes:
        names: assumptions, together.
        gain: log evidence.
        before, after: chi-square per reading of the sections, and of the launches (NaN where none
            is stated), [2].
        alike: other assumptions that explain the data as well.
    """

    names: Names
    gain: float
    before: tuple[float, float]
    after: tuple[float, float]
    alike: tuple[Names, ...] = ()


def certain(verdict: Verdict) -> bool:
    """Whether the evidence leaves no doubt."""
    return worth(verdict) > CERTAIN


def worth(verdict: Verdict) -> float:
    """Log evidence; each assumption beyond the first has to be certain by itself."""
    return verdict.gain - CERTAIN * (len(verdict.names) - 1)


def widely(stated: Terms, other: Terms, square: float) -> bool:
    """Whether nearly all of what an assumption changes becomes better."""
    a, b = stated.cost(square), other.cost(square)
    if len(a) != len(b):
        return True
    better, worse = np.maximum(a - b, 0).sum(), np.maximum(b - a, 0).sum()
    return bool(better > SHARE * (better + worse))


def believable(verdict: Verdict, share: float) -> bool:
    """Whether what was wrong is right then, and not only a little less wrong.

    Args:
        verdict: what is believed.
        share: of the orbit that the sections leave as stated.
    """
    (local, launch), (local_then, launch_then) = verdict.before, verdict.after
    local_clears, launch_clears = local / max(local_then, 1e-12), launch / max(launch_then, 1e-12)
    if launch_then > RIGHT and local_clears < AGAINST:  # false where no launch is stated
        return False
    unit = any("-in-" in name for name in verdict.names)
    clear = CLEAR_UNIT if unit else CLEAR
    if local_clears > clear or launch_clears > clear:
        return True
    return share < FINE and not unit and verdict.gain > FINE_GAIN


def levels(terms: Terms) -> tuple[float, float]:
    """Chi-square per reading: of the sections; of the launches, the worse plane."""
    launch = terms.launch.reshape(-1, 2)
    worse = float(np.median(launch, axis=0).max()) if len(launch) else float("nan")
    return terms.unit * terms.level, worse
