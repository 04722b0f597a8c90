"""The names by which the service is reached. Keys and selectors on Zenoh (`<prefix>/@v1/<vehicle>/<pair>/...`) are
built and parsed here and nowhere else; below them, the names of its node, topics, frames and diagnostics on ROS 2.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final, Literal

from coec.errors import UsageError

VERSION_CHUNK: Final = "@v1"
"""A chunk that starts with `@` is not matched by `**`: the version never leaks into wildcards."""

RIG: Final = "rig"
"""Stands in a key in place of a pair, for all pairs of a vehicle together."""

LAST: Final = "last"
"""Stands in a key in place of a pair; below it are the last words of all pairs, which a storage keeps while the vehicle
is parked."""

MAX_LIMIT: Final = 10_000
"""Most results in one reply of `history`, as many as the state keeps at most (config.StateConfig.history)."""

MAX_LENGTH: Final = 16 * 2**20
"""Most bytes in one reply of `windows/<id>`: half of Zenoh's configured message size."""

COMMAND_TIMEOUT_MS: Final = 10_000
"""Timeout of a command that gives none; a Zenoh client that gives none waits as long (`queries_default_timeout`)."""

MAX_COMMAND_TIMEOUT_MS: Final = 600_000

Format = Literal["msgpack", "json"]
_FORMATS: Final[dict[str, Format]] = {"msgpack": "msgpack", "json": "json"}


@dataclass(frozen=True, slots=True)
class Address:
    """What a key names: `resource` of `pair`, or of the vehicle if `pair` is None. `argument` is the id of the window
    or event, or the command's name."""

    pair: str | None
    resource: str
    argument: str | None = None


@dataclass(frozen=True, slots=True)
class Claim:
    """What a daemon tells other daemons of its vehicle about itself.

    Attributes:
        daemon: its Zenoh id, hexadecimal.
        since_ns: wall clock at its start.
        serving: whether it answers queries; False while it starts.
    """

    daemon: str
    since_ns: int
    serving: bool


@dataclass(frozen=True, slots=True)
class Keys:
    """Keys of one vehicle."""

    prefix: str
    vehicle: str

    @property
    def root(self) -> str:
        """The part that all keys of the vehicle share."""
        return f"{self.prefix}/{VERSION_CHUNK}/{self.vehicle}"

    @property
    def status(self) -> str:
        """Queryable: status of the daemon."""
        return f"{self.root}/status"

    @property
    def metrics(self) -> str:
        """Queryable: OpenMetrics text."""
        return f"{self.root}/metrics"

    @property
    def config(self) -> str:
        """Queryable: effective configuration without secrets."""
        return f"{self.root}/config"

    @property
    def rig(self) -> str:
        """Queryable, and published on change: state of all sensors of the vehicle."""
        return f"{self.root}/{RIG}"

    def last(self, pair: str) -> str:
        """Queryable, and published on change and periodically: the last word of a pair; `pair` may be `*`."""
        return f"{self.root}/{LAST}/{pair}"

    def extrinsic(self, pair: str) -> str:
        """Queryable, and published on change."""
        return f"{self.root}/{pair}/extrinsic"

    def health(self, pair: str) -> str:
        """Queryable, and published on change."""
        return f"{self.root}/{pair}/health"

    def history(self, pair: str) -> str:
        """Queryable: past results."""
        return f"{self.root}/{pair}/history"

    def windows(self, pair: str) -> str:
        """Queryable: list of recorded windows."""
        return f"{self.root}/{pair}/windows"

    def window(self, pair: str, window_id: str) -> str:
        """Queryable: bytes of one recorded window; `window_id` may be `*`."""
        return f"{self.root}/{pair}/windows/{window_id}"

    def overlay(self, pair: str) -> str:
        """Queryable: JPEG of the latest window's points on the image."""
        return f"{self.root}/{pair}/overlay"

    def evidence(self, pair: str) -> str:
        """Queryable: list of the kept incidents."""
        return f"{self.root}/{pair}/evidence"

    def evidence_of(self, pair: str, event_id: str) -> str:
        """Queryable: one incident with its figures, or a picture of it (`?overlay=before`, `?overlay=after`)."""
        return f"{self.root}/{pair}/evidence/{event_id}"

    def command(self, pair: str, name: str) -> str:
        """Queryable with payload; `name` may be `*`. With `RIG` as pair: for all pairs, or for those of the sensor that
        the payload names."""
        return f"{self.root}/{pair}/command/{name}"

    def alive(self, pair: str) -> str:
        """Liveliness token."""
        return f"{self.root}/{pair}/alive"

    @property
    def claims(self) -> str:
        """Liveliness tokens of the vehicle's daemons, all of them; each daemon answers a query for its own."""
        return f"{self.root}/alive/*/*/*"

    def claim(self, claim: Claim) -> str:
        """Liveliness token of a daemon, and queryable: `alive/<starting or serving>/<daemon>/<since_ns>`."""
        return f"{self.root}/alive/{'serving' if claim.serving else 'starting'}/{claim.daemon}/{claim.since_ns}"

    def parse_claim(self, key: str) -> Claim:
        """The inverse of `claim`.

        Raises:
            UsageError: not the token of a daemon of this vehicle.
        """
        form = re.escape(f"{self.root}/alive/") + r"(starting|serving)/([1-9a-f][0-9a-f]{0,31})/([1-9][0-9]{0,18})"
        match = re.fullmatch(form, key)
        if match is None:
            raise UsageError("not the token of a daemon of this vehicle")
        return Claim(match[2], int(match[3]), serving=match[1] == "serving")

    def parse(self, key: str) -> Address:
        """The inverse of the builders above.

        Raises:
            UsageError: not a key of this vehicle.
        """
        head = f"{self.root}/"
        chunks = key.removeprefix(head).split("/")
        if not key.startswith(head) or not all(chunks):
            raise UsageError(f"the key is not below {self.root}")
        match chunks:
            case [("status" | "metrics" | "config" | "rig") as resource]:
                return Address(None, resource)
            case ["last" as resource, pair]:
                return Address(pair, resource)
            case [
                pair,
                ("extrinsic" | "health" | "history" | "windows" | "overlay" | "evidence" | "alive") as resource,
            ]:
                return Address(pair, resource)
            case [pair, ("windows" | "evidence" | "command") as resource, argument]:
                return Address(pair, resource, argument)
            case _:
                raise UsageError(f"no such resource below {self.root}; see `{self.status}` for what is served")


@dataclass(frozen=True, slots=True)
class Selector:
    """Parameters behind the `?` of a query whose resource adds none."""

    format: Format = "msgpack"


@dataclass(frozen=True, slots=True)
class ExtrinsicSelector:
    """A reply, or, if `export` is not None, a file for another program, between the pair's frames or the named ones."""

    format: Format = "msgpack"
    export: str | None = None
    parent: str | None = None
    child: str | None = None


@dataclass(frozen=True, slots=True)
class CommandSelector:
    """How long the sender of a command waits for the acknowledgement, ms, counted from the arrival of the command at
    the service because the two share no clock. A command that cannot start in that time is not carried out.
    `conversation` is the id of the TLS conversation in which the sender proves its name; None: no proof."""

    timeout_ms: int = COMMAND_TIMEOUT_MS
    conversation: str | None = None
    format: Format = "msgpack"


@dataclass(frozen=True, slots=True)
class HistorySelector:
    """`since` and `until` bound `data_stamp_ns` (inclusive); of these, `limit` keeps the newest."""

    since_ns: int = 0
    until_ns: int = 2**63 - 1
    limit: int = 100
    format: Format = "msgpack"


@dataclass(frozen=True, slots=True)
class RangeSelector:
    """A range of bytes of a file."""

    offset: int = 0
    length: int = MAX_LENGTH
    format: Format = "msgpack"


@dataclass(frozen=True, slots=True)
class OverlaySelector:
    """Which window (None: the latest), and at which extrinsic its points are drawn."""

    at: Literal["current", "nominal"] = "current"
    window_id: str | None = None


@dataclass(frozen=True, slots=True)
class EvidenceSelector:
    """A picture of the event, or, with `overlay` None, the event itself."""

    overlay: Literal["before", "after"] | None = None
    format: Format = "msgpack"


def parse_selector(parameters: str) -> Selector:
    """`format=json`.

    Raises:
        UsageError: unknown, doubled or malformed parameter; names it.
    """
    return Selector(format=_format(_split(parameters, ("format",))))


def parse_extrinsic_selector(parameters: str, exports: Collection[str]) -> ExtrinsicSelector:
    """`format=json`, or `format=<one of exports>;parent=<frame>;child=<frame>`, each optional.

    Raises:
        UsageError: unknown, doubled or malformed parameter; names it.
    """
    given = _split(parameters, ("format", "parent", "child"))
    form = given.get("format", "msgpack")
    if form in _FORMATS or form not in exports:
        known = ", ".join((*_FORMATS, *(name for name in exports if name not in _FORMATS)))
        return ExtrinsicSelector(_format(given, known))
    return ExtrinsicSelector(export=form, parent=given.get("parent"), child=given.get("child"))


def parse_command_selector(parameters: str) -> CommandSelector:
    """`timeout_ms=<ms>;tls=<32 hexadecimal digits>;format=json`, each optional.

    Raises:
        UsageError: unknown, doubled, malformed or out-of-range parameter; names it.
    """
    given = _split(parameters, ("timeout_ms", "tls", "format"))
    timeout_ms = _integer(given, "timeout_ms", COMMAND_TIMEOUT_MS, 1, MAX_COMMAND_TIMEOUT_MS)
    conversation = given.get("tls")
    if conversation is not None and not re.fullmatch("[0-9a-f]{32}", conversation):
        raise UsageError("parameter `tls` must be 32 hexadecimal digits, random for each command")
    return CommandSelector(timeout_ms, conversation, _format(given))


def parse_history_selector(parameters: str) -> HistorySelector:
    """`since=<ns>;until=<ns>;limit=<count>;format=json`, each optional.

    Raises:
        UsageError: unknown, doubled, malformed or out-of-range parameter; names it.
    """
    given = _split(parameters, ("since", "until", "limit", "format"))
    default = HistorySelector()
    since_ns = _integer(given, "since", default.since_ns, 0, 2**63 - 1)
    until_ns = _integer(given, "until", default.until_ns, 0, 2**63 - 1)
    if until_ns < since_ns:
        raise UsageError("parameter `until` lies before `since`")
    return HistorySelector(since_ns, until_ns, _integer(given, "limit", default.limit, 1, MAX_LIMIT), _format(given))


def parse_range_selector(parameters: str) -> RangeSelector:
    """`offset=<bytes>;length=<bytes>;format=...`, each optional.

    Raises:
        UsageError: unknown, doubled, malformed or out-of-range parameter; names it.
    """
    given = _split(parameters, ("offset", "length", "format"))
    return RangeSelector(
        _integer(given, "offset", 0, 0, 2**63 - 1),
        _integer(given, "length", MAX_LENGTH, 1, MAX_LENGTH),
        _format(given),
    )


def parse_overlay_selector(parameters: str) -> OverlaySelector:
    """`at=nominal;window=<id>`, each optional.

    Raises:
        UsageError: unknown, doubled or malformed parameter; names it.
    """
    given = _split(parameters, ("at", "window", "format"))
    match given.get("at", "current"):
        case ("current" | "nominal") as at:
            return OverlaySelector(at, given.get("window"))
        case _:
            raise UsageError("parameter `at` must be current or nominal")


def parse_evidence_selector(parameters: str) -> EvidenceSelector:
    """`overlay=before` or `overlay=after`, `format=json`, each optional.

    Raises:
        UsageError: unknown, doubled or malformed parameter; names it.
    """
    given = _split(parameters, ("overlay", "format"))
    match given.get("overlay"):
        case (None | "before" | "after") as overlay:
            return EvidenceSelector(overlay, _format(given))
        case _:
            raise UsageError("parameter `overlay` must be before or after")


def _split(parameters: str, allowed: tuple[str, ...]) -> dict[str, str]:
    if len(parameters) > 1024:
        raise UsageError("the parameters are longer than 1024 characters")
    given: dict[str, str] = {}
    for item in filter(None, parameters.split(";")):
        name, _, value = item.partition("=")
        if name.startswith("_"):  # reserved by Zenoh for itself (`_time`, `_anyke`)
            continue
        if name not in allowed:
            raise UsageError(f"unknown parameter {name[:32]!a}; known here: {', '.join(allowed)}")
        if name in given:
            raise UsageError(f"parameter `{name}` is given twice")
        given[name] = value
    return given


def _integer(given: dict[str, str], name: str, default: int, low: int, high: int) -> int:
    text = given.get(name)
    if text is None:
        return default
    # Plain digits only: str.isdigit also accepts digits of other scripts, and int() signs, spaces and underscores.
    if not (text.isascii() and text.isdigit() and len(text) <= 19 and low <= int(text) <= high):
        raise UsageError(f"parameter `{name}` must be a whole number from {low} to {high}")
    return int(text)


def _format(given: dict[str, str], known: str = ", ".join(_FORMATS)) -> Format:
    text = given.get("format", "msgpack")
    if text not in _FORMATS:
        raise UsageError(f"parameter `format` must be one of {known}")
    return _FORMATS[text]


NODE: Final = "coec"

DIAGNOSTICS: Final = "/diagnostics"
TF_STATIC: Final = "/tf_static"


def ros_name(name: str) -> str:
    """A vehicle or a pair as one token of a ROS name: letters, digits and underscores, and no digit first
    (rmw/validate_full_topic_name.h)."""
    token = re.sub(r"[^A-Za-z0-9_]+", "_", name)
    return f"_{token}" if token[:1].isdecimal() else token


def camera_info_topic(pair: str) -> str:
    """Topic of the intrinsics of a pair's camera, as the service knows them. No images are published beside it."""
    return f"/coec/{ros_name(pair)}/camera/camera_info"


def overlay_topic(pair: str) -> str:
    """Topic of the picture of points on an image. It has no `camera_info`, as the picture has a title and a scale."""
    return f"/coec/{ros_name(pair)}/overlay/compressed"


def sensor_status_name(sensor: str) -> str:
    """Name of a sensor's status among the diagnostics."""
    return f"{NODE}: {sensor}_mount"


def status_name(pair: str) -> str:
    """Name of a pair's status among the diagnostics: `node: name`, as aggregators and Autoware's graph parse it."""
    return f"{NODE}: {pair}_calibration"
