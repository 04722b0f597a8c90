"""`coec fetch`: an incident of a vehicle that had one, over a router; and of vehicles that say what they like."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh

from cli.conftest import Coec
from coec.cli import fetch as cli_fetch
from coec.config import UplinkConfig, ZenohConfig
from coec.errors import NotFoundError, RemoteError, UsageError
from coec.io.images import encode_jpeg
from coec.io.mcap.windows import WindowWriter, write_result
from coec.io.zenoh.query_client import PIECE_BYTES, SPARE_BYTES, NoSpaceError, RecordingInfo, connected, fetch_window
from coec.schemas.documents import IncidentReport
from coec.schemas.keys import Keys, parse_range_selector
from coec.schemas.message import to_json
from coec.schemas.replies import SnippetInfo, WindowInfo, WindowsReply
from coec.service.api.uplink import BURST_BYTES
from coec.service.recording.recorder import DigestReader
from e2e.processes import Router
from support.fake_worker import wait_until
from support.messages import heartbeat, packed_heartbeat
from support.router import MemoryStorage
from support.vehicles import (
    BEGIN_S,
    DRIVE_END_S,
    KEYS,
    NOMINAL,
    NS_PER_S,
    PAIR,
    PAIR_RIG,
    PairBench,
    ServingVehicle,
    frame_pair_at,
    serving,
)

VEHICLE = "vehicle"
DATA = bytes(range(256)) * 6000
"""Three pieces of a window."""

SHA256 = hashlib.sha256(DATA).hexdigest()
WINDOW = "front-7"


@pytest.fixture(scope="module")
def vehicle(router: Router, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServingVehicle]:
    """Its mount was knocked, and its pair was put right again."""
    with (
        serving(tmp_path_factory.mktemp("state"), ZenohConfig(connect=(router.endpoint,)), before=driven) as made,
        connected([router.endpoint], 5.0) as session,
    ):
        wait_until(lambda: bool(list(session.get(KEYS.health(PAIR)))), "the vehicle answers")
        yield made


def driven(bench: PairBench) -> None:
    """Its windows lie in the folder as recorder and worker leave them, and its pictures are pictures."""
    bench.drive(BEGIN_S, DRIVE_END_S)
    folder = bench.context.folder
    for result in bench.store.history.results():
        path = folder.path(result.window_id)
        path.unlink(missing_ok=True)
        configuration = bench.config.pairs[0].calibration
        writer = WindowWriter(path, PAIR_RIG, NOMINAL, result.window_id, configuration, {"vehicle": VEHICLE})
        for second in range(3):
            writer.add(frame_pair_at(result.data_stamp_ns + second * NS_PER_S))
        writer.finish()
        write_result(path, result)
    reader = DigestReader(folder, PAIR)
    while reader.read(2**20):
        pass
    (event,) = bench.answers.events().events
    for side in event.overlays:
        bench.store.incidents.add_overlay(event.event_id, side, encode_jpeg(np.full((90, 160, 3), 90, np.uint8)))


class Page(HTMLParser):
    """What a page loads, and what it says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: set[str] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.usefixtures("vehicle")
def test_an_event_comes_home_as_one_folder_with_its_history(coec: Coec, router: Router, tmp_path: Path) -> None:
    folder = tmp_path / "event"
    listed = coec("fetch", VEHICLE, "--connect", router.endpoint, "--json")
    (event,) = listed.document["events"]
    assert event["event_id"] in coec("fetch", VEHICLE, "--connect", router.endpoint).out
    outcome = coec("fetch", VEHICLE, "latest", "--connect", router.endpoint, "--output", folder, "--json")
    assert outcome.status == 0, outcome.err
    report = IncidentReport.model_validate(outcome.document)
    assert report == IncidentReport.model_validate_json((folder / "incident.json").read_bytes())
    assert (report.event_id, report.absent) == (event["event_id"], ())
    there = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert there == {file.name for file in report.files} | {"incident.json"}
    for file in report.files:
        data = (folder / file.name).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (file.sha256, file.size_bytes)
    assert {"config.json", "event.json", "history.json", "rig.json", "status.json"} <= there
    assert [window.window_id for window in report.windows] == [event["window_before"], event["window_after"]]
    assert [window.in_history for window in report.windows] == [True, True]
    assert report.chain_holds is True
    page = Page((folder / "index.html").read_text())
    neighbour = {name for name in page.loads if not name.startswith(("#", "data:image/"))}
    assert neighbour <= there, "it leads nowhere else"
    assert {"before.jpg", "after.jpg"} <= set(page.loads)
    for reported in (event["reasons"][0]["text"], event["resolution"], event["window_after"], "accepted"):
        assert reported in page.text
    assert not {"link", "iframe"} & page.tags


def test_whoever_requests_again_fetches_no_window_twice(
    coec: Coec, router: Router, vehicle: ServingVehicle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, read = tmp_path / "event", []
    existing = vehicle.bench.answers.read_window

    def read_window(window_id: str, offset: int, length: int) -> bytes:
        read.append(window_id)
        return existing(window_id, offset, length)

    monkeypatch.setattr(vehicle.bench.answers, "read_window", read_window)
    for _ in range(2):
        outcome = coec("fetch", VEHICLE, "latest", "--connect", router.endpoint, "--output", folder)
        assert outcome.status == 0
        assert "2 windows with the right sha256, 2 with the result" in outcome.out
    assert len(read) == len(set(read)) == 2


@pytest.mark.usefixtures("vehicle")
def test_recordings_can_be_left_on_board(coec: Coec, router: Router, tmp_path: Path) -> None:
    arguments = ("--no-windows", "--connect", router.endpoint, "--output", tmp_path)
    assert coec("fetch", VEHICLE, "latest", *arguments).status == 0
    assert not (tmp_path / "windows").exists()
    assert "None was fetched" in (tmp_path / "index.html").read_text()


@pytest.mark.fault("the uplink of the vehicle is spent", "what is fetched comes when it may, and is counted")
def test_whatever_is_fetched_is_metered_and_waited_for(
    coec: Coec, router: Router, vehicle: ServingVehicle, tmp_path: Path
) -> None:
    before = dict(vehicle.uplink.sent)
    vehicle.uplink.reconfigure(UplinkConfig(evidence_bytes_per_s=1_000_000))
    vehicle.uplink.count_sent("test", BURST_BYTES + 300_000)
    outcome = coec("fetch", VEHICLE, "latest", "--connect", router.endpoint, "--output", tmp_path, "--json")
    assert outcome.status == 0, outcome.err
    report = IncidentReport.model_validate(outcome.document)
    sent = {name: count - before.get(name, 0) for name, count in vehicle.uplink.sent.items()}
    assert sent["windows"] == sum(window.size_bytes for window in report.windows)
    assert sent["evidence"] > 0
    assert sent["history"] > 0
    assert sum(vehicle.uplink.refused.values()) > 0


@pytest.mark.usefixtures("vehicle")
@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (("../x",), UsageError.exit_code, "is not a valid name of a vehicle"),
        ((VEHICLE, "../../etc/passwd"), UsageError.exit_code, "is not the id of an incident"),
        ((VEHICLE, "front-1"), NotFoundError.exit_code, "has no such incident"),
        (("nobody", "latest"), NotFoundError.exit_code, "nobody answered"),
    ],
)
def test_what_is_not_there_is_reported(
    coec: Coec,
    router: Router,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    status: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = coec("fetch", *arguments, "--connect", router.endpoint)
    assert (outcome.status, list(tmp_path.iterdir())) == (status, [])
    assert message in outcome.err


def test_of_a_vehicle_that_is_parked_its_last_text_is_reported(coec: Coec, router: Router) -> None:
    key = Keys("coec", "truck-3").last("front")
    with (
        MemoryStorage(router.session, Keys("coec", "*").last("*")) as storage,
        connected([router.endpoint], 5.0) as session,
    ):
        word = heartbeat("truck-3", service="stopping", state="miscalibrated")
        session.put(key, packed_heartbeat(word), timestamp=session.new_timestamp())
        wait_until(lambda: bool(storage.samples), "it is kept")
        outcome = coec("fetch", "truck-3", "latest", "--connect", router.endpoint)
    assert outcome.status == NotFoundError.exit_code
    assert re.search(r"truck-3 does not answer; it logged off \d+ d ago \(front: miscalibrated\)", outcome.err)


@pytest.mark.fault(
    "a vehicle that lists more recordings of an event than are fetched", "what is left out is listed, and how to get it"
)
@pytest.mark.usefixtures("vehicle")
def test_recordings_beyond_the_limit_are_left_out(
    coec: Coec, router: Router, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli_fetch, "MAX_RECORDED_BYTES", 1)
    outcome = coec("fetch", VEHICLE, "latest", "--connect", router.endpoint, "--output", tmp_path, "--json")
    report = IncidentReport.model_validate(outcome.document)
    assert (outcome.status, report.windows) == (1, ())
    assert ["and 1 may be fetched: nothing of it was" in absent.why for absent in report.absent] == [True, True]
    assert list((tmp_path / "windows").glob("*")) == []


@pytest.mark.fault(
    "a vehicle that lists thousands of snippets of one event", "the nearest are fetched, the rest is counted"
)
def test_snippets_of_an_event_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = cli_fetch.Download(cast(Any, None), KEYS, PAIR, tmp_path, 1.0, 1.0, with_windows=True)
    file: dict[str, Any] = {"size_bytes": 1, "sha256": SHA256, "event": "suspect", "recorded_ns": 8}
    snippets = tuple(SnippetInfo(snippet_id=f"front-{n}.snippet", stamp_ns=n, **file) for n in range(1000))
    listed = WindowsReply(vehicle=VEHICLE, pair=PAIR, windows=(), snippets=snippets)
    monkeypatch.setattr(cli_fetch.Download, "_document", lambda *_: listed)
    monkeypatch.setattr(cli_fetch.Download, "_recording", lambda *_: snippets[0])
    detected = sorted(bench._snippets(cast(Any, SimpleNamespace(stamp_ns=100))))
    nearest = sorted(f"front-{n}.snippet" for n in range(92, 108))
    assert (detected, len(detected)) == (nearest, cli_fetch.MAX_SNIPPETS)
    (absent,) = bench.absent
    assert (absent.what, "lists 1000" in absent.why) == ("984 snippets", True)


# ------------------------------------------------------------------------------------------------ pieces of a window


class Sender:
    """Has one window, and answers for its pieces as it is told to: `answer(offset, length)` gives bytes, or a code."""

    def __init__(self, session: zenoh.Session, keys: Keys, answer: Callable[[int, int], bytes | str], **reported: Any):
        self.requested: list[int] = []
        self._answer = answer
        info = {
            "window_id": WINDOW,
            "sha256": SHA256,
            "size_bytes": len(DATA),
            "pairs": 1,
            "decision": None,
            **reported,
        }
        listed = WindowsReply(vehicle=keys.vehicle, pair=PAIR, windows=(WindowInfo.model_validate(info),))
        self._declared = [
            session.declare_queryable(keys.windows(PAIR), lambda query: self._list(query, to_json(listed))),
            session.declare_queryable(keys.window(PAIR, WINDOW), self._piece),
        ]

    def end(self) -> None:
        for each in self._declared:
            each.undeclare()

    @staticmethod
    def _list(query: zenoh.Query, payload: bytes) -> None:
        with query:
            query.reply(query.key_expr, payload)

    def _piece(self, query: zenoh.Query) -> None:
        with query:
            selected = parse_range_selector(str(query.parameters))
            self.requested.append(selected.offset)
            answer = self._answer(selected.offset, selected.length)
            if isinstance(answer, bytes):
                query.reply(query.key_expr, answer)
            else:
                error = json.dumps({"code": answer, "message": "no", "schema_version": 1}).encode()
                query.reply_err(error, encoding="application/json")


def whole(offset: int, length: int) -> bytes:
    return DATA[offset : offset + length]


@pytest.fixture
def far(request: pytest.FixtureRequest) -> Keys:
    """Of a vehicle of each test's own."""
    return Keys("coec", re.sub(r"[^A-Za-z0-9]", "-", request.node.name)[:60])


def fetch(router: Router, keys: Keys, path: Path, patience_s: float = 0.3) -> RecordingInfo:
    with connected([router.endpoint], 5.0) as session:
        return fetch_window(session, keys, PAIR, WINDOW, path, 5.0, patience_s, lambda *_: None)


@pytest.mark.fault("the link breaks in the middle of a window", "what has come is kept, and the rest is fetched later")
def test_a_window_goes_on_where_the_link_broke(
    router: Router, far: Keys, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    path, broken = tmp_path / "w.mcap", [True]
    sender = Sender(router.session, far, lambda at, n: "not_found" if at > PIECE_BYTES and broken[0] else whole(at, n))
    with pytest.raises(RemoteError):
        fetch(router, far, path)
    assert not path.exists()
    broken[0] = False
    before = len(sender.requested)
    assert fetch(router, far, path).sha256 == SHA256
    sender.end()
    assert path.read_bytes() == DATA
    again = [offset for offset in sender.requested[before:] if offset < 2 * PIECE_BYTES]
    record_property("figure", f"{len(again)} pieces fetched twice")
    assert again == []
    assert [each.name for each in tmp_path.iterdir()] == ["w.mcap"]


@pytest.mark.fault("a disk with too little room for a window", "nothing is fetched, and how much is needed is said")
def test_a_window_for_which_there_is_no_room_is_not_started(
    router: Router, far: Keys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender = Sender(router.session, far, whole)
    free = SPARE_BYTES + len(DATA) - 1
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    with pytest.raises(NoSpaceError, match=f"{len(DATA)} bytes are to be fetched, {free} are free"):
        fetch(router, far, tmp_path / "w.mcap")
    assert (sender.requested, list(tmp_path.iterdir())) == ([], [])
    free += 1
    fetch(router, far, tmp_path / "w.mcap")
    sender.end()


@pytest.mark.fault("the vehicle's uplink is busy", "the piece is asked for again until it comes, or patience ends")
def test_who_is_reported_to_wait_waits(router: Router, far: Keys, tmp_path: Path) -> None:
    refusals = iter(["uplink_busy", "busy"])
    sender = Sender(router.session, far, lambda at, n: next(refusals, None) or whole(at, n))
    fetch(router, far, tmp_path / "w.mcap", patience_s=30.0)
    sender.end()
    assert (tmp_path / "w.mcap").read_bytes() == DATA
    sender = Sender(router.session, far, lambda *_: "uplink_busy")
    with pytest.raises(RemoteError) as refused:
        fetch(router, far, tmp_path / "x.mcap", patience_s=0.3)
    sender.end()
    assert refused.value.reply_code == "uplink_busy"


@pytest.mark.fault("bytes of a window that are wrong, too many, or missing", "the file does not get its name")
@pytest.mark.parametrize(
    ("answer", "reported", "code"),
    [
        (lambda _, n: bytes(n), {}, "checksum"),
        (lambda at, n: whole(at, n) + b"x", {}, "checksum"),
        (lambda *_: b"", {}, "checksum"),
        (lambda at, n: whole(at, min(n, 1)), {}, "checksum"),
        (whole, {"size_bytes": 2**40}, "too_large"),
        (whole, {"sha256": "../../../etc/x"}, "malformed"),
    ],
    ids=["others", "more", "none", "a byte at a time", "too large", "a path"],
)
def test_what_is_not_what_was_promised_is_no_window(
    router: Router, far: Keys, tmp_path: Path, answer: Callable[[int, int], bytes], reported: dict[str, Any], code: str
) -> None:
    sender = Sender(router.session, far, answer, **reported)
    with pytest.raises(RemoteError) as refused:
        fetch(router, far, tmp_path / "in" / "w.mcap")
    sender.end()
    assert refused.value.reply_code == code
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
