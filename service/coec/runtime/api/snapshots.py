"""Replies that are serialised in advance."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
from pydantic import BaseModel

from coec.adapters.zenoh.bus import JSON, MSGPACK, Answer
from coec.schemas.base import to_json, to_msgpack
from coec.schemas.keys import Format


@dataclass(frozen=True, slots=True)
class SerializedReply:
    """A reply in both encodings, serialised before anyone asks."""

    msgpack: bytes
    json: bytes

    @classmethod
    def of(cls, model: BaseModel) -> SerializedReply:
        """Both encodings of the model."""
        return cls(to_msgpack(model), to_json(model))

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> SerializedReply:
        """Both encodings of JSON-like values that have no model of their own."""
        text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        return cls(msgpack.packb(json.loads(text)), text.encode())

    def answer(self, form: Format) -> Answer:
        """The reply in the encoding that was asked for."""
        return Answer(self.json, JSON) if form == "json" else Answer(self.msgpack, MSGPACK)


def answer_of(model: BaseModel, form: Format) -> Answer:
    """A model in the encoding that was asked for."""
    return Answer(to_json(model), JSON) if form == "json" else Answer(to_msgpack(model), MSGPACK)
