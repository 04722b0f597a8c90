"""`coec query`: what was typed is checked before anything is asked, and what was answered is said."""

from __future__ import annotations

import getpass
import hashlib
import inspect
import json
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from cli.conftest import SMALL, Coec
from coec.cli.query import KEYS as HELPED
from coec.cli.query import PLAIN_KEYS, WITH_ARGUMENT, query
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import NotFoundError
from coec.io.zenoh.bus import JSON, Answer, Bus, QueryLane, Request, Route, open_session
from coec.schemas.commands import COMMAND_NAMES, Acknowledgement, arguments_of
from coec.schemas.keys import RIG, Keys, parse_command_selector, parse_range_selector
from coec.schemas.message import Message, to_json
from coec.schemas.replies import (
    PairStatus,
    SnippetInfo,
    WindowInfo,
    WindowsReply,
)
from conftest import REPOSITORY
from support.messages import status_reply
from support.router import free_port

DEADLINE_S = 20.0
KEYS = Keys("coec", "vehicle")
WINDOW = bytes(range(256))
CLAIMS: list[bytes | None] = []
PAYLOADS: list[tuple[str, bytes]] = []


@pytest.fixture
def endpoint() -> str:
    """Nobody is there yet."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def vehicle() -> Iterator[str]:
    """The endpoint of a vehicle with the pair `front` and one window."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig())
    bus = Bus(session)
    for thread in bus.threads:
        thread.start()
    serve_status(bus, "front")
    file: dict[str, Any] = {"size_bytes": len(WINDOW), "sha256": hashlib.sha256(WINDOW).hexdigest()}
    info = WindowInfo(window_id="front-1", pairs=1, decision=None, kept_for="red_event", **file)
    snippet = SnippetInfo(snippet_id="front-7.snippet", event="suspect", stamp_ns=7, recorded_ns=8, **file)
    listed = WindowsReply(vehicle="vehicle", pair="front", windows=(info,), snippets=(snippet,))
    serve_document(bus, KEYS.windows("front"), listed)
    bus.serve(KEYS.window("front", "*"), window_routes)
    bus.serve(KEYS.evidence_of("front", "*"), no_event)
    bus.serve(KEYS.command("front", "*"), acknowledging)
    bus.serve(KEYS.command(RIG, "*"), acknowledging)
    yield endpoint
    bus.undeclare_inputs()
    for thread in bus.threads:
        thread.request_stop()
        assert thread.join(DEADLINE_S)
    bus.undeclare_queryables()
    assert bus.close(DEADLINE_S)


def serve_document(bus: Bus, key: str, document: Message) -> None:
    route = Route(key, lambda _: Answer(to_json(document), JSON), QueryLane.AT_ONCE)
    bus.serve(key, lambda _: [route])


def serve_status(bus: Bus, *pairs: str) -> None:
    status = status_reply(pairs=tuple(PairStatus(name=name) for name in pairs))
    serve_document(bus, KEYS.status, status)


def window_routes(key: str) -> Sequence[Route]:
    def answer(parameters: str) -> Answer:
        selected = parse_range_selector(parameters)
        return Answer(WINDOW[selected.offset : selected.offset + selected.length], "application/octet-stream")

    return [Route(key, lambda request: answer(request.parameters), QueryLane.FILES)]


def acknowledging(key: str) -> Sequence[Route]:
    """With the parameters that came; what its sender says of himself is noted."""

    def answer(request: Request) -> Answer:
        CLAIMS.append(request.attachment)
        PAYLOADS.append((key, request.payload))
        done = Acknowledgement(
            vehicle="vehicle", pair="front", command="hold", accepted=True, code="held", text=request.parameters
        )
        return Answer(to_json(done), JSON)

    return [Route(key, answer, QueryLane.AT_ONCE)]


def no_event(_: str) -> Sequence[Route]:
    raise NotFoundError("no event of this name is kept")


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("windows/a//b", "--output", "w.mcap"), "'windows/a//b' is no key: empty chunks"),
        (("windows/", "--output", "w.mcap"), "empty chunks"),
        (("evidence/x#1", "--output", "e.jpg"), "forbidden characters"),
        (("windows/*", "--output", "w.mcap", "--pair", "front"), "stands for several keys"),
        (("overlay", "--pair", "*", "--output", "o.jpg"), "stands for several keys"),
        (("health?limit=2",), "--param"),
        (("health", "--pair", "a//b"), "'a//b' is no key"),
        (("health", "--vehicle", ""), "is no key"),
        (("health", "--prefix", "/coec"), "leading and trailing slashes"),
        (("coec/@v1//status",), "empty chunks"),
        (("nonsense",), "known: extrinsic, health"),
        (("health", "--param", "limit"), "NAME=VALUE"),
        (("command/calibrate", "--payload", "{"), "not JSON"),
        (("health", "--to", "x"), "health is not a command"),
        (("health", "--payload", "{}"), "health is not a command"),
        (("command/hold", "--to", "x"), "It takes --release: "),
        (("command/apply", "--release"), "It takes --candidate: "),
        (("command/rollback", "--to", "x", "--sensor", "roof"), "command/rollback of the rig does not take it"),
        (("command/hold", "--release", "--payload", "{}"), "omit --release, or --payload"),
        (("command/explode", "--release"), "known: calibrate, apply"),
        (("overlay",), "--output FILE.jpg"),
        (("overlay", "--output", "o.png"), "o.png: the picture is a JPEG, its name must end in .jpg"),
        (("evidence/front-2", "--output", "e.PNG", "--param", "overlay=before"), "must end in .jpg"),
        (("health", "--output", "h.jpg"), "--output belongs to"),
        (("health", "--timeout", "inf"), "--timeout inf"),
    ],
)
def test_what_is_no_question_is_a_usage_error_and_writes_nothing(
    coec: Coec,
    vehicle: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    reported: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = coec("query", *arguments, "--connect", vehicle)
    assert outcome.status == 2
    assert reported in outcome.err
    assert "Traceback" not in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_the_configuration_of_a_service_reports_where_it_is_requested(
    coec: Coec, vehicle: str, endpoint: str, tmp_path: Path
) -> None:
    shipped = (REPOSITORY / "deploy" / "coec.yaml").read_text()
    config = tmp_path / "coec.yaml"
    for router, status in ((vehicle, 0), (endpoint, 1)):
        config.write_text(shipped.replace("tcp/127.0.0.1:7447", router))
        assert coec("query", "status", "--config", str(config)).status == status


def test_what_is_typed_comes_before_the_configuration(coec: Coec, vehicle: str, endpoint: str, tmp_path: Path) -> None:
    config = tmp_path / "coec.yaml"
    shipped = (REPOSITORY / "deploy" / "coec.yaml").read_text()
    config.write_text(shipped.replace("tcp/127.0.0.1:7447", endpoint).replace("vehicle: vehicle", "vehicle: other"))
    typed = ("query", "status", "--config", str(config), "--connect", vehicle)
    assert coec(*typed).status == 1, "nobody answers for `other`"
    assert coec(*typed, "--vehicle", "vehicle").status == 0


def test_an_endpoint_that_is_none_is_a_usage_error(coec: Coec) -> None:
    outcome = coec("query", "health", "--connect", "localhost")
    assert outcome.status == 2
    assert "'localhost' is not a router endpoint: write PROTOCOL/ADDRESS" in outcome.err


def test_without_a_router_it_says_what_to_start(coec: Coec, endpoint: str) -> None:
    outcome = coec("query", "health", "--connect", endpoint, "--timeout", "0.2", "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "not_connected"
    assert f"no Zenoh router answered at {endpoint}" in outcome.err
    assert "start `coec run --embedded-router`" in outcome.err


def test_a_router_without_a_service_says_what_to_check(coec: Coec, endpoint: str) -> None:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()):
        outcome = coec("query", "health", "--connect", endpoint, "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "not_found"
    assert "nobody answered coec/@v1/vehicle/*/health: check that `coec run` is up" in outcome.err


def test_the_list_reports_what_a_window_is_retained_for_and_names_snippets(coec: Coec, vehicle: str) -> None:
    outcome = coec("query", "windows", "--connect", vehicle)
    assert "vehicle/front  1 window, 1 snippet" in outcome.out
    (window,) = (line for line in outcome.out.splitlines() if "front-1" in line)
    assert "incident" in window
    (snippet,) = (line for line in outcome.out.splitlines() if "front-7.snippet" in line)
    assert "suspect" in snippet


@pytest.mark.parametrize("name", ["front-1", "front-7.snippet"])
def test_a_window_or_snippet_is_downloaded_and_verified(coec: Coec, vehicle: str, tmp_path: Path, name: str) -> None:
    path = tmp_path / "w.mcap"
    outcome = coec("query", f"windows/{name}", "--output", path, "--connect", vehicle)
    assert outcome.status == 0
    assert path.read_bytes() == WINDOW
    assert "verified" in outcome.out


@pytest.mark.parametrize(
    ("key", "reported"),
    [
        ("windows/nosuch", "pair front has no window nosuch: see `coec query windows`"),
        ("windows/front-2", "pair front has no window front-2"),
        ("evidence/xx", "no event of this name is kept"),
        ("evidence/front-2", "no event of this name is kept"),
        ("windows/rear-2", "nobody answered coec/@v1/vehicle/rear/windows"),
    ],
)
def test_what_the_service_does_not_have_is_what_it_answered(
    coec: Coec, vehicle: str, tmp_path: Path, key: str, reported: str
) -> None:
    outcome = coec("query", key, "--output", tmp_path / "x", "--connect", vehicle, "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "not_found"
    assert reported in outcome.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("key", ["command/hold", KEYS.command("front", "hold")])
def test_a_command_says_how_long_its_sender_waits(coec: Coec, vehicle: str, key: str) -> None:
    outcome = coec("query", key, "--timeout", "4", "--connect", vehicle, "--json")
    assert outcome.status == 0
    assert parse_command_selector(outcome.document["text"]).timeout_ms == 3600, "less than the four seconds"
    given = coec("query", key, "--param", "timeout_ms=7", "--connect", vehicle, "--json")
    assert parse_command_selector(given.document["text"]).timeout_ms == 7


def test_a_command_reports_who_reports_that_he_gives_it(coec: Coec, vehicle: str) -> None:
    CLAIMS.clear()
    assert coec("query", "command/hold", "--connect", vehicle).status == 0
    assert coec("query", "health", "--connect", vehicle).status == 1
    (claim,) = CLAIMS
    assert claim == f"{getpass.getuser()}@{socket.gethostname()}".encode()


def test_a_file_that_holds_something_else_is_replaced_only_on_request(coec: Coec, vehicle: str, tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    path.write_bytes(b"another recording")
    labels = ("query", "windows/front-7.snippet", "--output", path, "--connect", vehicle)
    refused = coec(*labels)
    assert refused.status == 1
    assert f"{path} is there already" in refused.err
    assert path.read_bytes() == b"another recording"
    assert coec(*labels, "--force").status == 0
    assert coec(*labels).status == 0, "what is complete is not fetched again"


def test_of_several_pairs_one_has_to_be_named(coec: Coec, endpoint: str, tmp_path: Path) -> None:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        serve_status(Bus(session), "front", "rear")
        outcome = coec("query", "windows/nosuch", "--output", tmp_path / "x", "--connect", endpoint)
    assert outcome.status == 2
    assert "several pairs are served, name one with --pair: front, rear" in outcome.err


def test_a_recording_is_not_played_to_a_key_that_is_none(coec: Coec, endpoint: str) -> None:
    outcome = coec("play", SMALL, "--pair", "a//b", "--connect", endpoint)
    assert outcome.status == 2
    assert "'sensors/a//b/camera' is no key" in outcome.err


def test_several_pairs_answer_in_one_document_by_pair_and_a_table_each(coec: Coec, endpoint: str) -> None:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        bus = Bus(session)
        for thread in bus.threads:
            thread.start()
        for pair in ("rear", "front"):
            serve_document(bus, KEYS.windows(pair), WindowsReply(vehicle="vehicle", pair=pair, windows=(), snippets=()))
        together = coec("query", "windows", "--connect", endpoint, "--json")
        alone = coec("query", "windows", "--connect", endpoint, "--pair", "rear", "--json")
        text = coec("query", "windows", "--connect", endpoint).out
        bus.undeclare_inputs()
        for thread in bus.threads:
            thread.request_stop()
            assert thread.join(DEADLINE_S)
        bus.undeclare_queryables()
    assert together.status == alone.status == 0
    assert set(together.document["pairs"]) == {"front", "rear"}
    assert together.document["pairs"]["rear"] == alone.document
    assert alone.document["pair"] == "rear"
    assert text.index("vehicle/front") < text.index("vehicle/rear")


@pytest.mark.parametrize(
    ("typed", "key", "payload"),
    [
        (("command/rollback", "--to", "ab12"), KEYS.command("front", "rollback"), {"to": "ab12"}),
        (("command/apply", "--candidate", "ab12cd34"), KEYS.command("front", "apply"), {"candidate": "ab12cd34"}),
        (("command/hold", "--reason", "a new lens"), KEYS.command("front", "hold"), {"reason": "a new lens"}),
        (("command/hold", "--release"), KEYS.command("front", "hold"), {"release": True}),
        (("command/hold", "--sensor", "roof"), KEYS.command(RIG, "hold"), {"sensor": "roof"}),
        (("command/hold", "--payload", '{"release": true}'), KEYS.command("front", "hold"), {"release": True}),
    ],
)
def test_options_stand_for_the_entries_of_a_payload(
    coec: Coec, vehicle: str, typed: tuple[str, ...], key: str, payload: dict[str, Any]
) -> None:
    PAYLOADS.clear()
    assert coec("query", *typed, "--connect", vehicle).status == 0
    ((requested, sent),) = PAYLOADS
    assert requested == key
    assert json.loads(sent) == payload


def test_every_entry_of_a_payload_has_its_option() -> None:
    fields = set(inspect.signature(query).parameters)
    for command in COMMAND_NAMES:
        for for_rig in (False, True):
            assert {argument.name for argument in arguments_of(command, for_rig=for_rig)} <= fields


def test_the_help_text_has_every_key_with_what_it_answers(coec: Coec) -> None:
    shown = coec("query", "--help").out
    requested = (*PLAIN_KEYS, *(f"{name}/{what}" for name, what in WITH_ARGUMENT.items()))
    assert {each.key for each in HELPED} == set(requested)
    for each in HELPED:
        assert each.key in shown
        assert each.answer in shown
