"""Text from outside in printable form: replies, samples, recordings and file names may hold anything, and a terminal
obeys control sequences in whatever is written to it.

`printable` makes one line without control sequences, `json_printable` does the same for a JSON document, and
`Untrusted` is a string whose only printed form is the former.
"""

from __future__ import annotations

import re

LIMIT = 1000
"""Most characters that one untrusted text occupies in a line: about ten lines of a terminal."""

_IGNORABLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180d\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)
"""Characters that take no room, although `str.isprintable` counts them as printable: the rest of the property
`Default_Ignorable_Code_Point` of Unicode. Texts that differ only in these look the same."""

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Halves of a character beyond U+FFFF; `str` joins proper pairs, so each of them stands alone and has no UTF-8 form."""


class Untrusted(str):
    """A string that came from outside. `str()`, `repr()` and every f-string give its printable form, bounded to `LIMIT`
    characters; comparison, hashing and encoding use the content as it came, which `raw` returns.

    `str.join` and `+` copy the content as it came: what they make is only safe in a line printed by
    `coec.reports.console`, which escapes once more.
    """

    __slots__ = ()

    def __new__(cls, text: str) -> Untrusted:
        """The text, with unpaired surrogates escaped, since no encoder accepts them."""
        content = str.__str__(text)
        if not content.isascii():
            content = _SURROGATE.sub(_escaped, content)
        return super().__new__(cls, content)

    @property
    def raw(self) -> str:
        """The content as it came, for comparison with other content. Never print it."""
        return str.__str__(self)

    def __str__(self) -> str:
        return printable(self)

    def __repr__(self) -> str:
        return printable(str.__repr__(self))

    def __format__(self, form: str) -> str:
        return format(printable(self), form)


def printable(text: str, limit: int | None = LIMIT) -> str:
    """The text as one line that a terminal shows and does not obey.

    Escaped as in Python literals (`\\x1b`, `\\n`, `\\u202e`) are control characters, line and paragraph separators,
    bidirectional controls, zero-width and other characters without a shape, unpaired surrogates, private use and
    unassigned characters, and spaces other than U+0020. What exceeds `limit` characters is cut; the end says how many
    characters were. None: no limit.
    """
    text = str.__str__(text)
    if _is_printable(text):
        length = len(text) if limit is None else limit
        return text if len(text) <= length else f"{text[:length]}{_left_out(len(text) - length)}"
    shown: list[str] = []
    length = 0
    for index, character in enumerate(text):
        piece = character if _is_printable(character) else character.encode("unicode_escape").decode()
        length += len(piece)
        if limit is not None and length > limit:
            return "".join(shown) + _left_out(len(text) - index)
        shown.append(piece)
    return "".join(shown)


def printable_lines(text: str) -> str:
    """As `printable`, of any length, with line breaks (`\n`) as they are: for a text whose lines the program made."""
    return "\n".join(printable(line, None) for line in str.__str__(text).split("\n"))


def json_printable(document: str) -> str:
    """A JSON document in which the characters that `printable` escapes are `\\u` escapes of JSON, so that it reads back
    to the same value. Line breaks between its values stay."""
    return "\n".join(
        line if _is_printable(line) else "".join(map(_json_escaped, line)) for line in document.split("\n")
    )


def _is_printable(text: str) -> bool:
    return text.isprintable() and (text.isascii() or _IGNORABLE.search(text) is None)


def _left_out(count: int) -> str:
    return f"… ({count} more characters)"


def _escaped(match: re.Match[str]) -> str:
    return match[0].encode("unicode_escape").decode()


def _json_escaped(character: str) -> str:
    if _is_printable(character):
        return character
    code = ord(character)
    if code <= 0xFFFF:
        return f"\\u{code:04x}"
    return f"\\u{0xD800 + (code - 0x10000 >> 10):04x}\\u{0xDC00 + (code & 0x3FF):04x}"
