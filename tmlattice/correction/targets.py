"""Targets of a correction: errors of the stored beam's optics from a goal, and their derivatives.

They come from the stored beam at two RF frequencies, half a step above and below: orbit, betas,
phases, tunes and coupling are their means; dispersion and chromaticity their differences, per the
relative energy of the step in the design, as a control room measures them.

>>> targets = Targets(design, {"beta_beating": 0.01})
>>> errors = targets.errors(optics_of(model, targets.step))
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Indices, rms
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.stored import Moved, StoredBeam
from tmlattice.effects import Hypothesis
from tmlattice.errors import TmlatticeError, unknown_choice
from tmlattice.lattice import Ring
from tmlattice.optics import short_way

ENERGY = 1e-4
"""Relative energy of the two stored beams: third orders are 1e-8 of the first."""


@dataclass(frozen=True)
class Target:
    """One quantity with a goal.

    Attributes:
        words: description, with its plane if it has two.
        unit: of its errors.
        tolerance: rms error that counts as one; of the dispersion a share of the design's rms.
        planes: labels of its last axis; each of two columns is reported.
    """

    words: str
    unit: str
    tolerance: float
    planes: tuple[str, str]


TARGETS: dict[str, Target] = {
    "beta_beating": Target("beta beating", "relative", 0.01, ("x", "y")),
    "phase_advance": Target("phase advance / 2π", "", 1e-3, ("x", "y")),
    "dispersion": Target("dispersion error", "m", 0.01, ("x", "y")),
    "tunes": Target("tune error", "", 1e-3, ("x", "y")),
    "chromaticity": Target("chromaticity error", "", 0.1, ("x", "y")),
    "coupling": Target("coupling", "relative", 0.01, ("x to y", "y to x")),
    "closed_orbit": Target("closed orbit", "m", 1e-4, ("x", "y")),
    "first_turn": Target("trajectory on the first two turns", "m", 1e-3, ("x", "y")),
}
"""The usual targets. One per cent of beta beating comes with 1e-3 of phase advance; an amplitude of
one per cent in the other plane is an emittance ratio of 1e-4."""


OPTICS = ("beta_beating", "phase_advance", "dispersion", "tunes", "coupling")
"""Targets of every estimated ring."""
THREADING = "first_turn"
"""Target of a beam that is not stored: it is corrected alone."""


Optics = Mapping[str, NDArray[Any]]
"""Of a stored beam at the BPMs, or derivatives with a leading axis of hypotheses: `orbit`, `beta`,
`dispersion`, m, [BPM, plane]; `phase`, turns, [BPM, plane]; `tunes`, `chromaticity` [plane]; and
`coupling`, of each mode the amplitude in the other plane over that in its own, complex,
[BPM, mode]."""


class StoredOptics:
    """Optics of a ring and their derivatives.

    Args:
        model: of the ring at its RF frequency, six coordinates.
        step: relative change of the RF frequency for `ENERGY`, see `Targets.step`.

    Raises:
        UnstableRingError: no stored beam.
    """

    def __init__(self, model: ResponseModel, step: float) -> None:
        self._beams = [
            StoredBeam(model.at_frequency(model.frequency + side * step)) for side in (1, -1)
        ]
        self.values = _means([_shown(beam.shown, beam.shown) for beam in self._beams], value=True)
        self.model, self.step = model, step

    def moved(self, ring: Ring, frequency: float) -> "StoredOptics":
        """Return those of a ring with other elements, at a relative change of the RF frequency."""
        model = self.model.changed_to(ring)
        if frequency:
            model = model.at_frequency(model.frequency + frequency)
        return StoredOptics(model, self.step)

    @property
    def per_energy(self) -> float:
        """Relative change of the RF frequency for one of the energy."""
        return 1 / float(self.model.rf_start[5])

    def by_frequency(self) -> Optics:
        """Return the change per relative RF frequency, with an axis of one hypothesis."""
        up, down = (
            StoredOptics(
                self.model.at_frequency(self.model.frequency + side * self.step), self.step
            )
            for side in (0.5, -0.5)
        )
        change = _difference(up.values, down.values)
        return {name: value[None] / self.step for name, value in change.items()}

    def derivatives(self, hypotheses: Sequence[Hypothesis]) -> Optics:
        """Return the change per unit of effects on the ring, [hypothesis, ...]."""
        return _means(
            [_shown(beam.moved(hypotheses), beam.shown, slope=True) for beam in self._beams]
        )


def _shown(moved: Moved, about: Moved, slope: bool = False) -> dict[str, np.ndarray]:
    """Orbit, tunes, beta, phase and coupling of modes; or their change, linearised at `about`."""
    own = about.modes[:, [0, 1], [0, 1]]  # [BPM, mode]
    other = about.modes[:, [1, 0], [0, 1]]
    found = {"orbit": moved.orbit, "tunes": moved.tunes}
    if not slope:
        phase = np.unwrap(np.angle(own), axis=0) / (2 * np.pi)
        return found | {"beta": np.abs(own) ** 2, "phase": phase, "coupling": other / own}
    d_own = moved.modes[..., [0, 1], [0, 1]]
    ratio = d_own / own
    return found | {
        "beta": 2 * np.abs(own) ** 2 * ratio.real,
        "phase": ratio.imag / (2 * np.pi),
        "coupling": moved.modes[..., [1, 0], [0, 1]] / own - other / own * ratio,
    }


def _means(sides: Sequence[dict[str, np.ndarray]], value: bool = False) -> Optics:
    above, below = sides
    tunes = above["tunes"] - below["tunes"]
    mean = {name: (above[name] + below[name]) / 2 for name in ("orbit", "beta", "coupling")}
    if value:
        tunes = short_way(tunes)
        turned = above["phase"] - below["phase"]
        phase = below["phase"] + (turned - np.round(turned)) / 2
    else:
        phase = (above["phase"] + below["phase"]) / 2
    return mean | {
        "phase": phase,
        "tunes": below["tunes"] + tunes / 2,
        "dispersion": (above["orbit"] - below["orbit"]) / (2 * ENERGY),
        "chromaticity": tunes / (2 * ENERGY),
    }


def _difference(optics: Optics, other: Optics) -> dict[str, NDArray[Any]]:
    """Difference of the optics of two rings, tunes and phases the short way."""
    change = {name: value - other[name] for name, value in optics.items()}
    change["tunes"] = short_way(change["tunes"])
    change["phase"] = change["phase"] - np.round(change["phase"])
    return change


class Weighted:
    """Wanted targets, each in units of its tolerance.

    Attributes:
        names: of the targets, in the order of `TARGETS`.
        tolerance: of these, in their units.
        s: of their readings, m.
    """

    names: tuple[str, ...]
    tolerance: dict[str, float]
    s: Array
    undetermined: Array | float = 0.0

    def rows(self, parts: Mapping[str, Array]) -> Array:
        """Return errors or changes of the wanted targets in units of their tolerances, so that the
        square of all rows is the sum of mean squares, [..., row]."""
        own = []
        for name in self.names:
            part = parts[name] / np.hypot(self.tolerance[name], self.undetermined)
            part = part.reshape(*part.shape[:-2], -1)
            own.append(part / np.sqrt(part.shape[-1]))
        return np.concatenate(own, axis=-1)

    def groups(self, parts: Mapping[str, Array]) -> Indices:
        """Return the index of the target and plane of each of `rows`, [row]."""
        return np.concatenate([
            2 * k + np.arange(parts[name].size) % 2 for k, name in enumerate(self.names)
        ])  # fmt: skip


class Targets(Weighted):
    """Errors of the optics from a goal, the wanted ones in units of their tolerances.

    Args:
        goal: the ring with the wanted optics.
        wanted: names of `TARGETS`, optionally with another tolerance.

    Attributes:
        step: relative change of the RF frequency that changes the goal's energy by `ENERGY`.
        goal: its optics.

    Raises:
        TmlatticeError: threading together with other targets.
        ChoiceError: no such target.
        UnstableRingError: the goal stores no beam.
    """

    def __init__(self, goal: Ring, wanted: Iterable[str] | Mapping[str, float | None]) -> None:
        given = wanted if isinstance(wanted, Mapping) else dict.fromkeys(wanted)
        for name in given:
            if name not in TARGETS:
                raise unknown_choice("target", name, TARGETS)
        if THREADING in given:
            raise TmlatticeError(
                f"'{THREADING}' is the target of a beam that is not stored; give it alone"
            )
        model = ResponseModel.of(goal)
        self.s = np.array([monitor.s for monitor in goal.monitors])
        self.step = ENERGY / float(model.rf_start[5])
        self.goal = StoredOptics(model, self.step).values
        self.names = tuple(name for name in TARGETS if name in given)
        size = rms(self.goal["dispersion"][:, 0]) or 1.0
        self.tolerance = {
            name: given[name] or TARGETS[name].tolerance * (size if name == "dispersion" else 1.0)
            for name in self.names
        }

    def begin(self, ring: Ring, energy: float) -> StoredOptics:
        """Return the optics of a ring with this relative energy of the beam.

        Raises:
            UnstableRingError: no stored beam.
        """
        model = ResponseModel(ring)
        return StoredOptics(model.at_energy(energy) if energy else model, self.step)

    def errors(self, optics: Optics) -> dict[str, Array]:
        """Return errors of all targets of a stored beam, [reading, plane] each, in their units."""
        found = self.changes(_difference(optics, self.goal))
        found["phase_advance"] -= np.round(found["phase_advance"])
        return found

    def changes(self, derivatives: Optics) -> dict[str, Array]:
        """Return the derivatives of `errors`, [hypothesis, reading, plane] each: linear in those of
        the optics."""
        beta = self.goal["beta"]
        across = np.sqrt(beta / beta[:, ::-1]) * derivatives["coupling"]
        return {
            "beta_beating": derivatives["beta"] / beta,
            "phase_advance": np.diff(derivatives["phase"], axis=-2),
            "dispersion": derivatives["dispersion"],
            "tunes": derivatives["tunes"][..., None, :],
            "chromaticity": derivatives["chromaticity"][..., None, :],
            "coupling": np.concatenate([across.real, across.imag], axis=-2),
            "closed_orbit": derivatives["orbit"],
        }


def rms_of(parts: Mapping[str, Array]) -> dict[str, Array]:
    """Return the rms of each target's errors, [..., plane], in its unit; of the coupling that of
    the complex amplitude."""
    parted = {"coupling": 2.0}
    return {
        name: np.sqrt(parted.get(name, 1.0) * np.mean(part**2, axis=-2))
        for name, part in parts.items()
    }
