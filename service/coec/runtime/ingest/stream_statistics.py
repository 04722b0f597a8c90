"""The latest report of the intake's thread about the streams of a pair."""

from __future__ import annotations

from dataclasses import dataclass, field

from coec.runtime.ingest.chooser import SelectionStatistics
from coec.runtime.ingest.decoder import StreamCounts


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """Counters since the start, and the latest figures.

    Attributes:
        streams: samples and frames, by stream.
        unpaired: number of frames that got into no pair, by `<stream>_<cause>`.
        pairs: number of pairs that were formed.
        held: how many of these pairs wait to be looked at.
        chosen: what was chosen from the others.
        rate_hz: pairs per second of sensor time; 0 when the streams have stopped, None before the second pair.
        pace: seconds of sensor time per second; None before the second pair.
        sync_error_s: how much later than its sweep the latest camera frame was taken.
        timed_by: how the times of the latest sweep's points were read, see `LidarFrame`.
    """

    streams: dict[str, StreamCounts] = field(default_factory=dict)
    unpaired: dict[str, int] = field(default_factory=dict)
    pairs: int = 0
    held: int = 0
    selection: SelectionStatistics = field(default_factory=SelectionStatistics)
    rate_hz: float | None = None
    pace: float | None = None
    sync_error_s: float | None = None
    timed_by: str = ""
