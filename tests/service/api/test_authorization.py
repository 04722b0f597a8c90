"""Who may give which command."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from coec.config import AuthorityConfig, SenderConfig
from coec.schemas.commands import COMMAND_NAMES
from coec.service.api.authorization import Authority, NotAllowedError

FILES = {"certificate": "v.pem", "private_key": "v-key.pem", "root_ca": "ca.pem"}
CONTEXT = "it connects to tcp/10.0.0.2:7447"


def config(**fields: object) -> AuthorityConfig:
    return AuthorityConfig.model_validate(FILES | fields)


def may(authority: Authority, name: str | None) -> set[str]:
    allowed: set[str] = set()
    for command in COMMAND_NAMES:
        try:
            authority.require(name, command)
        except NotAllowedError:
            continue
        allowed.add(command)
    return allowed


def test_a_sender_may_give_his_commands_and_no_other() -> None:
    senders = [{"name": "operator", "commands": ["hold", "reset"]}, {"name": "fleet"}]
    authority = Authority(config(senders=senders, anonymous="never"), lambda: None)
    reported = {name: may(authority, name) for name in ("operator", "fleet", "viewer", "Operator", "", None)}
    assert reported == {
        "operator": {"hold", "reset"},
        "fleet": set(COMMAND_NAMES),
        "viewer": set(),
        "Operator": set(),
        "": set(),
        None: set(),
    }


@pytest.mark.parametrize(
    ("anonymous", "context", "allowed"),
    [
        ("never", None, False),
        ("loopback", None, True),
        ("loopback", CONTEXT, False),
        ("always", None, True),
        ("always", CONTEXT, True),
    ],
)
def test_who_proves_no_name_may_give_commands_where_the_configuration_says_so(
    anonymous: str, context: str | None, allowed: bool
) -> None:
    authority = Authority(AuthorityConfig.model_validate({"anonymous": anonymous}), lambda: context)
    assert may(authority, None) == (set(COMMAND_NAMES) if allowed else set())
    assert not may(authority, "operator"), "a name that is not among the senders is worse than none"


def test_a_router_is_checked_for_each_command() -> None:
    message = [None, CONTEXT, None]
    authority = Authority(AuthorityConfig(), lambda: message.pop(0))
    authority.require(None, "hold")
    with pytest.raises(NotAllowedError, match=r"`hold` needs .* tcp/10\.0\.0\.2.*--zenoh FILE"):
        authority.require(None, "hold")
    authority.require(None, "hold")


@pytest.mark.parametrize(
    ("document", "why"),
    [
        ({"senders": [{"name": "operator"}]}, "give certificate, private_key and root_ca"),
        ({"certificate": "v.pem"}, "belong together"),
        (FILES | {"senders": [{"name": "a"}, {"name": "a"}]}, "must be unique"),
        (FILES | {"senders": [{"name": "a", "commands": []}]}, "at least 1"),
        (FILES | {"senders": [{"name": "a", "commands": ["fly"]}]}, "'hold'"),
        (FILES | {"senders": [{"name": "a\nb"}]}, "pattern"),
        ({"anonymous": "loopbak"}, "'never', 'loopback' or 'always'"),
    ],
)
def test_what_grants_nothing_that_is_meant_is_refused(document: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        AuthorityConfig.model_validate(document)


def test_all_commands_are_the_default() -> None:
    assert SenderConfig(name="operator").commands == COMMAND_NAMES
