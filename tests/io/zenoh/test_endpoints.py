"""Whom an endpoint lets in, and what of it may be shown."""

from __future__ import annotations

import pytest

from coec.errors import ConfigError
from coec.io.zenoh.session import Endpoint, redacted, without_secrets

KEY = "tls/vehicle:7448#connect_private_key_base64=c2VjcmV0;enable_mtls=true"


@pytest.mark.parametrize(
    ("text", "certificates_requested", "open_to_all"),
    [
        ("tcp/127.0.0.1:7447", False, False),
        ("tcp/127.9.9.9:7447", False, False),
        ("tcp/[::1]:7447", False, False),
        ("udp/localhost:7447", False, False),
        ("unixsock-stream//run/zenoh.sock", False, False),
        ("tcp/[::]:7447", True, True),
        ("tcp/0.0.0.0:0", False, True),
        ("tcp/192.168.0.4:7447", True, True),
        ("tcp/127.0.0.1.evil.example:7447", False, True),
        ("tcp/[::ffff:10.0.0.1]:7447", False, True),
        ("ws/[::]:7447", True, True),
        ("vsock/-1:1234", True, True),
        ("tls/[::]:7448", False, True),
        ("tls/[::]:7448", True, False),
        ("quic/[::]:7448", True, False),
        ("tls/[::]:7448#enable_mtls=true", False, False),
        ("tls/[::]:7448#enable_mtls=false", True, True),
        ("tls/[::]:7448?enable_mtls=true", False, True),
    ],
)
def test_whom_it_lets_in(text: str, certificates_requested: bool, open_to_all: bool) -> None:
    endpoint = Endpoint.parse(text)
    assert endpoint.admits_anyone(certificates_required=certificates_requested) is open_to_all


@pytest.mark.parametrize("text", ["", "localhost", "tcp/127.0.0.1", "tcp/127.0.0.1:abc", "tcp/h:65536", "foo/h:1"])
def test_what_is_no_endpoint_on_any_network_is_a_mistake_in_the_configuration(text: str) -> None:
    with pytest.raises(ConfigError, match=r"is not an endpoint|names no host|unknown to Zenoh"):
        Endpoint.parse(text)


@pytest.mark.fault("a key or password in an endpoint", "`config`, logs and errors show `***`")
@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447"),
        (KEY, "tls/vehicle:7448#connect_private_key_base64=***;enable_mtls=true"),
        ("tcp/h:1?token=abc#iface=eth0", "tcp/h:1?token=***#iface=eth0"),
        ("tls/h:1#connect_private_key_file=/etc/k.pem", "tls/h:1#connect_private_key_file=/etc/k.pem"),
        ("ws/me:secret@h:1", "ws/***@h:1"),
        ("nonsense?password=abc", "nonsense***"),
    ],
)
def test_what_may_be_shown(text: str, shown: str) -> None:
    assert redacted(text) == shown
    assert redacted(shown) == shown


def test_what_zenoh_says_of_an_endpoint_is_shown_without_its_secret() -> None:
    reported = without_secrets(f"cannot connect to {KEY}: root_ca_certificate_base64=bm9uZQ== at x.rs:1", (KEY,))
    assert "c2VjcmV0" not in reported
    assert "bm9uZQ" not in reported
    assert "x.rs:1" in reported
    with pytest.raises(ConfigError) as refused:
        Endpoint.parse("tls/h#connect_private_key_base64=c2VjcmV0")
    assert "c2VjcmV0" not in str(refused.value)
