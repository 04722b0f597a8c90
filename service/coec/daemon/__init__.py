"""The daemon: runs the service in this process until it is asked to stop."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable

from coec.adapters.system import logs
from coec.adapters.system.notify import ServiceManagerNotifier
from coec.config import Config
from coec.daemon.asked import handled_signals
from coec.daemon.service import Daemon, exit_code_of
from coec.daemon.state_folder import locked
from coec.errors import CoecError, UnavailableError
from coec.exit_codes import ExitCode

_log = logging.getLogger(__name__)

SWITCH_INTERVAL_S = 0.0005
"""How long a thread may keep the interpreter while a query waits. Python's default of 5 ms would be half of the time
that a query may take."""


def run(config: Config, reread: Callable[[], Config] | None = None) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit status. `reread` reads the configuration again on SIGHUP."""
    logs.configure(config.log.level, config.log.format)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        with handled_signals() as signals, locked(config.state.directory) as lock:
            return Daemon(config, ServiceManagerNotifier.from_environment(), lock).serve(signals, reread)
    except CoecError as error:
        _log.error(str(error), extra={"fields": {"code": error.reply_code}})
        return exit_code_of(error)
    except OSError as error:
        # Of the disk, as what it says is not foreseen: a full one, a failing one.
        _log.exception(f"the service cannot start: {error}", extra={"fields": {"code": UnavailableError.reply_code}})
        return ExitCode.UNAVAILABLE
