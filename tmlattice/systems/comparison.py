"""A figure of the paper beside ours, and why they differ."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Comparison:
    """One row of the table "paper / here / why they differ".

    Attributes:
        quantity: what it is, with its unit.
        paper: as printed there, or None where it prints none.
        here: as computed here.
        why: they differ, or what `here` was made with.
    """

    quantity: str
    paper: float | str | None
    here: float | str
    why: str = ""

    def as_json(self) -> dict[str, Any]:
        """The row for `reproduction.schema.json`."""
        return {
            "quantity": self.quantity,
            "paper": self.paper,
            "here": self.here,
            "why": self.why,
        }
