"""One method's fit of the readings, and the recommended method."""

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
"""The paper's recipe first; then the sparse fit, which identifies magnets."""

SPARSE_METHODS = ("sparse", "told")
"""Methods that identify magnets; the second is given the possible ones."""


@dataclass(frozen=True, repr=False)
class MethodFit(Speaks):
    """One method's fit of the readings. Tunes are fractions (x, y), or None.

    Attributes:
        method: its name.
        fit: the network and its history, or None.
        tunes: of the fitted ring, [2].
        tune_sigma: their standard error, [2]; None if the method has none.
        signal: tracked states of the tunes' spectrum, [1, turns + 1, n].
        growth: of the fitted network's amplitude per turn, 1 if it is symplectic.
        after: readings of the shot shown by the fitted network, [monitor, 2], m.
        rms: of the residual of all shots, m.
        readings: number of fitted readings.
        noise: their rms, m; 0 without noise.
        chi2: residual in units of the noise, per reading, or None.
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
        """Magnets that `sparse` identifies, with their relative change and its error."""
        return self.fit.changes if self.fit is not None and self.method in SPARSE_METHODS else {}

    @property
    def explains(self) -> bool:
        """Whether the residual is compatible with the noise of the readings."""
        if self.chi2 is None:
            return False
        return self.chi2 <= 1 + MAX_MISFIT * float(np.sqrt(2 / self.readings))

    def as_json(self, true: Array | None) -> dict[str, Any]:
        """Return an entry of "methods" in `tmlattice-tune-fit`."""
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
    """Return the recommended method: one with a residual of noise alone and stated errors, the one
    of fewest magnets first; None if there is none."""
    good = [m for m in methods if m.method != "adam" and m.tunes is not None and m.explains]
    return min(good, key=lambda m: m.method not in SPARSE_METHODS, default=None)


def errors(tunes: Array | None, true: Array | None) -> tuple[Array | None, Array | None]:
    """Return errors, absolute (the short way round the circle) and relative, [2] each."""
    if tunes is None or true is None:
        return None, None
    absolute = np.abs((tunes - true + 0.5) % 1.0 - 0.5)
    return absolute, absolute / true


def pair(value: Array | None) -> list[float] | None:
    """Return a list for JSON."""
    return None if value is None else [float(v) for v in value]
