"""AT's elements of a ring, and AT's JSON through its own saver (`at.load_lattice` reads it)."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.lattice.at_file import quiet_at
from tmlattice.lattice.places import rotation
from tmlattice.lattice.plain import BENDS, FIELDS, STRAIGHT, error_fields
from tmlattice.lattice.ring import Element, Ring

Array = NDArray[np.float64]

LIGHT = 299792458.0
STEP = 0.035
"""rad; phase sqrt(|k1|) l of a step of AT's integrator: the tunes of a ring are right to 1e-5."""


def holds(element: Element) -> tuple[str, ...]:
    """Errors for which AT has a place: T1 and T2, PolynomB and PolynomA."""
    cls = type(element.source).__name__
    if cls in STRAIGHT | BENDS and not (element.bending and cls not in BENDS):
        return ("dx", "dy", *FIELDS)
    return ("dx", "dy") if cls == "Matrix" else ()


def write_at(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements; what it lacks.

    Args:
        ring: of `plain`, with the errors that AT `holds`.
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
    for element, made in zip(ring.elements, line, strict=True):
        if isinstance(made, at.Multipole):
            steps = math.ceil(math.sqrt(abs(element.k1)) * element.length / STEP)
            made.NumIntSteps = max(steps, made.NumIntSteps)
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
    frame: dict[str, Any] = {}
    if element.tilt:
        frame = {"R1": rotation(element.tilt), "R2": rotation(-element.tilt)}
    if element.errors.dx or element.errors.dy:
        shift = np.array([element.errors.dx, 0.0, element.errors.dy, 0.0, 0.0, 0.0])
        frame |= {"T1": -shift, "T2": shift}
    if element.kind == "monitor":
        drift = {"Length": length, "PassMethod": "DriftPass"} if length else {}
        return at.Monitor(name, **drift)
    match type(source).__name__:
        case "Quadrupole" if element.kind == "multipole":
            A, B = _polynoms(element, [0.0, element.k1])
            return at.Multipole(name, length, A, B, **frame)
        case "Quadrupole":
            A, B = _polynoms(element, [0.0, element.k1, element.k2])
            return at.Quadrupole(name, length, PolynomA=A, PolynomB=B, **frame)
        case "Sextupole":
            A, B = _polynoms(element, [0.0, 0.0, element.k2])
            return at.Sextupole(name, length, PolynomA=A, PolynomB=B, **frame)
        case "Octupole":
            return at.Octupole(name, length, *_polynoms(element, [0, 0, 0, source.k3]), **frame)
        case "SBend" | "RBend" | "Bend":
            return _bend(element, frame)
        case "Hcor" | "Vcor":
            x, y = kicks(element)
            vertical = element.kind == "vcorrector"
            other = x if vertical else y
            mad = {} if other else {"MADType": "VKICKER" if vertical else "HKICKER"}
            return at.Corrector(name, length, [x, y], **mad)
        case "CombinedMultipole" if element.bending:
            left_out["thin bends are written as first-order matrices"] += 1
        case "CombinedMultipole":
            return _combined(element, frame)
        case "Multipole" if not length:
            return at.ThinMultipole(name, *_polynoms(element, list(source.kn)), **frame)
        case "Cavity" if float(source.freq) > 0:
            return _cavity(element, ring)
        case "Drift" | "Marker" | "Monitor" | "Cavity":
            return at.Drift(name, length) if length else at.Marker(name)
        case "Matrix":
            if second_order(source):
                left_out["what matrix elements do beyond their matrix is left out"] += 1
        case _:
            left_out["elements that AT has not are written as first-order matrices"] += 1
    matrix = _to_at(first_order(element, ring.map_energy), ring.beta)
    shifts = {k: v for k, v in frame.items() if k[0] == "T"}  # its tilt is in the matrix
    return at.M66(name, matrix, Length=length, **shifts)


def _polynoms(
    element: Element, normal: list[float], skew: tuple[float, ...] = ()
) -> tuple[Array, Array]:
    """PolynomA and PolynomB of fields k_n and k_ns, those of the element's errors included."""
    fields = np.zeros(max(len(normal), 2), dtype=complex)
    fields[: len(normal)] += np.asarray(normal, dtype=float)
    fields[: len(skew)] += 1j * np.asarray(skew, dtype=float)
    fields[:2] += np.array(error_fields(element)) / (element.length or 1.0)
    fields /= np.cumprod([1, *range(1, len(fields))])
    return fields.imag, fields.real


def _combined(element: Element, frame: dict[str, Any]) -> Any:
    """Of the class of its kind, with all its fields."""
    import at

    source, name, length = element.source, element.family, element.length
    skew = (float(source.k0s), float(source.k1s), float(source.k2s))
    A, B = _polynoms(element, [float(source.k0), float(source.k1), float(source.k2)], skew)
    if not length:
        return at.ThinMultipole(name, A, B, **frame)
    if element.kind == "quadrupole":
        return at.Quadrupole(name, length, PolynomA=A, PolynomB=B, **frame)
    if element.kind == "sextupole":
        return at.Sextupole(name, length, PolynomA=A, PolynomB=B, **frame)
    return at.Multipole(name, length, A, B, **frame)


def _bend(element: Element, frame: dict[str, Any]) -> Any:
    import at

    source = element.source
    A, B = _polynoms(element, [0.0, element.k1, element.k2])
    return at.Dipole(
        element.family,
        element.length,
        element.angle,
        PolynomA=A,
        PolynomB=B,
        EntranceAngle=float(source.e1),
        ExitAngle=float(source.e2),
        FullGap=float(source.gap),
        FringeInt1=float(source.fint),
        FringeInt2=float(source.fintx),
        H1=float(source.h_pole1),
        H2=float(source.h_pole2),
        **frame,
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
