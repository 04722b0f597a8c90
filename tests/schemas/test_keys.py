"""Keys and selectors of CONTRACT."""

import contextlib

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from coec.errors import UsageError
from coec.schemas.keys import (
    COMMAND_TIMEOUT_MS,
    MAX_LENGTH,
    Address,
    Claim,
    CommandSelector,
    ExtrinsicSelector,
    HistorySelector,
    Keys,
    RangeSelector,
    Selector,
    parse_command_selector,
    parse_extrinsic_selector,
    parse_history_selector,
    parse_range_selector,
    parse_selector,
)

KEYS = Keys("fleet/coec", "truck-7")
ROOT = "fleet/coec/@v1/truck-7"


@pytest.mark.parametrize(
    ("key", "text", "address"),
    [
        (KEYS.status, "status", Address(None, "status")),
        (KEYS.metrics, "metrics", Address(None, "metrics")),
        (KEYS.config, "config", Address(None, "config")),
        (KEYS.extrinsic("front"), "front/extrinsic", Address("front", "extrinsic")),
        (KEYS.health("front"), "front/health", Address("front", "health")),
        (KEYS.history("front"), "front/history", Address("front", "history")),
        (KEYS.windows("front"), "front/windows", Address("front", "windows")),
        (KEYS.window("front", "front-12"), "front/windows/front-12", Address("front", "windows", "front-12")),
        (KEYS.overlay("front"), "front/overlay", Address("front", "overlay")),
        (KEYS.command("front", "hold"), "front/command/hold", Address("front", "command", "hold")),
        (KEYS.alive("front"), "front/alive", Address("front", "alive")),
    ],
)
def test_every_key_stands_where_the_contract_says_and_parses_back(key: str, text: str, address: Address) -> None:
    assert key == f"{ROOT}/{text}"
    assert KEYS.parse(key) == address


@pytest.mark.parametrize(
    "key",
    [
        "",
        ROOT,
        f"{ROOT}/",
        f"{ROOT}/front",
        f"{ROOT}/front/",
        f"{ROOT}//extrinsic",
        f"{ROOT}/front/command",
        f"{ROOT}/front/command/",
        f"{ROOT}/front/nothing",
        f"{ROOT}/front/windows/a/b",
        "fleet/coec/@v2/truck-7/status",
        "fleet/coec/@v1/truck-8/status",
        "status",
    ],
)
def test_other_keys_are_refused(key: str) -> None:
    with pytest.raises(UsageError):
        KEYS.parse(key)


def test_no_parameters_are_the_defaults() -> None:
    assert parse_selector("") == Selector(format="msgpack")
    assert parse_history_selector("") == HistorySelector()
    assert parse_range_selector("") == RangeSelector(offset=0, length=MAX_LENGTH, format="msgpack")


def test_parameters_are_read_in_any_order() -> None:
    assert parse_history_selector("limit=3;until=20;since=10;format=json") == HistorySelector(10, 20, 3, "json")
    assert parse_range_selector("length=5;offset=7") == RangeSelector(7, 5, "msgpack")


def test_parameters_of_zenoh_itself_are_not_ours() -> None:
    assert parse_selector("_time=[now(-1h)..];_anyke;format=json") == Selector("json")


@pytest.mark.parametrize("value", ["", "-1", "+1", " 1", "1.0", "0x1", "1_0", "١", "²", "1" * 20, str(2**63)])
@pytest.mark.parametrize("name", ["since", "until", "limit"])
def test_a_number_out_of_bounds_is_refused_by_name(name: str, value: str) -> None:
    with pytest.raises(UsageError, match=f"`{name}`"):
        parse_history_selector(f"{name}={value}")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("limit=0", "limit"),
        ("limit=10001", "limit"),
        ("since=2;until=1", "until"),
        ("format=xml", "format"),
        ("format=", "format"),
        ("limit=1;limit=2", "limit"),
        ("limt=1", "limt"),
        ("limit", "limit"),
    ],
)
def test_a_wrong_parameter_is_refused_by_name(text: str, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        parse_history_selector(text)


def test_a_range_is_bounded() -> None:
    with pytest.raises(UsageError, match="`length`"):
        parse_range_selector(f"length={MAX_LENGTH + 1}")
    with pytest.raises(UsageError, match="`length`"):
        parse_range_selector("length=0")


def test_what_is_echoed_is_short_and_printable() -> None:
    with pytest.raises(UsageError) as refused:
        parse_selector("\x1b[2J" + "x" * 500 + "=1")

    assert len(str(refused.value)) < 200
    assert str(refused.value).isprintable()


@given(st.text(max_size=60))
def test_no_text_raises_anything_else(text: str) -> None:
    for parse in (parse_selector, parse_command_selector, parse_history_selector, parse_range_selector, KEYS.parse):
        with contextlib.suppress(UsageError):
            parse(text)


def test_how_long_the_sender_of_a_command_waits() -> None:
    assert parse_command_selector("") == CommandSelector(COMMAND_TIMEOUT_MS)
    assert parse_command_selector("timeout_ms=1500;format=json") == CommandSelector(1500, None, "json")
    for wrong in ("timeout_ms=0", "timeout_ms=600001", "timeout_ms=-5", "timeout_ms=1e3", "timeout=5"):
        with pytest.raises(UsageError, match="timeout"):
            parse_command_selector(wrong)


def test_the_conversation_of_a_command_is_named_by_32_digits() -> None:
    name = "0123456789abcdef" * 2
    assert parse_command_selector(f"tls={name}") == CommandSelector(COMMAND_TIMEOUT_MS, name)
    for wrong in ("", name[1:], name + "0", name.upper(), name[1:] + "g", name[1:] + "\n"):
        with pytest.raises(UsageError, match="`tls` must be 32 hexadecimal digits"):
            parse_command_selector(f"tls={wrong}")


def test_claims_of_daemons_are_read_back_and_nothing_else_is() -> None:
    for claim in (Claim("1a", 5, serving=True), Claim("f" * 32, 1, serving=False)):
        key = KEYS.claim(claim)
        assert KEYS.parse_claim(key) == claim
        assert zenoh.KeyExpr(KEYS.claims).intersects(zenoh.KeyExpr(key))
        assert not zenoh.KeyExpr(KEYS.alive("*")).intersects(zenoh.KeyExpr(key)), "no pair's"
        with pytest.raises(UsageError):
            Keys("coec", "other").parse_claim(key)


def test_an_extrinsic_is_requested_as_a_reply_or_as_a_file() -> None:
    assert parse_extrinsic_selector("", ("urdf",)) == ExtrinsicSelector()
    assert parse_extrinsic_selector("format=json", ("urdf", "json")) == ExtrinsicSelector("json")
    requested = parse_extrinsic_selector("format=urdf;parent=base_link", ("urdf", "json"))
    assert requested == ExtrinsicSelector(export="urdf", parent="base_link")
    with pytest.raises(UsageError, match="must be one of msgpack, json, urdf"):
        parse_extrinsic_selector("format=cuneiform", ("urdf", "json"))
