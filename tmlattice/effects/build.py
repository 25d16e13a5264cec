"""Errors of one element, for an engine that builds its elements by itself.

They state physical quantities; their effect on the beam is the engine's, so that no formula of the
model's maps is shared.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

Where = Literal["entrance", "middle"]


@dataclass
class Build:
    """Differences of the element from the design.

    Attributes:
        scale: of its strength: a quadrupole's or sextupole's, a bend's field, a corrector's kick.
        dx, dy: of its centre, m.
        ds: of its field along the beam, m.
        roll: of its body, or of a corrector's kick, from x towards y, rad.
        kick_x, kick_y: of a corrector beyond its setting, along its own axes, rad.
        k1: gradient of a bend beyond its own, 1/m2.
        loss: energy loss, in units of the expected one.
        gradients: thin quadrupoles, by place (normal, skew), 1/m; see `add_gradient`.
        slopes: other thin kicks, by place, 1/m; see `add_slopes`.
    """

    scale: float = 1.0
    dx: float = 0.0
    dy: float = 0.0
    ds: float = 0.0
    roll: float = 0.0
    kick_x: float = 0.0
    kick_y: float = 0.0
    k1: float = 0.0
    loss: float = 0.0
    gradients: dict[Where, tuple[float, ...]] = field(default_factory=lambda: defaultdict(tuple))
    slopes: dict[Where, tuple[float, ...]] = field(default_factory=lambda: defaultdict(tuple))

    def add_gradient(self, where: Where, normal: float = 0.0, skew: float = 0.0) -> None:
        """A thin quadrupole, px -= normal x, py += normal y, and a skew one, px += skew y, ..."""
        self.gradients[where] = _sum(self.gradients[where], (normal, skew))

    def add_slopes(self, where: Where, *slopes: float) -> None:
        """A thin kick of (d px / dx, d px / dy, d py / dx, d py / dy)."""
        self.slopes[where] = _sum(self.slopes[where], slopes)


def _sum(old: Sequence[float], new: Sequence[float]) -> tuple[float, ...]:
    return tuple(a + b for a, b in zip(old or (0.0,) * len(new), new, strict=True))
