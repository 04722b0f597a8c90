"""An answer on its way from the worker: nothing is lost, to the bit, and what is not of the documented form is seen."""

from __future__ import annotations

import math
import struct
from dataclasses import fields
from typing import Any

import msgpack
import numpy as np
import pytest

from coec.calibration.baseline import BaselineDrift
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.types import Metric, Reason
from coec.io.serialise import result_of
from coec.schemas.message import to_msgpack
from coec.service.worker.worker_jobs import (
    Answer,
    Checked,
    Commissioned,
    Kind,
    MalformedAnswerError,
    RenderedImage,
    Solved,
    number_of,
    pack_answer,
    read_answer,
)
from support.estimates import ESTIMATE_RIG, estimate

OBSERVATION = Observation(
    stamp_ns=7,
    pair_stamps_ns=(5, 7),
    metrics=(Metric("mi", 1 / 3, float("nan"), at_least=True),),
    offset=np.array([1 / 3, np.nan, 0.0, -0.0, 5e-324, 3.0]),
    sigma=np.full(6, np.nan),
    noise=np.full(6, 1 / 11),
    place=np.full(6, np.inf),
    dispersion=1.0,
    distance2=1 / 7,
    flagged=True,
    weak=False,
    flagged_by_paper=None,
    causes=(CAUSES["dark"],),
    first_derivative=np.arange(6) / 7,
    second_derivative=np.arange(6) / 9,
    drift=BaselineDrift(np.arange(6) / 3, np.full(6, np.inf)),
    dirty=(3, 575),
    textured=400,
)


def over_the_wire(message: dict[str, Any]) -> dict[str, Any]:
    back: dict[str, Any] = msgpack.unpackb(msgpack.packb(message))
    return back


def returned(answer: Answer, kind: Kind) -> Any:
    return read_answer(over_the_wire(pack_answer(3, answer)), kind)


def assert_same(one: object, other: object) -> None:
    """Equal in every field, arrays and doubles in every bit."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    elif isinstance(one, float) and isinstance(other, float):
        assert struct.pack("d", one) == struct.pack("d", other)
    elif isinstance(one, tuple) and isinstance(other, tuple):
        assert len(one) == len(other)
        for mine, its in zip(one, other, strict=True):
            assert_same(mine, its)
    elif isinstance(one, Observation | BaselineDrift | Metric):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


@pytest.mark.parametrize("why_not", [None, "another network"])
def test_a_check_survives_to_the_bit(why_not: str | None) -> None:
    back = returned(Checked(OBSERVATION, why_not), Kind.CHECK)
    assert isinstance(back, Checked)
    assert back.baseline_not_used == why_not
    assert_same(back.observation, OBSERVATION)


def test_figures_of_numpy_are_plain_figures_on_the_other_side() -> None:
    strange: Any = np.bool_(True), np.float64(0.25), np.int64(9)
    made = Observation(
        strange[2], (strange[2],), (Metric("mi", strange[1], strange[1], strange[0]),), np.zeros(6), np.zeros(6),
        np.zeros(6), np.zeros(6), strange[1], strange[1], strange[0], strange[0], strange[0], (),
    )  # fmt: skip
    back = returned(Checked(made, None), Kind.CHECK).observation
    assert (type(back.stamp_ns), type(back.distance2), type(back.flagged)) == (int, float, bool)
    assert back.metrics == (Metric("mi", 0.25, 0.25, True),)
    assert all(math.isnan(value) for value in back.first_derivative), "not told, not zero"


@pytest.mark.parametrize("note", [None, Reason("recording_failed", "The disk is full.")])
def test_a_result_survives_to_the_byte(note: Reason | None) -> None:
    result = result_of(estimate(1), ESTIMATE_RIG, "test")
    back = returned(Solved(result, note), Kind.SOLVE)
    assert isinstance(back, Solved)
    assert back.note == note
    assert to_msgpack(back.result) == to_msgpack(result)


def test_a_commissioning_and_a_picture_survive() -> None:
    pose = np.random.default_rng(0).normal(size=(4, 4))
    back = returned(Commissioned(pose, "hash", 8, 200), Kind.COMMISSION)
    assert isinstance(back, Commissioned)
    assert_same(back.pose, pose)
    assert (back.baseline_hash, back.windows, back.pairs) == ("hash", 8, 200)
    assert returned(RenderedImage(b"\xff\xd8jpeg"), Kind.OVERLAY) == RenderedImage(b"\xff\xd8jpeg")


def test_a_refusal_is_reported_whatever_was_requested_and_a_prefetch_is_answered_with_nothing() -> None:
    refusal = over_the_wire(pack_answer(9, Reason("bad_window", "empty")))
    assert number_of(refusal) == 9
    for kind in (*Kind, None):
        assert read_answer(refusal, kind) == Reason("bad_window", "empty")
    assert read_answer(over_the_wire(pack_answer(9, None)), None) is None


@pytest.mark.parametrize("number", [None, "3", 3.0, True, [3]])
def test_an_answer_without_a_number_is_malformed(number: object) -> None:
    with pytest.raises(MalformedAnswerError, match="number"):
        number_of({"id": number, "result": None})


RIGHT = over_the_wire(pack_answer(3, Checked(OBSERVATION, None)))["result"]


def changed(**observation: object) -> dict[str, Any]:
    return {**RIGHT, "observation": {**RIGHT["observation"], **observation}}


def an_array(code: int, shape: object, doubles: object) -> msgpack.ExtType:
    return msgpack.ExtType(code, msgpack.packb([shape, doubles]))


@pytest.mark.parametrize(
    "result",
    [
        None,
        7,
        "text",
        [],
        {},
        {"observation": RIGHT["observation"]},
        {**RIGHT, "more": 1},
        {**RIGHT, "observation": None},
        changed(stamp_ns="soon"),
        changed(pair_stamps_ns=7),
        changed(metrics=[["mi", 1.0, 2.0, True]]),
        changed(flagged="perhaps"),
        changed(more=1),
        changed(offset=[0.0] * 6),
        changed(offset=an_array(1, [5], bytes(40))),
        changed(offset=an_array(1, [2, 3], bytes(48))),
        changed(offset=an_array(1, [6], bytes(47))),
        changed(offset=an_array(1, [7], bytes(48))),
        changed(offset=an_array(1, "six", bytes(48))),
        changed(offset=an_array(1, [6], "doubles")),
        changed(offset=an_array(2, [6], bytes(48))),
        changed(offset=msgpack.ExtType(1, b"\xc1")),
        changed(offset=msgpack.ExtType(1, b"\x07")),
        changed(drift={"value": RIGHT["observation"]["offset"], "sigma": an_array(1, [1], bytes(8))}),
        over_the_wire(pack_answer(3, RenderedImage(b"")))["result"],
    ],
)
def test_what_is_no_check_is_malformed(result: object) -> None:
    with pytest.raises(MalformedAnswerError):
        read_answer(over_the_wire({"id": 3, "result": result}), Kind.CHECK)


@pytest.mark.fault("a worker that answers something else", "the answer is malformed, never taken")
@pytest.mark.parametrize(
    ("kind", "result"),
    [
        (Kind.SOLVE, {"result": b"\xc1", "note": None, "written": None}),
        (Kind.SOLVE, {"result": msgpack.packb({"pair": "front"}), "note": None, "written": None}),
        (Kind.SOLVE, {"result": msgpack.packb(7), "note": None, "written": None}),
        (
            Kind.SOLVE,
            {"result": to_msgpack(result_of(estimate(1), ESTIMATE_RIG, "test")), "note": "text", "written": None},
        ),
        (Kind.OVERLAY, {"jpeg": 7}),
        (Kind.OVERLAY, {"code": "a", "text": "a reason, and no refusal"}),
        (
            Kind.COMMISSION,
            {"pose": an_array(1, [4, 4], bytes(128)), "baseline_hash": "b", "windows": "many", "pairs": 1},
        ),
        (Kind.COMMISSION, {"pose": an_array(1, [16], bytes(128)), "baseline_hash": "b", "windows": 1, "pairs": 1}),
        (
            Kind.COMMISSION,
            {"pose": an_array(1, [4, 4], b"\xff" * 128), "baseline_hash": "b", "windows": 1, "pairs": 1},
        ),
        (None, {"jpeg": b""}),
    ],
)
def test_what_is_no_answer_to_what_was_requested_is_malformed(kind: Kind | None, result: object) -> None:
    with pytest.raises(MalformedAnswerError):
        read_answer(over_the_wire({"id": 3, "result": result}), kind)


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"result": {"jpeg": b""}, "refused": {"code": "a", "text": "b"}},
        {"result": {"jpeg": b""}, "more": 1},
        {"refused": None},
        {"refused": {"code": "a"}},
        {"refused": {"code": [1], "text": "b"}},
        {"jpeg": b""},
    ],
)
def test_an_answer_is_a_result_or_a_refusal(content: dict[str, Any]) -> None:
    with pytest.raises(MalformedAnswerError):
        read_answer(over_the_wire({"id": 3, **content}), Kind.OVERLAY)
