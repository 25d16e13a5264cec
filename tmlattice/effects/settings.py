"""Groups of shots with equal settings, which are tracked together."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects.apply import Settings


def groups(
    settings: Sequence[Settings] | None, shots: int
) -> Iterator[tuple[NDArray[np.intp], Settings]]:
    """Return the shots [index] of each different setting, and the setting.

    Args:
        settings: one for each shot; None or empty: the design's for all.

    Raises:
        ValueError: the numbers of settings and shots differ.
    """
    if not settings:
        yield np.arange(shots), {}
        return
    if len(settings) != shots:
        raise ValueError(f"{len(settings)} settings do not fit {shots} shots")
    known: list[Settings] = []
    members: list[list[int]] = []
    for shot, setting in enumerate(settings):
        for i, other in enumerate(known):
            if other == setting:
                members[i].append(shot)
                break
        else:
            known.append(setting)
            members.append([shot])
    for setting, indices in zip(known, members, strict=True):
        yield np.array(indices), setting
