"""Commands of people, before anything is done: what a payload may say, and how a sender is written down."""

from __future__ import annotations

import hashlib
import json
from typing import Any, Final

import msgpack

from coec.errors import UsageError
from coec.schemas.commands import MAX_REASON, NAMES, REASON, arguments_of

MAX_SENDER: Final = 96
"""Characters of a sender in log and history."""

MAX_PAYLOAD: Final = 4096
"""Bytes of a payload. Ours have below 100; a message of 32 MB in JSON would unpack to a gigabyte."""

MAX_ATTACHMENT: Final = 4096
"""Bytes of an attachment that are looked at."""

ANONYMOUS: Final = "anonymous"
"""Who says nothing of himself."""

_HARMLESS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789 ._:/@+-=,")


def parse(name: str, payload: bytes, *, for_rig: bool = False) -> dict[str, Any]:
    """The arguments of a command for a pair, or for the rig: nothing, or a map in msgpack or JSON.

    Raises:
        UsageError: no such command, or its payload is not what it takes.
    """
    if name not in NAMES:
        raise UsageError(f"no such command; known: {', '.join(NAMES)}")
    known = {argument.name: argument.kind for argument in arguments_of(name, for_rig=for_rig)}
    document = _document(payload)
    for key, value in document.items():
        if key not in known:
            takes = ", ".join(known) or "no arguments"
            raise UsageError(f"`{name}` takes {takes}")
        if not isinstance(value, known[key]):
            raise UsageError(f"argument `{key}` of `{name}` must be of type {known[key].__name__}")
    if REASON.name in document:
        document[REASON.name] = _one_line(document[REASON.name])
    return document


def sender_of(attachment: bytes | None) -> str:
    """The attachment of a query as one short harmless line; what is not readable text is told by its hash."""
    if not attachment:
        return ANONYMOUS
    start = attachment[:MAX_ATTACHMENT]
    text = start.decode("ascii", errors="replace")
    cleaned = "".join(character if character in _HARMLESS else "_" for character in text)
    if 2 * cleaned.count("_") > len(cleaned):
        return f"{len(attachment)} bytes, sha256 {hashlib.sha256(start).hexdigest()[:16]}"
    return cleaned[:MAX_SENDER]


def proven_sender(name: str) -> str:
    """A sender whose certificate has this common name, as one short harmless line that no attachment can come to."""
    return f"{sender_of(name.encode('ascii', errors='replace'))} (certificate)"


def _one_line(reason: str) -> str:
    """Words of a person in one line that steers no terminal.

    Raises:
        UsageError: there are too many of them.
    """
    line = " ".join("".join(letter if letter.isprintable() else " " for letter in reason).split())
    if len(line) > MAX_REASON:
        raise UsageError(f"argument `reason` has {len(line)} characters: give {MAX_REASON} at most")
    return line


def _document(payload: bytes) -> dict[str, Any]:
    if not payload:
        return {}
    if len(payload) > MAX_PAYLOAD:
        raise UsageError(f"the payload has more than {MAX_PAYLOAD} bytes")
    try:
        document = (
            json.loads(payload)
            if payload[:1] == b"{"
            else msgpack.unpackb(payload, max_map_len=8, max_str_len=MAX_PAYLOAD)
        )
    except (ValueError, RecursionError, msgpack.UnpackException) as error:
        raise UsageError("the payload is neither a map in msgpack nor in JSON") from error
    if not isinstance(document, dict) or not all(isinstance(key, str) for key in document):
        raise UsageError("the payload must be a map of names to values")
    return document
