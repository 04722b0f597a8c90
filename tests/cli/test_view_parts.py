"""What the timeline says of a service, and which frames of a vehicle are shown. Needs no viewer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli.vehicle_on_screen import PAIR, RIG, configuration, extrinsic, health
from coec.cli.view import ListenAddress, listen_address
from coec.cli.view import sources as view_vehicle
from coec.cli.view.sources import (
    DEPTHS,
    SILENT_S,
    SensorStreams,
    ServiceState,
    extrinsics_of_service,
    moment_of_service,
)
from coec.config import load_config
from coec.errors import UsageError
from coec.io.msgpack_frames import encode_camera, encode_lidar
from coec.io.viewer_scene import DisplayedPose
from coec.io.zenoh.bus import MSGPACK
from coec.schemas.message import from_msgpack
from coec.schemas.replies import ExtrinsicReply, HealthReply
from e2e.processes import Router
from support.fake_worker import wait_until
from support.scenes import BOARD_MOVED, BOARD_NOMINAL

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

REPORTED = ServiceState(
    alive=True,
    answer_age_s=1.0,
    health=from_msgpack(HealthReply, health("miscalibrated")),
    extrinsic=from_msgpack(ExtrinsicReply, extrinsic(BOARD_MOVED)),
    served=BOARD_MOVED,
)


def reported(message: ServiceState) -> tuple[str, int, tuple[str, ...]]:
    moment = moment_of_service("front", message, {}, Counter())
    return moment.state, moment.level, moment.reasons


def test_who_does_not_answer_is_silent_and_who_is_not_there_serves_nothing() -> None:
    assert reported(REPORTED) == ("miscalibrated", 2, ("moved",))
    assert reported(replace(REPORTED, answer_age_s=SILENT_S + 0.1)) == ("silent", 3, ("silent",))
    assert reported(replace(REPORTED, alive=False)) == ("not_served", 3, ("not_served",))
    assert reported(ServiceState(alive=True)) == ("silent", 3, ("silent",))
    assert reported(ServiceState()) == ("not_served", 3, ("not_served",))


def test_what_is_not_known_is_not_rendered_and_this_is_reported() -> None:
    nothing = extrinsics_of_service(RIG, ServiceState())
    assert nothing[DisplayedPose.SERVED].T_camera_lidar is None
    assert nothing[DisplayedPose.SERVED].title == "served: not known, not_served"
    np.testing.assert_array_equal(nothing[DisplayedPose.NOMINAL].T_camera_lidar, BOARD_NOMINAL)
    assert nothing[DisplayedPose.CANDIDATE].title == "candidate: none"
    gone = extrinsics_of_service(RIG, replace(REPORTED, alive=False))
    assert gone[DisplayedPose.SERVED].T_camera_lidar is BOARD_MOVED, "the last that is known"
    assert gone[DisplayedPose.SERVED].title == "served: estimated, not_served"


@pytest.fixture
def streams(router: Router, tmp_path: Path) -> Iterator[SensorStreams]:
    config = load_config(configuration(tmp_path, router.endpoint))
    streams = SensorStreams(router.session, config.pairs[0], config)
    streams.listen(enabled=True)
    yield streams
    streams.close()


def send(router: Router, number: int) -> None:
    stamp_ns = 10**18 + number * 10**8
    router.session.put("in/camera", encode_camera(replace(PAIR.camera, stamp_ns=stamp_ns)), encoding=MSGPACK)
    router.session.put("in/lidar", encode_lidar(replace(PAIR.lidar, stamp_ns=stamp_ns)), encoding=MSGPACK)


@pytest.mark.fault("more frames than can be shown", "the newest are shown; the others are passed over and counted")
def test_the_newest_pair_is_shown_and_older_ones_are_passed_over(
    router: Router, streams: SensorStreams, record_property: Record
) -> None:
    count = 40
    for number in range(count):
        send(router, number)
    wait_until(lambda: streams.not_shown["camera", "overrun"] >= count - DEPTHS["camera"], "all of them")
    pair = streams.newest(1.0)
    assert pair is not None
    assert pair.stamp_ns == 10**18 + (count - 1) * 10**8
    assert streams.newest(0.0) is None
    record_property("figure", f"1 of {count} pairs, the newest")


def test_keys_on_which_nothing_comes_are_reported(
    router: Router, streams: SensorStreams, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not streams.mute, "not at once"
    monkeypatch.setattr(view_vehicle, "PATIENCE_S", 0.0)
    assert streams.mute == ("in/camera", "in/lidar")
    router.session.put("in/lidar", b"", encoding=MSGPACK)
    wait_until(lambda: streams.mute == ("in/camera",), "what came")
    streams.listen(enabled=False)
    assert not streams.mute, "nobody looks"


@pytest.mark.parametrize(
    ("address", "host"), [("127.0.0.1:8765", "127.0.0.1"), ("localhost:0", "localhost"), ("[::1]:8765", "::1")]
)
def test_loopback_is_served_without_a_word(address: str, host: str) -> None:
    assert listen_address(address, insecure=False) == ListenAddress(host, int(address.rpartition(":")[2]))


@pytest.mark.parametrize("address", ["0.0.0.0:8765", "[::]:8765", "10.0.0.5:8765", "vehicle.local:8765"])
def test_other_addresses_are_served_only_if_that_is_reported(address: str) -> None:
    with pytest.raises(UsageError, match="--insecure"):
        listen_address(address, insecure=False)
    assert listen_address(address, insecure=True).port == 8765


@pytest.mark.parametrize("address", ["8765", "127.0.0.1", "127.0.0.1:65536", "127.0.0.1:-1", "::1:8765", "a b:1"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="HOST:PORT"):
        listen_address(address, insecure=True)
