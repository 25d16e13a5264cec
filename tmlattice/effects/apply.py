"""Causes applied to a ring: a new ring, the given one unchanged."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array
from tmlattice.effects.effect import Cause, LaunchEffect, ReadingEffect, RingEffect, find
from tmlattice.effects.reading import Monitors
from tmlattice.errors import EffectError
from tmlattice.lattice import Element, Ring

Settings = Mapping[str, Mapping[str, float]]


def check(ring: Ring, causes: Iterable[Cause]) -> None:
    """Raise for the first cause that is impossible in the ring.

    Raises:
        UnknownNameError: an effect or an element that does not exist.
        EffectError: an element that the effect cannot sit on, or an amount that is not a number.
    """
    for cause in causes:
        find(cause.effect).check(ring, cause)


def changed_elements(
    ring: Ring, causes: Iterable[Cause], settings: Settings | None = None
) -> dict[int, Element]:
    """Return the elements that settings and causes change, by their index in `ring.elements`.

    Settings come first: a corrector's calibration error acts on the kick that was set. Effects on
    readings and on the launch change no element.
    """
    changed = set_elements(ring, settings or {})
    for cause in causes:
        effect = find(cause.effect)
        if isinstance(effect, RingEffect):
            for place in effect.members(ring, cause.element):
                element = changed.get(place, ring.elements[place])
                changed[place] = effect.changed(element, cause.amount, ring.energy)
    return changed


def apply(ring: Ring, causes: Iterable[Cause], settings: Settings | None = None) -> Ring:
    """Return a ring with the settings of a shot and with causes.

    Args:
        ring: is not changed.
        causes: those on readings or on the launch are checked, and change nothing.
        settings: by element name: kick= (rad, the total of a corrector), k1_relative=,
            k2_relative=; frequency_relative= under the name rf changes no element.

    Raises:
        UnknownNameError: an effect or an element that does not exist.
        EffectError: an element that the effect, or the setting, cannot sit on.
    """
    causes = list(causes)
    check(ring, causes)
    changed = changed_elements(ring, causes, settings)
    return ring.with_elements(changed) if changed else ring


def set_elements(ring: Ring, settings: Settings) -> dict[int, Element]:
    """Return the elements that settings change, by their index in `ring.elements`.

    Raises:
        UnknownNameError: no such element.
        EffectError: a setting that the element does not have.
    """
    changed: dict[int, Element] = {}
    for name, setting in settings.items():
        if name.casefold() == "rf" and "frequency_relative" in setting:
            continue  # the RF acts on the energy of a stored beam, not on an element
        place = ring.index(name)
        element = ring.elements[place]
        for attribute, amount in setting.items():
            element = _set(element, attribute, amount)
        changed[place] = element
    return changed


def _set(element: Element, attribute: str, amount: float) -> Element:
    match attribute, element.kind:
        case "kick", "hcorrector" | "vcorrector":
            return element.changed(angle=amount)
        case "k1_relative", "quadrupole" | "bend":
            return element.changed(k1=element.k1 * (1 + amount))
        case "k2_relative", "sextupole":
            return element.changed(k2=element.k2 * (1 + amount))
    raise EffectError(
        f"{element.kind} '{element.name}' has no setting '{attribute}'; correctors have kick, "
        "quadrupoles and bends k1_relative, sextupoles k2_relative, rf frequency_relative"
    )


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
        i = next((i for i, other in enumerate(known) if other == setting), len(known))
        if i == len(known):
            known.append(setting)
            members.append([])
        members[i].append(shot)
    for setting, indices in zip(known, members, strict=True):
        yield np.array(indices), setting


def monitors_with(ring: Ring, causes: Iterable[Cause]) -> Monitors:
    """Return the ring's monitors with causes that act on readings."""
    at = {monitor.name: i for i, monitor in enumerate(ring.monitors)}
    monitors = Monitors.perfect(len(at))
    for cause in causes:
        effect = find(cause.effect)
        if isinstance(effect, ReadingEffect):
            effect.set(monitors, at[ring[cause.element or ""].name], cause.amount)
    return monitors


def beams(launches: Array, causes: Iterable[Cause]) -> tuple[Array, Array]:
    """Return launches [shot, 6] with causes that act on the beam.

    Returns:
        Weights [node] and launches [node, shot, 6]: a monitor reads the weighted mean of their
        positions. One node of weight 1 without an energy spread.
    """
    weights, nodes = np.ones(1), np.asarray(launches, dtype=float)[None]
    for cause in causes:
        effect = find(cause.effect)
        if isinstance(effect, LaunchEffect):
            parts = [effect.beams(node, cause.amount) for node in nodes]
            weights = np.concatenate([w * own for w, (own, _) in zip(weights, parts, strict=True)])
            nodes = np.concatenate([moved for _, moved in parts])
    return weights, nodes
