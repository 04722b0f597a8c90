"""The last word of a pair: when it is said, what it says, and who answers when it is asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from coec.config import Config, UplinkConfig, ZenohConfig
from coec.errors import DecodeError, NotFoundError
from coec.io.zenoh.bus import Answer
from coec.io.zenoh.query_client import connected, query_all
from coec.schemas import heartbeat as last_word
from coec.schemas.keys import Keys
from coec.service.api.uplink import Heartbeats
from e2e.processes import Router
from support.fake_worker import wait_until
from support.messages import heartbeat, packed_heartbeat
from support.vehicles import PAIR, PairBench, serving

KEYS = Keys("coec", "vehicle")
PERIOD = UplinkConfig(last_word_s=30.0)


class Clock:
    """Seconds, as the test says."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_it_is_reported_on_change_from_time_to_time_and_at_the_end(tmp_path: Path) -> None:
    bench, clock = PairBench(tmp_path / "state", vehicle="vehicle"), Clock()
    reported: list[tuple[str, Answer]] = []
    text = Heartbeats(KEYS, "1.2", PERIOD, lambda key, answer: reported.append((key, answer)), clock)

    def received(service: str) -> list[str]:
        before = len(reported)
        text.renew(service, "h", [bench.answers])  # type: ignore[arg-type]
        return [last_word.decode_heartbeat(key, answer.payload).service for key, answer in reported[before:]]

    assert received("running") == ["running"]
    assert received("running") == [], "nothing has changed"
    clock.now_s = 29.0
    assert received("running") == []
    clock.now_s = 31.0
    assert received("running") == ["running"]
    assert received("stopping") == ["stopping"], "whoever leaves says so"
    key, answer = reported[-1]
    assert key == KEYS.last(PAIR)
    word = last_word.decode_heartbeat(key, answer.payload)
    assert (word.state, word.provenance, word.period_s, word.version) == ("unknown", "nominal", 30.0, "1.2")


def test_of_a_pair_that_is_not_there_nothing_is_reported() -> None:
    with pytest.raises(NotFoundError):
        Heartbeats(KEYS, "0", PERIOD, lambda *_: None).answer("front", "json")


def test_the_service_answers_for_itself_and_is_silent_about_pairs_that_it_does_not_have(
    router: Router, tmp_path: Path
) -> None:
    """Others may have kept the words of those: an error reply would hide them."""
    with (
        serving(tmp_path, ZenohConfig(connect=(router.endpoint,))),
        connected([router.endpoint], 5.0) as session,
    ):
        wait_until(lambda: bool(query_all(session, KEYS.last(PAIR), 5.0)), "the vehicle answers")
        for expression in (KEYS.last(PAIR), KEYS.last("*"), "coec/@v1/*/last/*"):
            (reply,) = query_all(session, expression, 5.0)
            assert last_word.decode_heartbeat(reply.key, reply.payload).pair == PAIR
        assert query_all(session, KEYS.last("gone"), 5.0) == []
        assert [reply.key for reply in query_all(session, "coec/@v1/*/*/health", 5.0)] == [KEYS.health(PAIR)]


@pytest.mark.fault("a last word that is too large, invalid, or about another vehicle", "refused by cause, never shown")
@pytest.mark.parametrize(
    ("key", "payload", "cause"),
    [
        (KEYS.last("front"), b"\x00" * (last_word.MAX_HEARTBEAT_BYTES + 1), "word_too_large"),
        (KEYS.last("front"), b"", "word_malformed"),
        (KEYS.last("front"), b"\xc1", "word_malformed"),
        (KEYS.last("front"), b"\x91" * 9000, "word_malformed"),
        (KEYS.last("front"), packed_heartbeat(heartbeat(), state="splendid"), "word_malformed"),
        (KEYS.last("front"), packed_heartbeat(heartbeat(), drift=[float("nan")] * 6), "word_malformed"),
        (KEYS.last("front"), packed_heartbeat(heartbeat(), reasons=[{"code": "x", "text": "x"}] * 9), "word_malformed"),
        (KEYS.last("rear"), packed_heartbeat(heartbeat()), "word_of_another"),
        (Keys("coec", "other").last("front"), packed_heartbeat(heartbeat()), "word_of_another"),
    ],
)
def test_what_is_no_word_of_its_key_is_refused(key: str, payload: bytes, cause: str) -> None:
    with pytest.raises(DecodeError) as refused:
        last_word.decode_heartbeat(key, payload)
    assert refused.value.reason == cause


@pytest.mark.parametrize("taken", ["last", "rig"])
def test_a_pair_cannot_have_the_name_of_what_all_have(taken: str) -> None:
    from coec.cli.check_config import example

    document = example().model_dump(mode="json")
    document["pairs"][0]["name"] = taken
    with pytest.raises(ValueError, match=f"`{taken}`"):
        Config.model_validate(document)
