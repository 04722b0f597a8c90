"""The process itself: limits, state, worker, session, log."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from coec.config.base import FilePath, Stage


class LimitsConfig(Stage):
    """Hard limits on what a message may hold: larger is refused before it is decoded."""

    max_message_bytes: int = Field(default=32 * 2**20, ge=2**16, le=2**30, description="as Zenoh's max_message_size")
    max_image_pixels: int = Field(default=33_000_000, ge=2**12, description="8K UHD")
    max_points: int = Field(default=1_000_000, ge=2**10, description="of a cloud")
    max_waiting_bytes: int = Field(
        default=128 * 2**20,
        ge=2**20,
        description="of all streams, messages that have come and wait to be decoded; beyond, the oldest are lost",
    )
    max_held_bytes: int = Field(
        default=256 * 2**20,
        ge=2**20,
        description="of all pairs, frames that wait until what came before them is judged; beyond, they do not wait",
    )


class StateConfig(Stage):
    """The state directory; deleting it returns the vehicle to nominal."""

    directory: FilePath = Field(
        default=Path("coec-state"), description="what is remembered over a restart, and the windows"
    )
    model: FilePath | None = Field(
        default=None,
        description="baselines of this model of vehicle (`coec fleet commission`): a pair that is not commissioned "
        "itself starts from them",
    )
    max_bytes: int = Field(default=4 * 2**30, ge=2**20, description="windows kept, bytes; the oldest go first")
    max_age_days: float = Field(default=90.0, gt=0, description="of windows; older ones go")
    min_free_bytes: int = Field(
        default=512 * 2**20, ge=0, description="left free on the disk; no window starts below it"
    )
    max_protected_bytes: int = Field(
        default=2 * 2**30,
        ge=0,
        description="windows of red events and commissionings, which outlive the others; beyond, the oldest of them "
        "are ordinary ones",
    )
    packing: Literal["lz4", "none"] = Field(
        default="lz4", description="of clouds and raw images in windows; encoded images are left as they are"
    )
    history: int = Field(default=500, ge=1, le=10_000, description="kept per pair: results, states, commands, each")
    checks: int = Field(default=2000, ge=1, le=100_000, description="checks of the monitor kept per pair, 2 kB each")
    evidence: int = Field(default=8, ge=1, le=100, description="red events kept per pair, with their windows")


class SnippetsConfig(Stage):
    """Recordings at full rate of the seconds around an event (suspect, degraded, miscalibrated), from memory."""

    memory_bytes: int = Field(
        default=0,
        ge=0,
        le=64 * 2**30,
        description="of the frames of all pairs that are kept for them: a quarter for the time before, a quarter for "
        "the time after, half for what is being written. 0: none are recorded",
    )
    before_s: float = Field(default=15.0, gt=0, le=600, description="of the time before the event, as far as it fits")
    after_s: float = Field(default=5.0, gt=0, le=600, description="of the time after it, as far as it fits")
    max_bytes: int = Field(default=2**30, ge=2**20, description="of all that are kept on the disk; the oldest go first")


class BudgetConfig(Stage):
    """What the pairs may spend of the processor between them. Where it does not suffice for every check and every
    window, their periods stretch evenly, and `status` says by how much."""

    cores: float = Field(
        default=0.5,
        gt=0,
        le=64,
        description="processor time of the worker in a second of driving, s: a replay at ten times the pace of the "
        "drive spends ten times as much, and is checked as often. The worker does one thing after the other: where "
        "that is more than it gets done, answers come late and frames are looked at without them (`not_awaited`)",
    )


class LidarEdgesConfig(Stage):
    """Where the LiDARs of a vehicle that has several sit to one another, by the surfaces that both of two see."""

    period_s: float = Field(
        default=15.0,
        ge=0,
        le=86_400,
        description="one look per so much sensor time at every two of them, s, 4 at least; it takes about half a "
        "second of the worker's processor time. 0: none. Needs the extra `lidars`, and ego-motion",
    )


class WorkerConfig(Stage):
    """The process that infers and solves."""

    timeout_s: float = Field(default=120.0, gt=0, description="one job; a worker that needs longer is replaced")
    max_memory_bytes: int = Field(default=3 * 2**30, ge=2**28, description="resident; a worker above is replaced")
    attempts: int = Field(
        default=2, ge=1, le=10, description="workers that may die on one window before it is given up"
    )
    threads: int = Field(default=2, ge=1, le=64, description="of the kernels that score a pose")
    niceness: int = Field(default=10, ge=0, le=19, description="so that queries are answered first")


class ZenohConfig(Stage):
    """The session. `file` is a Zenoh configuration (JSON5) for TLS, access control and the like."""

    connect: tuple[str, ...] = Field(default=("tcp/127.0.0.1:7447",), description="endpoints of the router")
    embedded_router: bool = Field(default=False, description="be the router and listen on `listen`")
    listen: tuple[str, ...] = Field(
        default=("tcp/127.0.0.1:7447",), description="where it is the router; loopback, or TLS with certificates"
    )
    insecure: bool = Field(
        default=False, description="listen even where whoever comes is let in without a certificate; health says so"
    )
    file: FilePath | None = Field(default=None, description="Zenoh's own configuration: endpoints, certificate")

    @property
    def router(self) -> tuple[str, ...]:
        """Endpoints at which a client reaches the router that the service uses, or is."""
        return self.listen if self.embedded_router else self.connect


class LogConfig(Stage):
    """The log, on standard output."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="lines of less weight are left out"
    )
    format: Literal["auto", "json", "human"] = Field(
        default="auto", description="auto: for people where it goes to a terminal, else JSON lines"
    )
