"""`coec router`: runs the Zenoh router of a vehicle, in the version that the service uses."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import success_on_sigterm, until_signal

_log = logging.getLogger(__name__)


def router(
    config: Annotated[
        Path,
        typer.Option(
            help="Zenoh configuration of a router (JSON5).", metavar="FILE", show_default=False, readable=False
        ),
    ],
) -> int:
    """Run a Zenoh router for the vehicle, with the access control of its configuration (deploy/router.json5)."""
    with success_on_sigterm():
        from coec.io import logs
        from coec.io.system import ServiceManagerNotifier
        from coec.io.zenoh.session import open_router

        logs.configure("info", "auto")
        notifier = ServiceManagerNotifier.from_environment()
        with until_signal() as stop, open_router(config) as session:
            _log.info("routing", extra={"fields": {"router": str(session.info.zid()), "configuration": str(config)}})
            notifier.ready()
            stop.wait()
            notifier.stopping()
            _log.info("stopping")
    return 0
