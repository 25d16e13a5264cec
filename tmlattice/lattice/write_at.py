"""Writing AT's JSON, through AT's own saver: `at.load_lattice(FILE)` reads it."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.lattice.at_file import quiet_at
from tmlattice.lattice.places import rotation
from tmlattice.lattice.ring import Element, Ring

Array = NDArray[np.float64]

LIGHT = 299792458.0


def write_at(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements; what it lacks.

    Args:
        ring: of `plain`.
        path: to write to, whatever its suffix.
    """
    from at.load.json import save_json

    lattice, told = at_lattice(ring)
    save_json(lattice, str(path))
    return told


def at_lattice(ring: Ring) -> tuple[Any, tuple[str, ...]]:
    """An `at.Lattice` of plain elements with their families as names, and what it lacks."""
    import at

    left_out: Counter[str] = Counter()
    line = [_element(element, ring, left_out) for element in ring.elements]
    name = Path(ring.name).stem
    with quiet_at():  # which warns of particles that are slower than light
        particle = at.Particle("relativistic")
        if not ring.radiates:
            particle = at.Particle("particle", rest_energy=ring.mass * 1e9, charge=1.0)
        lattice = at.Lattice(
            line, name=name, energy=ring.energy * 1e9, particle=particle, periodicity=1
        )
    return lattice, tuple(f"{what} ({count} elements)" for what, count in left_out.items())


def first_order(element: Element, energy: float) -> Array:
    """The matrix of an element in OCELOT's coordinates, [6, 6]."""
    total = np.eye(6)
    for part in element.source.R(energy):
        total = np.asarray(part) @ total
    return total


def second_order(source: Any) -> bool:
    """Whether a matrix element does more than its matrix."""
    return bool(np.any(source.t) or np.any(source.b) or source.delta_e)


def kicks(element: Element) -> tuple[float, float]:
    """Of a corrector, (x, y), rad; exactly zero in the other plane of an upright one."""
    x, y = element.angle * math.cos(element.tilt), element.angle * math.sin(element.tilt)
    size = 1e-12 * abs(element.angle)
    return (x if abs(x) > size else 0.0), (y if abs(y) > size else 0.0)


def _element(element: Element, ring: Ring, left_out: Counter[str]) -> Any:
    import at

    source, name, length = element.source, element.family, element.length
    turn: dict[str, Any] = {}
    if element.tilt:
        turn = {"R1": rotation(element.tilt), "R2": rotation(-element.tilt)}
    if element.kind == "monitor":
        drift = {"Length": length, "PassMethod": "DriftPass"} if length else {}
        return at.Monitor(name, **drift)
    match type(source).__name__:
        case "Quadrupole" if element.kind == "multipole":
            return at.Multipole(name, length, [0.0, 0.0], [0.0, element.k1], **turn)
        case "Quadrupole":
            field = [0.0, element.k1, element.k2 / 2]
            return at.Quadrupole(name, length, element.k1, PolynomB=field, **turn)
        case "Sextupole":
            return at.Sextupole(name, length, element.k2 / 2, **turn)
        case "Octupole":
            field = [0.0, 0.0, 0.0, float(source.k3) / 6]
            return at.Octupole(name, length, [0.0] * 4, field, **turn)
        case "SBend" | "RBend" | "Bend":
            return _bend(element, turn)
        case "Hcor" | "Vcor":
            x, y = kicks(element)
            vertical = element.kind == "vcorrector"
            other = x if vertical else y
            mad = {} if other else {"MADType": "VKICKER" if vertical else "HKICKER"}
            return at.Corrector(name, length, [x, y], **mad)
        case "CombinedMultipole" if element.bending:
            left_out["thin bends are written as first-order matrices"] += 1
        case "CombinedMultipole":
            return _combined(element, turn)
        case "Multipole" if not length:
            kn = np.asarray(source.kn, dtype=float)
            factorials = np.cumprod([1, *range(1, len(kn))])
            return at.ThinMultipole(name, np.zeros(len(kn)), kn / factorials, **turn)
        case "Cavity" if float(source.freq) > 0:
            return _cavity(element, ring)
        case "Drift" | "Marker" | "Monitor" | "Cavity":
            return at.Drift(name, length) if length else at.Marker(name)
        case "Matrix":
            if second_order(source):
                left_out["what matrix elements do beyond their matrix is left out"] += 1
        case _:
            left_out["elements that AT has not are written as first-order matrices"] += 1
    return at.M66(name, _to_at(first_order(element, ring.map_energy), ring.beta), Length=length)


def _combined(element: Element, turn: dict[str, Any]) -> Any:
    """Of the class of its kind, with all its fields."""
    import at

    source, name, length = element.source, element.family, element.length
    normal = [float(source.k0), float(source.k1), float(source.k2) / 2]
    skew = [float(source.k0s), float(source.k1s), float(source.k2s) / 2]
    if not length:
        return at.ThinMultipole(name, skew, normal, **turn)
    if element.kind == "quadrupole":
        return at.Quadrupole(name, length, normal[1], PolynomA=skew, PolynomB=normal, **turn)
    if element.kind == "sextupole":
        return at.Sextupole(name, length, normal[2], PolynomA=skew, PolynomB=normal, **turn)
    return at.Multipole(name, length, skew, normal, **turn)


def _bend(element: Element, turn: dict[str, Any]) -> Any:
    import at

    source = element.source
    return at.Dipole(
        element.family,
        element.length,
        element.angle,
        element.k1,
        PolynomB=[0.0, element.k1, element.k2 / 2],
        EntranceAngle=float(source.e1),
        ExitAngle=float(source.e2),
        FullGap=float(source.gap),
        FringeInt1=float(source.fint),
        FringeInt2=float(source.fintx),
        H1=float(source.h_pole1),
        H2=float(source.h_pole2),
        **turn,
    )


def _cavity(element: Element, ring: Ring) -> Any:
    """Switched off, as lattices are kept."""
    import at

    frequency = float(element.source.freq)
    return at.RFCavity(
        element.family,
        element.length,
        float(element.source.v) * 1e9,
        frequency,
        max(round(frequency * ring.length / (ring.beta * LIGHT)), 1),
        ring.energy * 1e9,
        PassMethod="DriftPass" if element.length else "IdentityPass",
    )


def _to_at(r: Array, beta: float) -> Array:
    """The matrix in AT's coordinates: the last two swap places and differ by beta."""
    to_ocelot = np.eye(6)
    to_ocelot[4:, 4:] = [[0.0, 1.0], [beta, 0.0]]
    return np.asfortranarray(np.linalg.inv(to_ocelot) @ r @ to_ocelot)
