"""Reading MAD-X: a file's statements are carried out, and its sequence or line is laid out.

Every statement is in one of three lists: carried out; without effect on the ring (`NO_EFFECT`); or
neither, and then the file is refused with that statement's name (`REFUSED`, and whatever is
unknown). Nothing of a file is run: see `madx_language`.
"""

import contextlib
import math
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError, first_of, plain, unknown_name
from tmlattice.input_files import content_of, decoded
from tmlattice.lattice.lines import Items, chosen, inner_names, items_of, laid_out, with_gaps
from tmlattice.lattice.madx_beam import ENERGIES, Beam
from tmlattice.lattice.madx_language import (
    CONSTANTS,
    LOGICAL,
    Evaluate,
    Given,
    Statement,
    Undetermined,
    attributes,
    compiled,
    evaluated,
    holds,
    split,
    statements,
    unquoted,
)
from tmlattice.lattice.parts import (
    ACTING,
    MODELLED,
    NO_EFFECT,
    SHIFTS,
    STATIC,
    Part,
    Report,
    ring_of_parts,
)
from tmlattice.lattice.ring import Ring

MOST_WORK = 4_000_000
"""Statements (ten each), names and elements looked up; the LHC needs some hundred thousand."""
MOST_FILES = 1000
MOST_BYTES = 200_000_000
ROUNDING = 1e-6
"""m; elements may overlap by this much, as positions are rounded."""
SHORTEST_GAP = 1e-9
"""m"""

NO_STATEMENT = frozenset({
    "title", "assign", "value", "show", "print", "printf", "help", "plot", "survey", "twiss",
    "save", "write", "savebeta", "esave", "eprint", "eoption", "emit", "touschek", "ibs",
    "aperture", "coguess", "track", "run", "observe", "start", "endtrack", "tkstart", "ripken",
    "dynap", "sodd", "sixtrack", "dumpsequ", "create", "fill", "readtable", "readmytable",
    "setplot", "resplot", "usemonitor", "usekick", "chdir", "rename", "copyfile", "removefile",
    "shrink", "sxfwrite", "delete", "tabstring", "setbeta", "nlens", "fill_knob", "threader",
    "set", "error", "beta0", "coption", "deselect", "distribution", "etable", "getdisp", "getkick",
    "getorbit", "renamefile", "rviewer", "save_state", "sddsin", "sddsout", "select_ptc_normal",
    "saveline", "real", "int", "constraint", "weight", "gweight", "global", "vary",
})  # fmt: skip
"""Statements that leave the ring as it is, as do all that begin with PTC_; those of MATCH stand for
nothing without it."""
NOT_RUN = {
    "system": "SYSTEM is not run",
    "makethin": "MAKETHIN is not carried out: magnets stay thick",
}
"""Statements that are passed over with a warning."""
REFUSED: dict[str, str] = {
    "match": "MATCH changes strengths by an optimisation, which is not carried out here; run MAD-X "
             "and SAVE the sequence, or take MATCH out to read the strengths before it",
    "ealign": "EALIGN moves elements by errors; take it out to read the ring as designed",
    "efcomp": "EFCOMP gives elements field errors; take it out to read the ring as designed",
    "seterr": "SETERR gives elements errors from a table; take it out to read the ring as designed",
    "correct": "CORRECT sets correctors; take it out to read the ring before it",
    "taper": "TAPER changes strengths along the ring; take it out to read the ring as designed",
    "add2expr": "ADD2EXPR changes the expression of a variable; write the expression",
    **{word: f"{word.upper()} sets variables from a table; write their values"
       for word in ("setvars", "setvars_lin", "setvars_const", "setvars_knob")},
    **{word: f"{word.upper()} sets correctors from a table; write their kicks"
       for word in ("readcorr", "setcorr", "putkick", "putorbit", "putdisp")},
    "sxfread": "SXFREAD reads a ring from a file of SXF; give a sequence",
    "setplugin": "SETPLUGIN runs a program; take it out",
}  # fmt: skip
"""Statements that may change the ring and are not carried out."""
KEYWORDS = frozenset({*MODELLED, *STATIC, *ACTING, "rbend"}) | {"sequence", "line"}
WORDS = frozenset({
    "type", "apertype", "aperture", "aper_offset", "aper_tol", "aper_vx", "aper_vy", "comments",
    "from", "refer", "refpos", "name", "method", "shape", "model", "range", "polarity", "calib",
    "mech_sep", "v_pos", "slot_id", "assembly_id", "magnet", "kmax", "kmin", "next_sequ", "xsize",
    "ysize", "reference",
})  # fmt: skip
"""Attributes that are texts, or whose numbers nothing here asks for."""
_FLAGS = frozenset({"kill_ent_fringe", "kill_exi_fringe"})

Attributes = dict[str, Given]


@dataclass
class _Definition:
    """An element: its base class and its attributes, those of its parents included.

    `length` is along the arc and of the moment of the definition: in a sequence that stands in
    another one MAD-X keeps it, whatever happens to L and ANGLE later.
    """

    name: str
    keyword: str
    values: dict[str, Any]
    where: str
    length: float = 0.0
    parents: tuple[str, ...] = ()


@dataclass
class _Node:
    """An element's place in a sequence; `at` is that of its reference point, or of its centre.

    `count` is k of NAME[k], which stays when others of the name are removed; `moved` are the
    shifts that hold at this place only.
    """

    name: str
    at: Evaluate
    origin: str = ""
    centred: bool = False
    count: int = 1
    moved: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class _Sequence:
    name: str
    length: Evaluate
    refer: str = "centre"
    refpos: str = ""
    nodes: list[_Node] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    def counted(self, name: str) -> int:
        """The number of an element's next place."""
        self.counts[name] += 1
        return self.counts[name]


@dataclass(frozen=True)
class _Slot:
    """An element with the position of its centre, m."""

    name: str
    centre: float
    length: float
    count: int = 1
    moved: Mapping[str, Any] = field(default_factory=dict)


def read_madx(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a MAD-X file.

    Args:
        path: `.seq`, `.madx`; files that it calls are read too.
        name: of the ring.
        sequence: of the file's sequences or lines; else the one that its last USE names; else
            `ring`, else the only one that stands in no other.
        energy: GeV; else that of the file's BEAM.

    Raises:
        LatticeError: a statement that is not understood, or that changes the ring and is not
            carried out; no sequence, several without a choice, or no energy.

    Warns:
        Of names without a value, statements that are passed over, and what the model lacks.
    """
    reader = _Reader(energy)
    try:
        reader.read(path)
    except LatticeError as error:
        raise LatticeError(f"'{path}' cannot be read as MAD-X: {error}") from error
    use = reader.chosen(path, sequence)
    beam = reader.ring_beam = reader.beam(use)
    if energy is None and not beam.has_energy:
        raise LatticeError(f"'{path}' has no BEAM with an energy; give energy= (GeV)")
    try:
        parts = reader.parts(use)
        for found, what in (
            (reader.undefined, "have no value: taken for 0, as by MAD-X"),
            (reader.skipped, "are not defined: skipped, as by MAD-X"),
        ):
            if found:
                reader.warnings.append(f"{first_of(sorted(found))} ({len(found)}) {what}")
        if beam.given.get("radiate"):
            reader.warnings.append("RADIATE of BEAM: orbits and optics are those without radiation")
        energy = beam.energy if energy is None else energy
        if reader.warnings:
            warnings.warn(f"'{path}': {'; '.join(reader.warnings)}", stacklevel=4)
        return ring_of_parts(parts, name, energy, beam.mass, beam.charge, reader.report)
    except LatticeError as error:
        raise LatticeError(f"'{path}' cannot be read as MAD-X: {error}") from error


def ring_of_madx(madx: Any, sequence: str | None = None, energy: float | None = None) -> Ring:
    """Return the ring of a sequence in the memory of `cpymad.madx.Madx`, with its errors.

    Args:
        madx: with a sequence that was used (`madx.use(...)`); nothing is run in it.
        sequence: of its sequences; else the one that was used last.
        energy: GeV; else that of the sequence's beam.

    Raises:
        LatticeError: no sequence that was used, or an element or an error that is not modelled.

    Warns:
        Of what the model lacks, reading errors of monitors among it.
    """
    known = list(madx.sequence)
    if sequence is not None and sequence.casefold() not in known:
        raise unknown_name("sequence of the Madx named", sequence, known)
    active = madx.sequence[sequence] if sequence is not None else madx.sequence()
    if active is None or not active.is_expanded:
        name = plain(active.name if active is not None else "NAME", 60)
        raise LatticeError(f"no sequence of the Madx is used; run madx.use('{name}') before")
    stated = active.beam
    beam = Beam({k: float(stated[k]) for k in ("mass", "charge", "energy", "bv")})
    reader = _Reader(energy)
    reader.ring_beam, reader.circumference = beam, float(active.length)
    reader.rbarc, reader.thin_focusing = bool(madx.options.rbarc), bool(madx.options.thin_foc)
    energy = beam.energy if energy is None else energy
    made: dict[Any, Part] = {}
    parts = []
    nodes = list(active.expanded_elements)
    # of a LINE every place is that of a centre, and no way between is implied
    reader._in_line = all(
        abs(node["at"] - node.position - node.length / 2) < ROUNDING for node in nodes
    )
    for node in nodes:
        align, field = node.align_errors, node.field_errors
        keyword, length = node.base_type.name, float(node.length)
        kicks = float(node.chkick), float(node.cvkick)
        errors = (str(align), str(field), kicks)
        key = (length,) if keyword == "drift" else (node.name, length, *errors)
        if key not in made:
            given = {"kick": 0.0, **{k: _evaluated(v) for k, v in node.items()}}
            usual = {k: _evaluated(v) for k, v in node.base_type.items()}
            own = {k: v for k, v in given.items() if k != "at" and v != usual.get(k)}
            name = "drift" if keyword == "drift" else node.name
            definition = _Definition(name, keyword, own, "of the Madx")
            part = reader._new_part(definition, length)
            made[key] = _with_errors_of(part, align, field, kicks, reader.report)
        parts.append(made[key])
    return ring_of_parts(parts, active.name, energy, beam.mass, beam.charge, reader.report)


_IN_TWISS: dict[str, dict[str, Sequence[int]]] = {
    "sbend": {"knl": (0, 1, 2)},
    **{k: {"knl": (n,), "ksl": (n,)} for n, k in ((1, "quadrupole"), (2, "sextupole"),
                                                  (3, "octupole"))},
    "multipole": {"knl": range(20), "ksl": range(20)},
}  # fmt: skip
"""Orders of field errors of which MAD-X's TWISS (5.09) takes account."""


def _evaluated(value: Any) -> Any:
    """A number or a text as it is, a list as a tuple."""
    return tuple(value) if not isinstance(value, str) and hasattr(value, "__len__") else value


def _with_errors_of(
    part: Part, align: Any, field: Any, kicks: tuple[float, float], report: Report
) -> Part:
    """A part with what EALIGN, EFCOMP and CORRECT have given its node in MAD-X.

    Raises:
        LatticeError: errors that are not modelled.
    """
    values = dict(part.values)
    named = f"{part.keyword.upper()} '{plain(part.name, 60)}'"
    moved = {} if align is None else {k: v for k, v in align._asdict().items() if v}
    if part.keyword in ("monitor", "hmonitor", "vmonitor"):
        if moved:
            report.left_out("errors of EALIGN of the BPM", part.name)
        moved = {}
    for key, amount in moved.items():
        if key not in SHIFTS or key not in MODELLED.get(part.keyword, ()):
            raise LatticeError(f"{key.upper()} of EALIGN of {named} is not modelled; set it to 0")
        values[key] = part.number(key) + amount
    for key, errors in () if field is None else (("knl", field.dkn), ("ksl", field.dks)):
        amounts = np.array(errors, dtype=float)
        acting = np.zeros_like(amounts)
        orders = _IN_TWISS.get(part.keyword, {}).get(key, ())
        acting[list(orders)] = amounts[list(orders)]
        if (acting != amounts).any():
            report.left_out("errors of EFCOMP without effect in MAD-X's TWISS", part.name)
        if not acting.any():
            continue
        own = part.list(key)
        values[key] = np.pad(own, (0, max(0, len(acting) - len(own))))
        values[key][: len(acting)] += acting
        if part.keyword == "multipole":  # the design's bend stays
            if part.list("ksl")[:1].any():
                raise LatticeError(f"EFCOMP of {named}, which bends vertically, is not modelled")
            values.setdefault("angle", float(part.list("knl")[:1].sum()))
    if any(kicks):
        alone = part.number("kick")
        plane = {"hkicker": "hkick", "vkicker": "vkick"}.get(part.keyword)
        if alone and plane:
            values.pop("kick")
            values[plane] = alone
        for key, amount in zip(("hkick", "vkick"), kicks, strict=True):
            values[key] = float(values.get(key, 0.0)) + amount
    return replace(part, values=values)


class _Stop(Exception):
    """RETURN, or the end of all reading."""

    def __init__(self, everything: bool) -> None:
        self.everything = everything


class _Reader:
    """What the statements of a file have defined so far."""

    def __init__(self, energy: float | None = None) -> None:
        self.variables: dict[str, float | Evaluate] = dict(CONSTANTS)
        self._constants = set(CONSTANTS)
        self.elements: dict[str, _Definition] = {}
        self.sequences: dict[str, _Sequence] = {}
        self.lines: dict[str, Items] = {}
        self.macros: dict[str, tuple[list[str], str]] = {}
        self._with_arguments: dict[str, tuple[list[str], str]] = {}
        self._given_energy = energy
        self.beams: dict[str, Beam] = {"": Beam({} if energy is None else {"energy": energy})}
        self.order: list[str] = []
        self.used = ""
        self.undefined: set[str] = set()
        self.skipped: set[str] = set()
        self.warnings: list[str] = []
        self.report = Report()
        self.rbarc = self.thin_focusing = True
        self.ring_beam, self.circumference = Beam(), 0.0
        self._open: _Sequence | None = None
        self._edited: _Sequence | None = None
        self._selected: list[dict[str, str]] = []
        self._unfound = set[str]()
        self._made: dict[tuple[Any, ...], Part] = {}
        self._files: list[Path] = []
        self._count = 0
        self._work = 0
        self._depth = 0

    # --- what expressions ask for ---------------------------------------------------------------
    def work(self, steps: int = 1) -> None:
        """Count the work that the file asks for."""
        self._work += steps
        if self._work > MOST_WORK:
            raise LatticeError("the file asks for more work than any ring; write the ring out")

    def variable(self, name: str) -> float:
        """The value of a variable; one that has none is 0, as in MAD-X."""
        self.work()
        value = self.variables.get(name)
        if value is None:
            if name not in self.elements:
                self.undefined.add(name)
            return 0.0
        return self._valued(value, name) if callable(value) else value

    def _valued(self, evaluate: Evaluate, name: str) -> float:
        self._depth += 1
        if self._depth > 200:
            raise LatticeError(f"'{name}' is defined by itself")
        try:
            return evaluate(self)
        finally:
            self._depth -= 1

    def attribute(self, owner: str, name: str) -> float:
        """The value of `owner->name`: of a beam, or an element's attribute."""
        self.work()
        if owner == "beam" or owner.startswith("beam%"):
            return self.beam(owner.partition("%")[2]).attribute(name)
        if owner in self.elements:
            value = self._value(self.elements[owner], name)
            return float(value[0] if isinstance(value, tuple) else value)
        if owner in self.sequences:
            raise Undetermined(f"'{owner}->{name}' of a sequence is 0 in MAD-X; write its value")
        raise Undetermined(f"'{owner}->{name}': no element '{owner}' is defined")

    def _value(self, definition: _Definition, attribute: str) -> Any:
        value = definition.values.get(attribute, 0.0)
        return self._valued(value, definition.name) if callable(value) else value

    # --- statements -----------------------------------------------------------------------------
    def read(self, path: Path) -> None:
        """Carry out the statements of a file."""
        with contextlib.suppress(_Stop):
            self._read_file(path)
        if self._open is not None:
            raise LatticeError(f"SEQUENCE '{self._open.name}' has no ENDSEQUENCE")

    def _read_file(self, path: Path) -> None:
        self._count += 1
        if not path.is_file():
            raise LatticeError(f"it calls '{path}', which is no file")
        if self._count > MOST_FILES or path.stat().st_size > MOST_BYTES:
            raise LatticeError(f"it calls '{path}': too many files, or too large ones")
        self._files.append(path)
        try:
            self._read_text(decoded(content_of(path, LatticeError)), whole=True)
        except _Stop as stop:
            if stop.everything:
                raise
        finally:
            self._files.pop()

    def _read_text(self, text: str, whole: bool = False) -> None:
        for statement in statements(text):
            self.work(10)
            if whole and not statement.ended and not _LAST.match(statement.text):
                self.warnings.append(
                    f"'{plain(statement.text, 60)}' ({self._where(statement)}) has no ';', without "
                    "which MAD-X does not carry it out: it is carried out here"
                )
            try:
                self._carry_out(statement)
            except (LatticeError, ArithmeticError, ValueError, TypeError, LookupError) as error:
                if "in the statement" in str(error):
                    raise
                why = str(error) or type(error).__name__
                if isinstance(error, KeyError):
                    why = f"{str(error.args[0]).upper()} is missing"
                raise LatticeError(
                    f"{why} (in the statement '{plain(statement.text, 100)}', "
                    f"{self._where(statement)})"
                ) from error

    def _where(self, statement: Statement) -> str:
        return f"line {statement.line} of {plain(self._files[-1].name, 60)}"

    def _carry_out(self, statement: Statement) -> None:
        text = statement.text
        text = re.sub(r"^else\s+if\b", "elseif", text, flags=re.IGNORECASE)
        block = re.match(r"(if|elseif|while)\s*\(|(else)\b", text, re.IGNORECASE)
        if block:
            return self._block(text, (block[1] or block[2]).lower())
        match = re.fullmatch(
            r"([\w.]+)\s*(?:\(([^)]*)\))?\s*:\s*macro\s*=\s*\{(.*)\}", text, re.I | re.DOTALL
        )
        if match:
            names = [n.strip() for n in (match[2] or "").split(",") if n.strip()]
            self.macros[match[1].lower()] = (names, match[3])
            return None
        match = re.fullmatch(
            # of CONST REAL MAD-X takes neither word
            r"(?:const\s+(?:real|int)\s+|(?:(real|int)\s+)?(const\s+)?)([\w.$%]+)\s*(:?=)\s*(.*)",
            text, re.I | re.DOTALL,
        )  # fmt: skip
        if match:
            name, given = match[3].lower(), Given(match[5], match[4] == ":=")
            self._assign(name, given, whole=str(match[1]).lower() == "int")
            if match[2]:
                self._constants.add(name)
            return None
        match = re.fullmatch(r"([\w.$%\"']+)\s*->\s*([\w.]+)\s*(:?=)\s*(.*)", text, re.DOTALL)
        if match:
            # worked out at once even after `:=`, as MAD-X does
            owner, given = unquoted(match[1]).lower(), Given(match[4])
            return self._set(owner, {match[2].lower(): given})
        match = re.fullmatch(  # a comma is a blank to MAD-X
            r"([\w.$%]+|\"[^\"]*\"|'[^']*')\s*(\([^)]*\))?[\s,]*:[\s,]*([^=].*)", text, re.DOTALL
        )
        if match:
            name, rest = unquoted(match[1]).lower(), match[3]
            line = re.fullmatch(r"line\s*=\s*(.*)", rest, re.IGNORECASE | re.DOTALL)
            if match[2] and not line:
                raise LatticeError("an element with arguments is not read; write it out")
            if line and match[2]:
                self._with_arguments[name] = (split(match[2][1:-1].lower()), line[1])
                return None
            if line:
                self.lines[name] = items_of(self._written_out(line[1]), _line_parts, _bare)
                return self._known_as(name)
            return self._define(name, rest, statement)
        return self._command(text)

    def _assign(self, name: str, given: Given, whole: bool) -> None:
        if name in self._constants:
            return  # MAD-X keeps them
        expression = compiled(unquoted(given.text.strip()))
        evaluate: Evaluate = (lambda names: math.trunc(expression(names))) if whole else expression
        try:
            value = evaluate if given.deferred else evaluate(self)
        except Undetermined as error:  # of no consequence where nothing asks for it
            value = _raising(error)
        self.variables[name] = value

    def _block(self, text: str, word: str) -> None:
        head, brace, body = text.partition("{")
        if not brace or (word != "else" and ")" not in head):
            raise LatticeError(f"{word.upper()} is not followed by (...) and braces; write both")
        body = body.rpartition("}")[0]
        if word == "else":
            if not self._branched:
                self._read_text(body)
            return
        condition = head[head.index("(") + 1 : head.rindex(")")]
        if len(LOGICAL.findall(condition)) > 1:
            self.warnings.append(
                f"{word.upper()} ({plain(condition, 60)}): what stands behind the first && or || "
                "of several is false, as in MAD-X"
            )
        if word == "while":
            while holds(condition, self):
                self.work(10)
                self._read_text(body)
            return
        if word == "elseif" and self._branched:
            return
        holding = holds(condition, self)
        if holding:
            self._read_text(body)
        self._branched = holding  # also where blocks inside have changed it

    _branched = _in_line = False

    def _define(self, name: str, rest: str, statement: Statement) -> None:
        head, *items = split(rest)
        if " " in head:
            head, first = head.split(" ", 1)
            items.insert(0, first)
        given = attributes(items)
        word = unquoted(head).lower()
        if word == "sequence":
            return self._begin(name, given)
        if word not in KEYWORDS and word not in self.elements:
            if word in NO_STATEMENT or word in _COMMANDS or word in REFUSED:
                self.macros[name] = ([], rest)  # EXEC carries it out again
                return self._command(rest)
            raise LatticeError(f"no element or command '{plain(word, 60)}' is known")
        if self._open is not None and name in self.elements:
            return self._place_again(name, given)
        if word == name:
            self.warnings.append(f"'{name}: {name}' leaves the element as it is, as in MAD-X")
            return None
        parent = self.elements.get(word)
        own = dict(parent.values) if parent else {}
        keyword = parent.keyword if parent else word
        parents = () if parent is None else (word, *parent.parents)
        definition = _Definition(name, keyword, own, self._where(statement), parents=parents)
        self.elements[name] = definition
        self._update(definition, given)
        unknown = set(self.undefined)
        definition.length = self._element_length(definition)
        self.undefined = unknown  # a value that comes later counts in the ring
        self._place(name, given)
        return None

    def _written_out(self, text: str) -> str:
        """The text of a line, with the items of lines with arguments in place of their names."""

        def items(match: re.Match[str]) -> str:
            names, body = self._with_arguments[match[1].lower()]
            given = split(match[2])
            if len(given) != len(names):
                raise LatticeError(f"the line '{plain(match[1], 60)}' has {len(names)} arguments")
            values = dict(zip(names, given, strict=True))
            return re.sub(r"[\w.$%]+", lambda m: values.get(m[0].lower(), m[0]), body)

        known = "|".join(map(re.escape, self._with_arguments))
        call = re.compile(rf"(?<![\w.$%])({known})\s*\(([^()]*)\)", re.IGNORECASE)
        while known and call.search(text):
            self.work(len(text))
            text = call.sub(items, text)
        return text

    def _known_as(self, name: str) -> None:
        if name in self.order:
            self.order.remove(name)
        self.order.append(name)

    def _update(self, definition: _Definition, given: Attributes) -> None:
        for attribute, value in given.items():
            if attribute in ("at", "from"):
                continue
            if attribute in WORDS:
                definition.values[attribute] = unquoted(value.text)
            elif value.bare and attribute not in _FLAGS | NO_EFFECT:
                definition.values[attribute] = 0.0
                self.warnings.append(
                    f"{attribute.upper()} of '{definition.name}' has no value: 0, as in MAD-X"
                )
            elif value.deferred:
                definition.values[attribute] = evaluated(value)
            else:
                definition.values[attribute] = evaluated(value)(self)

    def _set(self, owner: str, given: Attributes) -> None:
        """`owner->attribute = value`, and an element that is named again with other values."""
        if owner == "beam" or owner.startswith("beam%"):
            raise LatticeError("MAD-X leaves its beam as it is here; state it by BEAM")
        if owner in self.elements:
            self._update(self.elements[owner], given)
        elif owner in self.sequences:
            names = ", ".join(sorted(given)).upper()
            self.warnings.append(f"{names} of the sequence '{owner}' stays as defined, as in MAD-X")
        elif given and given.keys() <= _ATTRIBUTES:
            self.skipped.add(owner)
        else:
            raise LatticeError(f"no element or command '{plain(owner, 60)}' is known")

    def _evaluate(self, given: Given) -> Evaluate:
        evaluate = compiled(given.text)
        if given.deferred:
            return evaluate
        return _constant(evaluate(self))

    # --- commands -------------------------------------------------------------------------------
    def _command(self, text: str) -> None:
        match = re.match(r"\"[^\"]*\"|[\w.$%]+", text)
        if match is None:
            raise LatticeError("no element or command begins so")
        word = unquoted(match[0]).lower()
        rest = text[match.end() :].lstrip(" ,")
        if rest.startswith("->"):
            raise LatticeError("one number of a list is not set so; give the whole list")
        if word == "set" and (match := re.search(r"\bsequence\s*=\s*([^,]+)", rest, re.I)):
            self.used = unquoted(match[1]).lower()
        if word in NO_STATEMENT or word.startswith("ptc_"):
            return None
        if word in NOT_RUN:
            if NOT_RUN[word] not in self.warnings:
                self.warnings.append(NOT_RUN[word])
            return None
        if word in REFUSED:
            raise LatticeError(REFUSED[word])
        if word in ("return", "exit", "quit", "stop"):
            raise _Stop(word != "return")
        if word == "exec":
            return self._execute(rest)
        given = attributes(split(rest))
        match word:
            case "call":
                return self._call(given)
            case "option":
                if "reset" in given and compiled(given["reset"].text)(self):
                    self.rbarc = self.thin_focusing = True
                for option, name in (("rbarc", "rbarc"), ("thin_foc", "thin_focusing")):
                    if option in given:
                        setattr(self, name, bool(compiled(given[option].text)(self)))
                return None
            case "beam":
                owner = _word(given, "sequence")
                given.pop("sequence", None)
                return self._update_beam(owner, given)
            case "resbeam":
                self.beams[_word(given, "sequence")] = Beam()
                return None
            case "use":
                return self._use(given)
            case "select":
                return self._select(given)
            case "endsequence":
                if self._open is None:
                    raise LatticeError("ENDSEQUENCE closes no SEQUENCE")
                self._open = None
                return None
            case "seqedit":
                return self._seqedit(unquoted(given["sequence"].text).lower())
            case "endedit":
                self._edited = None
                return None
            case "extract":
                return self._extract(given)
        if self._edited is not None and word in _EDITS:
            slots = self.slots(self._edited)
            return self._put(getattr(self, f"_{word}")(given, self._edited, slots))
        if self._open is not None and (word in self.elements or word in self.sequences):
            return self._place_again(word, given)
        return self._set(word, given)

    def _call(self, given: Attributes) -> None:
        called = unquoted(given["file"].text if "file" in given else next(iter(given), ""))
        folders = [self._files[-1].parent, self._files[0].parent]
        found = [folder / called for folder in folders if (folder / called).is_file()]
        self._read_file(found[0] if found else folders[0] / called)

    def _execute(self, text: str) -> None:
        match = re.fullmatch(r"([\w.]+)\s*(?:\((.*)\))?", text, re.DOTALL)
        if match is None or match[1].lower() not in self.macros:
            raise LatticeError(f"no macro '{plain(text, 60)}' is defined")
        names, body = self.macros[match[1].lower()]
        given = re.sub(
            r"\$([\w.]+)", lambda m: str(int(self.variable(m[1].lower()))), match[2] or ""
        )
        for name, value in zip(names, split(given), strict=False):
            if not _ARGUMENT.fullmatch(value):
                raise LatticeError(
                    f"the argument '{plain(value, 60)}' of a macro is an expression, which MAD-X "
                    "cuts off; give a number or a name"
                )
            # wherever it stands, within words too, as MAD-X does
            body = re.sub(re.escape(name), value.replace("\\", r"\\"), body, flags=re.IGNORECASE)
        self._depth += 1
        if self._depth > 100:
            raise LatticeError(f"the macro '{match[1]}' calls itself without end")
        self._read_text(body)
        self._depth -= 1

    def beam(self, sequence: str) -> Beam:
        """The beam of a sequence, else the default one.

        One that states no energy has 1 GeV in MAD-X, whatever the default one has.
        """
        default, own = self.beams[""], self.beams.get(sequence, self.beams[""])
        if own.has_energy or not default.has_energy:
            return own
        text = (
            f"BEAM of the sequence '{sequence}' states no energy, which is 1 GeV in MAD-X: that of "
            "the BEAM without a sequence is taken"
        )
        if text not in self.warnings and not self._given_energy:
            self.warnings.append(text)
        kept = ENERGIES if "particle" in own.given else (*ENERGIES, "particle", "mass", "charge")
        return Beam({k: v for k, v in default.given.items() if k in kept} | own.given)

    def _update_beam(self, owner: str, given: Attributes) -> None:
        beam = self.beams.setdefault(owner, Beam())
        own: dict[str, float | str] = {}
        for name, value in given.items():
            if name == "particle":
                own[name] = unquoted(value.text)
            elif value.text[:1] != "{":  # lists are of its synchrotron radiation integrals
                own[name] = float(compiled(value.text)(self))
        if idle := beam.update(own):
            what = f"{' and '.join(idle)} of BEAM".upper()
            self.warnings.append(
                f"{what}: those of the {beam.given['particle']} are taken, as in MAD-X"
            )

    def _use(self, given: Attributes) -> None:
        named = next((given[k].text for k in ("sequence", "period") if k in given), None)
        named = named or next((k for k in given if k not in ("range", "survey")), "")
        if _word(given, "range").replace(" ", "") not in ("#s/#e", ""):
            raise LatticeError("USE with a RANGE takes a part of the sequence; use all of it")
        self.used = unquoted(named).lower()
        if self.used not in self.sequences and self.used not in self.lines:
            raise LatticeError(f"USE names '{plain(self.used, 60)}', which no sequence or line is")

    # --- sequences ------------------------------------------------------------------------------
    def _begin(self, name: str, given: Attributes) -> None:
        if self._open is not None:
            raise LatticeError(f"SEQUENCE '{self._open.name}' has no ENDSEQUENCE before this one")
        if "l" not in given:
            raise LatticeError(f"SEQUENCE '{name}' has no length; give it L")
        for word in ("next_sequ", "add_pass"):
            if _word(given, word) not in ("", "0", "none"):
                raise LatticeError(f"{word.upper()} of a sequence is not read")
        length = self._evaluate(given["l"])
        self._open = _Sequence(name, length, refpos=_word(given, "refpos"))
        if "refer" in given:
            self._open.refer = _refer(given["refer"])
        self.sequences[name] = self._open
        self._known_as(name)

    def _place(self, name: str, given: Attributes, moved: Mapping[str, Any] | None = None) -> None:
        """An element's place in the sequence that is open."""
        if self._open is None or "at" not in given:
            return
        at, origin = self._evaluate(given["at"]), _word(given, "from")
        count = self._open.counted(name)
        self._open.nodes.append(_Node(name, at, origin, count=count, moved=moved or {}))

    def _place_again(self, name: str, given: Attributes) -> None:
        """Place what is defined already: of its attributes MAD-X changes shifts, at this place."""
        if "at" not in given:
            raise LatticeError(f"'{plain(name, 60)}' has no AT in its sequence")
        known = self.elements.get(name)
        own = _Definition(name, "", {}, "")
        self._update(own, {k: v for k, v in given.items() if k not in WORDS | NO_EFFECT - {"l"}})
        moved = {k: v for k, v in own.values.items() if k in _SHIFTS} if known else {}
        unknown = set(self.undefined)
        # SAVE writes there what it has written in the definition
        if any(not known or self._value(own, key) != self._value(known, key)
               for key in own.values.keys() - moved.keys()):  # fmt: skip
            self.report.left_out("attributes given in the sequence (as in MAD-X)", name)
        self.undefined = unknown  # a value may come later
        self._place(name, given, moved)

    def _length(self, name: str, nested: bool = False) -> float:
        """Of an element (along the arc) or a sequence, m."""
        if name in self.sequences:
            return self._valued(self.sequences[name].length, name)
        if name in self.elements:
            own = self.elements[name]
            return own.length if nested else self._element_length(own)
        raise LatticeError(f"no element '{plain(name, 60)}' is defined")

    def _element_length(self, definition: _Definition) -> float:
        length = float(self._value(definition, "l"))
        if definition.keyword == "multipole":
            return 0.0
        if definition.keyword == "rbend" and self.rbarc:
            half = float(self._value(definition, "angle")) / 2
            return length * half / math.sin(half) if half else length
        return length

    def slots(self, sequence: _Sequence, nested: bool = False) -> list[_Slot]:
        """Its elements and sequences with the positions of their centres, in their order."""
        reference = _REFERENCE.get(sequence.refer, 0.0)
        nodes: dict[tuple[str, int], _Node] = {}
        for node in sequence.nodes:
            nodes.setdefault((node.name, node.count), node)
        known: dict[int, float] = {}

        def centre(node: _Node, depth: int = 0) -> float:
            if id(node) in known:
                return known[id(node)]
            if depth > 200:
                raise LatticeError(f"FROM of '{plain(node.name, 60)}' leads back to itself")
            at = self._valued(node.at, node.name)
            if not node.centred:
                at += self._offset(node.name, reference, nested)
            if node.origin:
                origin = nodes.get(_occurrence(node.origin))
                if origin is None:
                    raise LatticeError(
                        f"FROM of '{plain(node.name, 60)}' names '{plain(node.origin, 60)}', not "
                        f"in the sequence '{sequence.name}'"
                    )
                at += centre(origin, depth + 1)
            known[id(node)] = at
            return at

        self.work(len(sequence.nodes))
        own = [
            _Slot(n.name, centre(n), self._length(n.name, nested), n.count, n.moved)
            for n in sequence.nodes
        ]
        return sorted(own, key=lambda slot: slot.centre)

    def _offset(self, name: str, reference: float, nested: bool = False) -> float:
        """From the reference point of an element or a sequence to its centre, m."""
        sub = self.sequences.get(name)
        if sub is not None and sub.refpos:
            found = [slot for slot in self.slots(sub, True) if slot.name == sub.refpos]
            if not found:
                raise LatticeError(f"REFPOS of '{name}' names '{sub.refpos}', which it has not")
            return self._length(name) / 2 - found[0].centre
        return reference * self._length(name, nested)

    def _flat(self, sequence: _Sequence, start: float = 0.0, depth: int = 0) -> list[_Slot]:
        if depth > 50:
            raise LatticeError(f"the sequence '{sequence.name}' contains itself")
        flat: list[_Slot] = []
        for slot in self.slots(sequence, depth > 0):
            self.work()
            if slot.name in self.sequences:
                begin = start + slot.centre - slot.length / 2
                flat += self._flat(self.sequences[slot.name], begin, depth + 1)
            else:
                flat.append(replace(slot, centre=start + slot.centre))
        return flat

    # --- SEQEDIT: each edit returns the elements that the sequence then has, in any order ---------
    def _seqedit(self, name: str) -> None:
        if name not in self.sequences:
            raise LatticeError(f"SEQEDIT names '{plain(name, 60)}', which no sequence is")
        self._edited = self.sequences[name]
        self._unfound = set()
        self._put(self.slots(self._edited))

    def _put(self, slots: Sequence[_Slot]) -> None:
        assert self._edited is not None
        self._edited.nodes = _nodes(sorted(slots, key=lambda slot: slot.centre))

    def _extract(self, given: Attributes) -> None:
        """A sequence of what stands between two markers of another."""
        named, first, last, new = (
            unquoted(given[k].text).lower() for k in ("sequence", "from", "to", "newname")
        )
        if named not in self.sequences:
            raise LatticeError(f"EXTRACT names '{plain(named, 60)}', which no sequence is")
        slots = self.slots(self.sequences[named])
        ends = [self._targets({"element": Given(end)}, slots)[0] for end in (first, last)]
        begin, end = ends[0].centre, ends[1].centre
        if ends[0].length or ends[1].length or end < begin:
            raise LatticeError("EXTRACT is not from a marker to a marker behind it")
        made = _Sequence(new, _constant(end - begin), counts=self.sequences[named].counts.copy())
        made.nodes = _nodes(slots[slots.index(ends[0]) : slots.index(ends[1]) + 1], begin)
        self.sequences[new] = made
        self._known_as(new)

    def _select(self, given: Attributes) -> None:
        if _word(given, "flag") != "seqedit":
            return
        if "clear" in given and given["clear"].text.lower() not in ("0", "false"):
            self._selected = []
        else:
            words = ("class", "pattern", "range")
            self._selected.append({k: unquoted(given[k].text) for k in words if k in given})

    def _matches(self, slot: _Slot, choice: dict[str, str]) -> bool:
        if "range" in choice:
            raise LatticeError("SELECT with a RANGE is not read in SEQEDIT; use a PATTERN")
        definition = self.elements.get(slot.name)
        classes = (slot.name, *(definition.parents if definition else ()))
        keyword = definition.keyword if definition else ""
        if "class" in choice and choice["class"].lower() not in (keyword, *classes):
            return False
        if "pattern" not in choice:
            return "class" in choice
        pattern = choice["pattern"]
        if len(pattern) > 200 or re.search(r"[)\]*+}][*+{]", pattern):
            raise LatticeError(f"the pattern '{plain(pattern, 60)}' is not read; name the elements")
        try:
            return re.search(pattern, slot.name, re.IGNORECASE) is not None
        except re.error as error:
            raise LatticeError(f"the pattern '{plain(pattern, 60)}' is none ({error})") from error

    def _targets(self, given: Attributes, slots: Sequence[_Slot]) -> list[_Slot]:
        """The places that an edit names by ELEMENT, or those that SELECT has selected."""
        if "element" not in given:
            raise LatticeError("the edit names no ELEMENT")
        named = unquoted(given["element"].text).lower()
        if named == "selected":
            return [s for s in slots if any(self._matches(s, own) for own in self._selected)]
        found = [slot for slot in slots if (slot.name, slot.count) == _occurrence(named)]
        if not found:
            raise LatticeError(f"the sequence has no element '{plain(named, 60)}'")
        if len(found) > 1:  # MAD-X edits one of them or none
            raise LatticeError(
                f"FLATTEN has made {len(found)} elements '{plain(named, 60)}' of one name; edit "
                "them by SELECT"
            )
        return found

    def _found(self, given: Attributes, slots: Sequence[_Slot]) -> list[_Slot]:
        """As `_targets`, for edits that do not find what FLATTEN has just brought in."""
        found = self._targets(given, slots)
        unfound = sorted({slot.name for slot in found} & self._unfound)
        if unfound:
            raise LatticeError(
                f"MAD-X does not find '{plain(unfound[0], 60)}' in the SEQEDIT that flattens its "
                "sequence; put ENDEDIT and another SEQEDIT before this edit"
            )
        return found

    def _install(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        name = unquoted(given["element"].text).lower()
        if "class" in given and name not in self.elements:
            word = unquoted(given["class"].text).lower()
            self._define(name, word, Statement("", 0))
            if word in self.elements:  # in MAD-X they are one: what changes one changes both
                self.elements[name].values = self.elements[word].values
        self._is_element(name)
        reference = _REFERENCE.get(edited.refer, 0.0)
        length = self._length(name)
        at = float(compiled(given["at"].text)(self)) + self._offset(name, reference)
        origins = [0.0]
        if "from" in given:
            origin = {"element": Given(given["from"].text)}
            origins = [slot.centre for slot in self._targets(origin, slots)]
        return slots + [_Slot(name, at + s, length, edited.counted(name)) for s in origins]

    def _is_element(self, name: str) -> None:
        """Raises a LatticeError otherwise: MAD-X puts no sequence into another here."""
        if name not in self.elements:
            raise LatticeError(f"'{plain(name, 60)}' is no element; SEQEDIT puts in elements only")

    def _remove(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        gone = {id(slot) for slot in self._found(given, slots)}
        return [slot for slot in slots if id(slot) not in gone]

    def _replace(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        new = unquoted(given["by"].text).lower()
        self._is_element(new)
        old = {id(slot) for slot in self._targets(given, slots)}
        length = self._length(new)
        return [
            replace(s, name=new, length=length, count=edited.counted(new))
            if id(s) in old else s for s in slots
        ]  # fmt: skip

    def _move(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        """MAD-X counts from where REFER has an element, also with BY, and drops its shifts here."""
        moved = {id(slot) for slot in self._found(given, slots)}
        way = float(compiled(given["to" if "to" in given else "by"].text)(self))
        if "to" in given and "from" in given:
            way += self._targets({"element": Given(given["from"].text)}, slots)[0].centre
        share = _REFERENCE.get(edited.refer, 0.0)
        return [
            replace(
                s, centre=way + self._offset(s.name, share) + ("by" in given) * s.centre, moved={}
            )
            if id(s) in moved else s for s in slots
        ]  # fmt: skip

    def _flatten(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        flat = self._flat(edited)
        self._unfound = {slot.name for slot in flat} - {slot.name for slot in slots}
        edited.refer = "centre"
        return flat

    def _cycle(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        named = {"element": given.get("start", Given(""))}
        first = self._targets(named, slots)[0]
        if first.length:
            raise LatticeError(f"CYCLE starts at '{first.name}', which has a length; take a marker")
        length, zero = self._length(edited.name), first.centre
        before = slots.index(first)
        return [replace(s, centre=s.centre - zero + (length if k < before else 0.0))
                for k, s in enumerate(slots)]  # fmt: skip

    def _reflect(self, given: Attributes, edited: _Sequence, slots: list[_Slot]) -> list[_Slot]:
        length = self._length(edited.name)
        return [replace(s, centre=length - s.centre) for s in slots[::-1]]

    # --- the ring -------------------------------------------------------------------------------
    def chosen(self, path: Path, wanted: str | None) -> str:
        """Of the sequences and lines the one that is the ring."""
        inside = [node.name for s in self.sequences.values() for node in s.nodes]
        inside += [name for items in self.lines.values() for name in inner_names(items)]
        return chosen(path, self.order, wanted, self.used, inside)

    def parts(self, use: str) -> list[Part | float]:
        """The elements of the ring in beam order, and the gaps between them."""
        names = [use]
        if use not in self.sequences:
            self._in_line = True
            names = [name for name, _ in laid_out(self.lines[use], self.lines)]
            self.work(len(names))
        self.circumference = sum(map(self._length, names))
        parts: list[Part | float] = []
        for name in names:
            if name in self.sequences:
                parts += self._laid_out(self.sequences[name])
            else:
                parts.append(self._part(name, self._length(name)))
        return parts

    def _laid_out(self, sequence: _Sequence) -> list[Part | float]:
        placed = [
            (self._part(slot.name, slot.length, slot.moved), slot.name,
             slot.centre - slot.length / 2, slot.length)
            for slot in self._flat(sequence)
        ]  # fmt: skip
        end = self._length(sequence.name)
        return with_gaps(placed, f"the sequence '{sequence.name}'", end, ROUNDING, SHORTEST_GAP)

    def _part(self, name: str, length: float, moved: Mapping[str, Any] | None = None) -> Part:
        if name not in self.elements:
            raise LatticeError(f"no element '{plain(name, 60)}' is defined")
        key = (name, length, *(moved or {}).items())
        if key not in self._made:
            definition = self.elements[name]
            if moved:
                definition = replace(definition, values=definition.values | dict(moved))
            self._made[key] = self._new_part(definition, length)
            if abs(length - self._element_length(definition)) > 1e-12:
                self.report.left_out("the later L or ANGLE (as in MAD-X)", name)
        return self._made[key]

    def _new_part(self, definition: _Definition, length: float) -> Part:
        """An element's attributes as numbers; rectangular bends as sector bends."""
        beam = self.ring_beam
        keyword, half = definition.keyword, 0.0
        own = {k: self._value(definition, k) for k in definition.values if k not in WORDS}
        own["l"] = length
        match keyword:
            case "rbend":
                keyword = "sbend"
                half = float(own.get("angle", 0.0)) / 2
                own |= {e: float(own.get(e, 0.0)) + half for e in ("e1", "e2")}
            case "rfcavity" if not own.get("freq") and own.get("harmon"):
                gamma = beam.energy / beam.mass
                speed = CONSTANTS["clight"] * math.sqrt(1 - 1 / gamma**2)
                own["freq"] = 1e-6 * float(own["harmon"]) * speed / self.circumference
            case "matrix":
                own = _with_matrix(own)
            case "multipole":
                if not own.get("angle"):  # KNL[0] bends the design, also with ANGLE=0
                    own.pop("angle", None)
                elif np.ravel(own.get("ksl", ()))[:1].any():
                    raise LatticeError(
                        f"ANGLE of MULTIPOLE '{plain(definition.name, 60)}', which bends "
                        f"vertically by its KSL ({definition.where}), is not modelled; set it to 0"
                    )
                if not self.thin_focusing:
                    own["lrad"] = 0.0
        for attribute in (*_NOT_IN_TWISS.get(keyword, ()), *(SHIFTS if self._in_line else ())):
            if np.any(own.pop(attribute, 0.0)):
                where = "a LINE" if attribute in SHIFTS else "MAD-X's TWISS"
                what = f"{attribute.upper()} of the {keyword.upper()} (as in {where})"
                self.report.left_out(what, definition.name)
        if float(beam.given.get("bv", 1.0)) == -1 and keyword != "srotation":
            own = _reversed_fields(own)
            if definition.keyword == "rbend" and half:
                what = "the other sign that MAD-X's TWISS gives half the angle in faces (BV=-1)"
                self.report.left_out(what, definition.name)
        return Part(definition.name, keyword, own, definition.where)


_NOT_IN_TWISS: dict[str, tuple[str, ...]] = {
    "sbend": ("k0s", "k1s", "knl", "ksl"),
    "quadrupole": ("k0", "knl", "ksl"),
    **dict.fromkeys(("sextupole", "octupole", "solenoid"), ("knl", "ksl")),
}
"""What MAD-X's TWISS leaves out of thick magnets: it is for PTC and MAKETHIN."""
_REFERENCE = {"entry": 0.5, "exit": -0.5}
"""From the point that REFER names to the centre, in lengths of the element."""
_SHIFTS = SHIFTS | {"dtheta", "dphi"}
_COMMANDS = ("beam", "resbeam", "select", "call", "use", "option", "exec", *NOT_RUN)
_EDITS = ("install", "remove", "move", "replace", "cycle", "flatten", "reflect")
_LAST = re.compile(r"(return|exit|quit|stop|twiss|endsequence)\b", re.IGNORECASE)
"""Statements that end a file as well without their `;`."""
_ARGUMENT = re.compile(
    r"\"[^\"]*\"|'[^']*'|(\d+\.?\d*|\.\d+)([ed][-+]?\d+)?|[^-+*/^(){}]*(->[\w.]+)?", re.IGNORECASE
)
"""What MAD-X takes whole as an argument of a macro."""
_ENTRY = re.compile(r"rm([1-6])([1-6])")
_ATTRIBUTES = (WORDS | NO_EFFECT).union(*MODELLED.values()) - {"at", "from"}
_ODD = ("angle", "k0", "k1", "k2", "k3", "k0s", "k1s", "k2s", "k3s", "ks", "ksi", "hkick", "vkick",
        "kick", "knl", "ksl", "e1", "e2", "h")  # fmt: skip


def _reversed_fields(own: dict[str, Any]) -> dict[str, Any]:
    """BV=-1: the beam goes through the same fields with the other sign of charge or direction."""
    return {k: tuple(-x for x in v) if isinstance(v, tuple) else -v
            if k in _ODD else v for k, v in own.items()}  # fmt: skip


def _occurrence(text: str) -> tuple[str, int]:
    """The name and k of NAME[k]; NAME alone is the first."""
    name, _, k = text.partition("[")
    return name, int(k.rstrip("]") or 1)


def _constant(value: float) -> Evaluate:
    return lambda names: value


def _nodes(slots: Sequence[_Slot], begin: float = 0.0) -> list[_Node]:
    """Places of a sequence that begins at this position, m."""
    return [
        _Node(s.name, _constant(s.centre - begin), centred=True, count=s.count, moved=s.moved)
        for s in slots
    ]


def _raising(error: LatticeError) -> Evaluate:
    def value(_: Any) -> float:
        raise error

    return value


def _bare(word: str) -> str:
    return unquoted(word).lower()


def _word(given: Mapping[str, Given], attribute: str) -> str:
    """An attribute that is a word, in lower case; empty where it is not given."""
    return _bare(given[attribute].text) if attribute in given else ""


def _line_parts(text: str) -> list[str]:
    """Items of a line; MAD-X takes a plus for a comma."""
    return [item for part in split(text) for item in split(part, "+")]


def _refer(given: Given) -> str:
    word = unquoted(given.text).lower()
    if word in ("centre", "center"):
        return "centre"
    if word not in ("entry", "exit"):
        raise LatticeError(f"REFER is '{plain(word, 40)}'; it is ENTRY, CENTRE or EXIT")
    return word


def _with_matrix(own: dict[str, Any]) -> dict[str, Any]:
    """MATRIX: RMij and KICKi as arrays; its second order TMijk is named as left out."""
    rm, b = np.eye(6), np.zeros(6)
    rest: dict[str, Any] = {}
    for name, value in own.items():
        entry = _ENTRY.fullmatch(name)
        if entry:
            rm[int(entry[1]) - 1, int(entry[2]) - 1] = float(value)
        elif re.fullmatch(r"kick[1-6]", name):
            b[int(name[-1]) - 1] = -float(value) if name == "kick5" else float(value)
        elif re.fullmatch(r"tm[1-6]{3}", name):
            rest["tm"] = rest.get("tm", 0.0) or float(value)
        else:
            rest[name] = value
    return {**rest, "rm": rm, **({"b": b} if b.any() else {})}
