"""MATLAB code of a lattice, worked out from its tree: text that a file holds is never run.

It is written as Python's syntax, whose tree `Arithmetic` is of, so that brackets show what they
are: `x(2)` is `x[2]`, `x{2}` is `x.cell[2]`, `(a)` is `own[a]`, `[a; b]` is `matrix[row[a],
row[b]]`, `x'` is `x.T`. Known are numbers, texts, matrices, cells, structures, ranges and their
parts, functions of the file, `if`, `switch`, `for`, `return`, and functions that are given.

A variable that cannot be worked out has no value; the reason is raised where the value is needed,
since lattice functions also print and calculate what no element depends on. Numbers are `float`,
matrices arrays of two axes, cells lists, structures dictionaries; in `[ ]`, a structure is a cell.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tmlattice.errors import LatticeError, plain
from tmlattice.lattice.expressions import MOST_ITEMS, Arithmetic

Scope = dict[str, Any]
FAILURES = (ValueError, TypeError, LookupError, ArithmeticError, MemoryError)
"""Of a statement that cannot be worked out."""

_TOKEN = re.compile(
    r"(?P<space>[ \t\f]+|\.\.\.[^\n]*(\n|$)|%[^\n]*)|(?P<line>\n)|(?P<name>[A-Za-z]\w*)"
    r"|(?P<number>(\d+(\.(?![*/\\^'.])\d*)?|\.\d+)([eEdD][+-]?\d+)?)"
    r"|(?P<sign>\.[*/^']|[=~<>!]=|&&|\|\||[-+*/^<>=~!&|:;,()\[\]{}.'\"])|(?P<other>.)"
)
_BLOCK = re.compile(r"^[ \t]*%\{[ \t]*$.*?^[ \t]*%\}[ \t]*$", re.DOTALL | re.MULTILINE)
_TEXT = {sign: re.compile(rf"{sign}((?:[^{sign}\n]|{sign}{sign})*){sign}") for sign in "'\""}
_PYTHON = {"*": "@", ".*": "*", "/": "//", "./": "/", "^": "**", ".^": "**", "~=": "!=",
           "&&": " and ", "&": " and ", "||": " or ", "|": " or ", "!": "~", ".'": ".T",
           "'": ".T"}  # fmt: skip
_OPEN, _CLOSE = ("(", "[", "{"), (")", "]", "}")
_OPERATIONS: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Pow: operator.pow,
    ast.MatMult: operator.mul, ast.Div: operator.truediv, ast.FloorDiv: operator.truediv,
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le,
    ast.Gt: operator.gt, ast.GtE: operator.ge,
}  # fmt: skip


class Token(NamedTuple):
    """A word, number, text or sign; whether there is space before it; its line."""

    kind: str
    value: str
    apart: bool
    line: int

    def ends_value(self) -> bool:
        """Whether a value may end with this."""
        word = self.kind == "name" and self.value in ("case", "if", "elseif", "switch")
        return not word and (self.kind != "sign" or self.value in (*_CLOSE, "'", ".'"))


class Reason(ValueError):
    """Why a variable has no value: the statement that it should have been of."""


def statements_of(text: str) -> list[list[Token]]:
    """The words of each statement.

    Raises:
        LatticeError: a text that does not end.
    """
    found: list[list[Token]] = [[]]
    depth: list[str] = []
    at, line, apart = 0, 1, False
    while at < len(text):
        match = _TOKEN.match(text, at)
        assert match is not None
        kind, value, own = str(match.lastgroup), match[0], found[-1]
        rows = depth and depth[-1] != "("
        transposes = value == "'" and own and own[-1].ends_value() and not (rows and apart)
        if value in _TEXT and not transposes:
            match = _TEXT[value].match(text, at)
            if match is None:
                raise LatticeError(f"{where_in(text, line)}: a text does not end")
            own.append(Token("text", match[1].replace(2 * value, value), apart, line))
        elif not depth and (kind == "line" or value in (";", ",")):
            found.append([])
        elif kind == "line" and rows:
            own.append(Token("sign", ";", apart, line))
        elif kind not in ("space", "line"):
            own.append(Token(kind, value, apart, line))
            depth += [value] if value in _OPEN else []
            del depth[len(depth) - (value in _CLOSE) :]
        apart = kind in ("space", "line")
        line += value.count("\n")
        at = match.end()
    return [statement for statement in found if statement]


def _closing(tokens: Sequence[Token]) -> int:
    """Where the bracket closes that opens with the first token."""
    depth = 0
    for place, token in enumerate(tokens):
        if token.kind == "sign":
            depth += (token.value in _OPEN) - (token.value in _CLOSE)
        if not depth:
            return place
    raise LatticeError("a bracket is left open; close it")


def expression(tokens: Sequence[Token], line: int) -> str:
    """Python's syntax of an expression, its lines those of the file from this one on."""
    if any(token.kind == "other" for token in tokens):
        return "unread"
    found: list[str] = []
    depth: list[str] = []
    for k, token in enumerate(tokens):
        found.append("\n" * (token.line - line))
        line = token.line
        before = tokens[k - 1] if k else None
        after = tokens[k + 1] if k + 1 < len(tokens) else None
        behind = before is not None and before.ends_value()
        sign = token.value if token.kind == "sign" else ""
        if behind and token.apart and depth and depth[-1] != "(":  # the next item of a matrix
            begins = sign in ("+", "-") and after is not None and not after.apart
            if not sign or sign in (*_OPEN, "~") or begins:
                found.append(",")
                behind = False
        field = before is not None and before.value == "." and before.kind == "sign"
        if sign in _OPEN:
            depth.append(sign)
            if sign == "(":
                found.append("[" if behind else "field[" if field else "own[")
                found += ["()"] if after is not None and after.value == ")" else []
            else:
                found.append(".cell[" if behind and sign == "{" else f"{_NAMES[sign]}[row[")
                depth[-1] = "(" if behind and sign == "{" else sign
                found += ["()"] if after is not None and after.value in "]};" else []
        elif sign in _CLOSE:
            if not depth:
                raise LatticeError("a bracket closes that is not open")
            found.append("]" if depth.pop() == "(" else "]]")
        elif sign == ";" and depth:
            empty = after is not None and after.value in ("]", "}", ";") and after.kind == "sign"
            found.append("],row[" + ("()" if empty else ""))
        elif token.kind == "number":
            number = repr(float(token.value.lower().replace("d", "e")))
            found.append(number.replace("inf", "1e999"))
        elif token.kind == "text":
            found.append(repr(token.value))
        else:
            name = token.kind == "name" and (field or token.value != "end")
            found.append(f"{token.value}_" if name else _PYTHON.get(token.value, token.value))
    if depth:
        raise LatticeError("a bracket is left open; close it")
    return "".join(found)


_NAMES = {"[": "matrix", "{": "cells"}


def tree_of(text: str) -> ast.Module:
    """The tree of a file, whose lines are the file's.

    Raises:
        LatticeError: a statement that is not read.
    """
    text = _BLOCK.sub(lambda match: "\n" * match[0].count("\n"), text.replace("\r", ""))
    code: list[tuple[int, str]] = []
    blocks: list[str] = []
    rest = statements_of(text)[::-1]
    while rest:
        tokens = rest.pop()
        line, word = tokens[0].line, tokens[0].value if tokens[0].kind == "name" else ""
        own = tokens[1:]
        try:
            if word in ("if", "elseif") and own and own[0].value == "(":
                close = _closing(own) + 1
                if own[close:] and own[close].kind == "name":  # if (a) b = 1; end
                    rest.append(own[close:])
                    own = own[:close]
            lines = _lines(word, own, tokens, len(blocks))
        except (LatticeError, IndexError) as error:
            why = "it is not read" if isinstance(error, IndexError) else error
            raise LatticeError(f"{where_in(text, line)}: {why}") from error
        if word in ("end", "else", "elseif", "case", "otherwise") and not blocks:
            raise LatticeError(f"{where_in(text, line)}: it closes nothing")
        inner = len(blocks) - (word in ("else", "elseif", "case", "otherwise"))
        for own_line in lines:
            first, *more = own_line.split("\n")
            code += [(line, " " * inner + first), *enumerate(more, line + 1)]
        if word in ("if", "switch", "for", "function"):
            blocks.append(word)
        elif word == "end":
            blocks.pop()
    if set(blocks) - {"function"}:
        raise LatticeError(f"'{blocks[-1]}' has no end")
    try:
        tree = ast.parse("\n".join(own for _, own in code))
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        at = getattr(error, "lineno", None) or 1
        raise LatticeError(f"{where_in(text, code[at - 1][0])}: it is not read") from error
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt | ast.expr):
            node.lineno = code[node.lineno - 1][0]
    return tree


def where_in(text: str, line: int) -> str:
    """A statement, for messages."""
    own = " ".join(text.split("\n")[line - 1].split())
    return f"line {line}, '{plain(own, 80)}'"


def _lines(word: str, own: list[Token], tokens: list[Token], depth: int) -> list[str]:
    """Python's syntax of a statement."""
    equals = _equals(own)
    line = tokens[0].line
    value = partial(expression, line=line)
    match word:
        case "function":
            own = own if equals is None else own[equals + 1 :]
            names = [t.value for t in tokens[1:] if t.kind == "name"]
            out = names[0] if equals is not None else ""
            inputs = [f"{t.value}_" for t in own[1:] if t.kind == "name"]
            return [f"def {own[0].value}_({','.join(inputs)}) -> {out!r}:", " pass"]
        case "if" | "elseif":
            return [f"{word.replace('else', 'el')} own[{value(own)}]:", " pass"]
        case "switch":
            return [f"switch{depth} = own[{value(own)}]", "if own[False]:", " pass"]
        case "case":
            return [f"elif same[switch{depth - 1}, {value(own)}]:", " pass"]
        case "else" | "otherwise":
            return ["else:", " pass"]
        case "for":
            own = own[1:-1] if own and own[0].value == "(" else own
            equals = _equals(own) or 0
            return [f"for {own[0].value}_ in own[{value(own[equals + 1 :])}]:", " pass"]
        case "global" | "persistent":
            return [f"global {','.join(f'{t.value}_' for t in own)}"]
        case "return":
            return ["return"]
        case "end":
            return []
        case "while" | "parfor" | "try" | "break" | "continue" | "classdef":
            raise LatticeError(f"'{word}' is not read; write the ring with AT's atwritem")
    if own and word and own[0].kind in ("name", "number") and own[0].apart:
        return [f"own[{word}_[()]]"]  # a command and its words
    if (at := _equals(tokens)) is None:
        return [f"own[{value(tokens)}]"]
    left = tokens[:at]
    if left[0].value == "[":
        left = [t._replace(kind="name", value="ignored") if t.value == "~" else t for t in left]
        target = value(left).removeprefix("matrix[row[").removesuffix("]]") + ","
    else:
        target = value(left)
    return [f"{target} = own[{value(tokens[at + 1 :])}]"]


def _equals(tokens: Iterable[Token]) -> int | None:
    """Where the first `=` is that stands in no bracket."""
    depth = 0
    for k, token in enumerate(tokens):
        sign = token.value if token.kind == "sign" else ""
        depth += (sign in _OPEN) - (sign in _CLOSE)
        if sign == "=" and not depth:
            return k
    return None


class Code(Arithmetic):
    """What the variables of a file are worth.

    Args:
        text: of the file.
        functions: that it may call, by name.
        silent: names of functions that change no variable.

    Raises:
        LatticeError: a statement that is not read.
    """

    def __init__(
        self, text: str, functions: Mapping[str, Callable[..., Any]], silent: Collection[str]
    ) -> None:
        super().__init__(())
        self._text, self._given, self._silent = text.replace("\r", ""), functions, silent
        self._tree = tree_of(self._text)
        walked = ast.walk(self._tree)
        self._own = {node.name[:-1]: node for node in walked if isinstance(node, ast.FunctionDef)}
        self._shared: Scope = {}
        self._ends: list[float] = []

    def run(self) -> tuple[Scope, str]:
        """The variables after the file's statements, or after its first function, and the name of
        that function's result.

        Raises:
            LatticeError: a statement cannot be worked out that may change any variable.
        """
        scope: Scope = {"nargin": 0.0, "nargout": 1.0, "varargin": []}
        body, output = self._tree.body, ""
        if body and isinstance(body[0], ast.FunctionDef):
            output, body = _result_of(body[0]), body[0].body
        try:
            with np.errstate(all="ignore"):
                self._run(body, scope)
        except RecursionError:
            raise LatticeError("a function of the file calls itself endlessly") from None
        except Reason as error:
            raise LatticeError(str(error)) from error
        return self._shared | scope, output

    def _run(self, body: Iterable[ast.stmt], scope: Scope) -> bool:
        """Whether the function goes on behind these statements."""
        for node in body:
            self.work()
            try:
                if not self._statement(node, scope):
                    return False
            except FAILURES as error:
                raise self._reason(error, node) from error
        return True

    def _reason(self, error: Exception, node: ast.stmt | ast.expr) -> Reason:
        if isinstance(error, Reason):
            return error
        why = plain(str(error), 120) or "it cannot be worked out"
        return Reason(f"{where_in(self._text, node.lineno)}: {why}")

    def _statement(self, node: ast.stmt, scope: Scope) -> bool:
        """Whether the function goes on."""
        match node:
            case ast.Assign(targets=[target]):
                value: Any
                try:
                    value = self._of(node.value, (scope,))
                except FAILURES as error:
                    value = self._reason(error, node)
                for own in target.elts if isinstance(target, ast.Tuple) else [target]:
                    self._assign(own, value, node, scope)
                    value = self._reason(ValueError("only the first result is read"), node)
            case ast.Expr(value=ast.Subscript(slice=inner)):
                called = inner.value if isinstance(inner, ast.Subscript) else inner
                name = called.id[:-1] if isinstance(called, ast.Name) else ""
                if name not in self._silent:
                    value = self._of(inner, (scope,))
                    if name == "buildlat":
                        self._shared["THERING"] = value
            case ast.If(test=test, body=body, orelse=other):
                return self._run(body if _is_true(self._of(test, (scope,))) else other, scope)
            case ast.For(target=ast.Name(id=name)):
                values = self._of(node.iter, (scope,))
                for item in values if isinstance(values, list) else np.atleast_2d(values).T:
                    scope[name[:-1]] = [item] if isinstance(values, list) else _simple(item)
                    if not self._run(node.body, scope):
                        return False
            case ast.Return():
                return False
            case ast.Global():
                for name in node.names:
                    self._shared.setdefault(name[:-1], scope.pop(name[:-1], np.zeros((0, 0))))
        return True

    def _assign(self, target: ast.expr, value: Any, node: ast.stmt, scope: Scope) -> None:
        path: list[tuple[ast.expr, str, Any]] = []
        while not isinstance(target, ast.Name):
            kind, inner, place = _part_of(target)
            path.insert(0, (inner, kind, place))
            target = inner
        name = target.id.removesuffix("_")
        own = self._shared if name in self._shared else scope
        try:
            steps = [(kind, self._places(place, inner, scope)) for inner, kind, place in path]
            if not isinstance(value, Reason):
                value = _changed(_known(own.get(name)), steps, value, self._room)
        except FAILURES as error:
            value = self._reason(error, node)
        own[name] = value

    def _room(self, count: int) -> None:
        if count > MOST_ITEMS:
            raise LatticeError(f"a variable has {count:g} items; no ring has as many")
        self.work(1 + count // 100)

    def _places(self, place: Any, inner: ast.expr, scope: Mapping[str, Any]) -> Any:
        """Places in a variable, of which `end` is the last."""
        if isinstance(place, str):
            return [place]
        count = 0
        if any(isinstance(node, ast.Name) and node.id == "end" for node in ast.walk(place)):
            count = _count(self._of(inner, (scope,)))
        self._ends.append(float(count))
        found = self._all(place, scope)
        self._ends.pop()
        return found

    def _all(self, node: ast.AST, scope: Mapping[str, Any]) -> list[Any]:
        """Values of arguments or items; `x{:}` is several."""
        found: list[Any] = []
        for own in node.elts if isinstance(node, ast.Tuple) else [node]:
            if isinstance(own, ast.Slice) and own.lower is None:
                found.append(slice(None))
            else:
                value = self._of(own, (scope,))
                found += value if isinstance(value, _Several) else [value]
        return found

    def _of(self, node: ast.AST, names: tuple[Mapping[str, Any], ...]) -> Any:
        self.work()
        (scope,) = names
        match node:
            case ast.Constant():
                return node.value
            case ast.Name(id="end"):
                return self._ends[-1]
            case ast.Name(id=name) if name != "unread":
                return self._named(name, [], scope)
            case ast.Slice(lower=first, upper=middle, step=last):
                parts = [float(self._of(part, names)) for part in (first, middle, last) if part]
                step = parts.pop(1) if len(parts) == 3 else 1.0
                count = max(math.floor((parts[1] - parts[0]) / step + 1e-10) + 1, 0)
                self._room(count)
                return _simple(parts[0] + step * np.arange(count))
            case ast.Subscript(value=ast.Name(id="own"), slice=inner):
                return self._of(inner, names)
            case ast.Subscript(value=ast.Name(id="same"), slice=ast.Tuple(elts=[value, case])):
                one, known = self._of(value, names), self._of(case, names)
                known = known if isinstance(known, list) else [known]
                return any(type(one) is type(k) and bool(np.all(one == k)) for k in known)
            case ast.Subscript(value=ast.Name(id="matrix" | "cells" as kind), slice=rows):
                each = rows.elts if isinstance(rows, ast.Tuple) else [rows]
                items = [self._all(row.slice, scope) for row in each]  # type: ignore[attr-defined]
                if kind == "cells":
                    return [item for row in items for item in row]
                return _joined([_joined(row, 1, self._room) for row in items], 0, self._room)
            case ast.Attribute(value=inner, attr="T"):
                value = self._of(inner, names)
                return _simple(value.T) if isinstance(value, np.ndarray) else value
            case ast.Subscript(value=ast.Name(id=name), slice=place) if self._free(name, scope):
                try:
                    return self._named(name, self._all(place, scope), scope)
                except FAILURES as error:
                    raise self._reason(error, node) from error
            case ast.Subscript() | ast.Attribute():
                how, inner, place = _part_of(node)
                whole = self._of(inner, names)
                return _part(how, whole, self._places(place, inner, scope), self._room)
            case ast.UnaryOp(op=op, operand=inner):
                value = _number(self._of(inner, names))
                if isinstance(op, ast.Invert):
                    return np.logical_not(value)
                return -value if isinstance(op, ast.USub) else value
            case ast.BoolOp(op=op, values=values):
                each_true = (_is_true(self._of(value, names)) for value in values)
                return all(each_true) if isinstance(op, ast.And) else any(each_true)
            case ast.BinOp(op=ast.Pow(), right=ast.BinOp(op=ast.Pow())):
                raise ValueError("a power of a power needs brackets")  # MATLAB's order is another
            case ast.BinOp(op=op, left=left, right=right):
                return self._two(type(op), self._of(left, names), self._of(right, names))
            case ast.Compare(ops=[op], left=left, comparators=[right]):
                return self._two(type(op), self._of(left, names), self._of(right, names))
        raise ValueError("it is not read")

    def _two(self, kind: type[ast.AST], left: Any, right: Any) -> Any:
        if isinstance(left, str) and isinstance(right, str) and kind in (ast.Eq, ast.NotEq):
            return (left == right) == (kind is ast.Eq)
        left, right = _number(left), _number(right)
        if kind is ast.FloorDiv and np.ndim(right):
            raise ValueError("nothing is divided by a matrix")
        product = kind is ast.MatMult and np.ndim(left) and np.ndim(right)
        self.work(np.size(left) if product else 1)
        rows, columns = np.maximum(np.atleast_2d(left).shape, np.atleast_2d(right).shape)
        self._room(int(rows) * int(columns))
        value = left @ right if product else _OPERATIONS[kind](left, right)
        if np.iscomplexobj(value):
            raise ValueError("a number is complex")
        return _simple(value) if np.ndim(value) else value

    def _free(self, name: str, scope: Mapping[str, Any]) -> bool:
        return name.removesuffix("_") not in scope and name.removesuffix("_") not in self._shared

    def _named(self, name: str, given: list[Any], scope: Mapping[str, Any]) -> Any:
        """A variable, or what a function gives."""
        free, name = self._free(name, scope), name.removesuffix("_")
        if not free:
            return _known(scope[name] if name in scope else self._shared[name])
        if (own := self._own.get(name)) is not None:
            names = [argument.arg[:-1] for argument in own.args.args]
            inner: Scope = dict(zip(names, given, strict=False))
            inner |= {"nargin": float(len(given)), "nargout": 1.0}
            if names[-1:] == ["varargin"]:
                inner["varargin"] = given[len(names) - 1 :]
            self._run(own.body, inner)
            return _known(inner.get(_result_of(own), math.nan))
        if name not in self._given:
            raise ValueError(f"'{name}' is no variable, and no function that is read")
        value = self._given[name](*given)
        self._room(_count(value))
        return value


class _Several(list[Any]):
    """Items of a cell that stand for themselves, as `x{:}`."""


def _result_of(node: ast.FunctionDef) -> str:
    return str(node.returns.value) if isinstance(node.returns, ast.Constant) else ""


def _known(value: Any) -> Any:
    if isinstance(value, Reason):
        raise value
    return value


def _part_of(node: ast.AST) -> tuple[str, ast.expr, Any]:
    """How a part is taken (`field`, `cell`, `call`), of what, and which."""
    match node:
        case ast.Attribute(value=inner, attr=name):
            return "field", inner, name[:-1]
        case ast.Subscript(value=ast.Attribute(value=inner, attr="cell" | "field" as kind)):
            return kind, inner, node.slice
        case ast.Subscript(value=inner):
            return "call", inner, node.slice
    raise ValueError("nothing can be assigned to this")


def _part(kind: str, whole: Any, where: list[Any], room: Callable[[int], None]) -> Any:
    if kind == "field":
        whole = whole[0] if isinstance(whole, list) and len(whole) == 1 else whole
        if not isinstance(whole, dict) or where[0] not in whole:
            raise ValueError(f"there is no field '{where[0]}'")
        return whole[where[0]]
    if isinstance(whole, dict):
        whole, kind = [whole], "cell"
    place = _only(where)
    if isinstance(whole, list):
        found = [whole[k] for k in indices(place, len(whole))]
        room(len(found))
        if kind == "call":
            return found
        return found[0] if not isinstance(place, slice) and np.size(place) == 1 else _Several(found)
    flat = _vector(whole)
    if kind == "cell" or flat is None:
        raise ValueError("only cells and vectors have places here")
    part = flat[indices(place, flat.size)]
    return _simple(part[:, None] if np.shape(whole)[1:] == (1,) else part)


def _changed(
    old: Any, path: Sequence[tuple[str, list[Any]]], value: Any, room: Callable[[int], None]
) -> Any:
    """A copy of a value with another part."""
    if not path:
        return value
    (kind, where), *rest = path
    empty = old is None or not _count(old)
    if kind == "field":
        own: Any = {} if empty else old
        if not isinstance(own, dict):
            raise ValueError("only a structure has fields")
        return own | {where[0]: _changed(own.get(where[0]), rest, value, room)}
    if isinstance(old, list) or (empty and (kind == "cell" or isinstance(value, list | dict))):
        new = [] if empty else list(old)
        places = indices(_only(where), len(new))
        room(max([len(new), *places]))
        if kind == "call" and not rest and not _count(value):  # x(2) = [] takes it out
            return [item for k, item in enumerate(new) if k not in set(places)]
        new += [np.zeros((0, 0))] * (max(places, default=-1) + 1 - len(new))
        several = kind == "call" and isinstance(value, list) and not rest
        values = value if several else [value] * len(places)
        for place, item in zip(places, values, strict=True):
            new[place] = _changed(new[place], rest, item, room)
        return new
    flat = np.zeros(0) if empty else _vector(old)
    if rest or kind == "cell" or flat is None:
        raise ValueError("this part cannot be assigned to")
    places = indices(_only(where), flat.size)
    room(max(places, default=0))
    flat = np.pad(flat, (0, max(0, max(places, default=-1) + 1 - flat.size))).astype(float)
    flat[places] = np.ravel(value)
    return _simple(flat[:, None] if np.shape(old)[1:] == (1,) else flat)


def _vector(value: Any) -> Any:
    """The numbers of one row or column; None: of a matrix, or no numbers."""
    if isinstance(value, str | list | dict) or min(np.atleast_2d(value).shape) > 1:
        return None
    return np.ravel(value)


def indices(place: Any, size: int) -> list[int]:
    """Places from 0."""
    if isinstance(place, slice):
        return list(range(size))
    array = np.ravel(_number(place))
    if array.dtype == bool:
        return [int(k) for k in np.flatnonzero(array)]
    if array.size and (not (array >= 1).all() or (array != np.round(array)).any()):
        raise ValueError(f"there is no place {array[0]:g}")
    return [int(k) - 1 for k in array]


def _only(where: list[Any]) -> Any:
    """The place in what has one axis: `(k)`, `(k, 1)` and `(1, k)`."""
    if len(where) not in (1, 2):
        raise ValueError("a place is along one axis")
    one = len(where) == 2 and not isinstance(where[1], slice | str) and np.size(where[1]) == 1
    return where[0] if one and float(where[1]) == 1.0 else where[-1]


def _count(value: Any) -> int:
    return len(value) if isinstance(value, list | str) else int(np.size(value))


def _simple(array: Any) -> Any:
    """A number where it is one, else a matrix."""
    array = np.atleast_2d(array)
    return array.item() if array.size == 1 else array


def _number(value: Any) -> Any:
    if not isinstance(value, bool | float | np.ndarray | np.bool_):
        raise ValueError("only numbers are calculated with")
    return value


def _is_true(value: Any) -> bool:
    if isinstance(value, str):
        return bool(value)
    if np.size(_number(value)) > 1:
        raise ValueError("a condition has one value")
    return bool(np.size(value)) and bool(np.all(value))


def _joined(parts: list[Any], axis: int, room: Callable[[int], None]) -> Any:
    """`[ ]` of values: a cell where one of them is a cell or structure, else a text or a matrix."""
    room(sum(_count(part) for part in parts))
    if any(isinstance(part, list | dict) for part in parts):
        whole = [part if isinstance(part, list) else [part] for part in parts if _count(part)]
        return [item for part in whole for item in part]
    if any(isinstance(part, str) for part in parts):
        if not all(isinstance(part, str) or not np.size(part) for part in parts):
            raise ValueError("a text and a number are joined")
        return "".join(part for part in parts if isinstance(part, str))
    arrays = [np.atleast_2d(_number(part)) for part in parts if np.size(part)]
    return _simple(np.concatenate(arrays, axis=axis)) if arrays else np.zeros((0, 0))
