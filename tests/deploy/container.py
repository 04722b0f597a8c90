"""A container without a container engine: a copy of this machine's root that forgets what is written to it, in which
the steps of the Dockerfile are taken and its programs run, each as the user and with the rights that the files say.

For a process of its own, in namespaces of its own (`unshare`), as root: it leaves its old root for good.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from conftest import REPOSITORY
from deploy.written import Stage

SEARCH_PATH = "/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin"
"""ENV PATH of the image that the Dockerfile starts from."""

PLACE = Path("/srv")
"""Where the copy is put together, on a file system of its own: a folder that every Debian has."""

NEEDED = ("/proc", "/dev", "/sys", str(REPOSITORY), sys.prefix, sys.base_prefix, str(Path.home()))
"""What may lie on file systems of their own, which a copy of the root does not hold."""


def enter_copy_of_root() -> None:
    """Every file is there as it was; what is written, changed and removed from here on is forgotten at the end."""
    _run("mount", "--make-rprivate", "/")
    mounted = {line.split()[4] for line in Path("/proc/self/mountinfo").read_text().splitlines()}
    others = sorted(place for place in mounted - {"/"} if any(Path(one).is_relative_to(place) for one in NEEDED))
    _run("mount", "-t", "tmpfs", "-o", "mode=755", "tmpfs", str(PLACE))
    for name in ("changed", "work", "root"):
        (PLACE / name).mkdir()
    layers = f"lowerdir=/,upperdir={PLACE}/changed,workdir={PLACE}/work"
    _run("mount", "-t", "overlay", "overlay", "-o", layers, str(PLACE / "root"))
    for place in others:
        _run("mount", "--rbind", place, f"{PLACE}/root{place}")
    # Every container has memory of its own there.
    _run("mount", "-t", "tmpfs", "-o", "mode=1777", "tmpfs", str(PLACE / "root" / "dev" / "shm"))
    os.chroot(PLACE / "root")
    os.chdir("/")


def forget(*folders: str) -> None:
    """What somebody has left behind on this machine, in the copy: no image begins with it."""
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


def use_interpreter_as_image_does() -> None:
    """`python` and `pip` in /usr/local/bin, for every user, as in the image that the Dockerfile starts from."""
    prefix = Path(sys.base_prefix)
    if Path("/usr/local").parent == prefix:
        # The system's own interpreter: it lies around that folder, and takes no packages.
        _run(f"{prefix}/bin/python3", "-m", "venv", "/usr/local")
    elif prefix != Path("/usr/local"):
        if prefix.is_relative_to("/root"):
            _run("chmod", "go+x", "/root")
        layers = f"lowerdir={prefix}:/usr/local"
        _run("mount", "-t", "overlay", "overlay", "-o", layers, "/usr/local")
    assert shutil.which("python", path=SEARCH_PATH), f"{prefix} has no bin/python"


def take_steps(stage: Stage, built: bool) -> None:
    """The steps of a stage, as they are written.

    Args:
        built: whether what other stages have built is there already, where it is copied to.
    """
    folder = Path("/")
    environment = {"PATH": SEARCH_PATH, "HOME": "/root", "LANG": "C.UTF-8"}
    # How this machine reaches its index is not for the image to know, and for a build to be given.
    environment |= {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
    for step in stage.steps:
        match step.instruction:
            case "WORKDIR":
                folder = Path(step.text)
                folder.mkdir(parents=True, exist_ok=True)
            case "COPY" if step.text.startswith("--from="):
                *_, source, target = step.labels()
                if source != target and Path(source).exists():
                    shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True)
                assert built or not Path(target).exists()
            case "COPY":
                *sources, target = step.labels()
                _copy(sources, folder / target)
            case "RUN" if step.text == "coec warmup":
                pass  # takes minutes for all lenses; a service compiles those that it needs
            case "RUN":
                subprocess.run(["/bin/sh", "-c", step.text], cwd=folder, env=environment, check=True)
            case "ENV" | "USER" | "VOLUME" | "STOPSIGNAL" | "HEALTHCHECK" | "ENTRYPOINT" | "CMD":
                pass  # of what runs in it
            case other:
                raise AssertionError(f"the Dockerfile has a step that is not known here: {other}")


def _copy(sources: Sequence[str], target: Path) -> None:
    """As COPY: the content of a folder, a file by its name into a folder. `.dockerignore` keeps caches out."""
    for source in sources:
        origin = REPOSITORY / source
        if origin.is_dir():
            shutil.copytree(
                origin, target, ignore=shutil.ignore_patterns("__pycache__", "*.py[cod]"), dirs_exist_ok=True
            )
        else:
            shutil.copy(origin, target)


@dataclass(frozen=True, slots=True)
class Container:
    """How a program of the image is run: its environment, its user, and of the service in the compose file where it is
    one of these: capabilities, whether it may gain privileges, and whether its root can be written."""

    image: Stage
    service: Mapping[str, object]

    def command(self, command: Sequence[str]) -> list[str]:
        """The command with what gives it its user and takes its rights; for Popen, with `environment`."""
        user, _, group = self.image.last("USER").text.partition(":")
        rights = ["--reuid", user, "--regid", group, "--init-groups"]
        if self.service.get("cap_drop") == ["ALL"]:
            rights += ["--bounding-set=-all", "--inh-caps=-all", "--ambient-caps=-all"]
        if "no-new-privileges:true" in _strings(self.service.get("security_opt")):
            rights.append("--no-new-privs")
        limited = ["setpriv", *rights, "--", *command]
        if not self.service.get("read_only"):
            return limited
        # What is mounted by itself stays as it is when the root is made read-only, for this program alone.
        volumes = self.image.last("VOLUME").labels()
        steps = [f"mount --bind {folder} {folder}" for folder in volumes]
        steps.append("mount -o remount,bind,ro /")
        steps += [f"mount -t tmpfs tmpfs {folder}" for folder in _strings(self.service.get("tmpfs"))]
        return ["unshare", "--mount", "sh", "-c", f"{' && '.join(steps)} && exec {shlex.join(limited)}"]

    @property
    def environment(self) -> dict[str, str]:
        """That of the image."""
        given = {name: value.replace("$PATH", SEARCH_PATH) for name, value in self.image.environment.items()}
        return {"PATH": SEARCH_PATH, "HOME": "/", **given}


def _strings(value: object) -> list[str]:
    return [str(item) for item in value] if isinstance(value, list) else []


def _run(*command: str) -> None:
    subprocess.run(command, check=True)
