"""The log: one line a record, as JSON or for people, whatever a sender had a hand in."""

from __future__ import annotations

import io
import json
import logging
import os
import re
from collections.abc import Iterator
from typing import TextIO

import pytest

from coec.io import logs
from coec.io.logs import Form
from support.strategies import HOSTILE, obeyed_characters

NASTY = "two\nlines \x1b[31mred\x1b[0m\r and a \u202ebackwards"


@pytest.fixture(autouse=True)
def _root() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


def logged(form: Form, stream: TextIO) -> None:
    logs.configure("info", form, stream)
    logging.getLogger("test").warning(NASTY, extra={"fields": {"pair": "front", "level": "forged"}})
    logging.getLogger("test").debug("not at this level")


def test_a_record_is_one_line_of_json() -> None:
    stream = io.StringIO()
    logged("auto", stream)  # it goes to no terminal
    (line,) = stream.getvalue().splitlines()
    document = json.loads(line)
    assert (document["message"], document["pair"], document["level"]) == (NASTY, "front", "warning")


def test_for_people_it_is_one_line_that_moves_no_cursor() -> None:
    stream = io.StringIO()
    logged("human", stream)
    (line,) = stream.getvalue().splitlines()
    assert re.match(r"\d\d:\d\d:\d\d\.\d{3} warning: two\\nlines ", line), line
    assert line.isprintable()
    assert "pair=front" in line


@pytest.mark.fault("control characters in a name that the log quotes", "both forms of the log show escapes")
@pytest.mark.parametrize("form", ["json", "human"])
def test_no_form_of_the_log_steers_a_terminal(form: Form) -> None:
    stream = io.StringIO()
    logs.configure("info", form, stream)
    try:
        raise ValueError(HOSTILE)
    except ValueError:
        logging.getLogger(HOSTILE).exception("frame %s", HOSTILE, extra={"fields": {HOSTILE: HOSTILE}})
    assert obeyed_characters(stream.getvalue()) == ""
    line, *traceback = stream.getvalue().splitlines()
    assert r"\u202e" in repr(line)
    if form == "json":
        assert json.loads(line)[HOSTILE] == HOSTILE
        assert not traceback
    else:
        assert traceback[-2].startswith(r"ValueError: \x1b[35;45m")


def test_where_it_goes_to_a_terminal_it_is_for_people() -> None:
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "w") as terminal:
        logged("auto", terminal)
        terminal.flush()
        assert b" warning: two" in os.read(ours, 4096)
        logged("json", terminal)
        terminal.flush()
        assert json.loads(os.read(ours, 4096))["pair"] == "front"
    os.close(ours)


def test_a_traceback_follows_its_line() -> None:
    stream = io.StringIO()
    logs.configure("info", "human", stream)
    try:
        raise ValueError("of the test")
    except ValueError:
        logging.getLogger("test").exception("it failed")
    line, *traceback = stream.getvalue().splitlines()
    assert line.endswith("error: it failed")
    assert traceback[-1] == "ValueError: of the test"
