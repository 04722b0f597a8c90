"""Seeded mutations: of bytes, and of the values that a document is made of."""

from __future__ import annotations

import copy
import math
import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

Mutation = Callable[[Random, bytes], bytes]
"""A mutation that knows a format: what it makes of an input is of that format, too, and wrong further inside."""

INTEGERS = (0, 1, 2, 127, 128, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
"""The ends of the types that something may be stored in."""

FLOATS = (0.0, -0.0, 1e-308, 5e-324, 1.0, 1e38, 1e39, 1e308, math.inf, -math.inf, math.nan)

TEXTS = (
    "",
    "\0",
    "a\0b",
    "/",
    "..",
    "../..",
    "/dev/zero",
    "*",
    "a" * 300,
    "9" * 5000,
    "1e999",
    "nan",
    "-1",
    "😀",
    "~",
    "null",
)

DEEP = re.compile(rb"\"@deep(\d+)@\"")
"""What stands for so many lists in one another, which no encoder would write."""

DEPTHS = (5, 30, 33, 100, 300, 900, 960, 980, 990, 995, 1000, 3000, 100_000)
"""Around the bounds of ours and of Python."""

MAX_BYTES = 2**18
"""Of an input: what is wrong with larger ones is told by tests of their own."""


def mutated_bytes(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    """One to eight changes, one after the other; `other` is another input, `words` what readers look for."""
    for _ in range(2 ** rng.randrange(4)):
        data = rng.choice(_CHANGES)(rng, data, other, labels)
    return data[:MAX_BYTES]


def mutated_value(rng: Random, value: Any) -> Any:
    """A document with one to four of its parts replaced, removed, repeated or put where others belong."""
    value = copy.deepcopy(value)
    for _ in range(2 ** rng.randrange(3)):
        places = list(_places(value))
        if not places:
            return _odd(rng, value)
        container, key = rng.choice(places)
        match rng.randrange(6):
            case 0 | 1 | 2:
                container[key] = _odd(rng, container[key])
            case 3:
                del container[key]
            case 4:
                other, at = rng.choice(places)
                container[key] = copy.deepcopy(other[at])
            case _ if isinstance(container, list):
                container[key:key] = [copy.deepcopy(container[key])] * rng.choice((1, 2, 50))
            case _:
                container[rng.choice(TEXTS)] = copy.deepcopy(container[key])
    return value


def deepened(text: bytes) -> bytes:
    """JSON or YAML in flow style with the lists in one another that its `@deep…@` stand for."""
    return DEEP.sub(lambda match: b"[" * int(match[1]) + b"]" * int(match[1]), text)


def _places(value: Any) -> list[tuple[Any, Any]]:
    result: list[tuple[Any, Any]] = []
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict | list):
            result += [(one, key) for key in (one if isinstance(one, dict) else range(len(one)))]
            waiting += one.values() if isinstance(one, dict) else one
    # A removal may have taken the place of another: only what is there still.
    return [(one, key) for one, key in result if (key in one if isinstance(one, dict) else key < len(one))]


def _odd(rng: Random, value: Any) -> Any:
    """Something else, half of the time of the same type."""
    if rng.randrange(2):
        if isinstance(value, bool):
            return not value
        if isinstance(value, int):
            return rng.choice((1, -1)) * rng.choice(INTEGERS) if rng.randrange(3) else value + rng.choice((-1, 1))
        if isinstance(value, float):
            return rng.choice((*FLOATS, -value, value * 1e300, value + rng.gauss(0, 1)))
        if isinstance(value, str):
            return rng.choice((*TEXTS, value + value, value[:-1], value.upper()))
        if isinstance(value, bytes):
            return mutated_bytes(rng, value, value[::-1], ())
        if isinstance(value, list):
            return rng.choice(([], value[:-1], value * 2, [value], list(reversed(value))))
    pools: tuple[Sequence[Any], ...] = (
        INTEGERS, FLOATS, TEXTS, (None, True, False), ([], {}, [[]], {"": {}}, [None] * 6, [0.0] * 6),
        tuple(f"@deep{depth}@" for depth in DEPTHS),
    )  # fmt: skip
    return copy.deepcopy(rng.choice(rng.choice(pools)))


def _flip(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    del other, labels
    if not data:
        return bytes([rng.randrange(256)])
    changed = bytearray(data)
    changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _integer(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    """A number that is stored in bytes, often where it would be aligned."""
    del other, labels
    form = rng.choice(("<B", "<H", ">H", "<I", ">I", "<Q", ">Q"))
    size = struct.calcsize(form)
    if len(data) < size:
        return data
    at = rng.randrange(len(data) - size + 1)
    at -= at % size if rng.randrange(2) else 0
    (old,) = struct.unpack_from(form, data, at)
    new = rng.choice((rng.choice(INTEGERS), old + 1, old - 1, old * 2, len(data), len(data) - at)) % 256**size
    return data[:at] + struct.pack(form, new) + data[at + size :]


def _digits(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    """A number that is written in digits."""
    del other, labels
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", data))
    if not numbers:
        return data
    selected = rng.choice(numbers)
    new = rng.choice((str(rng.choice(INTEGERS)), f"-{rng.choice(INTEGERS)}", str(rng.choice(FLOATS)), "9" * 5000, ""))
    return data[: selected.start()] + new.encode() + data[selected.end() :]


def _cut(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    del other, labels
    begin = rng.randrange(len(data) + 1)
    length = rng.choice((1, 2, 4, 8, 16, 64, len(data)))
    return data[:begin] + data[begin + length :]


def _repeat(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    del other, labels
    begin = rng.randrange(len(data) + 1)
    piece = data[begin : begin + rng.choice((1, 2, 4, 8, 16, 64))]
    return data[:begin] + piece * rng.choice((1, 2, 10, 1000)) + data[begin:]


def _splice(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    del labels
    begin, end = sorted(rng.randrange(len(other) + 1) for _ in range(2))
    at = rng.randrange(len(data) + 1)
    return data[:at] + other[begin:end] + data[at + (end - begin if rng.randrange(2) else 0) :]


def _word(rng: Random, data: bytes, other: bytes, labels: Sequence[bytes]) -> bytes:
    del other
    pool = (
        *labels,
        b"\0",
        b"\n",
        b"\xff" * 8,
        b"[" * 2000,
        b"\x91" * 2000,
        b"nan",
        b"1e999",
        b"-",
        b"'",
        b'"',
        b"\xed\xa0\x80",
    )
    at = rng.randrange(len(data) + 1)
    word = rng.choice(pool)
    return data[:at] + word + data[at + (len(word) if rng.randrange(2) else 0) :]


_CHANGES = (_flip, _flip, _integer, _integer, _digits, _cut, _repeat, _splice, _word)
