"""Where messages go: addresses of Apprise. Another kind of target is another class here."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from apprise import NotifyBase

_NAME = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")


class Target(Protocol):
    """Sends to one address."""

    name: str
    """The address without its secrets."""

    def send(self, title: str, text: str) -> bool:
        """Return whether the message was taken."""


class AppriseTarget:
    """Sends by Apprise."""

    def __init__(self, address: str) -> None:
        self._sender: NotifyBase = make_sender(address)
        # by itself it pauses for 5.5 s; `Outbox` sends one message a look
        self._sender.request_rate_per_sec = 0.0
        self.name = str(self._sender.url(privacy=True)).partition("?")[0]

    def send(self, title: str, text: str) -> bool:
        """Return whether the message was taken; no error of a network or library comes out."""
        from apprise import NotifyFormat
        from apprise.logger import logger

        logger.disabled = True  # its lines quote addresses
        try:
            return bool(self._sender.notify(body=text, title=title, body_format=NotifyFormat.TEXT))
        except Exception:  # another package's code: whatever it raises
            return False


def make_sender(address: str) -> NotifyBase:
    """Return what sends to an address.

    Raises:
        ValueError: it is none of Apprise's.
        ModuleNotFoundError: the extra ``alerts`` is not installed.
    """
    from apprise import Apprise

    found = Apprise.instantiate(expanded(address), suppress_exceptions=True)
    if found is None:
        raise ValueError(
            "is not an address of Apprise; write one like mailto://user:password@example.org "
            "(github.com/caronc/apprise lists all)"
        )
    return found


def expanded(address: str) -> str:
    """Return an address with ``${NAME}`` replaced by variables of the environment.

    Raises:
        ValueError: one is not set.
    """
    missing = [name for name in _NAME.findall(address) if not os.environ.get(name)]
    if missing:
        raise ValueError(f"the environment variable {missing[0]} is not set")
    return _NAME.sub(lambda found: os.environ[found[1]], address)
