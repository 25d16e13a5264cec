"""Families of closed-orbit kicks that change the dispersion, see `beam.kicks`.

Dispersion from kicks would bias the gradients, because the RF's orbit is fitted too. Single kicks
are degenerate, so the parameters are amplitudes of patterns of independent kicks, as many as the
BPMs separate. They are linearised in the design's optics.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.kicks import (
    dispersion_behind,
    dispersion_of_kicks,
    energy_of_way,
    kicking,
)
from tmlattice.diagnosis.families.family import Family, StatedCause
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]

LEAST = 3e-3
"""Share of the strongest pattern below which a weaker one is omitted."""
USUAL = 1e-4
"""Kick rms, rad, of a ring aligned to some tenths of a millimetre."""


class Patterns(NamedTuple):
    """Patterns of independent kicks of one size, the strongest first; none without an RF step.

    Attributes:
        rf: of the RF's orbit, m/rad, [pattern, monitor].
        at_correctors: of the dispersion at those that kick in the plane, 0 at the others, m per
            relative energy and rad, [pattern, corrector].
        kicks: that make them, of a size of 1, [pattern, source].
    """

    rf: Array
    at_correctors: Array
    kicks: Array


def patterns_of_kicks(at: Predicted, plane: int) -> Patterns:
    """The dispersion patterns of independent kicks of one size, as many as the BPMs separate."""
    data, model = at.data, at.model
    if not np.isfinite(data.orbits[-1, :, plane]).any():
        return Patterns(*(np.zeros((0, n)) for n in (len(data.at), len(data.kicks) - 1, 0)))
    shown = dispersion_of_kicks(model, data.kicks[-1], plane)[data.at]
    shapes, size, kicks = np.linalg.svd(shown, full_matrices=False)
    kept = size > LEAST * size[:1]
    layers = model.columns(data.measured.correctors).layer
    behind = kicks[kept] @ dispersion_behind(model, layers, plane).T
    own = behind * (data.plane[:-1] == plane)
    return Patterns((shapes[:, kept] * size[kept]).T, own, kicks[kept])


class _Kicks(Family):
    per, trust = "ring", 1e-3
    plane: ClassVar[int]

    @property
    def largest(self) -> float:
        """Zero: a pattern has no members."""
        return 0.0

    def patterns(self, data: ResponseData) -> Patterns:
        """The kicks in the design."""
        read = bool(np.isfinite(data.orbits[-1, :, self.plane]).any())
        names = tuple(data.measured.correctors)
        planes = data.plane.tobytes()
        key = (self.name, data.at.tobytes(), float(data.kicks[-1]), read, names, planes)
        memory = data.ring.memory
        if key not in memory:
            memory[key] = patterns_of_kicks(Predicted(data, Errors.none(data)), self.plane)
        found: Patterns = memory[key]
        return found

    def size(self, data: ResponseData) -> int:
        """Number of patterns."""
        return len(self.patterns(data).rf)

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of independent kicks."""
        return [Group(self.name, np.eye(self.size(data)), USUAL)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """Responses of the RF's orbit, and of the correctors by the energy, see
        `beam.kicks.by_energy`."""
        data, model, patterns = at.data, at.model, self.patterns(at.data)
        names = data.measured.correctors
        read = data.plane_of(self.block)[:-1]
        more = energy_of_way(model)
        energy = model.columns(names).start[:, 5] + more * at.errors.at_correctors
        dispersion = model.rf_response()[data.at] / model.rf_start[5]
        dispersion = dispersion + at.errors.dispersion / data.energy_of_rf
        kicks = data.kicks[:-1] * (1 + at.errors.calibration[:-1])
        out = np.zeros((len(values), *data.shape))
        out[:, -1] = patterns.rf
        own = np.flatnonzero(read == self.plane)  # their orbit is read in the plane of the kicks
        by_monitors = kicks[own] * energy[own]
        out[:, own] = by_monitors[:, None] * (patterns.rf / data.energy_of_rf)[:, None]
        by_correctors = more * kicks * patterns.at_correctors
        out[:, :-1] += by_correctors[:, :, None] * dispersion.T[read]
        out *= at.gain(self.block)
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with the kicks' dispersion."""
        patterns = self.patterns(data)
        more = np.zeros((len(data.at), 2))
        more[:, self.plane] = values @ patterns.rf
        return replace(
            errors,
            dispersion=errors.dispersion + more,
            at_correctors=errors.at_correctors + values @ patterns.at_correctors,
        )

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """No causes: single kicks are degenerate."""
        return []

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """No effect of the catalogue."""
        return [{} for _ in range(self.size(data))]


class HorizontalKicks(_Kicks):
    """Horizontal dispersion by kicks, not by gradients."""

    name, effects = "horizontal kicks", ("dipole_field",)
    block, variable, plane = 0, "horizontal kicks", 0
    title = "kicks in the dispersion"


class VerticalKicks(_Kicks):
    """Vertical dispersion by kicks, not by skew gradients."""

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
            size = np.sqrt(np.mean((own @ family.patterns(data).rf) ** 2))
            yield (
                f"{1e6 * size:.2g} µm rms of the RF's orbit in {'xy'[family.plane]} are not from a "
                f"{gradient} but from kicks of the closed orbit (errors of bends, quadrupole "
                "offsets, correctors), which the data do not separate"
            )


def fitted_orbit_kicks(at: Predicted) -> Array | None:
    """What makes the dispersion that the errors have beside the ring's, as kicks behind each magnet
    in x and y, rad, [magnet, 2]: see `ResponseModel`. In the ring with its errors, in which other
    kicks make it than in the design. None where there is no such dispersion.
    """
    ring, orbit_kicks = at.data.ring, np.zeros((len(at.data.ring.magnets), 2))
    beside = np.broadcast_to(at.errors.dispersion, (len(at.data.at), 2))
    for plane in (0, 1):
        if beside[:, plane].any():
            patterns = patterns_of_kicks(at, plane)
            amounts = np.linalg.lstsq(patterns.rf.T, beside[:, plane], rcond=None)[0]
            orbit_kicks[kicking(ring, plane), plane] = amounts @ patterns.kicks
    return orbit_kicks if orbit_kicks.any() else None


def dispersion_beside(
    values: Mapping[str, Array], data: ResponseData
) -> dict[str, tuple[float, float]]:
    """Return the fitted additional dispersion at all BPMs and correctors of the ring, m per
    relative energy in x and y; empty where none was fitted.

    Args:
        values: that were found, by variable.
        data: the response.
    """
    found = [
        (family, values[family.variable])
        for family in (HorizontalKicks(), VerticalKicks())
        if values.get(family.variable, np.zeros(0)).any()
    ]
    if not found:
        return {}
    model = data.design
    columns = model.columns()
    names = [*model.monitors, *columns.names]
    dispersion = np.zeros((len(names), 2))
    for family, own in found:
        kicks = own @ family.patterns(data).kicks
        dispersion[:, family.plane] = np.concatenate([
            dispersion_of_kicks(model, data.kicks[-1], family.plane) / data.energy_of_rf,
            dispersion_behind(model, columns.layer, family.plane),
        ]) @ kicks  # fmt: skip
    return {name: (float(x), float(y)) for name, (x, y) in zip(names, dispersion, strict=True)}
