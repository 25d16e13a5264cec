"""JSON documents that carry `format` and `version`: read strictly, checked by their schema."""

import difflib
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from tmlattice.errors import MeasurementError, UnknownNameError, plain

MOST_DIGITS = 300
"""Of a whole number: as a float it would be beyond all of them."""
NEAR = 0.8
"""Likeness of a key to a known one from which it is taken for a slip of the pen."""


@cache
def _validator(schema: str) -> Any:
    from jsonschema import Draft202012Validator

    text = (files("tmlattice") / "schemas" / f"{schema}.schema.json").read_text(encoding="utf-8")
    return Draft202012Validator(json.loads(text))


def read_document(
    path: Path,
    schema: str,
    name: str,
    version: int = 1,
    first: Callable[[dict[str, Any]], None] = lambda document: None,
) -> dict[str, Any]:
    """A JSON file of the format `name`, as its schema has it.

    Args:
        path: the file.
        schema: file name in `tmlattice/schemas`, without `.schema.json`.
        name: what `format` has to be.
        version: the one that can be read.
        first: looks before the schema does, which takes its time over long lists.

    Raises:
        MeasurementError: no such file, not UTF-8, not JSON (with the line), another format or
            version, or not as the schema has it (with the place).
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise MeasurementError(f"cannot read '{path}': {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise not_utf8(path, error) from error
    try:
        document = json.loads(
            text, object_pairs_hook=_once, parse_constant=_no_constant, parse_int=_whole
        )
    except json.JSONDecodeError as error:
        raise MeasurementError(
            f"{path}, line {error.lineno}: not JSON ({error.msg}); mend it, or write it anew"
        ) from error
    except (ValueError, RecursionError) as error:
        raise MeasurementError(f"{path}: {error}") from error
    if not isinstance(document, dict) or document.get("format") != name:
        found = document.get("format") if isinstance(document, dict) else None
        raise MeasurementError(f'{path}: its "format" is {_short(found)}; it should be "{name}"')
    if document.get("version") != version or isinstance(document["version"], bool):
        raise MeasurementError(
            f'{path}: its "version" is {_short(document.get("version"))}; this package reads '
            f"{version}: write it in that version, or update tmlattice"
        )
    first(document)
    from jsonschema.exceptions import best_match

    wrong = best_match(_validator(schema).iter_errors(document))
    if wrong is not None:
        raise MeasurementError(f"{path}: {_explain(wrong)}")
    if said := _misspelt(document, _validator(schema).schema):
        raise MeasurementError(f"{path}: {said}")
    return document


def _misspelt(document: dict[str, Any], schema: dict[str, Any]) -> str | None:
    """What to say of a key that is all but a known one; others are whoever wrote them's own."""
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


class Digest:
    """What says that a table is the one that its measurement.json was written with.

    Lines may end as any system ends them.
    """

    def __init__(self) -> None:
        self._sum = hashlib.sha256()

    def add(self, text: bytes) -> None:
        """More of the table."""
        self._sum.update(text.replace(b"\r", b""))

    def told(self) -> str:
        """64 characters."""
        return self._sum.hexdigest()


def check_table(document: dict[str, Any], table: Path) -> None:
    """Whether a table is whole, and belongs to the document beside it, where that says so.

    Raises:
        MeasurementError: it cannot be read, or is another.
    """
    if (stated := document.get("table_sha256")) is None:
        return
    digest = Digest()
    try:
        with table.open("rb") as file:
            while part := file.read(1 << 20):
                digest.add(part)
    except OSError as error:
        raise MeasurementError(f"cannot read '{table}': {error.strerror or error}") from error
    if digest.told() != stated:
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


def not_utf8(path: Path, error: UnicodeDecodeError, before: int = 0) -> MeasurementError:
    """The error for a text file in another encoding; `before` lines were already read."""
    line = before + error.object[: error.start].count(b"\n") + 1
    return MeasurementError(f"{path}, line {line}: not UTF-8; save the file as UTF-8")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for key, value in pairs:
        if key in made:
            raise ValueError(f'the key "{key}" stands twice in one object; keep one of the two')
        made[key] = value
    return made


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON; a number that is not finite is written as null")


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits; write it with an exponent")
    return int(digits)


def _short(value: Any) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 40 else f"{text[:37]}..."


_KINDS = {
    "number": "a number",
    "integer": "a whole number",
    "string": "a text",
    "object": "an object {...}",
    "array": "a list [...]",
    "null": "null",
    "boolean": "true or false",
}


def _explain(error: Any) -> str:
    """One sentence: where, what stands there, what should."""
    place = "".join(
        f"[{step}]" if isinstance(step, int) else f".{step}" for step in error.absolute_path
    ).lstrip(".")
    kind, wanted, value = error.validator, error.validator_value, error.instance
    if kind == "required":
        missing = next(name for name in wanted if name not in value)
        return f'{place or "it"} has no "{missing}"; add it'
    if kind == "additionalProperties":
        known = error.schema.get("properties", {})
        strange = next((name for name in value if name not in known), "?")
        return f'{place} has a key "{strange}"; known are {", ".join(known)}'
    if kind == "type":
        types = [wanted] if isinstance(wanted, str) else wanted
        should = f"should be {' or '.join(_KINDS[t] for t in types)}"
    elif kind == "enum":
        should = f"should be one of {', '.join(_short(w) for w in wanted)}"
    elif kind == "exclusiveMinimum":
        should = f"should be above {wanted}"
    elif kind == "minimum":
        should = f"should be {wanted} or more"
    elif kind in ("minItems", "minProperties", "minLength"):
        should = "should not be empty"
    else:
        should = f"breaks the rule {kind} = {_short(wanted)}"
    return f"{place or 'it'} is {_short(value)}; it {should}"
