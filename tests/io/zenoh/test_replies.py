"""Replies to a query: whatever answers, a client uses bounded memory and says what it left out."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from coec.errors import NotFoundError, RemoteError
from coec.io.zenoh import query_client
from coec.io.zenoh.query_client import JSON, Replies, ReplyBounds, connected, query_all, query_one
from coec.io.zenoh.subscriptions import MAX_WAITING_BYTES, HeartbeatReceiver
from coec.schemas.heartbeat import MAX_HEARTBEAT_BYTES
from coec.schemas.keys import Keys
from coec.schemas.message import to_json
from coec.schemas.replies import ErrorReply
from e2e.processes import Router
from support.fake_worker import wait_until

PATIENCE_S = 20.0
SMALL = ReplyBounds(replies=5, total_bytes=1000, reply_bytes=400)
NUMBERS = itertools.count()


class Payload:
    """Of a reply; fails if it is copied although it must not be."""

    def __init__(self, size: int, *, may_be_copied: bool = True) -> None:
        self._size = size
        self._may_be_copied = may_be_copied

    def __len__(self) -> int:
        return self._size

    def to_bytes(self) -> bytes:
        assert self._may_be_copied, "copied"
        return bytes(self._size)


def a_reply(key: str, size: int, stamp: int | None = None, **payload: bool) -> zenoh.Reply:
    timestamp = None if stamp is None else SimpleNamespace(get_time=lambda: stamp)
    sample = SimpleNamespace(
        key_expr=key, payload=Payload(size, **payload), encoding=f"text/{size}", timestamp=timestamp
    )
    return cast(zenoh.Reply, SimpleNamespace(ok=sample, err=None))


def an_error(content: bytes) -> zenoh.Reply:
    return cast(
        zenoh.Reply, SimpleNamespace(ok=None, err=SimpleNamespace(payload=zenoh.ZBytes(content), encoding=JSON))
    )


def collected(*replies: zenoh.Reply, selector: str = "a/*") -> Replies:
    made = Replies(selector, 1.0, lambda: None, SMALL)
    for reply in replies:
        made.add(reply)
    return made


def refused(replies: Replies) -> RemoteError:
    with pytest.raises(RemoteError) as error:
        replies.result()
    return error.value


@pytest.mark.fault("more replies, or larger ones, than a query can bring", "an error that says how many, and no copy")
def test_replies_are_bounded_in_number_and_in_bytes() -> None:
    few = [a_reply(f"a/{index}", 100) for index in range(5)]
    assert len(collected(*few).result()) == 5
    many = refused(collected(*few, a_reply("a/5", 1, may_be_copied=False)))
    assert (many.reply_code, "more than 5 replies to a/*" in str(many)) == ("too_many_replies", True)
    assert "name one vehicle and one pair" in str(many)
    large = refused(collected(a_reply("a/\x1b[2J", 401, may_be_copied=False)))
    assert large.reply_code == "reply_too_large"
    assert "401 bytes, and 400 are accepted" in str(large)
    assert "\x1b" not in str(large)
    together = refused(collected(*(a_reply(f"a/{n}", 400, may_be_copied=n < 2) for n in range(3))))
    assert together.reply_code == "replies_too_large"
    assert "have more than 1000 bytes" in str(together)
    of_one = refused(collected(*(a_reply("a", 1, n) for n in range(6)), selector="a"))
    assert "one program answers for a key" in str(of_one)


def test_the_latest_of_several_replies_with_one_key_counts() -> None:
    (reply,) = collected(a_reply("a", 1, 5), a_reply("a", 2, 7), a_reply("a", 3, 6), a_reply("a", 4)).result()
    assert reply.encoding == "text/2"
    (reply,) = collected(a_reply("a", 1), a_reply("a", 2, 1)).result()
    assert reply.encoding == "text/2"


def test_an_error_reply_ends_the_query_and_is_bounded() -> None:
    finished: list[bool] = []
    replies = Replies("a/*", 1.0, lambda: finished.append(True), SMALL)
    replies.add(an_error(to_json(ErrorReply(code="busy", message="later"))))
    replies.add(a_reply("a/1", 1, may_be_copied=False))
    assert (finished, refused(replies).reply_code) == ([True], "busy")
    assert refused(collected(an_error(bytes(query_client.MAX_ERROR_BYTES + 1)))).reply_code == "unknown"
    assert refused(collected(an_error(query_client.TIMEOUT_PAYLOAD))).reply_code == "timeout"
    assert len(collected(an_error(query_client.TIMEOUT_PAYLOAD), a_reply("a/1", 1)).result()) == 1


@contextmanager
def answering(router: Router, key: str, answer: Callable[[zenoh.Query], None]) -> Iterator[None]:
    def receive(query: zenoh.Query) -> None:
        with query:
            answer(query)

    declared = router.session.declare_queryable(key, receive)
    yield
    declared.undeclare()


def own_key() -> str:
    return f"replies/{next(NUMBERS)}"


@pytest.mark.fault("a program that answers with endless replies", "the query ends at the bound, long before its time")
def test_a_flood_of_replies_ends_the_query(router: Router, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(query_client, "OF_MANY_KEYS", SMALL)
    key, over = own_key(), threading.Event()

    def flood(query: zenoh.Query) -> None:
        for index in itertools.count():
            query.reply(f"{key}/{index}", b"x")
            if over.wait(0.002 if index > SMALL.replies else 0.0):
                return

    with answering(router, f"{key}/*", flood), connected([router.endpoint], 5.0) as session:
        try:
            with pytest.raises(RemoteError, match="more than 5 replies"):
                query_all(session, f"{key}/*", 600.0)
        finally:
            over.set()


@pytest.mark.fault("a reply larger than any message", "Zenoh drops it, and the client says that this may be the reason")
def test_an_answer_larger_than_a_message_is_no_answer(router: Router) -> None:
    key = own_key()
    too_large = bytes(query_client.MAX_MESSAGE_BYTES + 2**20)
    with (
        answering(router, key, lambda query: query.reply(key, too_large)),
        connected([router.endpoint], 5.0) as session,
        pytest.raises(NotFoundError),
    ):
        query_one(session, key, 5.0)
    assert str(query_client.MAX_MESSAGE_BYTES) in str(query_client.no_reply_error(key, service_is_there=True))


@pytest.mark.fault("words of the largest size, faster than they are read", "those beyond 64 MiB are counted as lost")
def test_text_that_wait_are_bounded_in_bytes() -> None:
    nowhere = cast(Any, None)
    text = HeartbeatReceiver(nowhere, nowhere, Keys("coec", "*"), 1.0)
    reported = SimpleNamespace(
        kind=zenoh.SampleKind.PUT, key_expr="coec/@v1/a/last/b", payload=Payload(MAX_HEARTBEAT_BYTES)
    )
    count = MAX_WAITING_BYTES // MAX_HEARTBEAT_BYTES
    for _ in range(count + 3):
        text._on_published(cast(zenoh.Sample, reported))
    assert text.refused() == {"too_many_at_once": 3}
    assert sum(1 for _ in text.pending()) == count
    text._on_published(cast(zenoh.Sample, reported))
    assert text.refused() == {}, "there is room again"


def test_one_token_of_many_says_that_a_service_is_there(router: Router) -> None:
    keys = Keys("coec", "tokens")
    with connected([router.endpoint], 5.0) as session:
        assert not query_client.is_alive(session, keys, PATIENCE_S)
        tokens = [router.session.liveliness().declare_token(keys.alive(f"pair-{index}")) for index in range(100)]
        wait_until(lambda: query_client.is_alive(session, keys, PATIENCE_S), "the tokens are seen")
        for token in tokens:
            token.undeclare()
