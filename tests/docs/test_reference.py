"""The generated pages of the reference hold what there is: all of it, and each once. What there is is counted here by
other means than those that write the pages."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, get_args

import pytest
import typer
from pydantic import BaseModel

from coec.cli.main import application
from coec.config import Config
from coec.config.pair import OpenCameraConfig, OpenEgoConfig, OpenLidarConfig, OpenPairConfig
from coec.config.rig import RigConfig, RigStages
from coec.schemas.keys import Keys
from coec_lab.experiments.schema_export import MESSAGES
from conftest import REPOSITORY

DOCS = REPOSITORY / "docs"
TWO_FORMS = "## The sensors of a vehicle, each told once"
"""Of a configuration: what stands below is the other."""


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


# ------------------------------------------------------------------------------------------------ command line
def leaves(command: Any, labels: str) -> Iterator[tuple[str, Any]]:
    for name, child in getattr(command, "commands", {}).items():
        yield f"{labels} {name}", child
        yield from leaves(child, f"{labels} {name}")


def sections() -> dict[str, str]:
    parts = re.split(r"^## (coec [a-z- ]+)$", page("cli.md"), flags=re.MULTILINE)
    assert len(parts[1::2]) == len(set(parts[1::2])), "a command stands there twice"
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def test_every_option_of_every_command_stands_there_once() -> None:
    shown = sections()
    tree = dict(leaves(typer.main.get_command(application(())), "coec"))
    for name, command in tree.items():
        options = [opt for one in command.params for opt in (*one.opts, *one.secondary_opts) if opt.startswith("--")]
        terms = re.findall(r"^`([^`]+)`\n:   ", shown.get(name, ""), flags=re.MULTILINE)
        reported = Counter(re.findall(r"--[a-z0-9-]+", " ".join(terms)))
        assert reported == Counter(options), name
        assert len(terms) == len(command.params), name
        assert [one.name for one in command.params if not one.help] == [], name
    groups = {name for name, command in tree.items() if getattr(command, "commands", None)}
    assert set(tree) - groups <= set(shown) <= set(tree)


def test_the_commands_of_the_picture_are_those_that_there_are() -> None:
    rendered = re.findall(r'<text class="c"[^>]*>([^<]+)</text>', page("images/commands.svg"))
    named = Counter(word for text in rendered for word in text.split(", "))
    assert named == Counter(list(typer.main.get_command(application(())).commands))  # type: ignore[attr-defined]


# ----------------------------------------------------------------------------------------------- configuration
def models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models(part)


def keys(model: type[BaseModel], place: str = "") -> Iterator[str]:
    """Every key of the plain form; entries of `awaited` are those of `pairs`."""
    for name, one in model.model_fields.items():
        yield place + name
        many = "[]" if "tuple" in str(one.annotation) else ""
        for child in models(one.annotation):
            if child is not OpenPairConfig:
                yield from keys(child, f"{place}{name}{many}.")


def shown_keys(text: str) -> Counter[str]:
    return Counter(re.findall(r"^\| `([^`]+)` \|", text, flags=re.MULTILINE))


def test_every_key_of_a_configuration_stands_there_once() -> None:
    plain, _, _ = page("configuration.md").partition(TWO_FORMS)
    assert shown_keys(plain) == Counter(keys(Config))


def test_every_key_that_only_a_rig_has_stands_there_once() -> None:
    _, _, rig = page("configuration.md").partition(TWO_FORMS)
    shown = shown_keys(rig)
    assert set(shown.values()) == {1}
    every = set(keys(RigConfig))
    assert set(shown) <= every
    # What is left out stands in the plain form, with the same name at the end.
    stated = {
        name for model in (OpenCameraConfig, OpenLidarConfig, OpenEgoConfig, RigStages) for name in model.model_fields
    }
    assert {key for key in every - set(shown) if not stated & set(re.split(r"\W+", key))} == {"links"} | {
        key for key in every if key.startswith("links[]")
    }


def test_every_key_says_what_it_means() -> None:
    rows = re.findall(r"^\| `[^`]+` \|.*\|([^|]*)\|$", page("configuration.md").replace(r"\|", "/"), flags=re.MULTILINE)
    assert rows
    assert [row for row in rows if not row.strip()] == []


@pytest.mark.parametrize(
    ("key", "default", "unit", "bounds"),
    [
        ("pairs[].calibration.search.rotation_deg", "`10.0`", "°", "(0, 45]"),
        ("pairs[].window.max_clipped", "`0.6`", "", "(0, 1]"),
        ("limits.max_message_bytes", "`33554432`", "B", "[65536, 1.07374e+09]"),
        ("pairs[].tracker.drift_deg_per_sqrt_h", "`0.01`", "°/√h", "[0, ∞)"),
        ("pairs[].policy.apply", "`within_limits`", "", "`never`, `within_limits`, `always`"),
        ("pairs[].camera.intrinsics.fx", "*needed*", "px", "(0, ∞)"),
        ("zenoh.embedded_router", "`false`", "", "`true`, `false`"),
    ],
)
def test_a_key_has_its_default_unit_and_range(key: str, default: str, unit: str, bounds: str) -> None:
    row = re.search(
        rf"^\| `{re.escape(key)}` \| (.*?) \| (.*?) \| (.*?) \| ", page("configuration.md"), flags=re.MULTILINE
    )
    assert row is not None
    assert (row[1], row[2].strip(), row[3].strip()) == (default, unit, bounds)


# ------------------------------------------------------------------------------------------------- keys, schemas
def test_every_key_that_can_be_requested_is_reported() -> None:
    built = Keys("p", "v")
    names = [name for name in vars(Keys) if not name.startswith("_") and name not in ("prefix", "vehicle", "root")]
    arguments = {"pair": "<pair>", "window_id": "<id>", "event_id": "<id>", "name": "<name>"}
    text = page("keys.md")
    for name in names:
        made = getattr(built, name)
        if callable(made):
            expected = made.__code__.co_varnames[1 : made.__code__.co_argcount]
            if not set(expected) <= set(arguments):
                continue  # the claim of a daemon, and what reads keys
            made = made(*(arguments[one] for one in expected))
        assert f"`{made.replace('p/@v1/v/', '…/')}`" in text, name


def test_every_message_is_reported_with_its_fields() -> None:
    text = page("schemas.md")
    for message in MESSAGES:
        name = message.__name__
        result = re.search(rf"^## {name} .*?(?=^## |\Z)", text, flags=re.MULTILINE | re.DOTALL)
        assert result is not None, name
        assert shown_keys(result[0]) == Counter(list(message.model_fields)), name


def error_codes(*packages: str) -> set[str]:
    paths = (path for package in packages for path in (REPOSITORY / "service" / package).rglob("*.py"))
    source = (path.read_text(encoding="utf-8") for path in paths)
    return {code for text in source for code in re.findall(r'^    reply_code = "([a-z_]+)"', text, flags=re.MULTILINE)}


def test_every_error_code_is_reported() -> None:
    _, _, reported = page("keys.md").partition("## Error codes")
    assert shown_keys(reported) == Counter(error_codes("coec", "coec_lab"))
