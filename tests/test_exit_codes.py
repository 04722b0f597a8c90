"""With which status the service ends, and what the unit of systemd makes of it."""

from __future__ import annotations

import errno
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from coec import daemon
from coec.cli import check_config
from coec.cli.check_config import example, template
from coec.cli.options import success_on_sigterm
from coec.config import Config, StateConfig, ZenohConfig
from coec.daemon import exit_code_of
from coec.errors import EXIT_CODE_MEANINGS, MAY_BE_CURED, NOT_CURED_BY_RESTART, CoecError, ConfigError, ExitCode
from coec.service.process_lifetime import locked
from conftest import REPOSITORY
from deploy.written import compose
from e2e.processes import COMMAND, PATIENCE_S, coec_here, environment
from support.fake_worker import wait_until
from support.router import TestAuthority, free_port

pytestmark = pytest.mark.usefixtures("process")
UNIT = (REPOSITORY / "deploy" / "coec.service").read_text()
TEMPFAIL = 75


def every_error(base: type[CoecError]) -> Iterator[type[CoecError]]:
    yield base
    for below in base.__subclasses__():
        yield from every_error(below)


@pytest.fixture
def process() -> Iterator[None]:
    """What the daemon sets for its whole process is as before afterwards."""
    root, interval_s = logging.getLogger(), sys.getswitchinterval()
    handlers, level = list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    sys.setswitchinterval(interval_s)


def configured(folder: Path, port: int) -> Config:
    zenoh = ZenohConfig(embedded_router=True, listen=(f"tcp/127.0.0.1:{port}",))
    return example().model_copy(update={"zenoh": zenoh, "state": StateConfig(directory=folder, min_free_bytes=0)})


def never_again() -> set[int]:
    (line,) = re.findall(r"^RestartPreventExitStatus=(.*)$", UNIT, re.MULTILINE)
    return {int(code) for code in line.split()}


@pytest.mark.fault("a bad configuration", "exit code 78: the unit gives up on it, and on nothing that may be cured")
def test_the_unit_gives_up_on_what_no_restart_cures_and_on_nothing_else() -> None:
    assert never_again() == NOT_CURED_BY_RESTART
    assert "Restart=on-failure" in UNIT
    assert re.search(r"^StartLimitIntervalSec=0$", UNIT, re.MULTILINE), "the fifth quick failure would be the last"


def test_containers_are_started_again_as_the_page_says() -> None:
    """Engines have no exit code after which they give up, and `on-failure` would not start at the next boot."""
    assert {service["restart"] for service in compose().values()} == {"unless-stopped"}
    page = (REPOSITORY / "docs" / "operations.md").read_text()
    assert "`restart: unless-stopped`" in page
    for code, meaning in EXIT_CODE_MEANINGS.items():
        again = "no" if code in never_again() else "yes" if code in MAY_BE_CURED else ""
        assert re.search(rf"^\| {code.value} \| {re.escape(meaning)} \| {again} ?\|$", page, re.MULTILINE), code


def test_every_exit_code_has_a_meaning() -> None:
    assert set(EXIT_CODE_MEANINGS) == set(ExitCode)


@pytest.mark.parametrize("error", [*every_error(CoecError)], ids=lambda error: error.__name__)
def test_a_service_never_ends_as_failed_work_does(error: type[CoecError]) -> None:
    """Whatever error ends it: a person must see to it, or a later start may succeed."""
    status = exit_code_of(error.__new__(error))
    assert status in (ExitCode.CONFIGURATION, ExitCode.UNAVAILABLE)
    assert error.exit_code not in (ExitCode.CONFIGURATION, ExitCode.UNAVAILABLE) or status == error.exit_code


def test_a_reload_of_the_unit_is_the_signal_that_the_service_heeds() -> None:
    assert re.search(r"^ExecReload=/bin/kill -HUP \$MAINPID$", UNIT, re.MULTILINE)


@pytest.mark.fault("the port is taken", "exit code 75: the unit tries again")
def test_a_port_that_is_taken_may_be_free_later(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert daemon.run(configured(tmp_path / "state", other.getsockname()[1])) == TEMPFAIL


@pytest.mark.fault("a state directory that is read-only or full at the start", "exit code 75: the unit tries again")
@pytest.mark.parametrize("code", [errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_disk_that_takes_no_file_may_take_one_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "mkdir", refused)
    assert daemon.run(configured(tmp_path / "state", 0)) == TEMPFAIL


@pytest.mark.fault("a disk that fills up while the service starts", "exit code 75: the unit tries again")
@pytest.mark.parametrize("place", ["coec.daemon.WindowStore", "coec.daemon.StateStore"])
def test_a_disk_that_is_full_when_the_state_is_opened_may_have_room_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(place, refused)
    assert daemon.run(configured(tmp_path / "state", free_port())) == TEMPFAIL


@pytest.mark.fault("another daemon has the state directory", "exit code 75: the unit tries again")
def test_a_directory_that_another_daemon_has_may_be_free_later(tmp_path: Path) -> None:
    with locked(tmp_path / "state"):
        assert daemon.run(configured(tmp_path / "state", 0)) == TEMPFAIL


def test_a_file_in_the_place_of_the_state_directory_stays_one(tmp_path: Path) -> None:
    (tmp_path / "state").touch()
    assert daemon.run(configured(tmp_path / "state", 0)) == ExitCode.CONFIGURATION
    assert daemon.run(configured(tmp_path / "state" / "below", 0)) == ExitCode.CONFIGURATION


def test_an_endpoint_that_is_none_stays_none(tmp_path: Path) -> None:
    config = configured(tmp_path, 0)
    wrong = config.zenoh.model_copy(update={"listen": ("tcp/127.0.0.1:abc",)})
    assert daemon.run(config.model_copy(update={"zenoh": wrong})) == ConfigError.exit_code


def test_a_door_for_everybody_is_a_mistake_unless_spelled_out(tmp_path: Path) -> None:
    config = configured(tmp_path, 0)
    wide = config.zenoh.model_copy(update={"listen": ("tcp/0.0.0.0:0",)})
    assert daemon.run(config.model_copy(update={"zenoh": wide})) == ConfigError.exit_code


# ------------------------------------------------------------------------------------------------ as whole processes
UNPRIVILEGED = ("setpriv", "--bounding-set=-dac_override,-dac_read_search", "--inh-caps=-dac_override,-dac_read_search")
"""Root without the right to read what the mode of a file forbids."""


def unprivileged() -> Sequence[str]:
    """What stands before a command so that the modes of files hold for it."""
    prefix: Sequence[str] = () if os.geteuid() else UNPRIVILEGED
    if prefix and shutil.which(prefix[0]) is None:
        pytest.skip("needs setpriv (Debian: apt-get install util-linux), or another user than root")
    return prefix


def started(*arguments: object, log: Path) -> subprocess.Popen[bytes]:
    """`coec ARGUMENTS` as a user whom the modes of files hold for; what it says is in `log`."""
    with log.open("wb") as stream:
        command = [*unprivileged(), *COMMAND, *(str(argument) for argument in arguments)]
        return subprocess.Popen(command, stdout=stream, stderr=stream, env=environment())


def finished(*arguments: object, log: Path) -> int:
    """Exit status of `coec ARGUMENTS`."""
    process = started(*arguments, log=log)
    try:
        return process.wait(PATIENCE_S)
    finally:
        process.kill()
        process.wait()


def written(folder: Path, **changes: Any) -> Path:
    """The template with a state directory in the folder, and other values; `a__b` is the place `a.b`."""
    document = YAML(typ="safe").load(template())
    port = free_port()
    document["zenoh"] |= {"embedded_router": True, "listen": [f"tcp/127.0.0.1:{port}"]}
    document["state"] |= {"directory": str(folder / "state"), "min_free_bytes": 0}
    document["pairs"][0]["calibration"]["depth"]["model"] = "stereo"
    for place, value in changes.items():
        *head, last = place.split("__")
        inside = document
        for name in head:
            inside = inside[int(name)] if name.isdigit() else inside[name]
        inside[last] = value
    path = folder / "coec.yaml"
    with path.open("w") as stream:
        YAML().dump(document, stream)
    return path


def closed(path: Path) -> str:
    """Takes every right to a file or folder; what a message about it must say."""
    path.chmod(0)
    return (
        f"permission denied: {path} belongs to user {os.geteuid()}, group {os.getegid()}, with mode 0000, and this "
        f"process has user {os.geteuid()}"
    )


NETWORK = "pairs__0__calibration__depth__model"


def no_configuration(folder: Path, _: TestAuthority) -> str:
    path = written(folder)
    path.unlink()
    return f"cannot read {path}: No such file or directory"


def configuration_of_others(folder: Path, _: TestAuthority) -> str:
    return closed(written(folder))


def no_network(folder: Path, _: TestAuthority) -> str:
    written(folder, **{NETWORK: "absent.onnx"})
    return f"there is no depth network {folder / 'absent.onnx'}"


def network_of_others(folder: Path, _: TestAuthority) -> str:
    (folder / "own.onnx").touch()
    written(folder, **{NETWORK: "own.onnx"})
    return closed(folder / "own.onnx")


def folder_of_networks_of_others(folder: Path, _: TestAuthority) -> str:
    (folder / "networks").mkdir()
    (folder / "networks" / "own.onnx").touch()
    written(folder, **{NETWORK: "networks/own.onnx"})
    return closed(folder / "networks")


def mask_of_others(folder: Path, _: TestAuthority) -> str:
    (folder / "mask.png").touch()
    written(folder, pairs__0__camera__mask="mask.png")
    return closed(folder / "mask.png")


def own_certificates(folder: Path, authority: TestAuthority) -> TestAuthority:
    shutil.copytree(authority.folder, folder / "tls")
    return TestAuthority(folder / "tls")


def key_of_others(folder: Path, authority: TestAuthority) -> str:
    own = own_certificates(folder, authority)
    written(folder, authority=own.of_service().model_dump(mode="json"))
    return closed(own.folder / "vehicle-key.pem")


def zenoh_key_of_others(folder: Path, authority: TestAuthority) -> str:
    own = own_certificates(folder, authority)
    file = own.session("vehicle", "tls/127.0.0.1:7448", "peer")
    written(folder, zenoh={"file": str(file)})
    return closed(own.folder / "vehicle-key.pem")


def zenoh_key_of_another_certificate(folder: Path, authority: TestAuthority) -> str:
    own = own_certificates(folder, authority)
    shutil.copy(own.folder / "ros-key.pem", own.folder / "vehicle-key.pem")
    written(folder, zenoh={"file": str(own.session("vehicle", "tls/127.0.0.1:7448", "peer"))})
    return f"{own.folder / 'vehicle.pem'} and {own.folder / 'vehicle-key.pem'} are no certificate and its"


def zenoh_file_that_is_a_folder(folder: Path, _: TestAuthority) -> str:
    (folder / "session.json5").mkdir()
    written(folder, zenoh={"file": "session.json5"})
    return "it is a folder; container engines make one if the file to mount does not exist"


SPOILERS = (
    no_configuration,
    configuration_of_others,
    no_network,
    network_of_others,
    folder_of_networks_of_others,
    mask_of_others,
    key_of_others,
    zenoh_key_of_others,
    zenoh_key_of_another_certificate,
    zenoh_file_that_is_a_folder,
)

STARTS = {"check-config": (), "run": ("--config",)}
"""Commands that read a configuration, and what stands before its path."""

ONE_AFTER_THE_OTHER = f"""
import os, sys
from pathlib import Path
from coec.cli.main import main
for folder in sys.argv[1:]:
    for command, options in {STARTS!r}.items():
        said = os.open(f"{{folder}}.{{command}}", os.O_WRONLY | os.O_CREAT)
        for stream in (1, 2):
            os.dup2(said, stream)
        sys.argv = ["coec", command, *options, f"{{folder}}/coec.yaml"]
        status = main()
        sys.stdout.flush()
        Path(f"{{folder}}.{{command}}.status").write_text(str(int(status)))
"""
"""A program that tries to start in each of the folders, and puts beside it what was said, and the exit status."""


@pytest.fixture(scope="module")
def spoiled(tmp_path_factory: pytest.TempPathFactory, authority: TestAuthority) -> Mapping[str, tuple[Path, str]]:
    """By the name of what is wrong: a folder in which a start has failed, and what must have been said of it."""
    made = {}
    for spoil in SPOILERS:
        folder = tmp_path_factory.mktemp(spoil.__name__)
        made[spoil.__name__] = (folder, spoil(folder, authority))
    command = [
        *unprivileged(),
        sys.executable,
        "-c",
        ONE_AFTER_THE_OTHER,
        *(str(folder) for folder, _ in made.values()),
    ]
    subprocess.run(command, env=environment(), timeout=PATIENCE_S, check=True)
    return made


@pytest.mark.parametrize("spoil", SPOILERS, ids=lambda spoil: spoil.__name__)
@pytest.mark.fault(
    "a file that a start needs is absent, or may not be read",
    "`run` and `check-config` end with 78 alike and name the file, its mode, the user, and what to do",
)
def test_what_a_start_cannot_read_ends_run_and_check_config_alike(
    spoiled: Mapping[str, tuple[Path, str]], spoil: Any
) -> None:
    folder, labels = spoiled[spoil.__name__]
    for command in STARTS:
        reported = Path(f"{folder}.{command}").read_text()
        code = int(Path(f"{folder}.{command}.status").read_text())
        assert (code, labels in reported.replace("\n", " ")) == (ExitCode.CONFIGURATION, True), reported


@pytest.mark.fault(
    "a state directory that belongs to somebody else",
    "exit code 78, with its owner, its mode, the user of the service, and what to do",
)
def test_a_state_directory_of_others_stays_theirs(tmp_path: Path) -> None:
    path, log = written(tmp_path), tmp_path / "log"
    (tmp_path / "state").mkdir()
    labels = closed(tmp_path / "state")
    try:
        assert finished("run", "--config", path, log=log) == ExitCode.CONFIGURATION
    finally:
        (tmp_path / "state").chmod(0o700)
    assert labels in log.read_text()


def test_a_command_line_that_does_not_fit_never_does() -> None:
    assert coec_here("run", "--no-such-option").returncode in never_again()


@pytest.mark.fault(
    "the key of a router's certificate may not be read",
    "the router ends with 78, and names the file, its mode, the user, and what to do",
)
def test_a_router_that_may_not_read_its_key_names_it(tmp_path: Path, authority: TestAuthority) -> None:
    own, log = own_certificates(tmp_path, authority), tmp_path / "log"
    text = (REPOSITORY / "deploy" / "router.json5").read_text().replace("/etc/zenoh/tls", str(own.folder))
    (tmp_path / "router.json5").write_text(text.replace(":7447", f":{free_port()}").replace(":7448", f":{free_port()}"))
    labels = closed(own.folder / "router-key.pem")
    assert finished("router", "--config", tmp_path / "router.json5", log=log) == ExitCode.CONFIGURATION
    assert labels in log.read_text().replace("\n", " ")


@pytest.mark.fault("SIGTERM while the service starts, without a router", "exit code 0: it was stopped")
def test_a_signal_during_the_start_is_a_stop(tmp_path: Path) -> None:
    path, log = written(tmp_path, zenoh={"connect": [f"tcp/127.0.0.1:{free_port()}"]}), tmp_path / "log"
    process = started("run", "--config", path, log=log)
    try:
        wait_until(lambda: "worker starting" in log.read_text() or process.poll() is not None, "the start", PATIENCE_S)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == ExitCode.SUCCESS, log.read_text()
    finally:
        process.kill()
        process.wait()


def test_a_signal_before_the_service_handles_it_is_a_stop() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ending, success_on_sigterm():
        signal.raise_signal(signal.SIGTERM)
    assert ending.value.code == ExitCode.SUCCESS
    assert signal.getsignal(signal.SIGTERM) is before


def test_check_config_of_the_template_of_these_tests_succeeds(tmp_path: Path) -> None:
    """Without a fault, none is found."""
    assert check_config.check_config(written(tmp_path), defaults=False, as_json=True) == ExitCode.SUCCESS
