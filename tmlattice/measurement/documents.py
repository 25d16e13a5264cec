"""JSON documents that carry `format` and `version`: read strictly, checked by their schema."""

import difflib
import hashlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tmlattice.errors import MeasurementError, UnknownNameError, plain
from tmlattice.input_files import check_shape, content_of, json_of, schema_of, short

NEAR = 0.8
"""Likeness of a key to a known one from which it is taken for a slip of the pen."""


def read_document(
    path: Path,
    schema: str,
    name: str,
    version: int = 1,
    first: Callable[[dict[str, Any]], None] = lambda document: None,
) -> dict[str, Any]:
    """A JSON file of the format `name`, as its schema has it.

    Raises:
        MeasurementError: no such file, not UTF-8, not JSON (with the line), another format or
            version, or not as the schema has it (with the place).
    """
    document = json_of(path, MeasurementError)
    if not isinstance(document, dict) or document.get("format") != name:
        found = document.get("format") if isinstance(document, dict) else None
        raise MeasurementError(f'{path}: its "format" is {short(found)}; it should be "{name}"')
    if document.get("version") != version or isinstance(document["version"], bool):
        raise MeasurementError(
            f'{path}: its "version" is {short(document.get("version"))}; this package reads '
            f"{version}: write it in that version, or update tmlattice"
        )
    first(document)
    check_shape(path, document, schema, MeasurementError)
    if said := _misspelt(document, schema_of(schema).schema):
        raise MeasurementError(f"{path}: {said}")
    return document


def _misspelt(document: dict[str, Any], schema: dict[str, Any]) -> str | None:
    """The message about a misspelt key; unknown keys belong to whoever wrote the file."""
    parts = [schema, schema.get("then", {}), schema.get("else", {})]
    known = {name: rule for part in parts for name, rule in part.get("properties", {}).items()}
    places: list[tuple[str, dict[str, Any], Iterable[str]]] = [("it", document, known)]
    for name, rule in known.items():
        own = rule.get("items", {}).get("properties", {})
        if own and isinstance(document.get(name), list):
            places += [(f"{name}[{i}]", item, own) for i, item in enumerate(document[name])]
    for place, found, names in places:
        for key in found.keys() - set(names):
            near = difflib.get_close_matches(key.casefold(), list(names), 1, NEAR)
            if near and near[0] not in found:
                return f'{place} has the key "{plain(key, 60)}"; did you mean "{near[0]}"?'
    return None


def check_table(document: dict[str, Any], table: Path) -> None:
    """Whether a table is whole, and belongs to its document, where that holds a digest;
    MeasurementError: it cannot be read, or is another."""
    if (stated := document.get("table_sha256")) is None:
        return
    content = content_of(table, MeasurementError).replace(b"\r", b"")  # of any system's lines
    if hashlib.sha256(content).hexdigest() != stated:
        raise MeasurementError(
            f"{table}: it is not the table that measurement.json was written with: cut off, "
            'damaged or changed; copy it anew, or, if you changed it, take "table_sha256" out of '
            "measurement.json"
        )


@contextmanager
def located(place: Path) -> Iterator[None]:
    """Puts the file in front of what is wrong in it."""
    try:
        yield
    except (MeasurementError, UnknownNameError) as error:
        raise MeasurementError(f"{place}: {error}") from error
