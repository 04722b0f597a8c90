"""The operating system: threads that report progress, memory and processor time of processes, settings of the
allocator, the service manager, the state of the clock, listening sockets, file locks, and keys of a terminal.

systemd: its readiness protocol (sd_notify), without a library: one datagram to the socket in NOTIFY_SOCKET. A container
engine runs a command now and then (HEALTHCHECK), which needs something to look at: the file in COEC_HEARTBEAT_FILE. The
time of the file is that of the last progress. Its line is the address of the HTTP pages, `HOST PORT`, or `-` if there
are none.
"""

from __future__ import annotations

import contextlib
import ctypes
import ipaddress
import logging
import os
import select
import signal
import socket
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from coec.io import storage

_log = logging.getLogger(__name__)


class ServiceThread:
    """Runs `body(self)` until it returns. The body calls `beat()` in every round and returns soon after `stopping`.

    An exception that escapes the body ends the thread and is kept in `failure`, for the main loop to act on.
    """

    def __init__(self, name: str, body: Callable[[ServiceThread], None]) -> None:
        self.name = name
        self.failure: BaseException | None = None
        self._body = body
        self._stop = threading.Event()
        self._beat_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._beat_s = time.monotonic()
        self._thread.start()

    def beat(self) -> None:
        """The body has made progress."""
        self._beat_s = time.monotonic()

    @property
    def silence_s(self) -> float:
        """Seconds since the last beat."""
        return time.monotonic() - self._beat_s

    @property
    def stopping(self) -> bool:
        """Whether the body has been asked to return."""
        return self._stop.is_set()

    @property
    def dead(self) -> bool:
        """Whether the thread ended without having been asked to."""
        return self._thread.ident is not None and not self._thread.is_alive() and not self._stop.is_set()

    def request_stop(self) -> None:
        """Ask the body to return. If the body waits for more than a short timeout, the caller has to wake it."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; False if the thread still runs after `timeout_s`."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._body(self)
        except BaseException as error:
            self.failure = error
            _log.exception("a thread died", extra={"fields": {"thread": self.name}})


LOOPBACK_OF_WILDCARD = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""Addresses on which a server listens everywhere, and those at which the same computer reaches it."""


class ServiceManagerNotifier:
    """Tells the service manager the state of the process; does nothing if there is no manager."""

    def __init__(self, address: str | None, heartbeat: Path | None = None) -> None:
        """`address` is the value of NOTIFY_SOCKET: a path, `@name` in the abstract namespace, or None. `heartbeat` is
        the file in memory for a health check; None: nobody looks at one."""
        self._address = "\0" + address[1:] if address and address.startswith("@") else address
        self._heartbeat = heartbeat
        self._written: bytes | None = None

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> ServiceManagerNotifier:
        """The notifier of the manager that started this process."""
        heartbeat = environment.get("COEC_HEARTBEAT_FILE")
        return cls(environment.get("NOTIFY_SOCKET"), Path(heartbeat) if heartbeat else None)

    def starting(self, within_s: float) -> None:
        """The start makes progress; the next message comes within `within_s`."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(within_s * 1e6)}")

    def ready(self) -> None:
        """The service answers and can calibrate."""
        self._send("READY=1")

    def reloading(self) -> None:
        """The configuration is being read again; call `ready` when that is done."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def watchdog(self, http: tuple[str, int] | None = None) -> None:
        """Every thread has made progress since the last call. `http` is where the HTTP pages are served; None:
        nowhere."""
        self._send("WATCHDOG=1")
        self._beat(b"-\n" if http is None else f"{LOOPBACK_OF_WILDCARD.get(http[0], http[0])} {http[1]}\n".encode())

    def stopping(self) -> None:
        """The shutdown has begun."""
        self._send("STOPPING=1")
        if self._heartbeat is not None:
            with contextlib.suppress(OSError):
                self._heartbeat.unlink(missing_ok=True)

    def _beat(self, line: bytes) -> None:
        """Renews the time of the file, and writes it if its line has changed or the file has gone."""
        if self._heartbeat is None:
            return
        with contextlib.suppress(OSError):
            if line == self._written:
                with contextlib.suppress(FileNotFoundError):
                    os.utime(self._heartbeat, follow_symlinks=False)
                    return
            storage.replace(self._heartbeat, line)
            self._written = line

    def _send(self, message: str) -> None:
        if not self._address:
            return
        # Go on calibrating even if the manager has gone.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.connect(self._address)
            sock.send(message.encode())


M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -2, -3, -8
"""Parameters of mallopt(3)."""

MAX_ARENAS = 1
"""Number of arenas of the heap. By default there are eight per core, and each keeps the largest frames that its thread
has ever freed: under the load of a vehicle the service grew from 280 to 330 MB within half a minute. With two arenas it
stays at 254 MB, with one at 248 MB, without a difference in processor time or in the round trips of queries."""

LARGE_ALLOCATION_BYTES = 2**20
"""Arrays from this size on get separate maps. By default this limit rises up to 32 MiB as memory is freed, which leaves
holes between the maps of a window. See docs/measured.md."""

FRAME_ALLOCATION_BYTES = 8 * 2**20
"""Larger than the frames that sensors send repeatedly (clouds of 2 MB, raw images of 6 MB), so that these get memory
that was just freed. If it were mapped anew each time, the system would clear every page first. See docs/measured.md."""

RETAINED_HEAP_BYTES = 32 * 2**20
"""Free memory that may stay at the end of the heap until `trim_heap`."""


def limit_arenas() -> None:
    """For a process in which frames pass through many threads. Call it before these threads start."""
    _set_malloc_option(M_ARENA_MAX, MAX_ARENAS)


def return_large_allocations() -> None:
    """For a process that works on large arrays: freed arrays go back to the system at once."""
    _set_malloc_option(M_MMAP_THRESHOLD, LARGE_ALLOCATION_BYTES)


def reuse_frame_memory() -> None:
    """For a process through which frames pass: later frames reuse the memory of earlier ones. Larger memory goes back
    to the system at once, the rest with `trim_heap`."""
    _set_malloc_option(M_MMAP_THRESHOLD, FRAME_ALLOCATION_BYTES)
    _set_malloc_option(M_TRIM_THRESHOLD, RETAINED_HEAP_BYTES)
    _set_malloc_option(M_TOP_PAD, FRAME_ALLOCATION_BYTES)


def trim_heap() -> None:
    """Give memory that was freed in small pieces, between pieces still in use, back to the system: Zenoh receives in
    pieces of 64 KiB, hundreds for a large message. Takes milliseconds per 100 MB in use."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _set_malloc_option(parameter: int, value: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(parameter, value)


def resident_bytes(pid: int | None = None) -> int:
    """Resident memory of a process (None: this one); 0 if it is gone or the system does not tell."""
    try:
        pages = int(Path(f"/proc/{'self' if pid is None else pid}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def processor_time_s(pid: int) -> float:
    """Processor time of all threads of a process since it began, s, to the microsecond.

    Raises:
        OSError: the process is gone.
    """
    # The clock of a process: the complement of its id, and CPUCLOCK_SCHED (clock_getcpuclockid(3), Linux).
    return time.clock_gettime((~pid << 3) | 2)


PR_SET_PDEATHSIG = 1  # prctl(2)


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when the thread of process `parent` that started it ends, in whatever way."""
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent died before the call above
        sys.exit(0)


THREAD_COUNT_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables that set how many threads a library starts; a library reads them when it is imported."""

ONE_THREAD = dict.fromkeys(THREAD_COUNT_VARIABLES, "1")
"""The environment of a process that keeps to one core."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started inside the context keep to one core each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


TIME_ERROR = 5
"""State of a kernel clock that is not synchronised; adjtimex(2)."""


class _Timex(ctypes.Structure):
    """The beginning of `struct timex`, and room for the rest that the kernel fills."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


@dataclass(frozen=True, slots=True)
class ClockState:
    """What the kernel knows: whether a daemon (NTP, PTP) steers the clock, and the clock's largest error, s."""

    synchronised: bool
    max_error_s: float


def clock_state() -> ClockState | None:
    """The state now; None if the system does not tell."""
    adjtimex = getattr(ctypes.CDLL(None), "adjtimex", None)
    if adjtimex is None:
        return None
    timex = _Timex()
    state = adjtimex(ctypes.byref(timex))  # no mode is set: nothing is adjusted
    return None if state < 0 else ClockState(state != TIME_ERROR, timex.maxerror / 1e6)


def lock_holder(path: Path) -> int | None:
    """Id of a process that holds flock(2) on a file; None if none does, or if the system does not tell; 0 for a process
    that this one cannot see."""
    try:
        status, lines = path.stat(), Path("/proc/locks").read_text().splitlines()
    except OSError:
        return None
    file = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    for line in lines:
        columns = line.split()
        if len(columns) >= 6 and columns[1] == "FLOCK" and columns[5] == file:
            return int(columns[4])
    return None


IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address
Transport = Literal["tcp", "udp"]

SOCKET_TABLES = {"tcp": ("tcp", "tcp6"), "udp": ("udp", "udp6")}
LISTENING_STATES = {"tcp": "0A", "udp": "07"}
"""Their state in the tables: LISTEN for TCP, and CLOSE for UDP, the state of a socket without a peer."""

PROC_NET = Path("/proc/net")
"""Tables of the network namespace of this process."""


def listening_addresses(protocol: Transport, port: int, tables: Path = PROC_NET) -> set[IpAddress]:
    """Addresses at which a process listens on a port.

    Raises:
        OSError: this system does not tell.
    """
    texts = [
        (tables / name).read_text() for name in SOCKET_TABLES[protocol] if name == protocol or (tables / name).exists()
    ]
    return {
        address
        for text in texts
        for address, listening_port in _listening_sockets(text, LISTENING_STATES[protocol])
        if listening_port == port
    }


def _listening_sockets(table: str, state: str) -> Iterator[tuple[IpAddress, int]]:
    for line in table.splitlines()[1:]:
        columns = line.split()
        if columns[3] == state:
            digits, _, port = columns[1].partition(":")
            address = ipaddress.ip_address(_in_network_order(digits))
            # An IPv6 socket may be bound to an IPv4 address.
            yield getattr(address, "ipv4_mapped", None) or address, int(port, 16)


def _in_network_order(digits: str) -> bytes:
    """The bytes of an address; the kernel writes it as words of 32 bits in the byte order of the machine."""
    data = bytes.fromhex(digits)
    groups = (data[start : start + 4] for start in range(0, len(data), 4))
    return b"".join(word[::-1] if sys.byteorder == "little" else word for word in groups)


KEY_NAMES = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[5~": "page up", b"\x1b[6~": "page down", b"\r": "enter"}
"""What keys without a letter send (ECMA-48, as in xterm and the Linux console)."""

MAX_KEY_BYTES = 64
"""Bytes read at once, enough for a key that is held down."""


@contextmanager
def pressed_keys() -> Iterator[Callable[[float], str | None]]:
    """Yields `poll(wait_s)`, which returns the next pressed key or None. Afterwards the terminal is as before. Signals
    (Ctrl-C) work as usual. If standard input is no terminal, `poll` always returns None."""
    if not sys.stdin.isatty():
        yield lambda wait_s: _no_key(wait_s)
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)
    try:
        yield lambda wait_s: _next_key(descriptor, wait_s)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _next_key(descriptor: int, wait_s: float) -> str | None:
    ready, _, _ = select.select([descriptor], [], [], wait_s)
    if not ready:
        return None
    data = os.read(descriptor, MAX_KEY_BYTES)
    return KEY_NAMES.get(data) or data[:1].decode("ascii", errors="ignore") or None


def _no_key(wait_s: float) -> str | None:
    select.select([], [], [], wait_s)
    return None
