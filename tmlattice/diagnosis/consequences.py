"""The effect of a finding on the stored beam, and the beam after its correction.

All results come from one closed orbit and the Jacobians of the layers there, in six coordinates at
the ring's energy. Only layers that a cause changes are computed again.

>>> found = consequences(ring, [Cause("quadrupole_gradient", "qd::12", -0.2)])
>>> found["quadrupole_gradient", "qd::12"].found.beta_beat_rms
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tmlattice.arrays import Array, pair
from tmlattice.beam.assembly import Assembly, assembly
from tmlattice.beam.chain import Chain
from tmlattice.beam.layers import Layers
from tmlattice.diagnosis.recommended_actions import compensated
from tmlattice.diagnosis.records import named
from tmlattice.effects import Cause, Hypothesis, RingEffect, changed_elements, find, is_energy
from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Element, Ring
from tmlattice.maps import TaylorMap
from tmlattice.observe.calibration import offset_of
from tmlattice.optics import normal_modes

Pair = tuple[float, float]
"""(x, y)."""


@dataclass(frozen=True)
class Beam:
    """The stored beam of a ring compared with the design's, at the exits of all magnets.

    Attributes:
        tunes: fractions of Qx, Qy.
        beta_beat_rms, beta_beat_max: of beta / beta of the design - 1.
        dispersion_rms: of the change of the dispersion, m.
        orbit_rms: of the closed orbit, m.
    """

    tunes: Pair
    beta_beat_rms: Pair
    beta_beat_max: Pair
    dispersion_rms: Pair
    orbit_rms: Pair


@dataclass(frozen=True)
class Consequences:
    """The stored beam with and without one finding; None where the ring has no stable closed orbit.

    Attributes:
        design: tunes of the design.
        found: with everything that was found.
        corrected: with this finding corrected and the others still there.
    """

    design: Pair | None = field(metadata=named("design_tunes"))
    found: Beam | None
    corrected: Beam | None


@dataclass(frozen=True, eq=False)
class StoredOptics:
    """Tunes [2]; beta, dispersion and closed orbit at the start and at the exits of all magnets,
    [magnet + 1, 2], m."""

    tunes: Array
    beta: Array
    dispersion: Array
    orbit: Array


def consequences(ring: Ring, causes: Sequence[Cause]) -> dict[Hypothesis, Consequences]:
    """The effect of each cause on the stored beam, by effect and element.

    Those of monitors and of what acts on settings alone do not change the stored beam of the
    design's settings, and have no entry; nor have natural effects.

    Args:
        ring: the design.
        causes: all that were found; of the beam's, those of a stored one.
    """
    felt = [c for c in causes if _felt(c.effect) or is_energy(c.effect)]
    if not felt:
        return {}
    there = assembly(ring)
    design = _optics(there, {})
    found = _optics(there, _changed(ring, ring, causes), offset_of(causes))
    each: dict[Hypothesis, Consequences] = {}
    for cause in felt:
        others = [c for c in causes if c is not cause]
        corrected, by_hand = compensated(ring, [cause])
        changed = _changed(ring, corrected, others if by_hand else causes)
        after = _optics(there, changed, offset_of(others if by_hand else causes))
        each[cause.effect, cause.element] = _compared(design, found, after)
    return each


def _compared(
    design: StoredOptics | None, found: StoredOptics | None, corrected: StoredOptics | None
) -> Consequences:
    tunes = None if design is None else pair(design.tunes)
    return Consequences(tunes, _relative(design, found), _relative(design, corrected))


def beam_with(ring: Ring, causes: Sequence[Cause]) -> Consequences:
    """The effect of all causes together on the stored beam, without any correction; those of
    monitors and of settings are ignored."""
    design, estimated = optics_with(ring, causes)
    return _compared(design, estimated, None)


def optics_with(ring: Ring, causes: Sequence[Cause]) -> tuple[StoredOptics | None, ...]:
    """Optics of the design and of the ring with all causes; None where a ring has no stable closed
    orbit. See `beam_with`."""
    there = assembly(ring)
    felt = [cause for cause in causes if _felt(cause.effect)]
    return _optics(there, {}), _optics(there, _changed(ring, ring, felt))


def _felt(effect: str) -> bool:
    kind = find(effect)
    return isinstance(kind, RingEffect) and not kind.acts_on_settings and not kind.natural


def _changed(ring: Ring, corrected: Ring, causes: Sequence[Cause]) -> dict[int, Element]:
    """Elements that differ from the ring's where causes act on a ring with other settings."""
    both = enumerate(zip(ring.elements, corrected.elements, strict=True))
    settings = {i: new for i, (old, new) in both if new is not old}
    return settings | changed_elements(corrected, causes)


def _optics(
    there: Assembly, changed: Mapping[int, Element], energy: float = 0.0
) -> StoredOptics | None:
    """The optics of the ring with these elements, at the closed orbit of this relative energy; None
    where it has no stable one."""
    layers = Layers.of(there.maps)
    layers.put(there.layers_with(changed))
    W0, W1, W2 = layers.W
    maps = replace(
        there.maps, W0=W0[:-1], W1=W1[:-1], W2=W2[:-1], closing=TaylorMap([w[-1] for w in layers.W])
    )
    try:
        path, total = Chain(maps).closed_orbit([0.0, 0.0, 0.0, 0.0, 0.0, energy])
        turn = total[-1]
        values, modes = normal_modes(turn[:4, :4])
    except (TmlatticeError, np.linalg.LinAlgError):
        return None
    start = np.linalg.solve(np.eye(4) - turn[:4, :4], turn[:4, 5])
    vectors = total[:-1, :4, :4] @ modes
    position = np.stack([vectors[:, 0, 0], vectors[:, 2, 1]], axis=-1)
    dispersion = total[:-1, :4, :4] @ start + total[:-1, :4, 5]
    return StoredOptics(
        tunes=np.angle(values) / (2 * np.pi) % 1.0,
        beta=np.abs(position) ** 2,
        dispersion=dispersion[:, [0, 2]],
        orbit=path[:-1][:, [0, 2]],
    )


def _relative(design: StoredOptics | None, ring: StoredOptics | None) -> Beam | None:
    if design is None or ring is None:
        return None
    beat = ring.beta / design.beta - 1

    def rms(values: Array) -> Pair:
        return pair(np.sqrt(np.mean(values**2, axis=0)))

    return Beam(
        tunes=pair(ring.tunes),
        beta_beat_rms=rms(beat),
        beta_beat_max=pair(np.abs(beat).max(axis=0)),
        dispersion_rms=rms(ring.dispersion - design.dispersion),
        orbit_rms=rms(ring.orbit),
    )
