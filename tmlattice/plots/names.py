"""Names that fit into a drawing."""

LONGEST = 22
"""Letters of a name that have room."""


def brief(name: str) -> str:
    """A name; of a long one the end, which is where names differ."""
    return name if len(name) <= LONGEST else f"…{name[-LONGEST:]}"
