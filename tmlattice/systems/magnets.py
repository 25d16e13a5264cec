"""Magnets from their equation of motion, independent of OCELOT's maps.

Hamilton's function of a magnet's body by the path length s, at the nominal energy, in OCELOT's
canonical coordinates (x, px, y, py), px = Px / p0:

    H = -(1 + h x) sqrt(1 - px^2 - py^2) + h x + h^2 x^2 / 2 + k1 V1 + k2 V2

with h the curvature, V1 = (x^2 - y^2) / 2 and V2 = (x^3 - 3 x y^2) / 6 and the terms of a curved
magnet that keep the field free of sources (from Laplace's equation). The root is expanded, so that
the map of the body is exact up to the given order, at most the third.

>>> magnet_map(ring["qd::4"], order=3)
>>> third_order_turn(ring, [3e-3, 0, 3e-3, 0]).rms()     # what third order adds to a turn, m
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.errors import BeamLostError
from tmlattice.maps import TaylorMap, element_map, part_maps, taylor_map_of_ode
from tmlattice.systems import Comparison

if TYPE_CHECKING:
    from tmlattice.lattice.ring import Element, Ring

Polynomial = dict[tuple[int, ...], float]  # exponents of (x, px, y, py) -> coefficient

KINDS = ("drift", "quadrupole", "bend", "sextupole")
LAUNCHES = (1e-3, 3e-3)


def hamiltonian(h: float = 0.0, k1: float = 0.0, k2: float = 0.0) -> Polynomial:
    """H of a magnet's body to the fourth degree, without its constant.

    Args:
        h: curvature of the design orbit, 1/m.
        k1, k2: gradient [1/m^2] and its slope [1/m^3]; k1 > 0 focuses in x.
    """
    H: Polynomial = {
        (0, 2, 0, 0): 0.5, (0, 0, 0, 2): 0.5,  # p^2 / 2
        (0, 4, 0, 0): 0.125, (0, 2, 0, 2): 0.25, (0, 0, 0, 4): 0.125,  # p^4 / 8
        (1, 2, 0, 0): h / 2, (1, 0, 0, 2): h / 2,  # h x p^2 / 2
        (2, 0, 0, 0): (h**2 + k1) / 2, (0, 0, 2, 0): -k1 / 2,
        (3, 0, 0, 0): h * k1 / 3 + k2 / 6, (1, 0, 2, 0): -h * k1 / 2 - k2 / 2,
        (0, 0, 4, 0): -(h**2) * k1 / 24 + h * k2 / 24,
        (4, 0, 0, 0): h * k2 / 8, (2, 0, 2, 0): -h * k2 / 2,
    }  # fmt: skip
    return {exponents: value for exponents, value in H.items() if value}


def hamilton_equations(H: Polynomial) -> dict[tuple[int, ...], Array]:
    """dx/ds = dH/dpx, dpx/ds = -dH/dx and the same in y, as terms for `taylor_map_of_ode`."""
    terms: dict[tuple[int, ...], Array] = {}
    for exponents, value in H.items():
        for i, power in enumerate(exponents):
            if power:
                below = tuple(e - (i == j) for j, e in enumerate(exponents))
                image, sign = (i - 1, 1.0) if i % 2 else (i + 1, -1.0)
                terms.setdefault(below, np.zeros(4))[image] += sign * power * value
    return terms


def _body(element: "Element", order: int) -> TaylorMap:
    h = element.angle / element.length if element.kind == "bend" else 0.0
    k2 = element.k2 if element.kind in ("sextupole", "bend") else 0.0
    k1 = element.k1 if element.kind in ("quadrupole", "bend") else 0.0
    terms = hamilton_equations(hamiltonian(h, k1, k2))
    return taylor_map_of_ode(terms, order, element.length)


def _tilted(element: "Element") -> bool:
    return bool(getattr(element.source, "tilt", False))


def magnet_map(element: "Element", order: int = 3) -> TaylorMap:
    """Return the map of a magnet's body from its equation of motion, in (x, px, y, py).

    Args:
        element: a drift, quadrupole, bend or sextupole that has a length and no tilt.
        order: 1 to 3.

    Raises:
        ValueError: another kind, or a tilted one.
    """
    if element.kind not in KINDS or _tilted(element):
        raise ValueError(
            f"'{element.name}' is no upright {', '.join(KINDS[:-1])} or {KINDS[-1]}; its map "
            "comes from OCELOT: element_map"
        )
    return _body(element, order)


def henon_map(tune: float, strength: float = 1.0) -> TaylorMap:
    """Return Henon's map: a sextupole kick px -= strength x^2, then a turn of 2 pi tune; exact."""
    angle = 2 * np.pi * tune
    c, s = np.cos(angle), np.sin(angle)
    kick = TaylorMap([np.zeros(2), np.eye(2), np.array([[0, 0, 0], [-strength, 0, 0]])])
    return TaylorMap.linear([[c, s], [-s, c]]) @ kick


@dataclass(frozen=True)
class Agreement:
    """Difference of OCELOT's body maps of one kind from those of the equation of motion.

    Attributes:
        kind: of element.
        count: distinct ones compared.
        first, second: largest difference of a coefficient of W1, of W2, in m and rad.
        second_size: largest coefficient of W2.
        third_size: largest coefficient of W3, which OCELOT's maps leave out.
    """

    kind: str
    count: int
    first: float
    second: float
    second_size: float
    third_size: float


def agreements(ring: "Ring") -> list[Agreement]:
    """Compare all distinct upright drifts, quadrupoles, bends and sextupoles with OCELOT."""
    found = []
    for kind in KINDS:
        seen: set[tuple[float, ...]] = set()
        differences = []
        for element in ring.elements:
            key = (element.length, element.angle, element.k1, element.k2)
            if element.kind != kind or key in seen or element.length <= 0 or _tilted(element):
                continue
            seen.add(key)
            ours = magnet_map(element, 3).coefficients
            parts = part_maps(element, ring.map_energy)
            theirs = parts[len(parts) // 2].coefficients
            differences.append([
                np.abs(ours[1] - theirs[1]).max(), np.abs(ours[2] - theirs[2]).max(),
                np.abs(ours[2]).max(), np.abs(ours[3]).max(),
            ])  # fmt: skip
        if differences:
            found.append(Agreement(kind, len(seen), *map(float, np.max(differences, axis=0))))
    return found


@dataclass(frozen=True)
class ThirdOrderTurn:
    """One turn at the monitors by maps of second and of third order.

    Attributes:
        launch: [4], m and rad.
        s: of the monitors, m.
        second, third: readings (x, y) by our maps of that order, m, [monitor, 2].
    """

    launch: Array
    s: Array
    second: Array
    third: Array

    def rms(self) -> tuple[float, float]:
        """Rms over the monitors of third less second order in x and y, m."""
        x, y = np.sqrt(np.mean((self.third - self.second) ** 2, axis=0))
        return float(x), float(y)


def turn_maps(ring: "Ring", order: int) -> Iterator[tuple["Element", list[TaylorMap]]]:
    """Yield every element with its maps in beam order, bodies from the equation of motion.

    Bends' edges and elements that are no drift, quadrupole, bend or sextupole are OCELOT's, of
    second order. A corrector, monitor or tilted magnet of zero strength is a drift of its length.
    """
    known: dict[tuple[object, ...], list[TaylorMap]] = {}
    for element in ring.elements:
        key = (element.kind, element.length, element.angle, element.k1, element.k2,
               getattr(element.source, "e1", 0), getattr(element.source, "e2", 0))  # fmt: skip
        maps = known.get(key) if element.kind != "wiggler" else None
        if maps is None:
            maps = known[key] = _maps_of(element, ring.map_energy, order)
        yield element, maps


def _maps_of(element: "Element", energy: float, order: int) -> list[TaylorMap]:
    straight = element_map(element, energy)
    drift = TaylorMap.identity(4).coefficients[1]
    drift[0, 1] = drift[2, 3] = element.length
    W = straight.coefficients
    if not W[0].any() and not W[2].any() and np.array_equal(W[1], drift):
        if element.length == 0:
            return []
        return [taylor_map_of_ode(hamilton_equations(hamiltonian()), order, element.length)]
    if element.kind in KINDS and not _tilted(element) and element.length:
        parts = part_maps(element, energy)
        parts[len(parts) // 2] = _body(element, order)
        return parts
    return [straight]


def third_order_turn(ring: "Ring", launch: ArrayLike) -> ThirdOrderTurn:
    """Return one turn of a launch (x, px, y, py) by maps of second and third order.

    Args:
        launch: [4], m and rad.

    Raises:
        BeamLostError: the launch leaves the ring.
    """
    x = np.asarray(launch, dtype=float)
    readings = [_readings(ring, x, order) for order in (2, 3)]
    return ThirdOrderTurn(x, np.array([m.s for m in ring.monitors]), *readings)


def _readings(ring: "Ring", x: Array, order: int) -> Array:
    read = []
    for element, maps in turn_maps(ring, order):
        before = x
        for m in maps:
            x = m(x)
        if not (np.abs(x) < 1.0).all():
            raise BeamLostError(
                f"the launch is lost at '{element.name}' (s = {element.s:.2f} m); launch nearer "
                "to the axis"
            )
        if element.kind == "monitor":  # read in its middle
            read.append(0.5 * (before + x)[[0, 2]])
    return np.array(read)


@dataclass(frozen=True)
class MagnetStudy:
    """Everything of `tmlattice dev reproduce magnets`."""

    agreements: list[Agreement]
    turns: list[ThirdOrderTurn]
    henon: TaylorMap


def study(ring: "Ring", launches: tuple[float, ...] = LAUNCHES) -> MagnetStudy:
    """Compare maps with OCELOT's, and turns launched at x = y = each of `launches` [m]."""
    turns = [third_order_turn(ring, [a, 0.0, a, 0.0]) for a in launches]
    return MagnetStudy(agreements(ring), turns, henon_map(0.2114))


WHY: dict[str, str] = {
    "drift": "both are the expanded exact drift: no second order; third is L p^2 px / 2",
    "quadrupole": "the same physics; no second order at the nominal energy",
    "bend": "the same physics: sector body with the field of the exact curved frame",
    "sextupole": "the same physics: k2 along the length, no thin kick",
}


def comparisons(done: MagnetStudy) -> list[Comparison]:
    """Return comparisons of OCELOT's maps with the equation of motion, and of third order."""
    rows = [
        Comparison(f"{a.count} {a.kind}s: largest difference to OCELOT in W1 / W2", None,
                   f"{a.first:.1e} / {a.second:.1e}",
                   f"largest W2 {a.second_size:.3g}, left-out W3 {a.third_size:.3g}; "
                   f"{WHY[a.kind]}")
        for a in done.agreements
    ]  # fmt: skip
    for turn in done.turns:
        x, y = turn.rms()
        rows.append(
            Comparison(f"third order in one turn from x = y = {1e3 * turn.launch[0]:g} mm: "
                       "rms over BPMs, x / y [µm]", None, f"{1e6 * x:.3f} / {1e6 * y:.3f}",
                       "bodies and drifts in third order; bends' edges stay of second")
        )  # fmt: skip
    defect = max(float(np.abs(part).max()) for part in done.henon.symplectic_defect())
    rows.append(
        Comparison("Henon map: largest symplectic defect of any degree", None, f"{defect:.1e}",
                   "exact in second order, as an infinitely thin sextupole is")
    )  # fmt: skip
    return rows
