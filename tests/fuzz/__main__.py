"""`tests/fuzz/run TARGET… --seconds N`: fuzz for as long as you like, each target in a process of its own.

What breaks the promise is written to `--output`, one file a finding; what takes a new way through the code is added to
the corpus that the gate replays with `--keep`.
"""

from __future__ import annotations

import argparse
import faulthandler
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

from fuzz.corpus import CORPUS, MAX_RETAINED_BYTES, inputs_of
from fuzz.loop import Fuzzer, name_of, smallest_with_all_arcs
from fuzz.targets import TARGETS

MAX_ADDRESS_BYTES = 6 * 2**30
"""Of the process: a reader that asks for more is refused, and the machine does not notice."""

IN_MEMORY = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
"""Every input is written to a file before it is read; None: where temporary files are."""

LAST = "last"
"""File with the input that is being read."""

FAULT = "fault"
"""File with what the interpreter said when an input ended it."""

BROKEN = 10
"""Exit code of a process that saw a promise broken: one that an input ends has another."""

SILENT_S = 180
"""A process that has begun no new input for so long hangs where no signal reaches it."""


def main() -> int:
    """0 when every promise held."""
    parser = argparse.ArgumentParser(prog="tests/fuzz/run", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "targets", nargs="*", choices=[[], *TARGETS], help=f"one or more of {', '.join(TARGETS)}; all if none"
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("out/fuzz"), help="where findings are written")
    parser.add_argument("--keep", action="store_true", help="add to the corpus in tests/fuzz/corpus")
    parser.add_argument("--here", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here is not None:
        return _fuzz(options)
    if unknown := set(options.targets) - set(TARGETS):
        parser.error(f"no such target: {', '.join(sorted(unknown))}")
    broken = [name for name in options.targets or TARGETS if not _supervised(name, options)]
    return 1 if broken else 0


def _supervised(name: str, options: argparse.Namespace) -> bool:
    """Whether every promise of a target held. A process that is ended by an input is itself a finding."""
    end_s, seed, held = time.monotonic() + options.seconds, options.seed, True
    while (left_s := end_s - time.monotonic()) > 0:
        with tempfile.TemporaryDirectory(prefix="coec-fuzz-", dir=IN_MEMORY) as folder:
            last = Path(folder) / LAST
            arguments = [
                name,
                "--seconds",
                str(left_s),
                "--seed",
                str(seed),
                "--output",
                str(options.output),
                "--here",
                folder,
            ]
            process = subprocess.Popen(
                [sys.executable, "-m", "fuzz", *arguments, *(["--keep"] if options.keep else [])]
            )
            code = _pending(process, last)
            if code in (0, BROKEN):
                return held and code == 0
            held, seed = False, seed + 1
            text = f"the process ended with {code}\n{(Path(folder) / FAULT).read_text(errors='replace')}"
            print(f"{name}: {text}: {_write(options.output / name, last.read_bytes(), text)}", flush=True)
    return held


def _pending(process: subprocess.Popen[bytes], last: Path) -> int:
    while True:
        try:
            return process.wait(SILENT_S)
        except subprocess.TimeoutExpired:
            if not last.exists() or time.time() - last.stat().st_mtime > SILENT_S:
                process.kill()


def _fuzz(options: argparse.Namespace) -> int:
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESS_BYTES, MAX_ADDRESS_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # libjpeg and libpng tell the terminal of every damaged image.
    fault = os.open(options.here / FAULT, os.O_WRONLY | os.O_CREAT, 0o600)
    faulthandler.enable(fault)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    warnings.simplefilter("error")
    logging.disable()
    name = options.targets[0]
    target, last = TARGETS[name], options.here / LAST
    descriptor = os.open(last, os.O_WRONLY | os.O_CREAT, 0o600)

    def note(data: bytes) -> None:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, data, 0)

    work = options.here / "work"
    work.mkdir()
    fuzzer = Fuzzer(target, work, options.seed, note)
    fuzzer.replay(inputs_of(target))
    end_s = time.monotonic() + options.seconds
    report = fuzzer.mutate(lambda _: time.monotonic() >= end_s)
    print(f"{name}: {report.figure}", flush=True)
    for finding in report.findings.values():
        print(f"  {finding.place}: {_write(options.output / name, finding.data, finding.text)}", flush=True)
    if options.keep:
        folder = CORPUS / name
        folder.mkdir(exist_ok=True)
        for old in folder.iterdir():
            old.unlink()
        seeds = set(target.seeds())
        for data in smallest_with_all_arcs(target, work, [*target.seeds(), *report.corpus], MAX_RETAINED_BYTES):
            if data not in seeds:
                (folder / name_of(data)).write_bytes(data)
    return BROKEN if report.findings else 0


def _write(folder: Path, data: bytes, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name_of(data)
    path.write_bytes(data)
    path.with_suffix(".txt").write_text(text, encoding="utf-8")
    return path


if __name__ == "__main__":
    sys.exit(main())
