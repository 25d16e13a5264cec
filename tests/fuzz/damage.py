"""Damage to a file, by a seed: bytes, lines, sizes, names, types, values, structure."""

import contextlib
import io
import json
import re
import tempfile
import warnings
from pathlib import Path

import numpy as np

ODD = (
    None, True, [], {}, "", "x", "\x1b[31m", "\u202e", "nan", 0, -1, 1, 10**30, 10**400, -(10**19),
    1e300, -1e300, 1e-300, float("nan"), float("inf"), [0] * 7, [[0]], {"x": 1}, "x" * 100_000,
)  # fmt: skip
WORDS = (
    b"", b",", b"\n", b'"', b"\0", b"1e999", b"-", b"nan", b"\xff\xfe", b"(", b")", b"{", b"__",
    b";",
    b"9^9^9", b"while(1)", b"../", b"\r", b"0" * 400, b":=", b"x->y", b"\x1b]0;evil\x07",
)  # fmt: skip

NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
ODD_NUMBERS = (
    b"0", b"-1", b"1", b"2", b"1e-3", b"-0.7", b"1e-300", b"1e300", b"-1e300", b"1e-9", b"0.1999",
    b"100", b"1000", b"99999999999", b"9" * 400, b"3.7e9", b"nan", b"inf", b"1e400",
)  # fmt: skip


def damaged_bytes(rng, content):
    """Bits turned, pieces cut, doubled, exchanged, words put in."""
    content = bytearray(content)
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        size = max(len(content), 1)
        at, to = sorted(int(i) for i in rng.integers(0, size + 1, 2))
        match int(rng.integers(10)):
            case 7 | 8 | 9:
                numbers = list(NUMBER.finditer(content))
                if numbers:
                    own = numbers[int(rng.integers(len(numbers)))]
                    content[own.start() : own.end()] = ODD_NUMBERS[
                        int(rng.integers(len(ODD_NUMBERS)))
                    ]
            case 0:
                digits = bool(rng.integers(2))
                for place in rng.integers(0, size, int(rng.choice([1, 1, 2, 30]))):
                    if place < len(content):
                        content[place] = int(rng.integers(48, 58) if digits else rng.integers(256))
            case 1:
                del content[at:]
            case 2:
                del content[at : min(to, at + 200)]
            case 3:
                content[at:at] = content[at : min(to, at + 2000)]
            case 4:
                content[at:at] = WORDS[int(rng.integers(len(WORDS)))]
            case 5:
                lines = content.splitlines(keepends=True)
                rng.shuffle(lines)
                content = bytearray(b"".join(lines))
            case 6:
                lines = content.splitlines(keepends=True)
                if lines:
                    lines[int(rng.integers(len(lines)))] = WORDS[int(rng.integers(len(WORDS)))]
                content = bytearray(b"".join(lines))
    return bytes(content)


# --- names and sizes ------------------------------------------------------------------------------
ODD_NAMES = (
    "q<!--", "</script>", "%{x}", "<b>q</b>", '<a href="https://e.example/">q</a>', "$\\frac$",
    "@ink", "", " ", "nan", "..", "/etc/passwd", "x" * 5000, "\u202eq", "\x1b[2J", "qf::0", "QF",
    "µ", "\ud83d", "0", "__class__", "a,b", 'a"b', "a\\nb",
)  # fmt: skip
NAME = re.compile(rb"[A-Za-z_][A-Za-z_0-9.:]+")
ODD_SIZES = (0, 1, 2, 7, -1, -(2**31), 2**31 - 1, 2**24, 2**16, 255)


def damaged_names(rng, content):
    """A word of a text that is another everywhere, or in one place."""
    words = NAME.findall(content)
    if not words:
        return content
    word = words[int(rng.integers(len(words)))]
    odd = ODD_NAMES[int(rng.integers(len(ODD_NAMES)))].encode("utf-8", "surrogatepass")
    return content.replace(word, odd, -1 if rng.integers(2) else 1)


def damaged_sizes(rng, content):
    """A whole number of four or eight bytes of a binary file, at an even place."""
    content = bytearray(content)
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        wide = int(rng.choice([4, 8]))
        if len(content) <= wide:
            break
        reach = len(content) if rng.integers(2) else min(len(content), 2048)  # headers are first
        at = int(rng.integers(0, max(1, reach // 4))) * 4
        odd = ODD_SIZES[int(rng.integers(len(ODD_SIZES)))]
        content[at : at + wide] = odd.to_bytes(wide, ["little", "big"][int(rng.integers(2))],
                                               signed=True)  # fmt: skip
    return bytes(content)


def places(value, path=()):
    """Every place of a document."""
    yield path
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(item, (*path, key))


def damaged_json(rng, content):
    """A document with odd values, keys that are gone or misspelt, lists that are too deep."""
    return _damaged_document(rng, json.loads(content))


def damaged_toml(rng, content):
    """The same of TOML, whose values are written in one line each."""
    import tomllib

    made = json.loads(_damaged_document(rng, tomllib.loads(content.decode())))
    return "\n".join(f"{json.dumps(k)} = {_as_toml(v)}" for k, v in made.items()).encode()


def _as_toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_as_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_as_toml, value)) + "]"
    return {"NaN": "nan", "Infinity": "inf"}.get(json.dumps(value), json.dumps(value))


ODD_YAML = (
    "a: &a [x, x]\nb: &b [*a, *a]\nnames: [*b, *b]\n", "names: " + "[" * 9000, "unit: [mm]\n",
    "noise: 2001-13-45\n", "noise: " + "9" * 6000, "? [a, b]\n: c\n", "names: !!binary =\n",
    "unit: !!python/name:os.system\n", "--- a\n--- b\n", "unit: mm\nunit: m\n", "%YAML 9.9\n",
    "names: {<<: {a: b}}\n",
)  # fmt: skip


def damaged_yaml(rng, content):
    """The same of YAML, and what JSON does not have."""
    import yaml

    if not rng.integers(3):
        return content + ODD_YAML[int(rng.integers(len(ODD_YAML)))].encode()
    return _damaged_document(rng, yaml.safe_load(content))


def _damaged_document(rng, document):
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        every = list(places(document))
        path = every[int(rng.integers(len(every)))]
        odd = ODD[int(rng.integers(len(ODD)))]
        if not path:
            continue
        owner = document
        for key in path[:-1]:
            owner = owner[key]
        key = path[-1]
        match int(rng.integers(6)):
            case 0 | 1:
                owner[key] = odd
            case 2 if isinstance(owner, dict):
                del owner[key]
            case 3 if isinstance(owner, dict):
                owner[str(key).upper() if rng.integers(2) else f"{key}\x1b[2J"] = owner.pop(key)
            case 4 if isinstance(owner[key], int | float) and abs(owner[key]) < 1e300:
                owner[key] = owner[key] * float(10.0 ** rng.integers(-12, 13))
            case _:
                owner[key] = "HERE"
                deep = int(rng.choice([2, 990, 100_000]))
                text = json.dumps(document).replace('"HERE"', "[" * deep + "1" + "]" * deep)
                return text.encode()
    return json.dumps(document).encode()


# --- MATLAB variables ---
ODD_VARIABLES = (
    0.0, -1.0, 0.5, 1e-300, 1e300, float("nan"), float("inf"), 1j, True, np.int8(-3), "", "x",
    "\x1b[31m", "nan", "x" * 5000, {}, {"x": 1.0}, [], [1.0, "x", {}], np.zeros(0),
    np.zeros((0, 7)), np.full(3, np.nan), np.arange(1e5), np.zeros((3, 2, 2)), np.ones((2, 3)),
    np.array(["a", "bc"]),
)  # fmt: skip
ODD_VALUES = (0.0, -1.0, 0.5, 1e9, 1e300, -1e300, 1e-300, float("nan"), float("inf"))


def damaged_mat(rng, content):
    """Variables and fields that are gone, misspelt, of another type or shape, or out of range."""
    import scipy.io

    variables = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
    variables = {name: v for name, v in variables.items() if not name.startswith("__")}
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        every = list(places(variables))[1:]
        # of hundreds of elements' fields as many as of the others: first how deep, then where
        depth = int(rng.choice(sorted({len(path) for path in every})))
        every = [path for path in every if len(path) == depth]
        path = every[int(rng.integers(len(every)))]
        owner = variables
        for key in path[:-1]:
            owner = owner[key]
        _damage_variable(rng, owner, path[-1])
        if not variables:
            break
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that MATLAB would not have
        scipy.io.savemat(file, variables, long_field_names=True)
    return file.getvalue()


def _damage_variable(rng, owner, key):
    value = owner[key]
    match int(rng.integers(8)):
        case 0 if isinstance(owner, dict):
            del owner[key]
        case 1 if isinstance(owner, dict):
            owner[key.lower() if rng.integers(2) else f"{key}\x1b[2J"] = owner.pop(key)
        case 0 | 1:
            owner.pop(key)
        case 2:
            owner[key] = [value] * int(rng.integers(1, 4))
        case 3:
            for _ in range(int(rng.choice([2, 35]))):
                value = {"x": value}
            owner[key] = value
        case 4 | 5 | 6 if isinstance(value, int | float | np.ndarray) and np.size(value):
            owner[key] = _damaged_numbers(rng, value)
        case _:
            owner[key] = ODD_VARIABLES[int(rng.integers(len(ODD_VARIABLES)))]


def _damaged_numbers(rng, value):
    array = np.array(value)
    if array.dtype.kind not in "fiu":
        return "x"
    if not rng.integers(3):  # another shape or type
        flat = array.ravel()
        return [flat[:-1], np.append(flat, flat[:1]), array.T, flat, array[None, ..., None],
                np.concatenate([flat, flat]), flat.astype("S8").astype(str), flat.astype(np.int8),
                flat.astype(complex) * (1 + 1j)][int(rng.integers(9))]  # fmt: skip
    array = array.astype(float)
    flat = array.reshape(-1)
    some = rng.integers(0, flat.size, int(rng.choice([1, 1, 3, flat.size])))
    match int(rng.integers(5)):
        case 0:
            flat[some] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
        case 1:
            flat[some] *= 10.0 ** int(rng.integers(-12, 13))
        case 2:
            flat[some] += int(rng.choice([-1000, -1, 1, 1000]))
        case 3:
            flat[some] *= -1
        case _:
            rng.shuffle(flat)
    return array


# --- HDF5 -----------------------------------------------------------------------------------------
def damaged_hdf5(rng, content):
    """Objects that are gone, linked, renamed, of another type, shape or size, or elsewhere."""
    import h5py

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        path.write_bytes(content)
        with h5py.File(path, "r+") as file:
            for _ in range(int(rng.choice([1, 1, 1, 2]))):
                names = []
                file.visit(names.append)
                if not names:
                    break
                # what the library itself does not write is no damage
                with contextlib.suppress(TypeError, ValueError, OSError, RuntimeError, KeyError):
                    _damage_object(rng, file, names[int(rng.integers(len(names)))])
        changed = path.read_bytes()
    head = content[:512]  # of MATLAB, whose words stand before the file's own
    return head + changed[512:] if head.startswith(b"MATLAB") else changed


def _damage_object(rng, file, name):
    import h5py

    item = file[name]
    group, own = item.parent, name.rsplit("/", 1)[-1]
    data = isinstance(item, h5py.Dataset)
    shape = item.shape if data and item.shape else (3, 2)
    attributes = dict(item.attrs)
    chunks = tuple(10**5 for _ in shape)
    outside = [("/etc/hostname", 0, h5py.h5f.UNLIMITED)]
    make = group.create_dataset
    made = (
        lambda: None,  # gone
        lambda: group.__setitem__(own, h5py.SoftLink("/nowhere" if rng.integers(2) else "/")),
        lambda: group.__setitem__(own, h5py.ExternalLink("/etc/hostname", own)),
        lambda: group.__setitem__(own, group),
        lambda: make(own, (40_000_000, 60), "f8"),
        lambda: make(own, shape, "f8", chunks=chunks, maxshape=tuple(None for _ in shape)),
        lambda: make(own, (10_000_000,), "f8", chunks=(1000,), compression="gzip"),
        lambda: make(own, shape, _KINDS[int(rng.integers(len(_KINDS)))]),
        lambda: make(own, data=h5py.Empty("f8")),
        lambda: make(own, shape, "f8", external=outside),
        lambda: group.create_group(own),
        lambda: h5py.h5g.create(group.id, b"bpm\xff\xfe"),
        lambda: make(own, data=ODD_DATA[int(rng.integers(len(ODD_DATA)))]),
    )
    case = int(rng.integers(18))
    if case < len(made):
        del group[own]
        made[case]()
        return
    if case == 13:
        odd = ODD_NAMES[int(rng.integers(len(ODD_NAMES)))]
        if odd.strip(" ./") and "\ud83d" not in odd:
            group.move(own, odd.replace("\x00", "") + str(int(rng.integers(3))))
    elif case == 14:
        key = [*attributes, "unit", "units", "MATLAB_class", "MATLAB_empty"]
        odd = ODD_DATA[int(rng.integers(len(ODD_DATA)))]
        item.attrs[key[int(rng.integers(len(key)))]] = odd
    elif case == 15 and data and item.dtype == object and h5py.check_ref_dtype(item.dtype):
        every = []
        file.visit(every.append)
        value = item[()]
        for _ in range(int(rng.choice([1, 3, value.size]))):
            other = file[every[int(rng.integers(len(every)))]].ref
            value.flat[int(rng.integers(value.size))] = other
        item[()] = value
    elif data and item.dtype.kind in "fiu" and item.shape and item.size < 1e6:
        value = np.asarray(_damaged_numbers(rng, item[()]))
        value = value.astype("S") if value.dtype.kind == "U" else value
        del group[own]
        group[own] = value
        for key, one in attributes.items():
            group[own].attrs[key] = one


_KINDS = ("c16", "f8,i4", "S7", "V9", "3f8", "i1", "?", "f2", ">i8")
ODD_DATA = (
    0.0, -1.0, float("nan"), 10**18, True, "x", "", "\x1b[31m", np.bytes_(b"\xff\xfe"), ["a", "bc"],
    np.zeros((2, 3, 4)), np.arange(7), np.zeros(0), np.full((3, 2), np.inf), 1j, "x" * 60_000,
    np.bytes_(b"char"), np.bytes_(b"cell"), np.uint64(2**64 - 1),
)  # fmt: skip
