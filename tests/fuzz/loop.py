"""The fuzzer: inputs that take a new way through our code are kept, and changed further.

What it is held against: a reader ends in a value or in an error of ours, within `MAX_CPU_S` and `MAX_BYTES` of memory.
"""

from __future__ import annotations

import hashlib
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import FrameType

from coec.errors import CoecError
from fuzz.arcs import Arc, Arcs
from fuzz.mutate import MAX_BYTES as MAX_INPUT_BYTES
from fuzz.mutate import Mutation, mutated_bytes

PACKAGE = Path(sys.modules["coec"].__path__[0])

MAX_CPU_S = 5.0
"""Of one input."""

MAX_BYTES = 500 * 2**20
"""What the process may grow by for one input."""

HUNG_CPU_S = 60.0
"""An input is given up after this: tracing makes it some ten times as slow as it is."""

CLEAR_REFS, PEAK_ANEW, STATUS = Path("/proc/self/clear_refs"), "5", Path("/proc/self/status")
"""See proc(5)."""

TIME = "time"
"""Place of a finding that is no place."""

SLOW_S = 0.5
"""An input that takes longer while it is traced is measured once more without."""


@dataclass(frozen=True, slots=True)
class Target:
    """One reader of what nobody vouches for.

    Attributes:
        read: gives it an input; there is a folder for those that read files.
        seeds: inputs that it takes, to begin with.
        mutations: those that know the format.
        labels: what it looks for.
        refusals: the errors with which it may end.
    """

    name: str
    read: Callable[[bytes, Path], object]
    seeds: Callable[[], Sequence[bytes]]
    mutations: tuple[Mutation, ...] = ()
    labels: tuple[bytes, ...] = ()
    refusals: tuple[type[Exception], ...] = (CoecError,)


@dataclass(frozen=True, slots=True)
class Finding:
    """An input that broke the promise. `place` is the same for all that break it in the same way."""

    place: str
    text: str
    data: bytes


@dataclass(slots=True)
class Report:
    """What came of it."""

    executions: int = 0
    accepted: int = 0
    arcs: set[Arc] = field(default_factory=set)
    corpus: list[bytes] = field(default_factory=list)
    findings: dict[str, Finding] = field(default_factory=dict)
    slowest_s: float = 0.0
    grown_bytes: int = 0

    @property
    def lines(self) -> int:
        """Ways from one line to another that were taken."""
        return len({arc[:3] for arc in self.arcs})

    @property
    def figure(self) -> str:
        """In a line."""
        return (
            f"{self.executions} inputs, {len(self.corpus)} kept, {self.lines} ways through the code, "
            f"{len(self.findings)} findings, slowest {self.slowest_s:.2f} s, {self.grown_bytes >> 20} MB"
        )


class _HungError(BaseException):
    """It takes too long. No `Exception`: readers catch those."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What one input did: the promise that it broke, if any, as (place, text); what it took."""

    problem: tuple[str, str] | None
    accepted: bool
    cpu_s: float
    grown_bytes: int


def tried(target: Target, data: bytes, folder: Path) -> Trial:
    """Give an input to a target."""
    CLEAR_REFS.write_text(PEAK_ANEW)
    before = _peak_bytes()
    started_s = time.process_time()
    with _given_up_after(HUNG_CPU_S):
        problem, accepted = _read(target, data, folder)
    cpu_s = time.process_time() - started_s
    grown_bytes = _peak_bytes() - before
    if problem is None and grown_bytes > MAX_BYTES:
        problem = "memory", f"{grown_bytes >> 20} MB"
    return Trial(problem, accepted, cpu_s, grown_bytes)


class Fuzzer:
    """Fuzzes one target, always with the same inputs for the same seed and the same number of them."""

    def __init__(
        self,
        target: Target,
        folder: Path,
        seed: int,
        about_to_read: Callable[[bytes], None] = lambda _: None,
        code: Path = PACKAGE,
    ) -> None:
        """
        Args:
            folder: for the target's files; emptied by nobody.
            about_to_read: told of every input before it is read: the last one is what ended the process.
            code: the folder of the code whose ways are told apart.
        """
        self._target, self._folder = target, folder
        self._rng = Random(seed)
        self._about_to_read = about_to_read
        self._arcs = Arcs(code)
        self.report = Report()

    def replay(self, inputs: Iterable[bytes]) -> Report:
        """Read these, and keep those that take a new way."""
        for data in inputs:
            self._try(data)
        return self.report

    def mutate(self, enough: Callable[[Report], bool]) -> Report:
        """Read what becomes of those that are kept, until it is enough."""
        while not enough(self.report):
            self._try(self.next())
        return self.report

    def next(self) -> bytes:
        """A mutation of one that is kept."""
        rng, corpus = self._rng, self.report.corpus or [b""]
        # Half of the time one of the newest: they lead where nothing has been yet.
        data = rng.choice(corpus[-max(1, len(corpus) // 5) :] if rng.randrange(2) else corpus)
        if self._target.mutations and rng.randrange(2):
            # The input may not be of the format any more, or the format have no place for what was put into it.
            with suppress(Exception):
                return rng.choice(self._target.mutations)(rng, data)[:MAX_INPUT_BYTES]
        return mutated_bytes(rng, data, rng.choice(corpus), self._target.labels)

    def _try(self, data: bytes) -> None:
        report = self.report
        report.executions += 1
        self._about_to_read(data)
        with self._arcs:
            trial = tried(self._target, data, self._folder)
        cpu_s, problem = trial.cpu_s, trial.problem
        if cpu_s > SLOW_S and (problem is None or problem[0] == TIME):
            again = tried(self._target, data, self._folder)
            cpu_s, problem = again.cpu_s, again.problem
        if problem is None and cpu_s > MAX_CPU_S:
            problem = TIME, f"{cpu_s:.1f} s"
        report.accepted += trial.accepted
        report.slowest_s = max(report.slowest_s, cpu_s)
        report.grown_bytes = max(report.grown_bytes, trial.grown_bytes)
        if problem is not None:
            place, text = problem
            known = report.findings.get(place)
            if known is None or len(data) < len(known.data):
                report.findings[place] = Finding(place, text, data)
        elif new := self._arcs.taken - report.arcs:
            report.arcs |= new
            report.corpus.append(data)


def _read(target: Target, data: bytes, folder: Path) -> tuple[tuple[str, str] | None, bool]:
    """Where and how an input broke the promise, or None; and whether it was taken."""
    try:
        target.read(data, folder)
    except target.refusals:
        return None, False
    except _HungError:
        return (TIME, f"more than {HUNG_CPU_S} s"), False
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a panic of a library in Rust is no `Exception`
        ours = [frame for frame in traceback.extract_tb(error.__traceback__) if str(PACKAGE) in frame.filename]
        at = f"{ours[-1].filename.removeprefix(str(PACKAGE))}:{ours[-1].lineno}" if ours else "outside"
        return (f"{type(error).__name__} {at}", "".join(traceback.format_exception(error))[-3000:]), False
    return None, True


def smallest_with_all_arcs(target: Target, folder: Path, inputs: Sequence[bytes], max_bytes: int) -> list[bytes]:
    """Few of the inputs of at most so many bytes that take every way that all of these take: greedily, the shortest
    first where two take as many new ones."""
    arcs = Arcs(PACKAGE)
    directions: dict[bytes, set[tuple[str, int, int]]] = {}
    for data in dict.fromkeys(inputs):
        if len(data) <= max_bytes:
            with arcs, suppress(Exception):
                target.read(data, folder)
            directions[data] = {arc[:3] for arc in arcs.taken}
    selected: list[bytes] = []
    missing = set().union(*directions.values())
    while missing:
        best = max(directions, key=lambda data: (len(directions[data] & missing), -len(data), data))
        selected.append(best)
        missing -= directions.pop(best)
    return selected


def name_of(data: bytes) -> str:
    """Under which an input is kept."""
    return hashlib.sha256(data).hexdigest()[:12]


@contextmanager
def _given_up_after(cpu_s: float) -> Iterator[None]:
    def give_up(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise _HungError

    before = signal.signal(signal.SIGPROF, give_up)
    signal.setitimer(signal.ITIMER_PROF, cpu_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _peak_bytes() -> int:
    """Most memory that this process had resident since its peak was begun anew."""
    # `getrusage` also knows the peak of the process that this one was before `exec`, which nothing begins anew.
    (line,) = (line for line in STATUS.read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024
