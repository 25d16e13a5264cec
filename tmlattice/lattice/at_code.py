"""AT lattices that are MATLAB code: what `atquadrupole`, `repmat`, `buildlat`, ... give.

Elements are structures as MATLAB's AT makes them: arguments up to a pass method, then fields by
name. `atquadrupole` is of AT 2, `quadrupole` of AT 1 (whose bends have the angles of their faces);
lattices of the Middle Layer have both, and their ring is `THERING`.
"""

import ast
import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError, plain
from tmlattice.lattice.expressions import MOST_ITEMS
from tmlattice.lattice.matlab_code import Code, indices
from tmlattice.lattice.ring import LIGHT

Element = dict[str, Any]

_MAKERS = {
    "atbaselem": "Element", "atsolenoid": "Element Length K", "atskewquad": "Multipole Length Qs",
    "atM66Tijk": "Element M66 Tijk", "atQuantDiff": "QuantumDiffusion Lmatp",
    "atwiggler": "Wiggler Length Lw Bmax Energy", "atSimpleQuantDiff": "SimpleQuantDiff",
    "drift": "Drift Length", "marker": "Marker", "aperture": "Aperture Limits",
    "corrector": "Corrector Length KickAngle", "quadrupole": "Quadrupole Length K",
    "sextupole": "Sextupole Length H", "skewquad": "Multipole Length Qs",
    "rbend": "Bend Length BendingAngle EntranceAngle ExitAngle K",
    "sbend": "Bend Length BendingAngle EntranceAngle ExitAngle K",
    "multipole": "Multipole Length PolynomA PolynomB", "solenoid": "Element Length K",
    "rfcavity": "RFCavity Length Voltage Frequency HarmNumber",
}  # fmt: skip
"""The class and arguments, between name and pass method, that functions of MATLAB have; others of
AT 2 are those of Python's AT."""

_OF_FILE = re.compile(r"\A(function ring = ).*(?=\(\)\r?\n)")
_PYTHON_TEXT = re.compile(r"'(?:[^'\\\n]|\\.)*'|\"(?:[^\"\\\n]|\\.)*\"")
"""Python's AT calls the function as the file, which need not be a name, and has Python's texts."""

_FAMILY = re.compile(r"FAMLIST\{(\w+)\((\w+)\)\}\.ElemData")
_COUNTED = re.compile(r"^[ \t]*FAMLIST\{[^=\n]*=.*", re.MULTILINE)
"""Before AT 1 had BUILDLAT, files took elements from their families, and counted them."""

_SILENT = frozenset((
    "disp", "display", "fprintf", "clear", "clearvars", "clc", "close", "format", "tic", "toc",
    "warning", "evalin", "assignin", "atsummary", "figure", "plot", "hold", "drawnow", "addpath",
))  # fmt: skip
"""Statements that change no element."""

_DEFAULTS = {"Length": 0.0, "BendingAngle": 0.0, "Voltage": 0.0, "Frequency": 1.0,
             "HarmNumber": 1.0, "PolynomA": 0.0, "PolynomB": 0.0, "Periodicity": 1.0}  # fmt: skip


def elements_of(text: str, name: str | None = None, energy: float | None = None) -> list[Element]:
    """The elements of a ring that is MATLAB code.

    Args:
        text: of the file.
        name: the variable that is the ring; None: the function's result, or `THERING` or `RING`,
            or the only one that is a list of elements.
        energy: eV, of cavities without one; None: that of other elements, or `GLOBVAL.E0`.

    Raises:
        LatticeError: the code is not read, makes no single ring, or states no energy.
    """
    if "function v=False()" in text:  # by Python's AT
        text = _PYTHON_TEXT.sub(_matlab_text, _OF_FILE.sub(r"\1lattice", text, count=1))
    text = _COUNTED.sub("", _FAMILY.sub(r"\1{\2}", text))
    variables, result = Code(text, _functions(), _SILENT).run()
    lists = [key for key, value in variables.items() if _is_ring(value)]
    if result in ("", "varargout"):  # a script, or a function that leaves a global variable
        called = [key for key in variables if key.lower() in ("thering", "ring")] or lists
        result = called[0] if len(called) == 1 else ""
    ring: Any = variables.get(name or result)
    if isinstance(ring, ValueError):
        raise LatticeError(str(ring))
    if not _is_ring(ring):
        which = f"'{name or result}' is no list" if name or result else "no variable is the list"
        others = f"; lists are {', '.join(lists)}: name one with sequence=" if lists else ""
        raise LatticeError(f"{plain(which, 100)} of AT's elements{plain(others, 200)}")
    stated = variables.get("GLOBVAL")
    if isinstance(stated, dict) and "E0" in stated and not any("Energy" in e for e in ring):
        ring = [e | {"Energy": stated["E0"]} for e in ring]
    energies = [e["Energy"] for e in ring if "Energy" in e]
    own = energy or next(iter(energies), None)
    if own is None:
        raise LatticeError("its energy is not defined")
    ring = [{"Energy": own} | e if "Frequency" in e else e for e in ring]  # Python's AT needs it
    return [
        {k: np.squeeze(v) if isinstance(v, np.ndarray) else v for k, v in e.items()} for e in ring
    ]


def _matlab_text(match: re.Match[str]) -> str:
    value = str(ast.literal_eval(match[0]))
    return "'" + value.replace("'", "''").replace("\n", " ") + "'"


def _is_ring(value: Any) -> bool:
    own = isinstance(value, list) and len(value) > 0
    return own and all(isinstance(e, dict) and "FamName" in e for e in value)


def _element(function: str, name: Any = "", *given: Any) -> Element:
    """What a function that makes elements gives."""
    from at.load.utils import _CLASS_MAP

    kind, *places = _MAKERS.get(function, function[2:]).split()
    if function not in _MAKERS:
        places = _CLASS_MAP[kind]._BUILD_ATTRIBUTES[1:]
    places = places if "PassMethod" in places else [*places, "PassMethod"]
    may_be_text = ("PassMethod", "Filename_in")
    count = 0
    for value, place in zip(given, places, strict=False):  # up to the name of a field
        if isinstance(value, str) and not value.endswith("Pass") and place not in may_be_text[1:]:
            break
        count += 1
    keys, values = given[count::2], given[count + 1 :: 2]
    if len(keys) != len(values) or not all(isinstance(key, str) for key in keys):
        raise ValueError(f"'{function}' has the arguments {', '.join(places)}, then fields")
    fields = dict(zip(places, given[:count], strict=False)) | dict(zip(keys, values, strict=True))
    empty = [k for k, v in fields.items() if v is None or (k in places and not np.size(v))]
    fields = {k: v for k, v in fields.items() if k not in empty}
    for place in places:
        if isinstance(fields.get(place), str) and place not in may_be_text:
            raise ValueError(f"the {place} of '{plain(str(name), 40)}' is a text")
    missing: Element = {k: v for k, v in _DEFAULTS.items() if k in places}
    if function == "atsolenoid":
        missing["PassMethod"] = "SolenoidLinearPass"
    if function == "atrbend":
        half = fields.get("BendingAngle", 0.0) / 2
        missing |= {"EntranceAngle": half, "ExitAngle": half}
    fields = {"FamName": name, "Class": kind} | missing | fields
    if function == "atbaselem" and {"PolynomA", "PolynomB"} & fields.keys():
        orders = max(np.size(fields.get(f"Polynom{k}", 0.0)) for k in "AB")
        for k in ("PolynomA", "PolynomB"):
            given_orders = np.ravel(fields.get(k, 0.0))
            fields[k] = np.pad(given_orders, (0, orders - len(given_orders)))
        fields = {"MaxOrder": orders - 1.0, "NumIntSteps": 10.0} | fields
    for key, polynom, order in (("K", "B", 1), ("H", "B", 2), ("Qs", "A", 1)):
        if key in places and kind != "Element":
            _strength(fields, key, f"Polynom{polynom}", order)
    return fields


def _strength(fields: Element, key: str, polynom: str, order: int) -> None:
    """An argument is a strength of `PolynomB` (or `A`), as in MATLAB."""
    given = np.ravel(fields.get(polynom, 0.0))
    stated = np.pad(given, (0, max(0, order + 1 - len(given))))
    value = fields.setdefault(key, stated[order])
    if np.ndim(value):
        raise ValueError(f"the {key} of '{plain(str(fields['FamName']), 40)}' is no number")
    if stated[order] and not math.isclose(stated[order], value):
        raise ValueError(
            f"'{plain(str(fields['FamName']), 40)}' has the {key} {value:g} and in {polynom} "
            f"{stated[order]:g}; MATLAB's AT tracks one, Python's the other"
        )
    stated[order] = value
    fields[polynom] = stated
    if key == "Qs":
        del fields[key]
        fields.setdefault("PolynomB", np.zeros(len(stated)))
        fields.setdefault("PassMethod", "StrMPoleSymplectic4Pass")


def _functions() -> dict[str, Callable[..., Any]]:
    from at.load.utils import _CLASS_MAP

    makers = [*_MAKERS, *(f"at{kind}" for kind in _CLASS_MAP if f"at{kind}" not in _MAKERS)]
    numbers = {name: partial(_by_number, getattr(np, name)) for name in (
        "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "log10", "sqrt", "abs", "sign",
        "floor", "ceil", "deg2rad", "rad2deg", "isnan", "arcsin", "arccos", "arctan", "arctan2",
        "mod",
    )}  # fmt: skip
    numbers |= {name.replace("rc", ""): numbers[name] for name in numbers if name[:3] == "arc"}
    constants = {"pi": math.pi, "Inf": math.inf, "inf": math.inf, "NaN": math.nan, "nan": math.nan,
                 "eps": 2.0**-52, "true": True, "false": False, "None": None}  # fmt: skip
    radiation = ("atradon", "atradoff", "atenable_6d", "atdisable_6d")  # none is in the model
    return {
        **{name: partial(_element, name) for name in makers},
        **{name: partial(_constant, value) for name, value in constants.items()},
        **numbers,
        **{name: lambda ring, *_: ring for name in radiation},
        "round": lambda v: math.copysign(math.floor(abs(v) + 0.5), v),
        **{name: partial(_of_vector, getattr(np, name)) for name in ("max", "min", "sum")},
        "zeros": partial(_filled, 0.0), "ones": partial(_filled, 1.0),
        "eye": lambda n: np.diag(_filled(1.0, n)[0]), "diag": lambda v: np.diag(_vector(v)),
        "cell": lambda *n: [np.zeros((0, 0))] * _product(tuple(np.hstack([*map(np.ravel, n)]))),
        "size": _size,
        "length": _length, "isempty": lambda v: _length(v) == 0.0,
        "numel": lambda v: float(len(v) if isinstance(v, list | str) else np.size(v)),
        "ischar": lambda v: isinstance(v, str), "iscell": lambda v: isinstance(v, list),
        "isstruct": lambda v: isinstance(v, dict), "isfield": lambda s, key: key in s,
        "strcmp": lambda a, b: a == b, "strcmpi": lambda a, b: a.lower() == b.lower(),
        "strcat": lambda *v: "".join(v), "num2str": lambda v: f"{v:{'.5g' if v % 1 else '.0f'}}",
        "int2str": lambda v: f"{v:.0f}", "sprintf": _sprintf, "mfilename": lambda: "",
        "struct": _struct, "repmat": _repmat, "vertcat": lambda *v: [e for own in v for e in own],
        **dict.fromkeys(("reverse", "flip", "fliplr", "flipud"), _reverse),
        "horzcat": lambda *v: [e for own in v for e in own], "buildlat": list,
        "findcells": _findcells, "findspos": _findspos, "setcellstruct": _setcellstruct,
        "atsetfieldvalues": _atsetfieldvalues,
        "atSetRingProperties": _properties, "atsetringproperties": _properties,
        "atsetcavity": _atsetcavity,
    }  # fmt: skip


def _constant(value: Any) -> Any:
    return value


def _by_number(function: Any, *given: Any) -> Any:
    value = function(*given)
    return value if np.ndim(value) else value.item()


def _vector(value: Any) -> Any:
    if min(np.atleast_2d(value).shape) > 1:
        raise ValueError("a matrix has no order here")
    _product((float(np.size(value)),))  # as a diagonal
    return np.ravel(value)


def _of_vector(function: Any, *given: Any) -> float:
    """Of a vector, or of numbers."""
    return float(function(_vector(given[0]) if len(given) == 1 else [float(v) for v in given]))


def _product(counts: tuple[float, ...]) -> int:
    number = counts[0] ** (2 if len(counts) == 1 else 1) * math.prod(counts[1:])
    if not 0 <= number <= MOST_ITEMS:
        raise ValueError(f"{number:g} items are more than a ring has")
    return int(number)


def _filled(value: float, *counts: float) -> Any:
    _product(counts)
    return np.full([int(n) for n in (counts * 2)[:2]], value)


def _size(value: Any, *axis: float) -> Any:
    rows, columns = (1, len(value)) if isinstance(value, list | str) else np.atleast_2d(value).shape
    sizes = np.array([[rows, columns]], dtype=float)
    return float(sizes[0, int(axis[0]) - 1]) if axis else sizes


def _length(value: Any) -> float:
    if isinstance(value, list | str):
        return float(len(value))
    return float(max(np.shape(value), default=1)) if np.size(value) else 0.0


def _sprintf(form: str, *given: Any) -> str:
    if re.search(r"%[^%a-z]*(\*|\d{4})", form):
        raise ValueError("the form of sprintf is not read")
    return form % tuple(int(v) if isinstance(v, float) and v == int(v) else v for v in given)


def _struct(*given: Any) -> Element:
    """Values in a cell of one are that item."""
    if any(isinstance(v, list) and len(v) != 1 for v in given[1::2]):
        raise ValueError("an array of structures is not read")
    values = (v[0] if isinstance(v, list) else v for v in given[1::2])
    return dict(zip(given[::2], values, strict=True))


def _repmat(value: Any, *counts: Any) -> Any:
    counts = tuple(float(n) for n in np.ravel(counts))
    times = _product(counts)
    if isinstance(value, list | dict):
        whole = value if isinstance(value, list) else [value]
        _product((float(len(whole)), float(times)))
        return whole * times
    _product((float(np.size(value)), float(times)))
    if isinstance(value, str):
        raise ValueError("texts are not repeated")
    return np.tile(value, [int(n) for n in (counts * 2)[:2]])


def _reverse(value: Any) -> Any:
    return value[::-1] if isinstance(value, list) else np.flip(value)


def _findcells(ring: list[Element], field: str, *values: Any) -> Any:
    """Places of elements, from 1."""
    places = [
        k for k, e in enumerate(ring, 1)
        if field in e and (not values or any(np.array_equal(e[field], v) for v in values))
    ]  # fmt: skip
    return np.array([places], dtype=float)


def _findspos(ring: list[Element], places: Any) -> Any:
    ends = np.cumsum([0.0, *(e.get("Length", 0.0) for e in ring)])
    found = ends[indices(places, len(ring))]
    return found[None] if found.size != 1 else float(found[0])


def _atsetfieldvalues(ring: list[Element], *given: Any) -> list[Element]:
    """All elements where places are not given."""
    *places, field, values = given
    return _setcellstruct(ring, field, places[0] if places else slice(None), values)


def _setcellstruct(
    ring: list[Element], field: str, places: Any, values: Any, row: float = 1, column: float = 0
) -> list[Element]:
    """The ring with a field, or a number of one, of some elements changed."""
    new = list(ring)
    places = indices(places, len(ring))
    several = isinstance(values, float | np.ndarray) and np.size(values) == len(places)
    for k, place in enumerate(places):
        value = np.ravel(values)[k].item() if several else values
        if column:
            value, part = np.ravel(new[place].get(field, 0.0)).astype(float), value
            value = np.pad(value, (0, max(0, int(column) - len(value))))
            value[int(max(row, column)) - 1] = part
        new[place] = new[place] | {field: value}
    return new


def _properties(ring: list[Element], *given: Any) -> list[Element]:
    """The ring with what its first element, of class RingParam, states."""
    kept = {"energy": "Energy", "periodicity": "Periodicity", "particle": "Particle"}
    new = dict(zip(given[::2], given[1::2], strict=True))
    new = {kept[k.lower()]: v for k, v in new.items() if k.lower() in kept}
    own: Element = {"FamName": "", "Class": "RingParam", "Periodicity": 1.0, "Length": 0.0}
    if str(ring[0].get("Class", "")).lower() == "ringparam":
        own, ring = ring[0], ring[1:]
    return [own | new, *ring]


def _atsetcavity(ring: list[Element], voltage: Any, _: Any, harmonic: float) -> list[Element]:
    """The ring with a voltage in all, V, and the frequency of a harmonic."""
    cavities = _findcells(ring, "Frequency")
    frequency = harmonic * LIGHT / _findspos(ring, len(ring) + 1.0)
    for field, value in (("Voltage", voltage / cavities.size), ("Frequency", frequency),
                         ("HarmNumber", harmonic)):  # fmt: skip
        ring = _setcellstruct(ring, field, cavities, value)
    return ring
