"""A command whose sender proves who he is to the service, and the service to him, whatever router is in between."""

from __future__ import annotations

import secrets
import time

import zenoh

from coec.adapters.tls.conversation import Speaker
from coec.adapters.zenoh.client import Reply, ask_one
from coec.errors import NotProvenError, RemoteError
from coec.schemas.base import to_json
from coec.schemas.commands import ProvenCommand

BUSY = "busy"
"""Code of an error reply: too many queries wait."""

PAUSE_S = 0.05
"""Before a busy service is asked again; it is through with a full queue of beginnings in about that time."""


def give(
    session: zenoh.Session, selector: str, payload: bytes | None, timeout_s: float, speaker: Speaker, encoding: str
) -> Reply:
    """The acknowledgement of a command, of which only the service can be the author.

    Args:
        selector: key and parameters of the command, as without proof.
        encoding: of the acknowledgement, as the parameters ask for it.

    Raises:
        NotFoundError: nobody answered.
        RemoteError: an error reply. These carry no proof: whoever is in between can always refuse.
        NotProvenError: whoever answered is not the service.
    """
    key = selector.partition("?")[0]
    conversation = f"{key}?tls={secrets.token_hex(16)};format=json"
    flight = _told(session, conversation, timeout_s, speaker.hello())
    said = ProvenCommand(selector=selector, payload=(payload or b"").decode())
    sealed = _told(session, conversation, timeout_s, speaker.say(flight, to_json(said)))
    answer = speaker.answer(sealed)
    if not answer:
        raise NotProvenError("the service broke the conversation off")
    return Reply(key, answer, encoding)


def _told(session: zenoh.Session, conversation: str, timeout_s: float, goes: bytes) -> bytes:
    """The answer to the next bytes. A service that is busy is told them again: a conversation is heard to its end once,
    so that nothing is done twice, whoever said that it is busy."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            return ask_one(session, conversation, timeout_s, goes).payload
        except RemoteError as error:
            if error.reply_code != BUSY or time.monotonic() + PAUSE_S > deadline_s:
                raise
        time.sleep(PAUSE_S)
