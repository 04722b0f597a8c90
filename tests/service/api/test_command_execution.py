"""Commands over a router without rules: who may give them is for the service to say, and denied reads as denied."""

from __future__ import annotations

import json
import logging
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import zenoh

from coec.config import AuthorityConfig, SenderConfig, ZenohConfig
from coec.errors import NotProvenError, RemoteError
from coec.io.zenoh.bus import JSON, WAITING, QueryLane, open_session
from coec.io.zenoh.command_auth import CommandSender
from coec.io.zenoh.query_client import connected, query_one, send_authenticated
from coec.schemas.commands import ProvenCommand
from coec.schemas.message import to_json
from coec.service.api import command_execution
from coec.service.api.command_execution import BURST, RateLimit
from support.fake_worker import wait_until
from support.router import TestAuthority, free_port
from support.vehicles import KEYS, PAIR, VEHICLE_LIMITS, ServingVehicle, serving

PATIENCE_S = 20.0
HOLD = KEYS.command(PAIR, "hold")
RELEASE = b'{"release":true}'
OPERATOR = SenderConfig(name="operator", commands=("hold", "calibrate"))


@pytest.fixture(scope="module")
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def router(endpoint: str) -> Iterator[zenoh.Session]:
    """One without rules; whoever holds it may do all that a router in between can."""
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), VEHICLE_LIMITS) as session:
        yield session


Served = Callable[..., ServingVehicle]


@pytest.fixture
def vehicle(
    router: zenoh.Session, endpoint: str, tmp_path: Path
) -> Iterator[Callable[[AuthorityConfig], ServingVehicle]]:
    """A vehicle on the router, once it is told who may give commands."""
    with_end = []

    def served(authority: AuthorityConfig) -> ServingVehicle:
        context = serving(tmp_path / "state", ZenohConfig(connect=(endpoint,)), authority)
        with_end.append(context)
        made = context.__enter__()
        wait_until(lambda: bool(list(router.get(KEYS.status, timeout=PATIENCE_S))), "the vehicle answers")
        return made

    yield served
    for context in with_end:
        context.__exit__(None, None, None)


def plainly(session: zenoh.Session, payload: bytes | None = None, key: str = HOLD) -> dict[str, object]:
    reported: dict[str, object] = json.loads(query_one(session, f"{key}?format=json", PATIENCE_S, payload).payload)
    return reported


def proven(
    session: zenoh.Session, authority: TestAuthority, name: str, key: str = HOLD, payload: bytes | None = None
) -> dict[str, object]:
    speaker = CommandSender(authority.credentials(name), "vehicle")
    reported: dict[str, object] = json.loads(
        send_authenticated(session, f"{key}?format=json", payload, PATIENCE_S, speaker, JSON).payload
    )
    return reported


def refusal(reported: Callable[[], object]) -> tuple[str, str]:
    with pytest.raises(RemoteError) as refused:
        reported()
    return refused.value.reply_code, str(refused.value)


@pytest.mark.fault("a command through a router that has no rules", "it is denied, reads as denied, and is counted")
def test_who_proves_no_name_may_give_no_command(
    authority: TestAuthority,
    router: zenoh.Session,
    vehicle: Served,
    caplog: pytest.LogCaptureFixture,
) -> None:
    there = vehicle(authority.of_service(OPERATOR))
    for _ in range(5):
        code, why = refusal(lambda: plainly(router))
        assert code == "not_allowed"
        assert "needs an authenticated sender" in why
    assert not there.is_held
    assert there.commands == {"hold_not_allowed": 5}
    lines = [record for record in caplog.records if "denied" in record.getMessage()]
    assert [record.levelno for record in lines] == [logging.WARNING] * 3, "the first, the second, the fourth"
    assert not there.bench.entries("command"), "who may do nothing writes nothing into the history either"


def test_who_proves_his_name_may_give_the_commands_that_are_his(
    authority: TestAuthority, router: zenoh.Session, vehicle: Served
) -> None:
    there = vehicle(authority.of_service(OPERATOR, SenderConfig(name="fleet")))
    reported = proven(router, authority, "operator")
    assert (reported["accepted"], reported["code"]) == (True, "held")
    assert there.is_held
    assert proven(router, authority, "operator", payload=RELEASE)["code"] == "released"
    code, why = refusal(lambda: proven(router, authority, "operator", KEYS.command(PAIR, "reset")))
    assert (code, "only calibrate, hold" in why) == ("not_allowed", True)
    assert refusal(lambda: proven(router, authority, "viewer"))[0] == "not_allowed"
    assert proven(router, authority, authority.sign("fleet", "fleet"), KEYS.command(PAIR, "reset"))["code"] == "reset"
    senders = [entry.sender for entry in there.bench.entries("command")]
    assert senders == ["operator (certificate)", "operator (certificate)", "fleet (certificate)"]


@pytest.mark.fault("a name that is claimed without proof", "it is not taken for a proven one")
def test_a_name_that_is_claimed_is_not_proven(authority: TestAuthority, router: zenoh.Session, vehicle: Served) -> None:
    there = vehicle(authority.of_service(OPERATOR, anonymous="always"))
    claim = b"operator (certificate)"
    (reply,) = router.get(f"{HOLD}?format=json", attachment=claim, timeout=PATIENCE_S)
    assert reply.ok is not None
    (entry,) = there.bench.entries("command")
    assert entry.sender == "operator _certificate_"


def test_a_proven_sender_is_not_held_up_by_those_who_are_not(
    authority: TestAuthority, router: zenoh.Session, vehicle: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_execution, "RateLimit", partial(RateLimit, clock=lambda: 0.0))
    there = vehicle(authority.of_service(OPERATOR, anonymous="always"))
    reported = [plainly(router)["code"] for _ in range(BURST + 2)]
    assert reported == ["held"] * BURST + ["too_many"] * 2
    assert proven(router, authority, "operator", payload=RELEASE)["code"] == "released"
    assert not there.is_held


@pytest.mark.fault("a router in between turns a proven command into another one", "it is refused")
def test_what_was_meant_for_one_command_is_no_other(
    authority: TestAuthority, router: zenoh.Session, vehicle: Served
) -> None:
    there = vehicle(authority.of_service(SenderConfig(name="operator")))
    speaker = CommandSender(authority.credentials("operator"), "vehicle")
    reset = f"{KEYS.command(PAIR, 'reset')}?tls={'0' * 32};format=json"
    flight = query_one(router, reset, PATIENCE_S, speaker.first_flight()).payload
    message = speaker.send(flight, to_json(ProvenCommand(selector=f"{HOLD}?format=json")))
    code, why = refusal(lambda: query_one(router, reset, PATIENCE_S, message))
    assert (code, "not the requested command" in why) == ("bad_request", True)
    assert not there.bench.entries("command")


@pytest.mark.fault("a spoofed acknowledgement", "`coec query` does not take it for the service's")
def test_an_acknowledgement_of_somebody_else_is_not_taken(authority: TestAuthority, router: zenoh.Session) -> None:
    def pretend(query: zenoh.Query) -> None:
        with query:
            query.reply(HOLD, b'{"accepted":true,"code":"held"}', encoding=JSON)

    handler = zenoh.handlers.Callback(pretend, indirect=False)
    spoof = router.declare_queryable(HOLD, handler, complete=True)
    with pytest.raises(NotProvenError):
        proven(router, authority, "operator")
    spoof.undeclare()


def test_a_service_without_a_certificate_says_so(
    authority: TestAuthority, router: zenoh.Session, vehicle: Served
) -> None:
    vehicle(AuthorityConfig())
    code, why = refusal(lambda: proven(router, authority, "operator"))
    assert (code, "this service has no certificate" in why) == ("not_proven", True)
    assert plainly(router)["code"] == "held", "the session is loopback's alone"


@pytest.mark.fault("an unproven command while the session or its router is open to other computers", "it is denied")
@pytest.mark.parametrize("door", ["tcp/0.0.0.0", pytest.param("tcp/[::]", marks=pytest.mark.slow)])
def test_what_comes_through_a_door_for_everybody_is_denied(tmp_path: Path, door: str) -> None:
    port = free_port()
    wide = ZenohConfig(embedded_router=True, listen=(f"{door}:{port}",), insecure=True)
    neighbour = ZenohConfig(connect=(f"tcp/127.0.0.1:{port}",))
    with open_session(wide, VEHICLE_LIMITS) as open_router, serving(tmp_path / "beside", neighbour):
        wait_until(lambda: bool(list(open_router.get(KEYS.status, timeout=PATIENCE_S))), "the vehicle answers")
        code, why = refusal(lambda: plainly(open_router))
        assert (code, f"port {port} is open at" in why) == ("not_allowed", True)
    with serving(tmp_path / "within", wide), open_session(neighbour, VEHICLE_LIMITS) as client:
        wait_until(lambda: bool(list(client.get(KEYS.status, timeout=PATIENCE_S))), "the vehicle answers")
        code, why = refusal(lambda: plainly(client))
        assert (code, "it listens at" in why) == ("not_allowed", True)


class HangingDisk:
    """Whatever the thread of the reads opens or lists hangs until it is let go, with all the locks that it has."""

    EVENTS = frozenset({"open", "os.listdir", "os.scandir"})

    def __init__(self) -> None:
        self.entered, self.let_go = threading.Event(), threading.Event()
        sys.addaudithook(self._hang)  # for good: it does nothing any more once it is let go

    def _hang(self, event: str, _: object) -> None:
        if event in self.EVENTS and threading.current_thread().name == f"{QueryLane.FILES.value}-queries":
            self.entered.set()
            assert self.let_go.wait(PATIENCE_S)


@pytest.mark.fault("a disk that hangs in a read, and reads that queue behind it", "`hold` is acknowledged all the same")
def test_a_command_does_not_wait_for_a_window_that_is_read(
    router: zenoh.Session, vehicle: Served, record_property: Callable[[str, object], None]
) -> None:
    there = vehicle(AuthorityConfig())
    disk = HangingDisk()
    window = there.bench.folder / "windows" / "front-1.mcap"
    window.parent.mkdir(exist_ok=True)
    window.write_bytes(b"a window")
    waiting = [router.get(KEYS.window(PAIR, "front-1"), timeout=PATIENCE_S)]
    assert disk.entered.wait(PATIENCE_S)
    waiting += [
        router.get(KEYS.window(PAIR, "front-1"), timeout=PATIENCE_S) for _ in range(WAITING[QueryLane.FILES] + 5)
    ]
    times_s = []
    for payload in (None, RELEASE) * 5:
        began_s = time.monotonic()
        assert plainly(router, payload)["accepted"]
        times_s.append(time.monotonic() - began_s)
    for at_once in (KEYS.extrinsic(PAIR), KEYS.health(PAIR), KEYS.status):
        assert query_one(router, at_once, PATIENCE_S).payload
    disk.let_go.set()
    answers = [reply for replies in waiting for reply in replies]
    assert len(answers) == len(waiting)
    read = [reply.ok.payload.to_bytes() for reply in answers if reply.ok is not None]
    assert read == [b"a window"] * (WAITING[QueryLane.FILES] + 1), "the others were told that it is busy"
    record_property("figure", f"median {sorted(times_s)[5] * 1e3:.0f} ms, longest {max(times_s) * 1e3:.0f} ms")


@pytest.mark.fault(
    "conversations that are begun without end, 64 at a time, without proof", "a proven command is still carried out"
)
def test_beginnings_without_end_hold_up_no_proven_command(
    authority: TestAuthority,
    router: zenoh.Session,
    endpoint: str,
    vehicle: Served,
    record_property: Callable[[str, object], None],
) -> None:
    there = vehicle(authority.of_service(OPERATOR))
    hello = CommandSender(authority.credentials("viewer"), "vehicle").first_flight()
    stop, finished, started = threading.Event(), threading.Event(), [0]

    def flood() -> None:
        with connected([endpoint], PATIENCE_S) as session:
            while not stop.is_set():
                conversations = (f"{HOLD}?tls={secrets.token_hex(16)}" for _ in range(64))
                requested = [session.get(one, payload=hello, timeout=PATIENCE_S) for one in conversations]
                started[0] += sum(len(list(replies)) for replies in requested)
        finished.set()

    threading.Thread(target=flood).start()
    wait_until(lambda: started[0] > 200, "the flood")
    times_s = []
    for payload in (None, RELEASE, None):
        began_s = time.monotonic()
        assert proven(router, authority, "operator", payload=payload)["accepted"]
        times_s.append(time.monotonic() - began_s)
    stop.set()
    assert finished.wait(PATIENCE_S)
    assert there.is_held
    record_property("figure", f"longest {max(times_s):.2f} s, beside {started[0]} beginnings")
