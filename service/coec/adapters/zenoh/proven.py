"""A command whose sender proves who he is to the service, and the service to him, whatever router is in between."""

from __future__ import annotations

import secrets

import zenoh

from coec.adapters.tls.conversation import NotProvenError, Speaker
from coec.adapters.zenoh.client import Reply, ask_one
from coec.schemas.base import to_json
from coec.schemas.commands import ProvenCommand


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
    flight = ask_one(session, conversation, timeout_s, speaker.hello()).payload
    said = ProvenCommand(selector=selector, payload=(payload or b"").decode())
    sealed = ask_one(session, conversation, timeout_s, speaker.say(flight, to_json(said))).payload
    answer = speaker.answer(sealed)
    if not answer:
        raise NotProvenError("the service broke the conversation off")
    return Reply(key, answer, encoding)
