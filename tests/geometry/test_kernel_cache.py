"""Where compiled kernels are kept: private, writable, and another place after every edit of a source; by two processes
at once; and for which processors."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import IndexDataCacheFile

import coec
from coec.geometry.compiler import kernel_cache_directory, with_wide_registers


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two sources, one of them in a sub-package."""
    folder = tmp_path / "package"
    (folder / "inner").mkdir(parents=True)
    (folder / "outer.py").write_text("a = 1\n")
    (folder / "inner" / "formula.py").write_text("b = 2\n")
    return folder


def test_it_lies_in_the_users_cache_and_is_private(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    directory = kernel_cache_directory(package)
    assert directory.parent == tmp_path / "cache" / "coec"
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    assert kernel_cache_directory(package) == directory


def test_an_edit_in_any_source_moves_it(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    before = kernel_cache_directory(package)
    (package / "inner" / "formula.py").write_text("b = 3\n")
    after = kernel_cache_directory(package)
    (package / "inner" / "formula.py").rename(package / "inner" / "other.py")
    assert len({before, after, kernel_cache_directory(package)}) == 3


def test_a_new_version_removes_kernels_that_no_process_used_for_a_month(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    day_s, now_s = 86_400.0, time.time()
    used = {days: tmp_path / "cache" / "coec" / f"kernels-{days:012d}" for days in (31, 29)}
    for days, directory in used.items():
        directory.mkdir(parents=True)
        (directory / "kernel.nbi").touch()
        os.utime(directory, (now_s - days * day_s,) * 2)
    other = tmp_path / "cache" / "coec" / "maps"
    other.mkdir()
    os.utime(other, (0.0, 0.0))
    current = kernel_cache_directory(package)
    assert sorted(current.parent.iterdir()) == sorted([current, used[29], other])
    os.utime(current, (0.0, 0.0))
    kernel_cache_directory(package)
    assert now_s - current.stat().st_mtime < day_s  # in use


def test_without_a_usable_cache_it_lies_in_the_temporary_folder(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "occupied").write_text("a file, not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "occupied"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    directory = kernel_cache_directory(package)
    assert directory.parent == tmp_path
    assert kernel_cache_directory(package) == directory


@pytest.mark.fault("a cache of compiled kernels that others may write to", "it is not used")
def test_a_directory_that_others_may_write_to_is_not_used(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    open_to_all = kernel_cache_directory(package)
    open_to_all.chmod(0o777)
    second = kernel_cache_directory(package)
    second.chmod(0o777)
    third = kernel_cache_directory(package)
    assert len({open_to_all, second, third}) == 3
    assert stat.S_IMODE(third.stat().st_mode) == 0o700


def _numba_cache_directory(environment: dict[str, str]) -> str:
    code = "import coec.geometry.compiler, numba; print(numba.config.CACHE_DIR)"
    source_root = str(Path(coec.__file__).parents[1])
    result = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": source_root} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout.strip()


def test_the_import_sets_it_unless_the_user_has(tmp_path: Path) -> None:
    cache_home = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    ours = Path(_numba_cache_directory(cache_home | {"NUMBA_CACHE_DIR": ""}))
    assert ours.parent == tmp_path / "cache" / "coec"
    theirs = _numba_cache_directory(cache_home | {"NUMBA_CACHE_DIR": str(tmp_path / "mine")})
    assert theirs == str(tmp_path / "mine")


COMPILES = """
from coec.geometry import compilation_events
with compilation_events.listening(print):
    import numpy
    from coec.geometry.images import level_counts
    level_counts(numpy.zeros((4, 4), numpy.uint8), 1)
"""


def _compiled(checkout: Path, cache: Path) -> bool:
    """Whether a process with the program from another place compiles a kernel."""
    environment = {"PYTHONPATH": str(checkout), "XDG_CACHE_HOME": str(cache), "NUMBA_CACHE_DIR": ""}
    command = [sys.executable, "-c", COMPILES]
    done = subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=True, cwd=checkout
    )
    return bool(done.stdout)


def test_a_program_that_is_installed_again_detects_its_kernels_and_an_edited_one_does_not(tmp_path: Path) -> None:
    source = Path(coec.__file__).parent
    first, again, edited = (tmp_path / name for name in ("first", "again", "edited"))
    for checkout in (first, again, edited):
        (checkout / "coec").mkdir(parents=True)
        shutil.copytree(source / "geometry", checkout / "coec" / "geometry", copy_function=shutil.copyfile)
        for module in source.glob("*.py"):
            shutil.copyfile(module, checkout / "coec" / module.name)
    formula = edited / "coec" / "geometry" / "cameras" / "pinhole.py"
    formula.write_text(formula.read_text() + "\n# edited\n")
    assert _compiled(first, tmp_path / "cache")
    assert not _compiled(first, tmp_path / "cache")
    assert not _compiled(again, tmp_path / "cache")
    assert _compiled(edited, tmp_path / "cache")


def test_only_processors_that_hold_their_clock_use_registers_of_512_bits() -> None:
    first, later = "+avx2,+avx512f,-avx512vbmi2", "+avx2,+avx512f,+avx512vbmi2"
    assert with_wide_registers("+avx2,-avx512f") == "+avx2,-avx512f"
    assert with_wide_registers(first) == first
    assert with_wide_registers(later) == f"{later},-prefer-256-bit"


def test_who_save_a_kernel_for_different_types_at_once_do_not_get_the_code_of_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache_file: Any = IndexDataCacheFile
    observation, both_checked = cache_file._load_index, threading.Barrier(2)

    def hesitate(self: object) -> Any:
        detected = observation(self)
        # Where one has to wait until the other has saved, nobody comes to meet it here.
        with suppress(threading.BrokenBarrierError):
            both_checked.wait(0.2)
        return detected

    def save(types: str) -> None:
        cache_file(str(tmp_path), "kernel", "stamp").save(types, f"code for {types}")

    with monkeypatch.context() as patched, ThreadPoolExecutor(2) as pool:
        patched.setattr(cache_file, "_load_index", hesitate)
        list(pool.map(save, ("float32", "float64")))
    retained = cache_file(str(tmp_path), "kernel", "stamp")
    assert [retained.load(types) for types in ("float32", "float64")] == ["code for float32", "code for float64"]
