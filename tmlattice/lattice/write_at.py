"""AT's elements of a ring, and AT's JSON through its own saver (`at.load_lattice` reads it)."""

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.at_file import from_ocelot, quiet_at
from tmlattice.lattice.parts import Part, strengths
from tmlattice.lattice.places import first_order, rotation
from tmlattice.lattice.plain import (
    BENDS,
    FIELDS,
    STRAIGHT,
    error_fields,
    part_of,
    second_order,
)
from tmlattice.lattice.ring import LIGHT, Element, Ring

STEP = 0.035
"""rad; phase sqrt(|k1|) l of a step of AT's integrator: the tunes of a ring are right to 1e-5."""


def holds(element: Element) -> tuple[str, ...]:
    """Errors for which AT has a place: T1 and T2, PolynomB and PolynomA."""
    cls = type(element.source).__name__
    if cls in STRAIGHT | BENDS and not (element.bending and cls not in BENDS):
        return ("dx", "dy", *FIELDS)
    return ("dx", "dy") if cls == "Matrix" else ()


def write(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements; what it lacks.

    Args:
        ring: of `plain`, with the errors that AT `holds`.
        path: to write to, whatever its suffix.
    """
    from at.load.json import save_json

    lattice, lacks = made(ring)
    save_json(lattice, str(path))
    return lacks


def made(ring: Ring) -> tuple[Any, tuple[str, ...]]:
    """An `at.Lattice` of plain elements with their families as names, and what it lacks."""
    import at

    left_out: Counter[str] = Counter()
    line = [_element(element, ring, left_out) for element in ring.elements]
    for element, own in zip(ring.elements, line, strict=True):
        if isinstance(own, at.Multipole):
            steps = math.ceil(math.sqrt(abs(element.k1)) * element.length / STEP)
            own.NumIntSteps = max(steps, own.NumIntSteps)
    name = Path(ring.name).stem
    with quiet_at():  # which warns of particles that are slower than light
        particle = at.Particle("relativistic")
        if not ring.radiates:
            particle = at.Particle("particle", rest_energy=ring.mass * 1e9, charge=1.0)
        lattice = at.Lattice(
            line, name=name, energy=ring.energy * 1e9, particle=particle, periodicity=1
        )
    return lattice, tuple(f"{what} ({count} elements)" for what, count in left_out.items())


def _element(element: Element, ring: Ring, left_out: Counter[str]) -> Any:
    import at

    part, source = part_of(element), element.source
    name, length = element.family, element.length
    keyword = "matrix" if part is None else part.keyword
    number = (part or Part(name, keyword)).number
    frame: dict[str, Any] = {}
    if element.tilt and keyword != "matrix":
        frame = {"R1": rotation(element.tilt), "R2": rotation(-element.tilt)}
    if element.errors.dx or element.errors.dy:
        shift = np.array([element.errors.dx, 0.0, element.errors.dy, 0.0, 0.0, 0.0])
        frame |= {"T1": -shift, "T2": shift}
    A, B = _polynoms(element, part)
    match keyword:
        case "monitor":
            drift = {"Length": length, "PassMethod": "DriftPass"} if length else {}
            return at.Monitor(name, **drift)
        case "rfcavity" if number("freq"):
            return _cavity(element, ring)
        case "drift" | "marker" | "rfcavity":
            return at.Drift(name, length) if length else at.Marker(name)
        case "hkicker" | "vkicker" | "kicker":
            mad = {} if keyword == "kicker" else {"MADType": keyword.upper()}
            return at.Corrector(name, length, [number("hkick"), number("vkick")], **mad)
        case "quadrupole" | "sextupole":
            cls = at.Quadrupole if keyword == "quadrupole" else at.Sextupole
            return cls(name, length, PolynomA=A, PolynomB=B, **frame)
        case "octupole":
            return at.Octupole(name, length, A, B, **frame)
        case "multipole" if length:
            return at.Multipole(name, length, A, B, **frame)
        case "multipole" if not number("angle"):
            return at.ThinMultipole(name, A, B, **frame)
        case "sbend":
            return at.Dipole(
                name, length, element.angle, PolynomA=A, PolynomB=B, EntranceAngle=number("e1"),
                ExitAngle=number("e2"), FullGap=2 * number("hgap"), FringeInt1=number("fint"),
                FringeInt2=number("fintx"), H1=number("h1"), H2=number("h2"), **frame,
            )  # fmt: skip
        case "multipole":
            left_out["thin bends are written as first-order matrices"] += 1
        case "matrix" if type(source).__name__ == "Matrix":
            if second_order(source):
                left_out["what matrix elements do beyond their matrix is left out"] += 1
        case _:
            left_out["elements that AT has not are written as first-order matrices"] += 1
    turn = from_ocelot(ring.map_energy)
    matrix = turn @ first_order(source, ring.map_energy) @ np.linalg.inv(turn)
    matrix = np.asfortranarray(matrix)
    shifts = {k: v for k, v in frame.items() if k[0] == "T"}  # its tilt is in the matrix
    return at.M66(name, matrix, Length=length, **shifts)


def _polynoms(element: Element, part: Part | None) -> tuple[Array, Array]:
    """PolynomA and PolynomB, the fields of the element's errors included."""
    total = np.zeros(4, dtype=complex) if part is None else strengths(part)
    total[:2] += np.array(error_fields(element)) / (element.length or 1.0)
    highest = max(np.flatnonzero(total), default=0)  # AT tracks every order that is there
    total = total[: max(highest, 2) + 1]
    return total.imag, total.real


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
