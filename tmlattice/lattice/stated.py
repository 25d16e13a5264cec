"""What a lattice file states of its own ring, and whether the ring that was read agrees.

The linear optics here is the product of OCELOT's matrices: a check of a reader, without the maps
and sweeps of the package.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.ring import NO_ERRORS, Element, Ring

TUNES, TUNES_WITH_RF = 1e-4, 1e-3
"""Both codes multiply the same linear maps: from five digits a tune agrees to 1e-5. A magnet that
is lost or misread changes it by more than this in all but the weakest. Cavities that are on, where
the dispersion is not zero, change the header's tunes; here they are off."""
COMPACTION = 1e-2
CHROMATICITY = (0.5, 0.02)
"""Absolute and relative; MAD-X's own is an approximation where motion is coupled."""
LENGTH = 1e-6
"""Relative to the ring's length, in addition to 1 mm."""
STRAIGHT = 1e-6
"""m; an orbit below it is none."""
ORBIT = 0.1
"""Of the largest orbit: positions between elements have another, and so has the third order."""
STEP = 1e-6
"""Of the relative energy, for a difference: a tune near an integer must not cross it."""


@dataclass(frozen=True)
class Stated:
    """What a header states; None where it does not.

    Attributes:
        length: m.
        tunes: with or without integers, [2].
        chromaticity: dQ / d pt, [2].
        compaction: momentum compaction.
        orbit: largest closed orbit, m.
        tolerance: of the tunes.
        differences: whether the chromaticity is MAD-X's CHROM, whose differences between two
            energies scale the faces of bends with the momentum; None: unknown.
    """

    length: float | None = None
    tunes: tuple[float, float] | None = None
    chromaticity: tuple[float, float] | None = None
    compaction: float | None = None
    orbit: float = 0.0
    tolerance: float = TUNES
    differences: bool | None = False

    @classmethod
    def of_header(cls, header: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> "Stated":
        """Of a TWISS table. Its tunes are those of the design only where the orbit is straight;
        without them in the header, the phase advances of the last row are."""

        def number(key: str, where: Mapping[str, Any] = header) -> float | None:
            try:
                value = float(where[key])
            except (KeyError, TypeError, ValueError):
                return None
            return value if np.isfinite(value) else None

        def pair(first: str, second: str) -> tuple[float, float] | None:
            a, b = number(first), number(second)
            return None if a is None or b is None or not (a or b) else (a, b)

        orbit = max([0.0, *(abs(float(row.get(k) or 0.0)) for row in rows for k in ("X", "Y")),
                     *(abs(number(k) or 0.0) for k in ("XCOMAX", "YCOMAX"))])  # fmt: skip
        if number("DELTAP"):
            return cls(number("LENGTH"))
        if orbit > STRAIGHT:
            return cls(number("LENGTH"), orbit=orbit)
        last = rows[-1] if rows else {}
        mux, muy = number("MUX", last), number("MUY", last)
        phases = None if mux is None or muy is None or not (mux or muy) else (mux, muy)
        # of second order BV=-1 is not the reversed fields in MAD-X itself; PTC may leave out
        # products of curvature and gradient
        other = number("BV_FLAG") == -1 or "PTC" in str(header.get("NAME"))
        slopes = None if other else pair("DQ1", "DQ2")
        # without the column of its voltage a cavity may be on
        rf = any(row.get("VOLT", row.get("KEYWORD") == "RFCAVITY") for row in rows)
        chrom = any(row["WX"] for row in rows) if "WX" in last else None  # 0 without CHROM
        return cls(
            number("LENGTH"), pair("Q1", "Q2") or phases,
            None if rf and chrom is not False else slopes, number("ALFA") or None,
            tolerance=TUNES_WITH_RF if rf else TUNES, differences=chrom,
        )  # fmt: skip


def contradiction(ring: Ring, stated: Stated) -> str | None:
    """The first figure of the ring that differs from what its file states, with both numbers."""
    if stated.length is not None and abs(ring.length - stated.length) > 1e-3 + LENGTH * ring.length:
        return f"its elements are {ring.length:.6f} m long, the header states {stated.length:.6f} m"
    if stated.orbit > STRAIGHT and not any(map(_kicks, ring.elements)):
        return (
            f"nothing in it bends the orbit, the table has one of {1e3 * stated.orbit:.3g} mm: "
            "errors of elements and losses by radiation are not in a table"
        )
    chain = _maps(ring)
    if stated.orbit > STRAIGHT and all(e.errors == NO_ERRORS for e in ring.elements):
        largest = _largest_orbit(chain)
        if abs(largest - stated.orbit) > ORBIT * stated.orbit + STRAIGHT:
            return (
                f"its closed orbit is {1e3 * largest:.3g} mm at most, the table has "
                f"{1e3 * stated.orbit:.3g} mm: "
                "errors of elements and losses by radiation are not in a table"
            )
    if stated.tunes is None:
        return None
    matrix, _ = _turn(chain, np.zeros(6))
    tunes = _tunes(matrix[:4, :4])
    if tunes is None:
        return f"its motion is unstable, the header states tunes of {_two(stated.tunes)}"
    wanted = np.cos(2 * np.pi * np.array(stated.tunes))
    found = np.cos(2 * np.pi * tunes)
    if abs(found - wanted).max() > abs(found[::-1] - wanted).max():
        found, tunes = found[::-1], tunes[::-1]
    # by angles, so that a tune near 0 or 1/2 has the tolerance of any other
    away = np.abs(np.arccos(np.clip(found, -1, 1)) - np.arccos(np.clip(wanted, -1, 1)))
    if (away / (2 * np.pi)).max() > stated.tolerance:
        own = [q if np.sin(2 * np.pi * s) >= 0 else 1 - q
               for q, s in zip(tunes, stated.tunes, strict=True)]  # fmt: skip
        return f"its tunes are {_two(own)} (fractions), the header states {_two(stated.tunes)}"
    dispersion, late = _off_energy(matrix, ring.length)
    if stated.compaction is not None:
        compaction = ring.beta**2 * late + ring.gamma**-2
        share = COMPACTION * (5 if stated.tolerance > TUNES else 1)  # with cavities that are on
        if abs(compaction - stated.compaction) > share * abs(stated.compaction) + 1e-7:
            return (
                f"its momentum compaction is {compaction:.6g}, the header states "
                f"{stated.compaction:.6g}"
            )
    if stated.chromaticity is None:
        return None
    rising = np.where(np.sin(2 * np.pi * np.array(stated.tunes)) >= 0, 1.0, -1.0)
    rank = np.argsort(np.argsort(tunes))  # modes are in the order of their tunes
    allowed = CHROMATICITY[0] + CHROMATICITY[1] * np.abs(stated.chromaticity)
    slopes = list[Array]()
    for differences in (False, True) if stated.differences is None else (stated.differences,):
        shifted = []
        for delta in (STEP, -STEP):
            launch = np.concatenate([dispersion, [0.0, 1.0]]) * delta
            chain = _maps(ring, 1.0 + delta * differences / ring.beta)
            off = _tunes(_turn(chain, launch)[0][:4, :4])
            if off is None:
                return None
            shifted.append(off)
        slopes.append(rising * ((shifted[0] - shifted[1]) / (2 * STEP))[rank])
    if all((np.abs(own - stated.chromaticity) > allowed).any() for own in slopes):
        return (
            f"its chromaticities are {_two(slopes[0])}, the header states "
            f"{_two(stated.chromaticity)}"
        )
    return None


def slip(ring: Ring) -> float:
    """How much later a particle of more energy comes round, per turn's length: above transition it
    is positive."""
    return _off_energy(_turn(_maps(ring), np.zeros(6))[0], ring.length)[1]


def _off_energy(matrix: Array, length: float) -> tuple[Array, float]:
    """Of a turn's matrix the dispersion [4], and how much later more energy comes round, over the
    turn's length."""
    dispersion = np.asarray(np.linalg.solve(np.eye(4) - matrix[:4, :4], matrix[:4, 5]), dtype=float)
    return dispersion, float(matrix[4, :4] @ dispersion + matrix[4, 5]) / length


def curvatures(ring: Ring, stated: Stated) -> list[float]:
    """Curvatures (1/m) with which thin bends, all of one radius, give the tunes that are stated.

    Args:
        ring: with thin bends without a length; one of curvature h focuses as |angle| h.
        stated: what the header states; without tunes there is none.
    """
    from scipy.optimize import brentq

    ways, bends, total = [np.eye(4)], list[Array](), 0.0
    for element, maps in zip(ring.elements, _maps_of_elements(ring), strict=True):
        for _, r, _ in maps:
            ways[-1] = r[:4, :4] @ ways[-1]
        if element.kind == "multipole" and element.angle:
            across = np.array([np.cos(element.tilt), 0.0, np.sin(element.tilt), 0.0])
            bends.append(-abs(element.angle) * np.outer(np.roll(across, 1), across))
            ways.append(np.eye(4))
            total += abs(element.angle)
    wanted = sum(np.cos(2 * np.pi * q) for q in stated.tunes or ())

    def miss(curvature: float) -> float:
        turn = ways[0]
        for bend, way in zip(bends, ways[1:], strict=True):
            turn = way @ (turn + curvature * (bend @ turn))
        return float(np.trace(turn) / 2 - wanted)

    if stated.tunes is None or not bends:
        return []
    # the bends are not longer than the ring, and not shorter than a fiftieth of it
    grid = total / ring.length * np.geomspace(1.0, 50.0, 200)
    values = [miss(h) for h in grid]
    return [
        float(brentq(miss, *grid[k : k + 2]))
        for k in range(len(grid) - 1) if values[k] * values[k + 1] < 0
    ]  # fmt: skip


def _kicks(element: Element) -> bool:
    """Whether an element may bend the orbit off the design's."""
    corrector = element.is_corrector and element.angle != 0
    own = element.source
    dipole = any(getattr(own, k, 0.0) for k in ("k0", "k0s"))
    return corrector or dipole or element.errors != NO_ERRORS


def _two(values: Iterable[float]) -> str:
    return " and ".join(f"{value:.6f}" for value in values)


def _maps(ring: Ring, faces: float = 1.0) -> list[tuple[Array, Array, Array]]:
    """B, R, T of every element's parts, in beam order, with the focusing of bends' faces scaled."""
    chain = []
    for element, parts in zip(ring.elements, _maps_of_elements(ring), strict=True):
        thin = element.kind == "matrix" and not element.length
        for k, (b, r, t) in enumerate(parts):
            face = thin or (element.kind == "bend" and len(parts) == 3 and k != 1)
            chain.append((b, np.eye(6) + faces * (r - np.eye(6)) if face else r, t))
    return chain


def _maps_of_elements(ring: Ring) -> list[list[tuple[Array, Array, Array]]]:
    from tmlattice.lattice.ocelot import elements, parts_of_ocelot

    known: dict[Any, list[tuple[Array, Array, Array]]] = {}
    chain: list[list[tuple[Array, Array, Array]]] = []
    for element in ring.elements:
        own = vars(element.source.element).values()
        numbers = (v for v in own if isinstance(v, int | float | list | tuple | np.ndarray))
        key = (type(element.source), element.kind, *(np.asarray(v).tobytes() for v in numbers))
        if key not in known:
            cavity = element.kind == "cavity"  # a drift in the static optics
            source = elements.Drift(l=element.length) if cavity else element.source
            maps = parts_of_ocelot(source, ring.map_energy, False)
            known[key] = [(b, r, 0.5 * (t + t.swapaxes(1, 2))) for b, r, t in maps]
        chain.append(known[key])
    return chain


def _turn(chain: list[tuple[Array, Array, Array]], launch: Array) -> tuple[Array, Array]:
    """The matrix of a turn about the orbit from a launch, [6, 6], and that orbit, [part + 1, 6]."""
    matrix, path = np.eye(6), [launch]
    for b, r, t in chain:
        slope = t @ path[-1]
        matrix = (r + 2 * slope) @ matrix
        path.append(b + r @ path[-1] + slope @ path[-1])
    return matrix, np.array(path)


def _largest_orbit(chain: list[tuple[Array, Array, Array]]) -> float:
    """Largest |x| or |y| of the closed orbit at the ends of the parts, m."""
    launch = path = np.zeros(6)
    for _ in range(4):  # Newton's steps
        matrix, path = _turn(chain, launch)
        missing = (path[-1] - launch)[:4]
        launch = launch + np.append(np.linalg.solve(np.eye(4) - matrix[:4, :4], missing), [0, 0])
    return float(np.abs(path[:, [0, 2]]).max())


def _tunes(matrix: Array) -> Array | None:
    """Fractional tunes of the two modes, between 0 and 1/2; None: unstable."""
    values = np.linalg.eigvals(matrix)
    if np.abs(np.abs(values) - 1).max() > 1e-6:
        return None
    angles = np.sort(np.abs(np.angle(values)))[::2]
    return np.asarray(angles / (2 * np.pi))
