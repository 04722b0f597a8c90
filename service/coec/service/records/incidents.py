"""The evidence of every incident: the windows before and after it, pictures, the figures around it, the decision.

Each event has a folder with `event.json` and the pictures. The windows themselves stay in the window folder, where they
are protected from removal. If there are too many events, the oldest is dropped, and its windows lose that protection.
"""

import contextlib
import json
import threading
from collections import deque
from pathlib import Path
from typing import Literal

from coec.errors import DecodeError, NotFoundError, StateError
from coec.io import storage
from coec.schemas.message import from_json, to_json
from coec.schemas.replies import EvidenceEvent, MetricsPoint

POINTS_BEFORE = 240
"""How many checks' figures are remembered: 20 minutes at one check in 5 s."""

POINTS_AFTER = 60
"""How many checks after the beginning of an event are added to it: five minutes."""

EVENT = "event.json"
"""Name of the file in each event's folder that describes the event."""

NO_EVENT = "no such event is kept; the list is in `evidence`"

Side = Literal["before", "after"]


class Incidents:
    """Red events of one pair. Safe to use from several threads. Only `flush` waits for the disk; what it cannot write
    stays in memory until it can."""

    def __init__(self, folder: Path, pair: str, limit: int) -> None:
        self._folder = folder
        self._pair = pair
        self._limit = limit
        self._lock = threading.RLock()
        self._writing = threading.Lock()
        self._points: deque[MetricsPoint] = deque(maxlen=POINTS_BEFORE)
        self._events: dict[str, EvidenceEvent] = {}
        # Events as they are on the disk; events and pictures not yet written; dropped events not yet removed.
        self._on_disk: dict[str, EvidenceEvent] = {}
        self._unsaved: set[str] = set()
        self._pictures: dict[tuple[str, Side], bytes] = {}
        self._dropped: set[str] = set()
        self._after = 0
        self._unread: frozenset[str] = frozenset()
        self._load()

    @property
    def window_ids(self) -> frozenset[str]:
        """Windows that are evidence and must not be removed, those of events that cannot be read among them."""
        with self._lock:
            both = ((event.window_before, event.window_after) for event in self._events.values())
            return self._unread | {window_id for pair in both for window_id in pair if window_id is not None}

    @property
    def newest(self) -> EvidenceEvent | None:
        """The newest event; None if there is none."""
        with self._lock:
            return next(reversed(self._events.values()), None)

    @property
    def awaiting(self) -> EvidenceEvent | None:
        """The newest event if it has no window after it yet; else None."""
        with self._lock:
            newest = self.newest
            return newest if newest is not None and newest.window_after is None else None

    def note(self, point: MetricsPoint) -> None:
        """Takes in the figures of one check."""
        with self._lock:
            self._points.append(point)
            newest = self.newest
            if newest is not None and self._after > 0:
                self._after -= 1
                self._keep(newest.model_copy(update={"metrics": (*newest.metrics, point)}))

    def begin(self, event: EvidenceEvent) -> EvidenceEvent:
        """An incident begins; the figures so far are added to it."""
        with self._lock:
            opened = event.model_copy(update={"metrics": tuple(self._points)})
            self._after = POINTS_AFTER
            self._keep(opened)
            self._drop_oldest()
            return opened

    def add_window_after(self, window_id: str) -> EvidenceEvent | None:
        """Adds the first window after the newest event, and returns the event; None if no event waits for one."""
        with self._lock:
            event = self.awaiting
            if event is None:
                return None
            return self._keep(event.model_copy(update={"window_after": window_id}))

    def add_overlay(self, event_id: str, side: Side, jpeg: bytes) -> None:
        """Adds a picture of one of the windows; it replaces an earlier one."""
        with self._lock:
            event = self._events.get(event_id)
            if event is None:
                return
            self._pictures[event_id, side] = jpeg
            sides = tuple(s for s in ("before", "after") if s == side or s in event.overlays)
            self._keep(event.model_copy(update={"overlays": sides}))

    def resolve(self, stamp_ns: int | None, text: str) -> None:
        """The pair is not red any more."""
        with self._lock:
            newest = self.newest
            if newest is not None and newest.resolution is None:
                self._keep(newest.model_copy(update={"resolved_stamp_ns": stamp_ns, "resolution": text}))

    def events(self) -> tuple[EvidenceEvent, ...]:
        """All events that are kept, with their figures."""
        with self._lock:
            return tuple(self._events.values())

    def on_disk(self) -> tuple[EvidenceEvent, ...]:
        """All events that are on the disk, as they are there."""
        with self._lock:
            return tuple(self._on_disk.values())

    def overlay(self, event_id: str, side: Side) -> bytes:
        """JPEG of the window before or after an event.

        Raises:
            NotFoundError: no such event, or it has no such picture.
        """
        with self._lock:
            if event_id not in self._events:
                raise NotFoundError(NO_EVENT)
            waiting = self._pictures.get((event_id, side))
        if waiting is not None:
            return waiting
        try:
            return (self._folder / event_id / f"{side}.jpg").read_bytes()
        except OSError as error:
            raise NotFoundError(f"the event has no picture of the window {side} it") from error

    def _load(self) -> None:
        """Loads events of earlier runs. A folder without its event file is removed: the power failed while the folder
        was being filled or removed. An event that cannot be read stays on the disk, and its windows stay protected:
        another version of the software may have written it."""
        folders = [path for path in self._folder.glob(f"{self._pair}-*") if _is_event_of(self._pair, path.name)]
        for folder in sorted(folders, key=lambda path: _stamp(path.name)):
            with contextlib.suppress(OSError):
                if not (folder / EVENT).exists():
                    storage.remove_folder(folder)
                    continue
                data = (folder / EVENT).read_bytes()
                try:
                    event = from_json(EvidenceEvent, data)
                except DecodeError:
                    self._unread |= _windows_named_in(data)
                    continue
                if event.pair == self._pair and event.event_id == folder.name:
                    self._events[event.event_id] = self._on_disk[event.event_id] = event
        self._drop_oldest()
        with contextlib.suppress(StateError):
            self.flush()

    def _drop_oldest(self) -> None:
        while len(self._events) > self._limit:
            oldest = next(iter(self._events))
            del self._events[oldest]
            self._on_disk.pop(oldest, None)
            self._unsaved.discard(oldest)
            self._pictures = {key: jpeg for key, jpeg in self._pictures.items() if key[0] != oldest}
            self._dropped.add(oldest)

    def _keep(self, event: EvidenceEvent) -> EvidenceEvent:
        self._events[event.event_id] = event
        self._unsaved.add(event.event_id)
        return event

    def flush(self) -> None:
        """Writes to the disk what is not there yet or not any more, pictures before the events that name them; and
        removes dropped events. An event that somebody has removed has lost its pictures.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        with self._writing:
            with self._lock:
                on_disk = tuple(self._on_disk)
            lost = [event_id for event_id in on_disk if not (self._folder / event_id / EVENT).exists()]
            with self._lock:
                for event_id in lost:
                    if event_id in self._events:
                        sides = tuple(side for of, side in self._pictures if of == event_id)
                        self._keep(self._events[event_id].model_copy(update={"overlays": sides}))
                pictures = dict(self._pictures)
                events = {event_id: self._events[event_id] for event_id in sorted(self._unsaved)}
                dropped = tuple(self._dropped)
            try:
                for (event_id, side), jpeg in pictures.items():
                    self._write(self._folder / event_id / f"{side}.jpg", jpeg)
                    with self._lock:
                        if self._pictures.get((event_id, side)) is jpeg:
                            del self._pictures[event_id, side]
                for event_id, event in events.items():
                    self._write(self._folder / event_id / EVENT, to_json(event))
                    with self._lock:
                        if event_id in self._events:
                            self._on_disk[event_id] = event
                        if self._events.get(event_id) is event:
                            self._unsaved.discard(event_id)
                for event_id in dropped:
                    storage.remove_folder(self._folder / event_id)
                    with self._lock:
                        self._dropped.discard(event_id)
            except OSError as error:
                raise StateError(f"cannot write the evidence in {self._folder}: {error.strerror}") from error

    @staticmethod
    def _write(path: Path, data: bytes) -> None:
        storage.make_folder(path.parent)
        storage.replace(path, data)


def _windows_named_in(data: bytes) -> frozenset[str]:
    """The windows that an event file names, as far as that can be read."""
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError):
        return frozenset()
    named = [fields.get(name) for name in ("window_before", "window_after")] if isinstance(fields, dict) else []
    return frozenset(name for name in named if isinstance(name, str))


def _is_event_of(pair: str, name: str) -> bool:
    named, _, stamp = name.rpartition("-")
    return named == pair and stamp.isdecimal()


def _stamp(event_id: str) -> int:
    text = event_id.rpartition("-")[2]
    return int(text) if text.isdigit() else 0
