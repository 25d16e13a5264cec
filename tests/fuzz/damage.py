"""Damage to a file, by a seed: bytes, lines, values of a JSON document, MATLAB variables."""

import io
import json
import re
import warnings

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


def places(value, path=()):
    """Every place of a document."""
    yield path
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(item, (*path, key))


def damaged_json(rng, content):
    """A document with odd values, keys that are gone or misspelt, lists that are too deep."""
    document = json.loads(content)
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
            case 4 if isinstance(owner[key], int | float) and not isinstance(owner[key], bool):
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
