"""`coec fetch`: fetches what a vehicle stores of an incident, over whatever link there is, and makes a page of it.

Nothing that a vehicle sends is trusted: names become file names only where they are valid names, sizes are bounded, and
what a document says about itself is compared with what was requested.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

import typer

from coec import __version__
from coec.cli.options import Connect, Json, Prefix, SessionFile, service_address
from coec.cli.query import OF_PAIR
from coec.errors import CoecError, DecodeError, NotFoundError, OutputError, RemoteError, UsageError, WindowError
from coec.reports import console
from coec.schemas.keys import Keys

if TYPE_CHECKING:
    import zenoh

    from coec.io.zenoh.query_client import RecordingInfo
    from coec.schemas.documents import Absent, FetchedFile, FetchedWindow, IncidentReport
    from coec.schemas.message import Message
    from coec.schemas.replies import ChainedEntry, EvidenceEvent, HistoryReply

LATEST: Final = "latest"
VEHICLE: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")

AROUND_NS: Final = 600 * 1_000_000_000
"""History that is fetched before the first and after the last figure of the event: 10 minutes."""

SNIPPET_NS: Final = 60 * 1_000_000_000
"""Most sensor time between an event and its snippet: a suspicion comes up to a minute before the event."""

MAX_SNIPPETS: Final = 16
"""Most snippets of one event. A suspicion, the event, and its end within a minute make three."""

MAX_RECORDED_BYTES: Final = 2**32
"""Most bytes of the recordings of one event together, two windows and its snippets, as the vehicle claims them: as much
as is fetched of one window. Two windows and three snippets have some 500 MB."""

MAX_PICTURE_BYTES: Final = 16 * 2**20

ENTRIES: Final = 300
"""Most entries of the history, some 6 kB each."""

WAIT_S: Final = 0.5
"""Time before a vehicle with a busy uplink is asked again."""

WAITS: Final = frozenset({"uplink_busy", "busy", "not_drawn"})

PAGE = "index.html"
REPORT = "incident.json"

M = TypeVar("M", bound="Message")
T = TypeVar("T")


def fetch(
    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="Name of the vehicle.", show_default=False)],
    event: Annotated[
        str | None,
        typer.Argument(
            metavar="EVENT",
            help="Id of an incident, or `latest`; without it, the vehicle's incidents are listed.",
            show_default=False,
        ),
    ] = None,
    pair: Annotated[str | None, typer.Option(help="Pair whose events are searched.", show_default="all")] = None,
    prefix: Prefix = None,
    connect: Connect = None,
    zenoh: SessionFile = None,
    output: Annotated[
        Path | None, typer.Option(help="Folder to write.", metavar="DIR", show_default="VEHICLE-EVENT")
    ] = None,
    no_windows: Annotated[bool, typer.Option("--no-windows", help="Do not download the recordings.")] = False,
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Seconds to wait for the router and for each answer.", min=0.1)
    ] = 10.0,
    patience_s: Annotated[
        float,
        typer.Option("--patience", help="Seconds without a piece of a window before giving up.", min=0.1),
    ] = 120.0,
    as_json: Json = False,
) -> int:
    """Fetch an incident into one folder: pictures, recordings, history, and a report page.

    The same command resumes an interrupted download.
    """
    from coec.io.zenoh.query_client import connected_by
    from coec.reports import incident_page

    if not VEHICLE.fullmatch(vehicle):
        raise UsageError(f"{vehicle!a} is not a valid name of a vehicle")
    if pair is not None and not VEHICLE.fullmatch(pair):
        raise UsageError(f"{pair!a} is not a valid name of a pair")
    if event not in (None, LATEST) and not OF_PAIR.fullmatch(str(event)):
        raise UsageError(f"{event!a} is not the id of an incident: `coec fetch {vehicle}` lists them")
    address = service_address(None, vehicle, prefix, connect, zenoh)
    keys = Keys(address.prefix, address.vehicle)
    with connected_by(address.way, timeout_s) as session:
        events = _events(session, keys, pair, timeout_s)
        if event is None:
            return _list(events, vehicle, as_json=as_json)
        selected = _select(events, event, vehicle)
        folder = output or Path(f"{keys.vehicle}-{selected.event_id}")
        download = Download(session, keys, selected.pair, folder, timeout_s, patience_s, with_windows=not no_windows)
        report = download.fetch(selected.event_id)
    if as_json:
        console.print_json(report)
    else:
        console.show(f"{folder / PAGE}  {incident_page.sentence(report)}")
        for absent in report.absent:
            console.show(f"  not here: {absent.what}: {absent.why}", "yellow")
    return 1 if report.absent else 0


def _events(session: zenoh.Session, keys: Keys, pair: str | None, timeout_s: float) -> list[EvidenceEvent]:
    """Red events of the pair (None: of every pair), the latest last."""
    from coec.io.zenoh.query_client import query_all
    from coec.schemas.message import from_json
    from coec.schemas.replies import EvidenceReply

    selector = f"{keys.evidence(pair or '*')}?format=json"
    answers = query_all(session, selector, timeout_s)
    if not answers:
        raise _nobody(session, keys, timeout_s, selector)
    events: list[EvidenceEvent] = []
    for answer in answers:
        reply = from_json(EvidenceReply, answer.payload)
        events += [event for event in reply.events if _is_of(event, keys.vehicle, reply.pair)]
    return sorted(events, key=lambda event: event.wall_ns)


def _nobody(session: zenoh.Session, keys: Keys, timeout_s: float, selector: str) -> NotFoundError:
    """The error that nobody answers, with the last heartbeat of the vehicle, if one is stored."""
    from coec.io.zenoh.query_client import no_reply_error, query_all
    from coec.reports.fleet_board import duration
    from coec.schemas.heartbeat import decode_heartbeat as read_word

    for answer in query_all(session, keys.last("*"), timeout_s):
        try:
            word = read_word(answer.key, answer.payload)
        except DecodeError:
            continue
        ago = duration(max((time.time_ns() - word.said_ns) * 1e-9, 0.0))
        left = "logged off" if word.service == "stopping" else "was last received"
        return NotFoundError(
            f"{word.vehicle} does not answer; it {left} {ago} ago ({word.pair}: {word.state}). Its data are on "
            "board: fetch them when it is back"
        )
    return no_reply_error(selector)


def _is_of(event: EvidenceEvent, vehicle: str, pair: str) -> bool:
    named = OF_PAIR.fullmatch(event.event_id)
    return named is not None and (event.vehicle, event.pair, named["pair"]) == (vehicle, pair, pair)


def _list(events: Sequence[EvidenceEvent], vehicle: str, *, as_json: bool) -> int:
    from coec.reports import replies
    from coec.schemas.message import to_json
    from coec.schemas.replies import EvidenceReply

    if as_json:
        console.print_json({"events": [event.model_dump(mode="json") for event in events]})
        return 0
    for pair in sorted({event.pair for event in events}):
        ours = tuple(event for event in events if event.pair == pair)
        replies.evidence(to_json(EvidenceReply(vehicle=vehicle, pair=pair, events=ours)))
    if not events:
        console.show(f"{vehicle} has no incident")
    return 0


def _select(events: Sequence[EvidenceEvent], event_id: str, vehicle: str) -> EvidenceEvent:
    if event_id == LATEST and events:
        return events[-1]
    match = next((event for event in events if event.event_id == event_id), None)
    if match is None:
        raise NotFoundError(f"{vehicle} has no such incident: `coec fetch {vehicle}` lists them")
    return match


@dataclass(slots=True)
class Download:
    """Fetches one event. What cannot be fetched is noted with the reason, and does not stop the rest."""

    session: zenoh.Session
    keys: Keys
    pair: str
    folder: Path
    timeout_s: float
    patience_s: float
    with_windows: bool
    files: dict[str, FetchedFile] = field(default_factory=dict)
    absent: list[Absent] = field(default_factory=list)
    recorded_bytes: int = 0

    def fetch(self, event_id: str) -> IncidentReport:
        from coec.io import user_files as files
        from coec.reports import incident_page
        from coec.reports.page import render
        from coec.reports.page_parts import Provenance
        from coec.schemas.documents import IncidentReport
        from coec.schemas.message import to_json
        from coec.schemas.replies import EvidenceEvent, ExtrinsicReply, HealthReply, HistoryReply, StatusReply
        from coec.schemas.rig_state import RigReply

        keys, pair = self.keys, self.pair
        event = self._document(EvidenceEvent, keys.evidence_of(pair, event_id))
        if event.event_id != event_id or not _is_of(event, keys.vehicle, pair):
            raise RemoteError("malformed", f"the reply to {event_id} concerns another incident")
        self._store("event.json", to_json(event))
        history = self._optional("history.json", HistoryReply, _around(keys.history(pair), event))
        health = self._optional("health.json", HealthReply, keys.health(pair))
        extrinsic = self._optional("extrinsic.json", ExtrinsicReply, keys.extrinsic(pair))
        status = self._optional("status.json", StatusReply, keys.status)
        self._optional("rig.json", RigReply, keys.rig)
        self._try("config.json", lambda: self._store("config.json", self._configuration()))
        for side in event.overlays:
            self._try(f"{side}.jpg", lambda side=side: self._picture(event_id, side))  # type: ignore[misc]
        windows = [
            fetched
            for window_id in dict.fromkeys(filter(None, (event.window_before, event.window_after)))
            if self.with_windows and (fetched := self._window(window_id, history)) is not None
        ]
        snippets = () if not self.with_windows else tuple(self._snippets(event))
        holds = None if history is None else chain_holds(history)
        documents = (event, history, health, extrinsic, status)
        story = incident_page.FetchedIncident(*documents, tuple(windows), tuple(self.absent), holds, snippets)
        pictures = {name: (self.folder / name).read_bytes() for name in incident_page.PICTURED if name in self.files}
        self._store(PAGE, render(incident_page.page(story, pictures, Provenance.here())).encode())
        report = IncidentReport(
            folder=str(self.folder),
            vehicle=keys.vehicle,
            pair=pair,
            event_id=event_id,
            fetched_ns=time.time_ns(),
            version=__version__,
            files=tuple(self.files[name] for name in sorted(self.files)),
            windows=tuple(windows),
            entries=0 if history is None else len(history.entries),
            chain_holds=holds,
            absent=tuple(self.absent),
        )
        files.replace_output(self.folder / REPORT, to_json(report))
        return report

    def _document(self, model: type[M], selector: str) -> M:
        from coec.schemas.message import from_json

        joined = ";" if "?" in selector else "?"
        return from_json(model, self._answer(f"{selector}{joined}format=json"))

    def _optional(self, name: str, model: type[M], selector: str) -> M | None:
        from coec.schemas.message import to_json

        def fetch() -> M:
            document = self._document(model, selector)
            self._store(name, to_json(document))
            return document

        return self._try(name, fetch)

    def _configuration(self) -> bytes:
        """The configuration as the vehicle sends it; a newer vehicle may have keys that this program does not know."""
        from coec.schemas.message import json_value

        document = json_value(self._answer(f"{self.keys.config}?format=json"))
        return json.dumps(document, indent=2, sort_keys=True).encode()

    def _picture(self, event_id: str, side: str) -> None:
        from coec.config import LimitsConfig
        from coec.io.images import decode_bgr, probe

        data = self._answer(f"{self.keys.evidence_of(self.pair, event_id)}?overlay={side}")
        limits = LimitsConfig(max_message_bytes=MAX_PICTURE_BYTES)
        decode_bgr(probe(data, limits), limits)
        self._store(f"{side}.jpg", data)

    def _window(self, window_id: str, history: HistoryReply | None) -> FetchedWindow | None:
        from coec.schemas.documents import FetchedWindow
        from coec.schemas.replies import WindowInfo

        info = self._recording(window_id)
        if not isinstance(info, WindowInfo):
            return None
        return FetchedWindow(
            window_id=window_id,
            sha256=str(info.sha256),
            size_bytes=info.size_bytes,
            pairs=info.pairs,
            decision=info.decision,
            in_history=_in_history(self.folder / _recorded(window_id), window_id, history),
        )

    def _snippets(self, event: EvidenceEvent) -> Iterator[str]:
        """Ids of the snippets that were recorded at full rate about the event."""
        from coec.schemas.documents import Absent
        from coec.schemas.replies import WindowsReply

        listed = self._try("snippets", lambda: self._document(WindowsReply, self.keys.windows(self.pair)))
        near = [
            snippet
            for snippet in (listed.snippets if listed is not None else ())
            if abs(snippet.stamp_ns - event.stamp_ns) <= SNIPPET_NS
        ]
        near.sort(key=lambda snippet: abs(snippet.stamp_ns - event.stamp_ns))
        for snippet in near[:MAX_SNIPPETS]:
            if self._recording(snippet.snippet_id) is not None:
                yield snippet.snippet_id
        if len(near) > MAX_SNIPPETS:
            why = f"the vehicle lists {len(near)} about this event, and the {MAX_SNIPPETS} nearest in time were fetched"
            how = "`coec query windows` lists all, and `coec query windows/ID --output FILE` fetches one"
            self.absent.append(Absent(what=f"{len(near) - MAX_SNIPPETS} snippets", why=f"{why}; {how}"))

    def _recording(self, recording_id: str) -> RecordingInfo | None:
        from coec.io.zenoh.query_client import fetch_window
        from coec.schemas.documents import Absent, FetchedFile

        if (named := OF_PAIR.fullmatch(recording_id)) is None or named["pair"] != self.pair:
            self.absent.append(Absent(what="a recording", why="the vehicle reports an invalid name for it"))
            return None
        name = _recorded(recording_id)
        left = MAX_RECORDED_BYTES - self.recorded_bytes
        if left <= 0:
            how = f"`coec query windows/{recording_id} --output FILE` fetches it"
            why = f"the other recordings of the event have {self.recorded_bytes} bytes, as much as is fetched; {how}"
            self.absent.append(Absent(what=name, why=why))
            return None

        def fetch() -> RecordingInfo:
            with console.progress(counted=False) as bars:
                info = fetch_window(
                    self.session,
                    self.keys,
                    self.pair,
                    recording_id,
                    self.folder / name,
                    self.timeout_s,
                    self.patience_s,
                    bars.add_download(recording_id),
                    left,
                )
            self.recorded_bytes += info.size_bytes
            self.files[name] = FetchedFile(name=name, sha256=str(info.sha256), size_bytes=info.size_bytes)
            return info

        return self._try(name, fetch)

    def _answer(self, selector: str) -> bytes:
        from coec.io.zenoh.query_client import query_one

        deadline_s = time.monotonic() + self.patience_s
        while True:
            try:
                return query_one(self.session, selector, self.timeout_s).payload
            except RemoteError as error:
                if error.reply_code not in WAITS or time.monotonic() + WAIT_S > deadline_s:
                    raise
            time.sleep(WAIT_S)

    def _try(self, what: str, fetch: Callable[[], T]) -> T | None:
        """What is fetched; None, and a note why, if that cannot be had."""
        from coec.schemas.documents import Absent

        try:
            return fetch()
        except OutputError:
            raise
        except CoecError as error:
            self.absent.append(Absent(what=what, why=str(error)))
            return None

    def _store(self, name: str, data: bytes) -> None:
        import hashlib

        from coec.io import user_files as files
        from coec.schemas.documents import FetchedFile

        files.replace_output(self.folder / name, data)
        self.files[name] = FetchedFile(name=name, sha256=hashlib.sha256(data).hexdigest(), size_bytes=len(data))


def chain_holds(history: HistoryReply) -> bool | None:
    """Whether the entries match their hashes, and each holds the hash of the entry before it in its book, as far as
    that was fetched. None: unknown, because no two fetched entries follow each other, or another version wrote them."""
    from coec.schemas.message import SCHEMA_VERSION

    linked = 0
    last: dict[str, ChainedEntry] = {}
    for chained in sorted(history.entries, key=lambda item: item.entry.sequence):
        entry, before = chained.entry, last.get(chained.entry.book)
        if entry.schema_version == SCHEMA_VERSION and _sha256(entry) != chained.sha256:
            return False
        if before is not None:
            follows = entry.previous_sha256 == before.sha256
            linked += follows
            # Entries that were not fetched may lie between the two, unless their numbers say that none does.
            if not follows and entry.sequence == before.entry.sequence + 1:
                return False
        last[entry.book] = chained
    return True if linked else None


def _recorded(recording_id: str) -> str:
    """Path of a recording within the folder."""
    return f"windows/{recording_id}.mcap"


def _around(key: str, event: EvidenceEvent) -> str:
    """Selector of the history about an event, including the decisions on the windows before and after it."""
    stamps = [event.stamp_ns, *(point.stamp_ns for point in event.metrics)]
    for window_id in (event.window_before, event.window_after):
        if window_id is not None and OF_PAIR.fullmatch(window_id):
            stamps.append(int(window_id.rpartition("-")[2]))
    if event.resolved_stamp_ns is not None:
        stamps.append(event.resolved_stamp_ns)
    since_ns = max(min(stamps) - AROUND_NS, 0)
    until_ns = min(max(stamps) + AROUND_NS, 2**63 - 1)
    return f"{key}?since={since_ns};until={until_ns};limit={ENTRIES}"


def _in_history(path: Path, window_id: str, history: HistoryReply | None) -> bool | None:
    from coec.io.mcap.windows import read_result
    from coec.schemas.message import SCHEMA_VERSION

    entries = () if history is None else history.entries
    stored = [item.entry.result_sha256 for item in entries if item.entry.window_id == window_id]
    known = [sha256 for sha256 in stored if sha256 is not None]
    try:
        result = read_result(path)
    except WindowError:
        return None
    if result is None or not known or result.schema_version != SCHEMA_VERSION:
        return None
    return _sha256(result) in known


def _sha256(message: Message) -> str:
    import hashlib

    from coec.schemas.message import to_json

    return hashlib.sha256(to_json(message)).hexdigest()
