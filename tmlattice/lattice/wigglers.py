"""Wigglers that a lattice file describes as rows of short bends."""

import logging
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.places import Place, first_order

log = logging.getLogger(__name__)


THIN_BEND = 0.1
"""m; a bend not longer than this may be a slice of a wiggler."""

WIGGLER_SLICES = 8
"""At least as many thin bends in a row, of both signs, are a wiggler."""


def merge_wigglers(places: list[Place], energy: float) -> list[Place]:
    """Each row of thin bends of alternating sign as one matrix element of the family `wiggler`.

    The matrix is the product of the slices' own 6 x 6 matrices, edges included, so tunes and
    dispersion stay; the slices' second order is dropped (their fields average out). A network
    then has one layer a wiggler and not two hundred.
    """
    from tmlattice.lattice.ocelot import elements as ocelot

    matrices: dict[int, Array] = {}
    merged: list[Place] = []
    row: list[Place] = []

    def product(sources: Iterable[Any]) -> Array:
        total = np.eye(6)
        for source in sources:
            if id(source) not in matrices:
                matrices[id(source)] = first_order(source, energy)
            total = matrices[id(source)] @ total
        return total

    def close() -> None:
        sources = [source for _, _, source in row]
        angles = [float(source.angle) for source in sources]
        turns = sum(a * b < 0 for a, b in pairwise(angles))
        balanced = abs(sum(angles)) < 0.05 * sum(map(abs, angles))
        if len(row) >= WIGGLER_SLICES and turns >= 2 and balanced:
            whole = ocelot.Matrix(l=sum(float(source.l) for source in sources), eid="wiggler")
            whole.r = product(sources)
            log.info("%d thin bends from '%s' on are one wiggler", len(row), row[0][0])
            merged.append(("wiggler", "wiggler", whole))
        else:
            merged.extend(row)
        row.clear()

    for place in places:
        _, kind, source = place
        if kind == "bend" and 0 < float(source.l) <= THIN_BEND:
            row.append(place)
            continue
        close()
        merged.append(place)
    close()
    return merged
