"""The README and the pages of docs as somebody meets them who types them: every command is run, and what it says is
compared with what is shown.

A fenced block is `console` (typed here), `yaml` (read in tests/docs), `python` (compiled here) or `text` (neither). In
a console block a line `$ COMMAND  # remark` is typed, the lines below it are what it says, and a line `…` stands for
any number of lines. Every command runs as it is written, except those of `FORMS`; each block runs in a folder of its
own, beside which the sample recordings lie, unless a line `<!-- goes on -->` above it says that it goes on where the
block before it ended.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import psutil
import pytest

from conftest import REPOSITORY
from e2e.processes import environment
from support.router import free_port

PAGES = (REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md")))
LANGUAGES = ("console", "python", "text", "yaml")
GOES_ON = "<!-- goes on -->"
SAMPLES = "../shared/data"
ELLIPSIS = "…"

ABSOLUTE, RELATIVE = 0.03, 0.1
"""How far a number may be from the one shown: its unit is degrees, metres or a count, and processors round differently.
Durations, instants, digests, and how full the open window is depend on the machine and the moment: not compared."""

PATIENCE_S = 900.0
"""For a block; the longest takes 40 s on two idle cores, and five minutes where seven others share them."""
OBSERVATION_AGAIN_S = 2
"""Between two looks at an answer that is awaited: a look takes half a second of a core, which the service needs."""
LONG_S = 3600.0


@dataclass(frozen=True)
class Step:
    """A command of a block, and the lines that it is shown to say."""

    command: str
    shown: tuple[str, ...]


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, with those that go on from it."""

    page: Path
    line: int
    language: str
    text: str
    steps: tuple[Step, ...]


@dataclass(frozen=True)
class Form:
    """How a command is run that is not run as it is written.

    Attributes:
        instead: what is typed in the gate; the slow form types what is written.
        until: a person looks again until the answer holds this.
        status: exit status of `instead`.
        always: whether `instead` is typed in the slow form, too.
        other_data: in the gate, what the commands after `instead` say is of other data: not compared with the page.
    """

    instead: str | None = None
    until: str | None = None
    status: int = 0
    always: bool = False
    other_data: bool = False


def options_known(command: str) -> Form:
    """Of a command that needs more than a page can bring along: its options are looked up in its help."""
    labels = shlex.split(command)
    options = [word for word in labels if word.startswith("--")]
    requested = " ".join(f"&& grep -q -e {option} help.txt" for option in options)
    return Form(f"COLUMNS=200 coec {labels[1]} --help > help.txt {requested}", always=True)


DIRECTIONS = (
    f'coec evaluate "kitti360:{SAMPLES}/kitti360?camera=image_00" --depth stereo --objective mi '
    "--rotation-deg 10 --directions 200 --output out"
)
SIM_VIEW = "coec sim view --seed 4 --at-s 10 --output view.jpg"
SIM_DRIVE = "coec sim drive --seed 3 --seconds 60 --fault step:30:rx=3 --output drive.mcap"
RIG_DRIVE = "coec sim drive --rig four-fisheyes --seconds 4 --camera fisheye350 --fault front:step:2:ry=1 --output rig"
RIG_LIDARS = 'coec lidars "sim:rig=four-fisheyes&seconds=4" roof near_left'
RIG_DEMO = "coec demo --rig"
RIG_MOVES = "coec sim rig-moves --drives 5 --rigs 5"
TUTORIAL_DRIVE = "sim:seed=1&seconds=40&camera_hz=1&lidar_hz=1&workshop=0.8,-0.6,0.5"
SMALL_DRIVE = TUTORIAL_DRIVE.replace("seconds=40", "seconds=20&ego_hz=10&camera=fisheye200&lidar=32&depth=yes")
SIM_CALIBRATE = 'coec calibrate "sim:seed=3&seconds=60&camera_hz=0.4&lidar_hz=0.4" --perturb 3,-3,2'
TO_JSON = f'coec calibrate "kitti360:{SAMPLES}/kitti360?camera=image_00" --depth stereo --json > result.json'
COMMISSION = "coec commission SOURCE... --output rig.json"
DIAGNOSE = "coec diagnose SOURCE --rig rig.json"
ASSESS = "coec models assess network.onnx SOURCE --output DIR"
CHECK = f'coec check "kitti360:{SAMPLES}/kitti360?camera=image_00"'
NETWORK = f"{SAMPLES}/depth/tcsmallnet_dyn.onnx"

FORMS = {
    # These set up a virtual environment, and run what is tested here: the demonstration by tests/lab/test_demo.py.
    "deploy/demo": Form("bash -n $REPOSITORY/deploy/demo", always=True),
    "tests/run": Form("bash -n $REPOSITORY/tests/run", always=True),
    # The pictures that it writes are tested in tests/lab/test_evaluate.py.
    DIRECTIONS: Form(f"{DIRECTIONS.removesuffix(' --output out')} --frames 3".replace("200", "2")),
    # A small picture with exact depth is drawn, sent and solved in a tenth of the time, by the same commands.
    f'coec convert "{TUTORIAL_DRIVE}" s.yaml': Form(
        f'coec convert "{SMALL_DRIVE}" s.yaml && sed -i "s/model: stereo}}/&, objective: {{kind: mi}}/" s.yaml',
        other_data=True,
    ),
    f'coec play "{TUTORIAL_DRIVE}" --config s.yaml --rate 2': Form(
        f'coec play "{SMALL_DRIVE}" --config s.yaml --rate 8'
    ),
    SIM_VIEW: Form(f"{SIM_VIEW} --camera fisheye200"),
    SIM_DRIVE: Form(f"{SIM_DRIVE} --camera fisheye200".replace("60", "0.5").replace("step:30", "step:0.2")),
    RIG_DRIVE: Form(RIG_DRIVE.replace("fisheye350", "fisheye100").replace("4", "0.3").replace("step:2", "step:0.1")),
    RIG_LIDARS: Form("coec lidars --help > help.txt"),
    # What it shows is tested in tests/lab/test_demo_rig.py.
    RIG_DEMO: Form("coec demo --help > help.txt && grep -q -e --rig help.txt"),
    # What it draws is tested in tests/lab/test_sim_rig_moves.py.
    RIG_MOVES: Form(
        "COLUMNS=200 coec sim rig-moves --help > help.txt && grep -q -e --drives help.txt && grep -q -e --rigs help.txt"
    ),
    # Two frames are too few for an uncertainty: the verdict is negative.
    SIM_CALIBRATE: Form(
        f"{SIM_CALIBRATE} --frames 2 --depth stereo".replace(
            'lidar_hz=0.4"', 'lidar_hz=0.4&camera=fisheye200&depth=yes"'
        ),
        status=1,
    ),
    # What it looks at is tested in tests/cli/test_check.py; the slow form compares the figures.
    CHECK: Form("coec check --help > help.txt && grep -q -e --depth help.txt"),
    # The other objective takes a fifth of the time.
    TO_JSON: Form(TO_JSON.replace("--json", "--objective mi --json")),
    COMMISSION: options_known(COMMISSION),
    DIAGNOSE: options_known(DIAGNOSE),
    # A service that has no router to connect to runs on; it is stopped as soon as it says that it is ready.
    "coec run --config coec.yaml": Form(
        "coproc SERVICE { exec coec run --config coec.yaml; }; PID=$SERVICE_PID\n"
        "until [[ $line == *ready* ]]; do read -r line <&${SERVICE[0]} || break; done; kill $PID; wait $PID",
        always=True,
    ),
    "coec query windows": Form(until="sim-16000000[1-3][0-9]* .* accepted"),
    "coec models show network.onnx": Form(f"coec models show {NETWORK}", always=True),
    ASSESS: Form(f'coec models assess {NETWORK} "kitti360:{SAMPLES}/kitti360?camera=image_00" --frames 2', always=True),
}


def blocks(page: Path) -> list[Block]:
    """Of a page, in order."""
    result: list[Block] = []
    inside: list[str] | None = None
    begin, language, goes_on = 0, "", False
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        if not line.startswith("```"):
            if inside is not None:
                inside.append(line)
            elif line.strip():
                goes_on = line == GOES_ON
        elif inside is None:
            inside, begin, language = [], number, line.removeprefix("```")
        else:
            typed_here = steps(inside) if language == "console" else ()
            block = Block(page, begin, language, "\n".join(inside), typed_here)
            if goes_on:
                assert {result[-1].language, language} == {"console"}, f"{page}:{begin} goes on from nothing"
                before = result.pop()
                block = replace(before, steps=(*before.steps, *typed_here))
            result.append(block)
            inside, goes_on = None, False
    assert inside is None, f"the block of line {begin} has no end"
    return result


def steps(lines: list[str]) -> tuple[Step, ...]:
    """The commands of a block."""
    result: list[tuple[str, list[str]]] = []
    going_on = False
    for line in lines:
        if going_on:
            result[-1] = (result[-1][0].removesuffix("\\") + line.strip(), [])
        elif line.startswith("$ "):
            result.append((line.removeprefix("$ ").strip(), []))
        else:
            assert result, f"a console block begins with a command, not with {line!r}"
            result[-1][1].append(line.rstrip())
        going_on = result[-1][0].endswith("\\")
    return tuple(Step(without_comment(command), tuple(shown)) for command, shown in result)


def without_comment(command: str) -> str:
    """As a shell reads it."""
    return re.split(r"\s+#\s", command)[0].strip()


BLOCKS = [block for page in PAGES for block in blocks(page)]
CONSOLE = [block for block in BLOCKS if block.language == "console"]


def name_of(block: Block) -> str:
    """For pytest."""
    return f"{block.page.stem}-line-{block.line}"


def test_every_block_says_whether_it_is_typed() -> None:
    assert [name_of(block) for block in BLOCKS if block.language not in LANGUAGES] == []
    assert all(block.steps for block in CONSOLE)


@pytest.mark.parametrize("block", [block for block in BLOCKS if block.language == "python"], ids=name_of)
def test_python_that_is_shown_is_python(block: Block) -> None:
    compile(block.text, str(block.page), "exec")


def test_the_python_of_readme_is_the_example_that_a_test_runs() -> None:
    (block,) = (block for block in BLOCKS if block.language == "python" and block.page.stem == "README")
    assert block.text.strip() == (REPOSITORY / "docs" / "examples" / "calibrate.py").read_text().strip()


def test_no_form_is_left_of_a_command_that_is_gone() -> None:
    typed = {step.command for block in CONSOLE for step in block.steps}
    assert set(FORMS) - typed == set()


@pytest.mark.parametrize("block", CONSOLE, ids=name_of)
def test_a_block_does_what_it_says(block: Block, tmp_path: Path) -> None:
    play_through(block, tmp_path, PATIENCE_S, short=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "block",
    [b for b in CONSOLE if any((f := FORMS.get(step.command)) and f.instead and not f.always for step in b.steps)],
    ids=name_of,
)
def test_a_long_block_does_what_it_says(block: Block, tmp_path: Path) -> None:
    play_through(block, tmp_path, LONG_S, short=False)


@pytest.mark.parametrize(
    ("shown", "reported", "equal"),
    [
        ("rx pitch  -0.789  0.015  deg", "rx pitch   -0.777  0.014 deg ", True),
        ("rx pitch  -0.789  0.015  deg", "rx pitch   +0.789  0.015 deg ", False),
        ("verdict accepted", "verdict failed", False),
        ("load 0.22 s  total 1.55 s", "load 13.2 s  total 17.1 s", True),
        ("72 evaluations, tolerance_reached", "75 evaluations, tolerance_reached", True),
        ("72 evaluations, tolerance_reached", "372 evaluations, tolerance_reached", False),
        ("sim-1600000000010000000: identical", "sim-1600000000020000000: identical", False),
        ("healthy since 2026-11-22 07:36:08Z", "healthy since 2027-01-01 00:00:00Z", True),
        ("sha256 d46f410f1fc80047… verified", f"sha256 {64 * '0'} verified", True),
        ("sigma_deg  0.020 ≤ 0.250 ✓", "sigma_deg  0.020 ≤ 0.250 ✗", False),
    ],
)
def test_lines_are_compared_by_their_text_and_within_tolerance(shown: str, reported: str, equal: bool) -> None:
    assert fits(shown, reported) is equal


def test_an_ellipsis_stands_for_any_lines_and_nothing_else_does() -> None:
    assert missing(("a", "…", "d"), "a\nb\nc\nd\n") is None
    assert missing(("a", "d"), "a\nb\nd\n") is not None
    assert missing(("a",), "a\nb\n") is not None
    assert missing(("a", "…"), "a\nb\n") is None
    assert missing(("…", "d"), "a\nb\n") is not None


# ------------------------------------------------------------------------------------------------------ typing
HERE = (sys.executable, "-m", "coec")


def play_through(
    block: Block,
    folder: Path,
    patience_s: float,
    *,
    short: bool,
    coec: Sequence[str] = HERE,
    env: Mapping[str, str] | None = None,
) -> None:
    """Types a block in a shell of its own, then looks at what came of it. `coec` is what that word runs, `env` the
    environment of the shell; by default those of this process."""
    data = Path(os.environ.get("COEC_SAMPLE_DATA") or REPOSITORY.parent / "shared" / "data")
    if not data.is_dir() and any(SAMPLES in typed(step, short=short).command for step in block.steps):
        pytest.skip(f"needs the sample recordings: {data} is absent; COEC_SAMPLE_DATA may name another folder")
    cwd = folder / "checkout"
    cwd.mkdir()
    (folder / "shared").mkdir()
    (folder / "shared" / "data").symlink_to(data)
    spoken = folder / "said"
    spoken.mkdir()
    lines = ["set -m", "trap 'kill $(jobs -p) 2> /dev/null; wait' EXIT"]
    for number, step in enumerate(block.steps):
        lines += shell_lines(typed(step, short=short), FORMS.get(step.command, Form()), spoken / str(number))
    variables = environment() if env is None else env
    path = os.pathsep.join([str(shim(folder, coec)), variables["PATH"]])
    run_shell("\n".join(lines), cwd, {**variables, "PATH": path, "REPOSITORY": str(REPOSITORY)}, patience_s)
    other_data = False
    for number, step in enumerate(block.steps):
        selected = typed(step, short=short)
        other_data |= short and FORMS.get(step.command, Form()).other_data
        out, err = ((spoken / f"{number}.{stream}").read_text() for stream in ("out", "err"))
        expected = FORMS[step.command].status if step.command in FORMS and selected.command != step.command else 0
        status = int((spoken / f"{number}.status").read_text())
        assert status == expected, f"{selected.command}\nexit status {status}\n{out}{err}"
        assert "Traceback" not in err, err
        if selected.shown and not other_data:
            complaint = missing(selected.shown, out)
            assert complaint is None, f"{selected.command}\n{complaint}\nit says\n{out}"


def typed(step: Step, *, short: bool) -> Step:
    """What is typed for a step of a page."""
    form = FORMS.get(step.command, Form())
    return Step(form.instead, ()) if form.instead is not None and (short or form.always) else step


def shell_lines(step: Step, form: Form, reported: Path) -> list[str]:
    """The command, with what it says and its exit status in files."""
    if step.command.endswith("&"):
        return [f": > {reported}.out; : > {reported}.err; echo 0 > {reported}.status", step.command]
    # A redirection of the command itself comes later, and wins.
    report = f"{{ {step.command}\n}} > {reported}.out 2> {reported}.err; echo $? > {reported}.status"
    if form.until is None:
        return [report]
    return [
        "while true; do",
        report,
        f"grep -q {shlex.quote(form.until)} {reported}.out && break; sleep {OBSERVATION_AGAIN_S}; done",
    ]


def shim(folder: Path, coec: Sequence[str]) -> Path:
    """A folder with a program `coec`: the given one, on a free port, where a page can only name the usual one."""
    endpoint = f"127.0.0.1:{free_port()}"
    path = folder / "bin" / "coec"
    path.parent.mkdir()
    path.write_text(
        "#!/bin/bash\n"
        f"case $1 in run | play) sed -i s/127.0.0.1:7447/{endpoint}/g ./*.yaml ;; esac\n"
        f'case $1 in query | watch) set -- "$@" --connect tcp/{endpoint} ;; esac\n'
        f'exec {shlex.join(coec)} "$@"\n'
    )
    path.chmod(0o755)
    return path.parent


def run_shell(script: str, cwd: Path, env: dict[str, str], patience_s: float) -> None:
    """A shell to its end; nothing that it started is left behind."""
    with subprocess.Popen(["bash", "-c", script], cwd=cwd, env=env, stderr=subprocess.DEVNULL) as shell:
        try:
            shell.wait(patience_s)
        except subprocess.TimeoutExpired:
            for process in [*psutil.Process(shell.pid).children(recursive=True), psutil.Process(shell.pid)]:
                process.kill()
            pytest.fail(f"not done after {patience_s:g} s:\n{script}")


# --------------------------------------------------------------------------------------------------- comparing
NUMBER = re.compile(r"(?<![\w.])[+-]?\d+(?:\.\d+)?(?![\w])")
PASSING = (
    (re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\dZ"), "INSTANT"),
    (re.compile(r"\d+(\.\d+)? (s|min|h|d)\b"), "DURATION"),
    (re.compile(r"(?<![-\w])[0-9a-f]{16,}\b…?"), "DIGEST"),
    (re.compile(r"open window \d+ %"), "open window SHARE"),
)
LONGEST_MEASURE = 12
"""Digits: more are a name."""


def missing(shown: tuple[str, ...], reported: str) -> str | None:
    """What of the shown lines was not said, or said beside them; None when all is as shown."""
    rest = [line.rstrip() for line in reported.splitlines() if line.strip()]
    any_lines = False
    for line in (line for line in shown if line.strip()):
        if line.strip() == ELLIPSIS:
            any_lines = True
            continue
        place = next((index for index, real in enumerate(rest) if fits(line, real)), None)
        if place is None or (place > 0 and not any_lines):
            return f"the page shows {line!r}, it says {rest[0] if rest else 'nothing more'!r}"
        del rest[: place + 1]
        any_lines = False
    return f"the page does not show {rest[0]!r}" if rest and not any_lines else None


def fits(shown: str, reported: str) -> bool:
    """Whether two lines have the same words, and the same numbers within the tolerance."""
    for pattern, name in PASSING:
        shown, reported = pattern.sub(name, shown), pattern.sub(name, reported)
    if NUMBER.sub("#", shown).split() != NUMBER.sub("#", reported).split():
        return False
    return all(near(a, b) for a, b in zip(NUMBER.findall(shown), NUMBER.findall(reported), strict=True))


def near(shown: str, reported: str) -> bool:
    """Whether a number is the one shown, within the tolerance; so long a one is a name."""
    if len(shown) > LONGEST_MEASURE:
        return shown == reported
    return abs(float(shown) - float(reported)) <= ABSOLUTE + RELATIVE * abs(float(shown))
