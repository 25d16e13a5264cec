"""Prior sizes of distributed errors, and prior odds of rare faults."""

from collections.abc import Mapping, Sequence

import numpy as np

from tmlattice.effects.effect import CATALOGUE, Hypothesis, RingEffect, find
from tmlattice.errors import EffectError
from tmlattice.lattice import Ring


def background_rms(wanted: str | Mapping[str, float | None]) -> dict[str, float]:
    """Return the rms of each distributed effect.

    Args:
        wanted: effect -> rms, or None for the catalogue's; "all" -> a scale of the catalogue's
            (None: 1) for every effect that has one; "none" alone: no errors. Named effects
            override "all". A name alone stands for its None.

    Raises:
        EffectError: an effect without a usual size, or a negative rms.
        UnknownNameError: no such effect.
    """
    wanted = {wanted: None} if isinstance(wanted, str) else dict(wanted)
    if "none" in wanted:
        if len(wanted) > 1:
            raise EffectError("'none' excludes all distributed errors; give it alone")
        return {}
    chosen: dict[str, float] = {}
    if "all" in wanted:
        scale = wanted.pop("all")
        scale = 1.0 if scale is None else scale
        chosen = {
            name: scale * effect.background
            for name, effect in CATALOGUE.items()
            if effect.background is not None
        }
    for name, size in wanted.items():
        effect = find(name)
        rms = effect.background if size is None else size
        if rms is None or effect.discrete:
            raise EffectError(f"{effect.name} has no usual size; give {effect.name}=RMS")
        chosen[effect.name] = rms
    if any(not 0 <= rms < np.inf for rms in chosen.values()):
        raise EffectError("a background's rms is zero or more")
    return {name: rms for name, rms in chosen.items() if rms}


def rare(ring: Ring, effects: Sequence[str]) -> dict[Hypothesis, float]:
    """Return the odds of each (effect, place) that is less probable than an ordinary fault.

    Args:
        effects: names.
    """
    return {
        (name, place): effect.odds
        for name in effects
        if (effect := find(name)).odds != 1 and isinstance(effect, RingEffect)
        for place in effect.places(ring)
        if any(
            effect.corrected_as(ring.elements[i])[0] == name for i in effect.members(ring, place)
        )
    }
