"""Network addresses in rig files: complete IPv4 addresses, or host names."""

from __future__ import annotations

import re
from ipaddress import AddressValueError, IPv4Address
from typing import Annotated

from pydantic import BeforeValidator, Field

_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?", re.ASCII)


def _bind(raw: object) -> object:
    """Refuse incomplete addresses: resolvers read ``192.168.1`` as 192.168.0.1."""
    if not isinstance(raw, str):
        return raw
    labels = raw.split(".")
    if all(label == "" or label.isdigit() for label in labels[:2]):
        try:
            IPv4Address(raw)
        except AddressValueError:
            raise ValueError(
                "is an incomplete address; write four numbers from 0 to 255, such as 192.168.1.10"
            ) from None
    elif len(raw) > 253 or not all(map(_LABEL.fullmatch, labels)):
        raise ValueError("must be an address such as 192.168.1.10, or a host name")
    return raw


def _host(raw: object) -> object:
    bound = _bind(raw)
    if isinstance(raw, str) and raw.replace(".", "").isdigit():
        address = IPv4Address(raw)
        if address.is_unspecified or address.is_multicast or raw == "255.255.255.255":
            raise ValueError("is not the address of a device; write one such as 192.168.1.10")
    return bound


_Text = Field(min_length=1, max_length=253, pattern=r"^[A-Za-z0-9.\-]+$")
Host = Annotated[str, BeforeValidator(_host), _Text]
"""Address of a device."""
BindAddress = Annotated[str, BeforeValidator(_bind), _Text]
"""Address of this computer; 0.0.0.0 means all its network interfaces."""
