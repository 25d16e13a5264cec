"""Names that fit into a drawing."""

LONGEST = 22
"""Letters of a name that fit."""


def brief(name: str) -> str:
    """A name; of a long one the end, which is where names differ."""
    return name if len(name) <= LONGEST else f"…{name[-LONGEST:]}"


def plural(kind: str) -> str:
    """Of a kind of elements."""
    kind = "BPM" if kind == "monitor" else kind
    return f"{kind[:-1]}ies" if kind.endswith("y") else f"{kind}s"
