"""What the service manager and a metrics scraper are told."""

from __future__ import annotations

import io
import json
import logging
import socket
from pathlib import Path

from coec.adapters import metrics
from coec.adapters.logs import JsonFormatter
from coec.adapters.notify import Notifier
from coec.calibration.lifecycle import HealthState
from coec.schemas.replies import PairStatus, StatusReply, StorageStatus, StreamStatus, WorkerStatus


def test_the_manager_is_told_by_datagrams(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        notifier = Notifier.from_environment({"NOTIFY_SOCKET": address})
        notifier.ready()
        notifier.watchdog()
        notifier.stopping()
        assert [manager.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_no_manager_and_a_vanished_one_do_no_harm(tmp_path: Path) -> None:
    Notifier.from_environment({}).ready()
    Notifier(str(tmp_path / "gone")).ready()
    Notifier("@coec-test-nobody-listens").ready()


def test_a_log_record_is_one_line_of_json() -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter())
    logger = logging.Logger("test")
    logger.addHandler(handler)
    logger.warning("two\nlines", extra={"fields": {"pair": "front", "level": "forged"}})
    (line,) = stream.getvalue().splitlines()
    document = json.loads(line)
    assert (document["message"], document["pair"], document["level"]) == ("two\nlines", "front", "warning")


def test_metrics_are_open_metrics_text() -> None:
    status = StatusReply(
        version="1",
        vehicle="test",
        state="running",
        started_ns=0,
        uptime_s=1.5,
        config_hash="c",
        pairs=(PairStatus(name="front", camera=StreamStatus(received=3, losses={"frame_id": 2}), windows=4),),
        worker=WorkerStatus(state="idle", restarts=1),
        storage=StorageStatus(bytes_used=10, bytes_free=20),
    )
    text = metrics.render(status, {"front": HealthState.HEALTHY}, 5).decode()
    for line in (
        'coec_build_info{version="1"} 1',
        'coec_health{pair="front",coec_health="healthy"} 1',
        'coec_health{pair="front",coec_health="stale"} 0',
        'coec_samples_received_total{pair="front",stream="camera"} 3',
        'coec_losses_total{pair="front",place="camera",cause="frame_id"} 2',
        'coec_windows_recorded_total{pair="front"} 4',
        "coec_worker_restarts_total 1",
        "coec_uptime_seconds 1.5",
    ):
        assert line in text.splitlines(), line
    assert text.endswith("\n# EOF\n")
