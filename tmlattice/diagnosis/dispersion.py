"""Families of the kicks that a closed orbit has: what they add to the dispersion, see `beam.kicks`.

Dispersion that no gradient makes would else draw the gradients astray: the RF's orbit is read as
well as any, and a step of it is large. One kick looks like another one, so the numbers are those of
patterns: as many as the monitors tell apart, each as large as independent kicks make it. They are
taken in the design's optics, for what they stand for is not known any better.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.kicks import dispersion_of_kicks
from tmlattice.diagnosis.family import Family, Told
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted, ResponseData

Array = NDArray[np.float64]

LEAST = 3e-3
"""Share of the strongest pattern below which a weaker one is left out."""
USUAL = 1e-4
"""rad: of the kicks of a ring that was aligned to some tenths of a millimetre."""


def patterns_of_kicks(at: Predicted, plane: int) -> Array:
    """What independent kicks of one size make of the RF's orbit, m/rad, [pattern, monitor]: the
    strongest first; none where that orbit was not read."""
    data = at.data
    if not np.isfinite(data.orbits[-1, :, plane]).any():
        return np.zeros((0, len(data.at)))
    shown = dispersion_of_kicks(at.model, data.kicks[-1], plane)[data.at]
    shapes, size, _ = np.linalg.svd(shown, full_matrices=False)
    kept = size > LEAST * size[:1]
    return np.asarray((shapes[:, kept] * size[kept]).T)


class _Kicks(Family):
    per, trust = "ring", 1e-3
    plane: ClassVar[int]

    def patterns(self, data: ResponseData) -> Array:
        """In the design, m/rad, [pattern, monitor]."""
        read = bool(np.isfinite(data.orbits[-1, :, self.plane]).any())
        key = (self.name, data.at.tobytes(), float(data.kicks[-1]), read)
        memory = data.ring.memory
        if key not in memory:
            memory[key] = patterns_of_kicks(Predicted(data, Errors.none(data)), self.plane)
        return np.asarray(memory[key])

    def size(self, data: ResponseData) -> int:
        """Of the patterns."""
        return len(self.patterns(data))

    def groups(self, data: ResponseData) -> list[Group]:
        """Of independent kicks."""
        return [Group(self.name, np.eye(self.size(data)), USUAL)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """Of the RF's orbit alone."""
        out = np.zeros((len(values), *at.data.shape))
        out[:, -1] = self.patterns(at.data) * at.gain(self.block)[-1]
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """Beside what the ring makes."""
        more = np.zeros((len(data.at), 2))
        more[:, self.plane] = values @ self.patterns(data)
        return replace(errors, dispersion=errors.dispersion + more)

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """Nothing: other kicks make the same dispersion."""
        return []

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """No effect of the catalogue: kicks that no orbit shows."""
        return [{} for _ in range(self.size(data))]


class HorizontalKicks(_Kicks):
    """What gradients cannot make of the dispersion."""

    name, effects = "horizontal kicks", ("dipole_field",)
    block, variable, plane = 0, "horizontal kicks", 0
    title = "kicks in the dispersion"


class VerticalKicks(_Kicks):
    """What skew gradients cannot make of the vertical dispersion."""

    name, effects = "vertical kicks", ("dipole_roll",)
    block, variable, plane = 1, "vertical kicks", 1
    title = "kicks in the vertical dispersion"


def dispersion_by_kicks(values: Mapping[str, Array], data: ResponseData) -> Iterator[str]:
    """A sentence for each plane in which the RF's orbit has something that no gradient makes.

    Args:
        values: that were found, by variable.
        data: the response.
    """
    for family, gradient in ((HorizontalKicks(), "gradient"), (VerticalKicks(), "skew gradient")):
        own = values.get(family.variable, np.zeros(0))
        if own.any():
            size = np.sqrt(np.mean((own @ family.patterns(data)) ** 2))
            yield (
                f"{1e6 * size:.2g} µm rms of the RF's orbit in {'xy'[family.plane]} no {gradient} "
                "makes: kicks of the closed orbit do (errors of bends, displaced quadrupoles, "
                "correctors), which the data do not tell apart"
            )
