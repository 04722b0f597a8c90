"""The list of recordings: what is there, in either encoding, and quick of thousands."""

from __future__ import annotations

import hashlib
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import BaseModel

from coec.config import StateConfig
from coec.io.mcap.windows import RecordedWindow
from coec.io.zenoh.bus import Answer
from coec.schemas.keys import Format
from coec.schemas.message import from_msgpack
from coec.schemas.replies import SnippetInfo, WindowsReply
from coec.service.api.pair_answers import WindowsList
from coec.service.api.reply_builders import answer_of
from coec.service.recording.snippets import SnippetStore
from coec.service.recording.window_store import WindowStore, WindowVersion

S = 1_000_000_000


def put(store: WindowStore, number: int) -> str:
    """A window as the recorder leaves it."""
    name = f"front-{1_700_000_000 * S + number * S}"
    path = store.path(name)
    path.write_bytes(b"window")
    status = path.stat()
    digest = hashlib.sha256(b"window").hexdigest()
    store.add(RecordedWindow(path, name, 10, status.st_size, status.st_mtime_ns, digest))
    return name


def listed(reported: WindowsList) -> WindowsReply:
    return from_msgpack(WindowsReply, reported.answer("msgpack").payload)


def test_it_says_what_is_there_now(tmp_path: Path) -> None:
    store = WindowStore(tmp_path / "windows", StateConfig(min_free_bytes=0))
    snippets = SnippetStore(tmp_path / "snippets", 2**20, 0)
    reported = WindowsList("v7", "front", store, snippets)
    assert listed(reported).windows == ()
    first = put(store, 1)
    assert [info.window_id for info in listed(reported).windows] == [first]
    store.protect("front", {first: "red_event"})
    assert [info.kept_for for info in listed(reported).windows] == ["red_event"]
    version = store.version(first)
    assert version is not None
    store.note(first, WindowVersion(**{**version.model_dump(), "decision": "accepted"}))
    snippets.add(
        SnippetInfo(snippet_id="front-5.snippet", event="suspect", stamp_ns=5, recorded_ns=6, size_bytes=7, sha256="00")
    )
    reply = listed(reported)
    assert [info.decision for info in reply.windows] == ["accepted"]
    assert [info.event for info in reply.snippets] == ["suspect"]
    answer = reported.answer("json")
    assert answer.encoding == "application/json"
    assert json.loads(answer.payload) == reply.model_dump(mode="json")


@pytest.mark.fault("5,000 windows, and a client that asks for their list again and again", "it is packed once")
def test_a_list_of_thousands_is_packed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    folder = tmp_path / "windows"
    folder.mkdir()
    for number in range(1, 5001):
        (folder / f"front-{number}.mcap").write_bytes(b"x")
    packed = 0

    def counted(model: BaseModel, form: Format) -> Answer:
        nonlocal packed
        packed += 1
        return answer_of(model, form)

    monkeypatch.setattr("coec.service.api.reply_builders.answer_of", counted)
    reported = WindowsList("v7", "front", WindowStore(folder, StateConfig(min_free_bytes=0)), None)
    took_s = []
    for _ in range(20):
        started_s = time.process_time()
        assert len(reported.answer("msgpack").payload) > 100_000
        took_s.append(time.process_time() - started_s)
    assert packed == 1
    record_property(
        "figure", f"first {1e3 * took_s[0]:.0f} ms of processor, then {1e3 * statistics.median(took_s):.2f} ms"
    )
