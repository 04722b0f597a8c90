"""With which status the service ends, and what the unit of systemd makes of it."""

from __future__ import annotations

import errno
import logging
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from coec import daemon
from coec.cli.check_config import example
from coec.config import Config, StateConfig, ZenohConfig
from coec.errors import CoecError, ConfigError, UnavailableError
from conftest import REPOSITORY

pytestmark = pytest.mark.usefixtures("process")
UNIT = (REPOSITORY / "deploy" / "coec.service").read_text()
TEMPFAIL = 75


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


@pytest.mark.fault("a bad configuration", "exit code 78: the unit gives up on it, and on nothing else")
def test_the_unit_gives_up_on_a_bad_configuration_and_on_nothing_else() -> None:
    ends = {CoecError.exit_code, UnavailableError.exit_code, daemon.EXIT_THREAD_DIED, ConfigError.exit_code}
    assert ends & never_again() == {ConfigError.exit_code}
    assert "Restart=on-failure" in UNIT
    assert re.search(r"^StartLimitIntervalSec=0$", UNIT, re.MULTILINE), "the fifth quick failure would be the last"


def test_a_reload_of_the_unit_is_the_signal_that_the_service_heeds() -> None:
    assert re.search(r"^ExecReload=/bin/kill -HUP \$MAINPID$", UNIT, re.MULTILINE)


@pytest.mark.fault("the port is taken", "exit code 75: the unit tries again")
def test_a_port_that_is_taken_may_be_free_later(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert daemon.run(configured(tmp_path / "state", other.getsockname()[1])) == TEMPFAIL


@pytest.mark.fault("a state directory that is read-only or full at the start", "exit code 75: the unit tries again")
def test_a_disk_that_takes_no_file_may_take_one_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refused)
    assert daemon.run(configured(tmp_path / "state", 0)) == TEMPFAIL


def test_an_endpoint_that_is_none_stays_none(tmp_path: Path) -> None:
    config = configured(tmp_path, 0)
    wrong = config.zenoh.model_copy(update={"listen": ("tcp/127.0.0.1:abc",)})
    assert daemon.run(config.model_copy(update={"zenoh": wrong})) == ConfigError.exit_code


def test_a_door_for_everybody_is_a_mistake_unless_spelled_out(tmp_path: Path) -> None:
    config = configured(tmp_path, 0)
    wide = config.zenoh.model_copy(update={"listen": ("tcp/0.0.0.0:0",)})
    assert daemon.run(config.model_copy(update={"zenoh": wide})) == ConfigError.exit_code
