"""From OCELOT objects in beam order to named elements: what all lattice readers share."""

import copy
import logging
import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import LatticeError, first_of
from tmlattice.lattice.ring import Element, Kind, number_names

log = logging.getLogger(__name__)

Place = tuple[str, Kind, Any]
"""Family, kind and OCELOT element, before its name has a number."""
KIND_OF: dict[int, Kind] = {1: "quadrupole", 2: "sextupole", 3: "octupole"}
MAIN_ORDER: dict[str, int] = {kind: order for order, kind in KIND_OF.items()}
"""Of the main field of a kind of magnet: 1 of a quadrupole."""


def rotation(angle: float) -> NDArray[np.float64]:
    """Coordinates seen by a magnet turned by `angle` (rad) from x towards y, [6, 6]."""
    matrix = np.eye(6)
    cos, sin = math.cos(angle), math.sin(angle)
    matrix[:4, :4] = np.kron([[cos, sin], [-sin, cos]], np.eye(2))
    return matrix


def first_order(source: Any, energy: float) -> NDArray[np.float64]:
    """The matrix of an OCELOT element in its own coordinates, [6, 6]; energy in GeV."""
    total = np.eye(6)
    for part in source.R(energy):
        total = np.asarray(part) @ total
    return total


def corrector(family: str, plane: Literal["h", "v"], length: float, kick: float = 0.0) -> Place:
    """A horizontal ("h") or vertical ("v") corrector; length in m, kick in rad."""
    from tmlattice.lattice.ocelot import elements

    cls, kind = (elements.Hcor, "hcorrector") if plane == "h" else (elements.Vcor, "vcorrector")
    return family, cast(Kind, kind), cls(l=length, angle=kick, eid=family)


def corrector_pair(family: str, length: float, x: float = 0.0, y: float = 0.0) -> list[Place]:
    """A corrector of both planes: FAMILY_h and FAMILY_v, thin, in the middle of its length.

    Args:
        family: its name.
        length: m; a way of half of it lies before and behind.
        x, y: kicks, rad.
    """
    from tmlattice.lattice.ocelot import elements

    pair = [corrector(f"{family}_h", "h", 0.0, x), corrector(f"{family}_v", "v", 0.0, y)]
    if length == 0:
        return pair
    half: Place = (f"{family}_half", "drift", elements.Drift(l=length / 2, eid=f"{family}_half"))
    return [half, *pair, half]


def source_kind(source: Any, name: str) -> Kind:
    """What an OCELOT element of this name is; a matrix with "wig" in its name is a wiggler."""
    from tmlattice.lattice.ocelot import elements as e

    kinds: list[tuple[Any, Kind]] = [
        (e.Drift, "drift"),
        (e.Quadrupole, "quadrupole"),
        (e.XYQuadrupole, "quadrupole"),
        ((e.Bend, e.SBend, e.RBend), "bend"),
        (e.Hcor, "hcorrector"),
        (e.Vcor, "vcorrector"),
        (e.Sextupole, "sextupole"),
        (e.Octupole, "octupole"),
        (e.Multipole, "multipole"),
        (e.Solenoid, "solenoid"),
        (e.Undulator, "wiggler"),
        (e.Monitor, "monitor"),
        ((e.Cavity, e.TDCavity, e.TWCavity), "cavity"),
    ]
    for classes, kind in kinds:
        if isinstance(source, classes):
            return kind
    if type(source).__name__ == "CombinedMultipole":
        fields = ((source.k0, source.k0s), (source.k1, source.k1s), (source.k2 / 2, source.k2s / 2))
        return strongest([complex(*own) for own in fields]) if source.l else "multipole"
    if isinstance(source, e.Matrix):  # OCELOT has no damping wiggler: the name tells
        return "wiggler" if "wig" in name.casefold() else "matrix"
    return "drift" if source.l else "marker"


def halves(source: Any) -> tuple[Any, Any]:
    """The two halves of an OCELOT element; a bend's edges stay at its ends."""
    first, second = (copy.deepcopy(source) for _ in range(2))
    first.l = second.l = source.l / 2
    if hasattr(source, "e1"):
        first.angle = second.angle = source.angle / 2
        first.e2 = first.fintx = first.h_pole2 = 0.0
        second.e1 = second.fint = second.h_pole1 = 0.0
    return first, second


RADIUS = 0.02
"""m; where fields of several orders are compared."""


def strongest(strengths: Any) -> Kind:
    """What a magnet is by its strongest field at `RADIUS`, of (k_n + i k_ns) / n!, [order]."""
    order = int(np.argmax(np.abs(strengths) * RADIUS ** np.arange(len(strengths))))
    return KIND_OF[order] if order in (1, 2) else "multipole"


def place_elements(
    families: Sequence[str], sources: Sequence[Any], kinds: Sequence[Kind] | None = None
) -> tuple[Element, ...]:
    """Elements in beam order: numbered names, positions, and the strengths of their sources.

    What the maps cannot model is warned of: an octupole is a drift at second order.

    Args:
        families: names without numbers.
        sources: OCELOT elements; one object may stand in many places.
        kinds: else what `source_kind` returns for each source and its family's name.

    Raises:
        LatticeError: a length that is not finite.
    """
    for source in {id(source): source for source in sources}.values():
        length = float(source.l)
        if not math.isfinite(length):
            raise LatticeError(
                f"'{source.id}' has the length {length}; correct it in the lattice file"
            )
        if length < 0:
            log.debug("element '%s' has the negative length %.3g m", source.id, length)
    _warn_of_octupoles(families, sources)
    if kinds is None:
        kinds = [source_kind(source, name) for source, name in zip(sources, families, strict=True)]
    placed = []
    start = 0.0
    for name, family, kind, source in zip(
        number_names(families), families, kinds, sources, strict=True
    ):
        length = float(source.l)
        placed.append(
            Element(
                name=name,
                family=family,
                kind=kind,
                s=start + length / 2,
                length=length,
                k1=float(getattr(source, "k1", 0.0)),
                k2=float(getattr(source, "k2", 0.0)),
                angle=float(getattr(source, "angle", 0.0)),
                tilt=float(getattr(source, "tilt", 0.0)),
                source=source,
            )
        )
        start += length
    return tuple(placed)


def _warn_of_octupoles(families: Sequence[str], sources: Sequence[Any]) -> None:
    from tmlattice.lattice.ocelot import elements

    names = [
        family for family, source in zip(families, sources, strict=True)
        if isinstance(source, elements.Octupole) and source.k3 != 0
    ]  # fmt: skip
    if names:
        kinds = list(dict.fromkeys(names))
        warnings.warn(
            "octupoles are drifts in the network and in optics; trajectories have them: "
            f"{first_of(kinds, 3)} ({len(names)})",
            stacklevel=4,
        )
