"""Reading a lattice of AT (accelerator-toolbox): `.mat`, `.json`, `.m`, `.repr`.

Each AT element becomes an OCELOT element of the same first- and second-order physics:

- `PolynomB[n]` is k_n / n! and `PolynomA[n]` is k_ns / n!: see `at_fields`. Fields of one order
  are a tilted magnet, a skew quadrupole (A > 0) one tilted by -pi / 4; of several, a combined one.
- A bend keeps its edges (angles, gap, fringe integrals, pole curvature), k1 and k2. The nonlinear
  fringes of quadrupoles are of third order and left out. To second order OCELOT's bend is the
  fuller one: AT's has no product of curvature and gradient, and edges of first order.
- Wigglers made of thin bends of alternating sign become one matrix each (`lattice.wigglers`).
- A corrector kicks px += KickAngle[0], py += KickAngle[1]. It has one plane where its MADType
  (HKICKER, VKICKER) or its name states it; else it is two correctors in one place: NAME_h, NAME_v.
- A cavity is a drift to the maps; over several turns it gives the energy of its voltage.

Coordinates of a matrix element are turned from AT's (.., delta, ct) into OCELOT's (.., tau, p):
tau = ct, p = beta0 delta.
"""

import cmath
import logging
import math
import pickle
import re
import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import LatticeError, first_of, plain
from tmlattice.input_files import content_of, decoded
from tmlattice.lattice.at_child import check_methods, map_of
from tmlattice.lattice.at_code import elements_of
from tmlattice.lattice.at_fields import (
    bend,
    kicks_of,
    own_order,
    straight_magnet,
    strengths_of,
    thin,
    with_coils,
)
from tmlattice.lattice.expressions import STALE, nothing_run
from tmlattice.lattice.mat_file import lattice_in, read_mat
from tmlattice.lattice.parts import Report, assembled
from tmlattice.lattice.places import Place, corrector, corrector_pair, rotation
from tmlattice.lattice.ring import ELECTRON_GEV, Kind, Ring

log = logging.getLogger(__name__)


ACTS = frozenset({
    "BEAMBEAM", "CHANGEREF", "NLLENS", "SROTATION", "TRANSLATION", "XROTATION", "YROTATION",
    "CRABCAVITY", "ELSEPARATOR", "RFMULTIPOLE", "SOLENOID", "VARIABLETHINMULTIPOLE",
})  # fmt: skip
"""Classes of MAD-X and AT that are a drift in the static optics of AT, although they act."""

COARSE = 1e-3
"""|k1| l^2 / steps^4 of a magnet above which AT's integrator is wrong by 3e-5 of a tune."""

FINE = 100
"""Steps in which AT integrates a magnet without an error that counts."""
SAME, SAME_KICK = 1e-5, 1e-9
"""Of a matrix (1 or 1/m) and a kick (m or rad): elements that agree within these are the same."""

_VERTICAL = re.compile(r"^(f?v|c[hy]?v|pcv|pkv|c_?y|ky)|vcor|vkick|vcm|_v(_|\d|$)", re.IGNORECASE)
_HORIZONTAL = re.compile(r"^(f?h|c[vx]?h|pch|pkh|c_?x|kx)|hcor|hkick|hcm|_h(_|\d|$)", re.IGNORECASE)


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
        LatticeError: AT cannot read it, or it holds no elements, or one that needs a pass method
            that AT does not ship.
    """
    import at
    from at.load.matfile import load_var

    options: dict[str, Any] = {}
    if energy is not None:
        options["energy"] = 1e9 * energy
    if path.suffix.lower() == ".mat":
        options["use"] = lattice_in(read_mat(path), path, sequence)
    try:
        with quiet_at() as caught, nothing_run():
            if path.suffix.lower() == ".m":
                text = decoded(content_of(path, LatticeError))
                elements = elements_of(text, sequence, options.get("energy"))
                lattice = load_var(elements, **options)
            else:
                lattice = at.load_lattice(str(path), **options)
    except Exception as error:  # each of AT's readers fails in its own way
        message = plain(str(error), 300) or type(error).__name__
        if "energy is not defined" in message:
            raise LatticeError(f"'{path}' states no beam energy; give energy= (GeV)") from error
        advice = "correct it, or save the ring with AT's save_lattice"
        if isinstance(error, LatticeError):
            advice = "correct it"
        raise LatticeError(
            f"'{path}' cannot be read as an AT lattice ({message}); {advice}"
        ) from error
    messages = dict.fromkeys(str(warning.message) for warning in caught)
    if stale := [own.removeprefix(STALE) for own in messages if own.startswith(STALE)]:
        warnings.warn(
            f"'{path}': K or H of {first_of(stale, 3)} ({len(stale)}) is not that of PolynomB, "
            "which is used, as AT does",
            stacklevel=4,
        )
    for message in messages:
        if message.startswith(_ASSUMED):
            warnings.warn(f"'{path}': by AT's reader: {message}", stacklevel=4)
    return ring_from_at(lattice, name, energy)


_ASSUMED = ("More than 1 RingParam", "Inconsistent energy", "Non-integer number of cells")
"""What warnings of AT's reader begin with that are of the ring."""


@contextmanager
def quiet_at() -> Iterator[list[warnings.WarningMessage]]:
    """What AT warns of stays in the log: it is about AT's tracking, or about words of a file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield caught
    for warning in caught:
        log.info("AT: %s", warning.message)


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
        Of orders above the second, which are left out.
    """
    energy_gev = float(lattice.energy) / 1e9 if energy is None else energy
    rest = float(lattice.particle.rest_energy) / 1e9
    light = rest < 2 * ELECTRON_GEV  # an electron, or AT's particle that is as fast as light
    design = Ring(name, (), energy_gev, mass=ELECTRON_GEV if light else rest)
    report = Report()
    converted: list[Place] = []
    known: dict[Hashable, tuple[list[Place], str, list[str]]] = {}  # with family and what it lacks
    errors: dict[int, dict[str, float]] = {}
    still = {id(element): _at_rest(element) for element in lattice}
    check_methods(still.values())
    content = {id(element): _content(element) for element in still.values()}
    for element in (still[id(element)] for element in lattice):
        if (key := content[id(element)]) not in known:
            family = str(getattr(element, "CommonName", "") or element.FamName).strip().lower()
            entrance, exit_ = _frame(element, family, design.map_energy)
            bare = _without(element, "T1", "T2", "R1", "R2") if entrance else element
            lacks: list[str] = []
            own = _places(bare, family, design.map_energy, lacks.append)
            if shift := _shift(bare):
                errors |= {id(source): shift for _, _, source in own}
            known[key] = [*entrance, *own, *exit_], family, lacks
        places, family, lacks = known[key]
        for reason in lacks:
            report.left_out(reason, family, id(element))
        converted += places
    if not converted:
        raise LatticeError(f"'{name}' holds no elements; name another variable with sequence=")
    report.warn(name)
    return assembled(design, converted, errors, max(1, int(lattice.periodicity)))


def _content(element: Any) -> Hashable:
    """A key that elements with equal fields share: files have most elements many times."""
    try:
        return pickle.dumps((type(element), vars(element)))
    except Exception:  # a field that is no data
        return id(element)


def _at_rest(element: Any) -> Any:
    """The element without radiation and acceleration, whatever its class: by its pass method."""
    method = str(element.PassMethod)
    if any(word in method for word in _LONGITUDINAL):
        long = float(getattr(element, "Length", 0.0)) != 0.0
        own = "DriftPass" if long and "Cavity" in method else "IdentityPass"
    else:
        own = re.sub(r"(Rad|Quant)Pass$", "Pass", method)
        own = own.replace("OldPass", "MPoleSymplectic4Pass")
    if own == method:
        return element
    still = element.deepcopy()
    still.PassMethod = own
    return still


_LONGITUDINAL = (
    "Cavity", "EnergyLoss", "QuantDiff", "SimpleRadiation", "WakeField", "ImpedanceTable",
)  # fmt: skip
"""In the names of pass methods that change energies alone, or act by the charge of the beam."""


def _translations(element: Any) -> tuple[Array, Array]:
    T1, T2 = (np.asarray(getattr(element, key, np.zeros(6)), float).ravel() for key in ("T1", "T2"))
    return T1, T2


def _rotations(element: Any) -> tuple[Array, Array]:
    R1, R2 = (np.asarray(getattr(element, key, np.eye(6)), dtype=float) for key in ("R1", "R2"))
    return R1, R2


def _roll(element: Any) -> float:
    """rad."""
    if not hasattr(element, "R1"):
        return 0.0
    R1, _ = _rotations(element)
    return math.atan2(R1[0, 2], R1[0, 0])


def _frame(element: Any, family: str, energy: float) -> tuple[list[Place], list[Place]]:
    """What T1, R1 and R2, T2 do before and behind an element, where they are neither an offset nor
    a roll: matrices of their own. x -> R1 (x + T1) and x -> R2 x + T2."""
    if vars(element).keys().isdisjoint(("T1", "T2", "R1", "R2")):
        return [], []
    (T1, T2), (R1, R2) = _translations(element), _rotations(element)
    turn = rotation(_roll(element))
    offset = np.array_equal(T1, -T2) and not T1[[1, 3, 4, 5]].any()
    if offset and np.abs(R1 - turn).max() < 1e-9 and np.abs(R2 - turn.T).max() < 1e-9:
        return [], []
    entrance, exit_ = f"{family}_entrance", f"{family}_exit"
    return (
        [(entrance, "matrix", _matrix(R1, entrance, 0.0, energy, R1 @ T1)[1])],
        [(exit_, "matrix", _matrix(R2, exit_, 0.0, energy, T2)[1])],
    )


def _without(element: Any, *fields: str) -> Any:
    bare = element.deepcopy()
    for name in fields:
        vars(bare).pop(name, None)
    return bare


def _shift(element: Any) -> dict[str, float]:
    """Offset of the element's centre, m."""
    T1, _ = _translations(element)
    return {k: v for k, v in (("dx", -T1[0]), ("dy", -T1[2])) if v}


def _places(
    element: Any, family: str, energy: float, left_out: Callable[[str], None]
) -> list[Place]:
    """What one AT element is in the ring: one element, but for correctors of both planes and bends
    with coils."""
    import at

    mad = str(getattr(element, "MADType", "")).upper()
    mad = mad or str(getattr(element, "origin", "")).upper()
    kicks = element.PassMethod.startswith(("Corrector", *_FIELDS)) or passes_freely(element)
    if isinstance(element, at.Corrector) and kicks and not _acts(element):
        return _correctors(element, family, mad)
    kind, source = _convert(element, family, mad, energy, left_out)
    own: list[Place] = [(family, kind, source)]
    if kind == "bend":
        own = with_coils(element, family, source)
    method = element.PassMethod
    warned = method.startswith("Str") if kind == "bend" else source.l and _is_short(method)
    if _fields(element) and not passes_freely(element) and not warned:
        return _as_tracked(element, family, own, energy, left_out)
    return own


def _as_tracked(
    element: Any, family: str, own: list[Place], energy: float, left_out: Callable[[str], None]
) -> list[Place]:
    """An element, and behind it a matrix of what AT tracks otherwise: linear fringes, fields that
    a pass method lacks or has about another axis. AT integrates in steps that are fine enough."""
    fine = _without(element, "T1", "T2")
    fine.NumIntSteps = max(FINE, int(np.ravel(getattr(element, "NumIntSteps", 1))[0]))
    wanted, kick = map_of(fine, 1e9 * energy)
    turn, matrix, shift = from_ocelot(energy), np.eye(6), np.zeros(6)
    for _, _, source in own:
        for r, b in zip(source.R(energy), source.B(energy), strict=True):
            matrix, shift = r @ matrix, r @ shift + np.ravel(b)
    rest = wanted @ turn @ np.linalg.inv(matrix) @ np.linalg.inv(turn)
    rest[4:, 4:] = np.eye(2)  # how late a slow particle comes is OCELOT's
    across = (kick - rest @ turn @ shift) * [1, 1, 1, 1, 0, 0]
    if np.abs((rest - np.eye(6))[:4, :5]).max() < SAME and np.abs(across).max() < SAME_KICK:
        return own
    name = f"{family}_rest"
    left_out(f"what {element.PassMethod} has beyond the model and a first-order matrix")
    return [*own, (name, *_matrix(rest, name, 0.0, energy, across))]


def _convert(
    element: Any, family: str, mad: str, energy: float, left_out: Callable[[str], None]
) -> tuple[Kind, Any]:
    """Kind and OCELOT element of one AT element."""
    import at

    from tmlattice.lattice.ocelot import elements as ocelot

    length = float(getattr(element, "Length", 0.0))
    roll = _roll(element)
    if isinstance(element, at.RFCavity) and passes_freely(element):
        voltage, frequency = (float(getattr(element, k, 0.0)) for k in ("Voltage", "Frequency"))
        return "cavity", ocelot.Cavity(l=length, v=1e-9 * voltage, freq=frequency, eid=family)
    if mad == "INSTRUMENT" and isinstance(element, at.Monitor):  # AT's MAD-X reader has it so
        return "marker", ocelot.Marker(eid=family)
    acts, method = _acts(element), element.PassMethod
    if length and _is_short(method):
        left_out(f"that AT's {method} skips the length of an element")
    steps = float(np.ravel(getattr(element, "NumIntSteps", 10.0))[0])
    gradient = abs(strengths_of(element)[1]) if acts else 0.0
    if "Symplectic4" in method and gradient * length**2 > COARSE * max(steps, 1.0) ** 4:
        left_out("the error of AT's integration in a few steps")
    if passes_freely(element):
        if isinstance(element, at.Monitor) or mad in ("MONITOR", "HMONITOR", "VMONITOR"):
            return "monitor", ocelot.Monitor(l=length, eid=family)
        if not mad and isinstance(element, at.Marker) and str(element.FamName).casefold() == "bpm":
            return "monitor", ocelot.Monitor(l=length, eid=family)  # from before the class
        if _fields(element):
            left_out(f"fields of magnets whose pass method is {method}")
        for name in ACTS & {mad, type(element).__name__.upper()}:
            left_out(f"what {name.lower()} does")
        if length:
            return "drift", ocelot.Drift(l=length, eid=family)
        return "marker", ocelot.Marker(eid=family)
    if isinstance(element, at.M66) and method.startswith("Matrix66"):
        matrix = np.asarray(element.M66, dtype=float)
        if roll:
            R1, R2 = _rotations(element)
            matrix = R2 @ matrix @ R1
        return _matrix(matrix, family, length, energy)
    if method == "ThinMPolePass":
        return thin(element, family, length, roll, left_out)
    angle, ahead = getattr(element, "BendingAngle", 0.0), method.startswith("Str")
    if angle or (isinstance(element, at.Dipole) and not ahead):
        if method.startswith(_FIELDS):
            if ahead:
                left_out("that AT tracks bends straight ahead by a pass method Str...")
            return bend(element, family, length, roll, left_out)
    elif (acts or isinstance(element, at.Multipole)) and method.startswith(_FIELDS):
        strengths, own = strengths_of(element), own_order(element, mad)
        return straight_magnet(strengths, own, length, roll, family, left_out)
    matrix, kick = map_of(element, 1e9 * energy)
    if method == "ChangePRefPass" and kick[4]:
        raise LatticeError(f"'{family}' changes the reference momentum ({method}); take it out")
    kind, source = _matrix(matrix, family, length, energy, kick * [1, 1, 1, 1, 0, 0])
    name = type(element).__name__
    if name in ("Element", "Drift", "Marker", "Monitor"):
        name = method.removesuffix("Pass")
    left_out(f"what {name} has beyond its first-order matrix")
    if method.startswith(("GWig", "Wigg", "IdTable")):
        kind = "wiggler"
    return ("solenoid" if method.startswith("Solenoid") else kind), source


_FIELDS = ("Str", "Bnd", "Bend", "Quad", "Exact", "ThinMPole")
"""What the pass methods begin with that take an element's fields."""


def _fields(element: Any) -> bool:
    names = ("PolynomA", "PolynomB", "BendingAngle")
    return any(np.any(getattr(element, name, 0.0)) for name in names)


def _acts(element: Any) -> bool:
    """Whether AT tracks fields of an element, whatever its class."""
    return element.PassMethod.startswith(_FIELDS) and _fields(element)


def passes_freely(element: Any) -> bool:
    """Whether AT passes an element as if nothing were there, whatever its class and its fields: by
    a drift, an aperture, a monitor of the beam's moments, or fields that change from turn to
    turn."""
    return any(word in element.PassMethod for word in ("Drift", *_EMPTY))


_EMPTY = ("Identity", "Aperture", "Moments", "VariableThin")
"""In the names of pass methods that have neither a field nor a length."""


def _is_short(method: str) -> bool:
    """Whether a pass method skips the length of an element."""
    return any(word in method for word in ("ThinMPole", *_EMPTY))


def _correctors(element: Any, family: str, mad: str) -> list[Place]:
    """One corrector where something states its plane, else one of each plane."""
    on = element.PassMethod.startswith(("Corrector", *_FIELDS))
    kick = complex(*kicks_of(element)) if on else 0j
    turned = kick * float(getattr(element, "FieldScaling", 1.0)) * cmath.exp(1j * _roll(element))
    x, y = turned.real, turned.imag
    length = float(getattr(element, "Length", 0.0))
    if mad in ("HKICKER", "VKICKER"):
        horizontal, vertical = mad == "HKICKER", mad == "VKICKER"
    else:
        names = (str(element.FamName), family)
        horizontal, vertical = (any(map(k.search, names)) for k in (_HORIZONTAL, _VERTICAL))
    if horizontal and not vertical and y == 0.0:
        return [corrector(family, "h", length, x)]
    if vertical and not horizontal and x == 0.0:
        return [corrector(family, "v", length, y)]
    return corrector_pair(family, length, x, y)


def from_ocelot(energy: float) -> Array:
    """From OCELOT's coordinates (.., tau, p) to AT's (.., delta, ct), [6, 6]."""
    beta = math.sqrt(1.0 - (ELECTRON_GEV / energy) ** 2)
    turn = np.eye(6)
    turn[4:, 4:] = [[0.0, 1 / beta], [1.0, 0.0]]
    return turn


def _matrix(
    r: Array, family: str, length: float, energy: float, b: Array | None = None
) -> tuple[Kind, Any]:
    from tmlattice.lattice.ocelot import elements as ocelot

    turn = from_ocelot(energy)
    source = ocelot.Matrix(l=length, eid=family)
    source.r = np.linalg.inv(turn) @ r @ turn
    if source.r[4, 4] == 0.0 and source.r[5, 5] == 0.0:
        source.r[4, 4] = source.r[5, 5] = 1.0
    if b is not None and b.any():
        source.b = np.linalg.solve(turn, b).reshape(6, 1)
    return ("wiggler" if "wig" in family else "matrix"), source
