"""Methods that rooms above provide, loaded when they are asked for.

Imports run one way (tests/test_walls.py), and yet a diagnosis is to draw itself, which a room above
its own does. So a room names such a function in words, and it is looked up when somebody calls it:
nothing is imported before, and every room can still be imported alone. The tests see to it that the
words are right.

>>> class Ring:
...     plot = Method("tmlattice.plots.speaking", "plot_ring", "Draw it.")
"""

from collections.abc import Callable
from importlib import import_module
from types import MethodType
from typing import Any, cast


class Method:
    """A method that a function of another module provides; its first argument is the object.

    Args:
        module, name: where the function is.
    """

    def __init__(self, module: str, name: str, doc: str) -> None:
        self.module, self.name = module, name
        self.__doc__ = doc

    def __get__(self, instance: Any, owner: type) -> Any:
        """Bound to the object; of the class, itself."""
        if instance is None:
            return self
        return MethodType(self.function, instance)

    @property
    def function(self) -> Callable[..., Any]:
        """The function, its module loaded now."""
        return cast("Callable[..., Any]", getattr(import_module(self.module), self.name))


class ClassMethod(Method):
    """The same of a class: the first argument is the class."""

    def __get__(self, instance: Any, owner: type) -> Any:
        """Bound to the class."""
        return MethodType(self.function, owner)
