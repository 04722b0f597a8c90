"""Whatever a vehicle, a router or a recording says, no command prints anything of it that a terminal would obey."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from mcap.writer import Writer
from pydantic import BaseModel

import coec as coec_library
from cli.conftest import Coec, Outcome
from coec.cli import doctor, query
from coec.cli.doctor.environment import service_findings
from coec.config import Config
from coec.errors import DecodeError, RemoteError
from coec.io.zenoh.bus import JSON, MSGPACK
from coec.io.zenoh.query_client import Reply, connected
from coec.reports import console, fleet_board, replies
from coec.schemas import documents as fleet_now
from coec.schemas import heartbeat, message, rig_state
from coec.schemas.commands import Acknowledgement
from coec.schemas.documents import Finding
from coec.schemas.keys import Keys
from coec.schemas.replies import (
    ErrorReply,
    EvidenceEvent,
    EvidenceReply,
    ExtrinsicReply,
    HealthReply,
    HistoryReply,
    StatusReply,
    WindowsReply,
)
from e2e.processes import Router
from support.recordings import (
    TREE,
    Bag,
    camera_info_message,
    compressed_image_message,
    drive_messages,
    transform_message,
)
from support.strategies import HOSTILE, HOSTILE_SHORT, hostile_message, message_texts, obeyed_characters
from support.vehicles import pair_configuration

KEYS = Keys("coec", "hostile")
REFUSING = Keys("coec", "refusing")
EVENT = "front-7"
MODELS: dict[str, type[BaseModel]] = {
    "extrinsic": ExtrinsicReply,
    "health": HealthReply,
    "history": HistoryReply,
    "windows": WindowsReply,
    "evidence": EvidenceReply,
    "event": EvidenceEvent,
    "status": StatusReply,
    "rig": rig_state.RigReply,
    "command": Acknowledgement,
}
QUERIES = ("extrinsic", "health", "history", "windows", "evidence", f"evidence/{EVENT}", "status", "rig", "config",
           "metrics", "command/hold")  # fmt: skip


def everything() -> dict[str, tuple[bytes, str]]:
    """What the hostile vehicle answers: payload and encoding by key."""
    event = hostile_message(EvidenceEvent, vehicle=KEYS.vehicle, pair="front", event_id=EVENT, wall_ns=1, stamp_ns=7)
    listed = hostile_message(EvidenceReply, pair="front", events=(event,))
    of_models: dict[str, BaseModel] = {
        KEYS.status: hostile_message(StatusReply),
        KEYS.rig: hostile_message(rig_state.RigReply),
        KEYS.extrinsic("front"): hostile_message(ExtrinsicReply),
        KEYS.health("front"): hostile_message(HealthReply),
        KEYS.history("front"): hostile_message(HistoryReply),
        KEYS.windows("front"): hostile_message(WindowsReply),
        KEYS.evidence("front"): listed,
        KEYS.evidence_of("front", EVENT): event,
        KEYS.command("front", "hold"): hostile_message(Acknowledgement),
    }
    config = json.dumps({HOSTILE: [HOSTILE, {"x": HOSTILE}]}, ensure_ascii=False).encode()
    return {
        **{key: (message.to_json(model), JSON) for key, model in of_models.items()},
        KEYS.config: (config, JSON),
        KEYS.metrics: (f"# HELP {HOSTILE}\n{HOSTILE} 1\n".encode(), "text/plain"),
        KEYS.last("front"): (message.to_msgpack(a_word()), MSGPACK),
    }


def a_word() -> heartbeat.LastWord:
    return hostile_message(heartbeat.LastWord, vehicle=KEYS.vehicle, pair="front")


@pytest.fixture(scope="module")
def vehicle(router: Router) -> Iterator[str]:
    """The endpoint of a router with a vehicle that answers everything with texts that a terminal would obey, and one
    that refuses everything in such words."""
    refusal = message.to_json(hostile_message(ErrorReply))

    def answer(key: str, payload: bytes, encoding: str) -> Callable[[zenoh.Query], None]:
        def reply(requested: zenoh.Query) -> None:
            with requested:
                requested.reply(key, payload, encoding=encoding)

        return reply

    def refuse(requested: zenoh.Query) -> None:
        with requested:
            requested.reply_err(refusal, encoding=JSON)

    session = router.session
    declared = [session.declare_queryable(key, answer(key, *reported)) for key, reported in everything().items()]
    refusing = session.declare_queryable(f"{REFUSING.root}/**", refuse)
    token = session.liveliness().declare_token(KEYS.alive(HOSTILE))
    yield router.endpoint
    token.undeclare()
    for each in (*declared, refusing):
        each.undeclare()


@pytest.fixture(params=["plain", "styled"])
def styled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the output is a terminal with colours."""
    if request.param == "styled":
        terminal = {"force_terminal": True, "color_system": "truecolor", "width": 100, "height": 40}
        monkeypatch.setattr(console, "out", console.EscapingConsole(**terminal))
        monkeypatch.setattr(console, "err", console.EscapingConsole(stderr=True, **terminal))
    return bool(request.param == "styled")


def harmless(outcome: Outcome, *, styled: bool = False) -> str:
    """What a command printed, which moves no cursor."""
    assert "Traceback" not in outcome.err
    assert obeyed_characters(outcome.out, styled=styled) == ""
    assert obeyed_characters(outcome.err, styled=styled) == ""
    return outcome.out + outcome.err


@pytest.mark.fault("control sequences in every text of every reply", "the terminal shows them as escapes")
@pytest.mark.parametrize("key", QUERIES)
def test_a_reply_steers_no_terminal(coec: Coec, vehicle: str, styled: bool, key: str) -> None:
    requested = ("query", key, "--vehicle", KEYS.vehicle, "--connect", vehicle, "--pair", "front")
    shown = harmless(coec(*requested), styled=styled)
    assert r"\x1b[35;45m" in shown or r"\u001b[35;45m" in shown, "what was sent is shown"
    document = coec(*requested, "--json")
    assert obeyed_characters(document.out) == ""
    if key != "metrics":
        assert document.out.count("\n") == 1
        assert HOSTILE in message_texts(document.document), "a program reads what was sent"


@pytest.mark.parametrize("choice", [0, 1])
@pytest.mark.parametrize("kind", replies.BY_KIND)
def test_whatever_fixed_text_a_reply_has_it_steers_no_terminal(
    capsys: pytest.CaptureFixture[str], styled: bool, kind: str, choice: int
) -> None:
    replies.BY_KIND[kind](message.to_json(hostile_message(MODELS[kind], choice)))
    captured = capsys.readouterr()
    assert obeyed_characters(captured.out, styled=styled) == ""
    assert captured.out


@pytest.mark.fault("control sequences in code and message of an error reply", "one line with escapes, and a document")
@pytest.mark.parametrize("key", QUERIES)
def test_a_refusal_steers_no_terminal(coec: Coec, vehicle: str, key: str) -> None:
    requested = ("query", key, "--vehicle", REFUSING.vehicle, "--connect", vehicle, "--pair", "front")
    outcome = coec(*requested)
    assert outcome.status == RemoteError.exit_code
    assert r"\x1b[35;45m" in harmless(outcome)
    assert outcome.err.count("\n") == 1, "a message makes no second line"
    reported = coec(*requested, "--json")
    assert obeyed_characters(reported.out) == ""
    assert reported.document["error"]["code"] == HOSTILE


@pytest.mark.fault("control sequences in samples and tokens that are watched", "lines and board show them as escapes")
@pytest.mark.parametrize("form", [("--seconds", "0.3"), ("--once",)], ids=["lines", "board"])
def test_what_is_watched_steers_no_terminal(coec: Coec, vehicle: str, styled: bool, form: tuple[str, ...]) -> None:
    watched = ("watch", "--vehicle", KEYS.vehicle, "--connect", vehicle, *form)
    outcome = coec(*watched)
    assert outcome.status == 0
    shown = harmless(outcome, styled=styled)
    assert r"\x1b" in shown
    assert obeyed_characters(coec(*watched, "--json").out) == ""


def test_details_of_a_pair_on_the_board_steer_no_terminal(capsys: pytest.CaptureFixture[str], styled: bool) -> None:
    fleet = hostile_message(fleet_now.FleetNow)
    console.out.print(fleet_board.board(fleet, 0, 0, 1, HOSTILE))
    console.out.print(fleet_board.detail(fleet.pairs[0]))
    assert obeyed_characters(capsys.readouterr().out, styled=styled) == ""


def test_findings_about_a_service_steer_no_terminal(
    coec: Coec, vehicle: str, styled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = pair_configuration(tmp_path).model_copy(update={"vehicle": KEYS.vehicle, "prefix": KEYS.prefix})

    def examined(*_: object) -> Iterator[Finding]:
        yield hostile_message(Finding)
        with connected([vehicle], 5.0) as session:
            yield from service_findings(session, Config.model_validate(config))

    monkeypatch.setattr(doctor, "examine", examined)
    shown = harmless(coec("doctor"), styled=styled)
    assert r"\x1b[35;45m" in shown
    assert obeyed_characters(coec("doctor", "--json").out) == ""


def test_what_is_fetched_steers_no_terminal_and_no_page(coec: Coec, vehicle: str, styled: bool, tmp_path: Path) -> None:
    of = ("fetch", KEYS.vehicle, "--connect", vehicle)
    listed = coec(*of)
    assert listed.status == 0
    assert EVENT in harmless(listed, styled=styled)
    outcome = coec(*of, EVENT, "--output", tmp_path / "event", "--patience", "0.1")
    harmless(outcome, styled=styled)
    assert obeyed_characters((tmp_path / "event" / "index.html").read_text()) == ""
    again = coec(*of, EVENT, "--output", tmp_path / "again", "--patience", "0.1", "--json")
    assert obeyed_characters(again.out) == ""
    assert {path.name for path in tmp_path.iterdir()} == {"event", "again"}, "no text becomes a path"


@pytest.mark.fault("control sequences as names of topics, types and frames of a recording", "they are shown as escapes")
@pytest.mark.parametrize("command", ["check", "calibrate", "convert", "play"])
def test_names_in_a_recording_steer_no_terminal(
    coec: Coec, vehicle: str, styled: bool, tmp_path: Path, command: str
) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=HOSTILE, library=HOSTILE)
        for name in ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", HOSTILE):
            for topic in (f"/a{HOSTILE}", f"/b{HOSTILE}"):
                schema = writer.register_schema(name=name, encoding="ros2msg", data=b"")
                channel = writer.register_channel(
                    topic=topic, message_encoding="cdr", schema_id=schema, metadata={HOSTILE: HOSTILE}
                )
                for stamp_ns in range(8):
                    writer.add_message(channel, log_time=stamp_ns, publish_time=stamp_ns, data=HOSTILE.encode())
        writer.add_metadata(name=HOSTILE, data={HOSTILE: HOSTILE})
        writer.finish()  # type: ignore[no-untyped-call]
    more: dict[str, tuple[object, ...]] = {"convert": (tmp_path / "out.mcap",), "play": ("--connect", vehicle)}
    outcome = coec(command, path, *more.get(command, ()))
    assert outcome.status == 1
    assert r"\x1b[35;45m" in harmless(outcome, styled=styled)
    assert obeyed_characters(coec(command, path, *more.get(command, ()), "--json").out) == ""


@pytest.mark.parametrize("command", ["check", "calibrate", "convert"])
def test_frames_in_a_drive_steer_no_terminal(coec: Coec, styled: bool, tmp_path: Path, command: str) -> None:
    drive = drive_messages(
        info=camera_info_message("plumb_bob", [0.0] * 5, HOSTILE),
        tree=[*TREE, transform_message("optical", HOSTILE, np.eye(4))],
        image=lambda stamp_ns: compressed_image_message(stamp_ns, HOSTILE),
    )
    path = Bag(drive).write(tmp_path / f"{HOSTILE_SHORT}.mcap")
    more = (tmp_path / f"{HOSTILE_SHORT}.yaml",) if command == "convert" else ()
    harmless(coec(command, path, *more), styled=styled)
    assert obeyed_characters(coec(command, path, *more, "--json").out) == ""
    recording = coec_library.open(path)
    assert obeyed_characters(f"{recording.describe()}{recording!r}") == ""
    assert r"\x1b[35;45m" in str(recording.describe())


NO_JSON = {
    "cut off": b'{"config": ',
    "no UTF-8": b'{"config": "\xff\xfe"}',
    "nested": b"[" * 100_000,
    "nested and whole": b"[" * 200 + b"]" * 200,
    "long number": b"1" * 5_000,
    "no number": b"[NaN]",
    "endless number": b"[1e999]",
    "nothing": b"",
}


@pytest.mark.fault("a reply that is called JSON and is none", "a message that says what is wrong, and status 1")
@pytest.mark.parametrize("payload", NO_JSON.values(), ids=NO_JSON)
@pytest.mark.parametrize("as_json", [(), ("--json",)], ids=["for people", "for programs"])
def test_a_reply_that_is_no_json_is_an_error(
    coec: Coec, router: Router, payload: bytes, as_json: tuple[str, ...]
) -> None:
    keys = Keys("coec", "broken")

    def answer(requested: zenoh.Query) -> None:
        with requested:
            requested.reply(requested.key_expr, payload, encoding=JSON)

    declared = router.session.declare_queryable(f"{keys.root}/**", answer)
    try:
        requested = ("--vehicle", keys.vehicle, "--connect", router.endpoint, "--pair", "front", *as_json)
        outcomes = {key: coec("query", key, *requested) for key in ("config", "command/hold", "health")}
    finally:
        declared.undeclare()
    for outcome in outcomes.values():
        assert outcome.status == DecodeError.exit_code
        harmless(outcome)
    assert f"the reply of {keys.config} is not" in outcomes["config"].err
    assert "see the log of the service" in outcomes["config"].err
    if as_json:
        assert outcomes["config"].document["error"]["code"] == "bad_input"


def test_text_that_is_called_text_is_shown_line_by_line(capsys: pytest.CaptureFixture[str]) -> None:
    query._render(Reply("k", b"a\x1b[2J\nb\x9b\xff\n", "text/plain"), None)
    assert capsys.readouterr().out == "a\\x1b[2J\nb��\n"
