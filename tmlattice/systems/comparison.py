"""A figure of the paper compared with ours, and the reason of a difference."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Comparison:
    """One row of the table "paper / here / why they differ".

    Attributes:
        quantity: its description and unit.
        paper: as printed there, or None.
        here: as computed here.
        why: they differ, or how `here` was computed.
    """

    quantity: str
    paper: float | str | None
    here: float | str
    why: str = ""
