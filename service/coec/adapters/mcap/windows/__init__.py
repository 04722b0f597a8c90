"""Windows on disk: one MCAP file each. Import from this package; `names` may be imported directly, too."""

from coec.adapters.mcap.windows.names import PART_SUFFIX, REWRITE_SUFFIX, SUFFIX
from coec.adapters.mcap.windows.reading import is_window, pairs_since, read_result, read_vehicle, read_window
from coec.adapters.mcap.windows.rewriting import write_result
from coec.adapters.mcap.windows.salvage import salvage
from coec.adapters.mcap.windows.writer import RecordedWindow, WindowWriter

__all__ = [
    "PART_SUFFIX",
    "REWRITE_SUFFIX",
    "SUFFIX",
    "RecordedWindow",
    "WindowWriter",
    "is_window",
    "pairs_since",
    "read_result",
    "read_vehicle",
    "read_window",
    "salvage",
    "write_result",
]
