"""What the Dockerfile, the compose file, the unit and the examples say, and the commands that go with them."""

from __future__ import annotations

import copy
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from coec.config import config_of, load_config, parse_yaml
from coec.errors import ConfigError
from coec.io.zenoh.session import settings_of, unguarded
from conftest import REPOSITORY
from deploy.written import DEPLOY, compose, exec_start, shipped_configurations, stages, unit

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

DIGEST = r"sha256:[0-9a-f]{64}"
OTHER = f"sha256:{'5' * 64}"


# --------------------------------------------------------------------------------------------------------- images
def test_every_image_is_pinned_by_its_digest() -> None:
    assert stages()
    for stage in stages():
        assert re.fullmatch(rf"python:3\.11\.\d+-slim-bookworm@{DIGEST}", stage.image), stage.image
    assert len({stage.image for stage in stages()}) == 1
    assert {service.get("image") for service in compose().values()} == {"coec"}, "an image of another origin"


def test_what_the_image_is_built_from_is_not_retained_from_it() -> None:
    let_in = (REPOSITORY / ".dockerignore").read_text().splitlines()
    copied = [step.labels()[:-1] for step in stages()[0].steps if step.instruction == "COPY"]
    assert copied
    assert [source for sources in copied for source in sources if f"!{source}" not in let_in] == []


def pin_images(folder: Path, reported: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`deploy/pin-images` in a copy of the checkout, where the registry tells something."""
    (folder / "deploy").mkdir()
    shutil.copy(DEPLOY / "pin-images", folder / "deploy")
    shutil.copy(REPOSITORY / "Dockerfile", folder)
    docker = folder / "bin" / "docker"
    docker.parent.mkdir()
    docker.write_text(f'#!/bin/sh\necho "$@" >> {folder}/asked\n{reported}\n')
    docker.chmod(0o755)
    environment = {"PATH": f"{docker.parent}:/usr/bin:/bin"}
    command = [str(folder / "deploy" / "pin-images"), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def test_pin_images_writes_the_digest_that_the_registry_reports(tmp_path: Path) -> None:
    finished = pin_images(tmp_path, f"echo {OTHER}", "3.11.99-slim-bookworm")
    assert finished.returncode == 0, finished.stderr
    before, after = ((folder / "Dockerfile").read_text() for folder in (REPOSITORY, tmp_path))
    assert after == re.sub(rf"python:\S+@{DIGEST}", f"python:3.11.99-slim-bookworm@{OTHER}", before)
    (requested,) = (tmp_path / "asked").read_text().splitlines()
    assert requested == "buildx imagetools inspect python:3.11.99-slim-bookworm --format {{.Manifest.Digest}}"


@pytest.mark.parametrize("reported", ["exit 1", "echo not found"], ids=["no registry", "no digest"])
def test_pin_images_changes_nothing_without_a_digest(tmp_path: Path, reported: str) -> None:
    finished = pin_images(tmp_path, reported)
    assert finished.returncode == 1
    assert "nothing was changed" in finished.stderr
    assert (tmp_path / "Dockerfile").read_text() == (REPOSITORY / "Dockerfile").read_text()


def test_kernels_are_compiled_into_the_volume_of_the_cache_by_the_user_who_runs_the_service() -> None:
    """A cache that belongs to another user is not used, and what is written to a volume after its line is lost."""
    steps = [step.instruction if step.text != "coec warmup" else "warmup" for step in stages()[-1].steps]
    assert steps.index("ENV") < steps.index("USER") < steps.index("warmup") < steps.index("VOLUME")


# -------------------------------------------------------------------------------------------------------- compose
def test_every_service_is_bounded_confined_and_requested_whether_it_is_well() -> None:
    image = stages()[-1]
    for name, service in compose().items():
        assert re.fullmatch(r"\d+[gm]", service["mem_limit"]), name
        assert service["pids_limit"] > 0
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"] is True
        assert not service.get("ports"), "what is reached from outside is the router's to say"
        assert service.get("healthcheck", {}).get("test") or image.health_check


def test_only_who_must_is_on_the_network_of_the_host() -> None:
    assert {name for name, service in compose().items() if service.get("network_mode") == "host"} == {"router", "coec"}


def test_the_observer_has_no_key_but_its_own() -> None:
    targets = [volume.split(":")[1] for volume in compose()["observer"]["volumes"]]
    assert {Path(target).name for target in targets if target.endswith("key.pem")} == {"viewer-key.pem"}


def test_the_service_has_time_to_end_in() -> None:
    """In under 15 s, as it promises."""
    assert float(compose()["coec"]["stop_grace_period"].removesuffix("s")) > 15
    assert float(unit()["TimeoutStopSec"][0]) > 15


# ----------------------------------------------------------------------------------------------------------- unit
def test_the_unit_starts_what_the_image_starts() -> None:
    image = stages()[-1]
    program, *arguments = exec_start()
    assert program == "/opt/coec/bin/coec"
    assert [Path(program).name, *arguments] == [*image.last("ENTRYPOINT").labels(), *image.last("CMD").labels()]


def test_the_unit_lets_packets_to_the_router_of_this_computer_through_and_no_others() -> None:
    assert unit()["IPAddressDeny"] == ["any"]
    assert unit()["IPAddressAllow"] == ["localhost"]


def test_the_unit_has_as_much_memory_as_the_container() -> None:
    assert unit()["MemoryMax"] == [compose()["coec"]["mem_limit"].upper()]
    assert unit()["TasksMax"] == [str(compose()["coec"]["pids_limit"])]


def test_the_unit_gives_a_user_without_a_home_places_for_kernels_and_networks() -> None:
    (line,) = unit()["Environment"]
    assert {"XDG_CACHE_HOME=%C", "XDG_DATA_HOME=%S"} <= set(line.split())
    assert {"coec"} == {*unit()["CacheDirectory"], *unit()["StateDirectory"]}


@pytest.mark.fault(
    "a setting of the unit that systemd does not know, or that opens the sandbox",
    "systemd takes every line, and rates its exposure below 2 of 10",
)
def test_systemd_takes_the_unit_and_finds_it_confined(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("needs systemd-analyze")
    # The program is where the image has it, not on this machine.
    text = (DEPLOY / "coec.service").read_text().replace(exec_start()[0], "/bin/true")
    (tmp_path / "coec.service").write_text(text)
    verified = subprocess.run([analyze, "verify", "coec.service"], cwd=tmp_path, capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    rated = subprocess.run(
        [analyze, "security", "--offline=true", "--no-pager", "coec.service"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    result = re.search(r"Overall exposure level for coec.service: (\d+\.\d)", rated.stdout)
    assert result is not None, rated.stderr
    record_property("figure", f"exposure {result[1]}")
    assert float(result[1]) < 2.0


# -------------------------------------------------------------------------------------------------- configurations
@pytest.mark.parametrize("name", shipped_configurations())
def test_no_shipped_configuration_listens(name: str) -> None:
    """Seen from outside in `test_vehicle`."""
    config = load_config(REPOSITORY / name)
    settings = settings_of(config.zenoh, config.limits)
    assert settings.get_json("listen/endpoints") == "[]"
    assert unguarded(settings) == ()


@pytest.mark.parametrize("name", shipped_configurations())
def test_a_shipped_configuration_can_be_used_as_it_is(name: str) -> None:
    from coec.cli import check_config

    assert check_config.check_config(REPOSITORY / name, defaults=False, as_json=True) == 0


def leaves(value: object, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Where the values of a document stand; a row of numbers is one."""
    if isinstance(value, dict):
        for name, below in value.items():
            yield from leaves(below, (*path, name))
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for index, below in enumerate(value):
            yield from leaves(below, (*path, index))
    else:
        yield path


@pytest.mark.parametrize("path", sorted((DEPLOY / "examples").glob("*.yaml")), ids=lambda path: path.stem)
def test_nothing_stands_in_an_example_that_need_not(path: Path) -> None:
    """What is taken away changes what the example comes to, or makes it none."""
    written = parse_yaml(path.read_text())
    whole = config_of(written)
    idle = []
    for place in leaves(written):
        document = copy.deepcopy(written)  # an alias stays the same object as what it stands for
        below = document
        for step in place[:-1]:
            below = below[step]
        del below[place[-1]]
        try:
            same = config_of(document) == whole
        except ConfigError:
            same = False
        if same:
            idle.append(place)
    assert idle == []


# ------------------------------------------------------------------------------------------------------ the wheel
def test_the_wheel_of_the_dockerfile_runs_next_to_the_packages_of_this_environment(tmp_path: Path) -> None:
    """The short form of what `test_vehicle` builds from nothing: the wheel by its own command, then what the image
    starts, of a configuration that is not there."""
    (build,) = [step.text for step in stages()[0].steps if "hatchling build" in step.text]
    context = tmp_path / "build"
    context.mkdir()
    for source in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / source, context)
    shutil.copytree(REPOSITORY / "service", context / "service", ignore=shutil.ignore_patterns("__pycache__"))
    command = build.split("&&")[0].replace("tools/bin/hatchling", f"{sys.executable} -m hatchling")
    subprocess.run(command, shell=True, cwd=context, check=True, capture_output=True)
    (wheel,) = (context / "dist").glob("coec-*.whl")
    target = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(target)  # which is what installing a wheel of plain Python comes to
    assert (target / "coec" / "io" / "depth" / "cards" / "street.onnx").is_file()
    program = f"import sys; sys.path.insert(0, {str(target)!r}); from coec.cli.main import main; sys.exit(main())"
    checked = [sys.executable, "-I", "-c", program]
    finished = subprocess.run(
        [*checked, *stages()[-1].last("CMD").labels()], capture_output=True, text=True, cwd=tmp_path
    )
    assert finished.returncode == ConfigError.exit_code
    assert "cannot read /etc/coec/coec.yaml" in finished.stderr
