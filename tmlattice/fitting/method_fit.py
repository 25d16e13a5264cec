"""One method's fit of the readings, and the recommended method in sentences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.sparse import MAX_MISFIT
from tmlattice.optics import short_way
from tmlattice.speaks import Speaks

Array = NDArray[np.float64]

METHODS = ("adam", "sparse", "map")
"""The paper's recipe first; then the sparse fit, which identifies magnets."""

SPARSE_METHODS = ("sparse", "known")
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
    def turns_alive(self) -> int:
        """Number of turns of the tunes: fewer than requested if the motion grew."""
        return 0 if self.signal is None else self.signal.shape[1] - 1

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
    absolute = np.abs(short_way(tunes - true))
    return absolute, absolute / true


def pair(value: Array | None) -> list[float] | None:
    """Return a list for JSON."""
    return None if value is None else [float(v) for v in value]


ALIKE = 3.0
"""Joint standard errors within which two methods' tunes are the same."""


def advice(methods: Sequence[MethodFit]) -> str:
    """Return a few sentences: the recommended method, and why the others differ."""
    best = trusted(methods)
    sentences = [_recommended(methods, best)]
    for method in methods:
        if method.method == "adam":
            sentences.append(_recipe(method))
        elif method is not best and best is not None:
            sentences.append(_compared(method, best))
    return " ".join(one for one in sentences if one)


def _recommended(methods: Sequence[MethodFit], best: MethodFit | None) -> str:
    if best is not None:
        why = f"it {_residual(best)}"
        if best.method == "map":
            return f"Trust map: {why}, most strengths nearly right and a few far off."
        if not best.named:
            return (
                f"Trust {best.method}: {why} without any changed magnet, so that no fault is seen; "
                "the effect of a smaller fault on the tunes is unknown."
            )
        named = ", ".join(
            f"{name} by {100 * amount:+.2f} ± {100 * error:.2f} %"
            for name, (amount, error) in best.named.items()
        )
        return f"Trust {best.method}: {why} with {named} alone, and states the error of its tunes."
    others = [m for m in methods if m.method != "adam" and m.fit is not None]
    if not others:
        return "No method here is reliable: add --method sparse, which identifies magnets."
    least = min(others, key=lambda m: m.rms)
    return (
        f"Trust none: {least.method} has the smallest residual, and it {_residual(least)}, so "
        "other errors than strengths of quadrupoles and sextupoles are present, or launches and "
        "noise are misstated; `tmlattice diagnose` tests every effect with free launches."
    )


def _compared(method: MethodFit, best: MethodFit) -> str:
    if method.tunes is None:
        return f"{method.method.capitalize()} has no tunes."
    if not method.explains:
        return f"{method.method.capitalize()} {_residual(method)}."
    if best.tunes is None or best.tune_sigma is None or method.tune_sigma is None:
        return ""
    away = np.abs(short_way(method.tunes - best.tunes))
    same = bool((away <= ALIKE * np.hypot(method.tune_sigma, best.tune_sigma)).all())
    name = method.method.capitalize()
    if same:
        return f"{name} agrees within the errors."
    return f"{name} differs by {away.max():.2g}, more than its error."


def _recipe(method: MethodFit) -> str:
    assert method.fit is not None
    free = set(method.fit.options["free"])
    parameters = method.fit.network.named_parameters()
    weights = sum(own.numel() for name, own in parameters if name in free)
    why = (
        f"The recipe (adam) cannot do it: {method.readings} readings do not determine {weights:,} "
        "free weights, nor which change is the ring's, and they have no error"
    )
    if method.chi2 is None or method.explains:
        return f"{why}."
    return f"{why}; it {_residual(method)}."


def _residual(method: MethodFit) -> str:
    """Residual of a method compared with the noise of the readings."""
    if method.explains:
        return f"leaves the readings' noise ({1e6 * method.rms:.3g} of {1e6 * method.noise:.3g} µm)"
    return f"leaves {1e6 * method.rms:.3g} µm, more than the noise of {1e6 * method.noise:.3g} µm"
