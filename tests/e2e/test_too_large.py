"""A message larger than Zenoh takes in is dropped by Zenoh, in the router or in the service's own session, and neither
logs it: what can be known of it all the same."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from coec.config import LimitsConfig, ZenohConfig
from coec.io.msgpack_frames import encode_camera, encode_lidar
from coec.io.zenoh.bus import MSGPACK, on_key
from coec.io.zenoh.query_client import connected
from coec.io.zenoh.ros_node import has_subscribers
from coec.io.zenoh.session import settings_of
from coec.schemas.replies import StreamStatus
from support.fake_worker import wait_until
from support.router import free_port
from support.vehicles import BEGIN_S, NS_PER_S, frame_pair_at, serving

PATIENCE_S = 20.0
TOO_LARGE = 100_000_000
PAIRS, DROPPED = 30, 5
"""A gap is certain once 16 frames have come behind it."""


@contextmanager
def router(endpoint: str, max_bytes: int) -> Iterator[None]:
    settings = settings_of(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig())
    settings.insert_json5("transport/link/rx/max_message_size", json.dumps(max_bytes))
    with zenoh.open(settings):
        yield


@pytest.mark.fault(
    "a message of 100 MB, which Zenoh drops and does not log, whether in the router or in the service",
    "a numbered stream shows a gap; a stream without numbers is noticed by its partner: an unpaired "
    "sweep, or a surplus picture",
)
@pytest.mark.parametrize(
    ("limit", "stream", "numbered", "counted"),
    [
        (LimitsConfig().max_message_bytes, "lidar", True, {"camera": {"surplus": 1}, "lidar": {"sequence_gap": 1}}),
        pytest.param(
            *(2**30, "camera", False, {"camera": {}, "lidar": {"unpaired": 1}}),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["in a router of the shipped limit", "behind a router of Zenoh's own"],
)
def test_what_zenoh_drops_is_counted_as_far_as_it_can_be_known(
    tmp_path: Path,
    limit: int,
    stream: str,
    numbered: bool,
    counted: dict[str, dict[str, int]],
    record_property: Callable[[str, object], None],
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        router(endpoint, limit),
        serving(tmp_path, ZenohConfig(connect=(endpoint,))) as vehicle,
        connected([endpoint], PATIENCE_S) as session,
    ):
        publishers = {}
        for known, take in vehicle.bench.vehicle.new_streams():
            vehicle.bus.subscribe(on_key(known.place), take)
        for name in counted:
            block = zenoh.CongestionControl.BLOCK
            publishers[name] = session.declare_publisher(f"in/{name}", congestion_control=block)
        wait_until(lambda: all(map(has_subscribers, publishers.values())), "the service", PATIENCE_S)

        def reported() -> dict[str, StreamStatus]:
            status = vehicle.bench.answers.status()
            return {"camera": status.camera, "lidar": status.lidar}

        for number in range(PAIRS):
            pair, sequence = frame_pair_at(BEGIN_S * NS_PER_S + number * NS_PER_S // 10), number if numbered else None
            frames = {
                "camera": encode_camera(replace(pair.camera, sequence=sequence)),
                "lidar": encode_lidar(replace(pair.lidar, sequence=sequence)),
            }
            if number == DROPPED:
                frames[stream] = bytes(TOO_LARGE)
            for name, payload in frames.items():
                publishers[name].put(payload, encoding=MSGPACK)
            expected = {name: number + 1 - (name == stream and number >= DROPPED) for name in frames}

            def taken(expected: dict[str, int] = expected) -> bool:
                return {name: one.received for name, one in reported().items()} == expected

            wait_until(taken, f"pair {number}", PATIENCE_S)
        wait_until(lambda: {name: one.losses for name, one in reported().items()} == counted, f"{counted}", PATIENCE_S)
    record_property("figure", ", ".join(f"{name} {causes}" for name, causes in counted.items() if causes))
