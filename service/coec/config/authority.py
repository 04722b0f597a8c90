"""Who may give commands."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from coec.config.base import FilePath, Stage
from coec.schemas.commands import NAMES, CommandName

CommonName = Annotated[str, Field(pattern=r"^[A-Za-z0-9 ._:/@+=,-]{1,64}$")]
"""Of a certificate; X.509 allows 64 characters."""


class SenderConfig(Stage):
    """Somebody who may give commands, by the common name of his certificate."""

    name: CommonName = Field(description="common name of the certificate")
    commands: tuple[CommandName, ...] = Field(
        default=NAMES, min_length=1, description="that may be given; all, unless they are listed"
    )


class AuthorityConfig(Stage):
    """Who may give commands, whatever the router lets through. A router tells the service nothing of who asks: whoever
    is to be known proves it to the service itself, by a certificate of `root_ca`, in a TLS conversation inside the
    query (`coec query command/...` does). A router in between can only keep such a command back. `anonymous` are all
    others; `loopback` takes theirs while the session listens and connects on loopback only, and its router's port is
    open nowhere else. What other doors that router has the service cannot see: where it has some, they are what its own
    access control lets in, or `never` shuts them."""

    anonymous: Literal["never", "loopback", "always"] = Field(
        default="loopback", description="when commands are taken from whoever proves nothing"
    )
    senders: tuple[SenderConfig, ...] = Field(default=(), max_length=64, description="by `name`, and their `commands`")
    certificate: FilePath | None = Field(
        default=None, description="of the service; its common name is the vehicle's name"
    )
    private_key: FilePath | None = Field(default=None, description="of the certificate")
    root_ca: FilePath | None = Field(default=None, description="the authority that signed the senders' certificates")

    @model_validator(mode="after")
    def _provable(self) -> AuthorityConfig:
        given = [path is not None for path in (self.certificate, self.private_key, self.root_ca)]
        if any(given) != all(given):
            raise ValueError("certificate, private_key and root_ca belong together: give all three or none")
        if self.senders and not all(given):
            raise ValueError("senders prove their names to the service: give certificate, private_key and root_ca, too")
        names = [sender.name for sender in self.senders]
        if len(set(names)) != len(names):
            raise ValueError("names of senders must be unique")
        return self
