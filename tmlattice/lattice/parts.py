"""Elements in MAD-X's words, as OCELOT elements: what the readers of MAD-X, TWISS tables, elegant
and Xsuite share.

Every keyword and every attribute is in one of three lists: modelled, without effect on the optics,
or neither. What is in neither is refused where it changes the linear optics, the geometry or the
closed orbit, and named in one warning otherwise.
"""

import cmath
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tmlattice.arrays import Array, ComplexArray
from tmlattice.errors import LatticeError, first_of, plain
from tmlattice.lattice.at_fields import straight_magnet
from tmlattice.lattice.places import (
    MAIN_ORDER,
    Place,
    corrector,
    corrector_pair,
    place_elements,
    rotation,
)
from tmlattice.lattice.ring import ELECTRON_GEV, Kind, Ring
from tmlattice.lattice.wigglers import merge_wigglers


@dataclass(frozen=True)
class Part:
    """One element of a file.

    Attributes:
        name: without a number.
        keyword: MAD-X's, in lower case; of bends only `sbend`, with the arc as its length and the
            whole angles of its faces.
        values: by MAD-X's attribute, in lower case and in MAD-X's units (m, rad, 1/m2, MV, MHz).
            `k0` is the whole dipole field of a bend, where it differs from angle / l. A matrix has
            `rmat`, [6, 6], in OCELOT's coordinates, or `rm` in MAD-X's, and `b`, [6], likewise in
            OCELOT's.
        where: file and line, for messages.
    """

    name: str
    keyword: str
    values: Mapping[str, Any] = field(default_factory=dict)
    where: str = ""

    def number(self, attribute: str) -> float:
        """An attribute's value; 0 where it has none."""
        value = self.values.get(attribute) or 0.0
        if isinstance(value, tuple):
            raise LatticeError(
                f"{attribute.upper()} of {self.keyword.upper()} '{plain(self.name, 60)}' "
                f"({self.where}) is a list; give a number"
            )
        return float(value)

    def list(self, attribute: str) -> Array:
        """Values of an attribute that is a list."""
        return np.atleast_1d(np.asarray(self.values.get(attribute, ()), dtype=float))


_STRENGTHS = frozenset({"k0", "k0s", "k1", "k1s", "k2", "k2s", "k3", "k3s", "knl", "ksl"})
SHIFTS = frozenset({"dx", "dy", "ds", "dpsi"})
_EDGES = frozenset({
    "angle", "e1", "e2", "h1", "h2", "hgap", "fint", "fintx", "kill_ent_fringe", "kill_exi_fringe",
})  # fmt: skip
_PASSIVE = frozenset[str]()

MODELLED: dict[str, frozenset[str]] = {
    **dict.fromkeys(("drift", "marker", "sixmarker", "instrument", "placeholder"), _PASSIVE),
    **dict.fromkeys(("blmonitor", "imonitor", "slmonitor"), _PASSIVE),  # of losses, current, light
    **dict.fromkeys(("collimator", "ecollimator", "rcollimator"), _PASSIVE),
    **dict.fromkeys(("monitor", "hmonitor", "vmonitor"), _PASSIVE),
    "hkicker": frozenset({"kick", "hkick", "tilt"}),
    "vkicker": frozenset({"kick", "vkick", "tilt"}),
    **dict.fromkeys(("kicker", "tkicker"), frozenset({"hkick", "vkick", "tilt"})),
    "sbend": _STRENGTHS | SHIFTS | _EDGES | {"tilt"},
    **dict.fromkeys(("quadrupole", "sextupole", "octupole"), _STRENGTHS | SHIFTS | {"tilt"}),
    "multipole": _STRENGTHS | SHIFTS | {"tilt", "lrad", "angle"},
    "solenoid": frozenset({"ks", "ksi"}),
    "rfcavity": frozenset({"volt", "freq"}),
    "matrix": frozenset({"rm", "rmat", "b", "tilt"}),
    "dipedge": frozenset({"h", "e1", "hgap", "fint", "tilt"}),
    "srotation": frozenset({"angle"}),
}
"""Attributes that the model has, by keyword; every keyword has a length."""

STATIC: dict[str, str] = {
    "crabcavity": "volt", "hacdipole": "volt", "vacdipole": "volt", "twcavity": "volt",
}  # fmt: skip
"""Drifts in the static optics: what their voltage does is named in a warning."""
ACTING: dict[str, tuple[str, ...]] = {
    "elseparator": ("ex", "ey", "ex_l", "ey_l"),
    "beambeam": ("charge",),
    "wire": ("current",),
    "nllens": ("knll",),
    "rfmultipole": ("knl", "ksl", "volt"),
    "changeref": ("patch_ang", "patch_trans"),
    "translation": ("dx", "dy", "ds"),
    "xrotation": ("angle",),
    "yrotation": ("angle",),
}
"""Elements that are not modelled; they are refused unless these attributes are zero."""
_ASSUMED = {"charge": 1.0}
"""What MAD-X takes where such an attribute is not given, if that is not zero."""

NO_EFFECT = frozenset({
    "l", "at", "from", "type", "name", "apertype", "aperture", "aper_offset", "aper_tol",
    "aper_tilt", "aper_vx", "aper_vy", "xsize", "ysize", "slot_id", "assembly_id", "mech_sep",
    "v_pos", "calib", "polarity", "comments", "comment", "kmax", "kmin", "nst", "method", "model",
    "exact", "fringe", "bend_fringe", "thick", "magnet", "lrad", "lag", "harmon", "shunt", "tfill",
    "betrf", "pg", "n_bessel", "no_cavity_totalpath", "add_angle", "f_factor", "slice", "sigx",
    "sigy", "f1", "f2", "fcsr", "slice_straight", "frngmax", "rot_start", "nbin", "binmax",
    "time_var", "reference", "range", "shape", "refpos", "rfcavity_totalpath", "freq", "entrance",
})  # fmt: skip
"""Attributes without effect on the optics, of any keyword."""
NONLINEAR = frozenset({"k4", "k4s", "k5", "k5s", "k6", "k7", "k8", "pnl", "psl", "rad", "tm",
                       "he", "sinkick", "sinpeak", "sintune", "sinphase"})  # fmt: skip
"""Attributes that act beyond the linear optics: named in a warning."""


class Report:
    """What a reader and the model leave out: names by reason, in one warning."""

    def __init__(self) -> None:
        self.names: dict[str, dict[tuple[str, int], None]] = {}

    def left_out(self, reason: str, name: str, own: int = 0) -> None:
        """Note that something of this element is left out; several elements of one name are
        counted by their `own`."""
        self.names.setdefault(reason, {})[name, own] = None

    def warn(self, ring: str) -> None:
        """Warn of all that was noted, if anything was."""
        if not self.names:
            return
        what = "; ".join(
            f"{reason} of {first_of(list(dict.fromkeys(n for n, _ in names)), 3)} ({len(names)})"
            for reason, names in self.names.items()
        )
        warnings.warn(f"'{ring}': left out of the model: {what}", stacklevel=4)


def ring_of_parts(
    parts: Sequence[Part | float],
    name: str,
    energy: float,
    mass: float = ELECTRON_GEV,
    charge: float = 1.0,
    report: Report | None = None,
) -> Ring:
    """The ring of these elements in beam order; one `Part` may stand in many places.

    Args:
        parts: elements, and lengths of the gaps between them, m.
        name: of the ring.
        energy: of a particle, rest energy included, GeV.
        mass: rest energy, GeV.
        charge: of a particle, in elementary charges; a cavity acts by its voltage times the charge.
        report: what the reader left out already.

    Raises:
        LatticeError: no element, or one that the model lacks and the optics needs.

    Warns:
        Once, of what is left out.
    """
    if not parts:
        raise LatticeError(f"'{name}' has no elements; name another sequence with sequence=")
    if not charge:
        raise LatticeError("the beam's particle has the charge 0; state another")
    mass = ELECTRON_GEV if mass < 2 * ELECTRON_GEV else mass
    design = Ring(name, (), energy, mass=mass)
    report = report or Report()
    known: dict[int | float, list[Place]] = {}
    errors: dict[int, dict[str, Any]] = {}
    places: list[Place] = []
    for part in parts:
        key = part if isinstance(part, float) else id(part)
        if key not in known:
            one = Part("drift", "drift", {"l": part}) if isinstance(part, float) else part
            own = known[key] = _places(one, design, abs(charge), report)
            if amounts := _errors(one):
                errors |= {id(source): amounts for _, _, source in own}
            own += _exit_of_displaced(one)
        places += known[key]
    report.warn(name)
    return assembled(design, places, errors)


def assembled(
    design: Ring,
    places: Sequence[Place],
    errors: Mapping[int, Mapping[str, Any]],
    periods: int = 1,
) -> Ring:
    """The ring with elements at these places.

    Args:
        design: name, energy and mass.
        places: in beam order.
        errors: of an element, by the `id` of its source, as `Element.with_errors` takes them.
        periods: how often the places follow one another.
    """
    merged = merge_wigglers(list(places), design.map_energy) * periods
    families, kinds, sources = zip(*merged, strict=True)
    elements = tuple(
        e.with_errors(**errors[id(s)]) if id(s) in errors else e
        for e, s in zip(place_elements(families, sources, kinds), sources, strict=True)
    )
    return replace(design, elements=elements)


def acts(value: Any) -> bool:
    """Whether an attribute has a value other than zero; a word has."""
    if isinstance(value, dict):
        return any(map(acts, value.values()))
    if value is None:
        return False
    try:
        return bool(np.any(np.asarray(value, dtype=float)))
    except (TypeError, ValueError):
        return bool(value)


def _check(part: Part, report: Report) -> None:
    """Attributes that the model lacks.

    Raises:
        LatticeError: one that the optics needs, or a keyword of no list.
    """
    keyword = part.keyword
    where = f" ({part.where})" if part.where else ""
    named = f"{keyword.upper()} '{plain(part.name, 60)}'{where}"
    if keyword in ACTING:
        for attribute in ACTING[keyword]:
            if acts(part.values.get(attribute, _ASSUMED.get(attribute))):
                raise LatticeError(
                    f"{named} acts on the beam by its {attribute.upper()}, which is not modelled; "
                    "set it to 0 or take the element out"
                )
        return
    if keyword in STATIC:
        if acts(part.values.get(STATIC[keyword])):
            report.left_out(f"what the voltage does in the {keyword.upper()}", part.name)
        return
    if keyword not in MODELLED:
        raise LatticeError(f"{named}: no element class {keyword.upper()} is known")
    for attribute, value in part.values.items() if MODELLED[keyword] is not _PASSIVE else ():
        if attribute in MODELLED[keyword] or attribute in NO_EFFECT or not acts(value):
            continue
        if attribute not in NONLINEAR:
            raise LatticeError(
                f"the attribute {attribute.upper()} of {named} is not modelled; set it to 0 or "
                "take it out"
            )
        report.left_out(attribute.upper(), part.name)


def _errors(part: Part) -> dict[str, Any]:
    """Misalignments, and the dipole field of a bend beyond its design curvature.

    In the curved frame a field of k0 focuses by h k0 in the plane of the bend.
    """
    own = {"dx": "dx", "dy": "dy", "ds": "ds", "roll": "dpsi"}
    amounts: dict[str, Any] = {k: part.number(v) for k, v in own.items()}
    if part.keyword == "sbend":
        length, angle = part.number("l"), part.number("angle")
        knl, ksl = _integrated(part, "knl"), _integrated(part, "ksl")
        excess = length * part.number("k0") - angle if part.number("k0") else 0.0
        x, y = -excess - knl[0], part.number("k0s") * length + ksl[0]
        roll = amounts.pop("roll")  # about the entrance's axis: the field kicks, as it is turned
        x, y = x + roll**2 * math.sin(angle) / 2, y - roll * math.sin(angle)
        cos, sin = math.cos(part.number("tilt")), math.sin(part.number("tilt"))
        x, y = x * cos - y * sin, x * sin + y * cos
        amounts["kick_x"], amounts["kick_y"] = x, y
        curvature = angle / length if length else 0.0  # the way through the field is 1 + h x
        # and its oblique faces focus by the field that is there
        edge = (excess + knl[0]) / length * sum(math.tan(part.number(e)) for e in ("e1", "e2"))
        along, across, mixed = cos**2 - sin**2, sin**2 - cos**2, 2 * cos * sin
        amounts["middle"] = tuple(
            curvature * k * c + edge * face
            for k, c, face in zip(
                (x, x, y, y), (cos, sin, cos, sin), (along, mixed, mixed, across), strict=True
            )
        )
        gradient = part.number("k1") * length + knl[1]
        amounts["k1sl"] = part.number("k1s") * length + ksl[1] - gradient * math.sin(2 * roll)
        if amounts["k1sl"] and part.number("tilt"):
            raise LatticeError(
                f"the tilted bend '{plain(part.name, 60)}' has a skew gradient, which is not "
                "modelled; set its tilt or its K1S to 0"
            )
    return {k: v for k, v in amounts.items() if np.any(v)}


def _exit_of_displaced(part: Part) -> list[Place]:
    """What the exit of a displaced bend does beyond that of a displaced straight magnet.

    The body is moved as a whole, by dx and ds along the axes of its entrance; those of its exit are
    turned by the angle.
    """
    angle, ds, tilt = part.number("angle"), part.number("ds"), part.number("tilt")
    cos, sin = math.cos(tilt), math.sin(tilt)
    inward = part.number("dx") * cos + part.number("dy") * sin
    if part.keyword != "sbend" or not angle or not (ds or inward):
        return []
    from tmlattice.lattice.ocelot import elements as ocelot

    aside = ds * math.sin(angle) - inward * (1 - math.cos(angle))
    way = ds * (1 - math.cos(angle)) + inward * math.sin(angle)
    source = ocelot.Matrix(l=0.0, eid=f"{part.name}_exit")
    source.r = np.eye(6)
    source.r[0, 1] = source.r[2, 3] = way
    source.b = np.array([[aside * cos, 0.0, aside * sin, 0.0, 0.0, 0.0]]).T
    return [(f"{part.name}_exit", "matrix", source)]


def _integrated(part: Part, attribute: str) -> Array:
    """Four integrated strengths at least."""
    given = part.list(attribute)
    return np.concatenate([given, np.zeros(max(0, 4 - len(given)))])


def fields(part: Part) -> ComplexArray:
    """k_n + i k_ns of each order, four at least; integrated where the element is thin."""
    length = part.number("l")
    normal, skew = _integrated(part, "knl"), _integrated(part, "ksl")
    total = np.zeros(max(len(normal), len(skew)), dtype=complex)
    total[: len(normal)] += normal
    total[: len(skew)] += 1j * skew
    if length:
        total /= length
        total[:4] += [complex(part.number(f"k{n}"), part.number(f"k{n}s")) for n in range(4)]
    return total


def strengths(part: Part) -> ComplexArray:
    """`fields` over n!, as AT has them."""
    total = fields(part)
    total /= np.array([math.factorial(n) for n in range(len(total))], dtype=float)
    return total


def _places(part: Part, ring: Ring, charge: float, report: Report) -> list[Place]:
    """What one element of a file is in the ring."""
    from tmlattice.lattice.ocelot import elements as ocelot

    _check(part, report)
    name, length, tilt = part.name, part.number("l"), part.number("tilt")
    keyword = part.keyword
    match keyword:
        case "hkicker" | "vkicker" | "kicker" | "tkicker":
            return _corrector(part)
        case "monitor" | "hmonitor" | "vmonitor":
            return [(name, "monitor", ocelot.Monitor(l=length, eid=name))]
        case "rfcavity":
            voltage, frequency = 1e-3 * charge * part.number("volt"), 1e6 * part.number("freq")
            source = ocelot.Cavity(l=length, v=voltage, freq=frequency, eid=name)
            return [(name, "cavity", source)]
        case "solenoid" if length:
            half = (part.number("ks") or part.number("ksi") / length) / 2
            return [(name, "solenoid", ocelot.Solenoid(l=length, k=half, eid=name))]
        case "solenoid" | "dipedge" | "srotation" | "matrix":
            return [_matrix(part, ring)]
        case "sbend" if length:
            return [(name, "bend", _bend(part, report))]
        case "sbend":
            raise LatticeError(f"the bend '{plain(name, 60)}' has no length; give it one")
        case "quadrupole" | "sextupole" | "octupole" | "multipole" if not length:
            # K L of a thin magnet is nothing; KNL acts
            return [(name, "multipole", _thin(part, report))]
        case "quadrupole" | "sextupole" | "octupole" | "multipole":
            kind, source = straight_magnet(
                strengths(part), MAIN_ORDER.get(keyword), length, tilt, name,
                lambda reason: report.left_out(reason, name),
            )  # fmt: skip
            return [(name, kind, source)]
    if length:
        return [(name, "drift", ocelot.Drift(l=length, eid=name))]
    return [(name, "marker", ocelot.Marker(eid=name))]


def _corrector(part: Part) -> list[Place]:
    """A corrector of one plane by its keyword, turned by its tilt; else one of each plane."""
    name, length, tilt = part.name, part.number("l"), part.number("tilt")
    x, y = part.number("hkick"), part.number("vkick")
    cos, sin = math.cos(tilt), math.sin(tilt)
    if part.keyword in ("hkicker", "vkicker"):
        plane = part.keyword[0]
        amount = part.number("kick") or (x if plane == "h" else y)
        quarter = round(2 * tilt / math.pi)
        if abs(tilt - quarter * math.pi / 2) < 1e-9:
            if quarter % 2:
                amount *= sin if plane == "h" else -sin
                plane = "v" if plane == "h" else "h"
            else:
                amount *= cos
            return [corrector(name, plane, length, amount)]  # type: ignore[arg-type]
        x, y = (amount, 0.0) if plane == "h" else (0.0, amount)
    return corrector_pair(name, length, x * cos - y * sin, x * sin + y * cos)


def _thin(part: Part, report: Report) -> Any:
    """A thin multipole; its first normal component bends the design orbit, as in MAD-X.

    `angle`, where it is given, is the design's bend, and the rest of KNL[0] a field error.
    """
    from tmlattice.lattice.combined import CombinedMultipole, fields_of

    own = fields(part)
    if np.any(own[3:]):
        report.left_out("fields above the sextupole", part.name)
    k = own[:3].tolist()
    given, turn = part.values.get("angle"), 0.0
    if given is None and k[0].imag:  # it bends in a plane of its own
        turn = -cmath.phase(k[0])
        k = [one * cmath.exp(1j * (n + 1) * turn) for n, one in enumerate(k)]
        k[0] = complex(k[0].real)
    angle = k[0].real if given is None else float(given)
    if angle and (k[1] or k[2]):
        report.left_out("products of curvature and gradient", part.name)
    k[0] -= angle
    tilt = part.number("tilt") + turn
    return CombinedMultipole(
        **fields_of(k), angle=angle, lrad=part.number("lrad"), tilt=tilt, eid=part.name
    )


def _bend(part: Part, report: Report) -> Any:
    from tmlattice.lattice.ocelot import elements as ocelot

    own = fields(part)
    if np.any(own[3:]) or own[2].imag:
        report.left_out("fields above the gradient, but for the normal sextupole,", part.name)
    values: dict[str, float] = {
        k: part.number(k) for k in ("e1", "e2", "h1", "h2", "fint", "fintx")
    }
    if part.values.get("fintx") is None or values["fintx"] < 0:
        values["fintx"] = values["fint"]
    if part.number("kill_ent_fringe"):
        values |= {"e1": 0.0, "h1": 0.0, "fint": 0.0}
    if part.number("kill_exi_fringe"):
        values |= {"e2": 0.0, "h2": 0.0, "fintx": 0.0}
    return ocelot.SBend(
        l=part.number("l"),
        angle=part.number("angle"),
        k1=own[1].real,
        k2=own[2].real,
        e1=values["e1"],
        e2=values["e2"],
        tilt=part.number("tilt"),
        gap=2 * part.number("hgap"),
        fint=values["fint"],
        fintx=values["fintx"],
        h_pole1=values["h1"],
        h_pole2=values["h2"],
        eid=part.name,
    )


def fringe_of(curvature: float, e: float, gap: float, integral: float, down: float) -> float:
    """Half gap times fringe integral (m) of a face that focuses as one with a feed-down angle.

    Arguments as of `edge_focusing`, in the design's field.
    """
    y = edge_focusing(curvature, e, gap, integral, down)[1]
    scale = 2 * curvature * (1 + math.sin(e) ** 2) / math.cos(e)
    return (e + math.atan(y / curvature)) / scale


def edge_focusing(
    field: float, e: float, gap: float, integral: float, down: float = 0.0
) -> tuple[float, float]:
    """R21 and R43 of the face of a bend, 1/m, as of DIPEDGE.

    Args:
        field: the dipole field behind the face, 1/m.
        e: its angle, rad.
        gap, integral: half gap (m) and fringe integral.
        down: added to the angle in the vertical plane, rad.
    """
    y = e + down
    fringe = 2 * gap * integral * field * (1 + math.sin(y) ** 2) / math.cos(y)
    return field * math.tan(e), -field * math.tan(y - fringe)


def _matrix(part: Part, ring: Ring) -> Place:
    """A matrix element; MAD-X's (t, pt) are (-tau, p)."""
    from tmlattice.lattice.ocelot import elements as ocelot

    r = np.eye(6)
    turn = part.number("tilt")
    match part.keyword:
        case "matrix" if "rmat" in part.values:
            r = np.asarray(part.values["rmat"], dtype=float).copy()
        case "matrix":
            sign = np.diag([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
            r = sign @ np.asarray(part.values.get("rm", np.eye(6)), dtype=float) @ sign
        case "dipedge":
            r[1, 0], r[3, 2] = edge_focusing(*map(part.number, ("h", "e1", "hgap", "fint")))
        case "srotation":
            r = rotation(part.number("angle"))
        case "solenoid":
            half, turn = part.number("ks") / 2, part.number("ksi") / 2
            r[1, 0] = r[3, 2] = -half * turn
            r = rotation(turn) @ r
            turn = 0.0
    if turn:
        r = rotation(-turn) @ r @ rotation(turn)
    source = ocelot.Matrix(l=part.number("l"), eid=part.name)
    source.r = r
    if "b" in part.values:
        source.b = np.asarray(part.values["b"], dtype=float).reshape(6, 1)
        if source.b[5, 0]:
            raise LatticeError(
                f"the matrix '{plain(part.name, 60)}' changes the energy in every turn, which is "
                "not modelled; set that to 0"
            )
    kind: Kind = "solenoid" if part.keyword == "solenoid" else "matrix"
    return part.name, "wiggler" if "wig" in part.name.casefold() else kind, source
