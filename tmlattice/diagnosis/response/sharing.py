"""Magnets that may share an error: all, a polarity, a region, a type, a family; or a single one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.supplies import supplied_alike

GAP = 2.5
"""Ratio to the typical distance of two bends above which a straight is between them."""


class Candidates(NamedTuple):
    """All candidates for a common factor.

    Attributes:
        kinds, names: see `common_factors.MAKES`.
        members: 1 for each magnet that shares it, [magnet, candidate].
        families: whether it is a family of several magnets, whatever its kind.
    """

    kinds: tuple[str, ...]
    names: tuple[str, ...]
    members: Array
    families: Flags


def candidates(ring: Ring, own: Sequence[tuple[Element, ...]]) -> Candidates:
    """Return all groups of a ring's magnets that may share an error; each group has one name.

    Args:
        ring: with the magnets.
        own: the magnets, each with its pieces.
    """
    kinds: list[str] = []
    names: list[str] = []
    columns: list[Array] = []
    families: list[bool] = []

    def add(kind: str, name: str, members: Array) -> None:
        if members.sum() < (1 if kind == "magnet" else 2):
            return
        same = [i for i, column in enumerate(columns) if (members == column).all()]
        if same:
            families[same[0]] |= kind == "family"
            return
        kinds.append(kind)
        names.append(name)
        columns.append(members)
        families.append(kind == "family")

    focusing = np.array([float(pieces[0].k1 > 0) for pieces in own])
    add("all", "all quadrupoles", np.ones(len(own)))
    add("focusing", "all focusing quadrupoles", focusing)
    add("focusing", "all defocusing quadrupoles", 1 - focusing)
    stems, by_stem = supplied_alike(ring)
    for name, members in zip(stems, by_stem.T, strict=True):
        add("family", name, members)
    groups = [pieces[0].family.casefold() for pieces in own]
    for name in dict.fromkeys(groups):
        add("family", name, np.array([float(group == name) for group in groups]))
    for name, members in _regions(ring, own):
        add("region", name, members)
        add("region", f"{name}, focusing", members * focusing)
        add("region", f"{name}, defocusing", members * (1 - focusing))
    for length in sorted({_length(pieces) for pieces in own}):
        alike = np.array([float(_length(pieces) == length) for pieces in own])
        add("type", f"quadrupoles of {length:g} m", alike)
    for i, pieces in enumerate(own):
        add("magnet", pieces[0].name, np.eye(len(own))[i])
    return Candidates(tuple(kinds), tuple(names), np.array(columns).T, np.array(families))


def _length(pieces: Sequence[Element]) -> float:
    return round(sum(e.length for e in pieces), 3)


def _regions(ring: Ring, own: Sequence[tuple[Element, ...]]) -> list[tuple[str, Array]]:
    """Arcs and straights, all of them and single ones."""
    bends = np.array([e.s for e in ring.elements if e.kind == "bend"])
    if len(bends) < 3:
        return []
    ways = np.diff(np.append(bends, bends[0] + ring.length))
    long = np.flatnonzero(ways > GAP * np.median(ways))
    if not 0 < len(long) < len(ways) / 2:
        return []
    s = np.array([pieces[0].s for pieces in own])
    low, high = bends[long], bends[long] + ways[long]
    within = [((s > a) & (s < b)) | (s + ring.length < b) for a, b in zip(low, high, strict=True)]
    straight = np.any(within, axis=0)
    found = [("arcs", np.where(straight, 0.0, 1.0)), ("straights", straight.astype(float))]
    for inside, a, b in zip(within, low, high, strict=True):
        found.append((f"straight at s = {((a + b) / 2) % ring.length:.0f} m", inside.astype(float)))
    for start, end in zip(high, np.append(low[1:], low[0] + ring.length), strict=True):
        inside = ((s > start) & (s < end)) | (s + ring.length < end) & (s + ring.length > start)
        inside &= ~straight
        middle = ((start + end) / 2) % ring.length
        found.append((f"arc at s = {middle:.0f} m", inside.astype(float)))
    return found
