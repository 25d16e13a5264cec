"""Reading Xsuite's JSON: a line, or an environment with lines, of any version.

Every class is in one of three lists: modelled; without effect on the static optics (`PASSIVE`,
`COLLECTIVE`); or neither, and then the file is refused unless the element's strength is zero
(`ACTING`). So is every field of a class that is modelled.
"""

import cmath
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import LatticeError, plain
from tmlattice.input_files import json_of
from tmlattice.lattice.expressions import Arithmetic
from tmlattice.lattice.lines import chosen, with_gaps
from tmlattice.lattice.parts import Part, Report, acts, edge_focusing, fringe_of, ring_of_parts
from tmlattice.lattice.places import KIND_OF
from tmlattice.lattice.ring import ELECTRON_GEV, LIGHT, Ring

MOST_BYTES = 1_000_000_000
DEEPEST = 50
"""Lines in lines, and elements that are copies of copies."""

PASSIVE = frozenset({
    "Marker", "Drift", "DriftExact", "DriftExactSlice", "Device", "LimitEllipse", "LimitPolygon",
    "LimitRacetrack", "LimitRect", "LimitRectEllipse", "LongitudinalLimitRect",
    "ParticlesMonitor", "LastTurnsMonitor", "MultiElementMonitor", "BeamProfileMonitor",
    "BeamSizeMonitor", "BeamStatsMonitor", "SyncTime", "RandomExponential", "RandomNormal",
    "RandomRutherford", "RandomUniform", "RandomUniformAccurate", "MultipoleEdge", "ZetaShift",
    "TimeDelay", "BlackAbsorber", "BlackCrystal", "TransparentCollimator", "TransparentCrystal",
    "ScatterHelper", "EverestBlock", "EverestCollimator", "EverestCrystal", "FlukaCollimator",
    "FlukaCrystal", "Geant4Collimator", "Geant4CollimatorTip", "Geant4Crystal", "TouschekMarker",
    "ParticleStatsMonitor", "EmittanceMonitor",
})  # fmt: skip
"""Drifts and markers in the optics: apertures, collimators, monitors of particles, delays, and
fringes of the third order."""
COLLECTIVE = frozenset({
    "ACDipole", "Exciter", "TransverseDamper", "CollectiveMonitor", "WakeTracker", "WakeField",
    "Wakefield", "ResistiveWallWake", "MultiWakefield", "IBSAnalyticalKick", "IBSKineticKick",
    "ElectronCloud", "BunchMonitor", "BlowUp", "RFSweep", "SlicedParticles", "DampingElement",
})  # fmt: skip
"""What excites or damps the beam, or acts with the beam's current: named in a warning."""
ACTING: dict[str, tuple[str, ...]] = {
    "Elens": ("current",),
    "Wire": ("current",),
    "ElectronCooler": ("current",),
    "NonLinearLens": ("knll",),
    "ReferenceEnergyIncrease": ("Delta_p0c",),
    "ReferenceEnergyChange": ("p0c",),
    "Misalignment": ("dx", "dy", "ds", "theta", "phi", "psi"),
    "XRotation": ("angle", "sin_angle", "tan_angle"),
    "YRotation": ("angle", "sin_angle", "tan_angle"),
    "Wedge": ("angle", "k", "k1"),
    "MagnetEdge": ("kn", "ks", "knl", "ksl"),
    "DipoleFringe": ("k",),
    "RFMultipole": ("knl", "ksl", "voltage"),
    "TempRF": ("knl", "ksl", "voltage"),
    "BFieldExpansion": ("k0", "k1", "k2", "k3", "k0s", "k1s", "k2s", "k3s", "ksc", "knc", "ksolc",
                        "knl", "ksl", "ksoll", "angle", "h"),
    "BeamBeamBiGaussian2D": ("other_beam_num_particles",),
    "BeamBeamBiGaussian3D": ("slices_other_beam_num_particles",),
    "BeamBeamPIC3D": ("scale_strength",),
}  # fmt: skip
"""Classes that are not modelled, and the fields by which they act."""
NO_EFFECT = frozenset({
    "__class__", "order", "inv_factorial_order", "model", "integrator", "num_multipole_kicks",
    "num_kicks", "radiation_flag", "name_associated_aperture", "extra", "prototype", "dummy",
    "tpsa_enabled", "internal_record_id", "isthick", "length", "rot_shift_anchor", "absolute_time",
    "lag_taper", "phase_taper", "weight", "slice_offset", "parent_name", "parent", "main_order",
    "main_is_skew", "rbend_model", "rbend_shift", "rbend_compensate_sagitta", "k0_from_h", "h",
    "mult_shift_s", "slice_offset_fraction",
})  # fmt: skip
"""Fields without effect on the optics, or on which another field's meaning depends."""
SLICE = re.compile(r"(Thick|Thin|Drift)Slice(\w*?)(Entry|Exit)?")
BENDS = ("Bend", "RBend", "CombinedFunctionMagnet", "Magnet")
MAIN = {"Bend": "k0", "RBend": "k0", "CombinedFunctionMagnet": "k0", "Quadrupole": "k1",
        "Sextupole": "k2", "Octupole": "k3"}  # fmt: skip
MOST_KICKS = 1000
LUMPED = 1e-5
"""1/m; by so much a magnet's focusing may differ for its gradient's being spread over its length:
1e-5 of a tune at a beta of 10 m."""
SLICE_ANGLE, KICKS, YOSHIDA = 0.022, 7, 5.8e-3
"""rad: Xsuite has seven kicks for each such angle of a bend. In a slice of length l they change a
gradient by YOSHIDA (k1 l^2)^3 of itself (measured between 0.12 and 0.5)."""
SKEW_SHARE = 0.1
"""Weight of skew gradients there: they act on the tunes in second order."""
ROUNDING = 1e-9
"""Relative; a dipole field that differs by less from the design's is the design's."""
EDGES = {-1: "suppressed", 0: "linear", 1: "full", 2: "dipole-only"}
SIDES = ("entry", "exit")


def read_xsuite(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a JSON file of Xsuite.

    Args:
        path: `.json`: a line, an environment with lines, or `{"line", "particle"}`.
        name: of the ring.
        sequence: of an environment's lines; else `ring`, else the only one.
        energy: GeV; else that of the line's reference particle.

    Raises:
        LatticeError: no line, several without a choice, no energy, or an element or a field that
            the optics needs and that is not modelled.

    Warns:
        Of what is left out.
    """
    if path.stat().st_size > MOST_BYTES:
        raise LatticeError(f"'{path}' is larger than {MOST_BYTES / 1e9:g} GB; save one line")
    content = json_of(path, LatticeError, finite=False)
    try:
        return ring_of_content(path, content, name, sequence, energy)
    except LatticeError as error:
        if str(error).startswith(f"'{path}'"):
            raise
        raise LatticeError(f"'{path}' cannot be read as Xsuite's JSON: {error}") from error


def ring_of_content(
    path: Path, content: Any, name: str, sequence: str | None, energy: float | None
) -> Ring:
    """The ring of what `xtrack.Line.to_dict` or `Environment.to_dict` returns; see `read_xsuite`.

    Args:
        path: of its file, or the object's name, for messages.
        content: the dictionary.
        name, sequence, energy: see `read_xsuite`.
    """
    outer: Mapping[str, Any] = {}
    if isinstance(content.get("line"), dict):
        content, outer = content["line"], content
    line = content
    if isinstance(content.get("lines"), dict):
        line = content["lines"][chosen(path, list(content["lines"]), sequence)]
    mass, charge, stated = _particle(line, content, outer)
    if energy is None and stated is None:
        raise LatticeError(f"'{path}' has no reference particle; give energy= (GeV)")
    energy = float(stated or 0.0) if energy is None else energy
    reader = _Reader(content, line, energy, mass)
    parts = reader.parts()
    if "energy_program" in content or "energy_program" in line:
        reader.report.left_out("the energy programme", "line")
    return ring_of_parts(parts, name, energy, mass, charge, reader.report)


def _particle(*places: Mapping[str, Any]) -> tuple[float, float, float | None]:
    """Rest energy (GeV), charge (e) and energy (GeV) of the reference particle that is stated."""
    particle: Any = None
    for place in places:
        particle = particle or place.get("particle_ref") or place.get("particle")
    if isinstance(particle, str):
        wanted, particle = particle, None
        for place in places:
            for key in ("particles", "env_particles"):
                particle = particle or (place.get(key) or {}).get(wanted)
        if particle is None:
            raise LatticeError(f"the reference particle '{plain(wanted, 60)}' is not in the file")
    if not particle:
        return ELECTRON_GEV, 1.0, None
    values = {str(k).lstrip("_"): v for k, v in particle.items()}

    def number(key: str) -> float | None:
        given = np.ravel(np.asarray(values.get(key, ()), dtype=float))
        return float(given[0]) if len(given) and math.isfinite(given[0]) else None

    mass, charge, momentum = number("mass0"), number("q0"), number("p0c")
    mass = ELECTRON_GEV if mass is None else 1e-9 * mass
    gamma, beta = number("gamma0"), number("beta0")
    energy: float | None = None
    if momentum and momentum < 0:
        raise LatticeError(f"the reference particle has the momentum {momentum:g} eV/c")
    if momentum:
        energy = math.hypot(1e-9 * momentum, mass)
    elif gamma:
        energy = gamma * mass
    elif beta:
        energy = mass / math.sqrt(1 - beta**2)
    return mass, 1.0 if charge is None else charge, energy


class _Fields:
    """The fields of one element; those that are asked for are modelled."""

    def __init__(self, name: str, content: Mapping[str, Any]) -> None:
        if not isinstance(content, Mapping) or "__class__" not in content:
            raise LatticeError(f"the element '{plain(name, 60)}' has no __class__")
        self.name, self.cls = name, str(content["__class__"])
        self.values = {
            str(k) if str(k).startswith("__") else str(k).lstrip("_"): v for k, v in content.items()
        }
        self.used: set[str] = set()

    @property
    def named(self) -> str:
        """For messages."""
        return f"{plain(self.cls, 60)} '{plain(self.name, 60)}'"

    def number(self, key: str, default: float = 0.0) -> float:
        """A field that is a number."""
        self.used.add(key)
        value = self.values.get(key)
        if isinstance(value, float) or value is None:
            return default if value is None else value
        try:
            given = np.ravel(np.asarray(value, dtype=float))
        except (TypeError, ValueError):
            raise LatticeError(
                f"{key} of {self.named} is '{plain(str(value), 40)}' and no number"
            ) from None
        if len(given) != 1:
            raise LatticeError(f"{key} of {self.named} is no single number")
        return float(given[0])

    def list(self, key: str, least: int = 0) -> Array:
        """A field that is a list, with zeros up to `least` items."""
        self.used.add(key)
        value = self.values.get(key)
        given = np.ravel(np.asarray([] if value is None else value, dtype=float))
        return np.concatenate([given, np.zeros(max(0, least - len(given)))])

    def word(self, key: str, default: str, words: Mapping[int, str] | None = None) -> str:
        """A field that is a word; old files have its number."""
        self.used.add(key)
        value = self.values.get(key, default)
        return (words or {}).get(value, default) if isinstance(value, int) else str(value)

    def acts(self, key: str) -> bool:
        """Whether a field is neither zero nor empty."""
        return acts(self.values.get(key))

    def check(self) -> None:
        """Raises a LatticeError for a field that acts and was not asked for."""
        for key in self.values:
            if key not in self.used and key not in NO_EFFECT and self.acts(key):
                raise LatticeError(
                    f"the field {plain(key, 40)} of {self.named} is not modelled; set it to 0 or "
                    "take it out"
                )


class _Reader:
    """Elements of a line as parts."""

    def __init__(self, content: Any, line: Any, energy: float, mass: float) -> None:
        elements = line.get("elements") or content.get("elements") or {}
        if isinstance(elements, list):  # files of the first versions
            elements = dict(zip(line.get("element_names", ()), elements, strict=True))
        self.elements: Mapping[str, Any] = elements
        self.lines: Mapping[str, Any] = content.get("lines") or {}
        self.line = line
        self.beta = math.sqrt(max(0.0, 1 - (mass / energy) ** 2))
        self.momentum = 1e9 * energy * self.beta
        self.report = Report()
        variables = (content.get("_var_management_data") or {}).get("var_values") or {}
        functions = (math.sqrt, math.sin, math.cos, math.tan, math.exp)
        self.variables: dict[str, Any] = {own.__name__: own for own in functions}
        self.variables |= {k: v for k, v in variables.items() if isinstance(v, int | float)}
        self._arithmetic = Arithmetic(functions)
        self._steering = {
            key: {str(name).partition("::")[0] for name in own or ()}
            for key, own in (line.get("_extra_config") or {}).items() if key.startswith("steering_")
        }  # fmt: skip
        self._made: dict[str, list[Part]] = {}
        self._length = 0.0

    def parts(self) -> list[Part | float]:
        """The line's elements in beam order, and the gaps between them."""
        placed = self._names(self.line, 0)
        self._length = sum(map(self._way, placed))
        parts: list[Part | float] = []
        for item in placed:
            if isinstance(item, float):
                parts.append(item)
                continue
            if item not in self._made:
                own = self._converted(self._fields(item), item.lower())
                self._made[item] = [self._steered(item, part) for part in own]
            parts += self._made[item]
        return parts

    def _steered(self, name: str, part: Part) -> Part:
        """A marker or way among the monitors of the line's steering as a monitor, a dipole field
        among its correctors as a corrector."""
        x, y, read_x, read_y = (
            name in self._steering.get(f"steering_{what}", ())
            for what in ("correctors_x", "correctors_y", "monitors_x", "monitors_y")
        )
        if (read_x or read_y) and part.keyword in ("marker", "drift"):
            return replace(part, keyword="monitor")
        if not (x or y) or part.keyword != "multipole" or part.number("angle"):
            return part
        knl, ksl = part.list("knl"), part.list("ksl")
        moved = any(part.number(key) for key in ("dx", "dy", "ds", "dpsi"))
        if knl[1:].any() or ksl[1:].any() or moved:
            return part
        kick_x, kick_y = -float(knl[:1].sum()), float(ksl[:1].sum())
        values = {"l": part.number("l"), "tilt": part.number("tilt")}
        if x and not y and not kick_y:
            return replace(part, keyword="hkicker", values={**values, "kick": kick_x})
        if y and not x and not kick_x:
            return replace(part, keyword="vkicker", values={**values, "kick": kick_y})
        return replace(part, keyword="kicker", values={**values, "hkick": kick_x, "vkick": kick_y})

    # --- the order of a line's elements ---------------------------------------------------------
    def _names(self, line: Mapping[str, Any], depth: int) -> list[str | float]:
        """Names of elements in beam order, and lengths (m) of gaps between them."""
        if depth > DEEPEST:
            raise LatticeError("a line contains itself")
        composer = line.get("composer") or line.get("builder")
        names = line.get("element_names") or []
        if not composer or (names and line.get("mode", "normal") != "compose"):
            return [str(name) for name in names]
        self._arithmetic.work(100)
        refer = composer.get("refer") or "center"
        items: list[tuple[Any, Mapping[str, Any]]] = []
        for component in composer.get("components") or ():
            self._arithmetic.work(10)
            place = {} if isinstance(component, str) else component
            what = place.get("name", component)
            inner = self.lines.get(what) if isinstance(what, str) else what
            if not isinstance(inner, Mapping):
                items.append((str(what), place))
                continue
            own = self._names(inner, depth + 1)
            if own and place.get("at") is not None:
                anchor = _anchor(place.get("anchor") or refer) * sum(map(self._way, own))
                at = self._value(place["at"]) - anchor
                place = {**place, "at": at, "anchor": "start"}
            items += [(item, place if k == 0 else {}) for k, item in enumerate(own)]
        if len(items) > 1_000_000:
            raise LatticeError("a line has more elements than any ring")
        length = composer.get("length", composer.get("l"))
        tolerance = float(composer.get("s_tol") or 1e-6)
        total = None if length is None else self._value(length)
        laid = self._laid_out(items, refer, total, tolerance)
        return laid[::-1] if composer.get("mirror") else laid

    def _way(self, item: str | float) -> float:
        return item if isinstance(item, float) else self._element_length(item)

    def _value(self, given: Any) -> float:
        """A position or length, m: a number or an expression of the file's variables."""
        if isinstance(given, int | float):
            return float(given)
        try:
            return float(self._arithmetic.value(str(given), self.variables))
        except (ValueError, TypeError, NameError, SyntaxError, ArithmeticError) as error:
            raise LatticeError(
                f"the position '{plain(str(given), 60)}' cannot be worked out ({error})"
            ) from error

    def _laid_out(
        self, items: Sequence[tuple[Any, Mapping[str, Any]]], refer: str, total: float | None,
        tolerance: float,
    ) -> list[str | float]:  # fmt: skip
        """Elements by position, and the gaps between them."""
        ways = [self._way(item) for item, _ in items]
        starts: list[float | None] = [None] * len(items)
        known: dict[str, int] = {}
        progress = True
        while progress:
            progress = False
            for k, (item, place) in enumerate(items):
                if starts[k] is not None:
                    continue
                self._arithmetic.work()
                start = self._start(k, ways, starts, known, place, refer)
                if start is None:
                    continue
                starts[k], progress = start, True
                known[str(item)] = k
        if None in starts:
            item = items[starts.index(None)][0]
            raise LatticeError(f"the position of '{plain(str(item), 60)}' refers to no element")
        placed = [float(start or 0.0) for start in starts]
        order = sorted(range(len(items)), key=lambda k: round(placed[k] + ways[k] / 2, 9))
        own = ((items[k][0], str(items[k][0]), placed[k], ways[k]) for k in order)
        return with_gaps(own, "the line", total, tolerance, tolerance)

    def _start(
        self, k: int, ways: Sequence[float], starts: Sequence[float | None],
        known: Mapping[str, int], place: Mapping[str, Any], refer: str,
    ) -> float | None:  # fmt: skip
        """Where an element begins, m; None while what it refers to has no position."""
        at, origin = place.get("at"), place.get("from_")
        anchor = place.get("from_anchor")
        if isinstance(at, str) and ("@" in at or at in self.elements):
            at, origin = 0.0, at
        if isinstance(origin, str) and "@" in origin:
            origin, _, anchor = origin.partition("@")
        if at is None:
            before = starts[k - 1] if k else 0.0
            return None if before is None else before + (ways[k - 1] if k else 0.0)
        start = self._value(at) - _anchor(place.get("anchor") or refer) * ways[k]
        if origin is None:
            return start
        if origin not in known:
            return None
        other = known[origin]
        return start + float(starts[other] or 0.0) + _anchor(anchor or refer) * ways[other]

    # --- elements -------------------------------------------------------------------------------
    def _fields(self, name: str) -> _Fields:
        """An element's fields; of a replica those of what it repeats."""
        wanted = name
        for _ in range(DEEPEST):
            if name not in self.elements:
                raise LatticeError(f"no element '{plain(name, 60)}' is in the file")
            fields = _Fields(wanted, self.elements[name])
            if fields.cls != "Replica":
                return fields
            name = str(fields.values.get("parent_name"))
        raise LatticeError(f"the element '{plain(wanted, 60)}' repeats itself")

    def _parent(self, fields: _Fields) -> _Fields:
        """Of what an element is a slice."""
        parent = fields.values.get("parent") or fields.values.get("parent_name")
        if isinstance(parent, Mapping):
            return _Fields(fields.name, parent)
        if parent is None:
            raise LatticeError(f"{fields.named} is a slice and has no parent_name")
        found = self._fields(str(parent))
        found.name = fields.name
        return found

    def _element_length(self, name: str) -> float:
        """m, along the beam."""
        fields = self._fields(name)
        sliced = SLICE.fullmatch(fields.cls)
        if sliced:
            thin = sliced[1] == "Thin" or sliced[3]
            return 0.0 if thin else fields.number("weight", 1.0) * _way_of(self._parent(fields))
        return _way_of(fields)

    def _converted(self, fields: _Fields, name: str) -> list[Part]:
        """What one element of the file is in the ring."""
        cls, where = fields.cls, f"Xsuite's {plain(fields.cls, 40)}"
        sliced = SLICE.fullmatch(cls)
        if sliced or cls == "DriftExactSlice":
            return self._slice(fields, name, where, sliced)
        if cls in COLLECTIVE:
            self.report.left_out(f"what the {cls} does", name)
        if cls in PASSIVE or cls in COLLECTIVE:
            return [_passive(name, _way_of(fields))]
        if cls in ACTING:
            return [self._inert(fields, name)]
        if cls.startswith("SpaceCharge"):
            profile = fields.values.get("longitudinal_profile") or {}
            if fields.values.get("scale_strength", 1) and profile.get("number_of_particles", 1):
                raise _not_modelled(fields)
            return [_passive(name, 0.0)]
        make = self._classes().get(cls)
        if make is None:
            raise LatticeError(
                f"the class {plain(cls, 60)} of the element '{plain(fields.name, 60)}' is not "
                "modelled; take the element out, or replace it by one that is"
            )
        parts = make(fields, name, where)
        fields.check()
        return parts

    def _classes(self) -> dict[str, Callable[[_Fields, str, str], list[Part]]]:
        return {
            **dict.fromkeys(BENDS[:3], self._bend),
            **dict.fromkeys(("Quadrupole", "Sextupole", "Octupole", "Magnet"), self._straight),
            "Multipole": self._multipole,
            "SimpleThinBend": self._multipole,
            "SimpleThinQuadrupole": self._multipole,
            "Cavity": self._cavity,
            "CrabCavity": self._crab,
            "Solenoid": self._solenoid,
            "UniformSolenoid": self._solenoid,
            "VariableSolenoid": self._solenoid,
            "DipoleEdge": self._dipole_edge,
            "FirstOrderTaylorMap": self._map,
            "SecondOrderTaylorMap": self._map,
            "SRotation": self._rotation,
            "Rotation": self._rotation,
            "XYShift": self._shift,
            "Translation": self._shift,
            "BeamPositionMonitor": self._monitor,
        }

    def _monitor(self, fields: _Fields, name: str, where: str) -> list[Part]:
        fields.used |= set(fields.values)
        return [Part(name, "monitor", {}, where)]

    def _inert(self, fields: _Fields, name: str) -> Part:
        """An element of a class that is not modelled, where its strength is zero."""
        off = fields.values.get("scale_strength", 1) == 0
        if fields.cls == "ReferenceEnergyChange":
            off |= abs(fields.number("p0c", self.momentum) / self.momentum - 1) < 1e-9
        if not off and any(map(fields.acts, ACTING[fields.cls])):
            raise _not_modelled(fields)
        return _passive(name, _way_of(fields))

    def _alignment(self, fields: _Fields) -> dict[str, float]:
        """Misalignments and tilt; a slice has those of its parent."""
        for key in ("rot_x_rad", "rot_y_rad"):
            if fields.number(key):
                raise LatticeError(
                    f"{fields.named} is turned by its {key}, which is not modelled; set it to 0"
                )
        sin, cos = fields.number("sin_rot_s", -999.0), fields.number("cos_rot_s", -999.0)
        if fields.number("delta_taper"):
            self.report.left_out("delta_taper", fields.name)
        moved = {
            "dx": fields.number("shift_x"), "dy": fields.number("shift_y"),
            "ds": fields.number("shift_s"), "tilt": fields.number("rot_s_rad"),
            "dpsi": fields.number("rot_s_rad_no_frame"),
        }  # fmt: skip
        if max(abs(sin), abs(cos)) <= 1.0 and not moved["tilt"]:  # in early files; -999: none
            moved["tilt"] = math.atan2(sin, cos)
        anchor = fields.number("rot_shift_anchor")
        if anchor and fields.cls in BENDS:  # along the axes there, which are turned
            bend = _Bend(fields, self)
            turn = cmath.exp(1j * bend.curvature * anchor)
            frame = cmath.exp(1j * moved["tilt"])
            aside = complex(moved["dx"], moved["dy"]) / frame
            along = complex(aside.real, moved["ds"]) * turn
            aside = complex(along.real, aside.imag) * frame
            moved |= {"dx": aside.real, "dy": aside.imag, "ds": along.imag}
        return moved

    def _strengths(self, fields: _Fields, length: float, dipole: float) -> tuple[Array, Array]:
        """Integrated normal and skew strengths of each order, four at least.

        Args:
            fields: of a magnet.
            length: m.
            dipole: the normal dipole field, 1/m.
        """
        own = {key: fields.number(key) for key in ("k1", "k2", "k3", "k0s", "k1s", "k2s", "k3s")}
        own["k0"] = dipole
        fields.used.add("k0")
        lists = {key: fields.list(key, 4) for key in ("knl", "ksl", "knl_rel", "ksl_rel")}
        orders = max(map(len, lists.values()))
        knl, ksl, knl_rel, ksl_rel = (
            np.pad(values, (0, orders - len(values))) for values in lists.values()
        )
        if knl_rel.any() or ksl_rel.any():
            skew = bool(fields.number("main_is_skew"))
            if fields.cls == "Multipole":
                main = float((ksl if skew else knl)[int(fields.number("main_order"))])
            else:
                main = length * own[MAIN[fields.cls] + ("s" if skew else "")]
            knl, ksl = knl + main * knl_rel, ksl + main * ksl_rel
        for order in range(4):
            knl[order] += length * own[f"k{order}"]
            ksl[order] += length * own[f"k{order}s"]
        return knl, ksl

    def _slice(self, fields: _Fields, name: str, where: str, sliced: Any) -> list[Part]:
        parent, weight = self._parent(fields), fields.number("weight", 1.0)
        if sliced is None or sliced[1] == "Drift" or parent.cls in PASSIVE:
            return [_passive(name, weight * _way_of(parent))]
        if sliced[3]:
            if parent.cls not in BENDS:
                return [_passive(name, 0.0)]
            parts = _Bend(parent, self).edge(sliced[3] == "Exit", name, where)
        elif sliced[1] == "Thin":
            parts = self._thin_slice(parent, name, where, weight)
        elif parent.cls in BENDS[:3]:
            parts = [_Bend(parent, self).body(name, where, weight)]
        elif parent.cls in ("Cavity", "CrabCavity"):
            parts = self._cavity(parent, name, where, weight)
        elif parent.cls in ("UniformSolenoid", "Solenoid"):
            parts = self._solenoid(parent, name, where, weight)
        elif parent.cls in ("Quadrupole", "Sextupole", "Octupole", "Magnet", "Multipole"):
            if parent.cls == "Magnet" and _Bend(parent, self).angle:
                parts = [_Bend(parent, self).body(name, where, weight)]
            else:
                parts = self._in_kicks(parent, self._thick(parent, name, where, weight), weight)
        else:
            parent.cls = f"{fields.cls} of a {parent.cls}"
            raise _not_modelled(parent)
        if sliced[3] or sliced[1] == "Thick":
            _Bend(parent, self)  # its edges' fields are modelled, in other slices
        parent.used |= {"edge_entry_active", "edge_exit_active"}
        parent.check()
        return parts

    def _thin_slice(self, parent: _Fields, name: str, where: str, weight: float) -> list[Part]:
        if parent.cls in ("Cavity", "CrabCavity"):
            parts = self._cavity(parent, name, where, weight)
            return [Part(p.name, p.keyword, {**p.values, "l": 0.0}, where) for p in parts]
        length = _way_of(parent)
        if parent.cls in BENDS:
            bend = _Bend(parent, self)
            angle, dipole = bend.angle, bend.dipole
        else:
            angle, dipole = parent.number("hxl"), parent.number("k0")
        knl, ksl = self._strengths(parent, length, dipole)
        values = {"angle": weight * angle, "knl": weight * knl, "ksl": weight * ksl,
                  "lrad": weight * length}  # fmt: skip
        return [Part(name, "multipole", {**values, **self._alignment(parent)}, where)]

    def _bend(self, fields: _Fields, name: str, where: str) -> list[Part]:
        bend = _Bend(fields, self)
        self._few_kicks(fields, name, bend.angle)
        return bend.whole(name, where)

    def _few_kicks(self, fields: _Fields, name: str, angle: float) -> None:
        model, rule = fields.word("model", "adaptive"), fields.word("integrator", "adaptive")
        exact = ["mat-kick-mat", "mat-kick-mat-exact", "expanded"]
        if rule not in ("uniform", "teapot"):
            exact += ["adaptive", "full", "0"]
        k1, length = fields.number("k1"), _way_of(fields)
        slices = math.ceil(abs(angle) / SLICE_ANGLE)
        coarse = not model.startswith("mat") and _coarse(k1, length, slices)
        if (fields.number("num_multipole_kicks") and model not in exact) or coarse:
            self.report.left_out("the finite number of kicks", name)

    def _straight(self, fields: _Fields, name: str, where: str) -> list[Part]:
        if fields.cls == "Magnet":
            bend = _Bend(fields, self)
            oblique = (bend.face(k) or bend.fringe(k)[0] for k in (0, 1))
            if bend.angle or (bend.dipole and any(oblique)):
                return self._bend(fields, name, where)
        fields.used |= {"edge_entry_active", "edge_exit_active"}  # fringes of the third order
        return self._in_kicks(fields, self._thick(fields, name, where))

    def _in_kicks(self, fields: _Fields, whole: Part, weight: float = 1.0) -> list[Part]:
        """A straight magnet whose gradients, but for K1 of a quadrupole, are in thin kicks.

        Xsuite puts one kick in the middle where no number is given. A magnet whose kicks are fine,
        or whose gradient in them is weak, is kept whole.
        """
        length = whole.number("l")
        model, rule = fields.word("model", "adaptive"), fields.word("integrator", "adaptive")
        if model == "adaptive":
            model = {"Quadrupole": "mat", "Magnet": "rot"}.get(fields.cls, "drift")
        if rule == "adaptive":
            rule = "yoshida-6" if fields.cls == "Magnet" else "uniform"
        body = fields.number("k1") * length if model.startswith("mat") else 0.0
        count = math.ceil(weight * int(fields.number("num_multipole_kicks")))
        knl, ksl = whole.list("knl").copy(), whole.list("ksl")
        knl[1] -= body
        gradient = abs(knl[1]) + SKEW_SHARE * abs(ksl[1])
        lumped = gradient * abs(whole.list("knl")[1]) * length / 12  # what lumping adds to 1 / f
        if lumped < LUMPED or not 0 <= count < MOST_KICKS or not length:
            return [whole]
        if rule not in ("uniform", "teapot"):
            six = rule in ("yoshida6", "yoshida-6")
            if not six or _coarse(knl[1] / length, length, math.ceil(count / KICKS)):
                self.report.left_out("the finite number of kicks", whole.name)
            return [whole]
        return _kicks(whole, knl, ksl, max(1, count), rule == "teapot", body / length)

    def _thick(self, fields: _Fields, name: str, where: str, weight: float = 1.0) -> Part:
        length = _way_of(fields)
        knl, ksl = self._strengths(fields, length, fields.number("k0"))
        own = fields.cls.lower()
        if own == "magnet":
            fields.used |= {"angle", "h"}
            own = next((KIND_OF[n] for n in KIND_OF if knl[n] or ksl[n]), "multipole")
        values = {"l": weight * length, "knl": weight * knl, "ksl": weight * ksl}
        return Part(name, own, {**values, **self._alignment(fields)}, where)

    def _multipole(self, fields: _Fields, name: str, where: str) -> list[Part]:
        fields.used.add("hyl")
        if fields.acts("hyl"):
            raise LatticeError(f"{fields.named} bends vertically by its hyl, which is not modelled")
        if fields.acts("isthick") and _way_of(fields):
            if fields.number("hxl"):
                raise LatticeError(f"{fields.named} is thick and has hxl; give it as a Bend")
            return self._in_kicks(fields, self._thick(fields, name, where))
        knl, ksl = self._strengths(fields, 0.0, 0.0)
        values = {"knl": knl, "ksl": ksl, "angle": fields.number("hxl"),
                  "lrad": fields.number("length")}  # fmt: skip
        return [Part(name, "multipole", {**values, **self._alignment(fields)}, where)]

    def _cavity(self, fields: _Fields, name: str, where: str, weight: float = 1.0) -> list[Part]:
        if fields.cls == "CrabCavity":
            return self._crab(fields, name, where, weight)
        self._alignment(fields)
        volt, frequency = fields.number("voltage"), fields.number("frequency")
        phase = fields.number("phase") + math.radians(fields.number("lag"))
        if harmonic := fields.number("harmonic"):
            frequency = harmonic * self.beta * LIGHT / self._length if self._length else 0.0
        if not frequency and volt:
            if abs(volt * math.sin(phase)) > 1e-6 * abs(volt):
                raise LatticeError(
                    f"{fields.named} of frequency 0 changes the energy in every turn"
                )
            volt = 0.0
        values = {"l": weight * _way_of(fields), "volt": 1e-6 * weight * volt,
                  "freq": 1e-6 * frequency}  # fmt: skip
        return [Part(name, "rfcavity", values, where)]

    def _crab(self, fields: _Fields, name: str, where: str, weight: float = 1.0) -> list[Part]:
        self._alignment(fields)
        volt = fields.number("crab_voltage")
        phase = fields.number("phase") + math.radians(fields.number("lag"))
        fields.used.add("frequency")
        if volt and abs(math.sin(phase)) > 1e-6:
            raise LatticeError(f"{fields.named} kicks the closed orbit, as its phase is not 0")
        values = {"l": weight * _way_of(fields), "volt": 1e-6 * volt}
        return [Part(name, "crabcavity", values, where)]

    def _solenoid(self, fields: _Fields, name: str, where: str, weight: float = 1.0) -> list[Part]:
        fields.used |= {"edge_entry_active", "edge_exit_active"}  # the canonical map is the same
        length = weight * _way_of(fields)
        moved = self._alignment(fields)
        for key in ("x0", "y0", "mult_rot_x_rad", "mult_rot_y_rad", "mult_shift_x", "mult_shift_y"):
            moved[key] = fields.number(key)
        knl, ksl = fields.list("knl"), fields.list("ksl")
        moved.pop("tilt"), moved.pop("dpsi")  # a solenoid is round
        if any(moved.values()) or knl.any() or ksl.any():
            raise LatticeError(
                f"{fields.named} is displaced or has other fields (knl, ksl), which is not "
                "modelled; set them to 0"
            )
        if fields.cls == "VariableSolenoid":  # the mean in the body, as in Xsuite
            own = {"ks": float(fields.list("ks_profile", 2)[:2].mean())}
        else:
            own = {"ks": fields.number("ks"), "ksi": fields.number("ksi")}
        return [Part(name, "solenoid", {"l": length, **own}, where)]

    def _dipole_edge(self, fields: _Fields, name: str, where: str) -> list[Part]:
        fields.used.add("side")
        old = fields.number("r21"), fields.number("r43")
        tilt = self._alignment(fields).pop("tilt")
        if any(fields.acts(key) for key in ("shift_x", "shift_y")):
            raise LatticeError(f"{fields.named} is displaced, which is not modelled; set it to 0")
        k = fields.number("k") or fields.number("h")
        fields.used.add("h")
        if fields.word("model", "linear", EDGES) == "suppressed":
            return [_passive(name, 0.0)]
        edge = (k, fields.number("e1"), fields.number("e1_fd"), fields.number("hgap"),
                fields.number("fint"))  # fmt: skip
        return _edge(name, where, edge, tilt, None if k else old)

    def _map(self, fields: _Fields, name: str, where: str) -> list[Part]:
        self._alignment(fields)
        if fields.cls == "FirstOrderTaylorMap":
            m, b = fields.list("m1"), fields.list("m0", 6)
        else:
            m, b = fields.list("R"), fields.list("k", 6)
            if fields.list("T").any():
                self.report.left_out("the second order", name)
        matrix = np.eye(6) if not len(m) else np.reshape(m, (6, 6))
        # zeta = -beta0 tau, delta = p / beta0
        turn = np.diag([1.0, 1.0, 1.0, 1.0, -1 / self.beta, self.beta])
        values = {"l": _way_of(fields), "rmat": turn @ matrix @ np.linalg.inv(turn), "b": turn @ b}
        return [Part(name, "matrix", values, where)]

    def _rotation(self, fields: _Fields, name: str, where: str) -> list[Part]:
        if fields.cls == "SRotation":
            angle = math.radians(fields.number("angle"))
            cos, sin = fields.number("cos_z", math.cos(angle)), fields.number("sin_z", 0.0)
            if sin and not angle:
                angle = math.atan2(sin, cos)
        else:
            fields.used.add("seq")
            angle = fields.number("rot_s_rad")
            if fields.number("rot_x_rad") or fields.number("rot_y_rad"):
                raise _not_modelled(fields)
        return [Part(name, "srotation", {"angle": angle}, where)]

    def _shift(self, fields: _Fields, name: str, where: str) -> list[Part]:
        if fields.cls == "XYShift":
            x, y = fields.number("dx"), fields.number("dy")
        else:
            x, y = fields.number("shift_x"), fields.number("shift_y")
            if fields.number("shift_s"):
                raise _not_modelled(fields)
        values = {"rmat": np.eye(6), "b": np.array([-x, 0.0, -y, 0.0, 0.0, 0.0])}
        return [Part(name, "matrix", values, where)]


class _Bend:
    """A bend's geometry, field and faces."""

    def __init__(self, fields: _Fields, reader: _Reader) -> None:
        self.fields, self.reader = fields, reader
        self.length = _way_of(fields)
        self.angle = fields.number("angle")
        if "h" in fields.values:
            bent = fields.number("h") * self.length
            if "angle" not in fields.values:
                self.angle = bent
            elif fields.cls != "RBend" and not math.isclose(bent, self.angle, abs_tol=1e-6):
                raise LatticeError(
                    f"{fields.named} has the angle {self.angle:.6g} rad, and {bent:.6g} rad by its "
                    "h and length; leave one out"
                )
        self.curvature = self.angle / self.length if self.length else 0.0
        fields.used |= {"length_straight", "rbend_angle_diff", "length"}
        stated, from_h = fields.values.get("k0"), fields.values.get("k0_from_h")
        fields.used.add("k0")
        if stated == "from_h" or from_h or (stated is None and from_h is None):
            self.dipole = 0.0 if fields.cls == "Magnet" and from_h is False else self.curvature
        else:
            self.dipole = fields.number("k0")
        for side in SIDES:
            fields.used |= {f"edge_{side}_{key}" for key in (
                "active", "model", "angle", "angle_fdown", "hgap", "fint")}  # fmt: skip
        if self.length == 0 and (self.angle or self.dipole):
            raise LatticeError(f"{fields.named} has no length; give it as a Multipole")

    def face(self, side: int) -> float:
        """The whole angle of the entrance's (0) or the exit's (1) face against the sector, rad."""
        angle = self.fields.number(f"edge_{SIDES[side]}_angle")
        if self.fields.cls == "RBend":
            difference = self.fields.number("rbend_angle_diff") / 2
            angle += self.angle / 2 + (difference if side else -difference)
        return angle

    def fringe(self, side: int) -> tuple[float, float, float]:
        """Feed-down angle (rad), half gap (m) and fringe integral of a face."""
        key = f"edge_{SIDES[side]}"
        number = self.fields.number
        linear = self.fields.word(f"{key}_model", "linear", EDGES) == "linear"
        down = number(f"{key}_angle_fdown") if linear else 0.0
        return down, number(f"{key}_hgap"), number(f"{key}_fint")

    def active(self, side: int) -> bool:
        """Whether a face acts."""
        key = f"edge_{SIDES[side]}"
        model = self.fields.word(f"{key}_model", "linear", EDGES)
        return bool(self.fields.number(f"{key}_active", 1.0)) and model != "suppressed"

    def edge(self, side: int, name: str, where: str) -> list[Part]:
        """What a face is where it is an element of its own."""
        tilt = self.reader._alignment(self.fields)["tilt"]
        knl, _ = self.reader._strengths(self.fields, self.length, self.dipole)
        field = float(knl[0]) / self.length if self.length and self.active(side) else 0.0
        return _edge(name, where, (field, self.face(side), *self.fringe(side)), tilt)

    def body(self, name: str, where: str, weight: float = 1.0) -> Part:
        """The bend between its faces, or a slice of it."""
        knl, ksl = self.reader._strengths(self.fields, self.length, self.dipole)
        knl[0] -= self.angle
        if abs(knl[0]) < ROUNDING * abs(self.angle):
            knl[0] = 0.0
        self._check_body(knl, ksl)
        values = {"l": weight * self.length, "angle": weight * self.angle, "knl": weight * knl,
                  "ksl": weight * ksl}  # fmt: skip
        return Part(name, "sbend", {**values, **self.reader._alignment(self.fields)}, where)

    def _check_body(self, knl: Array, ksl: Array) -> None:
        body = self.fields.word("rbend_model", "adaptive", {2: "straight-body"})
        turned = any(
            self.active(side) and self.fields.number(f"edge_{key}_angle")
            for side, key in enumerate(SIDES)
        )
        if body == "straight-body" and (knl[1:].any() or ksl[1:].any() or turned):
            raise LatticeError(
                f"{self.fields.named} has a straight body with a gradient or with angles of its "
                "faces, which is not modelled; give it the rbend_model curved-body"
            )

    def whole(self, name: str, where: str) -> list[Part]:
        """The bend with its faces; as elements of their own where a sector bend has no such."""
        body = self.body(name, where)
        faces = [self.face(side) if self.active(side) else 0.0 for side in (0, 1)]
        (down, gap, first), (down2, gap2, last) = (
            self.fringe(side) if self.active(side) else (0.0, 0.0, 0.0) for side in (0, 1)
        )
        focusing = any(faces) or first * gap or last * gap2 or down or down2
        if focusing and not self.curvature and self.dipole:
            entry, exit_ = (self.edge(k, f"{name}_{s}", where) for k, s in enumerate(SIDES))
            return [*entry, body, *exit_]
        if self.curvature and (down or down2):
            first = fringe_of(self.curvature, faces[0], gap, first, down)
            last = fringe_of(self.curvature, faces[1], gap2, last, down2)
            gap = gap2 = math.copysign(1.0, last)  # MAD-X takes a negative FINTX for none
            first, last = first * gap, last * gap
        if gap2 != gap:
            gap, first, last = 1.0, first * gap, last * gap2
        edges = {"e1": faces[0], "e2": faces[1], "hgap": gap, "fint": first, "fintx": last}
        return [Part(name, "sbend", {**body.values, **edges}, where)]


def _not_modelled(fields: _Fields) -> LatticeError:
    return LatticeError(
        f"{fields.named} acts on the beam and is not modelled; set its strength to 0 or take it out"
    )


def _passive(name: str, length: float) -> Part:
    return Part(name, "drift" if length else "marker", {"l": length})


def _coarse(k1: float, length: float, slices: int) -> bool:
    """Whether seven kicks in each slice of a magnet focus otherwise than its gradient (1/m2)."""
    step = length / max(1, slices)
    return YOSHIDA * abs(k1 * step**2) ** 3 * abs(k1) * length > LUMPED


def _anchor(anchor: str) -> float:
    """Share of its length at which an element has its anchor."""
    shares = {"start": 0.0, "center": 0.5, "centre": 0.5, "end": 1.0}
    if anchor not in shares:
        raise LatticeError(f"the anchor '{plain(str(anchor), 40)}' is not start, center or end")
    return shares[anchor]


def _way_of(fields: _Fields) -> float:
    """An element's length along the beam, m; that of a thin multipole is no way."""
    if fields.cls in ("Multipole", "SimpleThinBend") and not fields.acts("isthick"):
        fields.used.add("length")
        return 0.0
    if fields.cls in ("ElectronCooler", "Elens", "Wire", "LongitudinalLimitRect"):
        return fields.number("length") if fields.cls == "ElectronCooler" else 0.0
    if fields.cls == "RBend" and "length_straight" in fields.values:
        straight, angle = fields.number("length_straight"), fields.number("angle")
        half, difference = angle / 2, fields.number("rbend_angle_diff") / 2
        if abs(angle) < 1e-10 or not straight:
            return straight
        arc = angle * straight / (math.sin(half - difference) + math.sin(half + difference))
        if "length" in fields.values and abs(fields.number("length") - arc) > 1e-6:
            raise LatticeError(
                f"{fields.named} has the length {fields.number('length'):.6g} m, and {arc:.6g} m "
                "by its length_straight and angle; leave one out"
            )
        return arc
    length = fields.number("length")
    for key in ("active_length", "inactive_front", "inactive_back"):
        length += fields.number(key) if key in fields.values else 0.0
    return length


def _edge(
    name: str, where: str, edge: tuple[float, ...], tilt: float, focus: Any = None
) -> list[Part]:
    """A face of a bend: field (1/m), angle, feed-down angle (rad), half gap (m), integral; of early
    files its `focus` alone: R21 and R43, 1/m."""
    field, e1, down, gap, integral = edge
    if not down and not focus:
        values: dict[str, Any] = {"h": field, "e1": e1, "hgap": gap, "fint": integral}
        return [Part(name, "dipedge", {**values, "tilt": tilt}, where)]
    matrix = np.eye(6)
    matrix[1, 0], matrix[3, 2] = focus or edge_focusing(field, e1, gap, integral, down)
    return [Part(name, "matrix", {"rmat": matrix, "tilt": tilt}, where)]


def _kicks(whole: Part, knl: Array, ksl: Array, count: int, teapot: bool, k1: float) -> list[Part]:
    """A straight magnet as `count` thin kicks between ways, or between quadrupoles of `k1`."""
    length = whole.number("l")
    end = middle = length / count
    end /= 2
    if teapot and count > 1:
        end, middle = length / (2 * (count + 1)), length * count / (count**2 - 1)
    moved = {k: whole.number(k) for k in ("dx", "dy", "dpsi", "tilt")}
    if whole.number("ds"):
        raise LatticeError(f"'{plain(whole.name, 60)}' is displaced along the beam; set it to 0")
    thin = {"knl": knl / count, "ksl": ksl / count, "angle": 0.0, "lrad": length / count, **moved}
    kick = Part(f"{whole.name}_kick" if k1 else whole.name, "multipole", thin, whole.where)
    body: dict[str, Any] = {"k1": k1, **moved} if k1 else {}
    name, keyword = (whole.name, "quadrupole") if k1 else (f"{whole.name}_way", "drift")
    ends, way = (Part(name, keyword, {"l": own, **body}, whole.where) for own in (end, middle))
    return [ends, kick, *[way, kick] * (count - 1), ends]
