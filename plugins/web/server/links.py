"""The two links of the web application, in files that only this user can read."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sliplab.flows.running.private_file import stored_secret, write_private

Role = Literal["operator", "reader"]
ROLES: tuple[Role, ...] = ("operator", "reader")
_TOKEN = r"[\w-]{40,80}"


@dataclass(frozen=True)
class Links:
    """Tokens and links of one store, in Prefect's home.

    ROLE-token has the token, stored from one start to the next: deleting it ends the access of all
    who have used the link. ROLE-link has the link.
    """

    home: Path

    def tokens(self) -> dict[Role, str]:
        """Return the tokens; they are made if missing.

        Raises:
            InputError: they cannot be stored where only this user can read them.
        """
        return {role: self._token(role) for role in ROLES}

    def write(self, address: str) -> dict[Role, str]:
        """Write the links of a page at an address, and return them.

        Raises:
            InputError: they cannot be stored where only this user can read them.
        """
        links = {role: f"{address}/enter?token={token}" for role, token in self.tokens().items()}
        for role, link in links.items():
            write_private(self.file(role), link)
        return links

    def file(self, role: Role) -> Path:
        """Return the file of a link."""
        return self.home / f"{role}-link"

    def _token(self, role: Role) -> str:
        make = lambda: secrets.token_urlsafe(32)  # noqa: E731
        return stored_secret(self.home / f"{role}-token", _TOKEN, make)
