"""ABB Robot Web Services with a bound on every wait, for motion programs on an IRC5 controller.

abb-robot-client 0.4.0 asks without a time-out, so its session gets one here. A request is bounded
from its last byte to the next one of the answer; answers are a few hundred bytes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import requests
from abb_motion_program_exec.abb_motion_program_exec_client import (
    MotionProgram,
    MotionProgramExecClient,
)
from abb_robot_client.rws import RWS, ABBException
from requests.adapters import HTTPAdapter

from sliplab.rigs.core.capabilities import UNKNOWN, ArmState, DeviceHealth, Pose
from sliplab.rigs.core.pose import from_quaternion
from sliplab.rigs.devices.abb.settings import AbbSettings

REQUEST_S = 1.0
"""Connecting, and each wait for bytes of an answer, s."""
STATUS_REQUESTS = 4
"""Requests of one look at the state."""
FULL_SPEED_PERCENT = 100.0
"""The speed ratio at which a segment has the speed that was asked for."""
START_REQUESTS = 12
"""Requests that starting a motion program takes at most, with those of logging in."""
T = TypeVar("T")


class WebError(RuntimeError):
    """The web services did not answer in time, or refused; the text says which."""


class WebRefused(WebError):
    """The web services answered, and not with what was asked for."""


class _Bounded(HTTPAdapter):  # type: ignore[misc, unused-ignore]
    """An HTTP adapter that never waits without a bound."""

    def send(self, request: Any, **how: Any) -> Any:
        """The answer to a request. Raises requests.RequestException after `REQUEST_S`."""
        how["timeout"] = REQUEST_S
        return super().send(request, **how)


@dataclass(frozen=True)
class WebStatus:
    """The controller's status by its web services."""

    controller: str
    """motoron, motoroff, guardstop, emergencystop, ..."""
    mode: str
    """AUTO, MANR, ..."""
    execution: str
    """running or stopped."""
    speed_percent: float
    """The speed ratio of the pendant: every move is slower by it."""

    @property
    def state(self) -> ArmState:
        """The arm's state as far as it is known without a path."""
        if self.controller.startswith("emergencystop"):
            return ArmState.EMERGENCY_STOP
        if self.controller == "guardstop":
            return ArmState.PROTECTIVE_STOP
        if self.mode != "AUTO":
            return ArmState.REMOTE_CONTROL_OFF
        return ArmState.READY if self.controller == "motoron" else ArmState.NOT_RUNNING


class WebServices:
    """One session of one thread at a time; others wait for it."""

    def __init__(self, settings: AbbSettings) -> None:
        url = f"http://{settings.host}:{settings.rws_port}"
        self._rws = RWS(url, settings.username, settings.password)
        self._rws._session.mount("http://", _Bounded())
        self._client = MotionProgramExecClient(abb_client=self._rws)
        self._task = settings.task
        self._lock = threading.Lock()
        self._answers = False

    def status(self) -> WebStatus:
        """State of controller, mode, execution and speed ratio. Raises WebError."""
        return self._ask(
            lambda: WebStatus(
                self._rws.get_controller_state(),
                self._rws.get_operation_mode(),
                self._rws.get_execution_state().ctrlexecstate,
                self._rws.get_speedratio(),
            )
        )

    def is_running(self) -> bool:
        """Return whether a program runs, in one request. Raises WebError."""
        return self._ask(lambda: self._rws.get_execution_state().ctrlexecstate != "stopped")

    def flange(self) -> tuple[Pose, tuple[float, ...]]:
        """The flange's pose in the base frame and the arm's configuration. Raises WebError."""
        target = self._ask(self._rws.get_robtarget)
        return from_quaternion(target.trans, target.rot), tuple(target.robconf.tolist())

    def joints_deg(self) -> list[float]:
        """The six joints, degrees. Raises WebError."""
        joints: list[float] = self._ask(self._rws.get_jointtarget).robax.tolist()
        return joints

    def about(self, resource: str) -> dict[str, str]:
        """Return the fields of a resource such as ``rw/system``; empty where it is not there.

        Raises:
            WebError: no answer.
        """
        try:
            answer = self._ask(lambda: self._rws._do_get(resource))
            return {key: str(value) for key, value in answer["_embedded"]["_state"][0].items()}
        except (WebRefused, KeyError, IndexError, TypeError):
            return {}

    def start(self, program: MotionProgram) -> None:
        """Upload a motion program and start it. Raises WebError."""
        self._ask(lambda: self._client.execute_motion_program(program, self._task, wait=False))

    def stop(self) -> None:
        """Stop the program that runs, and the arm with it. Raises WebError."""
        self._ask(self._client.stop_motion_program)

    def read_signal(self, name: str) -> float:
        """The value of an analog signal. Raises WebError; WebRefused if there is none."""
        return self._ask(lambda: self._rws.get_analog_io(name))

    def write_signal(self, name: str, value: float) -> None:
        """Set an analog output. Raises WebError; WebRefused if there is none."""
        self._ask(lambda: self._rws.set_analog_io(name, value))

    def close(self) -> None:
        """Log out if it answers, and close the connection; takes at most 2 `REQUEST_S`.

        A controller keeps a session that nobody logs out of for minutes, and has few of them.
        """
        with self._lock:
            if self._answers:
                self._rws.close()
            else:
                self._rws._session.close()

    def _ask(self, request: Callable[[], T]) -> T:
        try:
            with self._lock:
                self._answers = True
                return request()
        except requests.RequestException as error:
            self._answers = False
            raise WebError(f"the controller's web services do not answer: {error}") from None
        except ABBException as error:
            raise WebRefused(f"the controller refused: {error}") from None
        except Exception as error:  # the client raises bare exceptions for what it does not like
            raise WebRefused(str(error)) from None


def abb_health(web: WebServices, notes: tuple[str, ...]) -> DeviceHealth:
    """Return the report of an ABB controller, by its web services (RobotWare 6).

    Args:
        web: a session of them.
        notes: what the driver has to say besides.

    Raises:
        WebError: it does not answer.
    """
    system, identity, status = web.about("rw/system"), web.about("ctrl/identity"), web.status()
    return DeviceHealth(
        device="arm",
        model=identity.get("ctrl-name", UNKNOWN),
        serial=identity.get("ctrl-id", UNKNOWN),
        firmware=f"RobotWare {system.get('rwversion', UNKNOWN)}",
        temperature_c=None,
        clock="the controller's, in every EGM pose",
        notes=(f"mode {status.mode}", f"controller {status.controller}", *notes),
    )
