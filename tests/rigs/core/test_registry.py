"""Drivers of other packages are found by their metadata, and a broken one spoils no other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import validate
from sliplab.rigs.core import registry
from sliplab.rigs.core.driver import ArmDriver, EventCameraDriver
from sliplab.rigs.core.registry import DriverError, find_driver, listed
from sliplab.rigs.device_section import DeviceSettings
from tests.packages import write_metadata

CAMERA = '''
from typing import Literal
from pydantic import Field
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import EventCameraDriver

class Settings(DriverSettings):
    driver: Literal["{name}"] = "{name}"
    bias_mv: float = Field(default=0.0, ge=-100, le=100)
    """Bias, mV."""

DRIVER = EventCameraDriver(
    name="{name}", title="a lab's camera", settings=Settings, ping=lambda settings: None,
    build=lambda settings: None,
)
'''
LIMITS = {"low_mm": (300, -100, 200), "high_mm": (500, 100, 400)}
ARM = {"driver": "abb_socket", "host": "127.0.0.1", "limits": LIMITS}
Install = Callable[[str, str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Puts a package with one driver where Python finds it: name, code, entry point."""
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)

    def put(module: str, code: str, point: str) -> None:
        (tmp_path / f"{module}.py").write_text(code)
        name, place = point.split(" = ")
        write_metadata(tmp_path, module, {"sliplab.drivers": {name: place}}, "1.2")
        forget()

    forget()
    yield put
    forget()
    for name in set(sys.modules) - before:
        if name.startswith("lab_"):
            del sys.modules[name]


def forget() -> None:
    """Look for packages with drivers again."""
    listed.cache_clear()
    registry.load_driver.cache_clear()


def devices(**camera: Any) -> DeviceSettings:
    data = {"arm": ARM, "frame_camera": {}, "event_camera": camera}
    return validate(DeviceSettings, data, "rig.yaml")


def test_a_driver_of_another_package_is_used_and_imported_only_then(install: Install) -> None:
    install("lab_camera", CAMERA.format(name="lab"), "lab = lab_camera:DRIVER")
    assert listed()["lab"].package == "lab_camera 1.2"
    assert "lab_camera" not in sys.modules
    found = devices(driver="lab", bias_mv=12)
    assert (found.event_camera.driver, found.event_camera.model_dump()["bias_mv"]) == ("lab", 12.0)
    assert found.event_camera_driver.title == "a lab's camera"
    schema = DeviceSettings.model_json_schema()
    camera, _ = schema["properties"]["event_camera"]["anyOf"]  # or null
    choices = camera["discriminator"]["mapping"]
    assert set(choices) == {"dvxplorer", "lab"}


@pytest.mark.parametrize(
    ("camera", "key", "says"),
    [
        ({"driver": "lab", "bias_mv": 500}, "event_camera.bias_mv", "must be less than or equal"),
        ({"driver": "lab", "bias": 5}, "event_camera.bias", "did you mean 'bias_mv'?"),
        ({"driver": "lap"}, "event_camera.driver", "did you mean 'lab'?"),
        (
            {"driver": "prophesee"},
            "event_camera.driver",
            "is a driver of no installed package: install the package that has it",
        ),
        ({"driver": "ur"}, "event_camera.driver", "is the driver of a kind of arm"),
    ],
)
def test_a_message_names_key_value_and_cure(install: Any, camera: Any, key: str, says: str) -> None:
    install("lab_camera", CAMERA.format(name="lab"), "lab = lab_camera:DRIVER")
    with pytest.raises(InputError) as caught:
        devices(**camera)
    assert caught.value.key == key
    assert says in caught.value.expected


IMPORT = "broken of lab_broken 1.2 cannot be imported: "
NO_MODULE = "ModuleNotFoundError: No module named 'no_such_module_of_a_maker'"


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("import no_such_module_of_a_maker", IMPORT + NO_MODULE),
        ("raise RuntimeError('a licence\\nis missing')", f"{IMPORT}RuntimeError: a licence"),
        ("DRIVER = 5", "lab_broken:DRIVER is a int, not a Driver"),
        ("", "has no attribute 'DRIVER'"),
        (CAMERA.format(name="other"), "it calls itself 'other'"),
    ],
)
def test_a_package_that_fails_is_named_in_one_line(install: Any, code: str, says: str) -> None:
    install("lab_broken", code, "broken = lab_broken:DRIVER")
    with pytest.raises(DriverError) as caught:
        find_driver("broken", EventCameraDriver)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    # all others are there, and whoever looks for one that is not hears of it
    assert devices(driver="dvxplorer").event_camera.driver == "dvxplorer"
    with pytest.raises(InputError, match="broken of lab_broken"):
        devices(driver="brocken")


def test_the_name_of_a_driver_that_ships_is_not_taken(install: Install) -> None:
    install("lab_ur", CAMERA.format(name="ur"), "ur = lab_ur:DRIVER")
    assert find_driver("ur", ArmDriver).title == "Universal Robots"
    assert registry.taken() == ["ur of lab_ur 1.2 is not used: sliplab has a driver of that name"]
