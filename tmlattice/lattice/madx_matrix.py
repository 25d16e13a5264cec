"""MAD-X's MATRIX, which AT's reader of that language has not."""

import re
from typing import Any

import numpy as np

_ENTRY = re.compile(r"rm([1-6])([1-6])")


def matrix_command() -> Any:
    """The class that AT's parser is to know as `matrix`; its second order is left out.

    MAD-X has (t, pt) where AT has (delta, ct): t = -ct, and delta is pt for a beam as fast as
    light.
    """
    import at
    from at.load.madx import _MadElement, mad_element

    class Matrix(_MadElement):  # type: ignore[misc]
        """A matrix element."""

        @mad_element  # type: ignore[untyped-decorator]
        def to_at(self, l: float = 0.0, **params: Any) -> list[Any]:  # noqa: E741
            """AT's matrix of it."""
            r = np.eye(6)
            for name, value in params.items():
                entry = _ENTRY.fullmatch(name)
                if entry:
                    r[int(entry[1]) - 1, int(entry[2]) - 1] = float(value)
            to_at = np.eye(6)
            to_at[4:, 4:] = [[0.0, 1.0], [-1.0, 0.0]]
            matrix = np.asfortranarray(to_at @ r @ to_at.T)
            return [at.M66(self.name, matrix, Length=float(l))]

    return Matrix
