"""What goes wrong with sextupoles."""

from tmlattice.effects.effect import (
    ErrorEffect,
    FamilyEffect,
    RingEffect,
    StrengthEffect,
    register,
)
from tmlattice.lattice import Element


class _OnSextupole(RingEffect):
    group = "sextupoles"
    sits_on_text = "sextupoles with k2 not 0"

    def sits_on(self, element: Element) -> bool:
        """Powered sextupoles."""
        return element.kind == "sextupole" and element.k2 != 0


@register
class SextupoleStrength(_OnSextupole, StrengthEffect):
    """A sextupole's strength is not what its setting says."""

    name = "sextupole_strength"
    words = "wrong strength of a sextupole"
    headline = True
    strength = "k2"
    unit = "relative"
    sign = "k2 becomes (1 + amount) k2; -2 is a reversed one"
    quantity = "integrated strength"
    recommended_action = "set or repair the strength of {}"
    to_check = (
        "Read back the current of its supply; near -200 % its cables are exchanged, near -100 % it "
        "is off."
    )
    background = 5e-3
    largest = 2.0


@register
class SextupoleOffsetX(_OnSextupole, ErrorEffect):
    """A sextupole that stands beside its axis."""

    name = "sextupole_offset_x"
    responds = True
    words = "sextupole displaced horizontally"
    curved = True  # the field at the offset is quadratic
    error = "dx"
    unit = "m"
    sign = "x of the magnet's centre"
    quantity = "horizontal displacement"
    recommended_action = "move {} back horizontally"
    to_check = "Survey its horizontal position against the quadrupoles beside it."
    background = 1e-4
    largest = 3e-3


@register
class SextupoleOffsetY(_OnSextupole, ErrorEffect):
    """A sextupole that stands above or below its axis."""

    name = "sextupole_offset_y"
    responds = True
    words = "sextupole displaced vertically"
    curved = True  # the field at the offset is quadratic
    error = "dy"
    unit = "m"
    sign = "y of the magnet's centre"
    quantity = "vertical displacement"
    recommended_action = "move {} back vertically"
    to_check = "Survey its height against the quadrupoles beside it."
    background = 1e-4
    largest = 3e-3


@register
class FamilySextupole(_OnSextupole, FamilyEffect):
    """The power supply of a family of sextupoles is off: all of them have the same error."""

    name = "family_sextupole"
    words = "wrong strength of a whole family of sextupoles"
    usual = False  # between two measurements of one machine, or where somebody names it
    strength = "k2"
    unit = "relative"
    sign = "k2 of every member becomes (1 + amount) k2; -2 reverses them"
    quantity = "integrated strength of every member"
    recommended_action = "set or repair the supply of the family {}"
    to_check = (
        "Read back the current of the family's common supply with a second instrument; compare its "
        "setting with the lattice file."
    )
    largest = 2.0
    sits_on_text = "families of two or more sextupoles with k2 not 0, by the family's name"
