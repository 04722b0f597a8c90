"""`coec router`: runs the Zenoh router of a vehicle, in the version that the service uses."""

from __future__ import annotations

import logging
from pathlib import Path

from coec.adapters.system import logs
from coec.adapters.system.notify import Notifier
from coec.adapters.zenoh.router import open_router
from coec.cli.stopping import until_signal

_log = logging.getLogger(__name__)


def run(file: Path) -> int:
    """Routes until told to stop.

    Raises:
        ConfigError: the configuration, or a certificate that it names, cannot be used.
        UnavailableError: a port is taken.
    """
    logs.configure("info", "auto")
    notifier = Notifier.from_environment()
    with until_signal() as stop, open_router(file) as session:
        _log.info("routing", extra={"fields": {"router": str(session.info.zid()), "configuration": str(file)}})
        notifier.ready()
        stop.wait()
        notifier.stopping()
        _log.info("stopping")
    return 0
