"""Text from outside: what a person is shown of it, and that nothing of it is lost to a program."""

from __future__ import annotations

import copy
import json
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.errors import CoecError, DecodeError, RemoteError
from coec.untrusted import LIMIT, Untrusted, json_printable, printable, printable_lines
from support.strategies import HOSTILE, obeyed_characters

ANYTHING = st.text(st.characters(codec=None, categories=None))
"""Unpaired surrogates too."""


@given(ANYTHING)
def test_nothing_that_is_shown_is_obeyed(text: str) -> None:
    for shown in (printable(text), printable(text, None), f"{Untrusted(text)}", repr(Untrusted(text))):
        assert shown.isprintable()
        assert "\ufe0f" not in shown
    assert obeyed_characters(printable_lines(text)) == ""
    assert printable_lines(text).count("\n") == text.count("\n")
    assert printable(printable(text, None), None) == printable(text, None), "what is printable stays as it is"


@given(st.recursive(ANYTHING, lambda inner: st.lists(inner) | st.dictionaries(ANYTHING, inner), max_leaves=5))
def test_a_document_of_json_reads_back_to_the_same(value: object) -> None:
    for text in (json.dumps(value, ensure_ascii=False), json.dumps(value, ensure_ascii=False, indent=1)):
        shown = json_printable(text)
        assert obeyed_characters(shown) == ""
        assert json.loads(shown) == json.loads(json.dumps(value))


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[2J", r"a\x1b[2J"),
        ("one\ntwo\r\tthree", r"one\ntwo\r\tthree"),
        ("\x9b1m\x7f", r"\x9b1m\x7f"),
        ("\u202egnp.exe\u2066\u200f", r"\u202egnp.exe\u2066\u200f"),
        ("\u2028\u200b\ufeff\xa0\u3164\ufe0f\U000e0041", r"\u2028\u200b\ufeff\xa0\u3164\ufe0f\U000e0041"),
        ("\ud800", r"\ud800"),
        ("Größe 3° ± σ, 漢字 ✓ 🚗", "Größe 3° ± σ, 漢字 ✓ 🚗"),
    ],
)
def test_what_a_terminal_obeys_is_shown_as_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_a_novel_is_cut_and_says_by_how_much() -> None:
    assert printable("x" * LIMIT) == "x" * LIMIT
    assert printable("x" * (LIMIT + 7)) == "x" * LIMIT + "… (7 more characters)"
    shown = printable("\x1b" * 10_000_000)
    assert shown == r"\x1b" * (LIMIT // 4) + f"… ({10_000_000 - LIMIT // 4} more characters)"


def test_untrusted_text_is_the_same_text_to_a_program() -> None:
    text = Untrusted(HOSTILE)
    assert text == HOSTILE
    assert hash(text) == hash(HOSTILE)
    assert (type(text.raw), text.raw) == (str, HOSTILE)
    assert text.encode() == HOSTILE.encode()
    assert json.loads(json.dumps({text: text})) == {HOSTILE: HOSTILE}
    for other in (copy.deepcopy(text), pickle.loads(pickle.dumps(text)), Untrusted(text)):
        assert (type(other), other) == (Untrusted, HOSTILE)
    assert f"{Untrusted('a'):>3}" == "  a"
    assert "%s" % Untrusted("\x07") == "\\x07"  # noqa: UP031


def test_an_error_quotes_nothing_that_is_obeyed_and_begins_no_line() -> None:
    assert str(CoecError(f"no topic {HOSTILE}")).isprintable()
    assert str(CoecError("no such source", "accepted:\n  a\x1b")) == "no such source\naccepted:\n  a\\x1b"
    assert str(DecodeError("malformed", HOSTILE)).isprintable()
    assert str(CoecError()) == ""
    refusal = RemoteError(HOSTILE, HOSTILE + "y" * 10_000)
    assert str(refusal).isprintable()
    assert len(str(refusal)) < LIMIT + 100
    assert refusal.reply_code == HOSTILE
