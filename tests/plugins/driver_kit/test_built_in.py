"""Every driver that ships keeps the rules of its kind, on its own fake."""

from __future__ import annotations

import socket

import pytest

from sliplab.plugins.abb_socket import device as abb_socket
from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.plugins.ati_net_ft import device as ati_net_ft
from sliplab.plugins.ati_net_ft.settings import AtiNetFtSettings
from sliplab.plugins.devices import abb, basler, dvxplorer, sync_box, ur
from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings
from sliplab.plugins.devices.sync_box.settings import SyncBoxSettings
from sliplab.plugins.devices.ur.settings import UrSettings, UrWrenchSettings
from sliplab.plugins.driver_kit.conformance import Case, cases
from sliplab.plugins.driver_kit.rule import Bounds
from sliplab.plugins.record import columns, lsl
from sliplab.plugins.reflex import robotiq_2f
from sliplab.plugins.reflex.robotiq_2f.settings import Robotiq2fSettings
from sliplab.plugins.uvc import device as uvc
from sliplab.plugins.uvc.settings import UvcSettings
from sliplab.rigs.core.driver import Driver
from sliplab.rigs.core.registry import listed, load_driver
from tests.plugins.devices.arms import LIMITS
from tests.plugins.driver_kit.trying import each_apart, try_all
from tests.rigs.waiting import free_port, own_address

pytestmark = pytest.mark.realtime
NO_CLOCK = "this server reports no time"
UR_BOUNDS = Bounds(connect_s=25.0, call_s=12.0)
"""As its docstrings promise."""


def ur_settings() -> UrSettings:
    return UrSettings(host=own_address(), frequency_hz=125, limits=LIMITS)


def abb_settings() -> AbbSettings:
    return AbbSettings(
        host=own_address(),
        rws_port=8080,
        egm_bind="127.0.0.1",
        egm_port=free_port(socket.SOCK_DGRAM),
        limits=LIMITS,
        tool={"tcp_mm": (0, 0, 120), "mass_kg": 0.4},
    )


def abb_cases() -> list[Case]:
    return cases(abb.DRIVER, abb_settings())


def socket_cases() -> list[Case]:
    settings = AbbSocketSettings(host=own_address(), limits=LIMITS)
    return cases(abb_socket.DRIVER, settings, Bounds(call_s=10.0))


def ur_cases() -> list[Case]:
    return cases(ur.DRIVER, ur_settings(), UR_BOUNDS)


def wrench_cases() -> list[Case]:
    arm = ur.DRIVER, ur_settings()
    return cases(ur.WRENCH_DRIVER, UrWrenchSettings(), UR_BOUNDS, arm=arm)


def ati_cases() -> list[Case]:
    return cases(ati_net_ft.DRIVER, AtiNetFtSettings(host=own_address()))


def dvxplorer_cases() -> list[Case]:
    return cases(dvxplorer.DRIVER, DvxplorerSettings())


def sync_cases() -> list[Case]:
    settings = SyncBoxSettings(port="/dev/null", boot_s=0.5, silence_s=0.3)
    return cases(sync_box.DRIVER, settings)


def basler_cases() -> list[Case]:
    settings = BaslerSettings(trigger="hardware", trigger_line="Line1", sync_line=2, stall_s=0.4)
    return cases(basler.DRIVER, settings)


def uvc_cases() -> list[Case]:
    settings = UvcSettings(device="/dev/null", width_px=128, height_px=96, stall_s=0.4)
    return cases(uvc.DRIVER, settings)


def gripper_cases() -> list[Case]:
    settings = Robotiq2fSettings(host="127.0.0.1", opening_mm=40.0, answer_s=0.5)
    return cases(robotiq_2f.DRIVER, settings)


def columns_cases() -> list[Case]:
    known = {"clock": "us", "-": "", "force": "N", "angle": "deg"}
    settings = columns.ColumnsSettings(
        place="/dev/null", columns=known, time_column="clock", time_unit="us", stall_s=0.4
    )
    return cases(columns.DRIVER, settings)


def lsl_cases() -> list[Case]:
    # the sender's clock is read every two seconds, and on a busy machine later
    bounds = Bounds(call_s=10.0, news_s=10.0)
    return cases(lsl.DRIVER, lsl.LslSettings(name="fake", stall_s=3.0), bounds)


LATE, SYNC, WRAPS = "late answer", "sync input", "counter wraps"
DEVICES = {
    # not simulated: requests of their own connection, registers, and HTTP
    "abb": (abb_cases, {LATE, SYNC}),
    "abb_socket": (socket_cases, {"clock falls back", SYNC}),  # it reports no time
    "ur": (ur_cases, {LATE}),
    "ur_wrench": (wrench_cases, {"overload", WRAPS}),  # the controller's own stop, and its clock
    "ati_net_ft": (ati_cases, set()),
    "robotiq_2f": (gripper_cases, set()),
    "dvxplorer": (dvxplorer_cases, set()),
    "sync_box": (sync_cases, set()),
    "columns": (columns_cases, set()),
    "lsl": (lsl_cases, {"times fall back"}),
    "basler": (basler_cases, set()),
    # it has neither clock nor frame numbers nor a line
    "uvc": (uvc_cases, {"times fall back", WRAPS, "lost frames", "level of the sync line"}),
}
ONE_AT_A_TIME = {"basler"}  # pylon emulates one camera
# one arm, camera and stream are enough for a day; the wrench is on the connection of the arm
FURTHER = ("abb", "abb_socket", "dvxplorer", "lsl", "ur_wrench", "uvc")
MARKS = dict.fromkeys(FURTHER, pytest.mark.long) | {"ur": pytest.mark.xdist_group("scene")}
"""That of the arm computes as much as a scene: not beside one."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(it, marks=MARKS.get(it, ())) for it in DEVICES],
)
def test_a_driver_that_ships_keeps_every_rule(name: str) -> None:
    make, not_simulated = DEVICES[name]
    at_once = {"at_once": 1} if name in ONE_AT_A_TIME else {}
    broken, not_tried = try_all(each_apart(make), **at_once)
    assert not broken, "\n".join(broken.values())
    assert set(not_tried) == not_simulated, not_tried


def test_no_driver_that_ships_is_left_out() -> None:
    shipped = [load_driver(item) for item in listed().values() if item.package == "sliplab"]
    found = {driver.name for driver in shipped if isinstance(driver, Driver)}
    assert set(DEVICES) == found
    assert {make()[0].driver for make, _ in DEVICES.values()} == found
