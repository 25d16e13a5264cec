"""The paper's other systems: the methods for rings, on systems that fit on a page.

Each module holds its equation, its map, what is learned from one solution, and `comparisons` of the
paper's figures with ours. `tmlattice dev reproduce` runs them all.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Comparison:
    """A figure of the paper compared with ours.

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
