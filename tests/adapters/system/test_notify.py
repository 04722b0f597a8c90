"""What the service manager and a metrics scraper are told."""

from __future__ import annotations

import io
import json
import logging
import socket
from pathlib import Path

import pytest

from coec.adapters.system.logs import JsonFormatter
from coec.adapters.system.notify import Notifier
from coec.runtime.api import metrics
from coec.schemas.replies import (
    Axes,
    AxisReply,
    CheckReply,
    DataQuality,
    HealthReply,
    MetricReply,
    PairStatus,
    StatusReply,
    StorageStatus,
    StreamStatus,
    WorkerStatus,
)


def test_the_manager_is_told_by_datagrams(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        notifier = Notifier.from_environment({"NOTIFY_SOCKET": address})
        notifier.ready()
        notifier.watchdog()
        notifier.stopping()
        assert [manager.recv(100) for _ in range(3)] == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]


@pytest.mark.fault("the service manager's socket vanishes", "no harm is done")
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


def a_health() -> HealthReply:
    """Healthy, looked at once; commissioned."""
    axis = AxisReply(status="accepted", sigma=None, correction=0.0, unit="deg")
    none = (None,) * 6
    figures = {
        "mi": MetricReply(value=0.5, limit=0.25, at_least=True, passed=True),
        "overlap": MetricReply(value=None, limit=0.5, at_least=True, passed=False),
    }
    check = CheckReply(
        stamp_ns=1,
        pair_stamps_ns=(1,),
        flagged=False,
        weak=False,
        flagged_by_paper=False,
        causes=(),
        metrics=figures,
        first_derivative=(1.0, -2.0, 3.0, None, None, None),
        second_derivative=(9.0, 8.0, 7.0, None, None, None),
        offset=none,
        sigma=none,
        drift=(0.5, None, None, None, None, None),
        drift_sigma=none,
        outcome="clear",
        evidence=0.0,
        state="healthy",
    )
    return HealthReply(
        vehicle="test",
        pair="front",
        state="healthy",
        level=0,
        reasons=(),
        metrics=figures,
        axes=Axes(rx=axis, ry=axis, rz=axis, tx=axis, ty=axis, tz=axis),
        drift=(0.0, 0.0, None, 0.125, None, None),
        check=check,
        needs=(),
        data_quality=DataQuality(),
        since_ns=0,
        evaluated_ns=1,
        age_s=2.5,
    )


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
    text = metrics.render(status, {"front": a_health()}, 5).decode()
    for line in (
        'coec_build_info{version="1"} 1',
        'coec_health{pair="front",coec_health="healthy"} 1',
        'coec_health{pair="front",coec_health="stale"} 0',
        'coec_samples_received_total{pair="front",stream="camera"} 3',
        'coec_losses_total{pair="front",place="camera",cause="frame_id"} 2',
        'coec_windows_recorded_total{pair="front"} 4',
        "coec_worker_restarts_total 1",
        "coec_uptime_seconds 1.5",
        'coec_check_age_seconds{pair="front"} 2.5',
        'coec_diagnosis{pair="front",metric="mi"} 0.5',
        'coec_diagnosis_limit{pair="front",metric="mi"} 0.25',
        'coec_mi_first_derivative{pair="front",axis="ry"} -2',
        'coec_mi_second_derivative{pair="front",axis="rx"} 9',
        'coec_drift{pair="front",axis="tx",unit="m"} 0.125',
        'coec_check_drift{pair="front",axis="rx",unit="deg"} 0.5',
    ):
        assert line in text.splitlines(), line
    assert 'coec_diagnosis{pair="front",metric="overlap"}' not in text, "it could not be computed"
    assert 'axis="rz",unit="deg"' not in text, "it was not estimated"
    assert text.endswith("\n# EOF\n")
