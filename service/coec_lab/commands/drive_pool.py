"""Many simulated drives at once, each in one process on one core; finished ones stay on disk."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from coec.errors import CoecError
from coec.io import user_files
from coec.io.system import die_with_parent, one_thread_each

_Drive = TypeVar("_Drive")
_Row = TypeVar("_Row")
_Document = TypeVar("_Document", bound=BaseModel)


class DrivesError(CoecError):
    """Simulated drives could not be run to their end."""

    reply_code = "drives_failed"


def finished(work: Callable[[_Drive], _Row], drives: Sequence[_Drive], jobs: int | None) -> Iterator[_Row]:
    """The result of `work` for each drive, in the order in which drives finish, by `jobs` processes (None: one per
    core).

    `work`, the drives and the results are sent between processes, unless one process is enough.

    Raises:
        DrivesError: a process died.
    """
    processes = min(jobs or os.cpu_count() or 1, len(drives))
    if processes <= 1:
        yield from map(work, drives)
        return
    with one_thread_each():
        spawn = multiprocessing.get_context("spawn")
        # If the command is killed, its processes end, too.
        pool = ProcessPoolExecutor(processes, spawn, initializer=die_with_parent, initargs=(os.getpid(),))
        try:
            for done in as_completed([pool.submit(work, drive) for drive in drives]):
                yield done.result()
        except BrokenProcessPool as error:
            raise DrivesError(
                "a process that ran a drive died, possibly out of memory: run the command again with fewer --jobs; "
                "finished drives are retained"
            ) from error
        finally:  # also if the caller stops before the end
            pool.shutdown(cancel_futures=True)


def drive_file(folder: Path, name: str) -> Path:
    """File of the result of a drive."""
    return folder / "drives" / f"{name}.json"


def resumed(
    folder: Path, names: Sequence[str], model: type[_Document], is_current: Callable[[_Document], bool] = lambda _: True
) -> dict[str, _Document]:
    """Results that an earlier run left in the folder, by the name of their drive; without those that are damaged or not
    current."""
    rows = ((name, user_files.load_document(drive_file(folder, name), model)) for name in names)
    return {name: row for name, row in rows if row is not None and is_current(row)}
