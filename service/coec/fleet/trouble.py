"""Rows of windows that have no result."""

from __future__ import annotations

from coec import __version__
from coec.fleet.places import Job
from coec.schemas.fleet import WindowRow


def empty_row(job: Job, versions: dict[str, str]) -> WindowRow:
    """The row of a window of which nothing is known yet."""
    return WindowRow(url=job.url, sha256=None, bytes=None, vehicle="", seconds=0.0, cpu_s=0.0, versions=versions)


def failed_row(row: WindowRow, code: str, text: str) -> WindowRow:
    """A row that says why there is no result."""
    return row.model_copy(update={"result": None, "decided": None, "error_code": code, "error": text})


def lost_row(job: Job, code: str, text: str) -> WindowRow:
    """The row of a window whose process ended."""
    return failed_row(empty_row(job, {"coec": __version__}), code, text)
