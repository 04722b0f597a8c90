"""`coec watch`: what a service says, as it changes. Through certificates it watches in tests/deploy."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from cli.conftest import Coec
from coec.errors import ConfigError, ConnectionFailedError
from coec.io.zenoh.bus import MSGPACK
from coec.reports import console
from coec.schemas.keys import Keys
from coec.schemas.message import to_msgpack
from coec.schemas.replies import Axes, AxisReply, DataQuality, HealthReply, HealthState, Reason
from e2e.processes import Router, free_endpoint

KEYS = Keys("coec", "vehicle")
KEY = KEYS.health("front")
AT_MOST_S = "60"
SHORT_S = "0.5"


def health(state: HealthState, *reasons: Reason) -> bytes:
    axis = AxisReply(status="not_solved", sigma=None, correction=0.0, unit="deg")
    reply = HealthReply(
        vehicle="vehicle", pair="front", state=state, level=3, reasons=reasons, metrics={},
        axes=Axes(rx=axis, ry=axis, rz=axis, tx=axis, ty=axis, tz=axis), needs=(), data_quality=DataQuality(),
        since_ns=0, evaluated_ns=None, age_s=None,
    )  # fmt: skip
    return to_msgpack(reply)


class Speaker:
    """Answers what its health is, and says that it has changed: before it answers, or as soon as it is told to."""

    def __init__(self, session: zenoh.Session, *, hasty: bool = False) -> None:
        self._session = session
        self._hasty = hasty
        self._queryable = session.declare_queryable(KEY, self._answer)
        self._token = session.liveliness().declare_token(KEYS.alive("front"))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if self._hasty:
                self.change()
            query.reply(KEY, health("unknown"), encoding=MSGPACK)

    def change(self) -> None:
        self._session.put(KEY, b"\xc1", encoding=MSGPACK)
        self._session.put(KEY, health("degraded", Reason(code="dark", text="Too dark.")), encoding=MSGPACK)

    def end(self) -> None:
        self._queryable.undeclare()
        self._token.undeclare()


@pytest.fixture
def speaker(router: Router) -> Iterator[Speaker]:
    speaker = Speaker(router.session)
    yield speaker
    speaker.end()


def test_what_is_so_and_what_changes_is_reported_a_document_a_line(
    coec: Coec, router: Router, speaker: Speaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = console.print_json

    def print_json(document: Any) -> None:
        """As it does; when it has told what was so, that changes, and then it is told to stop."""
        shown(document)
        if document["key"] == KEY:
            speaker.change() if document["value"]["state"] == "unknown" else os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(console, "print_json", print_json)
    outcome = coec("watch", "--connect", router.endpoint, "--seconds", AT_MOST_S, "--json")
    assert outcome.status == 0
    reported = [json.loads(line) for line in outcome.out.splitlines()]
    assert {"key": KEYS.alive("front"), "value": True} in reported
    assert [one["value"]["state"] for one in reported if one["key"] == KEY] == ["unknown", "degraded"]
    assert "1 message was not shown" in outcome.err, "what is no document of ours is counted"


def test_an_answer_that_is_late_does_not_undo_a_change(coec: Coec, router: Router) -> None:
    speaker = Speaker(router.session, hasty=True)
    outcome = coec("watch", "--connect", router.endpoint, "--seconds", SHORT_S)
    speaker.end()
    lines = outcome.out.splitlines()
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\dZ  vehicle/front  .*", line) for line in lines)
    assert lines[-1].endswith("  degraded: dark")
    assert any(line.endswith("  is served") for line in lines)


def test_silence_is_a_failure(coec: Coec, router: Router) -> None:
    outcome = coec("watch", "--connect", router.endpoint, "--vehicle", "other", "--seconds", "0.2", "--timeout", "1")
    assert (outcome.status, outcome.out) == (1, "")


def test_without_a_router_it_says_so(coec: Coec, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    assert coec("watch", "--connect", endpoint, "--timeout", "0.2").status == ConnectionFailedError.exit_code
    file = tmp_path / "observer.json5"
    file.write_text(json.dumps({"connect": {"endpoints": [endpoint]}}))
    outcome = coec("watch", "--zenoh", file, "--timeout", "0.2")
    assert outcome.status == ConnectionFailedError.exit_code
    assert endpoint in outcome.err
    assert coec("watch", "--zenoh", tmp_path / "absent.json5").status == ConfigError.exit_code
