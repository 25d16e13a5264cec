"""What the pages take from the package when they are built: the catalogue, what may be assumed of
data, the schemas.

A page says `<!-- effects -->`, `<!-- assumptions -->` or `<!-- schema measurement -->` where one
is to stand.
"""

import json
import re
from collections.abc import Iterator
from importlib.resources import files
from typing import Any

MARK = re.compile(r"^<!-- (effects|assumptions|schema) ?([\w-]*) -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the marks of a page."""
    made = {"effects": effects, "assumptions": assumptions}
    return MARK.sub(lambda mark: made[mark[1]]() if mark[1] in made else schema(mark[2]), markdown)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in lines)


def effects() -> str:
    """The catalogue, in its own order."""
    from tmlattice.effects import CATALOGUE

    rows = [
        [
            f"`{effect.name}`" + ("" if effect.usual else " (\\*)"),
            effect.words,
            effect.unit,
            effect.sits_on_text,
            effect.sign.replace("*", "\\*"),
            "-" if effect.background is None else f"{effect.background:g}",
            f"{effect.largest:g}",
        ]
        for effect in CATALOGUE.values()
    ]
    head = [
        "effect",
        "in words",
        "unit",
        "sits on",
        "what a positive amount does",
        "usual rms",
        "largest",
    ]
    return table(head, rows)


def assumptions() -> str:
    """What may be assumed of data, in its own order."""
    from tmlattice.measurement.assume import ASSUMPTIONS

    rows = [
        [
            f"`{name}`",
            own.words,
            "yes" if own.trajectory else "",
            "yes" if own.response else "",
        ]
        for name, own in ASSUMPTIONS.items()
    ]
    return table(["--assume", "what is written down wrongly", "first turns", "responses"], rows)


def schema(name: str) -> str:
    """The fields of one of the package's JSON files, from its schema."""
    path = files("tmlattice") / "schemas" / f"{name}.schema.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    rows = [[f"`{key}`", kind, text] for key, kind, text in _fields(document, document, "")]
    return f"{document.get('description', '')}\n\n" + table(["field", "type", "meaning"], rows)


def _fields(
    root: dict[str, Any], node: dict[str, Any], prefix: str
) -> Iterator[tuple[str, str, str]]:
    # a file of one kind, of another; what stands in several is told of the first
    kinds = [node.get("else", {}), node.get("then", {})]
    kinds += [one.get("then", {}) for one in node.get("allOf", [])]
    found: dict[str, Any] = {}
    for branch in [node, *kinds]:
        found = branch.get("properties", {}) | found
    for key, child in found.items():
        where = f"{prefix}{key}"
        text = child.get("description", "")
        inner = _resolved(root, child)
        text = text or inner.get("description", "")
        text = text or ("Version of the package that wrote it." if where == "package" else "")
        yield where, _kind(root, inner), text
        below = inner
        for option in inner.get("anyOf", inner.get("oneOf", [])):
            if _resolved(root, option).get("properties"):
                below = _resolved(root, option)
        if "items" in below:
            below, where = _resolved(root, below["items"]), f"{where}[]"
        yield from _fields(root, below, f"{where}.")


def _resolved(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in node:
        place: Any = root
        for step in node["$ref"].removeprefix("#/").split("/"):
            place = place[step]
        node = {**place, **{k: v for k, v in node.items() if k != "$ref"}}
    return node


def _kind(root: dict[str, Any], node: dict[str, Any]) -> str:
    if "const" in node:
        return f"`{json.dumps(node['const'])}`"
    if "enum" in node:
        return ", ".join(f"`{json.dumps(value)}`" for value in node["enum"])
    for several in ("anyOf", "oneOf"):
        if several in node:
            kinds = [_kind(root, _resolved(root, option)) for option in node[several]]
            return " or ".join(dict.fromkeys(" or ".join(kinds).split(" or ")))
    kind = node.get("type", "object")
    text = " or ".join(kind) if isinstance(kind, list) else str(kind)
    if kind == "array" and isinstance(node.get("items"), dict):
        return f"array of {_kind(root, _resolved(root, node['items']))}"
    return text
