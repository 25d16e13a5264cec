"""The second-order map of one element, from OCELOT's own matrices and the element's errors.

OCELOT gives an element as a sequence of parts (three for a bend: entrance edge, body, exit edge),
each x -> B + R x + x^T T x. The parts are composed to second order. Straight quadrupoles, of which
a fit of gradients asks for hundreds in each step, have the same maps in closed form, all at once.
"""

import cmath
import functools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Flags
from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import NO_ERRORS, PHYSICS, Element, Errors

Weights = tuple[Array, Array, Array]
Made = TypeVar("Made")


@functools.cache
def _pairs(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Rows and columns of the pairs i <= j of n coordinates, and their multiplicity in T."""
    i, j = np.triu_indices(n)
    return i, j, np.where(i == j, 1.0, 2.0)


@dataclass(frozen=True)
class Quadratic:
    """x -> B + R x + x^T T x, or a stack of such maps, [..., out, n, n].

    T is symmetric in its last two indices, or None if 0.
    """

    B: Array
    R: Array
    T: Array | None

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Return images [..., out] of states [..., n], and their slopes [..., out, n]."""
        bent = 0.0 if self.T is None else (self.T @ x[..., None, :, None])[..., 0]
        return self.B + ((self.R + bent) @ x[..., None])[..., 0], self.R + 2.0 * bent

    def after(self, first: "Quadratic") -> "Quadratic":
        """Return this map after `first`, to second order in x."""
        into = first.B[..., None]
        if self.T is None:
            bent = None if first.T is None else _on_rows(self.R, first.T)
            return Quadratic(self.B + (self.R @ into)[..., 0], self.R @ first.R, bent)
        fed = (self.T @ into[..., None, :, :])[..., 0]  # half of the constant part's feed-down
        slope = self.R + 2.0 * fed
        turn = first.R[..., None, :, :]
        bent = turn.swapaxes(-1, -2) @ self.T @ turn
        if first.T is not None:
            bent += _on_rows(slope, first.T)
        return Quadratic(self.B + ((self.R + fed) @ into)[..., 0], slope @ first.R, bent)

    def reduced(self) -> tuple[Array, Array, Array]:
        """Return W0 [..., out], W1 [..., out, n], and W2 [..., out, n (n + 1) / 2] in the reduced
        Kronecker order."""
        i, j, counts = _pairs(self.R.shape[-1])
        if self.T is None:
            return self.B, self.R, np.zeros((*self.B.shape, len(i)))
        # by rows, as kernels are compiled for; an indexed array has another order
        return self.B, self.R, np.multiply(counts, self.T[..., i, j], order="C")

    def __getitem__(self, which: Any) -> "Quadratic":
        """Some maps of a stack."""
        return Quadratic(self.B[which], self.R[which], None if self.T is None else self.T[which])

    def each(self) -> list["Quadratic"]:
        """The maps of a stack."""
        if self.T is None:
            return [Quadratic(B, R, None) for B, R in zip(self.B, self.R, strict=True)]
        bent: Flags = np.asarray(self.T.any(axis=(-3, -2, -1)))
        return [Quadratic(B, R, T if some else None)
                for B, R, T, some in zip(self.B, self.R, self.T, bent, strict=True)]  # fmt: skip


def stacked(maps: Sequence[Quadratic], n: int) -> Quadratic:
    """Return maps of n coordinates as a stack, [map, ...]."""
    T = None
    if any(own.T is not None for own in maps):
        none = np.zeros((n, n, n))
        T = np.array([none if own.T is None else own.T for own in maps])
    B, R = np.array([own.B for own in maps]), np.array([own.R for own in maps])
    return Quadratic(B.reshape(-1, n), R.reshape(-1, n, n), T)


def slopes(ends: Quadratic, step: float | Array) -> Quadratic:
    """Return derivatives by differences: of a stack of pairs each first map less the second, over
    a step, [pair, ...]."""
    B, R = (((own[::2] - own[1::2]).T / step).T for own in (ends.B, ends.R))
    T = None if ends.T is None else ((ends.T[::2] - ends.T[1::2]).T / step).T
    return Quadratic(B, R, T)


def _on_rows(matrix: Array, T: Array) -> Array:
    """`np.tensordot(matrix, T, 1)`, also of stacks, in one product."""
    flat = matrix @ T.reshape(*T.shape[:-2], -1)
    return flat.reshape(*flat.shape[:-1], *T.shape[-2:])


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
    known: Hashable = vars(element).get(PHYSICS) or element.data
    if known is not None:
        return known
    source = element.source
    values = vars(source.element)
    physics = tuple([values[k] for k in values if k not in _FOR_PEOPLE])
    numbers = _PLAIN.issuperset(map(type, physics)) or all(isinstance(v, _NUMBERS) for v in physics)
    if not numbers or values.get("params"):
        return id(source)  # a matrix, a field map; not remembered, because a copy has another
    vars(element)[PHYSICS] = key = (type(source), physics)
    return key


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
    """Return the map of one element, see `quadratic_maps`."""
    return quadratic_maps([element], energy, n).each()[0]


def quadratic_maps(elements: Sequence[Element], energy: float, n: int) -> Quadratic:
    """Return the maps of elements, their errors included, as a stack.

    Raises:
        LatticeError: a map is not finite, or it loses energy, which needs six coordinates.
    """
    from tmlattice.lattice.ocelot import elements as ocelot

    # a cavity is a drift: its gain depends on the turn, see `beam.rf`
    given = [
        replace(e, source=ocelot.Drift(l=e.length)) if e.kind == "cavity" else e for e in elements
    ]
    wrong = [element for element in given if element.errors != NO_ERRORS]
    with_errors = iter(_with_errors(wrong, energy, n).each() if wrong else ())
    known = _straight([element for element in given if element.errors == NO_ERRORS], energy, n)
    total = stacked([
        next(with_errors) if element.errors != NO_ERRORS
        else known.get(id(element))
        or composed(of_ocelot(part, n) for part in parts_of(element, energy, False))
        for element in given
    ], n)  # fmt: skip
    for own in (total.B, total.R, total.T):
        if own is not None and not np.isfinite(own).all():
            bad = elements[int(np.argwhere(~np.isfinite(own))[0, 0])]
            raise LatticeError(
                f"OCELOT's map of {bad.kind} '{bad.name}' is not finite; check its strengths"
            )
    return total


def _with_errors(elements: Sequence[Element], energy: float, n: int) -> Quadratic:
    known = _straight(elements, energy, n, 0.5)
    # unchanged by errors in the middle
    halves = [
        (known[id(element)],) * 2 if id(element) in known
        else _remembered(_halved, element, (energy, n), partial(_halves, element, energy, n))
        for element in elements
    ]  # fmt: skip
    first, second = (stacked(own, n) for own in zip(*halves, strict=True))
    e = {own.name: np.array([getattr(element.errors, own.name) for element in elements])
         for own in fields(Errors)}  # fmt: skip
    ratio_x, ratio_y = np.array([_in_the_middle(element) for element in elements]).T
    kicks = e["kick_x"] * ratio_x, e["kick_y"] * ratio_y
    none = np.zeros(len(elements))
    moved = e["ds"].any()
    along, back = (drift(way, n, energy) if moved else None for way in (e["ds"], -e["ds"]))
    return composed([
        along,
        _thin(n, none, none, e["entrance_k1l"], none, e["entrance"]),
        _shift(n, -e["dx"], -e["dy"]), _turn(n, e["roll"]), first,
        _thin(n, *kicks, e["k1l"], e["k1sl"], e["middle"]),
        _loss(n, e["loss"], elements), second, _turn(n, -e["roll"]),
        _shift(n, e["dx"], e["dy"]), back,
    ])  # fmt: skip


def _straight(
    elements: Sequence[Element], energy: float, n: int, share: float = 1.0
) -> dict[int, Quadratic]:
    """The maps of upright straight quadrupoles, or of a share of their bodies, by `id`.

    To first order in the momentum deviation they differ by the integral of px^2 + py^2 along the
    trajectory, as drifts do, which is quadratic in the launch.
    """
    from tmlattice.lattice.ocelot import elements as ocelot

    own = [
        element for element in elements
        if element.kind == "quadrupole" and type(element.source) is ocelot.Quadrupole
        and not (element.tilt or element.k2 or element.source.dx or element.source.dy)
    ]  # fmt: skip
    length = share * np.array([element.length for element in own])
    k1 = np.array([element.k1 for element in own])
    metre = _metre(n, energy)
    R = np.eye(n) + length[:, None, None] * (metre.R - np.eye(n))
    T = None if metre.T is None else length[:, None, None, None] * metre.T
    for x, k in ((0, k1), (2, -k1)):
        plane = slice(x, x + 2)
        phase = np.sqrt(k.astype(complex)) * length
        c, s = np.cos(phase).real, length * np.sinc(phase / np.pi).real
        R[:, plane, plane] = _two_by_two(c, s, -k * s, c)
        if T is not None and metre.T is not None:
            # integrals of the squares of px by x and by px, and of their product
            xx, pp, xp = k * (length - s * c) / 2, (length + s * c) / 2, -k * s**2 / 2
            bent = R[:, plane, plane] @ _two_by_two(xp, pp, -xx, -xp) * metre.T[x, x + 1, 5]
            T[:, plane, plane, 5] = T[:, plane, 5, plane] = bent
            T[:, 4, plane, plane] = _two_by_two(xx, xp, xp, pp) * metre.T[4, x + 1, x + 1]
    maps = Quadratic(np.zeros((len(own), n)), R, T)
    return {id(element): made for element, made in zip(own, maps.each(), strict=True)}


def _two_by_two(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Matrices of these entries, row by row, [map, 2, 2]."""
    return np.stack([a, b, c, d], axis=1).reshape(-1, 2, 2)


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
    n: int, kick_x: Array, kick_y: Array, k1l: Array, k1sl: Array, slopes: Array
) -> Quadratic | None:
    """px += kick_x - k1l x + k1sl y, py += kick_y + k1l y + k1sl x, and the slopes' kicks."""
    return _linear(n, (kick_x, kick_y, k1l, k1sl, slopes), {1: kick_x, 3: kick_y}, {
        (1, 0): slopes[:, 0] - k1l, (1, 2): slopes[:, 1] + k1sl,
        (3, 0): slopes[:, 2] + k1sl, (3, 2): slopes[:, 3] + k1l,
    })  # fmt: skip


def _linear(
    n: int,
    changes: Iterable[Array],
    B: Mapping[int, Array],
    R: Mapping[tuple[int, int], Array],
) -> Quadratic | None:
    """Linear maps [map] with these entries of B and R, else the identity's; None: no changes."""
    if not any(own.any() for own in changes):
        return None
    count = len(next(iter((*B.values(), *R.values()))))
    total = Quadratic(np.zeros((count, n)), np.tile(np.eye(n), (count, 1, 1)), None)
    for i, constant in B.items():
        total.B[:, i] = constant
    for (i, j), entry in R.items():
        total.R[:, i, j] = entry
    return total


def _shift(n: int, dx: Array, dy: Array) -> Quadratic | None:
    return _linear(n, (dx, dy), {0: dx, 2: dy}, {})


def drift(length: float | Array, n: int, energy: float) -> Quadratic:
    """Return a drift, or a stack of drifts, also backwards.

    Args:
        length: m, or [map].
        n: number of coordinates.
        energy: GeV.
    """
    metre, eye, some = _metre(n, energy), np.eye(n), np.asarray(length)[..., None, None]
    bent = None if metre.T is None else some[..., None] * metre.T
    return Quadratic(some[..., 0] * metre.B, eye + some * (metre.R - eye), bent)


@functools.cache
def _metre(n: int, energy: float) -> Quadratic:
    """A drift of 1 m less the identity, which is proportional to the length."""
    from tmlattice.lattice.ocelot import elements, parts_of_ocelot

    parts = parts_of_ocelot(elements.Drift(l=1.0), energy, False)
    return composed(of_ocelot(part, n) for part in parts)


def _turn(n: int, roll: Array) -> Quadratic | None:
    """Rotations to axes that are turned by `roll` from x towards y."""
    cosine, sine = np.cos(roll), np.sin(roll)
    return _linear(n, (roll,), {}, {
        (0, 0): cosine, (0, 2): sine, (1, 1): cosine, (1, 3): sine,
        (2, 2): cosine, (2, 0): -sine, (3, 3): cosine, (3, 1): -sine,
    })  # fmt: skip


def _loss(n: int, loss: Array, elements: Sequence[Element]) -> Quadratic | None:
    """Energy losses of loss (1 + p)^2; the slopes stay, so the momenta fall with it."""
    if loss.any() and n != 6:
        losing = elements[int(np.flatnonzero(loss)[0])]
        raise LatticeError(
            f"{losing.kind} '{losing.name}' loses energy, which needs six coordinates (dimension=6)"
        )
    kept = 1 - loss
    return _linear(n, (loss,), {5: -loss}, {(5, 5): 1 - 2 * loss, (1, 1): kept, (3, 3): kept})
