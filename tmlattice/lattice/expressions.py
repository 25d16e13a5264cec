"""Expressions of a lattice file, worked out from their tree: text that a file holds is never run.

AT's readers hand expressions to Python's `eval`, from which a file reaches the whole interpreter.
An `Arithmetic` stands in its place. It knows numbers, texts, lists, names, the four operations and
powers, and calls of the functions that it is given; there is nothing else.
"""

import ast
import math
import operator
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError, plain

LONGEST = 10_000_000
"""Characters of one expression; a kick map written out has some million."""
MOST_STEPS = 2_000_000
"""Numbers and operations in all; the largest rings need some hundred thousand."""
MOST_ITEMS = 1_000_000
"""Of a repeated list; no ring has as many elements."""
_EXACT = 2**53  # larger whole numbers are taken as numbers like others, lest they grow for ever

_ONE_AT_A_TIME = Lock()

_OPERATIONS: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


class Arithmetic:
    """What expressions are worth, for as long as their work is bounded.

    Args:
        functions: what a file may call; nothing else is, whatever its name.
    """

    def __init__(self, functions: Iterable[Any]) -> None:
        self._functions = list(functions)
        self._steps = 0
        self._trees: dict[str, ast.expr] = {}

    def value(self, text: str, *names: Mapping[str, Any]) -> Any:
        """The value of an expression.

        Args:
            text: Python's syntax.
            names: what names mean; the first that has one applies.

        Raises:
            NameError: a name that none has (AT's readers come back to such a statement).
            ValueError, TypeError, SyntaxError, ArithmeticError: what cannot be worked out.
            LatticeError: more work than any ring needs.
        """
        if len(text) > LONGEST:
            raise LatticeError(f"an expression has {len(text)} characters; at most {LONGEST}")
        tree = self._trees.get(text)
        if tree is None:
            try:
                tree = ast.parse(text.strip(), mode="eval").body
            except (MemoryError, RecursionError, ValueError) as error:
                raise SyntaxError(f"'{text[:40]}' cannot be read ({error})") from error
            self._trees[text] = tree
        return self._of(tree, names)

    def work(self, steps: int = 1) -> None:
        """Count work that a file asks for.

        Raises:
            LatticeError: more than any ring needs.
        """
        self._steps += steps
        if self._steps > MOST_STEPS:
            raise LatticeError(
                "its expressions and lines ask for more work than any ring needs; write them out"
            )

    def _of(self, node: ast.AST, names: tuple[Mapping[str, Any], ...]) -> Any:
        self.work()
        match node:
            case ast.Constant(value=bool() | float() | str() | None):
                return node.value
            case ast.Constant(value=int()):
                return _bounded(node.value)
            case ast.Name():
                return _named(node.id, names)
            case ast.List():
                return [self._of(item, names) for item in node.elts]
            case ast.Tuple():
                return tuple(self._of(item, names) for item in node.elts)
            case ast.Dict():
                keys = [None if key is None else self._of(key, names) for key in node.keys]
                values = [self._of(value, names) for value in node.values]
                return dict(zip(keys, values, strict=True))
            case ast.UnaryOp(op=ast.USub()):
                return -self._of(node.operand, names)
            case ast.UnaryOp(op=ast.UAdd()):
                return +self._of(node.operand, names)
            case ast.BinOp() if type(node.op) in _OPERATIONS:
                left, right = self._of(node.left, names), self._of(node.right, names)
                return self._operate(type(node.op), left, right)
            case ast.Call(func=ast.Name(id=name)):
                return self._call(name, node, names)
            case ast.Call(func=ast.Attribute(value=ast.Name(id="np"), attr=name)):
                return self._call(name, node, names)  # numpy's numbers as it writes them
        raise ValueError(f"{type(node).__name__} is nothing that a lattice's expression may hold")

    def _operate(self, operation: type[ast.AST], left: Any, right: Any) -> Any:
        numbers = isinstance(left, int | float) and isinstance(right, int | float)
        if operation is ast.Pow:
            if not numbers:
                raise TypeError("only numbers have powers")
            return _bounded(math.pow(left, right))
        if not numbers:
            if operation not in (ast.Mult, ast.Add) or isinstance(left, str) | isinstance(
                right, str
            ):
                raise TypeError("only numbers are calculated with")
            times = next((abs(n) for n in (left, right) if isinstance(n, int | float)), 1)
            length = max(len(v) for v in (left, right) if not isinstance(v, int | float))
            if not times * max(length, 1) <= MOST_ITEMS:
                raise LatticeError(f"a line is repeated {times:g} times: no ring is as long")
        return _bounded(_OPERATIONS[operation](left, right))

    def _call(self, name: str, node: ast.Call, names: tuple[Mapping[str, Any], ...]) -> Any:
        function = _named(name, names)
        if not any(function is known for known in self._functions):
            raise ValueError(f"'{name}' is no function that a lattice may call")
        if any(keyword.arg is None or keyword.arg.startswith("__") for keyword in node.keywords):
            raise ValueError(f"'{name}' is called in a way that is not read")
        given = [self._of(argument, names) for argument in node.args]
        named = {str(k.arg): self._of(k.value, names) for k in node.keywords}
        return function(*given, **named)


def _named(name: str, names: tuple[Mapping[str, Any], ...]) -> Any:
    if name.startswith("__"):
        raise ValueError(f"'{name}' is no name of a lattice")
    for known in names:
        try:
            return known[name]
        except KeyError:
            continue
    raise NameError(f"name '{name}' is not defined")  # in Python's words: AT looks for the name


def _bounded(value: Any) -> Any:
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > _EXACT:
        return float(value)
    return value


HIGHEST_ORDER = 100
"""Of a magnet's field; AT lays out as many numbers as `MaxOrder` states."""


def check_order(fields: Mapping[str, Any]) -> None:
    """Raises a LatticeError for an element of a file whose `MaxOrder` no magnet has."""
    order = np.ravel(fields.get("MaxOrder", 0))
    if order.dtype.kind in "iufb" and not ((order >= 0) & (order <= HIGHEST_ORDER)).all():
        raise LatticeError(
            f"the element '{plain(str(fields.get('FamName')), 40)}' has the MaxOrder "
            f"{order[0]:g}; it is between 0 and {HIGHEST_ORDER}"
        )


def _checked(make: Callable[..., Any]) -> Callable[..., Any]:
    """What makes an element of a file, after a look at its size."""

    def made(*arguments: Any, **fields: Any) -> Any:
        first = arguments[0] if arguments else None  # a name, or all fields
        check_order(first if isinstance(first, dict) else {"FamName": first, **fields})
        return make(*arguments, **fields)

    return made


STALE = "K or H is not that of PolynomB, which is used, at "
"""What a warning of `of_fields` begins with; the element's name follows."""


def of_fields(fields: dict[str, Any], **options: Any) -> Any:
    """AT's element of a structure of MATLAB. Its class is that of its fields: of a family's name,
    which AT looks at before its pass method, only `BPM` and `Monitor` are one.

    Raises:
        LatticeError: AT cannot make it, or makes another of it.

    Warns:
        Of a `K` or `H` that is not the strength in `PolynomB`, which AT tracks.
    """
    from at.load.utils import element_from_dict

    name = fields.get("FamName")
    known = not isinstance(name, str) or name.casefold() in ("bpm", "monitor")
    given = {key: _as_array(value) for key, value in fields.items()}
    for key, value in given.items():  # MATLAB has no whole numbers, and pass methods ask for them
        if isinstance(value, float) and value.is_integer():
            given[key] = int(value)
    try:
        element = element_from_dict(given | ({} if known else {"FamName": "_"}), **options)
    except Exception as error:  # AT's constructors fail in their own ways
        raise LatticeError(
            f"the element '{plain(str(name), 40)}': {plain(str(error), 200)}"
        ) from error
    if not known:
        element.FamName = name
    for key in ("Length", "BendingAngle"):  # AT counts arguments, also where one is not there
        own, value = getattr(element, key, 0.0), np.squeeze(given.get(key, 0.0))
        if not np.array_equal(own, value, equal_nan=True):
            raise LatticeError(
                f"AT's reader gives the element '{plain(str(name), 40)}' the {key} {own!s:.20}, "
                f"the file {value!s:.20}; give the element all that its class needs"
            )
    strengths = given.keys() & {"K", "H"}
    if any(np.any(getattr(element, k, given[k]) != np.squeeze(given[k])) for k in strengths):
        warnings.warn(f"{STALE}{plain(str(name), 40)}", stacklevel=2)
    return element


def _as_array(value: Any) -> Any:
    """Numbers that JSON has in a list."""
    if not isinstance(value, list):
        return value
    with suppress(ValueError):  # rows of different lengths
        array = np.asarray(value)
        return array if array.dtype.kind in "fiub" else value
    return value


def _array(items: Any, dtype: Any = float, shape: Any = (-1,)) -> Any:
    """An array as NumPy writes it; only an empty one has its shape."""
    array = np.array(items)
    return array if array.size else np.empty(shape if 0 in np.ravel(shape) else 0, dtype)


@contextmanager
def nothing_run() -> Iterator[None]:
    """AT's reader of `.repr` calculates where it would evaluate; all readers look at sizes first.

    It finds `eval` among the names of its own module first; one reading at a time has it there.
    """
    import at
    from at.load import json, matfile, reprfile

    elements = {cls.__name__: _checked(cls) for cls in at.Element.subclasses()}
    make = json.element_from_dict
    numbers = {cls.__name__: cls for cls in (np.float64, np.float32, np.int64, np.int32, np.uint8)}
    functions = {**elements, **numbers, "Particle": at.Particle, "array": _array}
    constants = {"pi": math.pi, "nan": math.nan, "NaN": math.nan, "inf": math.inf, "Inf": math.inf}
    names = {**functions, **constants}
    arithmetic = Arithmetic(functions.values())

    def value(text: str, *_: Any) -> Any:
        try:
            return arithmetic.value(text, names)
        except (ValueError, SyntaxError) as error:  # AT would leave the line out
            raise LatticeError(f"{error}: {plain(text, 60)}") from error

    with _ONE_AT_A_TIME:
        reprfile.eval = value
        json.element_from_dict = matfile.element_from_dict = _checked(of_fields)
        try:
            yield
        finally:
            json.element_from_dict = matfile.element_from_dict = make
            del reprfile.eval
