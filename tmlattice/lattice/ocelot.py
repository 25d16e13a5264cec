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

import contextlib
import importlib.util
import inspect
import io
import logging
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

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
    from ocelot.cpbd.high_order import t_nnn
    from ocelot.cpbd.r_matrix import rot_mtx
    from ocelot.cpbd.transformations.second_order import SecondTM
    from ocelot.cpbd.transformations.transformation import TMTypes

logging.getLogger("ocelot").setLevel(logging.ERROR)

__all__ = ["Magnet", "OpticElement", "SecondTM", "TMTypes", "elements", "rot_mtx", "t_nnn"]
