"""Elements of MAD-X that AT's reader of that language has not."""

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ENTRY = re.compile(r"rm([1-6])([1-6])")

NO_FIELD = ("ecollimator", "rcollimator", "placeholder", "hacdipole", "vacdipole", "twcavity")
"""Ways, as far as closed orbits and optics go (AC dipoles stand still)."""
LEFT_OUT = ("beambeam", "changeref", "nllens", "srotation", "translation", "xrotation", "yrotation")
"""Elements that act, and that no element here does."""
ACTS = frozenset(
    name.upper() for name in (*LEFT_OUT, "crabcavity", "elseparator", "rfmultipole", "solenoid")
)
"""What becomes a way here or in AT's reader, and is told as left out."""


def more_elements() -> dict[str, Any]:
    """Classes that AT's parser is to know, by MAD-X's name."""
    from at.load.file_input import ignore_class
    from at.load.madx import _MadElement

    ways = {name: ignore_class(name, _MadElement) for name in (*NO_FIELD, *LEFT_OUT)}
    acting = {"matrix": _matrix(), "dipedge": _dipedge(), "solenoid": _solenoid()}
    return {**ways, **acting, "rbend": _rbend()}


def _as_matrix(name: str, r: Array, length: float = 0.0) -> list[Any]:
    """MAD-X has (t, pt) where AT has (delta, ct): t = -ct, and delta is pt for a beam as fast as
    light."""
    import at

    to_at = np.eye(6)
    to_at[4:, 4:] = [[0.0, 1.0], [-1.0, 0.0]]
    return [at.M66(name, np.asfortranarray(to_at @ r @ to_at.T), Length=length)]


def _matrix() -> Any:
    from at.load.madx import _MadElement, mad_element

    class Matrix(_MadElement):  # type: ignore[misc]
        """MATRIX, of first order alone."""

        @mad_element  # type: ignore[untyped-decorator]
        def to_at(self, l: float = 0.0, **params: Any) -> list[Any]:  # noqa: E741
            """AT's matrix of it."""
            r = np.eye(6)
            for name, value in params.items():
                entry = _ENTRY.fullmatch(name)
                if entry:
                    r[int(entry[1]) - 1, int(entry[2]) - 1] = float(value)
            return _as_matrix(self.name, r, float(l))

    return Matrix


def _dipedge() -> Any:
    from at.load.madx import _MadElement, mad_element

    class Dipedge(_MadElement):  # type: ignore[misc]
        """DIPEDGE: R21 = H tan(E1), R43 = -H tan(E1 - 2 HGAP FINT H (1 + sin(E1)^2) / cos(E1))."""

        @mad_element  # type: ignore[untyped-decorator]
        def to_at(
            self,
            h: float = 0.0,
            e1: float = 0.0,
            hgap: float = 0.0,
            fint: float = 0.0,
            **params: Any,
        ) -> list[Any]:
            """AT's matrix of it."""
            h, e1 = float(h), float(e1)
            fringe = 2 * float(hgap) * float(fint) * h * (1 + math.sin(e1) ** 2) / math.cos(e1)
            r = np.eye(6)
            r[1, 0], r[3, 2] = h * math.tan(e1), -h * math.tan(e1 - fringe)
            return _as_matrix(self.name, r)

    return Dipedge


def _solenoid() -> Any:
    import at
    from at.load.madx import _MadElement, mad_element

    class Solenoid(_MadElement):  # type: ignore[misc]
        """SOLENOID; its KS is B / (B rho), as AT's K; a thin one is left out."""

        @mad_element  # type: ignore[untyped-decorator]
        def to_at(self, l: float = 0.0, ks: float = 0.0, **params: Any) -> list[Any]:  # noqa: E741
            """AT's solenoid."""
            length, field = float(l), float(ks)
            if not length:
                return [at.Marker(self.name)]
            method = "SolenoidLinearPass"
            return [at.Element(self.name, Length=length, K=field, PassMethod=method)]

    return Solenoid


def _rbend() -> Any:
    from at.load.madx import rbend, sbend

    class Rbend(rbend):  # type: ignore[misc]
        """RBEND, of no angle where none is said: AT's own has then no length."""

        @property
        def length(self) -> Any:
            """m, along the arc."""
            return super().length if float(self.get("angle", 0.0)) else self["l"]

        def to_at(self, **params: Any) -> Any:
            """AT's dipole."""
            if float(params.get("angle", 0.0)):
                return super().to_at(**params)
            return sbend.to_at(self, **{**params, "angle": 0.0})

    return Rbend
