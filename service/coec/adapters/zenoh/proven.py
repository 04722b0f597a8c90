"""Commands with proof: sender and service prove their names to each other, through any router in between."""

from __future__ import annotations

import secrets
import time

import zenoh

from coec.adapters.tls.conversation import CommandSender
from coec.adapters.zenoh.client import Reply, query_one
from coec.errors import NotProvenError, RemoteError
from coec.schemas.base import to_json
from coec.schemas.commands import ProvenCommand

BUSY_CODE = "busy"
"""Code of an error reply: too many queries wait."""

BUSY_PAUSE_S = 0.05
"""Pause before asking a busy service again; in about that time it works off a full queue of conversations that
begin."""


def send_authenticated(
    session: zenoh.Session,
    selector: str,
    payload: bytes | None,
    timeout_s: float,
    speaker: CommandSender,
    encoding: str,
) -> Reply:
    """Gives a command and returns its acknowledgement, which is proven to come from the service.

    Args:
        selector: key and parameters of the command, as without proof.
        encoding: of the acknowledgement, as the parameters ask for it.

    Raises:
        NotFoundError: nobody answered.
        RemoteError: an error reply. It carries no proof, because a router in between can always refuse.
        NotProvenError: the answer does not come from the service.
    """
    key = selector.partition("?")[0]
    conversation = f"{key}?tls={secrets.token_hex(16)};format=json"
    flight = _exchange(session, conversation, timeout_s, speaker.first_flight())
    command = ProvenCommand(selector=selector, payload=(payload or b"").decode())
    sealed = _exchange(session, conversation, timeout_s, speaker.send(flight, to_json(command)))
    answer = speaker.reply(sealed)
    if not answer:
        raise NotProvenError("the service broke the conversation off")
    return Reply(key, answer, encoding)


def _exchange(session: zenoh.Session, conversation: str, timeout_s: float, outgoing: bytes) -> bytes:
    """The answer to the next bytes. If the service is busy, they are sent again. This is safe even if somebody else
    replied "busy", because the service completes a conversation only once, so that nothing is done twice."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            return query_one(session, conversation, timeout_s, outgoing).payload
        except RemoteError as error:
            if error.reply_code != BUSY_CODE or time.monotonic() + BUSY_PAUSE_S > deadline_s:
                raise
        time.sleep(BUSY_PAUSE_S)
