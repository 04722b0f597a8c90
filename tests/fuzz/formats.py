"""Mutations that know a format: they take an input apart, change a part, and put it together again with every length,
checksum and hash as it has to be. So what is wrong lies behind the checks that random bytes never pass."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

import msgpack
from mcap.opcode import Opcode
from ruamel.yaml import YAML

from coec.io.mcap.reader import MAGIC
from coec.service.records.history import GENESIS
from fuzz.mutate import deepened, mutated_bytes, mutated_value

Part = tuple[int, bytes]
"""Opcode and body of a record of MCAP."""


def in_msgpack(rng: Random, data: bytes) -> bytes:
    """A document in msgpack."""
    packed: bytes = msgpack.packb(mutated_value(rng, msgpack.unpackb(data, strict_map_key=False)))
    return packed


def in_json(rng: Random, data: bytes) -> bytes:
    """A document in JSON."""
    return deepened(canonical(mutated_value(rng, json.loads(data))))


def in_yaml(rng: Random, data: bytes) -> bytes:
    """A document in YAML, in flow style: JSON is YAML, but for how it writes what is no number."""
    document = mutated_value(rng, YAML(typ="safe").load(data.decode()))
    text = deepened(json.dumps(document).encode())
    return text.replace(b"NaN", b".nan").replace(b"-Infinity", b"-.inf").replace(b"Infinity", b".inf")


def behind(head: int, mutation: Callable[[Random, bytes], bytes]) -> Callable[[Random, bytes], bytes]:
    """What stands behind the first bytes of an input, which choose what it is given to."""
    return lambda rng, data: data[:head] + mutation(rng, data[head:])


def canonical(value: Any) -> bytes:
    """As our state file and history write JSON, but for numbers that are none, which somebody else may write."""
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def checksummed(rng: Random, data: bytes) -> bytes:
    """A state file whose body was forged: its checksum is right."""
    return with_checksum(deepened(canonical(mutated_value(rng, json.loads(data)["body"]))))


def with_checksum(body: bytes) -> bytes:
    """The state file of a body."""
    checksum = hashlib.sha256(body).hexdigest().encode()
    return b'{"body":' + body + b',"checksum":"' + checksum + b'","schema_version":1}'


def chained(rng: Random, data: bytes) -> bytes:
    """A book of the history of which one entry or result was forged, and all hashes after it made to fit."""
    parts = [tuple(map(json.loads, line.partition(b" ")[2].split(b"\t"))) for line in data.splitlines()]
    at = rng.randrange(len(parts))
    entry, result = parts[at]
    if result is not None and rng.randrange(2):
        parts[at] = entry, mutated_value(rng, result)
    else:
        parts[at] = mutated_value(rng, entry), result
    return book(parts)


def book(parts: list[tuple[Any, Any]]) -> bytes:
    """A book of these entries and results (or None)."""
    lines, previous = [], GENESIS
    for entry, result in parts:
        reported = deepened(canonical(result))
        if isinstance(entry, dict):
            hashed = None if result is None else hashlib.sha256(reported).hexdigest()
            entry = {**entry, "previous_sha256": previous, "result_sha256": hashed}
        document = deepened(canonical(entry))
        previous = hashlib.sha256(document).hexdigest()
        lines.append(previous.encode() + b" " + document + b"\t" + reported + b"\n")
    return b"".join(lines)


def in_lines(rng: Random, data: bytes) -> bytes:
    """A file of documents in JSON, a line each."""
    lines = data.splitlines() or [b"{}"]
    at = rng.randrange(len(lines))
    lines[at] = in_json(rng, lines[at])
    return b"\n".join(lines) + b"\n"


def in_archive(rng: Random, data: bytes) -> bytes:
    """An archive of which one member was changed: its CRC is right."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as given, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as made:
        names = given.namelist()
        selected = rng.choice(names)
        for name in names:
            body = given.read(name)
            made.writestr(
                name, mutated_bytes(rng, body, given.read(rng.choice(names)), ()) if name == selected else body
            )
    return stream.getvalue()


def in_records(rng: Random, data: bytes) -> bytes:
    """An MCAP file of which records were changed, removed, repeated or put elsewhere."""
    records = records_of(data)
    for _ in range(2 ** rng.randrange(3)):
        at = rng.randrange(len(records))
        opcode, body = records[at]
        match rng.randrange(6):
            case 0:
                del records[at]
            case 1:
                records.insert(rng.randrange(len(records) + 1), records[at])
            case 2 if opcode == Opcode.ATTACHMENT:
                records[at] = opcode, _attachment(rng, body)
            case 3 if opcode == Opcode.CHUNK:
                records[at] = opcode, chunk(packed_records(_changed(rng, _unpacked(body))), rng.choice((b"", b"none")))
            case _:
                records[at] = opcode, mutated_bytes(rng, body, rng.choice(records)[1], ())
        if not records:
            break
    return mcap_file(records)


def records_of(data: bytes) -> list[Part]:
    """The records of the data section of a sound file."""
    detected: list[Part] = []
    at = len(MAGIC)
    while True:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == Opcode.DATA_END:
            return detected
        detected.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length


def mcap_file(records: list[Part]) -> bytes:
    """A file of these records, with an index of its attachments and without the CRCs that may be left out."""
    data, index = bytearray(MAGIC), bytearray()
    for opcode, body in records:
        if opcode == Opcode.ATTACHMENT and len(body) >= 24:
            (length,) = struct.unpack_from("<I", body, 16)
            name = body[16 : 20 + length]
            entry = struct.pack("<QQQQQ", len(data), 9 + len(body), 0, 0, 0) + name + struct.pack("<I", 0)
            index += struct.pack("<BQ", Opcode.ATTACHMENT_INDEX, len(entry)) + entry
        data += packed_records([(opcode, body)])
    data += packed_records([(Opcode.DATA_END, bytes(4))])
    at = len(data) if index else 0
    return bytes(data + index + packed_records([(Opcode.FOOTER, struct.pack("<QQI", at, 0, 0))])) + MAGIC


def packed_records(records: list[Part]) -> bytes:
    """Records one after the other."""
    return b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in records)


def chunk(content: bytes, compression: bytes = b"") -> bytes:
    """Body of a chunk that is not compressed."""
    head = struct.pack("<QQQI", 0, 0, len(content), zlib.crc32(content))
    return head + struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(content)) + content


def attachment(name: str, data: bytes) -> bytes:
    """Body of an attachment; without its CRC."""
    texts = b"".join(struct.pack("<I", len(text)) + text for text in (name.encode(), b"application/json"))
    return bytes(16) + texts + struct.pack("<Q", len(data)) + data + bytes(4)


def _attachment(rng: Random, body: bytes) -> bytes:
    """Its file, which is JSON in a window of ours, was forged."""
    at, texts = 16, []
    for _ in range(2):
        (length,) = struct.unpack_from("<I", body, at)
        texts.append(body[at + 4 : at + 4 + length])
        at += 4 + length
    (length,) = struct.unpack_from("<Q", body, at)
    return attachment(texts[0].decode(), in_json(rng, body[at + 8 : at + 8 + length]))


def _unpacked(body: bytes) -> list[Part]:
    (length,) = struct.unpack_from("<I", body, 28)
    return records_of(MAGIC + body[40 + length :] + struct.pack("<BQ", Opcode.DATA_END, 0))


def _changed(rng: Random, records: list[Part]) -> list[Part]:
    at = rng.randrange(len(records))
    opcode, body = records[at]
    records[at] = opcode, mutated_bytes(rng, body, rng.choice(records)[1], ())
    return records
