"""The result of `tune_fit`: one column per method, and the recommended method."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.method_fit import MethodFit, advice, errors, pair, trusted
from tmlattice.late import Method
from tmlattice.lattice import Ring
from tmlattice.speaks import Speaks, last_part

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class TuneFit(Speaks):
    """The result of `tune_fit`. Tunes are fractions (x, y), or None.

    `fit`, `network_tunes` and `problem` are those of the first of the methods: the paper's recipe,
    if it was used.

    Attributes:
        ring: the design.
        magnet: name of the perturbed magnet; None for other data.
        change: relative change of its strength; None for other data.
        launch: state at the start of the ring, [n], of the shot shown, as stated.
        noise: rms of a reading, m, over monitors and planes, or None.
        design_tunes, true_tunes: of OCELOT's one-turn matrices, design and perturbed, [2]; other
            data have no true tunes.
        s: of the monitors, m, [monitor].
        measured, before: readings of one shot, and the design network's, [monitor, 2], m; NaN where
            missing.
        rms_before: of the design's residual on all shots' first turns, m; unknown launches are
            fitted, here to the design, by each method together with its weights.
        methods: fit of each method.
        seconds: of wall clock, by stage; "fit" and "tunes" are of all methods.
        seed: of the noise.
        turns: tracked for the tunes.
        shots: number of shots fitted together.
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
        def both(tunes: Array | None) -> str:
            return "" if tunes is None else " ".join(f"{q:.6f}" for q in tunes)

        rows = {"design tunes": both(self.design_tunes), "true tunes": both(self.true_tunes)}
        rows |= {f"tunes of {m.method}": both(m.tunes) or "none" for m in self.methods}
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
        """Recommended method; None if none explains the readings."""
        return trusted(self.methods)

    @property
    def best(self) -> MethodFit:
        """Recommended method; else the one with tunes and the smallest residual, a symplectic
        method before one that is not."""
        with_tunes = [m for m in self.methods if m.fit is not None]
        return self.trusted or min(with_tunes, key=lambda m: (m.method == "adam", m.rms))

    @property
    def advice(self) -> str:
        """Recommendation in a few sentences."""
        return advice(self.methods)

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
