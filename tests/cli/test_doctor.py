"""`coec doctor` against a real router, with sensors that babble as sensors do on a bad day."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
import pytest
import zenoh

from cli.conftest import Coec
from coec.calibration.types import LidarFrame
from coec.cli.doctor import environment, examine
from coec.cli.doctor.streams import StreamSamples, stream_findings
from coec.config import CalibrationConfig, Config, LimitsConfig, MonitorConfig, ZenohConfig, load_config
from coec.io import system
from coec.io.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.io.zenoh.bus import MSGPACK, open_session
from coec.io.zenoh.ros_node import RosTopicList
from coec.io.zenoh.session import CertificateError, Endpoint, TlsFiles, host_and_port, read_certificate, tls_files
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.documents import Finding
from conftest import REPOSITORY
from support.router import free_port
from support.vehicles import frame_pair_at, pair_configuration

RATE_HZ = 10.0
SECONDS = 1.5
HOUR_S = 3600.0
ADVISED = ("warn", "fail")


@dataclass(frozen=True)
class Sensors:
    """How those of one pair behave; seconds are added to the stamps."""

    rate_hz: float = RATE_HZ
    camera_late_s: float = 0.0
    lidar_late_s: float = 0.0
    damaged: bool = False
    silent: bool = False
    point_times_s: tuple[float, float] | None = (0.0, 0.1)


VEHICLE = {
    "good": Sensors(),
    "silent": Sensors(silent=True),
    "slow": Sensors(rate_hz=1.0),
    "behind": Sensors(camera_late_s=HOUR_S, lidar_late_s=HOUR_S),
    "apart": Sensors(camera_late_s=HOUR_S),
    "damaged": Sensors(damaged=True),
    "wrong-unit": Sensors(point_times_s=(0.0, 0.9)),
    "no-times": Sensors(point_times_s=None),
}
"""Pairs by name: each has something else the matter with it."""


def written(folder: Path, zenoh_config: ZenohConfig, *names: str) -> Path:
    """A configuration with these pairs, and a state directory beside it."""
    config = pair_configuration(folder / "state")
    (pair,) = config.pairs

    def named(name: str) -> object:
        assert pair.ego is not None
        keys = {
            stream: getattr(pair, stream).model_copy(update={"key": f"in/{name}/{stream}"})
            for stream in ("camera", "lidar", "ego")
        }
        return pair.model_copy(
            update={"name": name, "monitor": MonitorConfig(), "calibration": CalibrationConfig(), **keys}
        )

    changed = config.model_copy(update={"zenoh": zenoh_config, "pairs": tuple(named(name) for name in names)})
    (folder / "state").mkdir()
    path = folder / "coec.yaml"
    path.write_text(commented_yaml(Config.model_validate(changed.model_dump())))
    return path


def babble(session: zenoh.Session, name: str, sensors: Sensors, end: threading.Event) -> None:
    """Send until told to stop."""
    while not end.is_set():
        now_ns = time.time_ns()
        pair = frame_pair_at(now_ns)
        assert pair.motion is not None
        times = None
        if sensors.point_times_s is not None:
            times = np.linspace(*sensors.point_times_s, len(pair.lidar.xyz_m), dtype=np.float32)
        camera = replace(pair.camera, stamp_ns=now_ns - round(sensors.camera_late_s * 1e9))
        lidar = LidarFrame(now_ns - round(sensors.lidar_late_s * 1e9), "lidar", pair.lidar.xyz_m, time_offset_s=times)
        motion = replace(pair.motion, stamp_ns=camera.stamp_ns)
        for stream, data in (
            ("camera", encode_camera(camera)),
            ("lidar", encode_lidar(lidar)),
            ("ego", encode_ego(motion)),
        ):
            payload = data[: len(data) // 2] if sensors.damaged and stream == "camera" else data
            session.put(f"in/{name}/{stream}", payload, encoding=MSGPACK)
        end.wait(1.0 / sensors.rate_hz)


@contextmanager
def babbling(session: zenoh.Session, vehicle: dict[str, Sensors]) -> Iterator[None]:
    end = threading.Event()
    threads = [
        threading.Thread(target=babble, args=(session, name, sensors, end))
        for name, sensors in vehicle.items()
        if not sensors.silent
    ]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        end.set()
        for thread in threads:
            thread.join()


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Sequence[Finding]:
    """What is found on a vehicle on which every pair has something else the matter with it."""
    folder = tmp_path_factory.mktemp("vehicle")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    zenoh_config = ZenohConfig(connect=(endpoint,), listen=(endpoint,))
    path = written(folder, zenoh_config, *VEHICLE)
    with (
        open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session,
        babbling(session, VEHICLE),
    ):
        return list(examine(path, SECONDS))


def of(findings: Sequence[Finding], check: str, where: str) -> tuple[str, str]:
    """Level and text of the one finding about this."""
    (result,) = [one for one in findings if (one.check, one.where) == (check, where)]
    return result.level, result.text


def key(pair: str, stream: str) -> str:
    return f"in/{pair}/{stream}"


def test_what_is_in_order_is_ok(vehicle: Sequence[Finding]) -> None:
    about = [one for one in vehicle if one.where.startswith("in/good/") or one.where == "good"]
    assert {one.check for one in about} == {"stream", "stamps", "in_step", "point_times", "image"}
    assert [one for one in about if one.level != "ok"] == []
    for check in ("configuration", "network", "state", "lock", "disk", "writing", "router", "session", "rules"):
        (result,) = [one for one in vehicle if one.check == check]
        assert result.level == "ok", result
    assert any(one.check == "service" and "no service" in one.text for one in vehicle)


@pytest.mark.fault("a sensor that sends nothing", "the doctor names its key, and where to look")
def test_a_stream_that_is_silent_fails(vehicle: Sequence[Finding]) -> None:
    for stream in ("camera", "lidar", "ego"):
        level, text = of(vehicle, "stream", key("silent", stream))
        assert (level, "no sample" in text) == ("fail", True)


def test_a_slow_stream_is_reported(vehicle: Sequence[Finding]) -> None:
    for stream in ("camera", "ego"):
        level, _ = of(vehicle, "stream", key("slow", stream))
        assert level in ADVISED, stream


@pytest.mark.parametrize(
    ("rate_hz", "count", "level"), [(10.0, 50, "ok"), (1.0, 5, "warn"), (0.5, 3, "fail"), (0.2, 1, "fail")]
)
def test_a_rate_is_judged_by_what_a_check_wants(tmp_path: Path, rate_hz: float, count: int, level: str) -> None:
    """By default six pairs in five seconds are wanted, and four are needed."""
    config = load_config(written(tmp_path, ZenohConfig(), "front"))
    (pair,) = config.pairs
    camera, silent = StreamSamples(pair.camera.place), StreamSamples(pair.lidar.place)
    for number in range(count):
        camera.arrivals_s.append(number / rate_hz)
        camera.sizes.append(1000)
    result = list(stream_findings(pair, {"camera": camera, "lidar": silent}, config, 5.0, RosTopicList()))
    assert of(result, "stream", pair.camera.place)[0] == level
    assert of(result, "stream", pair.lidar.place)[0] == "fail"


def test_a_clock_an_hour_off_is_reported(vehicle: Sequence[Finding]) -> None:
    level, text = of(vehicle, "stamps", key("behind", "camera"))
    assert level == "warn"
    assert "3600.0 s behind the clock of this computer" in text
    in_step = [one for one in vehicle if one.where == "behind" and one.check == "in_step"]
    assert [one.level for one in in_step] == ["ok", "ok"], "both are off by the same, and pairs are formed"


@pytest.mark.fault("clocks of camera and LiDAR an hour apart", "the doctor says so, and that no pair comes of it")
def test_two_clocks_an_hour_from_each_other_make_no_pairs(vehicle: Sequence[Finding]) -> None:
    (separation,) = [one for one in vehicle if one.where == "apart" and one.text.startswith("camera and LiDAR")]
    assert separation.level == "fail"
    assert "0 % of the frames have a sweep" in separation.text


@pytest.mark.fault("frames that cannot be decoded", "the doctor says of which stream, and why")
def test_what_cannot_be_decoded_fails_and_says_why(vehicle: Sequence[Finding]) -> None:
    level, text = of(vehicle, "decoding", key("damaged", "camera"))
    assert level == "fail"
    assert "message_malformed" in text
    assert not [one for one in vehicle if one.check == "decoding" and "damaged/lidar" in one.where]


def test_point_times_are_checked(vehicle: Sequence[Finding]) -> None:
    level, text = of(vehicle, "point_times", key("wrong-unit", "lidar"))
    assert (level, "further than two sweeps" in text) == ("fail", True)
    level, text = of(vehicle, "point_times", key("no-times", "lidar"))
    assert (level, "points have no time" in text) == ("warn", True)


def test_whatever_is_not_in_order_has_an_advice(vehicle: Sequence[Finding]) -> None:
    assert [one for one in vehicle if one.level in ADVISED and not one.advice] == []


@pytest.mark.parametrize(("level", "status"), [("ok", 0), ("warn", 0), ("fail", 1)])
def test_only_what_failed_makes_it_fail(coec: Coec, monkeypatch: pytest.MonkeyPatch, level: str, status: int) -> None:
    result = Finding.model_validate(
        {"check": "disk", "level": level, "where": "/var", "text": "what it is like", "advice": "what to do"}
    )
    monkeypatch.setattr("coec.cli.doctor.examine", lambda *_: iter([result]))
    reported = coec("doctor")
    assert reported.status == status
    assert f"{level:<5}disk          /var: what it is like\n     → what to do\n" in reported.out
    report = coec("doctor", "--json").document
    assert report["healthy"] is (status == 0)
    assert report["findings"] == [json.loads(result.model_dump_json())]


# --- the way to the router --------------------------------------------------------------------------------------------


def test_no_router_is_reported_and_fails(coec: Coec, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    path = written(tmp_path, ZenohConfig(connect=(endpoint,), listen=(endpoint,)), "front")
    outcome = coec("doctor", "--config", path, "--json")
    assert outcome.status == 1
    report = json.loads(outcome.out)
    assert report["healthy"] is False
    (result,) = [one for one in report["findings"] if one["check"] == "router"]
    assert (result["level"], result["where"]) == ("fail", endpoint)
    assert "nothing listens at this port" in result["text"]
    assert "session" not in [one["check"] for one in report["findings"]], "there is nobody to talk to"


@pytest.mark.fault("another program at the port of the router", "the doctor distinguishes this from a missing router")
def test_a_port_at_which_something_else_answers_is_distinguished_from_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment, "CONNECT_S", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as other:
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        result = list(examine(written(tmp_path, ZenohConfig(connect=(endpoint,)), "front"), 0.5))
    assert of(result, "router", endpoint)[0] == "ok"
    level, text = of(result, "session", endpoint)
    assert (level, text) == ("fail", "no Zenoh session can be opened")


def test_a_broken_configuration_is_a_finding(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "coec.yaml"
    path.write_text("pairs: []\n")
    outcome = coec("doctor", "--config", path)
    assert outcome.status == 1
    assert "fail configuration" in outcome.out
    assert "ok   kernels" in outcome.out or "warn kernels" in outcome.out, "what can be looked at all the same is"


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an authority, certificates that it signed, one of them expired, and one of another authority."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    folder = tmp_path_factory.mktemp("tls")
    uses = "subjectAltName=DNS:localhost,IP:127.0.0.1\nextendedKeyUsage=serverAuth,clientAuth\n"
    (folder / "extensions").write_text(uses)

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    for root in ("ca", "foreign-ca"):
        openssl(
            "req",
            "-x509",
            *key,
            "-keyout",
            f"{root}-key.pem",
            "-out",
            f"{root}.pem",
            "-days",
            "99",
            "-subj",
            f"/CN={root}",
        )
    for name, subject, root, days in (
        ("router", "router", "ca", "60"),
        ("vehicle", "vehicle", "ca", "60"),
        ("soon", "vehicle", "ca", "3"),
        ("expired", "vehicle", "ca", "-1"),
        ("foreign", "vehicle", "foreign-ca", "60"),
    ):
        openssl("req", *key, "-keyout", f"{name}-key.pem", "-out", f"{name}.csr", "-subj", f"/CN={subject}")
        signed = ("-CA", f"{root}.pem", "-CAkey", f"{root}-key.pem", "-CAcreateserial", "-extfile", "extensions")
        openssl("x509", "-req", "-in", f"{name}.csr", "-out", f"{name}.pem", "-days", days, *signed)
    return folder


@pytest.fixture(scope="module")
def guarded(authority: Path) -> Iterator[int]:
    """The port of a router with the shipped rules, which asks for certificates."""
    port = free_port()
    rules = (REPOSITORY / "deploy" / "router.json5").read_text()
    for shipped, here in (
        ("/etc/zenoh/tls", str(authority)),
        ("tls/[::]:7448", f"tls/127.0.0.1:{port}"),
        ("tcp/127.0.0.1:7447", f"tcp/127.0.0.1:{free_port()}"),
    ):
        rules = rules.replace(shipped, here)
    (authority / "router.json5").write_text(rules)
    with zenoh.open(zenoh.Config.from_file(authority / "router.json5")):
        yield port


def result_with(authority: Path, port: int, name: str, folder: Path, vehicle: str = "vehicle") -> dict[str, Finding]:
    """What is found on the way to the router, by check, with one of the certificates."""
    tls = {
        "root_ca_certificate": str(authority / "ca.pem"),
        "enable_mtls": True,
        "connect_certificate": str(authority / f"{name}.pem"),
        "connect_private_key": str(authority / f"{name}-key.pem"),
    }
    file = folder / "session.json5"
    session = {"connect": {"endpoints": [f"tls/127.0.0.1:{port}"]}, "transport": {"link": {"tls": tls}}}
    file.write_text(json.dumps(session))
    config = pair_configuration(folder).model_copy(update={"zenoh": ZenohConfig(file=file), "vehicle": vehicle})
    result = [*environment.certificate_findings(config), *environment.router_findings(config)]
    with_session = environment.session_of_client(config)
    result.append(environment.session_finding(config, with_session))
    if with_session is not None:
        as_of_service = environment.session_as_of_service(config)
        assert as_of_service is not None
        with with_session, as_of_service:
            result.append(environment.rules_finding(config, as_of_service, with_session))
    return {one.check: one for one in result}


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not come about is given up soon."""
    monkeypatch.setattr(environment, "CONNECT_S", 1.0)
    monkeypatch.setattr(environment, "SEEN_S", 0.3)


@pytest.mark.usefixtures("soon")
def test_a_certificate_that_is_good_leads_to_a_session_that_may_speak(
    authority: Path, guarded: int, tmp_path: Path
) -> None:
    result = result_with(authority, guarded, "vehicle", tmp_path)
    assert {check: one.level for check, one in result.items()} == dict.fromkeys(
        ("certificate", "router", "tls", "session", "rules"), "ok"
    )
    assert "127.0.0.1" in result["tls"].text
    assert result_with(authority, guarded, "soon", tmp_path)["certificate"].level == "warn"


@pytest.mark.usefixtures("soon")
@pytest.mark.fault("a certificate that has expired", "the doctor names it, its day, and who refuses it")
def test_an_expired_certificate_is_named(authority: Path, guarded: int, tmp_path: Path) -> None:
    result = result_with(authority, guarded, "expired", tmp_path)
    assert "'vehicle' has expired on 20" in result["certificate"].text
    assert result["tls"].text == "the other end refuses: certificate expired"
    assert [result[check].level for check in ("certificate", "router", "tls", "session")] == [
        "fail",
        "ok",
        "fail",
        "fail",
    ]


@pytest.mark.usefixtures("soon")
def test_a_foreign_certificate_is_distinguished_from_no_router(authority: Path, guarded: int, tmp_path: Path) -> None:
    result = result_with(authority, guarded, "foreign", tmp_path)
    assert result["certificate"].level == "fail"
    assert result["tls"].text.startswith("the other end refuses: ")
    assert result["router"].level == "ok"


@pytest.mark.usefixtures("soon")
@pytest.mark.fault(
    "rules of the router that refuse the service",
    "the doctor distinguishes this from a missing router and from missing TLS",
)
def test_rules_that_refuse_are_distinguished_from_no_router(authority: Path, guarded: int, tmp_path: Path) -> None:
    result = result_with(authority, guarded, "vehicle", tmp_path, vehicle="other")
    assert [result[check].level for check in ("router", "tls", "session", "rules")] == ["ok", "ok", "ok", "fail"]
    assert "its access control refuses" in result["rules"].text


def material(folder: Path, certificate: str, key: str, root: str = "ca") -> TlsFiles:
    return TlsFiles(
        folder / f"{root}.pem", folder / f"{certificate}.pem", folder / f"{key}-key.pem", names_checked=True
    )


def test_files_that_do_not_belong_together_are_reported(authority: Path) -> None:
    assert read_certificate(material(authority, "router", "router"), "listen").names == ("localhost", "127.0.0.1")
    assert read_certificate(material(authority, "expired", "expired"), "connect").not_after_s < time.time()
    for wrong, why in (
        (material(authority, "vehicle", "router"), "key values mismatch"),
        (material(authority, "vehicle", "vehicle", "foreign-ca"), "unable to get local issuer certificate"),
        (material(authority, "absent", "vehicle"), "cannot be read: No such file"),
        (material(authority, "router", "router", "vehicle-key"), "cannot be used"),
    ):
        with pytest.raises(CertificateError, match=why):
            read_certificate(wrong, "connect")


@pytest.mark.usefixtures("guarded")
def test_an_endpoint_has_files_of_its_own(authority: Path) -> None:
    settings = zenoh.Config.from_file(authority / "router.json5")
    plain, own = Endpoint.parse("tls/[::1]:7448"), Endpoint.parse("tls/[::1]:7448#listen_certificate_file=/own.pem")
    assert tls_files(settings, plain, "listen").certificate == authority / "router.pem"
    assert tls_files(settings, own, "listen").certificate == Path("/own.pem")
    assert tls_files(settings, own, "connect").certificate is None
    assert host_and_port(own) == ("::1", 7448)


# --- this computer ----------------------------------------------------------------------------------------------------


def levels(config: Config) -> dict[str, str]:
    return {one.check: one.level for one in environment.state_findings(config.state)}


@pytest.mark.fault("a full disk before the start", "the doctor says so, and leaves nothing behind on it")
def test_a_full_disk_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = pair_configuration(tmp_path)
    assert levels(config) == {"state": "ok", "lock": "ok", "disk": "ok", "writing": "ok"}
    left = sorted(tmp_path.iterdir())
    wanting = config.state.model_copy(update={"min_free_bytes": 2**60})
    assert levels(config.model_copy(update={"state": wanting}))["disk"] == "fail"

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    (writing,) = (one for one in environment.state_findings(config.state) if one.check == "writing")
    assert writing.level == "fail"
    assert "No space left" in writing.text
    assert writing.advice is not None
    assert "free space" in writing.advice
    assert sorted(tmp_path.iterdir()) == left, "nothing is left behind"


def test_a_service_that_holds_the_state_is_seen_and_not_disturbed(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path)
    with (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        (held,) = (one for one in environment.state_findings(config.state) if one.check == "lock")
        assert "a service runs here" in held.text
    (free,) = (one for one in environment.state_findings(config.state) if one.check == "lock")
    assert "no service runs here" in free.text


def test_a_state_directory_that_cannot_be_made_fails(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path / "new" / "state")
    assert levels(config) == {"state": "ok"}
    (tmp_path / "file").write_text("")
    assert levels(pair_configuration(tmp_path / "file"))["state"] == "fail"
    assert not (tmp_path / "new").exists()


def test_a_cold_cache_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    cold = environment.kernels_finding()
    assert (cold.level, cold.where) == ("warn", str(tmp_path))
    (tmp_path / "geometry").mkdir()
    (tmp_path / "geometry" / "kernel.nbi").write_text("")
    assert environment.kernels_finding().level == "ok"


@pytest.mark.parametrize(
    ("state", "level"),
    [
        (system.ClockState(True, 0.002), "ok"),
        (system.ClockState(True, 16.0), "warn"),
        (system.ClockState(False, 0.002), "warn"),
        (None, "warn"),
    ],
)
def test_a_clock_that_nobody_keeps_is_reported(
    monkeypatch: pytest.MonkeyPatch, state: system.ClockState | None, level: str
) -> None:
    monkeypatch.setattr(environment, "clock_state", lambda: state)
    assert environment.clock_finding().level == level


def test_the_kernel_reports_of_its_clock() -> None:
    reported = system.clock_state()
    assert reported is None or reported.max_error_s > 0
