"""MAD-X's language: statements, and expressions worked out from their tokens.

Text of a file is never run: an expression knows numbers, names, attributes of elements, the four
operations, powers, and the functions listed here. The work that a file asks for is bounded.
"""

import math
import operator
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import ELECTRON_GEV, LIGHT, PROTON_GEV

LONGEST_STATEMENT = 5000
"""Lines, comments apart: a file without its semicolons is none of MAD-X."""
DEEPEST = 60
"""Brackets within brackets, and deferred expressions within each other."""

CONSTANTS: dict[str, float] = {
    "pi": math.pi, "twopi": 2 * math.pi, "degrad": 180 / math.pi, "raddeg": math.pi / 180,
    "e": math.e, "amu0": 4e-7 * math.pi, "emass": ELECTRON_GEV, "mumass": 0.1056583755,
    "nmass": 0.93956542052, "pmass": PROTON_GEV, "umass": 0.93149410242, "clight": LIGHT,
    "qelect": 1.602176634e-19, "hbar": 6.582119569e-25, "erad": 2.8179403262e-15,
    "prad": 1.5346982672e-18, "true": 1.0, "false": 0.0, "version": 50902.0,
}  # fmt: skip
"""As MAD-X 5.09 defines them (masses in GeV, lengths in m)."""


def _sinc(x: float) -> float:
    return math.sin(x) / x if x else 1.0


def _round(x: float) -> float:
    return math.copysign(math.floor(abs(x) + 0.5), x)


FUNCTIONS: dict[str, Callable[..., float]] = {
    "abs": abs, "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "log10": math.log10,
    "sin": math.sin, "cos": math.cos, "tan": math.tan, "asin": math.asin, "acos": math.acos,
    "atan": math.atan, "sinh": math.sinh, "cosh": math.cosh, "tanh": math.tanh, "sinc": _sinc,
    "erf": math.erf, "erfc": math.erfc, "floor": math.floor, "ceil": math.ceil, "round": _round,
    "frac": lambda x: x - math.trunc(x),
}  # fmt: skip
RANDOM = ("ranf", "gauss", "tgauss", "poisson")

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[ed][+-]?\d+)?)|(?P<name>[a-z_][\w.$%@]*(?:\[\d+\])?)"
    r"|(?P<sign>->|[-+*/^(),]))",
    re.IGNORECASE,
)


class Names(Protocol):
    """What an expression asks for."""

    def variable(self, name: str) -> float:
        """The value of a variable."""

    def attribute(self, owner: str, name: str) -> float:
        """The value of `owner->name`."""

    def work(self, steps: int = 1) -> None:
        """Count the work that a file asks for."""


Evaluate = Callable[[Names], float]


class Undetermined(LatticeError):
    """What the file alone does not determine: a result of MAD-X, or a random number."""


def compiled(text: str) -> Evaluate:
    """An expression, to be evaluated with the names of a file.

    Raises:
        LatticeError: it is no expression.
    """
    return _Parser(text).whole()


def _quotient(a: float, b: float) -> float:
    return a / b if b else 0.0  # as MAD-X has it


OPERATIONS: dict[str, tuple[int, Callable[[float, float], float]]] = {
    "+": (1, operator.add), "-": (1, operator.sub), "*": (2, operator.mul), "/": (2, _quotient),
    "^": (3, math.pow),
}  # fmt: skip
"""How tightly they bind, and what they do; each from the left, as in MAD-X."""
SIGNED = 2
"""A sign binds more tightly than this, and less than a power."""


def _binary(sign: str, left: Evaluate, right: Evaluate) -> Evaluate:
    operation = OPERATIONS[sign][1]
    return lambda names: operation(left(names), right(names))


class _Parser:
    """Operator precedence."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens: list[tuple[str, str]] = []
        at = 0
        bare = text.rstrip()
        while at < len(bare):
            match = _TOKEN.match(bare, at)
            if match is None:
                raise self._error()
            kind = str(match.lastgroup)
            self._tokens.append((kind, match[kind].lower()))
            at = match.end()
        self._at = 0
        self._depth = 0

    def _error(self) -> LatticeError:
        return LatticeError(f"'{self._text[:60].strip()}' is no expression")

    def _next(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else ""

    def _take(self, *signs: str) -> str:
        if self._next() in signs and self._tokens[self._at][0] == "sign":
            self._at += 1
            return self._tokens[self._at - 1][1]
        return ""

    def whole(self) -> Evaluate:
        value = self._expression()
        if self._at < len(self._tokens):
            raise self._error()
        return value

    def _expression(self, level: int = 0) -> Evaluate:
        """What is bound together more tightly than a level."""
        sign = self._take("+", "-")
        if sign and (level or self._next() in ("+", "-")):
            raise LatticeError(
                f"'{self._text[:60].strip()}' has two signs in a row, which MAD-X does not read; "
                "use brackets"
            )
        left = self._chain(self._atom(), max(level, SIGNED))
        return self._chain((lambda names: -left(names)) if sign == "-" else left, level)

    def _chain(self, left: Evaluate, level: int) -> Evaluate:
        """What operations make of it that bind more tightly than a level, from the left."""
        while OPERATIONS.get(self._next(), (0,))[0] > level:
            sign = self._take(*OPERATIONS)
            left = _binary(sign, left, self._expression(OPERATIONS[sign][0]))
        return left

    def _bracket(self) -> Evaluate:
        self._depth += 1
        if self._depth > DEEPEST:
            raise LatticeError(f"'{self._text[:40]}' has more than {DEEPEST} nested brackets")
        inner = self._expression()
        self._depth -= 1
        return inner

    def _atom(self) -> Evaluate:
        if self._at >= len(self._tokens):
            raise self._error()
        kind, word = self._tokens[self._at]
        self._at += 1
        if kind == "number":
            number = float(word.replace("d", "e"))
            if not math.isfinite(number):
                raise LatticeError(f"'{word[:20]}' is too large for a number")
            return lambda names: number
        if kind == "sign":
            if word != "(":
                raise self._error()
            inner = self._bracket()
            if not self._take(")"):
                raise self._error()
            return inner
        if self._take("->"):
            attribute = self._next()
            self._at += 1
            return lambda names: names.attribute(word, attribute)
        if self._take("("):
            return self._call(word)
        return lambda names: names.variable(word)

    def _call(self, word: str) -> Evaluate:
        arguments = []
        while not self._take(")"):
            arguments.append(self._bracket())
            if not self._take(","):
                if not self._take(")"):
                    raise self._error()
                break

        def value(names: Names) -> float:  # what nothing asks for may be anything
            names.work()
            if word in RANDOM:
                raise Undetermined(f"{word.upper()}() is random; write its value")
            if word == "table":
                raise Undetermined("TABLE() reads a result of MAD-X; write its value")
            if word not in FUNCTIONS:
                raise LatticeError(f"no function {word.upper()}() is known")
            function = FUNCTIONS[word]
            return float(function(*(argument(names) for argument in arguments)))

        return value


LOGICAL = re.compile(r"(&&|\|\|)")


def holds(condition: str, names: Names) -> bool:
    """Whether a condition of IF or WHILE holds: one comparison, or two joined by && or ||.

    As in MAD-X, what stands behind the first of several && and || is false.
    """
    first, *rest = LOGICAL.split(condition)
    left = _comparison(first, names)
    if not rest:
        return left
    right = len(rest) == 2 and _comparison(rest[1], names)
    return left and right if rest[0] == "&&" else left or right


def _comparison(text: str, names: Names) -> bool:
    match = re.fullmatch(r"(.*?)(<>|<=|>=|==|<|(?<!-)>)(.*)", text, re.DOTALL)
    if match is None:
        return False  # MAD-X takes a condition without a comparison for false
    left, right = compiled(match[1])(names), compiled(match[3])(names)
    return {
        "<": left < right, ">": left > right, "<=": left <= right, ">=": left >= right,
        "==": left == right, "<>": left != right,
    }[match[2]]  # fmt: skip


@dataclass(frozen=True)
class Statement:
    """Of a file: its text with blanks folded, the line in which it begins, and whether it ends."""

    text: str
    line: int
    ended: bool = True


_BLOCK = re.compile(r"(?:if|while|elseif)\s*\(|else\b|[\w.]+\s*(?:\([^)]*\))?\s*:\s*macro\b", re.I)


_SPECIAL = re.compile(r"//|/\*|[!\"';{}&\n]")


def statements(text: str) -> Iterator[Statement]:
    """The statements of a text; one with a block, as IF and MACRO, holds all of it.

    Raises:
        LatticeError: a statement, a brace or a quotation that does not end.
    """
    buffer: list[str] = []
    line = begin = 1
    depth = at = 0

    def statement(ended: bool = True) -> Iterator[Statement]:
        bare = re.sub(r":\s+=", ":=", " ".join("".join(buffer).split()))
        buffer.clear()
        if bare:
            yield Statement(bare, begin, ended)

    while at < len(text):
        match = _SPECIAL.search(text, at)
        stop = match.start() if match else len(text)
        if text[at:stop].strip() and not buffer:
            begin = line
        if buffer or text[at:stop].strip():
            buffer.append(text[at:stop] if buffer else text[at:stop].lstrip())
        if match is None:
            break
        sign, at = match[0], match.end()
        if sign in ("!", "//"):
            at = _find(text, "\n", at)
        elif sign == "/*":
            stop = _find(text, "*/", at)
            line += text.count("\n", at, stop)
            at = stop + 2
        elif sign in ('"', "'"):
            stop = text.find(sign, at)
            apostrophe = sign == "'" and (stop < 0 or (buffer and buffer[-1][-1:].isalnum()))
            if stop < 0 and not apostrophe:
                raise LatticeError(f"the quotation that begins in line {line} does not end")
            begin = begin if buffer else line
            stop = at if apostrophe else stop + 1
            buffer.append(text[match.start() : stop].replace("\n", ""))
            line += text.count("\n", at, stop)
            at = stop
        elif sign == "\n":  # is no blank: MAD-X's SAVE breaks lines within words and numbers
            line += 1
            if buffer and line - begin > LONGEST_STATEMENT:
                raise LatticeError(
                    f"no ';' ends the statement of line {begin} within {LONGEST_STATEMENT} lines"
                )
        elif sign == ";" and depth == 0:
            yield from statement()
        elif sign == "&" and depth == 0:
            buffer.append(sign if _BLOCK.match("".join(buffer)) else " ")  # MAD-8's continuation
        else:
            depth += (sign == "{") - (sign == "}")
            if depth < 0:
                raise LatticeError(f"line {line} closes a brace that is not open")
            buffer.append(sign)
            if sign == "}" and depth == 0 and _BLOCK.match("".join(buffer)):
                yield from statement()
    if depth:
        raise LatticeError(f"a brace that opens in line {begin} or later does not close")
    yield from statement(ended=False)


def _find(text: str, what: str, at: int) -> int:
    found = text.find(what, at)
    return len(text) if found < 0 else found


def split(text: str, separator: str = ",") -> list[str]:
    """Items between separators that stand in no bracket and no quotation."""
    items, depth, quote, begin = list[str](), 0, "", 0
    for at, sign in enumerate(text):
        if quote:
            quote = "" if sign == quote else quote
        elif sign in "\"'" and not (sign == "'" and at and text[at - 1].isalnum()):
            quote = sign
        elif sign in "({":
            depth += 1
        elif sign in ")}":
            depth -= 1
            if depth < 0:
                raise LatticeError("a bracket is closed that is not open")
        elif sign == separator and depth == 0:
            items.append(text[begin:at].strip())
            begin = at + 1
    if depth:
        raise LatticeError("a bracket is left open; close it")
    items.append(text[begin:].strip())
    return items


@dataclass(frozen=True)
class Given:
    """The text of an attribute, and whether it is worked out anew each time (`:=`).

    `bare`: the attribute stands without a value.
    """

    text: str
    deferred: bool = False
    bare: bool = False


_ITEM = re.compile(r"([\w.]+)\s*(:?=)\s*(.*)", re.DOTALL)


def attributes(items: Sequence[str]) -> dict[str, Given]:
    """Attributes by lower-case name; `-echo` is 0, `echo` is 1."""
    found: dict[str, Given] = {}
    for item in items:
        match = _ITEM.fullmatch(item)
        if match:
            found[match[1].lower()] = Given(match[3], match[2] == ":=")
        elif item:
            off = item.startswith("-")
            found[item.lstrip("-+ ").lower()] = Given("0" if off else "1", bare=True)
    return found


def unquoted(text: str) -> str:
    """A word or a text without its quotation marks."""
    bare = text.strip()
    if len(bare) > 1 and bare[0] in "\"'" and bare[-1] == bare[0]:
        return bare[1:-1]
    return bare


def evaluated(given: Given) -> Callable[[Names], float | tuple[float, ...]]:
    """What an attribute is worth: a number, or the numbers of `{a, b}`."""
    text = given.text.strip()
    items = None
    if text[:1] == "{" and text[-1:] == "}":
        items = [item for item in split(text[1:-1]) if item]
    elif text[:1] == "(" and len(split(text)) == 1 and text[-1:] == ")" and _encloses(text):
        items = split(text[1:-1])
        items = items if len(items) > 1 else None
    if items is None:
        return compiled(text)
    numbers = [compiled(item) for item in items]
    return lambda names: tuple(number(names) for number in numbers)


def _encloses(text: str) -> bool:
    """Whether the first bracket closes with the last sign."""
    depth = 0
    for at, sign in enumerate(text):
        depth += (sign in "({") - (sign in ")}")
        if depth == 0:
            return at == len(text) - 1
    return False
