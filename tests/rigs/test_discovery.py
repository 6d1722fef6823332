"""Devices that cannot be reached are reported by name, with what to check."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from sliplab.plugins.devices.dvxplorer.fake_stream import LiveDvxplorer
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.discovery import ping_devices
from tests.plugins.devices.arms import LIMITS
from tests.rigs.waiting import own_address


@pytest.fixture
def listening() -> Iterator[tuple[str, int]]:
    """An address where somebody takes connections."""
    host = own_address()
    with socket.create_server((host, 0)) as server:
        yield host, server.getsockname()[1]


def devices(**more: Any) -> DeviceSettings:
    plain = {
        "arm": {"driver": "abb_socket", "host": own_address(), "limits": LIMITS},
        "frame_camera": {},
        "sync_box": {"port": "/dev/nothing"},
    }
    return DeviceSettings.model_validate({**plain, **more})


def test_what_is_not_there_is_named_with_what_to_look_at() -> None:
    found = ping_devices(devices())
    assert set(found) == {"arm", "event camera", "frame camera", "sync box"}
    assert "check its power, its cable and the address" in (found["arm"] or "")
    assert found["sync box"] == "there is no /dev/nothing; check its cable and /dev/serial/by-id"
    assert "was not found" in (found["event camera"] or "")


def stream(events_port: int, triggers_port: int) -> dict[str, Any]:
    """An event camera on the network."""
    ports = {"events_port": events_port, "triggers_port": triggers_port}
    return {"source": {"kind": "network", "host": "127.0.0.1", **ports}}


def test_an_arm_and_streams_that_answer_are_reached(listening: tuple[str, int]) -> None:
    host, port = listening
    camera = LiveDvxplorer((640, 480))
    try:
        found = ping_devices(
            devices(
                arm={"driver": "abb_socket", "host": host, "port": port, "limits": LIMITS},
                event_camera=stream(*camera.ports),
            )
        )
    finally:
        camera.close()
    assert found["arm"] is None
    assert found["event camera"] is None


def test_a_stream_without_its_other_or_a_silent_port_is_not_reached() -> None:
    camera = LiveDvxplorer((640, 480))
    with socket.create_server(("127.0.0.1", 0)) as silent:
        number = silent.getsockname()[1]
        try:
            half = ping_devices(devices(event_camera=stream(camera.ports[0], 1)))["event camera"]
            mute = ping_devices(devices(event_camera=stream(camera.ports[0], number)))[
                "event camera"
            ]
        finally:
            camera.close()
    assert half.startswith("127.0.0.1:1: ")
    assert mute.startswith(f"127.0.0.1:{number}: no answer within 2 s")


def test_a_port_is_reached_and_a_rig_without_one_is_told() -> None:
    master, slave = os.openpty()
    try:
        assert ping_devices(devices(sync_box={"port": os.ttyname(slave)}))["sync box"] is None
        assert ping_devices(devices(sync_box=None))["sync box"] == "the rig file names no port"
    finally:
        os.close(master)
        os.close(slave)
