"""One effect at one place, by one amount."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """A difference between a machine and its model.

    Attributes:
        effect: a name in the catalogue.
        element: the element, or the family, that it sits on; None for the beam and for effects of
            all elements of a kind.
        amount: in the effect's unit and sign convention.
    """

    effect: str
    element: str | None
    amount: float

    def __str__(self) -> str:
        place = f" {self.element}" if self.element else ""
        return f"{self.effect}{place} {self.amount:g}"
