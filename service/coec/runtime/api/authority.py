"""Who may give which command. This is checked for each command, whatever the router let through
(`config.AuthorityConfig`)."""

from __future__ import annotations

from collections.abc import Callable

from coec.config import AuthorityConfig
from coec.errors import CoecError


class NotAllowedError(CoecError):
    """The sender may not give this command."""

    reply_code = "not_allowed"


class Authority:
    """Decides who may command a vehicle."""

    def __init__(self, config: AuthorityConfig, external_access: Callable[[], str | None]) -> None:
        """`reached_from_outside()` says in a clause why programs on other computers can reach the service; None: they
        cannot."""
        self._config = config
        self._allowed = {sender.name: frozenset(sender.commands) for sender in config.senders}
        self._external_access = external_access

    @property
    def senders(self) -> tuple[str, ...]:
        """The names whose owners may give commands once they have proven them."""
        return tuple(self._allowed)

    def require(self, name: str | None, command: str) -> None:
        """Returns if the sender may give the command. `name` is the name that he has proven; None: he has proven none.

        Raises:
            NotAllowedError: he may not give it.
        """
        if name is None:
            self._require_anonymous(command)
        elif name not in self._allowed:
            raise NotAllowedError(f"{name!a} may give no commands: `authority.senders` does not name this certificate")
        elif command not in self._allowed[name]:
            may = ", ".join(sorted(self._allowed[name]))
            raise NotAllowedError(f"{name!a} may not `{command}`, only {may} (`authority.senders`)")

    def _require_anonymous(self, command: str) -> None:
        if self._config.anonymous == "always":
            return
        why = "`authority.anonymous` is `never`"
        if self._config.anonymous == "loopback":
            external_access = self._external_access()
            if external_access is None:
                return
            why = f"other computers may reach the service: {external_access}"
        raise NotAllowedError(
            f"`{command}` needs a sender who proves his name: {why}. Give it with a certificate that "
            "`authority.senders` names (`coec query --zenoh FILE`)"
        )
