"""Errors of sextupoles."""

from tmlattice.effects.effect import (
    FamilyEffect,
    OffsetX,
    OffsetY,
    RingEffect,
    StrengthEffect,
    register,
)
from tmlattice.lattice import Element


class _OnSextupole(RingEffect):
    group = "sextupoles"
    sits_on_text = "sextupoles with k2 not 0"

    def sits_on(self, element: Element) -> bool:
        """Whether an element is a powered sextupole."""
        return element.kind == "sextupole" and element.k2 != 0


@register
class SextupoleStrength(_OnSextupole, StrengthEffect):
    """A wrong strength of a sextupole."""

    name = "sextupole_strength"
    words = "wrong strength of a sextupole"
    headline = True
    strength = "k2"
    sign = "k2 becomes (1 + amount) k2; -2 is a reversed one"
    quantity = "integrated strength"
    recommended_action = "set or repair the strength of {}"
    to_check = (
        "Read back the current of its supply; near -200 % its polarity is reversed, near -100 % it "
        "is off."
    )
    background = 5e-3
    largest = 2.0


@register
class SextupoleOffsetX(_OnSextupole, OffsetX):
    """A horizontal misalignment of a sextupole."""

    name = "sextupole_offset_x"
    responds = True
    words = "sextupole displaced horizontally"
    curved = True  # the field at the offset is quadratic
    to_check = "Survey its horizontal position against the adjacent quadrupoles."
    largest = 3e-3


@register
class SextupoleOffsetY(_OnSextupole, OffsetY):
    """A vertical misalignment of a sextupole."""

    name = "sextupole_offset_y"
    responds = True
    words = "sextupole displaced vertically"
    curved = True  # the field at the offset is quadratic
    to_check = "Survey its height against the adjacent quadrupoles."
    largest = 3e-3


@register
class FamilySextupole(_OnSextupole, FamilyEffect):
    """A wrong current of a sextupole family's power supply: a common error of its members."""

    name = "family_sextupole"
    words = "wrong strength of a whole family of sextupoles"
    usual = False  # between two measurements of one machine, or on request
    strength = "k2"
    sign = "k2 of every member becomes (1 + amount) k2; -2 reverses them"
    quantity = "integrated strength of every member"
    largest = 2.0
    sits_on_text = "families of two or more sextupoles with k2 not 0, by the family's name"
