"""Two ends prove who they are to each other; whoever is in between, or comes along, learns and changes nothing."""

from __future__ import annotations

import random
import ssl
import subprocess
from pathlib import Path

import pytest

from coec.errors import ConfigError, NotProvenError
from coec.io.zenoh import command_auth
from coec.io.zenoh.command_auth import (
    MAX_HANDSHAKES,
    MIN_HANDSHAKE_AGE_S,
    SECOND_QUERY_S,
    AuthenticatedCommand,
    CommandListener,
    CommandSender,
    Credentials,
    TooManyHandshakesError,
)
from support.router import TestAuthority, make_authority

TEXT = b"hold everything"


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def listener(authority: TestAuthority) -> CommandListener:
    return CommandListener(authority.credentials("vehicle"))


def flight(answer: bytes | AuthenticatedCommand) -> bytes:
    assert isinstance(answer, bytes)
    return answer


def end(answer: bytes | AuthenticatedCommand) -> AuthenticatedCommand:
    assert isinstance(answer, AuthenticatedCommand)
    return answer


def reported(
    listener: CommandListener, credentials: Credentials, to: str = "vehicle"
) -> tuple[AuthenticatedCommand, CommandSender]:
    """A whole conversation."""
    speaker = CommandSender(credentials, to)
    last = speaker.send(flight(listener.receive("1", speaker.first_flight())), TEXT)
    return end(listener.receive("1", last)), speaker


def test_each_knows_the_other_and_what_was_reported(authority: TestAuthority, listener: CommandListener) -> None:
    received, speaker = reported(listener, authority.credentials("operator"))
    assert (received.sender, received.payload) == ("operator", TEXT)
    assert speaker.reply(received.seal(b"held")) == b"held"


@pytest.fixture
def foreign(tmp_path: Path) -> TestAuthority:
    """An authority with the same names that nobody trusts."""
    return make_authority(tmp_path / "foreign")


@pytest.mark.fault(
    "a command with a certificate that has expired, is foreign, is for servers only, or none", "it is not proven"
)
def test_a_certificate_that_is_not_to_be_trusted_proves_nothing(
    authority: TestAuthority, listener: CommandListener, foreign: TestAuthority
) -> None:
    expired = authority.credentials(authority.sign("operator", "expired", days=-1))
    servers = authority.credentials(authority.sign("operator", "servers", uses="extendedKeyUsage=serverAuth\n"))
    other = foreign.credentials("operator")
    stranger = Credentials(other.certificate, other.private_key, authority.root)
    for credentials, why in ((expired, "expired"), (servers, "purpose"), (stranger, "issuer")):
        with pytest.raises(NotProvenError, match=f"rejected: .*{why}"):
            reported(listener, credentials)


def test_without_a_certificate_nothing_is_proven(
    authority: TestAuthority, listener: CommandListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ssl.SSLContext, "load_cert_chain", lambda *_, **__: None)
        speaker = CommandSender(authority.credentials("operator"), "vehicle")
    last = speaker.send(flight(listener.receive("1", speaker.first_flight())), TEXT)
    with pytest.raises(NotProvenError, match="did not return a certificate"):
        listener.receive("1", last)


def test_a_certificate_with_two_names_is_nobodys(authority: TestAuthority, listener: CommandListener) -> None:
    both = authority.credentials(authority.sign("operator/CN=viewer", "both", uses="extendedKeyUsage=clientAuth\n"))
    with pytest.raises(NotProvenError, match="2 common names"):
        reported(listener, both)


@pytest.mark.fault(
    "somebody else answers a proven command in the service's place", "the pretender learns nothing of the command"
)
def test_who_is_not_the_service_learns_nothing(authority: TestAuthority, foreign: TestAuthority) -> None:
    for pretender, why in (
        (CommandListener(authority.credentials("router")), "certificate of 'router', not that of 'vehicle'"),
        (CommandListener(authority.credentials("viewer")), "purpose"),
        (CommandListener(foreign.credentials("vehicle")), "issuer|self-signed"),
    ):
        speaker = CommandSender(authority.credentials("operator"), "vehicle")
        answer = flight(pretender.receive("1", speaker.first_flight()))
        with pytest.raises(NotProvenError, match=why):
            speaker.send(answer, TEXT)


@pytest.mark.fault("a proven command that is changed, cut or repeated on its way", "the command is not heard")
def test_what_was_changed_cut_or_repeated_is_not_received(authority: TestAuthority) -> None:
    chance = random.Random(0)
    received = 0
    for trial in range(60):
        listener = CommandListener(authority.credentials("vehicle"))
        speaker = CommandSender(authority.credentials("operator"), "vehicle")
        last = bytearray(speaker.send(flight(listener.receive("1", speaker.first_flight())), TEXT))
        if trial % 3 == 0:
            del last[chance.randrange(len(last)) :]
        else:
            last[chance.randrange(len(last))] ^= 1 << chance.randrange(8)
        try:
            received += end(listener.receive("1", bytes(last))).payload != TEXT
        except NotProvenError:
            continue
        received += 1
    assert received == 0


def test_a_conversation_that_was_recorded_cannot_be_played_again(
    authority: TestAuthority, listener: CommandListener
) -> None:
    speaker = CommandSender(authority.credentials("operator"), "vehicle")
    hello = speaker.first_flight()
    last = speaker.send(flight(listener.receive("1", hello)), TEXT)
    assert end(listener.receive("1", last)).payload == TEXT
    for recorded in (last, hello + last):
        with pytest.raises(NotProvenError):
            end(listener.receive("1", recorded))
    flight(listener.receive("2", hello))
    with pytest.raises(NotProvenError):
        listener.receive("2", last)


def test_an_answer_that_is_not_the_services_is_not_taken(authority: TestAuthority, listener: CommandListener) -> None:
    received, speaker = reported(listener, authority.credentials("operator"))
    sealed = bytearray(received.seal(b"held"))
    sealed[-1] ^= 1
    with pytest.raises(NotProvenError):
        speaker.reply(bytes(sealed))


def test_rubbish_is_no_conversation(listener: CommandListener) -> None:
    chance = random.Random(1)
    for size in (0, 1, 5, 300, 20_000):
        for head in (b"", b"\x16\x03\x01", b"\x16\x03\x01\x00\x05\x01\x00"):
            with pytest.raises(NotProvenError):
                listener.receive("1", head + chance.randbytes(size))


def test_what_takes_too_long_is_not_received(authority: TestAuthority) -> None:
    clock = Clock()
    listener = CommandListener(authority.credentials("vehicle"), clock)
    speaker = CommandSender(authority.credentials("operator"), "vehicle")
    last = speaker.send(flight(listener.receive("1", speaker.first_flight())), TEXT)
    clock.now_s = SECOND_QUERY_S + 0.1
    with pytest.raises(NotProvenError):
        listener.receive("1", last)


@pytest.mark.fault(
    "conversations that are begun and never ended",
    "their number is bounded; a client that was let in is heard to the end",
)
def test_conversations_that_never_end_keep_nobody_out(authority: TestAuthority) -> None:
    credentials = authority.credentials("operator")
    hello = CommandSender(credentials, "vehicle").first_flight()
    clock = Clock()
    listener = CommandListener(authority.credentials("vehicle"), clock)
    let_in = CommandSender(credentials, "vehicle")
    answer = flight(listener.receive("let in", let_in.first_flight()))
    for number in range(MAX_HANDSHAKES - 1):
        flight(listener.receive(f"flood {number}", hello))
    with pytest.raises(TooManyHandshakesError):
        listener.receive("one more", hello)
    received = listener.receive("let in", let_in.send(answer, TEXT))
    assert isinstance(received, AuthenticatedCommand)
    assert received.payload == TEXT
    clock.now_s = MIN_HANDSHAKE_AGE_S + 0.1
    for number in range(10):
        flight(listener.receive(f"later {number}", hello))
    assert len(listener._pending) == MAX_HANDSHAKES


def test_files_that_cannot_be_used_are_named_and_not_shown(authority: TestAuthority, tmp_path: Path) -> None:
    own = authority.credentials("vehicle")
    locked = tmp_path / "locked.pem"
    command = ["openssl", "ec", "-in", str(own.private_key), "-aes256", "-passout", "pass:secret", "-out", str(locked)]
    subprocess.run(command, check=True, capture_output=True)
    absent, rubbish = tmp_path / "absent.pem", tmp_path / "rubbish.pem"
    rubbish.write_text("c2VjcmV0")
    for wrong, named in (
        (Credentials(own.certificate, authority.credentials("viewer").private_key, own.root_ca), "mismatch"),
        (Credentials(own.certificate, locked, own.root_ca), str(locked)),
        (Credentials(absent, own.private_key, own.root_ca), str(absent)),
        (Credentials(own.certificate, own.private_key, rubbish), str(rubbish)),
        (Credentials(own.certificate, own.private_key, absent), "No such file"),
    ):
        with pytest.raises(ConfigError) as refused:
            CommandListener(wrong)
        assert named in str(refused.value)
        assert "c2VjcmV0" not in str(refused.value)


@pytest.mark.fault(
    "certificates are renewed while a conversation is under way",
    "it ends as it began; later ones use the new certificates",
)
def test_certificates_are_renewed_while_a_conversation_is_under_way(
    authority: TestAuthority, listener: CommandListener, foreign: TestAuthority
) -> None:
    speaker = CommandSender(authority.credentials("operator"), "vehicle")
    last = speaker.send(flight(listener.receive("before", speaker.first_flight())), TEXT)
    renewed = listener.renewed(foreign.credentials("vehicle"))
    assert end(renewed.receive("before", last)).sender == "operator"
    assert reported(renewed, foreign.credentials("operator"))[0].sender == "operator"
    with pytest.raises(NotProvenError):
        reported(renewed, authority.credentials("operator"))
    assert renewed.digest != listener.digest == CommandListener(authority.credentials("vehicle")).digest


def test_certificates_that_cannot_be_used_renew_nothing(authority: TestAuthority, listener: CommandListener) -> None:
    absent = Credentials(authority.folder / "absent.pem", authority.folder / "absent.pem", authority.root)
    with pytest.raises(ConfigError, match=r"absent\.pem"):
        listener.renewed(absent)
    assert reported(listener, authority.credentials("operator"))[0].sender == "operator"


def test_more_than_one_record_is_not_reported(authority: TestAuthority, listener: CommandListener) -> None:
    speaker = CommandSender(authority.credentials("operator"), "vehicle")
    arrived = flight(listener.receive("1", speaker.first_flight()))
    with pytest.raises(NotProvenError, match="more than 16384 bytes"):
        speaker.send(arrived, bytes(command_auth.MAX_PAYLOAD_BYTES + 1))
