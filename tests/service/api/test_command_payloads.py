"""What a command may say, and what is written down of who said it."""

import json
from contextlib import suppress

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coec.errors import UsageError
from coec.schemas.commands import COMMAND_NAMES, MAX_REASON
from coec.service.api.authorization import MAX_SENDER, parse_payload, proven_sender, sender_of


@pytest.mark.parametrize("name", COMMAND_NAMES)
@pytest.mark.parametrize("payload", [b"", b"{}", b"\x80"])
def test_every_command_can_come_without_arguments(name: str, payload: bytes) -> None:
    assert parse_payload(name, payload) == {}


@pytest.mark.parametrize("pack", [lambda d: msgpack.packb(d), lambda d: str(d).replace("'", '"').encode()])
def test_arguments_in_either_encoding(pack: object) -> None:
    assert callable(pack)
    assert parse_payload("rollback", pack({"to": "0123abcd"})) == {"to": "0123abcd"}
    assert parse_payload("hold", msgpack.packb({"release": True})) == {"release": True}


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("dance", b""),
        ("calibrate", b"x"),
        ("apply", b'{"force":true}'),
        ("hold", b'{"release":1}'),
        ("rollback", b'{"to":["a"]}'),
        ("rollback", b"[]"),
        ("reset", b"\xc1"),
        ("reset", b"\x81\x01\x02"),
        ("reset", b"{" * 100_000),
        ("reset", b'{"a":' * 800),
        ("hold", b'{"release":%s}' % (b"9" * 4050)),
        ("hold", b'{"release":%s}' % (b"9" * 5000)),
        ("hold", b'{"release":true,"a":[%s0]}' % (b"[]," * 1_000_000)),
        ("hold", b"\x81\xa7release" + b"\x91" * 2000),
        ("hold", b"\x81\xa7release\xd6\xff\xff\xff\xff\xff"),
        ("hold", b"\x81\x90\x01"),
        ("rollback", b"\x81\xa2to\xc7\x0c\xff" + b"\xff" * 12),
        ("hold", msgpack.packb({str(i): i for i in range(1000)})),
    ],
)
def test_what_is_no_command_is_refused_without_echo(name: str, payload: bytes) -> None:
    with pytest.raises(UsageError) as refused:
        parse_payload(name, payload)
    assert "force" not in str(refused.value)
    assert "dance" not in str(refused.value)


@pytest.mark.fault("control characters and bombs as the name of a sender", "one harmless line in the log")
@pytest.mark.fault("control characters and a novel as the reason of a command", "one line, or an error of ours")
def test_a_reason_is_one_line_that_steers_no_terminal() -> None:
    reported = {"reason": " the mirror\nis \x1b[31mchanged\u202e, sagt Jürgen\x00 "}
    for payload in (json.dumps(reported).encode(), msgpack.packb(reported)):
        assert parse_payload("hold", payload) == {"reason": "the mirror is [31mchanged , sagt Jürgen"}
    assert parse_payload("reset", json.dumps({"reason": "ü" * MAX_REASON}).encode()) == {"reason": "ü" * MAX_REASON}
    assert parse_payload("reset", msgpack.packb({"reason": "€" * MAX_REASON})) == {"reason": "€" * MAX_REASON}
    with pytest.raises(UsageError, match="at most"):
        parse_payload("reset", json.dumps({"reason": "x" * (MAX_REASON + 1)}).encode())


@pytest.mark.parametrize(
    ("attachment", "report"),
    [
        (None, "anonymous"),
        (b"", "anonymous"),
        (b"fleet@example.org/operator=7", "fleet@example.org/operator=7"),
        (b'eve\n{"level": "error"}\x1b[31m', "eve___level_: _error___[31m".replace("[", "_")),
    ],
)
def test_senders_are_one_harmless_line(attachment: bytes | None, report: str) -> None:
    assert sender_of(attachment) == report


def test_long_and_binary_senders_are_bounded() -> None:
    assert sender_of(b"a" * 100_000) == "a" * MAX_SENDER
    binary = sender_of(bytes(range(128, 256)) * 1000)
    assert binary.startswith("128000 bytes, sha256 ")
    assert len(binary) < MAX_SENDER


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(COMMAND_NAMES),
    st.one_of(
        st.binary(max_size=64),
        st.binary(max_size=16).map(lambda rest: b"{" + rest),
        st.binary(max_size=24).map(lambda rest: b"\x81\xa2to" + rest),
        st.dictionaries(st.text(max_size=3), st.integers() | st.text(max_size=3) | st.none(), max_size=3).map(
            lambda arguments: json.dumps(arguments).encode()
        ),
    ),
)
def test_any_bytes_are_a_command_or_an_error_of_ours(name: str, payload: bytes) -> None:
    with suppress(UsageError):
        parse_payload(name, payload)


@given(st.binary(max_size=200) | st.text(alphabet="operator (certificate)", max_size=40).map(str.encode))
def test_no_attachment_comes_to_a_name_that_is_proven(attachment: bytes) -> None:
    assert not sender_of(attachment).endswith(" (certificate)")


@given(st.text(max_size=64))
def test_a_proven_name_is_one_short_harmless_line(name: str) -> None:
    line = proven_sender(name)
    assert line.endswith(" (certificate)")
    assert line.isascii()
    assert line.isprintable()
    assert len(line) <= MAX_SENDER + len(" (certificate)")


def test_a_command_for_the_rig_may_name_a_sensor_and_no_window() -> None:
    assert parse_payload("hold", b'{"sensor":"roof","release":true}', for_rig=True) == {
        "sensor": "roof",
        "release": True,
    }
    for name, payload, for_rig in (
        ("hold", b'{"sensor":"roof"}', False),
        ("hold", b'{"sensor":5}', True),
        ("rollback", b'{"to":"x"}', True),
    ):
        with pytest.raises(UsageError):
            parse_payload(name, payload, for_rig=for_rig)
