"""Fixtures and rules for all tests."""

from __future__ import annotations

import gc
import json
import os
import shutil
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

from faults import FaultTable, rows_of_item

if TYPE_CHECKING:
    from e2e.processes import Router
    from support.router import TestAuthority

REPOSITORY = Path(__file__).resolve().parent.parent
TESTS = REPOSITORY / "tests"
BENCHMARKS = TESTS / "bench"

LONGEST_FIRST = (
    "test_readme.py",
    "e2e/test_step.py",
    "e2e/test_service.py",
    "service/worker",
    "e2e",
    "soak",
    "test_daemon.py",
    "deploy/test_vehicle.py",
    "peers",
    "lab",
    "calibration",
    "service",
    "cli",
    "golden",
    "reports",
    "campaign",
    "deploy",
)
"""Files and folders whose tests start processes, and those that calibrate. A parallel run hands out one file after the
other: a long one that comes last is waited for by a core that has nothing to do."""

# The same examples in every run, and no verdict from the speed of the machine. The long run tries twice as many.
for profile, examples in (("short", 50), ("long", 100)):
    hypothesis.settings.register_profile(profile, derandomize=True, deadline=None, database=None, max_examples=examples)
hypothesis.settings.load_profile("short")


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--faults FILE``: write the table of faults and promises (``tests/faults.py``): `tests/faults.json`, which is
    committed, or a page such as `build/faults.md`.
    ``--write-golden``: replace the golden decisions (``tests/golden``)."""
    parser.addoption("--faults", type=Path, metavar="FILE", help="write the table of faults and promises")
    parser.addoption("--write-golden", action="store_true", help="replace the golden decisions by today's")


def pytest_configure(config: pytest.Config) -> None:
    """The process that hears of all tests writes the table, not the workers of a parallel run."""
    if not config.getoption("markexpr"):
        hypothesis.settings.load_profile("long")
    table: Path | None = config.getoption("faults")
    if table is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(FaultTable(table))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Thousands of tests stay until the end: the garbage collector neither looks for waste among them while they come
    nor walks through them again and again while they run."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_unconfigure() -> None:
    """What ends with the process is found as waste again: libraries complain of what they believe to be lost."""
    gc.unfreeze()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave benchmarks to the long run: how fast the machine is at the moment is no verdict on a change.
    Long files come first.

    What a test is marked to hold travels with its report, from whatever process it runs in.
    """
    turns = {path: _file_order(path) for path in {item.path for item in items}}
    items.sort(key=lambda item: turns[item.path])
    benchmarks = {path for path in turns if path.is_relative_to(BENCHMARKS)}
    for item in items:
        if item.path in benchmarks:
            item.add_marker("slow")
        item.user_properties.extend(("fault", json.dumps(row)) for row in rows_of_item(item))


def _file_order(path: Path) -> int:
    """When a file comes; files of one turn stay in their order."""
    turns = (turn for turn, name in enumerate(LONGEST_FIRST) if path.is_relative_to(TESTS / name))
    return next(turns, len(LONGEST_FIRST))


@pytest.fixture(scope="session", autouse=True)
def one_thread_a_worker() -> Iterator[None]:
    """Kernels of a parallel run have one thread: those of several processes on the same cores wait for each other,
    which takes a third of the processor time."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        yield
        return
    from coec.geometry.compiler import on_one_thread  # numba, which a single test may do without

    with on_one_thread():
        yield


@pytest.fixture(scope="session")
def sample_data() -> Path:
    """The folder of the sample recordings: $COEC_SAMPLE_DATA, else ../shared/data beside the checkout.

    Skips the test where that folder is absent.
    """
    configured = os.environ.get("COEC_SAMPLE_DATA")
    folder = Path(configured) if configured else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs the sample recordings: {folder} is absent; COEC_SAMPLE_DATA may name another folder")
    return folder


@pytest.fixture(scope="session")
def authority(tmp_path_factory: pytest.TempPathFactory) -> TestAuthority:
    """Certificates of one authority; skips the test where there is no openssl to make them."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    from support.router import make_authority

    return make_authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="session")
def router() -> Iterator[Router]:
    """The router of all services that a run starts, which come one after the other."""
    from e2e.processes import routing  # Zenoh and more, which most tests do without

    with routing() as session_router:
        yield session_router
