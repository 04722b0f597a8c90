"""Names in the code are terms of robotics, statistics and distributed systems: the list of words that are none."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator

import pytest

from conftest import REPOSITORY

REFUSED = {
    "ail": "problem",
    "affords": "try_acquire",
    "apart": "separation, distance",
    "aside": "quarantined, offset",
    "ask": "request, submit",
    "asked": "requested, submitted",
    "asks": "requester, client",
    "awaited": "pending, discovered",
    "begun": "started, opened",
    "belief": "posterior",
    "beside": "next_to, alongside",
    "came": "received",
    "chooser": "selector",
    "chosen": "selected",
    "climb": "ascent",
    "climbed": "ascended",
    "climbs": "ascents",
    "decider": "manager, engine",
    "desk": "evaluator",
    "draw": "sample (at random), render, plot",
    "drawn": "simulated, sampled, rendered",
    "ended": "finished, closed",
    "found": "result, match, detection",
    "grain": "angular_resolution",
    "hear": "on_update, receive",
    "heard": "received, authenticated",
    "heed": "apply, follow",
    "keeper": "estimator, manager (of what)",
    "kept": "record, retained",
    "knocked": "perturbed, disturbed",
    "laid": "projected",
    "lay": "project",
    "look": "check, observation",
    "looked": "checked",
    "looks": "checks, observations, independent_samples",
    "loosen": "relax",
    "loosened": "relaxed",
    "objections": "vetoes, alarms",
    "outside": "context, environment",
    "prices": "cost_model",
    "questions": "requests, job_client",
    "recall": "load, restore",
    "reception": "command_handler",
    "remark": "note, warning",
    "roster": "fleet_state",
    "said": "report, message, text",
    "saying": "message",
    "scribe": "disk_writer",
    "sight": "window_data",
    "sights": "window_data",
    "spending": "usage",
    "tell": "publish, report, format",
    "tells": "reports, indicates",
    "told": "reply, message, text, measurement, assumption: name the thing",
    "trouble": "problem, error",
    "troubles": "problems",
    "wanted": "requested, required",
    "ways": "directions, parameter_subset",
    "wishes": "requests",
    "witness": "cue, cost_term",
    "witnesses": "cues, cost_terms",
    "words": "text, labels",
    "worth": "prior_odds, information, value",
}
"""Words that no textbook has for what they name in a program, and terms to choose from."""

WIRE = {
    "service/coec/config/root.py": {"awaited"},
    "service/coec/schemas/documents.py": {"kept", "looked_s", "said_s"},
    "service/coec/schemas/heartbeat.py": {"said_ns"},
    "service/coec/schemas/replies.py": {"found", "independent_looks", "kept_for", "look_s", "wanted"},
    "service/coec/schemas/rig_state.py": {"looks"},
    "service/coec/service/discovery.py": {"asked", "found_ns"},
    "service/coec_lab/experiments/evaluation_schema.py": {"told_s", "wanted", "wanted_s"},
    "service/coec_lab/experiments/simulation_schemas.py": {"KnockedRow", "RigLook", "biased_found", "knocked", "looks"},
    "tests/upgrade/test_step_back.py": {"independent_looks"},
}
"""Fields of messages, of files on a vehicle's disk and of published tables, and the models that are named in their JSON
Schemas: the contract holds them."""

COMMON = {"NotFoundError", "not_found", "is_not_found"}
"""Terms that hold a refused word."""


@functools.cache
def text_of(name: str) -> set[str]:
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def defined_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


def refused_names(source: str, permitted: set[str]) -> set[str]:
    identifiers = set(re.findall(r"\w+", source)) - permitted - COMMON
    refused = {name for name in identifiers if text_of(name) & REFUSED.keys()}
    return refused and refused & set(defined_names(ast.parse(source)))


@pytest.mark.parametrize("folder", ["service", "docs/generate", "tests"])
def test_names_are_terms_of_the_field(folder: str) -> None:
    for path in sorted((REPOSITORY / folder).rglob("*.py")):
        place = path.relative_to(REPOSITORY).as_posix()
        refused = refused_names(path.read_text(encoding="utf-8"), WIRE.get(place, set()))
        hints = {name: [REFUSED[word] for word in text_of(name) & REFUSED.keys()] for name in refused | {path.stem}}
        assert not {name: hint for name, hint in hints.items() if hint}, place


def test_every_exception_is_still_needed() -> None:
    for place, permitted in WIRE.items():
        source = (REPOSITORY / place).read_text(encoding="utf-8")
        assert refused_names(source, set()) == permitted, place


@pytest.mark.parametrize(
    ("source", "refused"),
    [
        ("def told(): ...", {"told"}),
        ("class HeardReply: ...", {"HeardReply"}),
        ("self.kept_s = 1", {"kept_s"}),
        ("def load(knocked): ...", {"knocked"}),
        ("class NotFoundError(Exception): ...", set()),
        ("print(told)", set()),
    ],
)
def test_definitions_are_read_and_uses_are_not(source: str, refused: set[str]) -> None:
    assert refused_names(source, set()) == refused
