"""A cause: one imperfection, at one place, of one amount."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """One effect of the catalogue on one element of a ring.

    Attributes:
        effect: the effect's name, `quadrupole_gradient` say.
        element: name of the element, of the family (`family_gradient`), or None for an effect
            of the beam or of all elements of a kind.
        amount: in the effect's unit (SI; relative changes as fractions).
    """

    effect: str
    element: str | None
    amount: float
