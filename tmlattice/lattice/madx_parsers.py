"""AT's parsers of MAD-X and elegant, with nothing of a file run and with an end to their work.

AT's parsers evaluate expressions as Python and follow whatever stands in a statement. These ones
calculate (`expressions.Arithmetic`), and refuse what AT's would not come back from: brackets that
are left open, control flow, lines of lines without end, a file that calls what is no file.
"""

import abc
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError
from tmlattice.lattice.expressions import MOST_ITEMS, Arithmetic
from tmlattice.lattice.madx_elements import more_elements

LONGEST_STATEMENT = 5000
"""Lines, comments apart: a file without its semicolons is none of MAD-X."""
MOST_FILES = 1000
MOST_BYTES = 200_000_000

_CONTROL = re.compile(r"(?:else\s*)?(?:if|while)\s*\(|elseif\b|else\s*\{|.*:\s*macro\s*=", re.I)
_QUOTED = re.compile(r'"[^"]*"')
_FUNCTIONS = (
    abs, math.sqrt, math.exp, math.log, math.log10, math.sin, math.cos, math.tan, math.asin,
    math.acos, math.atan, math.sinh, math.cosh, math.tanh, math.erf, math.erfc,
)  # fmt: skip


def parser_of(elegant: bool) -> Any:
    """An empty parser, of elegant's language or of MAD-X's."""
    import at

    kind = at.ElegantParser if elegant else at.MadxParser
    bounded: type[Any] = abc.ABCMeta("Bounded", (_Bounded, kind), {})
    parser = bounded(verbose=False) if elegant else bounded(verbose=False, **more_elements())
    if elegant:
        parser.rpn.operators.update(
            {sign: (_of_numbers(operate), 2) for sign, operate in _RPN.items()}
        )
    return parser


_RPN: dict[str, Callable[[float, float], float]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
}


def _of_numbers(operate: Callable[[float, float], float]) -> Callable[[Any, Any], float]:
    """Whole numbers of any length, and texts, would grow without end."""
    return lambda a, b: operate(float(a), float(b))


class _Zeros(dict[str, float]):
    """Has every name that is asked for."""

    def __missing__(self, name: str) -> float:
        self[name] = 0.0
        return 0.0


class _Bounded:
    """What stands before AT's parser of either language."""

    def __init__(self, **options: Any) -> None:
        from at.load.madx import sinc

        self._arithmetic = Arithmetic((*_FUNCTIONS, sinc))
        self._files = 0
        self._zeros: tuple[_Zeros, ...] = ()
        super().__init__(**options)

    # what AT's parsers are asked for; they are known at run time alone
    env: dict[str, Any]
    bases: list[Path]
    postponed: list[tuple[Any, ...]]
    _format_command: Callable[[str], str]
    _delimiter: str | None
    _linecomment: str | tuple[str, ...]

    def evaluate(self, expr: str) -> Any:
        """The value of an expression of the file."""
        names = (self, self.env, *self._zeros)
        return self._arithmetic.value(self._format_command(expr), *names)  # type: ignore[arg-type]

    @property
    def undefined(self) -> list[str]:
        """Names that the file does not define, and that were taken for 0."""
        return [name for zeros in self._zeros for name in zeros]

    def _assign_deferred(self, value: str) -> Any:
        from at.load.parser import StrParameter

        def constant(text: str) -> Any:
            try:
                return self._arithmetic.value(text, self.env)
            except LatticeError:
                raise
            except Exception:  # of names that are said later, or in the language's own words
                return StrParameter(self, text)

        parts = _list_items(value)
        return constant(value) if parts is None else tuple(map(constant, parts))

    def _statement(self, line: str) -> bool:
        bare = _QUOTED.sub('""', line)
        if "&" in bare:  # of MAD-8, where a line ends; MAD-X takes it for a blank
            line = "".join(
                part if i % 2 else part.replace("&", " ")
                for i, part in enumerate(re.split(r'("[^"]*")', line))
            )
        if _CONTROL.match(bare):
            raise LatticeError("control flow and macros are not read; write the lattice out")
        depth = 0
        for bracket in re.findall(r"[(){}]", bare):
            depth += 1 if bracket in "({" else -1
            if depth < 0:
                break
        if depth or bare.count('"') % 2:
            raise LatticeError("a bracket or a quotation mark is left open; close it")
        self._arithmetic.work(len(re.findall(r'[("]', line)) * len(line) // 10_000)
        return bool(super()._statement(line))  # type: ignore[misc]

    def _raw_command(self, *args: Any, **options: Any) -> Any:
        self._arithmetic.work(20)
        try:
            return super()._raw_command(*args, **options)  # type: ignore[misc]
        except TypeError as error:
            if "is not callable" not in str(error):
                raise
            raise LatticeError(f"no element or command '{args[1]}' is known") from error

    def parse_files(self, *names: str, **options: Any) -> None:
        """Read files; one that they call may be any regular file."""
        for name in names:
            path = (Path(self.bases[-1]) if self.bases else Path.cwd()) / name
            self._files += 1
            if not path.is_file():
                raise LatticeError(f"it calls '{name}', which is no file")
            if self._files > MOST_FILES or path.stat().st_size > MOST_BYTES:
                raise LatticeError(f"it calls '{name}': too many files, or too large ones")
            self._check_length(path)
        super().parse_files(*names, **options)  # type: ignore[misc]

    def _check_length(self, path: Path) -> None:
        """Refuse a text in which no statement ends: AT's parser joins its lines again and again."""
        lines = 0
        end = self._delimiter or "\n"
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                continued = end not in line or (end == "\n" and line.rstrip().endswith("&"))
                comment = line.lstrip().startswith(tuple(self._linecomment)) or not line.strip()
                lines = 0 if not continued else lines + (not comment)
                if lines > LONGEST_STATEMENT:
                    raise LatticeError(
                        f"'{path}' has no '{end.strip() or 'end of a statement'}' in "
                        f"{LONGEST_STATEMENT} lines"
                    )

    def _missing(self) -> set[Any]:
        """What postponed statements lack; AT's own follows definitions in a circle for ever."""
        return {command[0] for command in self.postponed}

    def _analyse(self, key: str | None) -> None:
        """AT's own prints such a circle."""

    def expand(self, key: str) -> Any:
        """AT's elements of a line or sequence. What no statement has defined by now is 0, as in
        MAD-X."""
        if self._delimiter and not self._zeros:
            self._zeros = (_Zeros(),)
        _length(self[key], {})  # type: ignore[index]
        yield from super().expand(key)  # type: ignore[misc]


def _list_items(text: str) -> list[str] | None:
    """Items of "(a, b)"; None of what is no list: "(a + b)", "(a, b) * (c)", "(a / 3) * (1 - b)".
    A list of one item is that item, which AT's elements take as well."""
    if text[:1] != "(":
        return None
    items, depth, begin = list[str](), 0, 1
    for i, sign in enumerate(text):
        depth += {"(": 1, ")": -1}.get(sign, 0)
        if depth == 0 and i < len(text) - 1:
            return None
        if (sign == "," and depth == 1) or depth == 0:
            items.append(text[begin:i])
            begin = i + 1
    return items if len(items) > 1 else None


def _length(value: Any, known: dict[int, int]) -> int:
    """Elements of a line of lines, and as many more as it has lines.

    Raises:
        LatticeError: more than any ring has.
    """
    if not isinstance(value, list | tuple) or (value and isinstance(value[0], str)):
        return 1
    if id(value) not in known:
        known[id(value)] = 1 + sum(_length(item, known) for item in value)
    if known[id(value)] > MOST_ITEMS:
        raise LatticeError("its line has more elements than any ring")
    return known[id(value)]
