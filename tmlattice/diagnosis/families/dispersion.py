"""Families of closed-orbit kicks that change the dispersion, see `beam.kicks`.

Dispersion by kicks would bias the gradients, because the RF's orbit is fitted, too. Single kicks
are degenerate, so the parameters are amplitudes of patterns of independent kicks, as many as the
BPMs separate. They are linearised in the design's optics.

A family of closed-orbit patterns of small kicks, which act in sextupoles. A response is hardly
sensitive to a kick itself, but off axis sextupoles focus and couple. With usual alignment that
exceeds the quadrupoles' own errors. Single kicks are degenerate, so the numbers are amplitudes of
patterns: the combinations of usual errors of bends and quadrupoles that focus most.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple, TypeVar

import numpy as np

from tmlattice.arrays import Array, Reals, rms
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.kicks import (
    dispersion_behind,
    dispersion_of_kicks,
    energy_of_way,
    kicking,
    orbits_of_kicks,
)
from tmlattice.diagnosis.families.family import Family, RingFamily, StatedCause
from tmlattice.effects import Cause, Hypothesis, background_rms, directions, find
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData

LEAST = 3e-3
"""Share of the strongest pattern below which a weaker one is omitted."""
USUAL = 1e-4
"""Kick rms, rad, of a ring aligned to some tenths of a millimetre."""


class Patterns(NamedTuple):
    """Patterns of independent kicks of one size, the strongest first; none without an RF step.

    Attributes:
        rf: of the RF's orbit, m/rad, [pattern, monitor].
        at_correctors: of the dispersion at correctors of the plane, 0 at others, m per relative
            energy and rad, [pattern, corrector].
        kicks: relative kicks of each pattern, of norm 1, [pattern, source].
    """

    rf: Array
    at_correctors: Array
    kicks: Array


def patterns_of_kicks(at: Predicted, plane: int) -> Patterns:
    """Return the dispersion patterns of independent kicks of one size that the BPMs separate."""
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
    per, single = "ring", False
    trust, rms = 1e-3, USUAL
    plane: ClassVar[int]

    def patterns(self, data: ResponseData) -> Patterns:
        """The kicks in the design."""
        read = bool(np.isfinite(data.orbits[-1, :, self.plane]).any())
        names = tuple(data.measured.correctors)
        planes = data.plane.tobytes()
        kick = float(data.kicks[-1])
        key = (self.name, data.at.tobytes(), kick, data.energy, read, names, planes)
        return data.ring.remembered(
            key, lambda: patterns_of_kicks(Predicted(data, Errors.none(data)), self.plane)
        )

    def size(self, data: ResponseData) -> int:
        """Number of patterns."""
        return len(self.patterns(data).rf)

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
        out = np.empty((len(values), *data.shape))
        out[:, -1] = patterns.rf
        by_correctors = more * kicks * patterns.at_correctors
        np.multiply(by_correctors[:, :, None], dispersion.T[read], out=out[:, :-1])
        by_monitors = kicks * energy * (read == self.plane) / data.energy_of_rf
        for column in np.flatnonzero(by_monitors):  # their orbit is read in the plane of the kicks
            out[:, column] += by_monitors[column] * patterns.rf
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

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """No causes: single kicks are degenerate."""
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


AnyFamily = TypeVar("AnyFamily", bound=Family)


def _fitted(values: Mapping[str, Array], *families: AnyFamily) -> Iterator[tuple[AnyFamily, Array]]:
    """Yield the families with fitted numbers that are not all zero, and these."""
    for family in families:
        own = values.get(family.variable, np.zeros(0))
        if own.any():
            yield family, own


def dispersion_by_kicks(values: Mapping[str, Array], data: ResponseData) -> Iterator[str]:
    """Yield a message for each plane in which kicks contribute to the RF's orbit.

    Args:
        values: fitted, by variable.
        data: the response.
    """
    for family, own in _fitted(values, HorizontalKicks(), VerticalKicks()):
        size = rms(own @ family.patterns(data).rf)
        yield (
            f"{1e6 * size:.2g} µm rms of the RF's orbit in {'xy'[family.plane]} are not from a "
            f"{FIELDS[family.plane]} but from kicks of the closed orbit (errors of bends, "
            "quadrupole offsets, correctors), which the data do not separate"
        )


FIELDS = ("gradient", "skew gradient")
"""Field by which a closed orbit acts, by plane."""


def fitted_orbit_kicks(at: Predicted) -> Array | None:
    """Return the kicks behind each magnet that make the fitted additional dispersion, in x and y,
    rad, [magnet, 2], see `ResponseModel`; None without such dispersion. They are computed in the
    estimated ring, where they differ from those in the design."""
    ring, orbit_kicks = at.data.ring, np.zeros((len(at.data.ring.magnets), 2))
    added = np.broadcast_to(at.errors.dispersion, (len(at.data.at), 2))
    for plane in (0, 1):
        if added[:, plane].any():
            patterns = patterns_of_kicks(at, plane)
            amounts = np.linalg.lstsq(patterns.rf.T, added[:, plane], rcond=None)[0]
            orbit_kicks[kicking(ring, plane), plane] = amounts @ patterns.kicks
    return orbit_kicks if orbit_kicks.any() else None


def dispersion_beside(
    values: Mapping[str, Array], data: ResponseData
) -> dict[str, tuple[float, float]]:
    """Return the fitted additional dispersion at all BPMs and correctors of the ring, m per
    relative energy in x and y; empty where none was fitted.

    Args:
        values: fitted, by variable.
        data: the response.
    """
    found = [*_fitted(values, HorizontalKicks(), VerticalKicks())]
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


LEAST_FOCUSING = 0.02
"""Share of the strongest pattern below which one is omitted; quadrupole gradients absorb it."""


class OrbitPatterns(NamedTuple):
    """Patterns of usual errors, the strongest first.

    Attributes:
        causes: the errors.
        amounts: of each, [pattern, error].
        orbits: in sextupoles, m, [pattern, sextupole].
    """

    causes: tuple[Hypothesis, ...]
    amounts: Array
    orbits: Array


def orbit_patterns(model: ResponseModel, plane: int, effects: Sequence[str]) -> OrbitPatterns:
    """Return the patterns of usual errors whose closed orbit focuses most in sextupoles."""
    magnets = model.ring.magnets
    strength = np.array([e.k2 * e.length if e.kind == "sextupole" else 0.0 for e in magnets])
    exits = np.flatnonzero(strength) + 1
    usual = background_rms(dict.fromkeys(effects))
    causes = tuple((name, place) for name in usual for place in find(name).places(model.ring))
    size = np.array([usual[name] for name, _ in causes])
    kicks = directions(model.layers, causes)
    rows = model.tangents[exits][:, 2 * plane]
    orbits = np.zeros((len(causes), len(exits)))
    by_layer = orbits_of_kicks(model, kicks.layer, exits, rows, kicks.D0)
    np.add.at(orbits, kicks.owner, by_layer.T)
    patterns, focusing, _ = np.linalg.svd(
        size[:, None] * orbits * strength[exits - 1], full_matrices=False
    )
    kept = focusing > LEAST_FOCUSING * focusing.max(initial=0.0)
    amounts = patterns.T[kept] * size
    return OrbitPatterns(causes, amounts, amounts @ orbits)


class OrbitFamily(RingFamily):
    """Amplitudes of orbit patterns, in units of usual errors. With kicks they can make up for an
    energy offset while gradients are far from the ring."""

    single, late = False, True
    trust, rms = 1.0, 1.0
    plane: ClassVar[int]

    def patterns(self, data: ResponseData) -> OrbitPatterns:
        """The patterns in the design."""
        return data.ring.remembered(
            (self.name, data.energy), lambda: orbit_patterns(data.design, self.plane, self.effects)
        )

    def size(self, data: ResponseData) -> int:
        """Number of patterns."""
        return len(self.patterns(data).amounts)

    def rows(self, at: Predicted, values: Array) -> Reals:
        """Derivatives by all errors."""
        causes, amounts, _ = self.patterns(at.data)
        return at.rows(causes, self.block, amounts)

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The most probable errors; what no pattern has of one keeps its usual size."""
        causes, amounts, _ = self.patterns(data)
        usual = background_rms(dict.fromkeys(self.effects))
        squares = np.array([usual[name] ** 2 for name, _ in causes]) - np.sum(amounts**2, axis=0)
        error = np.sqrt(np.maximum(squares, 0.0) + sigma**2 @ amounts**2)
        own = zip(causes, (values @ amounts).tolist(), error.tolist(), strict=True)
        return [(Cause(*h, amount), e) for h, amount, e in own]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """Amounts of all errors, the strongest first."""
        causes, amounts, _ = self.patterns(data)
        order = np.argsort(-np.abs(amounts), axis=1).tolist()
        own = zip(amounts.tolist(), order, strict=True)
        return [{causes[i]: pattern[i] for i in first} for pattern, first in own]


class HorizontalOrbit(OrbitFamily):
    """The horizontal closed orbit, which focuses in sextupoles."""

    name, effects = "horizontal orbit", ("dipole_field", "quadrupole_offset_x")
    block, variable, plane = 0, "horizontal orbit", 0
    title = "horizontal closed orbit in sextupoles"


class VerticalOrbit(OrbitFamily):
    """The vertical closed orbit, which couples in sextupoles."""

    name, effects = "vertical orbit", ("dipole_roll", "quadrupole_offset_y")
    block, variable, plane = 1, "vertical orbit", 1
    title = "vertical closed orbit in sextupoles"


def orbits_in_sextupoles(values: Mapping[str, Array], data: ResponseData) -> Iterator[str]:
    """Yield a message where the closed orbit acts in sextupoles.

    Args:
        values: fitted, by variable.
        data: the response.
    """
    sizes = [
        f"{1e3 * rms(own @ family.patterns(data).orbits):.2g} mm in {'xy'[family.plane]}"
        for family, own in _fitted(values, HorizontalOrbit(), VerticalOrbit())
    ]
    if sizes:
        yield (
            f"the sextupoles' gradients and skew gradients show a closed orbit of "
            f"{' and '.join(sizes)} (rms) about their centres; the data do not separate the errors "
            "of bends and quadrupoles that make it"
        )
