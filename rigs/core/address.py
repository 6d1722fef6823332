"""Addresses of devices as rig files give them: whole IPv4 addresses, or names of computers."""

from __future__ import annotations

import re
from ipaddress import AddressValueError, IPv4Address
from typing import Annotated

from pydantic import BeforeValidator, Field

_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?", re.ASCII)


def _bind(raw: object) -> object:
    """Resolvers take ``192.168.1`` for 192.168.0.1; here it is an incomplete address."""
    if not isinstance(raw, str):
        return raw
    labels = raw.split(".")
    if all(label == "" or label.isdigit() for label in labels[:2]):
        try:
            IPv4Address(raw)
        except AddressValueError:
            raise ValueError(
                "is no whole address; write four numbers from 0 to 255, such as 192.168.1.10"
            ) from None
    elif len(raw) > 253 or not all(map(_LABEL.fullmatch, labels)):
        raise ValueError("must be an address such as 192.168.1.10, or the name of a computer")
    return raw


def _host(raw: object) -> object:
    bound = _bind(raw)
    if isinstance(raw, str) and raw.replace(".", "").isdigit():
        address = IPv4Address(raw)
        if address.is_unspecified or address.is_multicast or raw == "255.255.255.255":
            raise ValueError("is the address of no device; write one such as 192.168.1.10")
    return bound


_Text = Field(min_length=1, max_length=253, pattern=r"^[A-Za-z0-9.\-]+$")
Host = Annotated[str, BeforeValidator(_host), _Text]
"""Of a device."""
BindAddress = Annotated[str, BeforeValidator(_bind), _Text]
"""Of this computer; 0.0.0.0 is all of its networks."""
