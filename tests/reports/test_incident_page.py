"""The page of an incident: it tells what the documents say, and obeys none of them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import pytest

from coec.cli.fetch import chain_holds
from coec.reports.incident_page import FetchedIncident, page, sentences
from coec.reports.page import render
from coec.schemas.documents import Absent, FetchedWindow
from coec.schemas.message import to_json
from coec.schemas.replies import (
    ChainedEntry,
    EvidenceEvent,
    ExtrinsicReply,
    HealthReply,
    HistoryEntry,
    HistoryReply,
    MetricsPoint,
    Reason,
    StatusReply,
    Transform,
)
from coec.service.records.history import GENESIS
from reports.pages import EVIL, MADE, png
from reports.test_page import Read
from support.strategies import HOSTILE, hostile_message, obeyed_characters

S = 1_000_000_000
IDENTITY = Transform(
    matrix=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
    translation_m=(0, 0, 0),
    quaternion_xyzw=(0, 0, 0, 1),
)
EVENT = EvidenceEvent(
    event_id="front-100",
    vehicle="truck",
    pair="front",
    stamp_ns=100 * S,
    wall_ns=1_700_000_000 * S,
    reasons=(Reason(code="bent_mount", text="The mount is bent."),),
    camera_from_lidar=IDENTITY,
    window_before="front-7",
    metrics=tuple(
        MetricsPoint(
            stamp_ns=at * S, state="healthy" if at < 100 else "suspect", metrics={"mi": at / 10, "edges": None}
        )
        for at in range(80, 120, 5)
    ),
)
STORY = FetchedIncident(EVENT, None, None, None, None, (), (), None)


def reported(story: FetchedIncident, pictures: Mapping[str, bytes] = MappingProxyType({})) -> str:
    """The document."""
    return render(page(story, pictures, MADE))


def test_the_story_is_what_the_documents_say() -> None:
    message = " ".join(sentences(STORY))
    assert "At 100.000 s of sensor time the pair front of truck turned red" in message
    assert "The mount is bent. (bent_mount)" in message
    assert "The window before it is front-7; nothing is told of what was decided of it." in message
    assert "There is no window after it." in message
    assert "It had not ended when this was fetched." in message
    resolved = replace(
        STORY, event=EVENT.model_copy(update={"resolved_stamp_ns": 160 * S, "resolution": "healthy: ok"})
    )
    assert "It ended after 60 s: healthy: ok" in " ".join(sentences(resolved))


def test_figures_are_rendered_on_one_axis_of_time_with_the_event_in_it() -> None:
    text = reported(STORY, {"before.jpg": png()})
    (line,) = re.findall(r'<path class="line [^"]*" d="(M[^"]*L[^"]*)"', text)
    assert len(re.findall("[ML]", line)) == len(EVENT.metrics), "a figure that was not told is not drawn"
    assert re.findall(r'<rect class="ground (\w+)" x=', text) == ["good", "unsure"], "each state once"
    assert text.count('<line class="mark"') == 1
    assert "8.000 to 11.500" in text


@pytest.mark.fault("a vehicle whose texts are markup", "the page shows them as text, and loads nothing")
def test_what_a_vehicle_says_is_text() -> None:
    event = EVENT.model_copy(
        update={
            "reasons": (Reason(code=EVIL, text=EVIL),),
            "resolution": EVIL,
            "window_before": EVIL,
            "metrics": (MetricsPoint(stamp_ns=-(2**70), state="healthy", metrics={EVIL: 1.0}),),
        }
    )
    entry = HistoryEntry(
        sequence=0, previous_sha256=EVIL, kind="command", code=EVIL, text=EVIL, wall_ns=2**90, sender=EVIL
    )
    history = HistoryReply(
        vehicle="v", pair="p", total=0, results=(), entries=(ChainedEntry(sha256=EVIL, entry=entry),)
    )
    story = FetchedIncident(event, history, None, None, None, (), (Absent(what=EVIL, why=EVIL),), False)
    text = reported(story)
    assert text.count("<script") == 1, "that of the page itself"
    assert "<img" not in text
    assert "something was changed, taken out or put in" in text


@pytest.mark.fault(
    "control sequences and markup in every text that a vehicle sends of an event",
    "the page has the elements and attributes that it has without them, and shows escapes",
)
def test_no_text_of_any_document_adds_to_the_page_or_reverses_it() -> None:
    def of(text: str) -> str:
        story = FetchedIncident(
            hostile_message(EvidenceEvent, text=text, stamp_ns=S, wall_ns=S),
            hostile_message(HistoryReply, text=text),
            hostile_message(HealthReply, text=text),
            hostile_message(ExtrinsicReply, text=text),
            hostile_message(StatusReply, text=text),
            (hostile_message(FetchedWindow, text=text),),
            (hostile_message(Absent, text=text),),
            chain_holds=True,
            snippets=(text,),
        )
        return reported(story, {"before.jpg": png()})

    shown = of(HOSTILE)
    assert obeyed_characters(shown) == ""
    page, harmless = (Read(text) for text in (shown, of("name")))
    assert [(tag, [*attributes]) for tag, attributes in page.tags] == [
        (tag, [*attributes]) for tag, attributes in harmless.tags
    ]
    leads = {attributes.get("href") or "#" for _, attributes in page.tags}
    assert all(address.startswith(("#", "windows/")) or address == "before.jpg" for address in leads)


def chained(*texts: str) -> list[ChainedEntry]:
    made, before = [], GENESIS
    for number, text in enumerate(texts):
        entry = HistoryEntry(
            sequence=number, previous_sha256=before, kind="state", book="states", code="c", text=text, wall_ns=number
        )
        before = sha256(entry)
        made.append(ChainedEntry(sha256=before, entry=entry))
    return made


def sha256(entry: HistoryEntry) -> str:
    return hashlib.sha256(to_json(entry)).hexdigest()


def held(*entries: ChainedEntry) -> bool | None:
    return chain_holds(HistoryReply(vehicle="v", pair="p", total=0, results=(), entries=entries))


@pytest.mark.fault("an entry of the history that was changed, taken out or put in on the way", "the page says so")
def test_entries_are_held_against_their_hashes() -> None:
    one, two, three = chained("a", "b", "c")
    assert held(one, two, three) is True
    assert held(two) is None
    assert held(one, three) is None, "what lies between them was not asked for"
    forged = two.entry.model_copy(update={"text": "B"})
    assert held(one, ChainedEntry(sha256=two.sha256, entry=forged), three) is False
    assert held(one, ChainedEntry(sha256=sha256(forged), entry=forged), three) is False, "it is not what follows on"


def test_snippets_are_links_into_the_folder() -> None:
    text = reported(replace(STORY, snippets=("front-7.snippet", "<b>")))
    assert 'href="windows/front-7.snippet.mcap"' in text
    assert "<b>" not in text
