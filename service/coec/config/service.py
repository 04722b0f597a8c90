"""The process and its interfaces: limits, state directory, worker, processor budget, log, Zenoh session, ROS 2 output,
metrics over HTTP, uplink, and who may give commands.
"""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from coec.config.model import ConfigModel, FilePath
from coec.schemas.commands import COMMAND_NAMES, CommandName


class LimitsConfig(ConfigModel):
    """Hard limits on what a message may hold: larger messages are refused before they are decoded."""

    max_message_bytes: int = Field(
        default=32 * 2**20, ge=2**16, le=2**30, description="largest message; also Zenoh's max_message_size"
    )
    max_image_pixels: int = Field(default=33_000_000, ge=2**12, description="largest image; the default is 8K UHD")
    max_points: int = Field(default=1_000_000, ge=2**10, description="most points of a cloud")
    max_waiting_bytes: int = Field(
        default=128 * 2**20,
        ge=2**20,
        description="received messages of all streams that wait to be decoded; beyond this the oldest are dropped",
    )
    max_held_bytes: int = Field(
        default=256 * 2**20,
        ge=2**20,
        description="frames of all pairs that wait for the judgement of earlier frames; beyond this they do not wait",
    )


class StateConfig(ConfigModel):
    """The state directory; deleting it returns the vehicle to its nominal calibration."""

    directory: FilePath = Field(
        default=Path("coec-state"), description="folder of the windows and of the state that survives a restart"
    )
    model: FilePath | None = Field(
        default=None,
        description="baselines of this vehicle model (`coec fleet commission`); a pair without a baseline of its own "
        "starts from them",
    )
    max_bytes: int = Field(
        default=4 * 2**30, ge=2**20, description="size of all kept windows; the oldest are removed first"
    )
    max_age_days: float = Field(default=90.0, gt=0, description="older windows are removed")
    min_free_bytes: int = Field(
        default=512 * 2**20, ge=0, description="space left free on the disk; with less free, no window starts"
    )
    max_protected_bytes: int = Field(
        default=2 * 2**30,
        ge=0,
        description="windows of incidents and commissionings, which are kept longer than the others; beyond this the "
        "oldest of them count as ordinary windows",
    )
    packing: Literal["lz4", "none"] = Field(
        default="lz4", description="compression of clouds and raw images in windows; encoded images stay as they are"
    )
    history: int = Field(
        default=500, ge=1, le=10_000, description="results, states and commands kept per pair, of each kind"
    )
    checks: int = Field(default=2000, ge=1, le=100_000, description="checks of the monitor kept per pair, 2 kB each")
    evidence: int = Field(default=8, ge=1, le=100, description="incidents kept per pair, with their windows")


class SnippetsConfig(ConfigModel):
    """Full-rate recordings of the seconds around an event (suspect, degraded, miscalibrated), from frames in memory."""

    memory_bytes: int = Field(
        default=0,
        ge=0,
        le=64 * 2**30,
        description="memory for frames of all pairs: a quarter for the time before the event, a quarter for the time "
        "after it, half for what is being written. 0: no recordings",
    )
    before_s: float = Field(default=15.0, gt=0, le=600, description="time before the event, as far as memory suffices")
    after_s: float = Field(default=5.0, gt=0, le=600, description="time after the event, as far as memory suffices")
    max_bytes: int = Field(
        default=2**30, ge=2**20, description="size of all recordings on the disk; the oldest are removed first"
    )


class BudgetConfig(ConfigModel):
    """How much processor time all pairs together may spend. If it does not suffice for every check and every window,
    all periods are stretched evenly, and `status` says by how much."""

    cores: float = Field(
        default=0.5,
        gt=0,
        le=64,
        description="processor time of the worker per second of driving, s: a replay at ten times the pace of the "
        "drive spends ten times as much, and is checked as often. The worker does one job after the other: if it "
        "cannot keep up, answers come late and frames go on without waiting for them (`not_awaited`)",
    )


class LidarEdgesConfig(ConfigModel):
    """Measures the poses between the LiDARs of a vehicle, from the surfaces that two of them both see."""

    period_s: float = Field(
        default=15.0,
        ge=0,
        le=86_400,
        description="sensor time between two registrations of the same two LiDARs, s, at least 4; one takes about half "
        "a second of the worker's processor time. 0: none. Needs the extra `lidars`, and ego-motion",
    )


class WorkerConfig(ConfigModel):
    """The process that runs the depth network and solves windows."""

    timeout_s: float = Field(
        default=120.0, gt=0, description="longest time for one job; a worker that needs longer is replaced"
    )
    max_memory_bytes: int = Field(
        default=3 * 2**30, ge=2**28, description="largest resident memory; a worker above it is replaced"
    )
    attempts: int = Field(
        default=2, ge=1, le=10, description="workers that may die on one window before it is given up"
    )
    threads: int = Field(default=2, ge=1, le=64, description="threads of the kernels that score a pose")
    niceness: int = Field(
        default=10, ge=0, le=19, description="niceness of the worker, so that queries are answered first"
    )


class ZenohConfig(ConfigModel):
    """The Zenoh session. `file` is a Zenoh configuration (JSON5) for TLS, access control and the like."""

    connect: tuple[str, ...] = Field(
        default=("tcp/127.0.0.1:7447",), description="endpoints of the router; the first that answers is used"
    )
    embedded_router: bool = Field(default=False, description="the service is the router itself and listens on `listen`")
    listen: tuple[str, ...] = Field(
        default=("tcp/127.0.0.1:7447",),
        description="endpoints of the embedded router: on loopback, or TLS with certificates",
    )
    insecure: bool = Field(
        default=False, description="allow endpoints that let anybody in without a certificate; health says so"
    )
    file: FilePath | None = Field(default=None, description="Zenoh's own configuration: endpoints, certificate")

    @property
    def router(self) -> tuple[str, ...]:
        """Endpoints at which a client reaches the router: the service's own, or the one that it connects to."""
        return self.listen if self.embedded_router else self.connect


class LogConfig(ConfigModel):
    """The log, on standard output."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="less severe lines are left out"
    )
    format: Literal["auto", "json", "human"] = Field(
        default="auto", description="auto: human on a terminal, else JSON lines"
    )


CommonName = Annotated[str, Field(pattern=r"^[A-Za-z0-9 ._:/@+=,-]{1,64}$")]
"""Common name of a certificate; X.509 allows 64 characters."""


class SenderConfig(ConfigModel):
    """A sender who may give commands, known by the common name of its certificate."""

    name: CommonName = Field(description="common name of the certificate")
    commands: tuple[CommandName, ...] = Field(
        default=COMMAND_NAMES, min_length=1, description="commands that this sender may give; all unless listed"
    )


class AuthorityConfig(ConfigModel):
    """Who may give commands, whatever the router lets through. A router does not tell the service who asks. A sender
    proves its name to the service itself, with a certificate signed by `root_ca`, in a TLS conversation inside the
    query (`coec query command/...` does this); a router in between can only hold such a command back. Senders without
    proof are `anonymous`. `loopback` accepts their commands while the session listens and connects on loopback only and
    the router's port is open on no other address. The service cannot see whether the router listens elsewhere, too. If
    it does, the router's own access control decides who gets in there; `never` refuses all anonymous commands."""

    anonymous: Literal["never", "loopback", "always"] = Field(
        default="loopback", description="when the service takes commands from senders without proof"
    )
    senders: tuple[SenderConfig, ...] = Field(default=(), max_length=64, description="who may give which commands")
    certificate: FilePath | None = Field(
        default=None, description="certificate of the service; its common name is the vehicle's name"
    )
    private_key: FilePath | None = Field(default=None, description="private key of `certificate`")
    root_ca: FilePath | None = Field(default=None, description="authority that signed the senders' certificates")

    @model_validator(mode="after")
    def _provable(self) -> AuthorityConfig:
        given = [path is not None for path in (self.certificate, self.private_key, self.root_ca)]
        if any(given) != all(given):
            raise ValueError("certificate, private_key and root_ca belong together: give all three or none")
        if self.senders and not all(given):
            raise ValueError("senders prove their names to the service: give certificate, private_key and root_ca, too")
        names = [sender.name for sender in self.senders]
        if len(set(names)) != len(names):
            raise ValueError("names of senders must be unique")
        return self


class MetricsConfig(ConfigModel):
    """HTTP for a scraper on the same computer: `/metrics` (OpenMetrics if asked for, else Prometheus text), `/health`
    (200, or 503 when a calibration is not known to be right) and `/live` (200 while the service makes progress).
    Everybody who reaches the address can read; nobody can change anything."""

    http: str | None = Field(default=None, description="HOST:PORT, such as 127.0.0.1:9464; null: no HTTP")
    insecure: bool = Field(default=False, description="allow addresses other than loopback; health says so")

    @property
    def address(self) -> tuple[str, int] | None:
        """Host, without brackets, and port; None: no HTTP."""
        if self.http is None:
            return None
        host, _, port = self.http.rpartition(":")
        return host.removeprefix("[").removesuffix("]"), int(port)

    @property
    def is_open(self) -> bool:
        """Whether other computers can reach it."""
        return self.address is not None and not is_loopback(self.address[0])

    @model_validator(mode="after")
    def _validate_address(self) -> MetricsConfig:
        if self.http is None:
            return self
        if not re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^\s:\[\]]+):\d{1,5}", self.http) or not 0 < self._port < 65536:
            raise ValueError(f"http: {self.http!r} is no HOST:PORT: write 127.0.0.1:9464")
        if self.is_open and not self.insecure:
            raise ValueError(
                f"http: any host that can reach {self.http} could read the metrics without a certificate: "
                "listen on loopback, as 127.0.0.1:9464, or set `metrics.insecure: true`, and health will say so"
            )
        return self

    @property
    def _port(self) -> int:
        return 0 if self.address is None else self.address[1]


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach an address (without brackets). Of names, only `localhost` counts: any other
    could resolve to any address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


RosOutput = Literal["diagnostics", "tf_static", "camera_info", "overlay"]


class RosConfig(ConfigModel):
    """ROS 2 on the bus, used if `middleware` is `rmw_zenoh` or `ros2dds`."""

    domain: int = Field(default=0, ge=0, le=232, description="ROS_DOMAIN_ID (rmw_zenoh)")
    namespace: str = Field(
        default="",
        pattern=r"^(/?[A-Za-z_][A-Za-z0-9_]*)*$",
        max_length=128,
        description="namespace of the bridge, if it has one (ros2dds)",
    )
    publish: tuple[RosOutput, ...] = Field(
        default=(), description="what is published to ROS nodes: diagnostics, tf_static, camera_info, overlay"
    )
    calibrated_suffix: str = Field(
        default="_calibrated",
        pattern=r"^[A-Za-z0-9_]+$",
        max_length=64,
        description="added to the camera's frame id to name the published frame, as the vehicle's own tree has the "
        "camera's frame",
    )
    replace_camera_frames: bool = Field(
        default=False,
        description="publish the camera's own frame instead; then nobody else may, because a frame has one parent",
    )

    @model_validator(mode="after")
    def _unique_outputs(self) -> RosConfig:
        if len(set(self.publish)) != len(self.publish):
            raise ValueError("publish names something twice")
        return self


class UplinkConfig(ConfigModel):
    """Limits for the link to a fleet centre, often a modem that others need, too. The service does not know who asks,
    so that it meters queries from the vehicle itself alike."""

    last_word_s: float = Field(
        default=60.0,
        ge=1.0,
        le=86_400.0,
        description="period at which each pair publishes its last word, one kilobyte, even if nothing has changed",
    )
    evidence_bytes_per_s: int = Field(
        default=1_000_000,
        ge=1_000,
        description="long-run limit for history, incidents, pictures and bytes of windows; beyond it the service asks "
        "the reader to wait",
    )
