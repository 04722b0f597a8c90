"""Of several daemons of one vehicle exactly one stays, in whatever order they look."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

from coec.config import LimitsConfig, ZenohConfig
from coec.errors import UnavailableError
from coec.io.zenoh import singleton
from coec.io.zenoh.bus import open_session
from coec.io.zenoh.singleton import SingletonGuard, next_step, outranking
from coec.schemas.keys import Claim, Keys
from coec.schemas.message import to_json
from support.fake_worker import wait_until
from support.messages import status_reply
from support.router import free_port

KEYS = Keys("coec", "vehicle")
LIMITS = LimitsConfig()
STARTED_NS = 1_700_000_000 * 10**9
DEADLINE_S = 20.0
ROUNDS = 20

Made = Callable[..., SingletonGuard]


@pytest.fixture(scope="module")
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def router(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LIMITS) as session:
        yield session


@pytest.fixture(scope="module")
def sessions(router: zenoh.Session, endpoint: str) -> Iterator[list[zenoh.Session]]:
    """Of two daemons on the router."""
    del router  # it has to be there first
    config = ZenohConfig(connect=(endpoint,))
    with open_session(config, LIMITS) as one, open_session(config, LIMITS) as two:
        yield [one, two]


@pytest.fixture
def daemon(endpoint: str) -> Iterator[Made]:
    """Makes one of a vehicle, which is closed at the end of the test."""
    with ExitStack() as stack:

        def make(session: zenoh.Session, keys: Keys = KEYS) -> SingletonGuard:
            one = SingletonGuard(session, ZenohConfig(connect=(endpoint,)), LIMITS, keys, STARTED_NS)
            stack.callback(lambda: one.close(DEADLINE_S))
            return one

        yield make


def serves(one: SingletonGuard) -> bool:
    try:
        one.claim(threading.Event())
    except UnavailableError:
        return False
    return True


@pytest.mark.fault("several daemons of a vehicle start in any order of looks", "never two serve, and always one does")
def test_in_no_order_of_observations_do_two_serve_and_one_always_does() -> None:
    """Every reachable state of three daemons that start, look and decide in any order, each any number of times."""
    start: tuple[str, ...] = ("new", "new", "new")
    reached, waiting = {start}, [start]
    while waiting:
        states = waiting.pop()
        following = set()
        for index, state in enumerate(states):
            others = [
                Claim(str(number), 0, serving=there == "serving")
                for number, there in enumerate(states)
                if number != index and there in ("starting", "serving")
            ]
            step = {"new": "starting", "starting": next_step(str(index), others)}.get(state, state)
            after = {"serve": "serving", "leave": "left", "wait": state}.get(step, step)
            following.add((*states[:index], after, *states[index + 1 :]))
        assert states.count("serving") <= 1, states
        if following == {states}:
            assert states.count("serving") == 1, f"nobody moves: {states}"
        waiting += following - reached
        reached |= following
    assert len(reached) > len(start), "the model moves"


@pytest.mark.fault("two daemons serve on two sides of a network that comes together", "one leaves")
def test_of_two_that_serve_on_different_sides_of_a_network_the_larger_leaves() -> None:
    one, two = Claim("1", 5, serving=True), Claim("2", 4, serving=True)
    assert outranking("2", [one]) == one
    assert outranking("1", [two]) is None
    assert outranking("2", [Claim("1", 5, serving=False)]) is None, "who starts has to leave itself"


def test_of_two_that_start_at_once_one_stays(sessions: list[zenoh.Session], daemon: Made) -> None:
    for _ in range(ROUNDS):
        both = [daemon(session) for session in sessions]
        with ThreadPoolExecutor(len(both)) as pool:
            assert sorted(pool.map(serves, both)) == [False, True]
        assert all(one.close(DEADLINE_S) for one in both)


def test_who_comes_later_says_who_is_there_and_is_no_matter_to_another_vehicle(
    sessions: list[zenoh.Session], daemon: Made
) -> None:
    one, two = sessions
    assert serves(daemon(one))
    with pytest.raises(UnavailableError, match=r"'vehicle' is served .* started 2023-11-14 22:13:20 UTC, Zenoh id"):
        daemon(two).claim(threading.Event())
    assert serves(daemon(two, Keys("coec", "other")))


@contextmanager
def held(session: zenoh.Session, *keys: str) -> Iterator[None]:
    """Liveliness tokens that any program could declare."""
    tokens = [session.liveliness().declare_token(key) for key in keys]
    yield
    for token in tokens:
        token.undeclare()


@contextmanager
def answering_status(session: zenoh.Session, started_ns: int) -> Iterator[None]:
    """What a service of an earlier version answers."""
    payload = to_json(status_reply(vehicle=KEYS.vehicle, started_ns=started_ns))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(KEYS.status, payload)

    queryable = session.declare_queryable(KEYS.status, zenoh.handlers.Callback(answer, indirect=False), complete=True)
    yield
    queryable.undeclare()


FAKED = KEYS.claim(Claim("1", 1, serving=True))
"""The smallest id of a daemon, so that every other daemon would have to leave."""


@pytest.mark.fault(
    "a program holds the token of another daemon, or of a pair, but answers no query",
    "the daemon serves after a bounded wait, and reports the token",
)
@pytest.mark.parametrize("key", [FAKED, KEYS.claim(Claim("1", 7, serving=False)), KEYS.alive("front")])
def test_a_token_without_an_answer_ends_nothing(
    router: zenoh.Session,
    sessions: list[zenoh.Session],
    daemon: Made,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    key: str,
) -> None:
    monkeypatch.setattr(singleton, "PROOF_S", 0.2)
    one = daemon(sessions[0])
    with held(router, key):
        assert serves(one)
    assert one.unproven == (key,)
    assert [key in record.getMessage() for record in caplog.records] == [True]


@pytest.mark.fault(
    "a program declares the token of another daemon while the service runs", "it goes on, and reports the token"
)
def test_a_token_without_an_answer_ends_no_service_that_runs(
    router: zenoh.Session, sessions: list[zenoh.Session], daemon: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(singleton, "WATCH_S", 0.02)
    one = daemon(sessions[0])
    assert serves(one)
    one.thread.start()
    copied = KEYS.claim(Claim("2", STARTED_NS, serving=True))
    with held(router, FAKED, copied, KEYS.alive("front")), answering_status(sessions[0], STARTED_NS):
        wait_until(lambda: set(one.unproven) == {FAKED, copied}, "the tokens are reported")
        assert one.rival is None, "the answer of the service itself proves no token that copies its start"
    wait_until(lambda: one.unproven == (), "the tokens are gone")
    with held(router, FAKED), answering_status(sessions[1], 1):
        wait_until(lambda: one.rival == Claim("1", 1, serving=True), "a service of an earlier version")


@pytest.mark.fault(
    "a daemon of an earlier version, which answers `status` only, serves the vehicle", "the new one leaves"
)
@pytest.mark.parametrize("token", [FAKED, KEYS.alive("front")])
def test_a_service_of_an_earlier_version_is_seen_by_its_status(
    router: zenoh.Session, sessions: list[zenoh.Session], daemon: Made, token: str
) -> None:
    with held(router, token), answering_status(router, 1), pytest.raises(UnavailableError, match="another daemon"):
        daemon(sessions[0]).claim(threading.Event())


@pytest.mark.fault("more tokens of daemons than are kept", "a daemon that is there is seen all the same")
def test_tokens_hide_no_daemon(router: zenoh.Session, sessions: list[zenoh.Session], daemon: Made) -> None:
    assert serves(daemon(sessions[0]))
    flood = [KEYS.claim(Claim(f"{number:x}", 1, serving=True)) for number in range(1, 3 * singleton.MAX_OTHERS)]
    with held(router, *flood), pytest.raises(UnavailableError, match=r"started 2023-11-14 22:13:20 UTC"):
        daemon(sessions[1]).claim(threading.Event())


def test_a_wider_query_gets_no_claim(sessions: list[zenoh.Session], daemon: Made) -> None:
    assert serves(daemon(sessions[0]))

    def replies(key: str) -> list[zenoh.Reply]:
        return list(sessions[0].get(key, target=zenoh.QueryTarget.ALL, timeout=DEADLINE_S))

    assert (len(replies(f"{KEYS.root}/**")), len(replies(KEYS.claims))) == (0, 1)


@pytest.mark.fault("a router whose rules let no daemon query another", "its tokens count without an answer, as before")
def test_where_queries_are_forbidden_tokens_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(singleton, "PROOF_S", 0.2)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "router.json5"
    settings = {"mode": "router", "listen": {"endpoints": [endpoint]}, "access_control": hiding("query")}
    file.write_text(json.dumps(settings))
    config = ZenohConfig(connect=(endpoint,))
    with open_session(ZenohConfig(file=file), LIMITS), open_session(config, LIMITS) as here:
        wait_until(lambda: bool(list(here.info.routers_zid())), "the router is there")
        for key, reported in ((FAKED, "by another daemon"), (KEYS.alive("front"), "another session holds the token")):
            one = SingletonGuard(here, config, LIMITS, KEYS, STARTED_NS)
            with held(here, key), pytest.raises(UnavailableError, match=reported):
                one.claim(threading.Event())
            assert one.close(DEADLINE_S)


def test_a_token_of_another_form_is_nobody(router: zenoh.Session, sessions: list[zenoh.Session], daemon: Made) -> None:
    ends = ("serving/zz/1", "serving/1/" + "9" * 40, "gone/1/1", "serving/0/1", "serving/1/0")
    tokens = [router.liveliness().declare_token(f"{KEYS.root}/alive/{end}") for end in ends]
    assert serves(daemon(sessions[0]))
    for token in tokens:
        token.undeclare()


@pytest.mark.fault("two daemons start before their router", "when it is there they see each other, and one leaves")
def test_two_that_started_before_their_router_see_each_other_when_it_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(singleton, "WATCH_S", 0.02)
    monkeypatch.setattr(singleton, "CONNECT_S", 0.1)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = ZenohConfig(connect=(endpoint,))
    with open_session(config, LIMITS) as here, open_session(config, LIMITS) as there:
        both = [SingletonGuard(session, config, LIMITS, KEYS, STARTED_NS) for session in (here, there)]
        assert [serves(one) for one in both] == [True, True]
        with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LIMITS):
            for one in both:
                one.thread.start()
            wait_until(lambda: any(one.rival for one in both), "one sees the other")
            (leaving,) = [one for one in both if one.rival]
            assert all(one.close(DEADLINE_S) for one in both)
        (staying,) = [one for one in both if one is not leaving]
        assert staying.rival is None


def hiding(*messages: str) -> dict[str, object]:
    """Rules that deny these messages, either way, and allow all else."""
    rule = {
        "id": "hide",
        "permission": "deny",
        "flows": ["ingress", "egress"],
        "messages": messages,
        "key_exprs": ["coec/@v1/**"],
    }
    subject = {"id": "all", "link_protocols": ["tcp"]}
    policy = {"subjects": ["all"], "rules": ["hide"]}
    return {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [subject],
        "policies": [policy],
    }


@pytest.mark.fault("a router whose rules hide liveliness tokens", "the daemon sees it, and when it is over")
@pytest.mark.parametrize("messages", [("liveliness_token",), ("liveliness_query",)])
def test_tokens_that_a_router_hides_are_reported_of(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, messages: tuple[str, ...]
) -> None:
    monkeypatch.setattr(singleton, "WATCH_S", 0.02)
    monkeypatch.setattr(singleton, "CONNECT_S", 0.5)
    monkeypatch.setattr(singleton, "SEEN_S", 0.2)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "router.json5"
    settings = {"mode": "router", "listen": {"endpoints": [endpoint]}, "access_control": hiding(*messages)}
    file.write_text(json.dumps(settings))
    config = ZenohConfig(connect=(endpoint,))
    with ExitStack() as stack:
        rules = stack.enter_context(ExitStack())
        rules.enter_context(open_session(ZenohConfig(file=file), LIMITS))
        session = stack.enter_context(open_session(config, LIMITS))
        one = SingletonGuard(session, config, LIMITS, KEYS, STARTED_NS)
        wait_until(lambda: bool(list(session.info.routers_zid())), "the router is there")
        assert serves(one)
        assert one.hidden
        one.thread.start()
        rules.close()
        stack.enter_context(open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LIMITS))
        wait_until(lambda: not one.hidden, "the tokens are seen")
        assert one.close(DEADLINE_S)
