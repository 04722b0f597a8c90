"""OpenMetrics text, read strictly: what the specification (version 1.0.0) calls an error is one here."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

NAME = r"[a-zA-Z_:][a-zA-Z0-9_:]*"
LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\["\\n])*)"')
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|[+-]?Inf|NaN")
SAMPLE = re.compile(rf"({NAME})(\{{(.*)\}})? (\S+)")
SUFFIXES = {
    "counter": {"_total"},
    "gauge": {""},
    "histogram": {"_bucket", "_count", "_sum"},
    "info": {"_info"},
    "stateset": {""},
}


class MalformedError(AssertionError):
    """This is no OpenMetrics text."""


@dataclass
class Family:
    """One family; `samples` by suffix and labels."""

    name: str
    kind: str = "unknown"
    unit: str = ""
    help: str | None = None
    samples: dict[tuple[str, tuple[tuple[str, str], ...]], float] = field(default_factory=dict)

    def value(self, suffix: str = "", **labels: str) -> float:
        """Of the one sample with these labels."""
        return self.samples[suffix, tuple(sorted(labels.items()))]


def _demand(condition: object, why: str) -> None:
    if not condition:
        raise MalformedError(why)


def parse(text: str) -> dict[str, Family]:
    """The families by their names."""
    _demand(text.endswith("# EOF\n"), "the text does not end with # EOF")
    families: dict[str, Family] = {}
    current: Family | None = None
    for line in text.removesuffix("# EOF\n").splitlines():
        _demand(line and line == line.strip(), f"blanks around a line: {line!r}")
        if line.startswith("#"):
            words = line.split(" ", 3)
            _demand(len(words) == 4 and words[0] == "#" and words[1] in ("TYPE", "UNIT", "HELP"), line)
            _, what, name, rest = words
            _demand(re.fullmatch(NAME, name), f"{name} is no name")
            if current is None or current.name != name:
                _demand(name not in families, f"the family {name} is told in two places")
                current = families[name] = Family(name)
            _demand(not current.samples, f"{what} of {name} after its samples")
            _describe(current, what, rest)
        else:
            _demand(current is not None, f"a sample before its family: {line}")
            assert current is not None
            _take(current, line)
    for family in families.values():
        _demand(family.kind in SUFFIXES, f"the type of {family.name}")
        if family.kind == "histogram":
            _check_histogram(family)
    names = [family.name + suffix for family in families.values() for suffix in SUFFIXES[family.kind]]
    _demand(len(names) == len(set(names)), "two families have a sample name in common")
    return families


def _describe(family: Family, what: str, rest: str) -> None:
    if what == "TYPE":
        _demand(family.kind == "unknown" and rest in SUFFIXES, f"TYPE of {family.name}")
        family.kind = rest
    elif what == "UNIT":
        _demand(not family.unit and family.name.endswith(f"_{rest}"), f"UNIT of {family.name}")
        family.unit = rest
    else:
        _demand(family.help is None and not re.search(r'(?<!\\)"|\\[^n\\"]', rest), f"HELP of {family.name}")
        family.help = rest


def _take(family: Family, line: str) -> None:
    match = SAMPLE.fullmatch(line)
    _demand(match, f"no sample: {line}")
    assert match is not None
    name, braces, inside, number = match.groups()
    _demand(name.startswith(family.name), f"{name} stands below {family.name}")
    suffix = name.removeprefix(family.name)
    _demand(suffix in SUFFIXES[family.kind], f"{name} in a {family.kind}")
    labels = _labels(inside or "", line) if braces else ()
    _demand(NUMBER.fullmatch(number), f"no number: {line}")
    value = float(number.replace("Inf", "inf"))
    _demand((suffix, labels) not in family.samples, f"told twice: {line}")
    if suffix in ("_total", "_bucket", "_count"):
        _demand(value >= 0 and math.isfinite(value), f"a count below zero or without end: {line}")
    if suffix in ("_bucket", "_count"):
        _demand(value == int(value), f"no whole number: {line}")
    if family.kind == "info":
        _demand(value == 1, line)
    if family.kind == "stateset":
        _demand(value in (0, 1) and family.name in dict(labels), line)
    family.samples[suffix, labels] = value


def _labels(inside: str, line: str) -> tuple[tuple[str, str], ...]:
    found = list(LABEL.finditer(inside))
    _demand(",".join(match.group() for match in found) == inside and found, f"labels: {line}")
    names = [match[1] for match in found]
    _demand(len(names) == len(set(names)), f"a label twice: {line}")
    return tuple(sorted((match[1], match[2]) for match in found))


def _check_histogram(family: Family) -> None:
    groups: dict[tuple[tuple[str, str], ...], list[tuple[float, float]]] = {}
    for (suffix, labels), value in family.samples.items():
        own = tuple(item for item in labels if item[0] != "le")
        groups.setdefault(own, [])
        if suffix == "_bucket":
            bounds = dict(labels)["le"]
            _demand(bounds == "+Inf" or re.fullmatch(r"\d+\.\d+(e-\d+)?|\d+e-\d+|\d+", bounds), f"le={bounds}")
            groups[own].append((float(bounds.replace("Inf", "inf")), value))
    for own, buckets in groups.items():
        bounds_s, counts = [bound for bound, _ in buckets], [count for _, count in buckets]
        _demand(bounds_s == sorted(bounds_s) and bounds_s[-1:] == [math.inf], f"buckets of {family.name}{own}")
        _demand(counts == sorted(counts), f"buckets of {family.name}{own} do not add up")
        _demand(family.samples["_count", own] == counts[-1], f"the count of {family.name}{own} is not its last bucket")
        _demand(family.samples["_sum", own] >= 0, f"the sum of {family.name}{own}")
