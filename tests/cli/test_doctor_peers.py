"""`coec doctor` beside nodes with rmw_zenoh's default settings: it says what the service receives, whatever the session
of the service and the router are like."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import zenoh

from coec.cli.doctor import examine
from coec.schemas.documents import Finding
from conftest import REPOSITORY
from support import ros
from support.ros import RosDriver
from support.router import free_port

SECONDS = 0.5
CAMERA, POINTS = "/camera/image_raw/compressed", "/points"
TOPICS = {CAMERA: "CompressedImage", POINTS: "PointCloud2"}

DEAF = {"mode": "peer"}
GOSSIPS = {
    "mode": "peer",
    "listen": {"endpoints": ["tcp/localhost:0"]},
    "scouting": {"gossip": {"enabled": True}},
}

Opened = Callable[[str], AbstractContextManager[zenoh.Session]]


@contextmanager
def shipped(endpoint: str, *, gossip: bool = True) -> Iterator[zenoh.Session]:
    settings = zenoh.Config.from_file(REPOSITORY / "deploy" / "router.json5")
    settings.insert_json5("listen/endpoints", json.dumps([endpoint]))
    settings.insert_json5("scouting/gossip/enabled", json.dumps(gossip))
    with zenoh.open(settings) as session:
        yield session


def silent_router(endpoint: str) -> AbstractContextManager[zenoh.Session]:
    """The shipped rules as they were, without gossip: peers do not learn of each other."""
    return shipped(endpoint, gossip=False)


@contextmanager
def sending(endpoint: str) -> Iterator[None]:
    """A node whose camera and LiDAR send until the end of the block."""
    end = threading.Event()
    with ros.rmw_node(endpoint) as session:
        drivers = [RosDriver(session, topic, kind, 10 * n) for n, (topic, kind) in enumerate(TOPICS.items(), start=1)]

        def send() -> None:
            while not end.wait(0.05):
                for driver in drivers:
                    driver.put(b"frame")

        thread = threading.Thread(target=send)
        thread.start()
        try:
            yield
        finally:
            end.set()
            thread.join()
            for driver in drivers:
                driver.close()


def result(folder: Path, endpoint: str, session: Mapping[str, object] | None) -> Sequence[Finding]:
    """What the doctor finds for the eight lines of a ROS vehicle, with this Zenoh file."""
    file = folder / "session.json5"
    if session is not None:
        file.write_text(json.dumps({"connect": {"endpoints": [endpoint]}, **session}))
    connection = f"connect: [{endpoint}]" if session is None else f"file: {file}"
    path = folder / "coec.yaml"
    path.write_text(
        f"""vehicle: shuttle-7
zenoh: {{{connection}}}
state: {{directory: {folder / "state"}}}
middleware: rmw_zenoh
pairs:
  - name: front
    camera: {CAMERA}
    points: {POINTS}
    T_camera_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
"""
    )
    return list(examine(path, SECONDS))


def of(findings: Sequence[Finding], check: str, where: str | None = None) -> Finding:
    (one,) = [one for one in findings if one.check == check and where in (None, one.where)]
    return one


@pytest.mark.parametrize(
    ("router", "session"),
    [
        (ros.rmw_router, None),
        (ros.rmw_router, GOSSIPS),
        (shipped, None),
        (shipped, GOSSIPS),
        (silent_router, None),
    ],
    ids=["client, rmw_zenoh's", "peer, rmw_zenoh's", "client, shipped", "peer, shipped", "client, no gossip"],
)
def test_what_the_service_receives_is_in_order(
    router: Opened, session: Mapping[str, object] | None, tmp_path: Path
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with router(endpoint), sending(endpoint):
        findings = result(tmp_path, endpoint, session)
    for topic in TOPICS:
        stream = of(findings, "stream", topic)
        assert (stream.level, "Hz" in stream.text) == ("ok", True), stream
    assert [of(findings, check).level for check in ("mode", "rules", "topics")] == ["ok", "ok", "ok"]
    absent = of(findings, "stream", "/camera/camera_info")
    assert (absent.level, absent.text) == (
        "fail",
        "awaited: no sample in 0.5 s: no publisher of /camera/camera_info",
    )


@pytest.mark.fault(
    "a Zenoh file that makes the service a peer, to which the router hands nothing from nodes of rmw_zenoh",
    "the doctor says that nothing comes though it is sent, why, and what to change",
)
@pytest.mark.parametrize(
    ("router", "session", "cause", "way_out"),
    [
        (
            ros.rmw_router,
            DEAF,
            "a peer without gossip",
            "`mode`, `listen` and `scouting` out of zenoh.file",
        ),
        (shipped, DEAF, "a peer without gossip", "so that the service is a client"),
        (silent_router, GOSSIPS, "it is not connected to them", "enable gossip at the router"),
    ],
    ids=["rmw_zenoh's", "shipped", "no gossip at the router"],
)
def test_what_the_service_does_not_receive_has_its_cause(
    router: Opened, session: Mapping[str, object], cause: str, way_out: str, tmp_path: Path
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with router(endpoint), sending(endpoint):
        findings = result(tmp_path, endpoint, session)
    for topic in TOPICS:
        stream = of(findings, "stream", topic)
        assert stream.level == "fail"
        assert "no sample in 0.5 s, while a client of the same router got" in stream.text
        assert cause in stream.text
        assert way_out in str(stream.advice)
    assert [cause in one.text for one in findings if one.check == "topics"] == [False, True]
    assert of(findings, "mode").level == ("warn" if session is DEAF else "ok")


def test_the_service_that_runs_is_not_disturbed_by_a_second_session_of_its_settings(tmp_path: Path) -> None:
    """Its id and its port are taken."""
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    own = GOSSIPS | {"id": "c0ec", "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}
    taken = {
        "mode": "peer",
        "id": "c0ec",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "connect/endpoints": [endpoint],
    }
    with (
        ros.rmw_router(endpoint) as router,
        zenoh.open(ros.rmw_settings(ros.RMW_SESSION, taken)) as service,
        sending(endpoint),
    ):
        findings = result(tmp_path, endpoint, own)
        assert service.info.zid() in list(router.info.peers_zid())
    assert of(findings, "stream", CAMERA).level == "ok"
