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


def _require(condition: object, why: str) -> None:
    if not condition:
        raise MalformedError(why)


def parse_open_metrics(text: str) -> dict[str, Family]:
    """The families by their names."""
    _require(text.endswith("# EOF\n"), "the text does not end with # EOF")
    families: dict[str, Family] = {}
    current: Family | None = None
    for line in text.removesuffix("# EOF\n").splitlines():
        _require(line and line == line.strip(), f"blanks around a line: {line!r}")
        if line.startswith("#"):
            parts = line.split(" ", 3)
            _require(len(parts) == 4 and parts[0] == "#" and parts[1] in ("TYPE", "UNIT", "HELP"), line)
            _, what, name, rest = parts
            _require(re.fullmatch(NAME, name), f"{name} is no name")
            if current is None or current.name != name:
                _require(name not in families, f"the family {name} is told in two places")
                current = families[name] = Family(name)
            _require(not current.samples, f"{what} of {name} after its samples")
            _describe(current, what, rest)
        else:
            _require(current is not None, f"a sample before its family: {line}")
            assert current is not None
            _add_sample(current, line)
    for family in families.values():
        _require(family.kind in SUFFIXES, f"the type of {family.name}")
        if family.kind == "histogram":
            _check_histogram(family)
    names = [family.name + suffix for family in families.values() for suffix in SUFFIXES[family.kind]]
    _require(len(names) == len(set(names)), "two families have a sample name in common")
    return families


def _describe(family: Family, what: str, rest: str) -> None:
    if what == "TYPE":
        _require(family.kind == "unknown" and rest in SUFFIXES, f"TYPE of {family.name}")
        family.kind = rest
    elif what == "UNIT":
        _require(not family.unit and family.name.endswith(f"_{rest}"), f"UNIT of {family.name}")
        family.unit = rest
    else:
        _require(family.help is None and not re.search(r'(?<!\\)"|\\[^n\\"]', rest), f"HELP of {family.name}")
        family.help = rest


def _add_sample(family: Family, line: str) -> None:
    match = SAMPLE.fullmatch(line)
    _require(match, f"no sample: {line}")
    assert match is not None
    name, braces, inside, number = match.groups()
    _require(name.startswith(family.name), f"{name} stands below {family.name}")
    suffix = name.removeprefix(family.name)
    _require(suffix in SUFFIXES[family.kind], f"{name} in a {family.kind}")
    labels = _labels(inside or "", line) if braces else ()
    _require(NUMBER.fullmatch(number), f"no number: {line}")
    value = float(number.replace("Inf", "inf"))
    _require((suffix, labels) not in family.samples, f"told twice: {line}")
    if suffix in ("_total", "_bucket", "_count"):
        _require(value >= 0 and math.isfinite(value), f"a count below zero or without end: {line}")
    if suffix in ("_bucket", "_count"):
        _require(value == int(value), f"no whole number: {line}")
    if family.kind == "info":
        _require(value == 1, line)
    if family.kind == "stateset":
        _require(value in (0, 1) and family.name in dict(labels), line)
    family.samples[suffix, labels] = value


def _labels(inside: str, line: str) -> tuple[tuple[str, str], ...]:
    matches = list(LABEL.finditer(inside))
    _require(",".join(match.group() for match in matches) == inside and matches, f"labels: {line}")
    names = [match[1] for match in matches]
    _require(len(names) == len(set(names)), f"a label twice: {line}")
    return tuple(sorted((match[1], match[2]) for match in matches))


def _check_histogram(family: Family) -> None:
    groups: dict[tuple[tuple[str, str], ...], list[tuple[float, float]]] = {}
    for (suffix, labels), value in family.samples.items():
        own = tuple(item for item in labels if item[0] != "le")
        groups.setdefault(own, [])
        if suffix == "_bucket":
            bounds = dict(labels)["le"]
            _require(bounds == "+Inf" or re.fullmatch(r"\d+\.\d+(e-\d+)?|\d+e-\d+|\d+", bounds), f"le={bounds}")
            groups[own].append((float(bounds.replace("Inf", "inf")), value))
    for own, buckets in groups.items():
        bounds_s, counts = [bound for bound, _ in buckets], [count for _, count in buckets]
        _require(bounds_s == sorted(bounds_s) and bounds_s[-1:] == [math.inf], f"buckets of {family.name}{own}")
        _require(counts == sorted(counts), f"buckets of {family.name}{own} do not add up")
        _require(family.samples["_count", own] == counts[-1], f"the count of {family.name}{own} is not its last bucket")
        _require(family.samples["_sum", own] >= 0, f"the sum of {family.name}{own}")
