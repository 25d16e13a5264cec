"""Reading elegant's lattices (`.lte`): RPN definitions, elements and lines.

Every class and every attribute is in one of three lists: modelled; without effect on the static
optics; or neither, and then the file is refused by its name. A class may be shortened or lengthened
as in elegant (QUADRUPOLE, CSBEN), and an element may be defined by another one.

Nothing of a file is run: RPN is worked out by `_Rpn`, which knows numbers, names and functions.
"""

import math
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError, plain
from tmlattice.input_files import content_of, decoded
from tmlattice.lattice.lines import DEEPEST, Items, chosen, inner_names, items_of, laid_out
from tmlattice.lattice.madx_language import LONGEST_STATEMENT, split
from tmlattice.lattice.parts import Part, Report, ring_of_parts
from tmlattice.lattice.ring import ELECTRON_GEV, LIGHT, Ring

MOST_FILES = 1000
MOST_BYTES = 200_000_000
MOST_WORK = 2_000_000
"""Words of RPN, and elements of lines."""

_CODE = re.compile(r'(?:[^!"]++|"[^"]*+"?+)*+')
"""A line up to a `!` outside quotation marks."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")

_DRIFTS = ("DRIF", "EDRIFT", "CSRDRIFT", "LSCDRIFT")
_SILENT = (
    "MARK", "WATCH", "MAXAMP", "RCOL", "ECOL", "SCRAPER", "APCONTOUR", "TAPERAPC", "TAPERAPE",
    "TAPERAPR", "SPEEDBUMP", "PEPPOT", "CHARGE", "PFILTER", "HISTOGRAM", "MHISTOGRAM", "SLICE",
    "CLEAN", "SAMPLE", "TRCOUNT", "RECIRC", "FLOOR", "REMCOR", "RIMULT", "POLAR", "TFBPICKUP",
    "CPICKUP",
)  # fmt: skip
"""Apertures, collimators, and what looks at the beam."""
_COLLECTIVE = (
    "WAKE", "TRWAKE", "CWAKE", "LRWAKE", "ZLONGIT", "ZTRANSVERSE", "IMPEDANCE", "RFMODE", "FRFMODE",
    "TRFMODE", "FTRFMODE", "CORGPIPE", "CORGPLATES", "IONEFFECTS", "SCMULT", "IBSCATTER",
    "TSCATTER", "SCATTER", "DSCATTER", "MATTER", "SREFFECTS", "TFBDRIVER", "CKICKER", "EMITTANCE",
    "TWISS", "CENTER", "BUMPER", "MBUMPER", "RFDF", "MRFDF", "SHRFDF", "RFTM110",
)  # fmt: skip
"""What acts with the beam's current, by chance, or in time: drifts in the static optics, named in a
warning."""
_REFUSED = (
    "ELSE", "MATR", "ALPH", "RFTMEZ0", "RMDF", "TMCF", "CEPL", "TWPL", "TWLA", "TWMTA", "KPOLY",
    "NISEPT", "RAMPP", "BMAPXY", "FMULT", "TUBEND", "MAPSOLENOID", "REFLECT", "SCRIPT", "LTHINLENS",
    "LMIRROR", "LSRMDLTR", "POLYSERIES", "CWIGGLER", "ILMATRIX", "UKICKMAP", "FTABLE", "GFWIGGLER",
    "BMXYZ", "BRAT", "BGGEXP", "BRANCH", "HKPOLY", "BOFFAXE", "GKICKMAP", "BEAMBEAM", "LGBEND",
    "BEDGE",
)  # fmt: skip
"""What acts on the beam by a file, a field map or a program, and is not modelled."""
_INERT: dict[str, dict[str, float]] = {
    "ENERGY": {"CENTRAL_ENERGY": 0, "CENTRAL_MOMENTUM": 0, "MATCH_BEAMLINE": 0,
               "MATCH_PARTICLES": 0},
    "MALIGN": {"DXP": 0, "DYP": 0, "DX": 0, "DY": 0, "DZ": 0, "DT": 0, "DP": 0, "DE": 0},
    "MAGNIFY": {"MX": 1, "MXP": 1, "MY": 1, "MYP": 1, "MS": 1, "MDP": 1},
    "STRAY": {"LBX": 0, "LBY": 0, "GBX": 0, "GBY": 0, "GBZ": 0},
}  # fmt: skip
"""What changes the beam unless these attributes have these values."""

_MOVED = ("DX", "DY", "DZ", "TILT")
_STEERED = ("HKICK", "VKICK", "HCALIBRATION", "VCALIBRATION")
_MONITORS, _CAVITIES = ("MONI", "HMON", "VMON"), ("RFCA", "RFCW", "MODRF", "RAMPRF")
_BENDS = ("SBEN", "RBEN", "CSBEND", "CSRCSBEND", "KSBEND", "NIBEND", "CCBEND")
_OWN: dict[tuple[str, ...], tuple[str, tuple[str, ...]]] = {
    ("QUAD", "KQUAD"): ("quadrupole", ("L", "K1", "FSE", "BORE", "B", *_MOVED, *_STEERED)),
    ("QUFRINGE",): ("quadrupole", ("L", "K1", "FSE", "DIRECTION", *_MOVED)),
    ("DQCOR",): ("quadrupole", ("L", "K1", "J1", "FSE", *_MOVED, *_STEERED)),
    ("SEXT", "KSEXT"): (
        "sextupole", ("L", "K1", "K2", "J1", "FSE", "BORE", "B", *_MOVED, *_STEERED),
    ),
    ("KQUSE",): ("sextupole", ("L", "K1", "K2", "FSE1", "FSE2", *_MOVED)),
    ("OCTU", "KOCT"): ("octupole", ("L", "K3", "FSE", "BORE", "B", *_MOVED)),
    ("MULT",): ("multipole", ("L", "KNL", "ORDER", "FACTOR", "BORE", "BTIPL", *_MOVED)),
    _BENDS: ("bend", (
        "L", "ANGLE", "K1", "K2", "E1", "E2", "H1", "H2", "HGAP", "FINT", "FINT1", "FINT2", "FSE",
        "FSE_DIPOLE", "FSE_QUADRUPOLE", "ETILT", "ETILT_SIGN", "EDGE1_EFFECTS", "EDGE2_EFFECTS",
        "USE_BN", "B1", "B2", "XKICK", "YKICK", "YAW", *_MOVED,
    )),
    ("HKICK", "VKICK", "EHKICK", "EVKICK"): ("corrector", ("L", "KICK", "TILT", "CALIBRATION")),
    ("KICKER", "EKICKER"): ("corrector", ("L", "TILT", *_STEERED)),
    _MONITORS: ("monitor", ("L",)),
    _CAVITIES: ("cavity", ("L", "VOLT", "FREQ", "CHANGE_P0")),
    ("SOLE",): ("solenoid", ("L", "KS", "B", "DX", "DY", "DZ")),
    ("EMATRIX",): ("matrix", (
        "L", "TILT", "DX", "DY", "DZ", "DELTAP", *(f"C{i}" for i in range(1, 7)),
        *(f"R{i}{j}" for i in range(1, 7) for j in range(1, 7)),
    )),
    ("ROTATE",): ("rotation", ("TILT", "EXCLUDE_OPTICS")),
    ("WIGGLER",): ("wiggler", ("L", "RADIUS", "K", "B", "POLES", *_MOVED)),
    (*_DRIFTS, *_SILENT, *_COLLECTIVE): ("drift", ("L",)),
}  # fmt: skip
"""What converts the elements of some classes, and the attributes that it has."""
_FAMILY = {cls: family for classes, (family, _) in _OWN.items() for cls in classes}
MODELLED: dict[str, frozenset[str]] = {
    cls: frozenset(own) for classes, (_, own) in _OWN.items() for cls in classes
} | {cls: frozenset({"L", "ON_PASS", *values}) for cls, values in _INERT.items()}
"""Attributes that the model has, by class."""
ALL_CLASSES = (*MODELLED, *_REFUSED)

NO_EFFECT = frozenset({
    "GROUP", "N_KICKS", "N_SLICES", "NSLICES", "INTEGRATION_ORDER", "ORDER", "MATRIX_ORDER",
    "SQRT_ORDER", "SYNCH_RAD", "ISR", "ISR1PART", "USE_RAD_DIST", "ADD_OPENING_ANGLE", "NONLINEAR",
    "EXPAND_HAMILTONIAN", "EXPANSION_ORDER", "TRACKING_MATRIX", "SR_IN_ORDINARY_MATRIX",
    "REFERENCE_CORRECTION", "HSTEERING", "VSTEERING", "STEERING", "XSTEERING", "YSTEERING",
    "EDGE_ORDER", "EDGE_EFFECTS", "TRANSPORT", "METHOD", "MODEL", "ACCURACY", "PARAXIAL", "LERAD",
    "MALIGN_METHOD", "FSE_CORRECTION", "EDGE1_KICK_LIMIT", "EDGE2_KICK_LIMIT", "KICK_LIMIT_SCALING",
    "PHOTON_OUTPUT_FILE", "PHOTON_LOW_ENERGY_CUTOFF", "FRINGE_TYPE", "FRINGE", "FRINGEMODEL",
    "MIN_NORMAL_ORDER", "MIN_SKEW_ORDER", "MAX_NORMAL_ORDER", "MAX_SKEW_ORDER", "LINEARIZE",
    "EDGE1_LINEAR", "EDGE2_LINEAR", "EDGE1_NONLINEAR_FACTOR", "EDGE2_NONLINEAR_FACTOR",
    "STEERING_MULTIPOLES", "STEERING_MULTIPOLE_FACTOR", "SYSTEMATIC_MULTIPOLE_FACTOR",
    "RANDOM_MULTIPOLE_FACTOR", "OPTIMIZE_FSE", "OPTIMIZE_FSE_ONCE", "OPTIMIZE_DX",
    "OPTIMIZE_DX_ONCE", "COMPENSATE_KN", "VERBOSE", "XREFERENCE", "FP1", "FP2", "FP3", "FP4",
    "ADJUST_BOUNDARY", "ADJUST_FIELD", "FUDGE_PATH_LENGTH", "FRINGE_POSITION", "FITPOINT",
    "OPEN_SIDE", "X_MAX", "Y_MAX", "LIGHT_THROUGH",
})  # fmt: skip
"""Attributes without effect on the optics, of any class: of integrators, radiation, output."""
NONLINEAR = frozenset({
    "K4", "K5", "K6", "K7", "K8", "B3", "B4", "B5", "B6", "B7", "B8", "SYSTEMATIC_MULTIPOLES",
    "EDGE_MULTIPOLES", "EDGE1_MULTIPOLES", "EDGE2_MULTIPOLES", "RANDOM_MULTIPOLES",
})  # fmt: skip
"""Attributes that act beyond the linear optics: named in a warning."""
_DEFAULTS = {"CALIBRATION": 1.0, "HCALIBRATION": 1.0, "VCALIBRATION": 1.0, "FINT": 0.5,
             "FINT1": -1.0, "FINT2": -1.0, "FACTOR": 1.0, "EDGE1_EFFECTS": 1.0,
             "EDGE2_EFFECTS": 1.0, "ETILT_SIGN": 1.0, "FREQ": 500e6,
             "LEFFECTIVE": -1.0, "DIRECTION": 1.0, "XCALIBRATION": 1.0,
             "YCALIBRATION": 1.0}  # fmt: skip


def read_elegant(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of an elegant lattice.

    Args:
        path: `.lte`; files that it includes are read too.
        name: of the ring.
        sequence: of the file's lines; else the one that USE names; else `ring`, else the only one
            that stands in no other.
        energy: of the electrons, GeV; elegant's lattices state none.

    Raises:
        LatticeError: a statement, a class or an attribute that is not understood or not modelled;
            no line, several without a choice, or no energy.

    Warns:
        Of what the model lacks.
    """
    reader = _Reader()
    try:
        reader.read(path, path.parent)
    except LatticeError as error:
        raise LatticeError(f"'{path}' cannot be read as elegant's lattice: {error}") from error
    inside = [name for items in reader.lines.values() for name in inner_names(items)]
    use = chosen(path, list(reader.lines), sequence, reader.used or "", inside)
    if energy is None:
        raise LatticeError(f"'{path}' has no beam energy; give energy= (GeV)")
    try:
        parts = reader.parts(use, energy)
        return ring_of_parts(parts, name, energy, charge=-1.0, report=reader.report)
    except LatticeError as error:
        raise LatticeError(f"'{path}' cannot be read as elegant's lattice: {error}") from error


# --- RPN ------------------------------------------------------------------------------------------
_OF_ONE: dict[str, Callable[..., Any]] = {
    "sqr": lambda a: a * a,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "ln": math.log,
    "log": math.log10,
    "abs": abs,
    "int": math.trunc,
    "floor": math.floor,
    "ceil": math.ceil,
    "chs": lambda a: -a,
    "rec": lambda a: 1 / a,
    "erf": math.erf,
    "erfc": math.erfc,
    "lngam": math.lgamma,
    "dtor": math.radians,
    "rtod": math.degrees,
    "beta.p": lambda p: p / math.hypot(1, p),
    "gamma.p": lambda p: math.hypot(1, p),
    "p.gamma": lambda g: math.sqrt(g * g - 1),
    "gamma.beta": lambda b: 1 / math.sqrt(1 - b * b),
    "dsin": lambda a: math.sin(math.radians(a)),
    "dcos": lambda a: math.cos(math.radians(a)),
    "dtan": lambda a: math.tan(math.radians(a)),
    "dasin": lambda a: math.degrees(math.asin(a)),
    "dacos": lambda a: math.degrees(math.acos(a)),
    "datan": lambda a: math.degrees(math.atan(a)),
    **{n: getattr(math, n) for n in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh",
                                     "cosh", "tanh", "asinh", "acosh", "atanh")},
    "=": lambda a: (a, a),
    "dup": lambda a: (a, a),
    "pop": lambda a: (),
}  # fmt: skip
_OF_TWO: dict[str, Callable[..., Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "pow": math.pow,
    "mod": math.fmod,
    "atan2": lambda a, b: math.atan2(b, a),
    "hypot": math.hypot,
    "max2": max,
    "min2": min,
    "swap": lambda a, b: (b, a),
    "over": lambda a, b: (a, b, a),
}
"""What an operator leaves on the stack of the number, or the two, that it takes from there: a
number, or several of which the last is on top."""
_CONSTANTS = {"pi": math.pi, "log_10": math.log(10), "HUGE": 1e308, "on_div_by_zero": 0.0,
              "c_mks": LIGHT, "c_cgs": 100 * LIGHT, "e_mks": 1.602176634e-19,
              "me_mks": 9.1093837015e-31, "me_cgs": 9.1093837015e-28, "mev": 0.51099895,
              "re_mks": 2.8179403262e-15, "re_cgs": 2.8179403262e-13, "kb_mks": 1.380649e-23,
              "hbar_mks": 1.054571817e-34, "mu_o": 4e-7 * math.pi,
              "eps_o": 8.8541878128e-12}  # fmt: skip


class _Rpn:
    """Values of expressions in reverse Polish notation, with the names that a file stores."""

    def __init__(self) -> None:
        self.memory = dict(_CONSTANTS)
        self._work = 0

    def work(self, steps: int = 1) -> None:
        """Count work that a file asks for."""
        self._work += steps
        if self._work > MOST_WORK:
            raise LatticeError("the file asks for more work than any ring; write the ring out")

    def value(self, text: str) -> float | None:
        """The number on top of the stack in the end; None of an empty one."""
        stack: list[float] = []
        words = iter(text.split())
        for word in words:
            self.work()
            if len(stack) > 10_000:
                raise LatticeError("an expression keeps too many numbers")
            if word == "sto":
                name = next(words, None)
                if name is None or not stack:
                    raise LatticeError("STO stores no number")
                self.memory[name] = stack[-1]
            elif _NUMBER.fullmatch(word):
                stack.append(float(word))
            elif word in self.memory:
                stack.append(self.memory[word])
            elif word.lower() in _OF_ONE or word.lower() in _OF_TWO:
                self._operate(word.lower(), stack)
            else:
                stack.append(self._named(word))
        return stack[-1] if stack else None

    def _operate(self, word: str, stack: list[float]) -> None:
        count, operate = (1, _OF_ONE[word]) if word in _OF_ONE else (2, _OF_TWO[word])
        if len(stack) < count:
            raise LatticeError(f"'{word}' needs {count} numbers before it")
        taken = stack[-count:]
        del stack[-count:]
        try:
            made = operate(*taken)
            stack.extend(map(float, made if isinstance(made, tuple) else (made,)))
        except (ArithmeticError, ValueError) as error:
            numbers = " ".join(f"{n:g}" for n in taken)
            raise LatticeError(f"'{numbers} {word}' has no value") from error

    def _named(self, word: str) -> float:
        self.work(len(self.memory) // 10)
        for name, value in self.memory.items():  # outside quotation marks elegant has capitals
            if name.casefold() == word.casefold():
                return value
        raise LatticeError(f"'{plain(word, 40)}' is no number, stored name or known operator")


# --- statements -----------------------------------------------------------------------------------
@dataclass
class _Element:
    """An element: its class, and its attributes as numbers, or as texts that are none."""

    name: str
    cls: str
    values: dict[str, float | str]
    where: str

    @property
    def named(self) -> str:
        """For messages."""
        return f"{self.cls} '{plain(self.name, 60)}'"

    def part(self, keyword: str, **values: Any) -> Part:
        """The element in MAD-X's words, with its own length where none is stated."""
        values = {"l": self.number("L"), **values}
        return Part(self.name.lower(), keyword, values, self.where)

    def numbers(self, **keys: str) -> dict[str, float]:
        """Attributes by MAD-X's names."""
        return {name: self.number(key) for name, key in keys.items()}

    def moved(self) -> dict[str, float]:
        """Misalignments and tilt."""
        return self.numbers(dx="DX", dy="DY", ds="DZ", tilt="TILT")

    def kicks(self) -> tuple[float, float]:
        """Of both planes, rad."""
        h, v = (self.number(f"{p}KICK") * self.number(f"{p}CALIBRATION") for p in "HV")
        return h, v

    def number(self, key: str) -> float:
        """An attribute's value, else elegant's default."""
        value = self.values.get(key, _DEFAULTS.get(key, 0.0))
        if isinstance(value, str):
            raise LatticeError(f"{key} of '{plain(self.name, 60)}' is '{plain(value, 40)}'")
        return value


class _Reader:
    """What the statements of a file define."""

    def __init__(self) -> None:
        self.rpn = _Rpn()
        self.elements: dict[str, _Element] = {}
        self.lines: dict[str, Items] = {}
        self.used: str | None = None
        self.report = Report()
        self._folded: dict[str, str] = {}
        self._files = 0
        self._rigidity = 0.0
        self._slip = 0.0

    def read(self, path: Path, folder: Path, depth: int = 0) -> None:
        """Carry out the statements of a file; what it includes is looked for in a folder too."""
        self._files += 1
        if not path.is_file():
            path = folder / path.name if (folder / path.name).is_file() else path
        if not path.is_file():
            raise LatticeError(f"it includes '{path}', which is no file")
        if self._files > MOST_FILES or depth > DEEPEST or path.stat().st_size > MOST_BYTES:
            raise LatticeError(f"it includes '{path}': too many files, or too large ones")
        text = decoded(content_of(path, LatticeError))
        lines = text.lstrip("\ufeff").splitlines()
        for text, number, after in _statements(lines):
            self.rpn.work(10)
            where = f"line {number} of {plain(path.name, 60)}"
            try:
                included = re.match(r"#include\s*:\s*(.*)", text, re.IGNORECASE)
                if included:
                    name = included[1].strip().strip("\"'")
                    self.read(path.parent / name, folder, depth + 1)
                elif self._carry_out(text, where, after):
                    return
            except LatticeError as error:
                if "in the statement" in str(error):
                    raise
                raise LatticeError(
                    f"{error} (in the statement '{plain(text, 100)}', {where})"
                ) from error

    def _carry_out(self, text: str, where: str, after: Iterator[tuple[int, str]]) -> bool:
        """Carry out a statement; whether it ends the file."""
        if text[0] == "%":
            self.rpn.value(text[1:])
            return False
        match = re.match(r'(?:"([^"]*)"|([^\s:,="]+))\s*([:,]|$)\s*', text)
        if match is None:
            raise LatticeError("this is no statement of elegant")
        name, rest = match[1] or match[2], text[match.end() :]
        if match[3] == ":" and (match[1] or match[2].upper() not in ("USE", "TITLE")):
            self._define(name if match[1] else name.upper(), rest, where)
            return False
        word = name.upper()
        if word == "USE":
            self.used = _bare(_split(rest)[0]) if rest else None
            return True
        if word == "RETURN":
            return True
        if word == "TITLE":
            if not rest:
                next(after, None)  # the title is the next line
            return False
        raise LatticeError(f"no statement {plain(word, 40)} is known")

    def _define(self, name: str, rest: str, where: str) -> None:
        line = re.fullmatch(r"line\s*=\s*(.*)", rest, re.IGNORECASE | re.DOTALL)
        if name in self.lines or name in self.elements:
            raise LatticeError(f"'{plain(name, 60)}' is defined twice; give one another name")
        if line:
            self.lines[name] = items_of(line[1], _split, _bare)
            return
        head, *given = _split(rest) or [""]
        parent = self.elements.get(_bare(head))
        if parent and _bare(head) in ALL_CLASSES and (parent.values or parent.cls != _bare(head)):
            raise LatticeError(
                f"'{plain(_bare(head), 60)}' is an element and a class; rename the element"
            )
        seen = set[str]()
        cls = parent.cls if parent else _class_of(head)
        values: dict[str, float | str] = dict(parent.values) if parent else {}
        for item in given:
            key, sign, value = item.partition("=")
            key = _attribute(cls, key.strip().upper())
            if not sign or not value.strip():
                raise LatticeError(f"'{plain(item, 60)}' gives no value")
            if key in seen:
                raise LatticeError(f"{plain(key, 40)} of '{plain(name, 60)}' is stated twice")
            seen.add(key)
            values[key] = self._value(cls, key, value.strip())
        self.elements[name] = _Element(name, cls, values, where)

    def _value(self, cls: str, key: str, text: str) -> float | str:
        """The number that an attribute is; a text of those that are not modelled."""
        quoted = len(text) > 1 and text[0] == text[-1] == '"'
        expression = text[1:-1] if quoted else text
        if not quoted and _NUMBER.fullmatch(text):
            return float(text)
        modelled = key in MODELLED.get(cls, ())
        if not modelled and (key in NO_EFFECT or cls in (*_SILENT, *_COLLECTIVE, *_REFUSED)):
            return expression
        if not quoted and text[0] in "+-.0123456789":
            raise LatticeError(
                f"{key} is '{plain(text, 60)}', which is no number; write an expression in RPN, in "
                "quotation marks"
            )
        try:
            value = self.rpn.value(expression)
        except LatticeError:
            if modelled:
                raise
            return expression
        if value is None:
            raise LatticeError(f"{key} is an expression without a value")
        return value

    def _found(self, name: str) -> str:
        """The name as it is defined; outside quotation marks elegant has capitals."""
        if name in self.elements or name in self.lines:
            return name
        if not self._folded:
            self._folded = {known.casefold(): known for known in (*self.elements, *self.lines)}
        if name.casefold() in self._folded:
            return self._folded[name.casefold()]
        raise LatticeError(f"no element or line '{plain(name, 60)}' is defined")

    # --- the ring ---------------------------------------------------------------------------------
    def parts(self, use: str, energy: float) -> list[Part]:
        """The elements of a line in beam order.

        Args:
            use: of the lines.
            energy: of the electrons, GeV.
        """
        momentum = math.sqrt(max(energy**2 - ELECTRON_GEV**2, 0.0))
        self._rigidity = 1e9 * momentum / LIGHT
        self._slip = (ELECTRON_GEV / energy) ** 2
        items = self.lines[use]
        names = laid_out(items, self.lines, self._found)
        self.rpn.work(len(names))
        made: dict[tuple[Any, ...], list[Part]] = {}
        parts: list[Part] = []
        for k, (name, turned) in enumerate(names):
            element = self.elements[name]
            inner = (False, False)
            if element.cls in _BENDS and element.cls != "CCBEND":
                inner = (self._same(names, k, -1), self._same(names, k, 1))
            key = (name, turned, inner)
            if key not in made:
                made[key] = self._converted(element, turned, inner)
            parts += made[key]
        return parts

    def _same(self, names: list[tuple[str, bool]], k: int, step: int) -> bool:
        """Whether the same bend comes before or after, but for markers: elegant takes both for
        pieces of one, without faces in between."""
        j = k + step
        while 0 <= j < len(names) and self.elements[names[j][0]].cls == "MARK":
            j += step
        return 0 <= j < len(names) and names[j][0] == names[k][0]

    def _converted(self, element: _Element, turned: bool, inner: tuple[bool, bool]) -> list[Part]:
        """What one element is in the ring."""
        cls, name = element.cls, element.name.lower()
        named = f"{element.named} ({element.where})"
        if cls in _REFUSED:
            raise LatticeError(
                f"{named} acts on the beam and is not modelled; take it out, or replace it"
            )
        once = element.values.get("ON_PASS", -1.0) != -1.0
        if cls in _INERT and not (once and not element.values.get("FORCE_MODIFY_MATRIX")):
            for key, still in _INERT[cls].items():
                if element.values.get(key, still) != still:
                    raise LatticeError(
                        f"{named} changes the beam by its {key}, which is not modelled; take it out"
                    )
        if cls in _COLLECTIVE:
            self.report.left_out(f"what {cls} does", name)
        if cls in ("DRIF", "EDRIFT"):
            for key in element.values.keys() - NO_EFFECT - {"L"}:
                self.report.left_out(key, name)
        if cls in (*_DRIFTS, *_SILENT, *_COLLECTIVE, *_INERT):
            return [element.part("drift" if element.number("L") else "marker")]
        for key, value in element.values.items():
            if key in MODELLED[cls] or not value or value == _DEFAULTS.get(key):
                continue
            higher = cls == "EMATRIX" and key[0] in "TQU" and key[1:].isdigit()
            bend = key == "K3" and cls in ("CSBEND", "CCBEND", "CSRCSBEND", "KSBEND")
            kick = key == "B2" and _FAMILY[cls] == "corrector"
            if key in NO_EFFECT or cls in _FAMILY_WITHOUT.get(key, ()):
                continue
            if higher or bend or kick or key in NONLINEAR or cls in (*_MONITORS, *_CAVITIES):
                self.report.left_out(key, name)
            else:
                raise LatticeError(
                    f"the attribute {plain(key, 40)} of {named} is not modelled; set it to 0 or "
                    "take it out"
                )
        if _FAMILY[cls] == "bend":
            return [self._as_bend(element, turned, inner)]
        made = getattr(self, f"_as_{_FAMILY[cls]}")(element)
        return made if isinstance(made, list) else [made]

    def _steered(self, element: _Element) -> dict[str, Any]:
        """Kicks of windings for steering, as integrated dipole fields of a magnet."""
        x, y = element.kicks()
        return {"knl": [-x], "ksl": [y]} if x or y else {}

    def _scaled(self, element: _Element, key: str, order: int, field: str = "B") -> float:
        """A strength, by its pole-tip field where the bore is given."""
        bore = element.number("BORE")
        value = element.number(key)
        if bore:
            value = math.factorial(order) * element.number(field) / bore**order / self._rigidity
        return value * (1 + element.number("FSE"))

    def _as_quadrupole(self, element: _Element) -> Part | list[Part]:
        k1 = self._scaled(element, "K1", 1)
        values = {**element.moved(), **self._steered(element)}
        if element.cls == "DQCOR":
            values["k1s"] = element.number("J1") * (1 + element.number("FSE"))
        if element.cls != "QUFRINGE":
            return element.part("quadrupole", k1=k1, **values)
        count = 10
        shares = (np.arange(count) + 0.5) / count
        if element.number("DIRECTION") < 0:
            shares = shares[::-1]
        values["l"] = element.number("L") / count
        return [element.part("quadrupole", k1=k1 * share, **values) for share in shares]

    def _as_sextupole(self, element: _Element) -> Part:
        values = {"k2": self._scaled(element, "K2", 2), **element.numbers(k1="K1", k1s="J1"),
                  **element.moved(), **self._steered(element)}  # fmt: skip
        if element.cls != "KQUSE":
            return element.part("sextupole", **values)
        values["k1"] *= 1 + element.number("FSE1")
        values["k2"] *= 1 + element.number("FSE2")
        return element.part("quadrupole", **values)

    def _as_octupole(self, element: _Element) -> Part:
        return element.part("octupole", k3=self._scaled(element, "K3", 3), **element.moved())

    def _as_multipole(self, element: _Element) -> Part:
        order = int(element.values.get("ORDER", 1.0))
        if not 0 <= order <= 20:
            raise LatticeError(f"{element.named} has the ORDER {order}")
        knl = np.zeros(order + 1)
        knl[order] = self._scaled(element, "KNL", order, "BTIPL") * element.number("FACTOR")
        return element.part("multipole", knl=knl, angle=0.0, **element.moved())

    def _as_bend(self, element: _Element, turned: bool, inner: tuple[bool, bool]) -> Part:
        number = element.number
        length, angle = number("L"), number("ANGLE")
        e1, e2 = number("E1"), number("E2")
        straight = element.cls == "CCBEND" and not {"E1", "E2"} & element.values.keys()
        if element.cls == "RBEN" or straight:  # faces parallel to each other
            e1, e2 = e1 + angle / 2, e2 + angle / 2
        if element.cls == "RBEN" and angle:
            length *= (angle / 2) / math.sin(angle / 2)
        yaw = number("YAW")
        if yaw and element.cls != "CCBEND":
            raise LatticeError(f"YAW of {element.named} is not modelled")
        e1, e2 = e1 - yaw, e2 + yaw
        curvature = angle / length if length else 0.0
        k1, k2 = number("K1"), number("K2")
        if number("USE_BN"):
            k1, k2 = number("B1") * curvature, number("B2") * curvature
        fse = number("FSE")
        k1 *= 1 + fse + number("FSE_QUADRUPOLE")
        k2 *= 1 + fse
        error = angle * (fse + number("FSE_DIPOLE")) - number("XKICK")
        default = number("FINT") if element.cls != "CCBEND" else 0.0
        fint = [default if number(key) < 0 else number(key) for key in ("FINT1", "FINT2")]
        faces = [
            (e1, number("H1"), fint[0], number("EDGE1_EFFECTS")),
            (e2, number("H2"), fint[1], number("EDGE2_EFFECTS")),
        ]
        if turned:
            faces.reverse()
        faces = [
            (0.0, 0.0, 0.0, 0.0) if off or not one[3] else one
            for one, off in zip(faces, inner, strict=True)
        ]
        body: dict[str, Any] = {
            "l": length, "k1": k1, "k2": k2, "knl": [error], "ksl": [number("YKICK")],
            **element.moved(),
        }  # fmt: skip
        if not angle:
            return element.part("quadrupole", **body)
        (e1, h1, first, _), (e2, h2, second, _) = faces
        edges = {"e1": e1, "e2": e2, "h1": h1, "h2": h2, "fint": first, "fintx": second}
        roll = math.copysign(number("ETILT"), number("ETILT") * number("ETILT_SIGN"))
        body |= {**edges, "angle": angle, "hgap": number("HGAP"), "dpsi": roll}
        return element.part("sbend", **body)

    def _as_corrector(self, element: _Element) -> Part:
        number = element.number
        if element.cls in ("KICKER", "EKICKER"):
            x, y = element.kicks()
            return element.part("kicker", hkick=x, vkick=y, tilt=number("TILT"))
        keyword = "hkicker" if "HK" in element.cls else "vkicker"
        kick = number("KICK") * number("CALIBRATION")
        return element.part(keyword, kick=kick, tilt=number("TILT"))

    def _as_monitor(self, element: _Element) -> Part:
        return element.part({"HMON": "hmonitor", "VMON": "vmonitor"}.get(element.cls, "monitor"))

    def _as_cavity(self, element: _Element) -> Part:
        if element.number("CHANGE_P0"):
            raise LatticeError(
                f"{element.named} changes the momentum of the ring (CHANGE_P0); set it to 0"
            )
        volt, freq = 1e-6 * element.number("VOLT"), 1e-6 * element.number("FREQ")
        return element.part("rfcavity", volt=volt, freq=freq)

    def _as_solenoid(self, element: _Element) -> Part:
        ks = -element.number("KS")  # elegant's is -B / (B rho)
        if not ks and element.number("B"):
            ks = element.number("B") / self._rigidity
        return element.part("solenoid", ks=ks, **element.numbers(dx="DX", dy="DY", ds="DZ"))

    def _as_matrix(self, element: _Element) -> Part:
        """elegant's (s, delta) are OCELOT's (beta0 tau, p / beta0), but for the slip of a drift."""
        r = np.array([[element.number(f"R{i}{j}") for j in range(1, 7)] for i in range(1, 7)])
        b = np.array([element.number(f"C{i}") for i in range(1, 7)])
        b[4] = 0.0  # the length
        if element.number("DELTAP"):
            raise LatticeError(f"{element.named} changes the momentum (DELTAP)")
        if abs(np.linalg.det(r[:4, :4])) < 1e-6:
            raise LatticeError(
                f"{element.named} has no inverse: what it does not state is 0, also on the "
                "diagonal; state R11 to R66"
            )
        if r[5, 5] == 0:
            r[4, 4] = r[5, 5] = 1.0
        _not_displaced(element)
        beta = math.sqrt(1 - self._slip)
        turn = np.diag([1.0, 1.0, 1.0, 1.0, 1 / beta, beta])
        rmat = turn @ r @ np.linalg.inv(turn)
        rmat[4, 5] -= element.number("L") * self._slip / (1 - self._slip)
        own = {"b": turn @ b} if b.any() else {}
        return element.part("matrix", rmat=rmat, tilt=element.number("TILT"), **own)

    def _as_rotation(self, element: _Element) -> Part:
        angle = 0.0 if element.number("EXCLUDE_OPTICS") else element.number("TILT")
        return element.part("srotation", angle=angle)

    def _as_wiggler(self, element: _Element) -> Part:
        """A wiggler focuses like half its curvature squared, in the plane of its field."""
        length, radius, poles = (element.number(key) for key in ("L", "RADIUS", "POLES"))
        if not radius and element.number("B"):
            radius = self._rigidity / element.number("B")
        elif not radius and element.number("K") and poles:
            radius = length / poles / (math.pi * element.number("K") * math.sqrt(self._slip))
        r = np.eye(6)
        r[0, 1] = r[2, 3] = length
        r[4, 5] = -length * self._slip / (1 - self._slip)
        if radius:
            focus = 1 / (math.sqrt(2) * abs(radius))
            cos, sin = math.cos(focus * length), math.sin(focus * length)
            r[2:4, 2:4] = [[cos, sin / focus], [-focus * sin, cos]]
        _not_displaced(element)
        made = element.part("matrix", rmat=r, tilt=element.number("TILT"))
        self.report.left_out("what it has beyond its first-order matrix", made.name)
        return made if "wig" in made.name else replace(made, name=f"{made.name}_wiggler")


def _not_displaced(element: _Element) -> None:
    if any(element.number(key) for key in ("DX", "DY", "DZ")):
        raise LatticeError(f"{element.named} is displaced; set DX to 0")


_FAMILY_WITHOUT: dict[str, tuple[str, ...]] = {
    "EDGE1_EFFECTS": ("QUAD", "KQUAD"), "EDGE2_EFFECTS": ("QUAD", "KQUAD"),
    "PITCH": ("QUAD", "KQUAD", "KSEXT", "KOCT"),
    "YAW": ("QUAD", "KQUAD", "KSEXT", "KOCT"), "ANGLE": ("EMATRIX",),
    **dict.fromkeys(("CSR", "BINS", "BIN_SIZE", "BIN_ONCE", "BIN_RANGE_FACTOR", "SG_HALFWIDTH",
                     "SG_ORDER", "SGDERIV_HALFWIDTH", "SGDERIV_ORDER", "TRAPAZOID_INTEGRATION",
                     "OUTPUT_FILE", "OUTPUT_INTERVAL", "OUTPUT_LAST_WAKE_ONLY", "STEADY_STATE",
                     "IGF", "BLOCK_CSR", "DERBENEV_CRITERION_MODE", "PARTICLE_OUTPUT_FILE",
                     "PARTICLE_OUTPUT_INTERVAL", "SLICE_ANALYSIS_INTERVAL", "CLIP_NEGATIVE_BINS",
                     "LOW_FREQUENCY_CUTOFF0", "LOW_FREQUENCY_CUTOFF1", "HIGH_FREQUENCY_CUTOFF0",
                     "HIGH_FREQUENCY_CUTOFF1", "WAKE_FILTER_FILE", "WFF_FREQ_COLUMN",
                     "WFF_REAL_COLUMN", "WFF_IMAG_COLUMN"), ("CSRCSBEND",)),
    **dict.fromkeys(("PERIODS", "ON_PASS", "EXCLUDE_FLOOR"), ("WIGGLER", "ROTATE")),
    **dict.fromkeys(("WEIGHT", "SETPOINT", "XSETPOINT", "YSETPOINT", "CO_FITPOINT", "READOUT",
                     "XREADOUT", "YREADOUT", "STORE_TURN_BY_TURN"), _MONITORS),
    **dict.fromkeys(("PHASE", "Q", "PHASE_REFERENCE", "CHANGE_T", "FIDUCIAL", "T_REFERENCE",
                     "LOCK_PHASE"), _CAVITIES),
}  # fmt: skip
"""Attributes without effect on the optics of some classes: PITCH and YAW are ignored by elegant's
default alignment, and fringes of quadrupoles act by their integrals."""


def _statements(lines: list[str]) -> Iterator[tuple[str, int, Iterator[tuple[int, str]]]]:
    """Each statement without comments, its line, and the lines behind it."""
    source = enumerate(lines, 1)
    text, first, joined = "", 0, 0
    for number, line in source:
        bare = next(_CODE.finditer(line))[0].strip()
        if not bare:
            continue
        first = first if text else number
        joined += 1
        if joined > LONGEST_STATEMENT:
            raise LatticeError(f"line {first}: no end of a statement in {LONGEST_STATEMENT} lines")
        text += bare
        if text.endswith("&"):
            text = text[:-1] + " "
            continue
        if text.strip():
            yield text.strip(), first, source
        text, joined = "", 0
    if text.strip():
        raise LatticeError(f"line {first}: the statement goes on (&) after the end of the file")


def _split(text: str) -> list[str]:
    """Items between commas outside brackets and quotation marks."""
    return [item for item in split(text) if item]


def _bare(text: str) -> str:
    """A name: as it is in quotation marks, else in capitals."""
    text = text.strip()
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text.upper()


def _class_of(word: str) -> str:
    """The class that a word names: it may be shorter or longer than the class's name."""
    word = _bare(word).upper()
    if not word:
        raise LatticeError("no element class is stated")
    if word in ALL_CLASSES:
        return word
    found = [cls for cls in ALL_CLASSES if cls.startswith(word) or word.startswith(cls)]
    longest = [cls for cls in found if word.startswith(cls)]
    if longest:
        found = [max(longest, key=len)]
    if len(found) != 1:
        which = f"may be {', '.join(found[:5])}" if found else "is unknown"
        raise LatticeError(f"the element class '{plain(word, 40)}' {which}")
    return found[0]


def _attribute(cls: str, key: str) -> str:
    """An attribute as elegant spells it: underscores may be missing."""
    known = MODELLED.get(cls, set()) | NO_EFFECT | NONLINEAR | _FAMILY_WITHOUT.keys()
    if key in known:
        return key
    same = [own for own in known if own.replace("_", "") == key.replace("_", "")]
    return same[0] if same else key
