"""Canonical encodings of wire models, and what readers forgive."""

import importlib
import inspect
import json
import pkgutil

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from coec import schemas
from coec.errors import DecodeError
from coec.schemas.commands import Acknowledgement
from coec.schemas.message import from_json, from_msgpack, json_value, to_json, to_msgpack
from coec.schemas.replies import HealthReply, MetricReply, StreamStatus, Transform
from coec.untrusted import Untrusted
from support.strategies import HOSTILE, hostile_message, message_texts, obeyed_characters

ACKNOWLEDGEMENT = Acknowledgement(
    vehicle="v", pair="front", command="calibrate", accepted=False, code="too_few_pairs", text="4 more pairs — wait"
)


def test_json_is_sorted_and_has_no_spaces_between() -> None:
    assert to_json(ACKNOWLEDGEMENT).decode() == (
        '{"accepted":false,"code":"too_few_pairs","command":"calibrate","durable":null,"pair":"front","schema_version":7,'
        '"text":"4 more pairs — wait","vehicle":"v","window_id":null}'
    )


def test_order_of_a_dictionary_does_not_change_the_bytes() -> None:
    one = StreamStatus(losses={"a": 1, "b": 2})
    other = StreamStatus(losses={"b": 2, "a": 1})

    assert to_msgpack(one) == to_msgpack(other)
    assert to_json(one) == to_json(other)


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=16, max_size=16))
def test_every_double_survives_both_encodings(values: list[float]) -> None:
    rows = [values[i : i + 4] for i in range(0, 16, 4)]
    transform = Transform.model_validate({"matrix": rows, "translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]})

    for back in (from_json(Transform, to_json(transform)), from_msgpack(Transform, to_msgpack(transform))):
        assert [list(row) for row in back.matrix] == rows
        assert to_msgpack(back) == to_msgpack(transform)


def test_a_reader_ignores_fields_of_a_newer_writer() -> None:
    newer = json.loads(to_json(ACKNOWLEDGEMENT)) | {"schema_version": 7, "mood": ["good"]}

    assert from_json(Acknowledgement, json.dumps(newer).encode()).schema_version == 7
    assert from_msgpack(Acknowledgement, msgpack.packb(newer)).command == "calibrate"


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b"\xc1", b'{"vehicle":1}', b"\xff\xfe", b"\x93" * 4000])
def test_anything_else_is_a_decode_error(payload: bytes) -> None:
    with pytest.raises(DecodeError):
        from_json(Acknowledgement, payload)
    with pytest.raises(DecodeError):
        from_msgpack(Acknowledgement, payload)


def test_a_model_refuses_nan() -> None:
    with pytest.raises(ValueError, match="finite"):
        MetricReply(value=float("nan"), limit=1.0, at_least=True, passed=False)


NEVER_SHOWN = {"frames", "commands"}
"""Modules whose messages only the service receives; it checks their texts itself."""

MODELS = [
    model
    for module in pkgutil.iter_modules(schemas.__path__)
    if module.name not in NEVER_SHOWN
    for name, model in inspect.getmembers(importlib.import_module(f"coec.schemas.{module.name}"), inspect.isclass)
    if issubclass(model, BaseModel) and model.__module__ == f"coec.schemas.{module.name}"
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_text_of_a_message_prints_as_an_escape_and_travels_as_it_is(model: type[BaseModel]) -> None:
    message = hostile_message(model)
    assert [text for text in message_texts(message) if not isinstance(text, Untrusted)] == [], "declare it as `Text`"
    for back in (from_json(model, to_json(message)), from_msgpack(model, to_msgpack(message))):
        assert back == message
        assert set(map(type, message_texts(back))) <= {Untrusted}
    assert obeyed_characters(f"{message_texts(message)}{message!r}") == ""


def test_places_of_mistakes_name_no_key_of_the_sender_as_it_arrived() -> None:
    document = json.loads(to_json(hostile_message(HealthReply)))
    document["metrics"] = {HOSTILE + "k" * 10_000: {}}
    with pytest.raises(DecodeError) as refused:
        from_json(HealthReply, json.dumps(document).encode())
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize(
    ("payload", "wrong"),
    [
        (b'{"a": ', "line 1 column 7"),
        (b'"\xff"', "no UTF-8 at byte 1"),
        (b"[" * 100_000, "nested deeper than 64"),
        (b"[" * 66 + b"]" * 66, "nested deeper than 64"),
        (b"1" * 5_000, "too many digits"),
        (b"[-Infinity]", "not finite"),
        (b"1e999", "not finite"),
    ],
)
def test_a_document_that_could_not_be_written_again_is_refused(payload: bytes, wrong: str) -> None:
    with pytest.raises(DecodeError, match=wrong):
        json_value(payload)


def test_a_document_that_can_be_written_again_is_read() -> None:
    assert json_value(b'{"a": [1, 2.5, null, "\\ud800"]}') == {"a": [1, 2.5, None, "\ud800"]}
