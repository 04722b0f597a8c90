"""No door is open to everybody unless the configuration says so in so many words, whichever file it is in."""

from __future__ import annotations

from pathlib import Path

import pytest

from coec.config import LimitsConfig, ZenohConfig
from coec.errors import ConfigError
from coec.io.zenoh.session import settings_of, unguarded

LIMITS = LimitsConfig()
EVERYBODY = "tcp/[::]:7447"
SECRET = "c2VjcmV0"


def of_file(folder: Path, text: str, *, insecure: bool = False) -> ZenohConfig:
    path = folder / "zenoh.json5"
    path.write_text(text)
    return ZenohConfig(file=path, insecure=insecure)


DOORS = (
    f'mode: "peer", listen: {{ endpoints: ["{EVERYBODY}"] }}',
    f'listen: {{ endpoints: {{ peer: ["tcp/127.0.0.1:0", "{EVERYBODY}"] }} }}',
    f'mode: "router", listen: {{ endpoints: {{ peer: [], router: ["{EVERYBODY}"] }} }}',
    'mode: "peer", listen: { endpoints: ["tls/[::]:7448"] }',
    'mode: "peer", listen: { endpoints: ["tls/[::]:7448"] }, transport: { link: { tls: { enable_mtls: false } } }',
)


@pytest.mark.fault(
    "a listener that lets in anybody, in the configuration or a Zenoh file",
    "it is refused unless it is explicitly allowed",
)
@pytest.mark.parametrize("reported", DOORS)
def test_a_door_for_everybody_in_a_file_is_refused_unless_spelled_out(tmp_path: Path, reported: str) -> None:
    with pytest.raises(ConfigError, match=r"whoever reaches t.*zenoh.insecure"):
        settings_of(of_file(tmp_path, f"{{ {reported} }}"), LIMITS)
    (door,) = unguarded(settings_of(of_file(tmp_path, f"{{ {reported} }}", insecure=True), LIMITS))
    assert door in reported


@pytest.mark.parametrize(
    "reported",
    [
        "",
        'mode: "peer"',
        'mode: "router"',
        'mode: "router", listen: { endpoints: ["tcp/127.0.0.1:7447"] }',
        f'mode: "peer", listen: {{ endpoints: {{ peer: [], router: ["{EVERYBODY}"] }} }}',
        'listen: { endpoints: ["tls/[::]:7448"] }, transport: { link: { tls: { enable_mtls: true } } }',
    ],
)
def test_what_lets_nobody_in_unknown_is_allowed(tmp_path: Path, reported: str) -> None:
    assert unguarded(settings_of(of_file(tmp_path, f"{{ {reported} }}"), LIMITS)) == ()


def test_the_router_that_is_the_service_is_held_to_the_same() -> None:
    router = ZenohConfig(embedded_router=True, listen=(EVERYBODY,))
    with pytest.raises(ConfigError, match="whoever reaches tcp"):
        settings_of(router, LIMITS)
    spelled_out = router.model_copy(update={"insecure": True})
    assert unguarded(settings_of(spelled_out, LIMITS)) == (EVERYBODY,)
    assert unguarded(settings_of(ZenohConfig(listen=(EVERYBODY,)), LIMITS)) == (), "nobody listens there"


@pytest.mark.fault("a key in an endpoint that is refused", "the message does not show the key")
@pytest.mark.parametrize("endpoint", [f"tls/[::]:1#listen_private_key_base64={SECRET}", f"tls/h#password={SECRET}"])
def test_a_refusal_does_not_report_a_secret(endpoint: str) -> None:
    with pytest.raises(ConfigError) as refused:
        settings_of(ZenohConfig(embedded_router=True, listen=(endpoint,)), LIMITS)
    assert SECRET not in str(refused.value)


def test_a_damaged_file_does_not_report_what_is_in_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        settings_of(of_file(tmp_path, f"{{ transport: {{ auth: {{ usrpwd: {{ password: {SECRET} }} }} }} }}"), LIMITS)
    assert SECRET not in str(refused.value)
    assert "zenoh.json5" in str(refused.value)


HOSTILE = {
    "deep": "{x:" + "[" * 100_000 + "]" * 100_000 + "}",
    "deep in strings": "{x:" + "['[" * 100_000,
    "long": " " * 2**21,
    "not text": "\udcff",
}


@pytest.mark.fault("a Zenoh file nested 100,000 deep, two megabytes long, or no text", "refused before it is parsed")
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_file_is_refused_before_it_is_parsed(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_bytes(HOSTILE[kind].encode(errors="surrogateescape"))
    with pytest.raises(ConfigError, match=r"zenoh.json5 is (no configuration of Zenoh: it has more|not UTF-8 text)"):
        settings_of(ZenohConfig(file=path), LIMITS)


@pytest.mark.parametrize(
    "text",
    [
        f"{{ transport: {{ auth: {{ usrpwd: {{ password:\n\"{SECRET}' }} }} }} }}",
        f'{{ transport: {{ link: {{ tls: {{ enable_mtls: "{SECRET}" }} }} }} }}',
        f"{{ mode: '{SECRET}' }}",
    ],
)
def test_what_is_wrong_in_a_file_is_reported_without_what_stands_there(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        settings_of(of_file(tmp_path, text), LIMITS)
    assert SECRET not in str(refused.value)
    assert "zenoh.json5 is no configuration of Zenoh" in str(refused.value)


@pytest.mark.fault("a Zenoh file nested 100,000 deep", "an error of ours; Zenoh's reader does not end the process")
@pytest.mark.parametrize(
    "text", ["[" * 100_000, "{mode: [" + "[[//]\r" * 100_000, "{a: '" + "[" * 2**20, "\x00", '{a: "[\\', "// [" * 9, ""]
)
def test_a_file_that_is_no_configuration_ends_in_an_error_and_not_the_process(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"zenoh\.json5"):
        settings_of(of_file(tmp_path, text), LIMITS)


def test_brackets_that_mean_nothing_do_not_count(tmp_path: Path) -> None:
    many = "[{" * 100
    text = f'{{ // {many}\n/* {many} */ mode: "peer", metadata: {{ a: "{many}", b: \'{many}\' }} }}'
    assert unguarded(settings_of(of_file(tmp_path, text), LIMITS)) == ()


@pytest.mark.parametrize("content", [b"\xff\xfe", None, ""], ids=["no text", "absent", "a folder"])
def test_a_file_that_is_not_text_or_not_there_is_refused(tmp_path: Path, content: bytes | str | None) -> None:
    path = tmp_path / "zenoh.json5"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        path.mkdir()
    with pytest.raises(ConfigError, match=r"zenoh\.json5"):
        settings_of(ZenohConfig(file=path), LIMITS)
