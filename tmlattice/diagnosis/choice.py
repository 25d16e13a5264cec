"""The effects that a diagnosis can look for."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import LaunchEffect, find, modelled, names
from tmlattice.errors import EffectError
from tmlattice.lattice import Ring

_COLUMNS = (0, 1, 2, 3, 5)
"""The five coordinates of a launch in a measurement."""


def chosen_effects(
    ring: Ring, effects: Sequence[str] | None, launch_sigma: NDArray[np.float64]
) -> list[str]:
    """The effects to be fitted; none where all that are requested show in the data alone.

    Args:
        ring: the design.
        effects: names; None: all usual ones.
        launch_sigma: how well each launch is known, 0 exactly, [shot, 5].

    Raises:
        EffectError: no effect is named, or none of them can be looked for.
        UnknownNameError: an effect that does not exist.
    """
    if not names(effects):
        raise EffectError("no effect is named; leave effects out to look for all of them")
    chosen = modelled(effects)
    free = [six for six, sigma in zip(_COLUMNS, launch_sigma.T, strict=True) if (sigma > 0).any()]
    why = [
        f"{name} shows in turns of a stored beam alone"
        for name in names(effects) if find(name).of_turns
    ]  # fmt: skip
    for name in list(chosen):
        effect = find(name)
        if not effect.places(ring):
            why.append(f"{name} has no place in '{ring.name}' (it sits on: {effect.sits_on_text})")
            chosen.remove(name)
        elif isinstance(effect, LaunchEffect) and effect.shifts in free:
            why.append(
                f"{name} cannot be separated from the launch of each shot, which is fitted too"
            )
            chosen.remove(name)
    if not chosen and len(why) == len(names(effects)):
        raise EffectError("; ".join(why) + ": name another effect")
    return chosen
