"""What the diagnosis of an orbit response says: steps, errors, what is left, the file format."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.result import ring_tunes
from tmlattice.effects import Cause, apply
from tmlattice.inference import chi2
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.calibration import CALIBRATES

if TYPE_CHECKING:
    from tmlattice.diagnosis.response_missing import Weighed

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

NOTHING = 1.3
"""Held-out chi2 per reading of the design below which nothing is wrong."""
MISSING = 1.5
"""Held-out chi2 per reading of the result above which an effect is missing."""


@dataclass(frozen=True)
class Step:
    """The gap with what has been allowed so far.

    Attributes:
        effect: what was tried; the first is "design".
        parameters: how many it has.
        heldout_rms_in_plane, heldout_rms_coupling: m, over held-out correctors.
        heldout_rms_position: in-plane, with a position jump of each held-out corrector, m.
        heldout_rms_roll: coupling, with the roll of each held-out corrector from the monitors that
            gave its kick, m; NaN before rolls are fitted.
        heldout_chi2_per_dof: in-plane, by the readings' noise.
        dispersion_rms: of the RF's orbit in x on the half of the monitors not fitted, m.
        kept: whether it helped those who choose; the figures of one that was not are its own.
    """

    effect: str
    parameters: int
    heldout_rms_in_plane: float
    heldout_rms_coupling: float
    heldout_chi2_per_dof: float
    dispersion_rms: float
    heldout_rms_position: float = float("nan")
    heldout_rms_roll: float = float("nan")
    kept: bool = True

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return {name: value for name, value in vars(self).items() if name != "kept"}


@dataclass(frozen=True)
class Left:
    """What the model does not explain of the fitted readings.

    Attributes:
        chi2_per_dof: by the readings' noise; 1 is noise.
        readings: how many.
        low_rank: share of the sum of squares that the eight strongest patterns hold, (x, y).
    """

    chi2_per_dof: float
    readings: int
    low_rank: tuple[float, float]

    @property
    def p_value(self) -> float:
        """Chance that noise leaves as much."""
        return float(chi2.sf(self.chi2_per_dof * self.readings, self.readings))

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return {"chi2_per_dof": self.chi2_per_dof, "low_rank": list(self.low_rank)}


@dataclass(frozen=True)
class ResponseDiagnosis:
    """Ordered steps and what was found.

    Attributes:
        ring: the design.
        measured: the response, its monitors in the ring's order.
        steps: those kept; the first is the design's, the last the result's.
        refused: those that did not help, or spoilt the RF's response.
        causes: of the ring, its correctors and its monitors.
        errors: posterior rms of each, the same length.
        bad_monitors: names of those left out.
        scales: rms of the priors, as the data have them, by name.
        degenerate: what the data alone do not settle, in words.
        held: correctors held out, [column], the RF last.
        good: monitors kept, [monitor].
        design, model: the model's response before and after, m, [column, monitor, 2].
        data: measured, the RF last, m.
        seed: of the split.
        seconds: that it took.
        hypotheses: effects that may be missing, weighed, see `response_missing`; None: not asked.
    """

    ring: Ring
    measured: OrbitResponse
    steps: tuple[Step, ...]
    refused: tuple[Step, ...]
    causes: tuple[Cause, ...]
    errors: tuple[float, ...]
    bad_monitors: tuple[str, ...]
    scales: dict[str, float]
    degenerate: tuple[str, ...]
    held: Flags
    good: Flags
    design: Array
    model: Array
    data: Array
    seed: int
    seconds: float
    hypotheses: "tuple[Weighed, ...] | None" = None

    @property
    def verdict(self) -> str:
        """`nothing` where the design leaves noise alone; else `distributed`: many small errors."""
        return "nothing" if self.steps[0].heldout_chi2_per_dof < NOTHING else "distributed"

    @property
    def repaired(self) -> Ring:
        """The ring with its errors; monitors and correctors are in `calibration`."""
        beam = (*CALIBRATES, "energy_spread")
        return apply(self.ring, [c for c in self.causes if c.effect not in beam])

    @property
    def calibration(self) -> tuple[Cause, ...]:
        """What monitors and correctors do, for `write_calibration`."""
        bad = (Cause("monitor_dead", name, 1.0) for name in self.bad_monitors)
        return (*(c for c in self.causes if c.effect in CALIBRATES), *bad)

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-diagnosis`, version 1 (see `schemas/`)."""
        from tmlattice import __version__

        noise = self.measured.noise
        assert noise is not None
        sigma = float(np.sqrt(np.mean(noise[self.good] ** 2)))
        misfits = [
            {"rms": step.heldout_rms_in_plane, "chi2_per_dof": step.heldout_chi2_per_dof}
            for step in self.steps
        ]
        before, after = (max(m["rms"] ** 2 - sigma**2, 0.0) for m in (misfits[0], misfits[-1]))
        left = self.left
        weighed = (
            {} if self.hypotheses is None
            else {"hypotheses": [row.as_json() for row in self.hypotheses]}
        )  # fmt: skip
        return {
            **weighed,
            "format": "tmlattice-diagnosis",
            "version": 1,
            "package": __version__,
            "kind": "orbit_response",
            "verdict": self.verdict,
            "findings": [],
            "steps": [step.as_json() for step in self.steps],
            "refused": [step.as_json() for step in self.refused],
            "bad_monitors": list(self.bad_monitors),
            "degenerate": list(self.degenerate),
            "priors": self.scales,
            "errors": [
                {"effect": c.effect, "element": c.element, "amount": c.amount, "amount_sigma": s}
                for c, s in zip(self.causes, self.errors, strict=True)
            ],
            "gap": {
                "noise": sigma,
                "fit": {
                    "before": self._misfit(self.design),
                    "after": self._misfit(self.model),
                },
                "heldout": {
                    "before": misfits[0],
                    "after": misfits[-1],
                    "shots": [],
                    "monitors": "half",
                    "steps": misfits,
                },
                "closed": 1 - after / before if before > 0 else None,
                "closed_interval": None,
            },
            "unexplained": {"p_value": left.p_value, "places": [], "patterns": left.as_json()},
            "tunes": {"before": ring_tunes(self.ring), "after": ring_tunes(self.repaired)},
            "next_measurement": None,
            "sensitivity": {},
            "warnings": list(self.warnings),
            "provenance": self.provenance,
        }

    @property
    def provenance(self) -> dict[str, Any]:
        """What made it."""
        from tmlattice import __version__

        return {
            "package": __version__,
            "lattice": self.ring.name,
            "measurement": "",
            "options": {
                "reference": False, "background": {}, "holdout": float(self.held[:-1].mean()),
                "effects": None, "max_effects": len(self.steps) + len(self.refused) - 1,
                "radiation": False, "false_alarm": 0.0,
            },
            "seed": self.seed,
            "seconds": self.seconds,
        }  # fmt: skip

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader should know."""
        last = self.steps[-1]
        if last.heldout_chi2_per_dof < MISSING:
            return ()
        return (
            f"On held-out readings {1e6 * last.heldout_rms_in_plane:.1f} µm are left, "
            f"{np.sqrt(last.heldout_chi2_per_dof):.1f} times the noise: an effect is missing.",
        )

    @property
    def left(self) -> "Left":
        """What stays of the fitted correctors' readings, in their own plane."""
        patterns = []
        noise = self.measured.noise
        assert noise is not None
        total, count = 0.0, 0
        for p in (0, 1):
            rows = ~self.held[:-1] & (np.array(self.measured.planes) == "xy"[p])
            miss = (self.data - self.model)[:-1][rows][:, self.good, p]
            miss = np.nan_to_num(miss)
            size = np.linalg.svd(miss, compute_uv=False) ** 2
            patterns.append(float(size[:8].sum() / max(size.sum(), 1e-300)))
            total += float(np.sum((miss / noise[self.good, p]) ** 2))
            count += miss.size
        return Left(total / max(count, 1), count, (patterns[0], patterns[1]))

    def _misfit(self, read: Array) -> dict[str, float]:
        noise = self.measured.noise
        assert noise is not None
        rows = np.flatnonzero(~self.held[:-1])
        plane = np.array([int(p == "y") for p in self.measured.planes])[rows]
        miss = pick((self.data - read)[rows][:, self.good], plane)
        pull = miss / noise[self.good][:, plane].T
        return {
            "rms": float(np.sqrt(np.nanmean(miss**2))), "chi2_per_dof": float(np.nanmean(pull**2)),
        }  # fmt: skip

    def error(self, effect: str, element: str | None) -> tuple[float, float]:
        """Amount and posterior rms of a cause."""
        for cause, sigma in zip(self.causes, self.errors, strict=True):
            if (cause.effect, cause.element) == (effect, element):
                return cause.amount, sigma
        raise KeyError((effect, element))


def pick(values: Array, plane: Indices) -> Array:
    """One plane of [column, monitor, 2] for each column."""
    return np.asarray(np.take_along_axis(values, plane[:, None, None], 2)[..., 0])
