"""Reading a lattice of AT (accelerator-toolbox): `.mat`, `.json`, `.m`, `.repr`.

Each AT element becomes an OCELOT element of the same first- and second-order physics:

- `PolynomB[n]` is k_n / n! and a complex strength B + i A = |k| exp(-i (n + 1) tilt), so a skew
  quadrupole (A) is one tilted by -pi / 4. A multipole is known by its strengths, then by MADType.
- A bend keeps its edges (angles, gap, fringe integrals, pole curvature), k1 and k2. The nonlinear
  fringes of quadrupoles are of third order and left out. To second order OCELOT's bend is the
  fuller one: AT's has no product of curvature and gradient, and edges of first order.
- Wigglers made of thin bends of alternating sign become one matrix each (`_merge_wigglers`).
- A corrector's plane is its MADType (HKICKER, VKICKER), else its kick, else its name.
- A cavity is a drift to the maps; over several turns it gives what its voltage says.

Coordinates of a matrix element are turned from AT's (.., delta, ct) into OCELOT's (.., tau, p):
tau = ct, p = beta0 delta.
"""

import logging
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import LatticeError
from tmlattice.lattice.places import place_elements
from tmlattice.lattice.ring import Kind, Ring

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

ELECTRON_GEV = 0.51099895e-3

_VERTICAL = re.compile(r"^(f?v|c[hy]?v|pcv|pkv|c_?y|ky)|vcor|vkick|vcm|_v(_|\d|$)", re.IGNORECASE)

THIN_BEND = 0.1
"""m; a bend not longer than this may be a slice of a wiggler."""

WIGGLER_SLICES = 8
"""At least as many thin bends in a row, of both signs, are a wiggler."""


def read_at(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of an AT lattice file.

    Args:
        path: `.mat`, `.json`, `.m` or `.repr`.
        name: of the ring.
        sequence: the variable of a `.mat` file that holds the ring, where it holds several.
        energy: GeV; else the file's.

    Raises:
        LatticeError: AT cannot read it, or it holds no elements.
    """
    import at

    options = {"use": sequence} if sequence else {}
    try:
        lattice = at.load_lattice(str(path), **options)
    except Exception as error:  # each of AT's readers fails in its own way
        said = " ".join(str(error).split()) or type(error).__name__
        raise LatticeError(
            f"'{path}' cannot be read as an AT lattice ({said}); save it with AT's "
            "save_lattice, or name its variable with sequence="
        ) from error
    return ring_from_at(lattice, name, energy)


def ring_from_at(lattice: Any, name: str, energy: float | None = None) -> Ring:
    """The ring of an `at.Lattice`, all its periods written out.

    Names are CommonName where an element has one, else FamName, in lower case, numbered.

    Args:
        lattice: with an energy; radiation and cavities are left out.
        name: of the ring.
        energy: GeV; else the lattice's.

    Raises:
        LatticeError: no elements.

    Warns:
        Of misalignments, rotations that are no roll, dipole field errors and orders above the
        second, which are left out.
    """
    energy_gev = float(lattice.energy) / 1e9 if energy is None else energy
    left_out: Counter[str] = Counter()
    converted: list[tuple[str, Kind, Any]] = []
    known: dict[int, tuple[str, Kind, Any]] = {}
    for element in lattice:
        if id(element) not in known:
            family = str(getattr(element, "CommonName", "") or element.FamName).strip().lower()
            kind, source = _convert(element, family, energy_gev, left_out)
            known[id(element)] = (family, kind, source)
        converted.append(known[id(element)])
    if not converted:
        raise LatticeError(f"'{name}' holds no elements; name another variable with sequence=")
    if left_out:
        what = ", ".join(f"{reason} ({count})" for reason, count in left_out.items())
        warnings.warn(f"'{name}': left out of the model: {what}", stacklevel=3)
    merged = _merge_wigglers(converted, energy_gev) * max(1, int(lattice.periodicity))
    families, kinds, sources = zip(*merged, strict=True)
    return Ring(name, place_elements(families, sources, kinds), energy_gev)


def _strengths(element: Any) -> NDArray[np.complex128]:
    """B + i A of the orders that AT uses, scaled, [order]."""
    B = np.atleast_1d(np.asarray(getattr(element, "PolynomB", [0.0]), dtype=float))
    A = np.atleast_1d(np.asarray(getattr(element, "PolynomA", [0.0]), dtype=float))
    orders = max(len(B), len(A))
    total = np.zeros(orders, dtype=complex)
    total[: len(B)] += B
    total[: len(A)] += 1j * A
    highest = int(getattr(element, "MaxOrder", orders - 1))
    total[highest + 1 :] = 0.0
    total *= float(getattr(element, "FieldScaling", 1.0))
    return total


def _normal(strength: complex, order: int) -> tuple[float, float]:
    """Derivative strength k_n and tilt of B + i A: signed and upright where A is zero."""
    if strength.imag == 0.0:
        return strength.real * math.factorial(order), 0.0
    tilt = -math.atan2(strength.imag, strength.real) / (order + 1)
    return abs(strength) * math.factorial(order), tilt


def _roll(element: Any, left_out: Counter[str]) -> float:
    """Tilt from R1, rad; anything else that moves the element is counted as left out."""
    for key in ("T1", "T2"):
        if np.any(np.asarray(getattr(element, key, (0.0,)), dtype=float)):
            left_out["misalignments T1, T2"] += 1
            break
    R1 = np.asarray(getattr(element, "R1", np.eye(6)), dtype=float)
    R2 = np.asarray(getattr(element, "R2", np.eye(6)), dtype=float)
    roll = math.atan2(R1[0, 2], R1[0, 0])
    turn = np.eye(6)
    turn[:4, :4] = np.kron(
        [[math.cos(roll), math.sin(roll)], [-math.sin(roll), math.cos(roll)]], np.eye(2)
    )
    if np.abs(R1 - turn).max() > 1e-9 or np.abs(R2 - turn.T).max() > 1e-9:
        left_out["rotations R1, R2 that are no roll"] += 1
    return roll


def _convert(element: Any, family: str, energy: float, left_out: Counter[str]) -> tuple[Kind, Any]:
    """Kind and OCELOT element of one AT element."""
    import at

    from tmlattice.lattice.ocelot import elements as ocelot

    length = float(getattr(element, "Length", 0.0))
    mad = str(getattr(element, "MADType", "")).upper()
    mad = mad or str(getattr(element, "origin", "")).upper()
    roll = _roll(element, left_out)
    if isinstance(element, at.RFCavity):
        voltage, frequency = (float(getattr(element, k, 0.0)) for k in ("Voltage", "Frequency"))
        return "cavity", ocelot.Cavity(l=length, v=1e-9 * voltage, freq=frequency, eid=family)
    if mad == "INSTRUMENT" and isinstance(element, at.Monitor):  # AT's MAD-X reader has it so
        return "marker", ocelot.Marker(eid=family)
    if isinstance(element, at.Monitor) or mad in ("MONITOR", "HMONITOR", "VMONITOR"):
        return "monitor", ocelot.Monitor(l=length, eid=family)
    if not mad and isinstance(element, at.Marker) and str(element.FamName).casefold() == "bpm":
        return "monitor", ocelot.Monitor(l=length, eid=family)  # lattices from before the class
    if isinstance(element, at.Corrector):
        return _corrector(element, family, length, mad)
    if isinstance(element, at.M66):
        return _matrix(np.asarray(element.M66, dtype=float), family, length, energy)
    if isinstance(element, at.ThinMultipole) and not isinstance(element, at.Multipole):
        return _thin(element, family, roll, left_out)
    if isinstance(element, at.Dipole) or getattr(element, "BendingAngle", False):
        return _bend(element, family, length, roll, left_out)
    if isinstance(element, at.Multipole):
        return _straight(element, family, length, mad, roll, left_out)
    if isinstance(element, at.Drift | at.Marker) or "Identity" in element.PassMethod:
        if length:
            return "drift", ocelot.Drift(l=length, eid=family)
        return "marker", ocelot.Marker(eid=family)
    matrix = at.find_elem_m66(element, energy=energy * 1e9, particle=at.Particle("relativistic"))
    kind, source = _matrix(np.asarray(matrix), family, length, energy)
    left_out[f"what {type(element).__name__} has beyond its first-order matrix"] += 1
    if element.PassMethod.startswith(("GWig", "Wigg", "IdTable")):
        kind = "wiggler"
    return ("solenoid" if element.PassMethod.startswith("Solenoid") else kind), source


def _corrector(element: Any, family: str, length: float, mad: str) -> tuple[Kind, Any]:
    """One plane by MADType, else by its kick, else by name (horizontal when nothing tells)."""
    from tmlattice.lattice.ocelot import elements as ocelot

    x, y = (float(k) for k in np.asarray(element.KickAngle, dtype=float).ravel()[:2])
    if mad in ("HKICKER", "VKICKER"):
        vertical = mad == "VKICKER"
    elif x != 0.0 or y != 0.0:
        vertical = abs(y) > abs(x)
    else:
        vertical = any(_VERTICAL.search(n) for n in (str(element.FamName), family))
    cls = ocelot.Vcor if vertical else ocelot.Hcor
    source = cls(l=length, angle=y if vertical else x, eid=family)
    if x != 0.0 and y != 0.0:  # both planes kick: OCELOT has it as a tilted horizontal one
        source = ocelot.Hcor(l=length, angle=math.hypot(x, y), eid=family)
        source.tilt = math.atan2(y, x)
    return ("vcorrector" if vertical else "hcorrector"), source


def _matrix(r: Array, family: str, length: float, energy: float) -> tuple[Kind, Any]:
    from tmlattice.lattice.ocelot import elements as ocelot

    gamma = energy / ELECTRON_GEV
    beta = math.sqrt(1.0 - 1.0 / gamma**2)
    to_ocelot = np.eye(6)
    to_ocelot[4:, 4:] = [[0.0, 1.0], [beta, 0.0]]
    source = ocelot.Matrix(l=length, eid=family)
    source.r = to_ocelot @ r @ np.linalg.inv(to_ocelot)
    if source.r[4, 4] == 0.0 and source.r[5, 5] == 0.0:
        source.r[4, 4] = source.r[5, 5] = 1.0
    return ("wiggler" if "wig" in family else "matrix"), source


def _thin(element: Any, family: str, roll: float, left_out: Counter[str]) -> tuple[Kind, Any]:
    """A kick px -= Re, py += Im of (B + i A) (x + i y)^n, to second order, as a matrix element."""
    from tmlattice.lattice.ocelot import elements as ocelot

    strengths = _strengths(element)
    if np.any(strengths[3:]):
        left_out["thin multipoles above the sextupole"] += 1
    turned = [k * np.exp(-1j * (n + 1) * roll) for n, k in enumerate(strengths[:3])]
    k0, k1, k2 = (complex(k) for k in (*turned, 0.0, 0.0, 0.0)[:3])
    source = ocelot.Matrix(l=0.0, eid=family)
    r, t = np.eye(6), np.zeros((6, 6, 6))
    r[1, 0], r[1, 2], r[3, 0], r[3, 2] = -k1.real, k1.imag, k1.imag, k1.real
    t[1, 0, 0], t[1, 2, 2], t[3, 0, 0], t[3, 2, 2] = -k2.real, k2.real, k2.imag, -k2.imag
    t[1, 0, 2] = t[1, 2, 0] = k2.imag
    t[3, 0, 2] = t[3, 2, 0] = k2.real
    source.r, source.t = r, t
    source.b = np.array([[0.0], [-k0.real], [0.0], [k0.imag], [0.0], [0.0]])
    return "multipole", source


def _bend(
    element: Any, family: str, length: float, roll: float, left_out: Counter[str]
) -> tuple[Kind, Any]:
    from tmlattice.lattice.ocelot import elements as ocelot

    strengths = (*_strengths(element), 0.0, 0.0, 0.0)
    if strengths[0] != 0 or np.any(np.asarray(getattr(element, "KickAngle", (0.0, 0.0)))):
        left_out["field errors of bends"] += 1
    if any(complex(k).imag for k in strengths) or any(strengths[3:]):
        left_out["skew fields and octupoles of bends"] += 1
    source = ocelot.SBend(
        l=length,
        angle=float(element.BendingAngle),
        k1=complex(strengths[1]).real,
        k2=2.0 * complex(strengths[2]).real,
        e1=float(getattr(element, "EntranceAngle", 0.0)),
        e2=float(getattr(element, "ExitAngle", 0.0)),
        tilt=roll,
        gap=float(getattr(element, "FullGap", 0.0)),
        fint=float(getattr(element, "FringeInt1", 0.0)),
        fintx=float(getattr(element, "FringeInt2", 0.0)),
        h_pole1=float(getattr(element, "H1", 0.0)),
        h_pole2=float(getattr(element, "H2", 0.0)),
        eid=family,
    )
    return "bend", source


def _straight(
    element: Any, family: str, length: float, mad: str, roll: float, left_out: Counter[str]
) -> tuple[Kind, Any]:
    """Quadrupole, sextupole or octupole, by strengths; at zero strength by class or MADType."""
    import at

    from tmlattice.lattice.ocelot import elements as ocelot

    strengths = _strengths(element)
    if strengths[0] != 0 or np.any(np.asarray(getattr(element, "KickAngle", (0.0, 0.0)))):
        left_out["dipole kicks of multipoles"] += 1
    orders = [n for n in range(1, len(strengths)) if strengths[n] != 0]
    if orders:
        order = orders[0]
    elif isinstance(element, at.Quadrupole) or mad == "QUADRUPOLE":
        order = 1
    elif isinstance(element, at.Octupole) or mad == "OCTUPOLE":
        order = 3
    elif isinstance(element, at.Sextupole) or mad == "SEXTUPOLE":
        order = 2
    else:
        return "multipole", ocelot.Quadrupole(l=length, k1=0.0, eid=family)
    k, tilt = (0.0, 0.0) if not orders else _normal(complex(strengths[order]), order)
    rest = [n for n in orders if n != order]
    k2 = 0.0
    if order == 1 and 2 in rest:
        second = complex(strengths[2]) * np.exp(3j * tilt)  # in the quadrupole's own frame
        if abs(second.imag) <= 1e-12 * abs(second):
            k2 = 2.0 * second.real
            rest.remove(2)
    if rest:
        left_out["higher orders of multipoles"] += 1
    if order == 1:
        return "quadrupole", ocelot.Quadrupole(l=length, k1=k, k2=k2, tilt=tilt + roll, eid=family)
    if order == 2:
        return "sextupole", ocelot.Sextupole(l=length, k2=k, tilt=tilt + roll, eid=family)
    if order == 3:
        return "octupole", ocelot.Octupole(l=length, k3=k, tilt=tilt + roll, eid=family)
    left_out["multipoles above the octupole"] += 1
    return "multipole", ocelot.Drift(l=length, eid=family)


def _merge_wigglers(
    places: list[tuple[str, Kind, Any]], energy: float
) -> list[tuple[str, Kind, Any]]:
    """Each row of thin bends of alternating sign as one matrix element of the family `wiggler`.

    The matrix is the product of the slices' own 6 x 6 matrices, edges included, so tunes and
    dispersion stay; the slices' second order is dropped (their fields average out). A network
    then has one layer a wiggler and not two hundred.
    """
    from tmlattice.lattice.ocelot import elements as ocelot

    matrices: dict[int, Array] = {}
    merged: list[tuple[str, Kind, Any]] = []
    row: list[tuple[str, Kind, Any]] = []

    def product(sources: Iterable[Any]) -> Array:
        total = np.eye(6)
        for source in sources:
            if id(source) not in matrices:
                own = np.eye(6)
                for part in source.R(energy):
                    own = part @ own
                matrices[id(source)] = own
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
