"""Evidence for a global error: terms with a scale of their own, and thresholds."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Names = tuple[str, ...]

GAIN, CERTAIN = 12.0, 15.0
"""Log evidence above which a global error is reported, and above which it is certain: no healthy
measurement of `benchmarks/data_checks.py` gains as much."""
SHARE = 0.65
"""Share of all changed terms that an assumption must improve: the section of a fault may gain much
by chance, but then many others lose."""
CLEAR, CLEAR_UNIT, AGAINST = 3.0, 30.0, 10.0
"""Factors by which chi-square must fall: of sections or launches, at least; with a unit corrected;
and of sections where launches contradict. Units are powers of a thousand."""
RIGHT = 5.0
"""Chi-square of correct launches."""
FINE, FINE_GAIN = 0.1, 30.0
"""Share of the orbit below which sections agree in any case, and log evidence that curvature, or a
few corrector settings, must then gain."""


@dataclass(frozen=True)
class Terms:
    """Mismatches between the parts of a measurement, and their degrees of freedom.

    Attributes:
        local, joints: mean squares in units of the noise, within sections and where they meet;
            those between turns are joints too.
        freedom: of the sections' terms.
        launch: mean squares of launches by plane, in units of noise and stated rms, by the scale of
            the noise: see `GlobalErrors`.
        stated: log of the stated noise over the estimated one, 0 if none is stated; log of the
            orbit over a usual one; each in standard deviations.
        blur: log uncertainty of launches and joints, which penalises vague readings.
        level, share: of the sections: see `SectionFits`.
        unit: chi-square per reading of a mean square of 1: of the stated noise, or of the best
            assumption's.
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
        """Negative log likelihood of each term, with its own scale, at least the noise."""
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
    """A global error whose correction improves the data far.

    Attributes:
        names: assumptions, together.
        gain: log evidence.
        before, after: chi-square per reading of the sections, and of the launches (NaN if none is
            stated), [2].
        alike: other assumptions that explain the data as well.
    """

    names: Names
    gain: float
    before: tuple[float, float]
    after: tuple[float, float]
    alike: tuple[Names, ...] = ()


def certain(verdict: Verdict) -> bool:
    """Whether the evidence is decisive."""
    return worth(verdict) > CERTAIN


def worth(verdict: Verdict) -> float:
    """Log evidence; each assumption beyond the first must be certain by itself."""
    return verdict.gain - CERTAIN * (len(verdict.names) - 1)


def widely(stated: Terms, other: Terms, square: float) -> bool:
    """Whether an assumption improves nearly all terms that it changes."""
    a, b = stated.cost(square), other.cost(square)
    if len(a) != len(b):
        return True
    better, worse = np.maximum(a - b, 0).sum(), np.maximum(b - a, 0).sum()
    return bool(better > SHARE * (better + worse))


def believable(verdict: Verdict, share: float) -> bool:
    """Whether the corrected terms are right, not only less wrong.

    Args:
        verdict: the global error.
        share: of the orbit that the sections leave as stated.
    """
    (local, launch), (local_then, launch_then) = verdict.before, verdict.after
    local_clears, launch_clears = local / max(local_then, 1e-12), launch / max(launch_then, 1e-12)
    if launch_then > RIGHT and local_clears < AGAINST:  # false if no launch is stated
        return False
    unit = any("-in-" in name for name in verdict.names)
    clear = CLEAR_UNIT if unit else CLEAR
    if local_clears > clear or launch_clears > clear:
        return True
    return share < FINE and not unit and verdict.gain > FINE_GAIN


def levels(terms: Terms) -> tuple[float, float]:
    """Chi-square per reading of the sections, and of the launches in the worse plane."""
    launch = terms.launch.reshape(-1, 2)
    worse = float(np.median(launch, axis=0).max()) if len(launch) else float("nan")
    return terms.unit * terms.level, worse
