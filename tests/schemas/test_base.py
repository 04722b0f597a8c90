"""Canonical encodings of wire models, and what readers forgive."""

import json

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.errors import DecodeError
from coec.schemas.base import from_json, from_msgpack, to_json, to_msgpack
from coec.schemas.replies import Acknowledgement, MetricReply, StreamStatus, Transform

ACKNOWLEDGEMENT = Acknowledgement(
    vehicle="v", pair="front", command="calibrate", accepted=False, code="too_few_pairs", text="4 more pairs — wait"
)


def test_json_is_sorted_and_has_no_spaces_between() -> None:
    assert to_json(ACKNOWLEDGEMENT).decode() == (
        '{"accepted":false,"code":"too_few_pairs","command":"calibrate","durable":null,"pair":"front","schema_version":6,'
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
