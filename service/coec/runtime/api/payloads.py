"""Checks commands of people before anything is done: reads the payload, and makes a safe name of the sender."""

from __future__ import annotations

import hashlib
import json
from typing import Any, Final

import msgpack

from coec.errors import UsageError
from coec.schemas.commands import COMMAND_NAMES, MAX_REASON, REASON, arguments_of

MAX_SENDER: Final = 96
"""Most characters of a sender in log and history."""

MAX_PAYLOAD: Final = 4096
"""Largest payload, bytes. coec's own have less than 100; a JSON message of 32 MB would unpack to a gigabyte."""

MAX_ATTACHMENT: Final = 4096
"""How many bytes of an attachment are read."""

ANONYMOUS: Final = "anonymous"
"""Name of a sender that does not name itself."""

_HARMLESS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789 ._:/@+-=,")


def parse_payload(name: str, payload: bytes, *, for_rig: bool = False) -> dict[str, Any]:
    """The arguments of a command for a pair or for the rig. A payload is empty, or a map in msgpack or JSON.

    Raises:
        UsageError: no such command, or the payload does not hold the arguments that it takes.
    """
    if name not in COMMAND_NAMES:
        raise UsageError(f"no such command; known: {', '.join(COMMAND_NAMES)}")
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
    """The attachment of a query as one short harmless line. If it is no readable text, the line shows its hash."""
    if not attachment:
        return ANONYMOUS
    start = attachment[:MAX_ATTACHMENT]
    text = start.decode("ascii", errors="replace")
    cleaned = "".join(character if character in _HARMLESS else "_" for character in text)
    if 2 * cleaned.count("_") > len(cleaned):
        return f"{len(attachment)} bytes, sha256 {hashlib.sha256(start).hexdigest()[:16]}"
    return cleaned[:MAX_SENDER]


def proven_sender(name: str) -> str:
    """A sender whose certificate has this common name, as one short harmless line that no attachment can imitate."""
    return f"{sender_of(name.encode('ascii', errors='replace'))} (certificate)"


def _one_line(reason: str) -> str:
    """The words of a person as one line without control characters.

    Raises:
        UsageError: the line is too long.
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
