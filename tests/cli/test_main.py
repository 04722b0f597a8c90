"""What all commands have in common: help, exit codes, where things are printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

from cli.conftest import Coec
from coec import __version__, api, extensions
from coec.cli.main import BUILT_IN, application
from coec.errors import UsageError

COMMANDS = ("calibrate", "run", "check-config", "play", "query", "replay", "convert", "models", "demo")
HELP = "import sys; sys.argv = ['coec', '--help']; from coec.cli.main import main; sys.exit(main())"
HEAVY = ("cv2", "mcap", "numba", "numpy", "onnxruntime", "pydantic", "rosbags", "zenoh")


def test_help_lists_every_command(coec: Coec) -> None:
    outcome = coec("--help")
    assert outcome.status == 0
    assert all(command in outcome.out for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(coec: Coec, command: str) -> None:
    assert coec(command, "--help").status == 0


@pytest.mark.parametrize("command", [*BUILT_IN, "evaluate", "resample", "demo", "bench"])
def test_no_name_of_an_option_is_cut_off_on_a_terminal_of_80_columns(
    coec: Coec, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert re.findall(r"--[\w-]+…", coec(command, "--help").out) == []


def test_help_of_all_commands_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['coec', '--help']\n"
        "from coec.cli.main import main; main()\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    path = ":".join(sys.path)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={"PYTHONPATH": path})
    assert done.returncode == 0
    assert done.stderr.strip() == "[]"


def test_a_query_imports_no_numpy() -> None:
    """It would take a quarter of the time of a query."""
    code = (
        "import sys, coec.cli.query, coec.io.zenoh.query_client\n"
        "print([name for name in ('numpy', 'numba') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={"PYTHONPATH": ":".join(sys.path)}
    )
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


def test_a_source_that_is_refused_is_refused_before_what_draws_is_imported(tmp_path: Path) -> None:
    code = (
        f"import sys; sys.argv = ['coec', 'calibrate', {str(tmp_path / 'absent')!r}]\n"
        "from coec.cli.main import main; status = main()\n"
        "print(status, 'coec.reports.pictures' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={"PYTHONPATH": ":".join(sys.path)}
    )
    assert "absent does not exist" in done.stderr
    assert done.stdout.strip() == "1 False"


def test_a_command_is_declared_without_the_others() -> None:
    (alone,) = application(["check-config", "--defaults"]).registered_commands
    assert alone.name == "check-config"
    everything = application(["--help", "check-config"])
    names = {each.name for each in everything.registered_commands}
    names |= {each.name for each in everything.registered_groups}
    assert names == {
        *BUILT_IN,
        *(point.name for point in entry_points(group=extensions.COMMANDS) if "." not in point.name),
    }


def test_a_mistyped_command_is_reported_which_is_meant(coec: Coec) -> None:
    outcome = coec("calibrat")
    assert outcome.status == 2
    assert "'calibrate'" in outcome.err


def test_usage_error_is_2_on_standard_error(coec: Coec) -> None:
    outcome = coec("calibrate", "--no-such-option")
    assert outcome.status == 2
    assert not outcome.out
    assert "no-such-option" in outcome.err


def test_usage_error_with_json_is_a_document_too(coec: Coec) -> None:
    outcome = coec("calibrate", "--no-such-option", "--json")
    assert outcome.status == 2
    assert outcome.document["error"]["code"] == "bad_request"
    assert "--no-such-option" in outcome.document["error"]["message"]


def test_deliberate_error_is_a_line_without_traceback(coec: Coec) -> None:
    outcome = coec("calibrate", "/no/such/recording", "--depth", "stereo")
    assert outcome.status == 1
    assert outcome.err.startswith("coec: /no/such/recording does not exist")
    assert "Traceback" not in outcome.err
    assert "accepted forms" not in outcome.err, "a path that is absent is meant as a path"
    assert "accepted forms" in coec("calibrate", "recording").err


def test_deliberate_error_with_json(coec: Coec) -> None:
    outcome = coec("calibrate", "/no/such/recording", "--depth", "stereo", "--json")
    assert outcome.status == 1
    assert outcome.document["error"]["code"] == "bad_source"
    assert "does not exist" in outcome.document["error"]["message"]


@pytest.mark.fault("a fault of our own in a command", "exit code 70 with a traceback")
def test_fault_of_our_own_is_70_with_traceback(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> int:
        raise ZeroDivisionError

    monkeypatch.setattr("coec.cli.models._list", fail)
    outcome = coec("models", "--json")
    assert outcome.status == 70
    assert "Traceback" in outcome.err
    assert outcome.document["error"]["code"] == "internal"


def test_without_a_command_says_how(coec: Coec) -> None:
    outcome = coec()
    assert outcome.status == 2
    assert "Usage" in outcome.out + outcome.err


def test_the_version_comes_with_those_of_what_decides(coec: Coec) -> None:
    document = coec("--version", "--json").document
    assert document["coec"] == __version__
    assert document["numpy"] == np.__version__
    assert {"numba", "onnxruntime", "eclipse-zenoh", "python"} <= set(document)
    shown = coec("--version")
    assert shown.status == 0
    assert shown.out.startswith(f"coec {__version__}\n")
    assert f"numpy {np.__version__}" in shown.out
    assert coec("--json", "models").status == 2


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("coec cal", {"calibrate"}),
        ("coec calibrate x --object", {"--objective"}),
        ("coec calibrate x --objective f", {"fused"}),
        ("coec calibrate x --depth st", {"stereo", "street"}),
        ("coec query command/r", {"command/rollback", "command/reset"}),
        ("coec export x --format op", {"openlabel", "opencv"}),
    ],
)
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands_options_and_values(
    coec: Coec, monkeypatch: pytest.MonkeyPatch, typed: str, offered: set[str], shell: str
) -> None:
    monkeypatch.setenv("_COEC_COMPLETE", f"complete_{shell}")
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", typed)
    monkeypatch.setenv("_TYPER_COMPLETE_WORD_TO_COMPLETE", typed.split()[-1])
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    out = coec().out
    assert all(value in out for value in offered)
    if shell == "bash":
        assert set(out.split()) == offered


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell_requests_this_program(coec: Coec, monkeypatch: pytest.MonkeyPatch, shell: str) -> None:
    monkeypatch.setenv("_COEC_COMPLETE", f"source_{shell}")
    shown = coec()
    assert shown.status == 0
    assert f"_COEC_COMPLETE=complete_{shell}" in shown.out


@pytest.mark.fault("a full disk under standard output", "one line says so; it does not count as an internal error")
def test_a_full_disk_under_the_output_is_a_line_and_1() -> None:
    with open("/dev/full", "wb") as full:  # noqa: PTH123  a device, and no file
        done = subprocess.run(
            [sys.executable, "-c", HELP],
            stdout=full, stderr=subprocess.PIPE, text=True, env={"PYTHONPATH": ":".join(sys.path)},
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["coec: cannot write: No space left on device; make room where the output goes"]


def test_who_reads_no_further_leaves_141() -> None:
    done = subprocess.run(
        ["bash", "-c", f'{sys.executable} -c "{HELP}" | true; echo ${{PIPESTATUS[0]}}'],
        capture_output=True, text=True, env={"PYTHONPATH": ":".join(sys.path), "PATH": os.defpath},
    )  # fmt: skip
    assert done.stdout.strip() == "141"
    assert "Traceback" not in done.stderr


ADDED = """\
import typer

group = typer.Typer(no_args_is_help=True)


def five(times: int = 1) -> int:
    '''Returns five.'''
    return 5 * times


@group.command()
def inner() -> int:
    '''Returns six.'''
    return 6


@group.command()
def other() -> int:
    return 0
"""


@pytest.fixture
def _added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package with commands is installed."""
    (tmp_path / "added_commands.py").write_text(ADDED)
    info = tmp_path / "added-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: added\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[coec.commands]\nfive = added_commands:five\ngroup = added_commands:group\n"
        "fleet.five = added_commands:five\n[coec.api]\nfive = added_commands:five\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("_added")
def test_another_package_adds_commands_groups_and_subcommands(coec: Coec) -> None:
    assert coec("five", "--times", 2).status == 10
    assert coec("group", "inner").status == 6
    assert coec("fleet", "five").status == 5
    assert "Returns five" in coec("--help").out
    assert coec("five", "--nonsense").status == 2


@pytest.mark.usefixtures("_added")
def test_another_package_adds_a_function_to_the_package() -> None:
    assert api.added("five")() == 5
    with pytest.raises(UsageError, match=r"coec\.six is not installed"):
        api.added("six")()
