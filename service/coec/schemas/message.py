"""What all wire models share: frozen, unknown fields ignored, no NaN; and their two encodings."""

import json
import math
from typing import Annotated, Any, Final, TypeVar

import msgpack
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from coec.errors import DecodeError
from coec.untrusted import Untrusted, printable

SCHEMA_VERSION = 7
"""Version of the models in this package, raised when a field is added. A field that changes its meaning or goes away
needs a new `@v2` in the keys instead."""

MAX_JSON_DEPTH: Final = 64
"""Deepest nesting of a JSON document that is read; ours have at most 10."""

MAX_LOCATION: Final = 100
"""Most characters of the place of a mistake in a message."""

Text = Annotated[str, AfterValidator(Untrusted)]
"""Text in a message. A model cannot know whether its sender is to be trusted, so that an f-string prints it with its
control characters escaped (`coec.untrusted`); on the wire it is unchanged."""


class Part(BaseModel):
    """A value inside a message. Readers ignore fields that they do not know, so that they understand newer senders."""

    model_config = ConfigDict(
        frozen=True,
        defer_build=True,
        extra="ignore",
        allow_inf_nan=False,
        # A writer writes every field, even those that a reader can do without.
        json_schema_serialization_defaults_required=True,
    )


class Message(Part):
    """A value that travels by itself, and therefore carries the version of the schema that it was written with."""

    schema_version: int = Field(default=SCHEMA_VERSION, ge=1, description="version of this schema at the writer")


M = TypeVar("M", bound=BaseModel)


def to_json(model: BaseModel) -> bytes:
    """Canonical JSON: keys sorted, no spaces, UTF-8, floats in the shortest form that reads back to the same
    double.

    Equal models give equal bytes.
    """
    return json.dumps(
        model.model_dump(mode="json"),
        sort_keys=True,
        separators=(",", ":"),
        ensure_ascii=False,
        allow_nan=False,
    ).encode()


def to_msgpack(model: BaseModel) -> bytes:
    """Canonical msgpack: keys sorted, doubles, `bytes` as bin. Equal models give equal bytes."""
    packed: bytes = msgpack.packb(_sorted(model.model_dump(mode="python")), use_bin_type=True)
    return packed


def from_json(model: type[M], payload: bytes) -> M:
    """The model that `to_json` wrote, here or in a newer version.

    Raises:
        DecodeError: not JSON, or not this model.
    """
    try:
        return model.model_validate(json.loads(payload))
    except (ValueError, RecursionError) as error:
        raise DecodeError("message_malformed", f"not a {model.__name__} in JSON: {_error_locations(error)}") from error


def json_value(payload: bytes) -> Any:
    """The value of any JSON document, which can be written again: every number is finite, and the nesting is at most
    `MAX_JSON_DEPTH`.

    Raises:
        DecodeError: not such a document; says what is wrong and at which place of it.
    """
    try:
        value = json.loads(payload)
    except json.JSONDecodeError as error:
        raise DecodeError("message_malformed", f"not JSON: {error}") from error
    except UnicodeDecodeError as error:
        raise DecodeError("message_malformed", f"not JSON: no UTF-8 at byte {error.start}") from error
    except ValueError as error:
        raise DecodeError("message_malformed", "not JSON: a number with too many digits") from error
    except RecursionError as error:
        raise DecodeError("message_malformed", f"not read: nested deeper than {MAX_JSON_DEPTH}") from error
    stack = [(value, 0)]
    while stack:
        part, depth = stack.pop()
        if depth > MAX_JSON_DEPTH:
            raise DecodeError("message_malformed", f"not read: nested deeper than {MAX_JSON_DEPTH}")
        if isinstance(part, dict | list):
            stack += ((item, depth + 1) for item in (part.values() if isinstance(part, dict) else part))
        elif isinstance(part, float) and not math.isfinite(part):
            raise DecodeError("message_malformed", "not JSON: a number that is not finite")
    return value


def from_msgpack(model: type[M], payload: bytes) -> M:
    """The model that `to_msgpack` wrote, here or in a newer version. Use it for replies, whose sender was asked. Frames
    come from anywhere and go through `coec.io.msgpack_frames`, which is stricter.

    Raises:
        DecodeError: not msgpack, or not this model.
    """
    try:
        return model.model_validate(msgpack.unpackb(payload))
    except (ValueError, RecursionError, msgpack.UnpackException) as error:
        raise DecodeError(
            "message_malformed", f"not a {model.__name__} in msgpack: {_error_locations(error)}"
        ) from error


def _sorted(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _sorted(value[key]) for key in sorted(value)}
    if isinstance(value, list | tuple):
        return [_sorted(item) for item in value]
    return value


def _error_locations(error: Exception) -> str:
    if isinstance(error, ValidationError):
        # At most three places, and never the values: they are text from the sender, as are keys in a place.
        return "; ".join(
            f"{printable('.'.join(str(part) for part in item['loc']), MAX_LOCATION)}: {item['type']}"
            for item in error.errors()[:3]
        )
    return type(error).__name__
