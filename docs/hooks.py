"""What the pages take from the package when they are built: the catalogue, what may be assumed of
data, the schemas, example files, the packages and their imports.

A page has `<!-- effects -->`, `<!-- assumptions -->`, `<!-- statements -->`,
`<!-- schema measurement -->`, `<!-- example trajectory -->` or `<!-- packages -->` where one is to
be shown.
"""

import ast
import json
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

MARK = re.compile(
    r"^<!-- (effects|assumptions|statements|schema|example|packages) ?([\w-]*) -->$", re.MULTILINE
)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the marks of a page."""
    made = {"effects": lambda _: effects(), "assumptions": lambda _: assumptions(),
            "statements": lambda _: statements(), "schema": schema, "example": example,
            "packages": lambda _: packages()}  # fmt: skip
    return MARK.sub(lambda mark: made[mark[1]](mark[2]), markdown)


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
    from tmlattice.measurement.assume import ASSUMPTIONS, WORDS

    rows = [
        [
            f"`{name}`",
            own.words,
            ", ".join(WORDS[kind].partition(" ")[2] for kind in own.kinds),
        ]
        for name, own in ASSUMPTIONS.items()
    ]
    return table(["--assume", "what is written down wrongly", "of"], rows)


def statements() -> str:
    """The report's sentences, and what each requires."""
    from tmlattice.diagnosis.assessment import STATEMENTS

    rows = [[one.topic, f"`{one.name}`", one.requires] for one in STATEMENTS]
    return table(["topic", "sentence", "requires"], rows)


ROOT = Path(__file__).parent.parent
IMPORTED = re.compile(r"^ *(?:from|import) tmlattice\.(\w+)", re.MULTILINE)


def packages() -> str:
    """The packages in the order of their imports, with an arc to each that one needs directly."""
    tree = ast.parse((ROOT / "tests" / "test_walls.py").read_text(encoding="utf-8"))
    (order,) = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)
                and ast.unparse(node.targets[0]) == "ORDER")  # fmt: skip
    needs: dict[str, set[str]] = {name: set() for name in order}
    for path in (ROOT / "tmlattice").rglob("*.py"):
        own = path.relative_to(ROOT / "tmlattice").parts[0].removesuffix(".py")
        found = IMPORTED.findall(path.read_text(encoding="utf-8"))
        needs.get(own, set()).update(set(found) & set(order) - {own})
    every: dict[str, set[str]] = {}
    shown = []
    for row, own in enumerate(order):
        below = set().union(*(every[name] for name in needs[own]))
        every[own] = needs[own] | below
        y = 14 + 24 * row
        shown.append(f'<text x="0" y="{y + 4}">{own}</text>')
        for name in needs[own] - below:
            other = 14 + 24 * order.index(name)
            shown.append(
                f'<path data-from="{own}" data-to="{name}" marker-end="url(#tip)" '
                f'd="M 110 {y} C {130 + y - other} {y}, {130 + y - other} {other}, 114 {other}"/>'
            )
    return (
        f'<svg viewBox="0 0 420 {24 * len(order) + 8}" role="img" style="max-width: 32em" '
        'fill="currentColor" font-size="13"><defs><marker id="tip" refX="8" refY="4" '
        'markerWidth="8" markerHeight="8" orient="auto"><path d="M 8 0 L 0 4 L 8 8 z" '
        'transform="rotate(180 4 4)"/></marker></defs><g fill="none" stroke="currentColor" '
        f'stroke-opacity="0.6">{"".join(s for s in shown if s[1] == "p")}</g>'
        f"{''.join(s for s in shown if s[1] == 't')}</svg>"
    )


def example(name: str) -> str:
    """The files of a measurement of two shots, or steps, and two monitors, as they are written."""
    import numpy as np

    from tmlattice.measurement import Measurement, OrbitResponse, RfStep, write_measurement

    monitors, noise = ("bpm_1", "bpm_2"), np.full((2, 2), 2e-5)
    readings = np.array(
        [[[1.23e-3, -4.5e-4], [9.8e-4, 1.2e-4]], [[-3.1e-4, 8.9e-4], [4.55e-4, np.nan]]]
    )
    written: Any = OrbitResponse(
        ("h1",), ("x",), np.array([1e-4]), monitors, readings[:1], np.full((2, 2), 2e-6),
        RfStep(499.65e6, 3840, 100.0, readings[1]), "my_ring.mat", 6.0,
    )  # fmt: skip
    if name == "trajectory":
        launches = np.array([[1e-3, 0, 0, 0, 0], [0, 0, 1e-3, 0, 0]])
        written = Measurement(launches, readings[:, None], monitors, noise, 0.1 * launches)
    with TemporaryDirectory() as place:
        folder = Path(place) / name
        write_measurement(folder, written)
        files_of_it = sorted(folder.iterdir())
        return "\n\n".join(
            f'```{path.suffix[1:]} title="{path.name}"\n{path.read_text().strip()}\n```'
            for path in files_of_it
        )


def schema(name: str) -> str:
    """The fields of one of the package's JSON files, from its schema."""
    path = files("tmlattice") / "schemas" / f"{name}.schema.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    rows = [[f"`{key}`", kind, text] for key, kind, text in _fields(document, document, "")]
    return f"{document.get('description', '')}\n\n" + table(["field", "type", "meaning"], rows)


def _fields(
    root: dict[str, Any], node: dict[str, Any], prefix: str
) -> Iterator[tuple[str, str, str]]:
    # a file of one kind, of another; what several have is described by the first
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
