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

from tmlattice.lattice.places import RADIUS, Place, halves
from tmlattice.lattice.ring import Kind

KIND_OF: dict[int, Kind] = {1: "quadrupole", 2: "sextupole", 3: "octupole"}


def strengths_of(element: Any) -> NDArray[np.complex128]:
    """B + i A of the orders that AT uses, scaled, four at least, kicks included, [order]; a linear
    pass method has the normal gradient alone."""
    B = np.atleast_1d(np.asarray(getattr(element, "PolynomB", [0.0]), dtype=float))
    A = np.atleast_1d(np.asarray(getattr(element, "PolynomA", [0.0]), dtype=float))
    orders = max(len(B), len(A), 4)
    total = np.zeros(orders, dtype=complex)
    total[: len(B)] += B
    total[: len(A)] += 1j * A
    highest = int(getattr(element, "MaxOrder", orders - 1))
    total[highest + 1 :] = 0.0
    kick = np.zeros(2)
    given = np.asarray(getattr(element, "KickAngle", (0.0, 0.0)), dtype=float).ravel()[:2]
    kick[: len(given)] = np.sin(given)
    total[0] += complex(-kick[0], kick[1]) / (float(getattr(element, "Length", 0.0)) or 1.0)
    total *= float(getattr(element, "FieldScaling", 1.0))
    if "Linear" in element.PassMethod:
        total[[0, *range(2, orders)]] = 0.0
        total[1] = total[1].real
    return total


def _normal(strength: complex, order: int) -> tuple[float, float]:
    """Derivative strength k_n and tilt of B + i A; the sign is that of the normal field, so that
    the tilt is at most half a pole's width."""
    k, n = strength * math.factorial(order), order + 1
    if k.imag == 0.0:
        return k.real, 0.0
    if k.real < 0.0:
        return -abs(k), -math.atan2(-k.imag, -k.real) / n
    return abs(k), -math.atan2(k.imag, k.real) / n


def straight(
    element: Any, family: str, length: float, mad: str, roll: float, left_out: Callable[[str], None]
) -> tuple[Kind, Any]:
    """A thick multipole of AT; see `straight_magnet`."""
    strengths, own = strengths_of(element), _own_order(element, mad)
    return straight_magnet(strengths, own, length, roll, family, left_out)


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
    if not orders:
        match own:
            case 1:
                return "quadrupole", ocelot.Quadrupole(l=length, tilt=roll, eid=family)
            case 2:
                return "sextupole", ocelot.Sextupole(l=length, tilt=roll, eid=family)
            case 3:
                return "octupole", ocelot.Octupole(l=length, tilt=roll, eid=family)
        return "multipole", ocelot.Quadrupole(l=length, k1=0.0, eid=family)
    if not low:
        if high == [3]:
            k, tilt = _normal(complex(strengths[3]), 3)
            return "octupole", ocelot.Octupole(l=length, k3=k, tilt=tilt + roll, eid=family)
        left_out("multipoles above the sextupole")
        return "multipole", ocelot.Drift(l=length, eid=family)
    if high:
        left_out("orders of multipoles above the sextupole")
    kind = _kind(strengths, own)
    if low == [1]:
        k, tilt = _normal(complex(strengths[1]), 1)
        return kind, ocelot.Quadrupole(l=length, k1=k, tilt=tilt + roll, eid=family)
    if low == [2]:
        k, tilt = _normal(complex(strengths[2]), 2)
        return kind, ocelot.Sextupole(l=length, k2=k, tilt=tilt + roll, eid=family)
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
    from tmlattice.lattice.combined import CombinedMultipole

    k = [complex(strength) * math.factorial(n) for n, strength in enumerate(strengths[:3])]
    return CombinedMultipole(
        l=length,
        k0=k[0].real, k0s=k[0].imag, k1=k[1].real, k1s=k[1].imag, k2=k[2].real, k2s=k[2].imag,
        tilt=roll,
        eid=family,
    )  # fmt: skip


def _own_order(element: Any, mad: str) -> int | None:
    """The order that a multipole's class, or its MADType, names."""
    import at

    known = ((at.Quadrupole, "QUADRUPOLE"), (at.Sextupole, "SEXTUPOLE"), (at.Octupole, "OCTUPOLE"))
    for order, (cls, name) in enumerate(known, 1):
        if isinstance(element, cls) or mad == name:
            return order
    return None


def _kind(strengths: Any, own: int | None) -> Kind:
    if own in (1, 2) and strengths[own] != 0:
        return KIND_OF[own]
    field = np.abs(strengths) * RADIUS ** np.arange(len(strengths))
    strongest = int(np.argmax(field))
    return KIND_OF[strongest] if strongest in (1, 2) else "multipole"


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
