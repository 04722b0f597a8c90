"""Takes commands as they come in: finds out who gives them, whether he may, and what they say; then has them carried
out. One thread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import BaseModel

from coec.adapters.tls.conversation import AuthenticatedCommand, CommandListener
from coec.adapters.zenoh.bus import Answer, Request
from coec.errors import NotProvenError, UsageError
from coec.runtime.api import payloads
from coec.runtime.api.authority import Authority, NotAllowedError
from coec.runtime.api.awaited import PendingPairCommands
from coec.runtime.api.commands import Commands
from coec.runtime.api.rig_commands import RigCommands
from coec.runtime.api.snapshots import answer_of
from coec.schemas.base import from_json
from coec.schemas.commands import ProvenCommand
from coec.schemas.keys import RIG, CommandSelector, parse_command_selector

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
        commands: Mapping[str, Commands | PendingPairCommands],
        rig: RigCommands | None = None,
    ) -> None:
        """`commands` are those of each pair, and may be replaced while queries come; `rig` are those for all pairs."""
        self._pairs = commands
        self._rig = rig
        self.reconfigure(rules)

    def reconfigure(self, rules: CommandRules) -> None:
        """Applies these rules from the next command on. For any thread."""
        proven = [payloads.proven_sender(name) for name in rules.authority.senders]
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
            claimed = payloads.sender_of(request.attachment)
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
            self._of(pair).note_refused(name, payloads.sender_of(request.attachment), error)
            raise
        return (
            Answer(received, SEALED)
            if isinstance(received, bytes)
            else self._answer_authenticated(rules, pair, name, received, request)
        )

    def _of(self, pair: str) -> Commands | PendingPairCommands | RigCommands:
        return self._rig if pair == RIG and self._rig is not None else self._pairs[pair]

    def _answer_authenticated(
        self, rules: CommandRules, pair: str, name: str, authenticated: AuthenticatedCommand, request: Request
    ) -> Answer:
        call = from_json(ProvenCommand, authenticated.payload)
        key, _, parameters = call.selector.partition("?")
        if key != request.key:
            raise UsageError("what was said in the conversation is not the command that was asked for")
        selector = parse_command_selector(parameters)
        sender = payloads.proven_sender(authenticated.sender)
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
        arguments = payloads.parse_payload(name, payload, for_rig=pair == RIG)
        try:
            rules.authority.require(proven, name)
        except NotAllowedError as error:
            commands.note_refused(name, sender, error)
            raise
        return commands.carry_out(name, arguments, sender, received_s + selector.timeout_ms / 1e3)
