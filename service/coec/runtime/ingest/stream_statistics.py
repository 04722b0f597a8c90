"""What the streams of a pair look like, as its ingest thread last said, and what follows from it for `health`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from coec.calibration.types import Estimate, ImageQuality
from coec.config import PairConfig
from coec.runtime.api import snapshots
from coec.runtime.ingest.decoder import EGO, StreamCounts
from coec.schemas import replies


@dataclass(frozen=True, slots=True)
class StreamReport:
    """Counters since the start, and the latest figures."""

    streams: dict[str, StreamCounts] = field(default_factory=dict)
    unpaired: dict[str, int] = field(default_factory=dict)
    rejections: dict[str, int] = field(default_factory=dict)
    pairs: int = 0
    selected: int = 0
    quality: ImageQuality | None = None
    frozen: bool = False
    rate_hz: float | None = None
    sync_error_s: float | None = None

    def needs(self, pair: PairConfig, latest: Estimate | None) -> tuple[str, ...]:
        """What is still missing, one sentence each. `latest` is the last estimate."""
        needs = []
        lacking = pair.window.min_pairs - self.selected
        if lacking > 0:
            needs.append(f"{lacking} more pairs")
        if pair.calibration.motion_compensation:
            compensation = latest.compensation if latest else {}
            ego = self.streams.get(EGO)
            if pair.ego is None or (self.pairs and (ego is None or not ego.accepted)):
                needs.append("motion compensation has no ego-motion")
            elif compensation.get("no_point_time", 0):
                needs.append("motion compensation has no point times")
        return tuple(needs)

    def data_quality(self, losses: Mapping[tuple[str, str], int]) -> replies.DataQuality:
        """The figures of `health`; `losses` are those of the pair by place and cause."""
        drops = snapshots.drops_of(losses, self.unpaired)
        if self.rejections:
            drops["pairs"] = self.rejections
        quality = self.quality
        return replies.DataQuality(
            pair_rate_hz=self.rate_hz,
            sync_error_s=self.sync_error_s,
            drops=drops,
            sharpness=quality.sharpness if quality else None,
            mean_level=quality.mean_level if quality else None,
            clipped=quality.clipped if quality else None,
            frozen_image=self.frozen,
        )
