"""The result of `tune_fit`: one column per method, and the recommended method in sentences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.fitting.adam import FitResult, tunes_text
from tmlattice.fitting.sparse import MAX_MISFIT
from tmlattice.late import Method
from tmlattice.lattice import Ring
from tmlattice.optics import short_way
from tmlattice.speaks import Speaks, last_part

METHODS = ("adam", "sparse", "map")
"""The paper's recipe first; then the sparse fit, which identifies magnets."""

SPARSE_METHODS = ("sparse", "known")
"""Methods that identify magnets; the second is given the possible ones."""


@dataclass(frozen=True, repr=False)
class MethodFit(Speaks):
    """One method's fit of the readings. Tunes are fractions (x, y), [2], or None.

    Attributes:
        fit: the network and its history, or None.
        tune_sigma: standard error of the tunes; None if the method has none.
        signal: tracked states of the tunes' spectrum, [1, turns + 1, n].
        growth: of the fitted network's amplitude per turn, 1 if it is symplectic.
        after: readings of the shot shown by the fitted network, [monitor, 2], m.
        rms: of the residual of all shots, m.
        readings, noise: number of fitted readings, and their rms noise, m.
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
        return self.method, {
            "tunes": tunes_text(self.tunes) or "none",
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


@dataclass(frozen=True, repr=False)
class TuneFit(Speaks):
    """The result of `tune_fit`. Tunes are fractions (x, y), or None.

    `fit`, `network_tunes` and `problem` are those of the first of the methods: the paper's recipe,
    if it was used.

    Attributes:
        magnet, change: the perturbed magnet, and its relative change; None for other data.
        launch: state at the start of the ring, [n], of the shot shown, as stated.
        noise: rms of a reading, m, over monitors and planes, or None.
        design_tunes, true_tunes: of OCELOT's one-turn matrices, design and perturbed, [2]; other
            data have no true tunes.
        s: of the monitors, m, [monitor].
        measured, before: readings of one shot, and the design network's, [monitor, 2], m; NaN where
            missing.
        rms_before: of the design's residual on all shots' first turns, m, unknown launches fitted.
        seconds: of wall clock, by stage; "fit" and "tunes" are of all methods.
        turns: tracked for the tunes.
        source: origin of the data; None for the experiment's own.
        noise_estimated: whether the noise is estimated from neighbouring monitors.
    """

    ring: Ring
    magnet: str | None
    change: float | None
    launch: Array
    noise: float | None
    design_tunes: Array
    true_tunes: Array | None
    s: Array
    measured: Array
    before: Array
    rms_before: float
    methods: tuple[MethodFit, ...]
    seconds: dict[str, float]
    seed: int
    turns: int
    shots: int = 1
    source: str | None = None
    noise_estimated: bool = False

    plot = Method(
        "tmlattice.plots.tune_fit",
        "plot_orbit_fit",
        "Draw the readings and each method's residual: a matplotlib Figure.",
    )

    def _told(self) -> tuple[str, dict[str, str]]:
        rows = {"design tunes": tunes_text(self.design_tunes),
                "true tunes": tunes_text(self.true_tunes)}  # fmt: skip
        rows |= {f"tunes of {m.method}": tunes_text(m.tunes) or "none" for m in self.methods}
        rows["trusted"] = "none" if self.trusted is None else self.trusted.method
        what = self.source if self.change is None else f"{self.magnet} {100 * self.change:+g} %"
        return f"of {last_part(self.ring.name)}, {what}", rows

    @property
    def fit(self) -> FitResult:
        """First method's network and its history."""
        assert self.methods[0].fit is not None
        return self.methods[0].fit

    @property
    def network_tunes(self) -> Array | None:
        """First method's tunes, [2]."""
        return self.methods[0].tunes

    @property
    def problem(self) -> str | None:
        """Why the first method has no tunes, or None."""
        return self.methods[0].problem

    @property
    def absolute_error(self) -> Array | None:
        """|network tune - true tune| of the first method, the short way round the circle, [2]."""
        return errors(self.network_tunes, self.true_tunes)[0]

    def method(self, name: str) -> MethodFit:
        """Return the fit of one method; a KeyError if it was not used."""
        return {m.method: m for m in self.methods}[name]

    @property
    def trusted(self) -> MethodFit | None:
        """Recommended method: one with a residual of noise alone and stated errors, the one of
        fewest magnets first; None if none explains the readings."""
        good = [m for m in self.methods
                if m.method != "adam" and m.tunes is not None and m.explains]  # fmt: skip
        return min(good, key=lambda m: m.method not in SPARSE_METHODS, default=None)

    @property
    def best(self) -> MethodFit:
        """Recommended method; else the one with tunes and the smallest residual, a symplectic
        method before one that is not."""
        with_tunes = [m for m in self.methods if m.fit is not None]
        return self.trusted or min(with_tunes, key=lambda m: (m.method == "adam", m.rms))

    @property
    def advice(self) -> str:
        """A few sentences: the recommended method, and why the others differ."""
        best = self.trusted
        sentences = [_recommended(self.methods, best)]
        for method in self.methods:
            if method.method == "adam":
                sentences.append(_recipe(method))
            elif method is not best and best is not None:
                sentences.append(_compared(method, best))
        return " ".join(one for one in sentences if one)

    def as_json(self) -> dict[str, Any]:
        """Return the result in the format `tmlattice-tune-fit`, version 1 (see `schemas/`)."""
        from tmlattice import __version__

        first = self.methods[0]
        absolute, relative = errors(first.tunes, self.true_tunes)
        return {
            "format": "tmlattice-tune-fit",
            "version": 1,
            "package": __version__,
            "lattice": self.ring.name,
            "layers": len(self.fit.network.layers),
            "monitors": len(self.fit.network.monitors),
            "magnet": self.magnet,
            "change": self.change,
            "launch": [float(v) for v in self.launch],
            "tunes": {
                "design": pair(self.design_tunes),
                "true": pair(self.true_tunes),
                "network": pair(first.tunes),
            },
            "error": {"absolute": pair(absolute), "relative": pair(relative)},
            "orbit_rms": {"before": self.rms_before, "after": first.rms},
            "noise": self.noise,
            "noise_estimated": self.noise_estimated,
            "loss": self.fit.loss,
            "penalty": self.fit.penalty,
            "seconds": self.seconds,
            "regularization": self.fit.options.get("regularization"),
            "seed": self.seed,
            "turns": self.turns,
            "turns_alive": first.turns_alive,
            "growth": first.growth,
            "options": self.fit.options,
            "problem": self.problem,
            "shots": self.shots,
            "measurement": self.source,
            "methods": [method.as_json(self.true_tunes) for method in self.methods],
            "best": self.best.method,
            "trusted": None if self.trusted is None else self.trusted.method,
            "advice": self.advice,
        }
