"""The second-order map of one element, from OCELOT's own matrices and the element's errors.

OCELOT gives an element as a sequence of parts (three for a bend: entrance edge, body, exit edge),
each x -> B + R x + x^T T x. The parts are composed to second order.
"""

import cmath
import functools
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array
from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import NO_ERRORS, Element, Slopes

Weights = tuple[Array, Array, Array]
Made = TypeVar("Made")


@functools.cache
def _pairs(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Rows and columns of the pairs i <= j of n coordinates, and their multiplicity in T."""
    i, j = np.triu_indices(n)
    return i, j, np.where(i == j, 1.0, 2.0)


@dataclass(frozen=True)
class Quadratic:
    """x -> B + R x + x^T T x with T [out, n, n] symmetric in its last two indices, or None if 0."""

    B: Array
    R: Array
    T: Array | None

    def after(self, first: "Quadratic") -> "Quadratic":
        """Return this map after `first`, to second order in x."""
        if self.T is None:
            bent = None if first.T is None else _on_rows(self.R, first.T)
            return Quadratic(self.B + self.R @ first.B, self.R @ first.R, bent)
        fed = self.T @ first.B  # [out, n]: half of the constant part's feed-down
        slope = self.R + 2.0 * fed
        bent = first.R.T @ self.T @ first.R
        if first.T is not None:
            bent = bent + _on_rows(slope, first.T)
        return Quadratic(self.B + (self.R + fed) @ first.B, slope @ first.R, bent)

    def reduced(self) -> tuple[Array, Array, Array]:
        """Return W0 [out], W1 [out, n], W2 [out, n (n + 1) / 2] in the reduced Kronecker order."""
        i, j, _ = _pairs(self.R.shape[1])
        if self.T is None:
            return self.B, self.R, np.zeros((len(self.B), len(i)))
        return self.B, self.R, _pairs(self.R.shape[1])[2] * self.T[:, i, j]


def each_after(
    later: Sequence[Quadratic], first: Sequence[Quadratic], n: int
) -> tuple[Array, Array, Array]:
    """Return `Quadratic.after` of many pairs: B [pair, n], R [pair, n, n], T [pair, n, n, n]."""
    (B2, R2, T2), (B1, R1, T1) = _stacked(later, n), _stacked(first, n)
    fed = (T2 @ B1[:, None, :, None])[..., 0]
    slope = R2 + 2.0 * fed
    bent = R1.swapaxes(1, 2)[:, None] @ T2 @ R1[:, None]
    bent += (slope @ T1.reshape(-1, n, n * n)).reshape(T1.shape)
    B = B2 + ((R2 + fed) @ B1[:, :, None])[..., 0]
    return B, slope @ R1, bent


def _stacked(maps: Sequence[Quadratic], n: int) -> tuple[Array, Array, Array]:
    nothing = np.zeros((n, n, n))
    B = np.array([m.B for m in maps]).reshape(-1, n)
    R = np.array([m.R for m in maps]).reshape(-1, n, n)
    T = np.array([nothing if m.T is None else m.T for m in maps]).reshape(-1, n, n, n)
    return B, R, T


def difference(ends: Iterable[tuple[int, Quadratic]], step: float) -> Quadratic:
    """Return the sum of maps with signs, over a step: a derivative by differences."""
    signs, maps = zip(*ends, strict=True)

    def total(arrays: Iterable[Array | None]) -> Array | None:
        given = [sign * own for sign, own in zip(signs, arrays, strict=True) if own is not None]
        return functools.reduce(np.add, given) / step if given else None

    B, R = total(m.B for m in maps), total(m.R for m in maps)
    assert B is not None
    assert R is not None
    return Quadratic(B, R, total(m.T for m in maps))


def _on_rows(matrix: Array, T: Array) -> Array:
    """`np.tensordot(matrix, T, 1)` without its checks, which cost more than the product."""
    rows, n = len(T), T.shape[-1]
    return (matrix @ T.reshape(rows, n * n)).reshape(-1, n, n)


def identity(n: int) -> Quadratic:
    """Return the identity."""
    return Quadratic(np.zeros(n), np.eye(n), None)


ASKED = 5_000
"""Elements' parts, and halves, in memory, some 20 MB: a scan needs each in many hypotheses."""

_asked: dict[Hashable, list[Weights]] = {}
_halved: dict[Hashable, tuple["Quadratic", "Quadratic"]] = {}


def parts_of(element: Element, energy: float, split: bool) -> list[Weights]:
    """Return OCELOT's (B [6], R [6, 6], T [6, 6, 6]) for each part of an element; read-only.

    With `split` the body is two halves, in the middle of the list.
    """
    from tmlattice.lattice.ocelot import parts_of_ocelot

    return _remembered(
        _asked, element, (energy, split), lambda: parts_of_ocelot(element.source, energy, split)
    )


def _remembered(
    memory: dict[Hashable, Made], element: Element, how: Hashable, made: Callable[[], Made]
) -> Made:
    """Cached result for an element with equal physics, if that is numbers alone."""
    physics = physics_of(element)
    if isinstance(physics, int):
        return made()
    known = memory.get((physics, how))
    if known is None:
        if len(memory) > ASKED:
            memory.clear()
        known = memory[physics, how] = made()
    return known


def physics_of(element: Element) -> Hashable:
    """Key that is equal for elements with equal maps, without their errors: the class and every
    attribute of the source except labels."""
    if element.data is not None:
        return element.data
    source = element.source
    values = vars(source.element)
    physics = tuple([values[k] for k in values if k not in _FOR_PEOPLE])
    numbers = _PLAIN.issuperset(map(type, physics)) or all(isinstance(v, _NUMBERS) for v in physics)
    if numbers and not values.get("params"):
        return (type(source), physics)
    return id(source)  # not only numbers: a matrix, a field map


_NUMBERS = (int, float, type(None))
_PLAIN = frozenset((*_NUMBERS, bool))
_FOR_PEOPLE = frozenset(("id", "color", "params"))


def of_ocelot(part: Weights, n: int) -> Quadratic:
    """Return OCELOT's part in the first n coordinates, its T made symmetric."""
    B, R, T = part
    bent = T[:n, :n, :n]
    bent = 0.5 * (bent + bent.swapaxes(1, 2))
    return Quadratic(B[:n], R[:n, :n], bent if bent.any() else None)


def quadratic_map(element: Element, energy: float, n: int) -> Quadratic:
    """Return the map of one element, its errors included; LatticeError: it is not finite, or it
    loses energy, which needs six coordinates."""
    errors = element.errors
    if element.kind == "cavity":  # its gain depends on the turn, see `beam.rf`
        element = _empty(element)
    if errors == NO_ERRORS:
        total = composed(of_ocelot(part, n) for part in parts_of(element, energy, False))
    else:
        # unchanged by errors in the middle
        first, second = _remembered(
            _halved, element, (energy, n), lambda: _halves(element, energy, n)
        )
        ratio_x, ratio_y = _in_the_middle(element)
        kicks = errors.kick_x * ratio_x, errors.kick_y * ratio_y
        total = composed([
            _way(n, errors.ds, energy),
            _thin(n, k1l=errors.entrance_k1l, slopes=errors.entrance),
            _shift(n, -errors.dx, -errors.dy), _turn(n, errors.roll), first,
            _thin(n, *kicks, errors.k1l, errors.k1sl, errors.middle),
            _loss(n, errors.loss, element), second, _turn(n, -errors.roll),
            _shift(n, errors.dx, errors.dy), _way(n, -errors.ds, energy),
        ])  # fmt: skip
    finite = np.isfinite(total.R).all() and np.isfinite(total.B).all()
    if not finite or (total.T is not None and not np.isfinite(total.T).all()):
        raise LatticeError(
            f"OCELOT's map of {element.kind} '{element.name}' is not finite; check its strengths"
        )
    return total


def _in_the_middle(element: Element) -> tuple[float, float]:
    """Ratios of a kick in the middle, in and across the bend's plane, to the equivalent one that is
    spread over the body: rho a (1 - cos angle) and a sin angle are those of 2 a sin(angle / 2), and
    a gradient k1 in the body focuses like angle^2 / length^2, and across the other way."""
    if element.kind != "bend":
        return 1.0, 1.0
    gradient = element.k1 * element.length**2
    halves = cmath.sqrt(element.angle**2 + gradient) / 2, cmath.sqrt(-gradient) / 2
    x, y = ((cmath.sin(half) / half).real if half else 1.0 for half in halves)
    return x, y


def _empty(element: Element) -> Element:
    """Return the same element as a drift."""
    from tmlattice.lattice.ocelot import elements

    return replace(element, source=elements.Drift(l=element.length))


def composed(parts: Iterable[Quadratic | None]) -> Quadratic:
    """Return the parts composed in beam order; None is the identity."""
    given = [part for part in parts if part is not None]
    total = given[0]
    for part in given[1:]:
        total = part.after(total)
    return total


def _halves(element: Element, energy: float, n: int) -> tuple[Quadratic, Quadratic]:
    """Maps to and from the middle of an element's body."""
    if element.length == 0:  # as thin as its errors
        parts = [of_ocelot(part, n) for part in parts_of(element, energy, False)]
        return identity(n), composed(parts)
    parts = [of_ocelot(part, n) for part in parts_of(element, energy, True)]
    middle = len(parts) // 2
    if len(parts) % 2 == 0:
        return composed(parts[:middle]), composed(parts[middle:])
    from scipy.linalg import sqrtm

    body = parts[middle]  # of a bare matrix, or of a cavity: in one piece
    root = np.array(np.real(sqrtm(body.R)), dtype=np.float64)
    back: Array = np.linalg.inv(root).astype(np.float64)
    first = Quadratic(np.zeros(n), root, None)
    second = body.after(Quadratic(np.zeros(n), back, None))
    return composed([*parts[:middle], first]), composed([second, *parts[middle + 1 :]])


def _thin(
    n: int,
    kick_x: float = 0.0,
    kick_y: float = 0.0,
    k1l: float = 0.0,
    k1sl: float = 0.0,
    slopes: Slopes = NO_ERRORS.middle,
) -> Quadratic | None:
    """px += kick_x - k1l x + k1sl y, py += kick_y + k1l y + k1sl x, and the slopes' kicks."""
    if kick_x == kick_y == k1l == k1sl == 0 and not any(slopes):
        return None
    B, R = np.zeros(n), np.eye(n)
    B[1], B[3] = kick_x, kick_y
    R[1, 0], R[3, 2] = -k1l, k1l
    R[1, 2] = R[3, 0] = k1sl
    R[1, 0] += slopes[0]
    R[1, 2] += slopes[1]
    R[3, 0] += slopes[2]
    R[3, 2] += slopes[3]
    return Quadratic(B, R, None)


def _shift(n: int, dx: float, dy: float) -> Quadratic | None:
    if dx == dy == 0:
        return None
    B = np.zeros(n)
    B[0], B[2] = dx, dy
    return Quadratic(B, np.eye(n), None)


def _way(n: int, length: float, energy: float) -> Quadratic | None:
    """A drift, forwards or backwards."""
    if length == 0:
        return None
    metre, eye = _metre(n, energy), np.eye(n)
    bent = None if metre.T is None else length * metre.T
    return Quadratic(metre.B, eye + length * (metre.R - eye), bent)


@functools.cache
def _metre(n: int, energy: float) -> Quadratic:
    """A drift of 1 m less the identity, which is proportional to the length."""
    from tmlattice.lattice.ocelot import elements, parts_of_ocelot

    parts = parts_of_ocelot(elements.Drift(l=1.0), energy, False)
    return composed(of_ocelot(part, n) for part in parts)


def _turn(n: int, roll: float) -> Quadratic | None:
    """Rotation to axes that are turned by `roll` from x towards y."""
    if roll == 0:
        return None
    R = np.eye(n)
    cos, sin = np.cos(roll), np.sin(roll)
    R[0, 0] = R[1, 1] = R[2, 2] = R[3, 3] = cos
    R[0, 2] = R[1, 3] = sin
    R[2, 0] = R[3, 1] = -sin
    return Quadratic(np.zeros(n), R, None)


def _loss(n: int, loss: float, element: Element) -> Quadratic | None:
    """Energy loss of loss (1 + p)^2; the slopes stay, so the momenta fall with it."""
    if loss == 0:
        return None
    if n != 6:
        raise LatticeError(
            f"{element.kind} '{element.name}' loses energy, which needs six coordinates "
            "(dimension=6)"
        )
    B, R = np.zeros(n), np.eye(n)
    B[5] = -loss
    R[5, 5] = 1 - 2 * loss
    R[1, 1] = R[3, 3] = 1 - loss
    return Quadratic(B, R, None)


def drift(length: float, n: int) -> Quadratic:
    """Return a drift at the nominal energy, length in m."""
    matrix = np.eye(n)
    matrix[0, 1] = matrix[2, 3] = length
    return Quadratic(np.zeros(n), matrix, None)
