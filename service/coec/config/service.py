"""The process itself: limits, state, worker, session, log."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from coec.config.base import ConfigModel, FilePath


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
        description="windows of red events and commissionings, which are kept longer than the others; beyond this the "
        "oldest of them count as ordinary windows",
    )
    packing: Literal["lz4", "none"] = Field(
        default="lz4", description="compression of clouds and raw images in windows; encoded images stay as they are"
    )
    history: int = Field(
        default=500, ge=1, le=10_000, description="results, states and commands kept per pair, of each kind"
    )
    checks: int = Field(default=2000, ge=1, le=100_000, description="checks of the monitor kept per pair, 2 kB each")
    evidence: int = Field(default=8, ge=1, le=100, description="red events kept per pair, with their windows")


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
        description="sensor time between two looks at the same two LiDARs, s, at least 4; one look takes about half a "
        "second of the worker's processor time. 0: no looks. Needs the extra `lidars`, and ego-motion",
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
