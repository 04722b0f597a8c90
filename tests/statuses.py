"""What a service says of itself, for tests of who reads it."""

from __future__ import annotations

from typing import Any

from coec.schemas.replies import StatusReply, StorageStatus, WorkerStatus


def status_reply(**fields: Any) -> StatusReply:
    """Of a service that runs without pairs and has nothing to do; `told` is what is otherwise."""
    return StatusReply(
        **{
            "version": "0",
            "vehicle": "vehicle",
            "state": "running",
            "started_ns": 0,
            "uptime_s": 1.0,
            "config_hash": "0",
            "pairs": (),
            "worker": WorkerStatus(state="idle"),
            "storage": StorageStatus(bytes_used=0, bytes_free=0),
            **fields,
        }
    )
