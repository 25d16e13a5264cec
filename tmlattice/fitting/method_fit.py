"""One method's fit of the readings, and when it is to be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.sparse import MAX_MISFIT
from tmlattice.speaks import Speaks

Array = NDArray[np.float64]

METHODS = ("adam", "sparse", "map")
"""The paper's recipe first; of the others the one that names magnets."""

SPARSE_METHODS = ("sparse", "told")
"""Those that name a few magnets; the second knows which might have changed."""


@dataclass(frozen=True, repr=False)
class MethodFit(Speaks):
    """One method's fit of the readings. Tunes are fractions (x, y); None where there is none.

    Attributes:
        method: its name.
        fit: the network and its history; None where there is no fit.
        tunes: of the fitted ring, [2].
        tune_sigma: their stated standard error, [2]; None where the method states none.
        signal: states of the tracking that a spectrum is made of, [1, turns + 1, n].
        growth: of the fitted network's amplitude in a turn, 1 where it is symplectic.
        after: readings of the shot shown by the fitted network, [monitor, 2], m.
        rms: of what it leaves of all shots' readings, m.
        readings: that were fitted.
        noise: their rms, m; 0 where they have none.
        chi2: of what is left in units of the noise, a reading; None where there is none.
        seconds: of wall clock.
        problem: why there are no tunes, or None.
    """

    method: str
    fit: FitResult | None
    tunes: Array | None
    tune_sigma: Array | None
    signal: Array | None
    growth: float | None
    after: Array
    rms: float
    readings: int
    noise: float
    chi2: float | None
    seconds: float
    problem: str | None = None

    def _told(self) -> tuple[str, dict[str, str]]:
        tunes = "none" if self.tunes is None else " ".join(f"{q:.6f}" for q in self.tunes)
        return self.method, {
            "tunes": tunes,
            "leaves": f"{1e6 * self.rms:.4g} µm",
            "noise": f"{1e6 * self.noise:.4g} µm",
            "named": ", ".join(self.named),
            "problem": self.problem or "",
        }

    @property
    def named(self) -> dict[str, tuple[float, float]]:
        """The magnets that `sparse` names, with their relative change and its error."""
        return self.fit.changes if self.fit is not None and self.method in SPARSE_METHODS else {}

    @property
    def explains(self) -> bool:
        """Whether the fit leaves no more than the noise of the readings."""
        if self.chi2 is None:
            return False
        return self.chi2 <= 1 + MAX_MISFIT * float(np.sqrt(2 / self.readings))

    def as_json(self, true: Array | None) -> dict[str, Any]:
        """An entry of "methods" in `tmlattice-tune-fit`."""
        absolute, relative = errors(self.tunes, true)
        return {
            "method": self.method,
            "tunes": pair(self.tunes),
            "tune_sigma": pair(self.tune_sigma),
            "error": {"absolute": pair(absolute), "relative": pair(relative)},
            "orbit_rms": self.rms,
            "chi2": self.chi2,
            "seconds": self.seconds,
            "named": [
                {"magnet": name, "change": change, "change_sigma": sigma}
                for name, (change, sigma) in self.named.items()
            ],
            "options": {} if self.fit is None else self.fit.options,
            "problem": self.problem,
        }


def trusted(methods: Sequence[MethodFit]) -> MethodFit | None:
    """The method whose tunes to take: one that leaves the noise alone and states its error, the
    one of fewest magnets first; None where none does."""
    good = [m for m in methods if m.method != "adam" and m.tunes is not None and m.explains]
    return min(good, key=lambda m: m.method not in SPARSE_METHODS, default=None)


def errors(tunes: Array | None, true: Array | None) -> tuple[Array | None, Array | None]:
    """Absolute, the short way round the circle, and relative to the true fraction, [2] each."""
    if tunes is None or true is None:
        return None, None
    absolute = np.abs((tunes - true + 0.5) % 1.0 - 0.5)
    return absolute, absolute / true


def pair(value: Array | None) -> list[float] | None:
    """For JSON."""
    return None if value is None else [float(v) for v in value]
