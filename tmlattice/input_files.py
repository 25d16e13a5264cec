"""Files that are read as text: regular ones alone, bounded in size, and what JSON and YAML allow.

Everything that a user or another program hands over is opened here, or by
`tmlattice.lattice.mat_file`.
"""

import difflib
import gc
import json
import os
import re
import stat
import tomllib
from functools import cache
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

from tmlattice.errors import TmlatticeError, plain

_FORTRAN = re.compile(r"(?<=[\d.])d(?=[+-]?\d)", re.IGNORECASE)
"""An exponent as Fortran writes it."""

MOST_BYTES = 1 << 30
"""Of a file of text."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
MOST_DIGITS = 300
"""Of a whole number: as a float it would be beyond all of them."""
LARGEST = 10**MOST_DIGITS
MOST_YAML, MOST_NODES, DEEPEST = 4 << 20, 100_000, 20
"""Of a YAML file: bytes, keys and values, and how deep they are nested."""


def check_regular(path: Path, error: type[TmlatticeError]) -> int:
    """Size of a file in bytes; error: no such file, or a folder, pipe or device."""
    try:
        status = path.stat()
    except (OSError, ValueError) as problem:
        said = getattr(problem, "strerror", None) or problem
        raise error(f"cannot read '{path}': {said}") from problem
    _check(path, status, error)
    return status.st_size


def _check(path: Path, status: os.stat_result, error: type[TmlatticeError]) -> None:
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
        raise error(f"cannot read '{path}': it is {what}; give a file")
    if status.st_size > MOST_BYTES:
        raise error(f"'{path}' is larger than {MOST_BYTES >> 20} MB; give a smaller file")


def content_of(path: Path, error: type[TmlatticeError]) -> bytes:
    """The bytes of a regular file, no more than it states to have.

    A pipe is not waited for. Nothing is read of an endless file, such as one of a virtual file
    system.

    Raises:
        error: it cannot be read, is no regular file, or is larger than `MOST_BYTES`.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        try:
            status = os.fstat(descriptor)
            _check(path, status, error)
            with os.fdopen(descriptor, "rb", closefd=False) as file:
                return file.read(status.st_size)
        finally:
            os.close(descriptor)
    except (OSError, ValueError) as problem:
        said = getattr(problem, "strerror", None) or problem
        raise error(f"cannot read '{path}': {said}") from problem


def decoded(content: bytes) -> str:
    """A text with its lines ended as Python's: UTF-8, else UTF-16 by its mark, else Latin-1."""
    try:
        text = content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def zip_of(path: Path, error: type[TmlatticeError], wanted: str) -> BytesIO:
    """The content of a ZIP archive (NumPy's and torch's arrays) whose parts are not compressed,
    so that together they are as large as the file.

    Raises:
        error: as of `content_of`, no archive, or compressed parts.
    """
    content = BytesIO(content_of(path, error))
    try:
        with ZipFile(content) as archive:
            parts = archive.infolist()
    except (BadZipFile, ValueError, NotImplementedError) as problem:
        raise error(f"'{path}' does not hold {wanted} ({problem})") from problem
    size = len(content.getbuffer())
    if any(part.compress_type != ZIP_STORED for part in parts) or (
        sum(part.file_size for part in parts) > size
    ):
        raise error(f"'{path}' is a compressed archive, or states more than it holds")
    content.seek(0)
    return content


def check_no_code(file: Path, lattice: str, error: type[TmlatticeError], instead: str) -> None:
    """Whether a lattice that a file of data names is data too; error: it is Python code."""
    if Path(lattice).suffix.casefold() == ".py":
        raise error(
            f"{file}: its lattice '{plain(lattice, 60)}' is Python code, which would be run; "
            f"if you trust that file, {instead}"
        )


def text_of(path: Path, error: type[TmlatticeError]) -> str:
    """The text of a file in UTF-8; error: as of `content_of`, or another encoding, with the
    line."""
    try:
        return content_of(path, error).decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = problem.object[: problem.start].count(b"\n") + 1
        raise error(f"{path}, line {line}: not UTF-8; save the file as UTF-8") from problem


def _short_text(path: Path, error: type[TmlatticeError]) -> str:
    if check_regular(path, error) > MOST_YAML:
        raise error(f"'{path}' is larger than {MOST_YAML >> 20} MB; write less of it")
    return text_of(path, error)


def json_of(path: Path, error: type[TmlatticeError], finite: bool = True) -> Any:
    """The value of a JSON file.

    Args:
        finite: whether NaN and Infinity, which are no JSON, are refused.

    Raises:
        error: as of `text_of`, or no JSON, with the line; a key that stands twice in one object;
            a number of hundreds of digits; or lists in lists without end.
    """
    text = text_of(path, error)
    collects = gc.isenabled()
    gc.disable()  # finalizers that run where the recursion is deepest print past everybody
    try:
        return json.loads(
            text,
            object_pairs_hook=_once,
            parse_int=_whole,
            parse_constant=_no_constant if finite else float,
        )
    except json.JSONDecodeError as problem:
        raise error(
            f"{path}, line {problem.lineno}: not JSON ({problem.msg}); correct it, or write it "
            "again"
        ) from problem
    except ValueError as problem:
        raise error(f"{path}: {problem}") from problem
    except RecursionError as problem:
        raise error(f"{path}: nested too deep; write it flatter") from problem
    finally:
        if collects:
            gc.enable()


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for i, key in enumerate(keys) if key in keys[:i])
        raise ValueError(
            f'the key "{plain(twice, 60)}" stands twice in one object; keep one of the two'
        )
    return made


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON; a number that is not finite is written as null")


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits; write it with an exponent")
    return int(digits)


def number(text: str) -> float:
    """A number of a table, also one with an exponent of Fortran, such as `1.5D-3`."""
    return float(_FORTRAN.sub("e", text.replace("_", "?")))


def yaml_of(path: Path, error: type[TmlatticeError]) -> Any:
    """The value of a YAML file: texts, lists and objects. No scalar is turned into a number, a
    date or a truth value; an empty one, `~` and `null` are None.

    Raises:
        error: as of `text_of`, or no YAML; an alias, of which a few can stand for any amount of
            data; a key that stands twice; or too much of it.
    """
    import yaml

    text = _short_text(path, error)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    count = 0

    def value(node: Any, depth: int) -> Any:
        if isinstance(node, yaml.ScalarNode):
            empty = not node.style and node.value in ("", "~", "null")
            return None if empty else node.value
        if isinstance(node, yaml.SequenceNode):
            return [value(item, depth + 1) for item in node.value]
        pairs = [(_key(key), value(item, depth + 1)) for key, item in node.value]
        return _once(pairs)

    def _key(node: Any) -> str:
        if not isinstance(node, yaml.ScalarNode):
            raise ValueError(f"line {node.start_mark.line + 1}: a key is a text")
        return str(node.value)

    try:
        depth = 0
        for event in yaml.parse(text, loader):
            count += 1
            line = event.start_mark.line + 1
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"line {line}: an alias (*{event.anchor}); write the value there")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST or count > MOST_NODES:
                raise ValueError(f"line {line}: too much, or too deep; write less of it")
        node = yaml.compose(text, loader)
        return None if node is None else value(node, 0)
    except (yaml.YAMLError, ValueError) as problem:
        said = " ".join(str(problem).split())[:200]
        raise error(f"'{path}' is no YAML that is read ({said})") from problem


def toml_of(path: Path, error: type[TmlatticeError]) -> dict[str, Any]:
    """The value of a TOML file, of the size and depth that a YAML file may have; error: as of
    `text_of`, or no TOML, with the line; a number that is not finite; or too much of it."""
    text = _short_text(path, error)
    for number, line in enumerate(text.splitlines(), 1):
        # a key of many parts: its reader takes a time that grows with their square
        keys = [line] if line.lstrip().startswith("[") else line.split("=")[:-1]
        parts = [part for key in keys for part in re.split("[,{]", key)]
        if any(part.count(".") > DEEPEST for part in parts):
            raise error(f"{path}, line {number}: a key of more than {DEEPEST} parts; shorten it")
    try:
        made = tomllib.loads(text)
    except (ValueError, RecursionError) as problem:
        raise error(f"{path}: no TOML that is read ({plain(str(problem), 200)})") from problem
    level: list[Any] = [made]
    for _ in range(DEEPEST):
        if any(isinstance(v, int | float) and not abs(v) < LARGEST for v in level):
            raise error(f"{path}: nan, inf and 10^{MOST_DIGITS} are no numbers; leave the key out")
        inner = [
            v.values() if isinstance(v, dict) else v for v in level if isinstance(v, dict | list)
        ]
        level = [item for items in inner for item in items]
        if not level:
            return made
    raise error(f"{path}: nested more than {DEEPEST} deep; write it flatter")


# --- shapes -------------------------------------------------------------------------------------
@cache
def schema_of(name: str) -> Any:
    """The validator of a schema, by its file name in `tmlattice/schemas` without the suffix."""
    from jsonschema import Draft202012Validator

    text = (files("tmlattice") / "schemas" / f"{name}.schema.json").read_text(encoding="utf-8")
    return Draft202012Validator(json.loads(text))


def check_shape(path: Path, value: Any, schema: str, error: type[TmlatticeError]) -> None:
    """Whether what stands in a file has the types and values of its schema; error: it has not; with
    the place, what stands there and what is expected."""
    from jsonschema.exceptions import best_match

    wrong = best_match(schema_of(schema).iter_errors(value))
    if wrong is not None:
        raise error(f"{path}: {_explain(wrong)}")


def short(value: Any) -> str:
    """A value as JSON, in at most 40 characters."""
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
        near = difflib.get_close_matches(strange, known, 1)
        offer = f'did you mean "{near[0]}"? ' if near else ""
        return (
            f'{place or "it"} has the key "{plain(strange, 60)}"; {offer}known are '
            f"{', '.join(known)}"
        )
    if kind == "anyOf" and all("type" in one for one in wanted):
        kind, wanted = "type", [one["type"] for one in wanted]
    if kind == "type":
        types = [wanted] if isinstance(wanted, str) else wanted
        should = f"should be {' or '.join(_KINDS[t] for t in types)}"
    elif kind == "enum":
        should = f"should be one of {', '.join(short(w) for w in wanted)}"
    elif kind == "exclusiveMinimum":
        should = f"should be above {wanted}"
    elif kind == "minimum":
        should = f"should be {wanted} or more"
    elif kind in ("minItems", "minProperties", "minLength"):
        should = "should not be empty"
    else:
        should = f"breaks the rule {kind} = {short(wanted)}"
    return f"{place or 'it'} is {short(value)}; it {should}"
