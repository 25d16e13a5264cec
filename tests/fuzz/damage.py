"""Damage to a file, by a seed: bytes, lines, and the values of a JSON document."""

import json
import re

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
