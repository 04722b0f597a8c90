"""numba, as every kernel of this program imports it: with its on-disk cache in a directory of the user, with the
formulas of the camera models registered, and with prefetching of memory.

The directory is keyed by a hash of the sources in `coec.geometry`. numba itself only looks at the file that holds the
outermost kernel, so that after an edit to a camera formula it would use a stale kernel from another file. It also keys
a kernel by the place and the time of that file, so that a program that is installed again would compile all of them
again. Those of this program are keyed by what their files say.

The camera model is chosen at compile time, by the type of the camera. A kernel therefore needs no branch and no code
per model, and numba caches it on disk, which it does not do for a kernel that takes a function as an argument.

No formula uses fastmath. numba compiles a parallel kernel twice: for the process that first runs it, and for the cache.
If it may re-associate and fuse, the two differ in the last bit, but decisions have to replay to the byte. The loops
vectorise anyway. (The one exception, `projection.certain_pixels`, compiles these formulas for itself and answers only
where the last bits do not matter.)

Importing this module loads a compiler: 70 MB and a third of a second, which the process that serves queries avoids.
"""

import fcntl
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils, event
from numba.core.caching import CacheImpl, IndexDataCacheFile, _CacheLocator
from numba.core.codegen import get_host_cpu_features
from numba.core.cpu_options import ParallelOptions
from numba.extending import intrinsic, overload, register_jitable
from numpy.typing import NDArray

from coec.geometry import compilation_events
from coec.geometry.cameras.base import (
    arc_over_tangent,
    distort,
    guarded_pixel,
    guarded_ray,
    like,
    odd_polynomial,
    polar_angle,
    solve_odd_polynomial,
    undistort,
)
from coec.geometry.cameras.registry import HELPERS, image_point, model_of, project_point, unproject_point

__all__ = ["PRANGE", "njit", "on_one_thread", "prange"]

_ARRAY_OPERATIONS = ("comprehension", "fusion", "inplace_binop", "numpy", "reduction", "setitem", "stencil")

PRANGE: Any = ParallelOptions({"prange": True} | dict.fromkeys(_ARRAY_OPERATIONS, False))
"""For `parallel=`: only a kernel's `prange` loops are shared among threads. By default numba would also make a parallel
loop of every operation on an array, however short, and each of those takes a second to compile."""

# Twelve hexadecimal digits are 48 bits, enough to distinguish the edits of one code base.
_HASH_DIGITS = 12

_PACKAGES = ("coec", "coec_lab")
"""The packages of this program."""

_KERNELS = "kernels-"
"""How the name of a directory of kernels begins; a hash follows."""

_UNUSED_S = 30 * 86_400.0
"""After which time kernels that no process uses are removed: 10 to 80 MB for each version that was installed."""

_FRESH = "coec-fresh-"
"""How the name of a directory begins that only one process uses."""


def _sources_hash(package: Path) -> str:
    """Hex digest over the paths and contents of all Python sources below `package`."""
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.relative_to(package).as_posix().encode() + b"\0")
        digest.update(source.read_bytes() + b"\0")
    return digest.hexdigest()[:_HASH_DIGITS]


def _user_cache_root() -> Path:
    """$XDG_CACHE_HOME, or ~/.cache. Raises RuntimeError if the user has no home."""
    configured = os.environ.get("XDG_CACHE_HOME", "")
    return Path(configured) if Path(configured).is_absolute() else Path.home() / ".cache"


def _private_directory(directory: Path) -> bool:
    """Create `directory` if need be; true if we may write to it and nobody else may.

    numba's cache holds pickled objects and machine code, so whoever can write to it can run code in our name.
    """
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = directory.lstat()
    except OSError:
        return False
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.geteuid()
        and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        and os.access(directory, os.W_OK | os.X_OK)
    )


def _remove_unused(directory: Path) -> None:
    """Removes the directories beside `directory`, which is used now, that no process has used for `_UNUSED_S`."""
    now_s = directory.stat().st_mtime
    for other in directory.parent.glob(f"{_KERNELS}*"):
        with suppress(OSError):
            if now_s - other.lstat().st_mtime > _UNUSED_S:
                shutil.rmtree(other)


def kernel_cache_directory(package: Path) -> Path:
    """A private, writable directory for the compiled kernels of the sources below `package`.

    `<user cache>/coec/kernels-<hash>`, else `<temporary folder>/coec-kernels-<user>-<hash>`, else a fresh temporary
    directory (then every process compiles anew). The first process of a version removes the directories of versions
    that have not run for a month.
    """
    name = f"{_KERNELS}{_sources_hash(package)}"
    temporary = Path(tempfile.gettempdir()) / f"coec-{os.geteuid()}-{name}"
    try:
        candidates = [_user_cache_root() / "coec" / name, temporary]
    except RuntimeError:
        candidates = [temporary]
    for candidate in candidates:
        is_new = not candidate.exists()
        if _private_directory(candidate):
            os.utime(candidate)
            if is_new:
                _remove_unused(candidate)
            return candidate
    return Path(tempfile.mkdtemp(prefix=f"{_FRESH}{name}-"))


def kernel_cache() -> tuple[Path, bool]:
    """The directory in which this process caches compiled kernels, and whether another process will find it again."""
    directory = Path(numba.config.CACHE_DIR)  # type: ignore[attr-defined]
    return directory, not directory.name.startswith(_FRESH)


_WIDE = "+avx512vbmi2"
"""A feature of the processors that do not lower their clock for registers of 512 bits: Intel's from Ice Lake on, AMD's
from Zen 4 on."""


def with_wide_registers(features: str) -> str:
    """The features of a processor, as LLVM lists them, plus registers of 512 bits if they do not lower its clock.

    LLVM uses 256 bits on every Intel processor, because the first ones with wider registers slowed down with them. One
    MI of 25 frames through a lens of the MEI model takes 5.7 ms of one thread with 256 bits, and 4.2 ms with 512. The
    order of sums is the same either way.
    """
    return f"{features},-prefer-256-bit" if _WIDE in features.split(",") else features


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Inside the context, kernels called by this thread run on it alone. Results are the same to the last bit.

    For work that consists of many kernels of some 50 µs each. Waking another thread and waiting for it takes as long
    and costs more processor time: a look at six pairs of 1400×1400 takes 94 ms of the processor on one thread, 152 ms
    on two.
    """
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


# A program that imported numba before `coec` has its configuration from an environment without the threading layer that
# `coec` chooses. numba would read it again at the next kernel, and forget what is set below.
numba.config.reload_config()

# Threads of a parallel kernel must not spin while they wait: with other processes on the cores, spinning made a small
# solve take 1 to 5 s instead of 0.1 s. The OpenMP runtime reads this when numba loads it; a value set by the user wins.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# They spin for a short time, though, because waking a thread takes as long as many a kernel: 3000 turns are some 150
# µs, after which a thread sleeps. On two quiet cores a fused solve of 25 frames then takes 0.75 s instead of 0.92 s; on
# busy cores it takes as long as without.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

if numba.config.CPU_FEATURES is None:  # type: ignore[attr-defined]  # features set by the user win
    numba.config.CPU_FEATURES = with_wide_registers(get_host_cpu_features())  # type: ignore[attr-defined]

_GEOMETRY = Path(__file__).parent

if not os.environ.get("NUMBA_CACHE_DIR"):  # a directory set by the user wins
    # mypy does not know the attribute: numba's configuration module fills itself at run time.
    numba.config.CACHE_DIR = str(kernel_cache_directory(_GEOMETRY))  # type: ignore[attr-defined]


class _BySource(_CacheLocator):
    """Keys a kernel of this program by its module, the sources of `coec.geometry` and its own file."""

    _OF_GEOMETRY = _sources_hash(_GEOMETRY)

    def __init__(self, kernel: Callable[..., Any], file: str) -> None:
        folder, _, _ = kernel.__module__.rpartition(".")
        self._folder = str(Path(numba.config.CACHE_DIR, folder))  # type: ignore[attr-defined]
        self._line = kernel.__code__.co_firstlineno
        self._stamp = self._OF_GEOMETRY, hashlib.sha256(Path(file).read_bytes()).hexdigest()

    @classmethod
    def from_function(cls, kernel: Callable[..., Any], file: str) -> "_BySource | None":
        if kernel.__module__.partition(".")[0] not in _PACKAGES or not Path(file).is_file():
            return None
        locator = cls(kernel, file)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None  # numba's own locators then find another place, or none
        return locator

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> tuple[str, str]:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)


CacheImpl._locator_classes.insert(0, _BySource)


_save = IndexDataCacheFile.save


def _save_alone(self: IndexDataCacheFile, key: Any, data: Any) -> None:
    """Save, one process at a time. Without the lock numba lists the files of a kernel, takes the next number, and
    writes. Of two processes that compile a kernel for different types at once, one would then find the other's machine
    code."""
    with Path(self._cache_path, "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _save(self, key, data)


IndexDataCacheFile.save = _save_alone  # type: ignore[method-assign]  # there is no other hook


class _Passes(event.Listener):
    """Reports each compiler pass. A kernel from the cache goes through none."""

    def on_start(self, event: Any) -> None:
        compilation_events.notify(event.data["qualname"])

    def on_end(self, event: Any) -> None:
        pass


class _Kernels(event.Listener):
    """Reports the end of each compilation. Kernels are compiled inside of those that call them, on any thread, but by
    numba one at a time."""

    def __init__(self) -> None:
        self._depth = 0

    def on_start(self, event: Any) -> None:
        del event
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if not self._depth:
            compilation_events.end(event.data["dispatcher"].py_func.__qualname__)


event.register("numba:run_pass", _Passes())
event.register("numba:compile", _Kernels())


# A division by zero gives an infinity, not a branch to an exception. The formulas have options of their own instead of
# their caller's, so that NaN stays invalid in a caller with fastmath.
_OPTIONS: Any = {"error_model": "numpy"}

_FORMULAS: tuple[Any, ...] = (
    distort, guarded_pixel, guarded_ray, odd_polynomial, polar_angle, project_point, solve_odd_polynomial, undistort,
    *HELPERS,
)  # fmt: skip

for _formula in _FORMULAS:
    register_jitable(**_OPTIONS)(_formula)


# `strict=False`: the annotations differ between the two signatures, and numba would compare them.
@overload(image_point, jit_options=_OPTIONS, strict=False)
def _image_point(
    camera: types.NamedTuple,
    x: types.Type,  # noqa: ARG001  (numba matches the names)
    y: types.Type,  # noqa: ARG001
    z: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).image_point


@overload(unproject_point, jit_options=_OPTIONS, strict=False)
def _unproject_point(
    camera: types.NamedTuple,
    u: types.Type,  # noqa: ARG001
    v: types.Type,  # noqa: ARG001
) -> Callable[..., Any]:
    return model_of(camera.instance_class).unproject_point


@overload(like, strict=False)
def _like(constant: types.Type, value: types.Type) -> Callable[..., Any]:  # noqa: ARG001
    if value == types.float32:
        return lambda constant, value: np.float32(constant)  # noqa: ARG005
    return lambda constant, value: constant  # noqa: ARG005


# As `arc_over_tangent`, from five Chebyshev nodes. Largest error 7e-9, below the rounding of a float32.
_S0, _S1, _S2, _S3, _S4 = (
    np.float32(c)
    for c in (0.9999999812646112, -0.3333278577192708, 0.19974082415558878, -0.13848490212710987, 0.07976291808000396)
)


def _arc_over_tangent_single(s: np.float32) -> np.float32:
    return _S0 + s * (_S1 + s * (_S2 + s * (_S3 + s * _S4)))


@overload(arc_over_tangent, jit_options=_OPTIONS, strict=False)
def _arc_over_tangent(s: types.Type) -> Callable[..., Any]:
    return _arc_over_tangent_single if s == types.float32 else arc_over_tangent


_READ, _SECOND_LEVEL, _DATA = 0, 2, 1
"""Arguments of LLVM's `prefetch`: for reading; keep in the second-level cache and below; data, not code."""

_SIGNATURE = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, *[cgutils.int32_t] * 3])


@intrinsic
def _prefetch(context: Any, array: types.Array, index: types.Integer) -> tuple[Any, Any]:  # noqa: ARG001
    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        entry = cgutils.get_item_pointer(context, builder, signature.args[0], values, [arguments[1]])
        function = builder.module.declare_intrinsic("llvm.prefetch", [cgutils.voidptr_t], _SIGNATURE)
        options = [cgutils.int32_t(option) for option in (_READ, _SECOND_LEVEL, _DATA)]
        builder.call(function, [builder.bitcast(entry, cgutils.voidptr_t), *options])
        return context.get_dummy_value()

    return types.void(array, index), generate


prefetch = cast("Callable[[NDArray[Any], np.integer], None]", _prefetch)
"""`prefetch(array, index)` begins to fetch the cache line of an entry of an array (n,). It does not wait, and an index
outside of the array does no harm."""
