"""`coec query command/...` with a certificate: denied reads as denied, and says what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli.conftest import Coec
from coec.config import SenderConfig, ZenohConfig
from coec.io.zenoh.bus import open_session
from support.fake_worker import wait_until
from support.router import TestAuthority, free_port, shipped_router
from support.vehicles import KEYS, VEHICLE_LIMITS, serving


@pytest.mark.fault("`coec query command/...` by somebody without permission", "it says `not_allowed`, and exits with 1")
def test_the_command_line_proves_who_it_is(authority: TestAuthority, coec: Coec, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = ZenohConfig(embedded_router=True, listen=(endpoint,))
    operator = ("--zenoh", authority.session("operator", endpoint))
    may = authority.of_service(SenderConfig(name="operator", commands=("hold",)))
    with (
        serving(tmp_path / "state", config, may) as there,
        open_session(ZenohConfig(connect=(endpoint,)), VEHICLE_LIMITS) as client,
    ):
        wait_until(lambda: bool(list(client.get(KEYS.status, timeout=20.0))), "the vehicle answers")
        reported = coec("query", "command/hold", *operator, "--json")
        assert (reported.status, reported.document["code"]) == (0, "held")
        assert there.is_held
        for arguments in (
            ("command/reset", *operator),
            ("command/hold", "--zenoh", authority.session("viewer", endpoint)),
            ("command/hold", *operator, "--anonymous"),
            ("command/hold", "--connect", endpoint),
        ):
            denied = coec("query", *arguments, "--json")
            assert (denied.status, denied.document["error"]["code"]) == (1, "not_allowed"), arguments
        late = authority.session(authority.sign("operator", "late", days=-1), endpoint)
        expired = coec("query", "command/hold", "--zenoh", late)
        assert (expired.status, "certificate has expired" in expired.err) == (1, True)
        assert there.commands == {"hold_accepted": 1, "reset_not_allowed": 1, "hold_not_allowed": 4}


def test_a_file_that_is_none_is_named(coec: Coec, tmp_path: Path) -> None:
    file = tmp_path / "operator.json5"
    file.write_text("{ connect: ")
    outcome = coec("query", "health", "--zenoh", file)
    assert outcome.status == 78
    assert f"{file} is no configuration of Zenoh (JSON5): line 1" in outcome.err


@pytest.mark.fault("`coec query` for what the router's rules keep back", "it says that this may be why")
def test_what_the_router_keeps_back_reads_as_denied(authority: TestAuthority, coec: Coec, tmp_path: Path) -> None:
    may = authority.of_service(SenderConfig(name="operator"))
    with (
        shipped_router(authority, tmp_path) as door,
        serving(tmp_path / "state", ZenohConfig(connect=(door.loopback,)), may) as there,
    ):
        viewer, operator = ("--zenoh", door.file("viewer")), ("--zenoh", door.file("operator"))
        wait_until(lambda: coec("query", "status", *viewer).status == 0, "the viewer reads")
        assert coec("query", "evidence", *operator).status == 0
        for arguments in (("command/hold", *viewer), ("coec/@v1/vehicle/**", *viewer)):
            denied = coec("query", *arguments, "--json")
            assert (denied.status, denied.document["error"]["code"]) == (1, "not_found")
            assert "though the service is there (its liveliness token is seen)" in denied.err
            assert "the router's rules may not allow it to you" in denied.err
        assert coec("query", "command/hold", *operator).status == 0
        assert there.commands == {"hold_accepted": 1}
    gone = coec("query", "status", *viewer, "--timeout", "0.5")
    assert (gone.status, "or it refuses the certificate" in gone.err) == (1, True)
