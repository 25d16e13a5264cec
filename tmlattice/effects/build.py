"""Errors of one element, for an engine that builds its elements by itself.

They state physical quantities; their effect on the beam is the engine's, so that no formula of the
model's maps is shared.
"""

from dataclasses import dataclass

from tmlattice.lattice.ring import Slopes, summed


@dataclass
class Build:
    """Differences of the element from the design; those of `lattice.ring.Errors` have their names.

    Attributes:
        scale: of its strength: a quadrupole's or sextupole's, a bend's field, a corrector's kick.
        dx, dy: of its centre, m.
        ds: of its field along the beam, m.
        roll: of its body, or of a corrector's kick, from x towards y, rad.
        kick_x, kick_y: of a corrector beyond its setting, along its own axes, rad.
        k1: gradient of a bend beyond its own, 1/m2.
        loss: energy loss, in units of the expected one.
        k1l, k1sl: thin quadrupole in the middle, px -= k1l x, py += k1l y, and a skew one,
            px += k1sl y, py += k1sl x, 1/m.
        entrance_k1l: thin quadrupole at the entrance, 1/m.
        entrance, middle: other thin kicks there, 1/m.
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
    k1l: float = 0.0
    k1sl: float = 0.0
    entrance_k1l: float = 0.0
    entrance: Slopes = (0.0, 0.0, 0.0, 0.0)
    middle: Slopes = (0.0, 0.0, 0.0, 0.0)

    def add(self, name: str, amount: float | Slopes) -> None:
        """Add an amount to one of the differences."""
        setattr(self, name, summed(getattr(self, name), amount))
