"""Receives commands: authenticates the sender, checks whether he may give the command and what its payload holds, and
has it carried out. One thread. Who may give which command is checked for each command, whatever the router let
through (`config.AuthorityConfig`).
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import msgpack
from pydantic import BaseModel

from coec.config import AuthorityConfig
from coec.errors import CoecError, NotProvenError, UsageError
from coec.io.zenoh.bus import Answer, Request
from coec.io.zenoh.command_auth import AuthenticatedCommand, CommandListener
from coec.schemas.commands import COMMAND_NAMES, MAX_REASON, REASON, ProvenCommand, arguments_of
from coec.schemas.keys import RIG, CommandSelector, parse_command_selector
from coec.schemas.message import from_json
from coec.service.api.command_execution import PairCommands, RigCommands
from coec.service.api.reply_builders import answer_of


class NotAllowedError(CoecError):
    """The sender may not give this command."""

    reply_code = "not_allowed"


class Authority:
    """Decides who may command a vehicle."""

    def __init__(self, config: AuthorityConfig, external_access: Callable[[], str | None]) -> None:
        """`external_access()` says in a clause why programs on other computers can reach the service; None: they
        cannot."""
        self._config = config
        self._allowed = {sender.name: frozenset(sender.commands) for sender in config.senders}
        self._external_access = external_access

    @property
    def senders(self) -> tuple[str, ...]:
        """The names whose owners may give commands once they have proven them."""
        return tuple(self._allowed)

    def require(self, name: str | None, command: str) -> None:
        """Returns if the sender may give the command. `name` is the name that he has proven; None: he has proven none.

        Raises:
            NotAllowedError: he may not give it.
        """
        if name is None:
            self._require_anonymous(command)
        elif name not in self._allowed:
            raise NotAllowedError(f"{name!a} may give no commands: `authority.senders` does not name this certificate")
        elif command not in self._allowed[name]:
            may = ", ".join(sorted(self._allowed[name]))
            raise NotAllowedError(f"{name!a} may not `{command}`, only {may} (`authority.senders`)")

    def _require_anonymous(self, command: str) -> None:
        if self._config.anonymous == "always":
            return
        why = "`authority.anonymous` is `never`"
        if self._config.anonymous == "loopback":
            external_access = self._external_access()
            if external_access is None:
                return
            why = f"other computers may reach the service: {external_access}"
        raise NotAllowedError(
            f"`{command}` needs an authenticated sender: {why}. Give it with a certificate that "
            "`authority.senders` names (`coec query --zenoh FILE`)"
        )


MAX_SENDER: Final = 96
"""Most characters of a sender in log and history."""

MAX_PAYLOAD: Final = 4096
"""Largest payload, bytes. coec's own have less than 100; a JSON message of 32 MB would unpack to a gigabyte."""

MAX_ATTACHMENT: Final = 4096
"""How many bytes of an attachment are read."""

ANONYMOUS: Final = "anonymous"
"""Name of a sender that does not name itself."""

_HARMLESS = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789 ._:/@+-=,")


def parse_payload(name: str, payload: bytes, *, for_rig: bool = False) -> dict[str, Any]:
    """The arguments of a command for a pair or for the rig. A payload is empty, or a map in msgpack or JSON.

    Raises:
        UsageError: no such command, or the payload does not hold the arguments that it takes.
    """
    if name not in COMMAND_NAMES:
        raise UsageError(f"no such command; known: {', '.join(COMMAND_NAMES)}")
    known = {argument.name: argument.kind for argument in arguments_of(name, for_rig=for_rig)}
    document = _document(payload)
    for key, value in document.items():
        if key not in known:
            takes = ", ".join(known) or "no arguments"
            raise UsageError(f"`{name}` takes {takes}")
        if not isinstance(value, known[key]):
            raise UsageError(f"argument `{key}` of `{name}` must be of type {known[key].__name__}")
    if REASON.name in document:
        document[REASON.name] = _one_line(document[REASON.name])
    return document


def sender_of(attachment: bytes | None) -> str:
    """The attachment of a query as one short harmless line. If it is no readable text, the line shows its hash."""
    if not attachment:
        return ANONYMOUS
    start = attachment[:MAX_ATTACHMENT]
    text = start.decode("ascii", errors="replace")
    cleaned = "".join(character if character in _HARMLESS else "_" for character in text)
    if 2 * cleaned.count("_") > len(cleaned):
        return f"{len(attachment)} bytes, sha256 {hashlib.sha256(start).hexdigest()[:16]}"
    return cleaned[:MAX_SENDER]


def proven_sender(name: str) -> str:
    """A sender whose certificate has this common name, as one short harmless line that no attachment can imitate."""
    return f"{sender_of(name.encode('ascii', errors='replace'))} (certificate)"


def _one_line(reason: str) -> str:
    """The words of a person as one line without control characters.

    Raises:
        UsageError: the line is too long.
    """
    line = " ".join("".join(letter if letter.isprintable() else " " for letter in reason).split())
    if len(line) > MAX_REASON:
        raise UsageError(f"argument `reason` has {len(line)} characters: give {MAX_REASON} at most")
    return line


def _document(payload: bytes) -> dict[str, Any]:
    if not payload:
        return {}
    if len(payload) > MAX_PAYLOAD:
        raise UsageError(f"the payload has more than {MAX_PAYLOAD} bytes")
    try:
        document = (
            json.loads(payload)
            if payload[:1] == b"{"
            else msgpack.unpackb(payload, max_map_len=8, max_str_len=MAX_PAYLOAD)
        )
    except (ValueError, RecursionError, msgpack.UnpackException) as error:
        raise UsageError("the payload is neither a map in msgpack nor in JSON") from error
    if not isinstance(document, dict) or not all(isinstance(key, str) for key in document):
        raise UsageError("the payload must be a map of names to values")
    return document


SEALED = "application/octet-stream"
"""Bytes of a TLS conversation."""


@dataclass(frozen=True, slots=True)
class CommandRules:
    """Who may give commands. `listener` is None if the service has no certificate; then nobody can prove his name."""

    authority: Authority
    listener: CommandListener | None

    @property
    def digest(self) -> str | None:
        """Digest of the files of the certificate; None: there is no certificate."""
        return None if self.listener is None else self.listener.digest


class CommandHandler:
    """Takes the commands for all pairs of a vehicle and for their rig."""

    def __init__(
        self,
        rules: CommandRules,
        commands: Mapping[str, PairCommands],
        rig: RigCommands | None = None,
    ) -> None:
        """`commands` are those of each pair, and may be replaced while queries come; `rig` are those for all pairs."""
        self._pairs = commands
        self._rig = rig
        self.reconfigure(rules)

    def reconfigure(self, rules: CommandRules) -> None:
        """Applies these rules from the next command on. For any thread."""
        proven = [proven_sender(name) for name in rules.authority.senders]
        for commands in self._pairs.values():
            commands.reserve_for(proven)
        self._rules = rules

    def handle(self, pair: str, name: str, request: Request) -> Answer:
        """The answer to a query for `command/<name>`.

        Raises:
            UsageError: no such command, or it does not fit the grammar.
            NotAllowedError: the sender may not give it.
            NotProvenError: the sender has tried to prove his name and failed.
        """
        selector, rules = parse_command_selector(request.parameters), self._rules
        if selector.conversation is None:
            claimed = sender_of(request.attachment)
            done = self._execute(rules, pair, name, None, claimed, request.payload, request.received_s, selector)
            return answer_of(done, selector.format)
        if rules.listener is None:
            raise NotProvenError(
                "this service has no certificate (`authority.certificate`), so that nobody can prove his name to it: "
                "give the command as `--anonymous`, if that is allowed here"
            )
        try:
            received = rules.listener.receive(selector.conversation, request.payload)
        except NotProvenError as error:
            self._of(pair).note_refused(name, sender_of(request.attachment), error)
            raise
        return (
            Answer(received, SEALED)
            if isinstance(received, bytes)
            else self._answer_authenticated(rules, pair, name, received, request)
        )

    def _of(self, pair: str) -> PairCommands | RigCommands:
        return self._rig if pair == RIG and self._rig is not None else self._pairs[pair]

    def _answer_authenticated(
        self, rules: CommandRules, pair: str, name: str, authenticated: AuthenticatedCommand, request: Request
    ) -> Answer:
        call = from_json(ProvenCommand, authenticated.payload)
        key, _, parameters = call.selector.partition("?")
        if key != request.key:
            raise UsageError("the authenticated message is not the requested command")
        selector = parse_command_selector(parameters)
        sender = proven_sender(authenticated.sender)
        done = self._execute(
            rules, pair, name, authenticated.sender, sender, call.payload.encode(), request.received_s, selector
        )
        return Answer(authenticated.seal(answer_of(done, selector.format).payload), SEALED)

    def _execute(
        self,
        rules: CommandRules,
        pair: str,
        name: str,
        proven: str | None,
        sender: str,
        payload: bytes,
        received_s: float,
        selector: CommandSelector,
    ) -> BaseModel:
        commands = self._of(pair)
        arguments = parse_payload(name, payload, for_rig=pair == RIG)
        try:
            rules.authority.require(proven, name)
        except NotAllowedError as error:
            commands.note_refused(name, sender, error)
            raise
        return commands.carry_out(name, arguments, sender, received_s + selector.timeout_ms / 1e3)
