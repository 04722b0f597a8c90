"""How much traffic the service may put on the vehicle's link to the outside."""

from __future__ import annotations

from pydantic import Field

from coec.config.base import ConfigModel


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
        description="long-run limit for history, red events, pictures and bytes of windows; beyond it the service asks "
        "the reader to wait",
    )
