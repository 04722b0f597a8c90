"""Last words of vehicles that do not exist, for tests of who keeps and who reads them."""

from __future__ import annotations

from typing import Any

import msgpack

from coec.schemas.base import to_msgpack
from coec.schemas.last_word import LastWord

SENT_NS = 1_700_000_000_000_000_000


def heartbeat(vehicle: str = "vehicle", pair: str = "front", **fields: Any) -> LastWord:
    """Of a healthy pair of a vehicle that runs; `told` is what is otherwise."""
    return LastWord(
        **{
            "vehicle": vehicle,
            "pair": pair,
            "said_ns": SENT_NS,
            "period_s": 60.0,
            "service": "running",
            "version": "1.0",
            "config_hash": "0123456789abcdef",
            "state": "healthy",
            "level": 0,
            "reasons": (),
            "since_ns": SENT_NS - 10**12,
            "age_s": 4.0,
            "drift": (0.01, -0.02, 0.03, 0.001, 0.002, -0.003),
            "drift_sigma": (0.01, 0.01, 0.02, 0.004, 0.004, 0.005),
            "provenance": "commissioned",
            "status": "accepted",
            "correction": (0.1, 0.2, 0.3, 0.01, 0.02, 0.03),
            "sigma": (0.02, 0.02, 0.04, 0.01, 0.01, 0.02),
            "held": False,
            "windows": 12,
            "event": None,
            **fields,
        }
    )


def packed_heartbeat(message: LastWord, **wrong: Any) -> bytes:
    """As it travels; `wrong` is written over it, whatever the model says of that."""
    document = msgpack.unpackb(to_msgpack(message))
    data: bytes = msgpack.packb({**document, **wrong})
    return data
