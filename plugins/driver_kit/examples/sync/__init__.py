"""Example sync box: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from pydantic import Field

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.arm_settings import Port
from sliplab.rigs.core.capabilities import SyncBox
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import FakeBox, OnTrain, SyncBoxDriver
from sliplab.rigs.core.network import answers


class ExampleSyncSettings(DriverSettings):
    """A sync box that speaks lines of text over TCP."""

    driver: Literal["example_sync"] = "example_sync"
    host: Host = "127.0.0.1"
    """Address of the box."""
    port: Port = 7700
    """TCP port of the box."""
    stall_s: float = Field(default=2.0, ge=0.1, le=60)
    """Silence of a running box that is a fault, seconds; longer than its code's longest gap."""


def build(settings: ExampleSyncSettings) -> SyncBox:
    """Make the driver, not connected yet."""
    from sliplab.plugins.driver_kit.examples.sync.driver import ExampleSync

    return ExampleSync(settings)


def fake(now_ns: Callable[[], int], on_train: OnTrain) -> FakeBox:
    """Serve a fake on a free port."""
    from sliplab.plugins.driver_kit.examples.sync.fake import FakeExampleSync

    return FakeExampleSync(now_ns, on_train)


def reach(settings: ExampleSyncSettings | None, address: Any) -> ExampleSyncSettings:
    """Return settings that reach a fake."""
    known = settings or ExampleSyncSettings()
    return known.model_copy(update={"host": address[0], "port": address[1]})


DRIVER = SyncBoxDriver(
    name="example_sync",
    title="Example sync box",
    settings=ExampleSyncSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=lambda settings: {f"sync-{settings.host}-{settings.port}": "the sync box"},
    build=build,
    fake=fake,
    reach=reach,
)
