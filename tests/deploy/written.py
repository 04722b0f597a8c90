"""What the files of the deployment say, in their parts: Dockerfile, compose file, systemd unit."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ruamel.yaml import YAML

from conftest import REPOSITORY

DEPLOY = REPOSITORY / "deploy"


@dataclass(frozen=True, slots=True)
class Step:
    """An instruction of a Dockerfile: `COPY`, and the rest of its line, continued lines joined."""

    instruction: str
    text: str

    def labels(self) -> list[str]:
        """Of a list in JSON, or as a shell splits them."""
        return list(json.loads(self.text)) if self.text.startswith("[") else shlex.split(self.text)


@dataclass(frozen=True, slots=True)
class Stage:
    """What stands between one FROM and the next; `image` with the arguments filled in."""

    image: str
    name: str | None
    steps: Sequence[Step]

    def last(self, instruction: str) -> Step:
        """The one that holds: later instructions replace earlier ones."""
        return [step for step in self.steps if step.instruction == instruction][-1]

    @property
    def environment(self) -> dict[str, str]:
        """What its ENV sets."""
        return dict(word.split("=", 1) for step in self.steps if step.instruction == "ENV" for word in step.labels())

    @property
    def health_check(self) -> list[str]:
        """The command of HEALTHCHECK."""
        text = self.last("HEALTHCHECK").text
        return Step("CMD", text[text.index("CMD ") + len("CMD ") :].strip()).labels()


def stages() -> list[Stage]:
    """Of the Dockerfile, in order."""
    arguments: dict[str, str] = {}
    result: list[Stage] = []
    for step in steps((REPOSITORY / "Dockerfile").read_text()):
        if step.instruction == "ARG" and not result:
            name, _, value = step.text.partition("=")
            arguments[name] = value
        elif step.instruction == "FROM":
            image, *named = step.labels()
            for name, value in arguments.items():
                image = image.replace(f"${{{name}}}", value)
            result.append(Stage(image, named[1] if named else None, []))
        else:
            result[-1] = Stage(result[-1].image, result[-1].name, [*result[-1].steps, step])
    return result


def steps(text: str) -> list[Step]:
    """The instructions of a Dockerfile."""
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    joined = re.sub(r"\\\n\s*", " ", lines)
    return [Step(*line.split(maxsplit=1)) for line in joined.splitlines() if line.strip()]


def compose() -> Mapping[str, Any]:
    """The services of the compose file by name."""
    document = YAML(typ="safe").load((DEPLOY / "compose.yaml").read_text())
    return dict(document["services"])


def unit() -> Mapping[str, list[str]]:
    """The settings of the unit's [Service], each with all its values in order."""
    result: dict[str, list[str]] = {}
    section = ""
    for line in (DEPLOY / "coec.service").read_text().splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif section == "Service" and line and not line.startswith("#"):
            name, _, value = line.partition("=")
            result.setdefault(name, []).append(value)
    return result


def exec_start() -> list[str]:
    """The command that the unit starts."""
    (line,) = unit()["ExecStart"]
    return shlex.split(line)


def shipped_configurations() -> list[str]:
    """The service's, by their path below the root of the checkout."""
    result = [DEPLOY / "coec.yaml", DEPLOY / "ros2" / "coec.yaml", *sorted((DEPLOY / "examples").glob("*.yaml"))]
    return [path.relative_to(REPOSITORY).as_posix() for path in result]


def documented_sockets() -> dict[str, list[str]]:
    """Who listens where, by the page of the deployment."""
    text = (REPOSITORY / "docs" / "deployment.md").read_text()
    (table,) = re.findall(r"\| program \| sockets \|\n\|[-|]+\|\n((?:\|.*\|\n)+)", text)
    rows = [[cell.strip() for cell in row.strip("|").split(" | ")] for row in table.splitlines()]
    return {program.replace("`", ""): re.findall(r"`([^`]+)`", sockets) for program, sockets in rows}
