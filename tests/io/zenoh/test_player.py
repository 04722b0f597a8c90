"""What is played on topics, as nodes that come later see it."""

from __future__ import annotations

import queue
import threading

import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from coec.config import LimitsConfig, ZenohConfig
from coec.io.ros.messages import TF
from coec.io.ros.topics import TopicMessage
from coec.io.zenoh.bus import open_session
from coec.io.zenoh.player import TopicPlayer, dialect_of
from coec.schemas.keys import TF_STATIC
from support.router import free_port

SECONDS = 20.0


def test_who_comes_later_gets_every_static_transform_of_the_recording() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = ZenohConfig(embedded_router=True, listen=(endpoint,))
    with (
        open_session(router, LimitsConfig()) as session,
        open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()) as late,
    ):
        player = TopicPlayer(session, dialect_of("rmw_zenoh", session, 7, ""), {TF_STATIC: TF})
        joints = [TopicMessage(n, TF_STATIC, TF, bytes([n])) for n in range(3)]
        player.play(joints, 0.0, threading.Event(), lambda *_: None)
        samples: queue.Queue[zenoh.Sample] = queue.Queue()
        declare_advanced_subscriber(
            late,
            "7/tf_static/*/*",
            zenoh.handlers.Callback(samples.put, indirect=False),
            history=HistoryConfig(detect_late_publishers=True, max_samples=100),
            recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )
        assert [samples.get(timeout=SECONDS).payload.to_bytes() for _ in joints] == [b"\0", b"\1", b"\2"]
        player.close()
