"""The vehicle's wheel in an environment that holds what it declares, and nothing else."""

from __future__ import annotations

import email
import json
import os
import subprocess
import venv
import zipfile
from collections.abc import Iterable
from importlib.metadata import Distribution, packages_distributions
from pathlib import Path

import pytest

from cli.conftest import SMALL
from deploy.test_archives import built
from deploy.test_locks import needed
from e2e.processes import Router, service, write_configuration
from support.fleet import recorded_windows
from support.simulated_drives import rendered_source

ABSENT = ("coec_lab", "embreex", "matplotlib", "PIL")
"""Modules of the laboratory, and those that only it needs."""

OPTIONAL = "foxglove"
"""What modules miss that only who serves viewers imports: it is an optional extra."""

IMPORT_ALL = """
import importlib, json, pkgutil
import coec

errors = {}
for module in pkgutil.walk_packages(coec.__path__, "coec."):
    try:
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    except ImportError as error:
        errors[module.name] = error.name
print(json.dumps([coec.__file__, errors]))
"""


class Environment:
    """A virtual environment with links to what is installed in this one.

    Attributes:
        python: its interpreter.
    """

    def __init__(self, folder: Path) -> None:
        venv.create(folder, symlinks=True)
        self.python = folder / "bin" / "python"
        (self._packages,) = folder.glob("lib/python3.*/site-packages")
        self._owners = packages_distributions()

    def unpack(self, wheel: Path) -> list[str]:
        """Installs a wheel of plain Python; what it requires."""
        zipfile.ZipFile(wheel).extractall(self._packages)
        (metadata,) = self._packages.glob("coec-*.dist-info/METADATA")
        return email.message_from_string(metadata.read_text()).get_all("Requires-Dist") or []

    def link(self, distributions: Iterable[Distribution]) -> None:
        """Adds distributions that are installed here."""
        for package in distributions:
            for file in package.files or ():
                # Folders that several distributions share, as `google` is, are made of links to what is in them.
                depth = 2 if len(self._owners.get(file.parts[0], ())) > 1 else 1
                name = Path(*file.parts[:depth])
                link = self._packages / name
                if ".." not in name.parts and name.parts[0] != "__pycache__" and not link.is_symlink():
                    link.parent.mkdir(exist_ok=True)
                    link.symlink_to(Path(str(package.locate_file(name))))

    def run(self, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
        """The interpreter with these arguments, to its end."""
        text = [str(self.python), *map(str, arguments)]
        return subprocess.run(text, capture_output=True, text=True, cwd=cwd, env=self.variables(cwd))

    def coec(self, *arguments: object, cwd: Path) -> str:
        """Standard output of `coec ARGS`, which succeeds."""
        done = self.run("-m", "coec", *arguments, cwd=cwd)
        assert done.returncode == 0, done.stderr
        return done.stdout

    @staticmethod
    def variables(cwd: Path) -> dict[str, str]:
        """Those of this process without its modules; kernels are kept below `cwd`."""
        own = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
        return own | {"XDG_CACHE_HOME": str(cwd / "cache")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def vehicle(wheel: Path, tmp_path: Path) -> Environment:
    """The wheel, and what it requires without extras."""
    environment = Environment(tmp_path / "vehicle")
    environment.link(needed(environment.unpack(wheel)).values())
    return environment


def test_every_module_of_the_wheel_imports_next_to_what_it_declares_alone(vehicle: Environment, tmp_path: Path) -> None:
    done = vehicle.run("-c", IMPORT_ALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    file, errors = json.loads(done.stdout)
    assert Path(file).is_relative_to(tmp_path), "it is the wheel that was imported"
    assert {name: missed for name, missed in errors.items() if missed != OPTIONAL} == {}
    absent = "import importlib.util, sys; print([m for m in sys.argv[1:] if importlib.util.find_spec(m)])"
    assert vehicle.run("-c", absent, *ABSENT, cwd=tmp_path).stdout == "[]\n"


@pytest.mark.slow  # compiles the kernels: they are kept for the place where the sources lie
def test_the_wheel_alone_serves_calibrates_replays_and_evaluates_many(
    vehicle: Environment, wheel: Path, router: Router, tmp_path: Path
) -> None:
    windows = tmp_path / "recorded"
    windows.mkdir()
    recorded_windows(windows)
    window = windows / "one" / "one-1.mcap"
    out = tmp_path / "out"
    rendered = {"result.json", "report.html", "overlay_before.png", "overlay_after.png", "close_ups.png"}
    calibrated = json.loads(vehicle.coec("calibrate", window, "--output", out, "--json", cwd=tmp_path))
    assert calibrated["verdict"]["decision"] == "accepted"
    assert rendered <= {path.name for path in out.iterdir()}
    assert "identical" in vehicle.coec("replay", window, cwd=tmp_path)

    configuration = write_configuration(tmp_path / "service", rendered_source(SMALL), router.endpoint)
    program = ("env", "--unset=PYTHONPATH", f"XDG_CACHE_HOME={tmp_path / 'cache'}", str(vehicle.python), "-m", "coec")
    with service(configuration, router, warm=False, program=program) as running:
        query = ("query", "status", "--config", configuration, "--json")
        status = json.loads(vehicle.coec(*query, cwd=tmp_path))
        assert [pair["name"] for pair in status["pairs"]] == [running.pair]
        assert running.terminate() == 0

    vehicle.link(needed(vehicle.unpack(wheel), ("", "fleet")).values())
    batch = ("batch", windows / "one", "--output", tmp_path / "tables", "--jobs", 1, "--json")
    assert json.loads(vehicle.coec(*batch, cwd=tmp_path))["differing"] == 0
