"""The HTTP endpoint for a scraper on the same computer."""

from __future__ import annotations

import ipaddress
import re

from pydantic import Field, model_validator

from coec.config.base import ConfigModel


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
                f"http: whoever reaches {self.http} would read the metrics, without a certificate: listen on loopback, "
                "as 127.0.0.1:9464, or set `metrics.insecure: true`, and health will say so"
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
