"""OCELOT, imported without its greeting and without the parts that the package does not use.

`import ocelot` takes seconds: it compiles three functions for collective effects, and loads pandas
and half of scipy. Everything in this package that needs OCELOT imports it from here, when it is
needed, and then only its elements are loaded:

- `ocelot` itself is run when a name of it other than an element is first used (`ocelot.twiss`,
  `from ocelot import *`): then it is whole, with the same classes. Where it was imported before,
  it is taken as it is.
- What OCELOT would compile while it is imported is compiled when it is first called.
- `LATER` are loaded when OCELOT first uses them.

Where a version of OCELOT does not bear this, it is imported whole.
"""

import cmath
import contextlib
import copy
import importlib.util
import inspect
import io
import logging
import math
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from tmlattice.arrays import Array

LATER = (
    "pandas",
    "scipy.fftpack",
    "scipy.integrate",
    "scipy.interpolate",
    "scipy.optimize",
    "scipy.signal",
)
"""Modules that OCELOT's elements name and do not need for a map."""


class _Package(ModuleType):
    """The package `ocelot`, whose own code is run when a name of it is first asked for."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name not in ("__all__", "__version__"):
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        elements = sys.modules.get("ocelot.cpbd.elements")
        if name in getattr(elements, "__all__", ()):  # all that most lattice files ask for
            return getattr(elements, name)
        self.__class__ = ModuleType  # type: ignore[assignment]
        spec = self.__spec__
        assert spec is not None
        assert spec.loader is not None
        spec.loader.exec_module(self)
        return getattr(self, name)


class _Later(ModuleType):
    """A module that is loaded when it is used; functions imported from it wait as well."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        if sys.modules.get(self.__name__) is not self:
            return getattr(import_module(self.__name__), name)

        def call(*args: Any, **options: Any) -> Any:
            return getattr(import_module(self.__name__), name)(*args, **options)

        return call


def _depth(context: int = 1) -> list[Any]:
    """A list as long as the stack: OCELOT counts it, and `inspect.stack` reads all its source."""
    frames = []
    frame = inspect.currentframe()
    while frame := frame and frame.f_back:
        frames.append(frame)
    return frames


@contextlib.contextmanager
def _light() -> Iterator[None]:
    """Imports of OCELOT's parts inside load neither the whole package nor `LATER`."""
    import scipy.special  # noqa: F401  (it, and what it needs, must be the real ones)

    from tmlattice.compiled import numba

    def uncompiled(jit: Callable[..., Any]) -> Callable[..., Any]:
        def made(*args: Any, **options: Any) -> Any:
            if args and isinstance(args[0], str):  # a signature would be compiled at once
                args = args[1:]
            return jit(*args, **options)

        return made

    spec = importlib.util.find_spec("ocelot")
    if spec is None or spec.submodule_search_locations is None:
        raise ImportError("no package 'ocelot'")
    package = _Package("ocelot")
    package.__spec__, package.__file__ = spec, spec.origin
    package.__path__ = list(spec.submodule_search_locations)
    package.__loader__, package.__package__ = spec.loader, "ocelot"
    stand_ins = {name: _Later(name) for name in LATER if name not in sys.modules}
    jit, njit, stack = numba.jit, numba.njit, inspect.stack
    sys.modules["ocelot"] = package
    sys.modules.update(stand_ins)
    numba.jit, numba.njit = uncompiled(jit), uncompiled(njit)
    inspect.stack = _depth  # type: ignore[assignment]
    try:
        yield
    except BaseException:
        for name in [k for k in sys.modules if k == "ocelot" or k.startswith("ocelot.")]:
            del sys.modules[name]
        raise
    finally:
        numba.jit, numba.njit, inspect.stack = jit, njit, stack
        for name in stand_ins:
            del sys.modules[name]


def _import() -> None:
    if "ocelot" not in sys.modules:
        try:
            with _light():
                import_module("ocelot.cpbd.elements")
        except Exception as error:
            logging.getLogger(__name__).info("OCELOT is imported whole: %s", error)
    import_module("ocelot.cpbd.elements")


with contextlib.redirect_stdout(io.StringIO()):
    _import()
    from ocelot.cpbd import elements
    from ocelot.cpbd.elements.magnet import Magnet
    from ocelot.cpbd.elements.optic_element import OpticElement
    from ocelot.cpbd.high_order import m_e_GeV, t_nnn
    from ocelot.cpbd.r_matrix import rot_mtx
    from ocelot.cpbd.transformations.second_order import SecondTM
    from ocelot.cpbd.transformations.transformation import TMTypes

logging.getLogger("ocelot").setLevel(logging.ERROR)

__all__ = ["Magnet", "OpticElement", "SecondTM", "TMTypes", "elements", "rot_mtx", "t_nnn"]

FAINT = 3e-4
"""rad; below, OCELOT's map of a bend with k2 loses a hundredth of its second order to rounding
(k2 terms are differences over powers of the curvature; at 1e-5 they are 1000 times too large).
The sextupole's part is then that of a straight magnet, wrong by the bend's angle at most."""


def parts_of_ocelot(source: Any, energy: float, split: bool) -> list[tuple[Array, Array, Array]]:
    """Return OCELOT's (B [6], R [6, 6], T [6, 6, 6]) for each part of its element.

    With `split` the body is two halves, in the middle of the list.
    """
    atom = source.element
    supported = source.supported_tms  # None: the family declares nothing, and takes any
    bare = isinstance(source, elements.Matrix)  # of unknown interior
    body = [(TMTypes.MAIN, atom.l / 2)] * 2 if split and not bare else [(TMTypes.MAIN, None)]
    edges = [(TMTypes.ENTRANCE, None)], [(TMTypes.EXIT, None)]
    parts = [*edges[0], *body, *edges[1]] if atom.has_edge else body
    bends = (elements.Bend, elements.SBend, elements.RBend)
    faint = isinstance(source, bends) and atom.k2 and abs(atom.angle) < FAINT
    if faint:
        atom = copy.copy(atom)
        atom.k2 = 0.0
    if supported is None or SecondTM in supported:
        try:
            made = {part: body_of(atom, energy, *part) for part in parts}  # two halves are equal
            second = [made[part] for part in parts]
            if faint:
                for i, (where, length) in enumerate(parts):
                    if where is TMTypes.MAIN:
                        B, R, T, tilt = second[i]
                        second[i] = B, R, T + _sextupole(source, length, energy), tilt
            return [(B, *tilted(R, T, tilt)) for B, R, T, tilt in second]
        except (AttributeError, NotImplementedError):
            pass  # a linear element
    zero = np.zeros((6, 6, 6))
    linear = zip(source.B(energy), source.R(energy), strict=True)
    return [(B.ravel(), R, zero) for B, R in linear]


def body_of(
    atom: Any, energy: float, where: Any, length: float | None
) -> tuple[Array, Array, Array, float]:
    """B, R, T and tilt of one part; for a magnet's body as from OCELOT's own call, without its
    Python loop over the feed-down of zero offsets."""
    usual = getattr(type(atom), "create_second_order_main_params", None)
    whole = Magnet.create_second_order_main_params
    if where is not TMTypes.MAIN or usual is not whole or atom.dx or atom.dy:
        own = SecondTM.from_element(atom, where, length).get_params(energy)
        return own.B.ravel(), own.R, own.T, own.tilt
    bent = 0.0 if atom.l == 0 else atom.angle / atom.l
    T = second_order(atom.l if length is None else length, bent, atom.k1, atom.k2, energy)
    return np.zeros(6), atom.create_first_order_main_params(energy, length).R, T, atom.tilt


def second_order(length: float, h: float, k1: float, k2: float, energy: float) -> Array:
    """Return T of a magnet's body, [6, 6, 6]: OCELOT's `t_nnn`, with two integrals as in MAD-X.

    OCELOT takes four times the second integral of sin^2(ky s) / ky^2 / 2, a factor of h k1 k2 in
    the vertical chromaticity, and too little of sx^3 in the integral of the cubed dispersion, a
    factor of k2 + 2 h k1 in the second order of the momentum compaction.

    Args:
        length: m.
        h, k1, k2: curvature (1/m), gradient (1/m2), sextupole (1/m3).
        energy: GeV.
    """
    T: Array = t_nnn(length, h, k1, k2, energy)
    if not h or not (k1 or k2):
        return T
    gamma = energy / m_e_GeV
    beta = math.sqrt(1 - 1 / gamma**2) if gamma else 1.0
    (_, x), (cos, y) = (_cos_sin(k, length) for k in (k1 + h * h, -k1))
    if k1 + h * h:
        T[4, 5, 5] += h**3 * (k2 + 2 * h * k1) * x**3 / (24 * (k1 + h * h) ** 2 * beta**3)
    if k1 and k2 and h * h + 5 * k1:
        excess = 0.75 * (length - y * cos) / -k1 / (h * h + 5 * k1) * h * k2 / beta
        T[2, 2, 5] += 2 * k1 * y * excess
        T[2, 3, 5] += 2 * cos * excess
        T[3, 2, 5] -= 2 * k1 * cos * excess
        T[3, 3, 5] -= 2 * k1 * y * excess
        T[4, 2, 2] -= k1 * excess
        T[4, 3, 3] -= excess
    return T


def _cos_sin(square: float, length: float) -> tuple[float, float]:
    """cos(k s) and sin(k s) / k, of k^2."""
    k = cmath.sqrt(square)
    return cmath.cos(k * length).real, (cmath.sin(k * length) / k).real if square else length


def _sextupole(bend: Any, length: float | None, energy: float) -> Array:
    """Contribution of k2 to T of a bend's body if it were straight, [6, 6, 6]."""
    with_k2, without = (
        elements.Quadrupole(l=bend.l, k1=bend.k1, k2=k2).element for k2 in (bend.k2, 0.0)
    )
    first, second = (
        SecondTM.from_element(atom, TMTypes.MAIN, length).get_params(energy).T
        for atom in (with_k2, without)
    )
    return np.asarray(first - second)


def tilted(R: Array, T: Array, tilt: float) -> tuple[Array, Array]:
    """R and T in axes rotated by the tilt, as OCELOT's `get_rotated_R` and `_T`.

    The latter is compiled at its first call, which takes longer than all maps of a ring.
    """
    if tilt == 0:
        return R, T
    there, back = rot_mtx(tilt), rot_mtx(-tilt)
    return back @ R @ there, np.tensordot(back, there.T @ T @ there, 1)
