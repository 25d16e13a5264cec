"""Records of a diagnosis as the objects of its JSON file, and back.

A field with the metadata `named(...)` has that name in the file, one with `OPTIONAL` is left out
where it is None or empty, one with `HIDDEN` always. A tuple with `of(...)`, or each of several, is
an object with these keys.
"""

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

OPTIONAL, HIDDEN = {"optional": True}, {"hidden": True}


def named(key: str) -> dict[str, str]:
    """Metadata of a field with another name in the file."""
    return {"key": key}


def of(*keys: str) -> dict[str, tuple[str, ...]]:
    """Metadata of a field of tuples that are objects in the file."""
    return {"of": keys}


def encoded(value: Any) -> Any:
    """A value as JSON has it: a record as an object, by its `as_json` if it has one; a tuple as a
    list."""
    if hasattr(value, "as_json"):
        return value.as_json()
    if is_dataclass(value):
        return record_of(value)
    if isinstance(value, Mapping):
        return {key: encoded(item) for key, item in value.items()}
    return [encoded(item) for item in value] if isinstance(value, tuple | list) else value


def record_of(record: Any) -> dict[str, Any]:
    """The fields of a record as JSON has them, without hidden ones and empty optional ones."""
    own = ((field, getattr(record, field.name)) for field in fields(record))
    return {
        _key(field): encoded(_object(value, field.metadata.get("of")))
        for field, value in own
        if "hidden" not in field.metadata and ("optional" not in field.metadata or value)
    }


def _object(value: Any, keys: tuple[str, ...] | None) -> Any:
    if keys is None or value is None:
        return value
    if all(isinstance(own, tuple) for own in value):
        return [_object(own, keys) for own in value]
    return dict(zip(keys, value, strict=True))


def _key(field: "Field[Any]") -> str:
    return str(field.metadata.get("key", field.name))


def decoded(kind: Any, value: Any) -> Any:
    """A value of a JSON file as the type that an attribute has.

    Null is NaN for a number. A tuple of fixed length may be an object, by the order of its keys.

    Raises:
        KeyError: a field that is absent.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        if value is None and NoneType in inner:
            return None
        return decoded(next(one for one in inner if one is not NoneType), value)
    if kind is float:
        return float("nan") if value is None else float(value)
    if is_dataclass(kind):
        return _record(kind, value)
    if origin is tuple:
        items = list(value.values()) if isinstance(value, Mapping) else value
        if inner[-1] is Ellipsis:
            return tuple(decoded(inner[0], item) for item in items)
        return tuple(decoded(one, item) for one, item in zip(inner, items, strict=True))
    if origin is Literal or not isinstance(origin, type) or not issubclass(origin, Mapping):
        return value
    return {key: decoded(inner[1], item) for key, item in value.items()}


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)


def stored_fields(kind: Any, row: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a record's fields that a file holds, by their names here.

    Raises:
        KeyError: one is absent that is not optional.
    """
    own = (field for field in fields(kind) if "hidden" not in field.metadata)
    return {
        field.name: row[_key(field)]
        for field in own if "optional" not in field.metadata or _key(field) in row
    }  # fmt: skip


def _record(kind: Any, row: Mapping[str, Any]) -> Any:
    own = {}
    for field in fields(kind):
        key = _key(field)
        if key in row:
            own[field.name] = decoded(_hints(kind)[field.name], row[key])
        elif field.default is MISSING and field.default_factory is MISSING:
            raise KeyError(key)
    return kind(**own)
