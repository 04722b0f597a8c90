"""The wire format of the worker's answers: the worker writes it, the service reads and checks it.

An answer is `{"id": number, "result": {field: value}}` or `{"id": number, "refused": {"code", "text"}}`. A slice of a
commissioning is answered with `{"id": number, "underway": {"stage", "done", "total"}}` until it is complete. A result
has the fields of its dataclass. Arrays are an extension type of their shape and their doubles, so that every bit is
kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, TypeAdapter

from coec.calibration.types import Reason
from coec.errors import DecodeError
from coec.geometry import se3
from coec.runtime.worker.jobs import (
    ANSWERS,
    Answer,
    Checked,
    Commissioned,
    Kind,
    Registered,
    RenderedImage,
    Solved,
    Underway,
    WrittenFile,
)
from coec.schemas.base import from_msgpack, to_msgpack

ARRAY = 1
"""Code of the extension type: msgpack of the shape, and the doubles, little-endian, in row-major order."""


class MalformedAnswerError(Exception):
    """An answer is not of the documented form. The message says what is wrong, but quotes none of its values."""


@dataclass(frozen=True, slots=True)
class _SolvedOnTheWire:
    """`Solved` with the result in msgpack, as in the window's file and the history."""

    result: bytes
    note: Reason | None
    written: WrittenFile | None


def pack_answer(number: int, answer: Answer | None) -> dict[str, Any]:
    """The answer to the question of this number; None if the question asks for nothing."""
    return {"id": number, "result": None if answer is None else _encoded(answer)}


def pack_refusal(number: int, reason: Reason) -> dict[str, Any]:
    """The refusal of the question of this number, with its reason."""
    return {"id": number, "refused": _encoded(reason)}


def pack_underway(number: int, underway: Underway) -> dict[str, Any]:
    """The answer that the work of the question of this number is not complete."""
    return {"id": number, "underway": _encoded(underway)}


def number_of(message: Mapping[str, Any]) -> int:
    """The number of the question that is answered.

    Raises:
        MalformedAnswerError: the message has no number.
    """
    number = message.get("id")
    if type(number) is not int:
        raise MalformedAnswerError("it has no number")
    return number


def read_answer(message: Mapping[str, Any], kind: Kind | None) -> Answer | Underway | Reason | None:
    """The answer to a question of a kind, how far its work is, or the reason why there is no answer. None for the kind
    None, which asks for nothing.

    Raises:
        MalformedAnswerError: the message is none of these.
    """
    content = {name: value for name, value in message.items() if name != "id"}
    if content.keys() == {"refused"}:
        reason: Reason = _read(Reason, content["refused"])
        return reason
    if content.keys() == {"underway"} and kind is Kind.COMMISSION:
        underway: Underway = _read(Underway, content["underway"])
        return underway
    if content.keys() != {"result"}:
        raise MalformedAnswerError("it is neither a result nor a refusal")
    if kind is None:
        if content["result"] is not None:
            raise MalformedAnswerError("it is a result where none was asked for")
        return None
    if kind is Kind.SOLVE:
        return _solved(_read(_SolvedOnTheWire, content["result"]))
    answer: Answer = _read(ANSWERS[kind], content["result"])
    return answer


def _solved(wire: _SolvedOnTheWire) -> Solved:
    # Imported here because the worker imports this module, too, and its first work, a check, needs no wire models.
    from coec.schemas.replies import CalibrationResult

    try:
        return Solved(from_msgpack(CalibrationResult, wire.result), wire.note, wire.written)
    except DecodeError as error:
        raise MalformedAnswerError(str(error)) from error


@cache
def _reader() -> TypeAdapter[Any]:
    """Reads a map into the dataclass with exactly its fields. Made at the first answer: only the service reads."""
    settings = ConfigDict(arbitrary_types_allowed=True, extra="forbid")
    forms = _SolvedOnTheWire | Checked | RenderedImage | Commissioned | Underway | Registered | Reason
    return TypeAdapter(forms, config=settings)


def _read(form: type, value: Any) -> Any:
    """A value in one of the forms of `_reader`.

    Raises:
        MalformedAnswerError: it is not in this form.
    """
    try:
        read = _reader().validate_python(_decoded(value))
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise MalformedAnswerError(f"it is no {form.__name__.strip('_')}") from error
    if not isinstance(read, form):
        raise MalformedAnswerError(f"it is no {form.__name__.strip('_')}")
    _check_shapes(read)
    return read


def _check_shapes(read: object) -> None:
    if isinstance(read, Commissioned) and not (read.pose.shape == (4, 4) and np.isfinite(read.pose).all()):
        raise MalformedAnswerError("its pose is not 4×4 finite numbers")
    if isinstance(read, Registered):
        if not se3.is_rigid(read.T_a_b):
            raise MalformedAnswerError("its pose is no rigid transform")
        if read.covariance.shape != (6, 6) or not np.isfinite(read.covariance).all():
            raise MalformedAnswerError("its covariance is not 6×6 finite numbers")
    if isinstance(read, Checked):
        parts = (read.observation, read.observation.drift)
        values = (getattr(part, field.name) for part in parts if part is not None for field in fields(part))
        if any(isinstance(value, np.ndarray) and value.shape != (6,) for value in values):
            raise MalformedAnswerError("it has an array that is not of the six axes")


def _encoded(value: Any) -> Any:
    """The value as values that msgpack knows."""
    if isinstance(value, BaseModel):
        return to_msgpack(value)
    if is_dataclass(value):
        return {field.name: _encoded(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        doubles = np.ascontiguousarray(value, dtype="<f8")
        return msgpack.ExtType(ARRAY, msgpack.packb([doubles.shape, doubles.tobytes()]))
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return [_encoded(entry) for entry in value]
    return value


def _decoded(value: Any) -> Any:
    """The value with the arrays that `_packed` packed, at any depth."""
    if isinstance(value, msgpack.ExtType):
        return _array(value)
    if isinstance(value, dict):
        return {name: _decoded(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_decoded(entry) for entry in value]
    return value


def _array(packed: msgpack.ExtType) -> NDArray[np.float64]:
    """The array in an extension type.

    Raises:
        ValueError, TypeError, UnpackException: it holds no array.
    """
    if packed.code != ARRAY:
        raise ValueError("an extension type that is no array")
    shape, doubles = msgpack.unpackb(packed.data)
    return np.frombuffer(doubles, "<f8").reshape(shape).astype(np.float64)
