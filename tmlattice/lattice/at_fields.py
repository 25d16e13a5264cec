"""The fields of AT's multipoles and bends, as OCELOT elements.

AT's strength of order n is B + i A = PolynomB[n] + i PolynomA[n] = (k_n + i k_ns) / n!, and its
kick is px -= Re, py += Im of it times (x + i y)^n. `KickAngle` of a multipole adds to its dipole
field: px += KickAngle[0], py += KickAngle[1] over its length.

A magnet of one field is OCELOT's quadrupole, sextupole or octupole; with several it is a
`CombinedMultipole`, in which none is lost up to the sextupole. What such a magnet is called follows
its class or MADType where it has that field, else its strongest field at 2 cm from the axis.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.lattice.places import KIND_OF, Place, halves, strongest
from tmlattice.lattice.ring import Kind


def strengths_of(element: Any) -> NDArray[np.complex128]:
    """B + i A of the orders that AT uses, scaled, four at least, kicks included, [order]; a linear
    pass method has the normal gradient alone."""
    B, A = (
        np.atleast_1d(np.asarray(getattr(element, key, 0.0), dtype=float))
        for key in ("PolynomB", "PolynomA")
    )
    orders = max(len(B), len(A), 4)
    total = np.zeros(orders, dtype=complex)
    total.real[: len(B)], total.imag[: len(A)] = B, A
    highest = int(getattr(element, "MaxOrder", orders - 1))
    total[highest + 1 :] = 0.0
    x, y = np.sin(kicks_of(element))
    total[0] += complex(-x, y) / (float(getattr(element, "Length", 0.0)) or 1.0)
    total *= float(getattr(element, "FieldScaling", 1.0))
    if "Linear" in element.PassMethod:
        total[[0, *range(2, orders)]] = 0.0
        total[1] = total[1].real
    return total


def kicks_of(element: Any) -> NDArray[np.float64]:
    """`KickAngle` in x and y, rad, [2]; 0 where it is missing."""
    given = np.ravel(np.asarray(getattr(element, "KickAngle", ()), dtype=float))[:2]
    kicks = np.zeros(2)
    kicks[: len(given)] = given
    return kicks


def _normal(strength: complex, order: int) -> tuple[float, float]:
    """Derivative strength k_n and tilt of B + i A; the sign is that of the normal field, so that
    the tilt is at most half a pole's width."""
    k, n = strength * math.factorial(order), order + 1
    if k.imag == 0.0:
        return k.real, 0.0
    if k.real < 0.0:
        return -abs(k), -math.atan2(-k.imag, -k.real) / n
    return abs(k), -math.atan2(k.imag, k.real) / n


def straight_magnet(
    strengths: NDArray[np.complex128],
    own: int | None,
    length: float,
    roll: float,
    family: str,
    left_out: Callable[[str], None],
) -> tuple[Kind, Any]:
    """A thick straight magnet: one of OCELOT's where it has one field, else a combined one.

    Args:
        strengths: (k_n + i k_ns) / n! of order n, four at least, [order].
        own: the order that its class names: 1 of a quadrupole.
        length: m.
        roll: rad.
        family: its name.
        left_out: takes the reason where a field is not modelled.
    """
    from tmlattice.lattice.ocelot import elements as ocelot

    orders = [n for n in range(len(strengths)) if strengths[n] != 0]
    low = [n for n in orders if n <= 2]
    high = [n for n in orders if n > 2]
    classes = {1: ocelot.Quadrupole, 2: ocelot.Sextupole, 3: ocelot.Octupole}
    if not orders:
        if own in classes:
            return KIND_OF[own], classes[own](l=length, tilt=roll, eid=family)
        return "multipole", ocelot.Quadrupole(l=length, k1=0.0, eid=family)
    if not low and high != [3]:
        left_out("multipoles above the sextupole")
        return "multipole", ocelot.Drift(l=length, eid=family)
    if low and high:
        left_out("orders of multipoles above the sextupole")
    kind = KIND_OF[own] if own in (1, 2) and own in low else strongest(strengths)
    kept = low or high
    if kept == [3]:
        k, tilt = _normal(complex(strengths[3]), 3)
        return "octupole", ocelot.Octupole(l=length, k3=k, tilt=tilt + roll, eid=family)
    if kept in ([1], [2]):
        k, tilt = _normal(complex(strengths[kept[0]]), kept[0])
        source = classes[kept[0]](l=length, tilt=tilt + roll, eid=family, **{f"k{kept[0]}": k})
        return kind, source
    if low == [1, 2] and kind == "quadrupole" and not strengths[:3].imag.any():
        k1, k2 = strengths[1].real, 2 * strengths[2].real
        return kind, ocelot.Quadrupole(l=length, k1=k1, k2=k2, tilt=roll, eid=family)
    return kind, _combined(strengths, length, roll, family)


def thin(
    element: Any, family: str, length: float, roll: float, left_out: Callable[[str], None]
) -> tuple[Kind, Any]:
    """A multipole of integrated fields."""
    strengths = strengths_of(element) / (length or 1.0)
    if np.any(strengths[3:]):
        left_out("thin multipoles above the sextupole")
    return "multipole", _combined(strengths, length, roll, family)


def _combined(strengths: Any, length: float, roll: float, family: str) -> Any:
    from tmlattice.lattice.combined import CombinedMultipole, fields_of

    k = [complex(strength) * math.factorial(n) for n, strength in enumerate(strengths[:3])]
    return CombinedMultipole(l=length, tilt=roll, eid=family, **fields_of(k))


def own_order(element: Any, mad: str) -> int | None:
    """The order that a multipole's class, or its MADType, names."""
    import at

    for order, cls in enumerate((at.Quadrupole, at.Sextupole, at.Octupole), 1):
        if isinstance(element, cls) or mad == cls.__name__.upper():
            return order
    return None


def bend(
    element: Any, family: str, length: float, roll: float, left_out: Callable[[str], None]
) -> tuple[Kind, Any]:
    """A bend with its edges, gradient and sextupole field; see `with_coils` for its others."""
    from tmlattice.lattice.ocelot import elements as ocelot

    strengths = strengths_of(element)
    if any(strengths[3:]):
        left_out("orders of bends above the sextupole")
    source = ocelot.SBend(
        l=length,
        angle=float(element.BendingAngle),
        k1=complex(strengths[1]).real,
        k2=2.0 * complex(strengths[2]).real,
        e1=float(getattr(element, "EntranceAngle", 0.0)),
        e2=float(getattr(element, "ExitAngle", 0.0)),
        tilt=roll,
        gap=float(getattr(element, "FullGap", 0.0)),
        fint=_fringe(element, "FringeInt1", "FringeBendEntrance"),
        fintx=_fringe(element, "FringeInt2", "FringeBendExit"),
        h_pole1=float(getattr(element, "H1", 0.0)),
        h_pole2=float(getattr(element, "H2", 0.0)),
        eid=family,
    )
    return "bend", source


def _fringe(element: Any, integral: str, model: str) -> float:
    """The fringe integral of a face; model 0 has none."""
    return float(getattr(element, integral, 0.0)) if getattr(element, model, 1) else 0.0


def with_coils(element: Any, family: str, source: Any) -> list[Place]:
    """A bend; with skew fields or a field error it is cut into halves, and they are in between."""
    strengths = strengths_of(element)[:3]
    others = np.array([strengths[0], 1j * strengths[1].imag, 1j * strengths[2].imag])
    if not others.any():
        return [(family, "bend", source)]
    first, second = halves(source)
    name = f"{family}_coil"
    coil: Place = (name, "multipole", _combined(source.l * others, 0.0, source.tilt, name))
    return [(family, "bend", first), coil, (f"{family}_2", "bend", second)]
