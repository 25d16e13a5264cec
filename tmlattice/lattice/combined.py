"""A straight magnet with dipole, quadrupole and sextupole fields, normal and skew, as one element.

OCELOT has none: its quadrupole may carry a sextupole, and no other pair goes together. Here is an
OCELOT element like its own, with the fields as everybody writes them (MAD-X, AT):

    B_y + i B_x = sum over n of (k_n + i k_ns) (x + i y)^n / n!,    px' = -B_y,  py' = +B_x

so that AT's PolynomB[n] is k_n / n! and PolynomA[n] is k_ns / n!. A sextupole with a skew coil and
a quadrupole with a corrector's coil on its poles are such magnets. A thin one (l = 0) holds the
integrated fields, k_n L. It may also bend the design orbit by an angle, which then makes no kick on
that orbit: `k0` is the dipole field beyond it.

Its map is that of the constant Hamiltonian of its body, to second order: the equations of motion of
all products of two coordinates are linear up to products of three: an exponential solves them.
"""

from functools import cache
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.ocelot import OpticElement, SecondTM, elements, rot_mtx

ELECTRON_GEV = 0.51099895e-3

FIELDS = ("k0", "k0s", "k1", "k1s", "k2", "k2s")
"""Dipole (1/m), quadrupole (1/m2), sextupole (1/m3); normal and skew."""
DESIGN = ("angle", "lrad")
"""Of a thin one: the angle by which the design orbit bends, rad, and the length of the bend that it
stands for, m; over that length a bend focuses as angle (angle + k0) / lrad; 0: it does not."""

_quadrupole = elements.Quadrupole().element
_Magnet: Any = next(c for c in type(_quadrupole).__mro__ if c.__name__ == "Magnet")
_First = type(_quadrupole.create_first_order_main_params(1.0))
_Second = type(_quadrupole.create_second_order_main_params(1.0))


@cache
def _products() -> dict[tuple[int, ...], int]:
    """The index of 1, of each coordinate, and of each product of two."""
    pairs = [(i, j) for i in range(6) for j in range(i, 6)]
    return {m: k for k, m in enumerate([(), *((i,) for i in range(6)), *pairs])}


def _motion(k: dict[str, float], energy: float) -> list[dict[tuple[int, ...], float]]:
    """d/ds of OCELOT's (x, px, y, py, tau, p), each as a sum over products of coordinates."""
    gamma = energy / ELECTRON_GEV
    beta = np.sqrt(1 - 1 / gamma**2) if gamma else 1.0
    slip = 1 / (beta * gamma) ** 2 if gamma else 0.0
    # H = -angle x (1 + delta) + weak x^2 / 2, with delta = p / beta - slip p^2 / 2
    angle = k.get("angle", 0.0)
    weak = angle * (angle + k["k0"]) / k["lrad"] if angle and k["lrad"] else 0.0
    return [
        {(1,): 1.0, (1, 5): -1 / beta},
        {(): -k["k0"], (0,): -k["k1"] - weak, (2,): k["k1s"],
         (0, 0): -k["k2"] / 2, (2, 2): k["k2"] / 2, (0, 2): k["k2s"],
         (5,): angle / beta, (5, 5): -slip * angle / 2},
        {(3,): 1.0, (3, 5): -1 / beta},
        {(): k["k0s"], (2,): k["k1"], (0,): k["k1s"],
         (0, 2): k["k2"], (0, 0): k["k2s"] / 2, (2, 2): -k["k2s"] / 2},
        {(5,): -slip, (1, 1): 0.5 / beta, (3, 3): 0.5 / beta, (5, 5): 1.5 * slip / beta,
         (0,): angle / beta, (0, 5): -slip * angle},
        {},
    ]  # fmt: skip


def body_map(
    fields: dict[str, float], length: float | None, energy: float
) -> tuple[Array, Array, Array]:
    """B [6], R [6, 6], T [6, 6, 6] (symmetric) of a straight body.

    Args:
        fields: `FIELDS`; integrated where there is no length, and there `DESIGN` as well.
        length: m; None: a thin one.
        energy: GeV.
    """
    from scipy.linalg import expm

    index, motion = _products(), _motion(fields, energy)
    if length is None:  # kicks alone, no way
        late = {term: amount for term, amount in motion[4].items() if 0 in term}
        motion = [{}, motion[1], {}, motion[3], late, {}]
        length = 1.0
    slope = np.zeros((len(index), len(index)))
    for product, row in index.items():
        for place, factor in enumerate(product):
            rest = product[:place] + product[place + 1 :]
            for term, amount in motion[factor].items():
                made = tuple(sorted((*rest, *term)))
                if made in index:  # products of three are of third order
                    slope[row, index[made]] += amount
    rows = expm(slope * length)[1:7]
    T = np.zeros((6, 6, 6))
    for product, column in index.items():
        if len(product) == 2:
            i, j = product
            T[:, i, j] += rows[:, column] / 2
            T[:, j, i] += rows[:, column] / 2
    return rows[:, 0], rows[:, 1:7], T


def bend_matrix(source: Any, energy: float) -> Array:
    """What a thin one does by bending the design orbit alone, [6, 6]; energy in GeV."""
    design = dict.fromkeys(FIELDS, 0.0) | {k: float(getattr(source, k)) for k in DESIGN}
    turn = rot_mtx(source.tilt)
    return np.asarray(rot_mtx(-source.tilt) @ body_map(design, None, energy)[1] @ turn)


class CombinedAtom(_Magnet):  # type: ignore[misc]
    """What OCELOT asks of an element's physics."""

    def __init__(self, l: float = 0.0, tilt: float = 0.0, eid: Any = None, **fields: float) -> None:  # noqa: E741
        super().__init__(eid=eid)
        self.l = l
        self.tilt = tilt
        for name in (*FIELDS, *DESIGN):
            setattr(self, name, fields.get(name, 0.0))

    def _map(self, energy: float, delta_length: float | None) -> tuple[Array, Array, Array]:
        length = None if self.l == 0 else self.l if delta_length is None else delta_length
        fields = {name: float(getattr(self, name)) for name in (*FIELDS, *DESIGN)}
        B, R, T = body_map(fields, length, energy)
        return (rot_mtx(-self.tilt) @ B).reshape(6, 1), R, T  # OCELOT turns R and T, not B

    def create_first_order_main_params(
        self, energy: float, delta_length: float | None = None
    ) -> Any:
        """R and B, before the tilt."""
        B, R, _ = self._map(energy, delta_length)
        return _First(R, B, self.tilt)

    def create_second_order_main_params(
        self, energy: float, delta_length: float | None = None
    ) -> Any:
        """R, B and T, before the tilt."""
        B, R, T = self._map(energy, delta_length)
        return _Second(R, B, T, self.tilt, 0.0, 0.0)


class CombinedMultipole(OpticElement):  # type: ignore[misc]
    """The element.

    Args:
        l: length, m; 0: the fields are integrated.
        tilt: of all fields about the beam axis, rad.
        eid: its name.
        **fields: k0, k0s, k1, k1s, k2, k2s, see `FIELDS`; of a thin one angle and lrad, see
            `DESIGN`; 0 where not given.

    Raises:
        TypeError: another field.
    """

    supported_tms = frozenset({elements.Quadrupole.default_tm, SecondTM})

    def __init__(
        self,
        l: float = 0.0,  # noqa: E741
        *,
        tilt: float = 0.0,
        eid: Any = None,
        tm: Any = None,
        **fields: float,
    ) -> None:
        if unknown := fields.keys() - {*FIELDS, *DESIGN}:
            raise TypeError(f"a CombinedMultipole has no {', '.join(sorted(unknown))}")
        super().__init__(CombinedAtom(l, tilt, eid, **fields), tm=tm)


def fields_of(strengths: Any) -> dict[str, float]:
    """`FIELDS` of k_n + i k_ns, [order], three at least; higher ones are passed over."""
    pairs = np.asarray(strengths[:3], dtype=complex).view(float)
    return dict(zip(FIELDS, pairs.tolist(), strict=True))
