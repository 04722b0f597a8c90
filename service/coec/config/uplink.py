"""What the vehicle's link to the outside may be loaded with."""

from __future__ import annotations

from pydantic import Field

from coec.config.base import Stage


class UplinkConfig(Stage):
    """The way to whoever looks after many vehicles: often a modem that others need, too. A service is not told who
    asks, so that whoever asks on the vehicle itself is metered alike."""

    last_word_s: float = Field(
        default=60.0,
        ge=1.0,
        le=86_400.0,
        description="each pair says so often how it is, one kilobyte, also when nothing has changed",
    )
    evidence_bytes_per_s: int = Field(
        default=1_000_000,
        ge=1_000,
        description="in the long run, of history, red events, pictures and bytes of windows; beyond, whoever asks is "
        "told to wait",
    )
