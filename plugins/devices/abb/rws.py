"""ABB Robot Web Services with a timeout on every request, for motion programs on an IRC5.

abb-robot-client 0.4.0 sets no timeout, so its session gets one here: to connect, and from a request
to the end of its answer, in however many pieces that comes.
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
from urllib3 import HTTPConnectionPool
from urllib3.connection import HTTPConnection

from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.rigs.core.capabilities import UNKNOWN, ArmState, DeviceHealth, Pose
from sliplab.rigs.core.network import BoundedSocket
from sliplab.rigs.core.pose import from_quaternion

REQUEST_S = 1.0
"""Timeout to connect, and of an answer, s."""
STATUS_REQUESTS = 4
"""Requests per status poll."""
FULL_SPEED_PERCENT = 100.0
"""Speed ratio at which a segment has the requested speed."""
START_REQUESTS = 12
"""Largest number of requests to start a motion program, including login."""
T = TypeVar("T")


class WebError(RuntimeError):
    """The web services timed out or refused; the text says which."""


class WebRefused(WebError):
    """The web services refused a request, or answered with something else."""


class _Connection(HTTPConnection):
    """A connection whose answers end within `REQUEST_S`."""

    def connect(self) -> None:
        """Connect. Raises OSError."""
        super().connect()
        assert self.sock is not None
        self.sock = BoundedSocket(fileno=self.sock.detach())
        self.sock.settimeout(REQUEST_S)

    def request(self, *what: Any, **how: Any) -> None:
        """Send a request. Raises OSError."""
        if self.sock is not None:
            self.sock.settimeout(REQUEST_S)  # what is left of the last answer's time is no measure
        super().request(*what, **how)

    def getresponse(self) -> Any:
        """Return the answer, which is read later, within `REQUEST_S` from now. Raises OSError."""
        assert isinstance(self.sock, BoundedSocket)
        self.sock.expect(REQUEST_S)
        return super().getresponse()


class _Pool(HTTPConnectionPool):
    ConnectionCls = _Connection


class _Bounded(HTTPAdapter):
    """An HTTP adapter with a timeout of connections and of whole answers."""

    def init_poolmanager(self, *what: Any, **how: Any) -> None:
        """Make the connections' pool."""
        super().init_poolmanager(*what, **how)
        self.poolmanager.pool_classes_by_scheme = {"http": _Pool}

    def send(self, request: Any, **how: Any) -> Any:
        """Send a request. Raises requests.RequestException after `REQUEST_S`."""
        how["timeout"] = REQUEST_S
        return super().send(request, **how)


@dataclass(frozen=True)
class WebStatus:
    """The controller's status as reported by the web services."""

    controller: str
    """motoron, motoroff, guardstop, emergencystop, ..."""
    mode: str
    """AUTO, MANR, ..."""
    execution: str
    """running or stopped."""
    speed_percent: float
    """Speed ratio of the pendant, which scales every move."""

    @property
    def state(self) -> ArmState:
        """The arm's state, apart from whether it is moving."""
        if self.controller.startswith("emergencystop"):
            return ArmState.EMERGENCY_STOP
        if self.controller == "guardstop":
            return ArmState.PROTECTIVE_STOP
        if self.mode != "AUTO":
            return ArmState.REMOTE_CONTROL_OFF
        return ArmState.READY if self.controller == "motoron" else ArmState.NOT_RUNNING


class WebServices:
    """One session of the web services; thread-safe, one request at a time."""

    def __init__(self, settings: AbbSettings) -> None:
        url = f"http://{settings.host}:{settings.rws_port}"
        self._rws = RWS(url, settings.username, settings.password)
        self._rws._session.mount("http://", _Bounded())
        self._client = MotionProgramExecClient(abb_client=self._rws)
        self._task = settings.task
        self._lock = threading.Lock()
        self._answers = False

    def status(self) -> WebStatus:
        """Read the state of controller, mode, execution and speed ratio. Raises WebError."""
        return self._ask(
            lambda: WebStatus(
                self._rws.get_controller_state(),
                self._rws.get_operation_mode(),
                self._rws.get_execution_state().ctrlexecstate,
                self._rws.get_speedratio(),
            )
        )

    def is_running(self) -> bool:
        """Return whether a program is running; one request. Raises WebError."""
        return self._ask(lambda: self._rws.get_execution_state().ctrlexecstate != "stopped")

    def flange(self) -> tuple[Pose, tuple[float, ...]]:
        """Read the flange's pose in the base frame and the arm's configuration. Raises WebError."""
        target = self._ask(self._rws.get_robtarget)
        return from_quaternion(target.trans, target.rot), tuple(target.robconf.tolist())

    def joints_deg(self) -> list[float]:
        """Read the six joint angles, degrees. Raises WebError."""
        joints: list[float] = self._ask(self._rws.get_jointtarget).robax.tolist()
        return joints

    def about(self, resource: str) -> dict[str, str]:
        """Return the fields of a resource such as ``rw/system``; empty if it does not exist.

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
        """Stop the running program, and the arm with it.

        Raises:
            WebError: no answer, or another request of this session is still waiting for its own.
        """
        self._ask(self._client.stop_motion_program, REQUEST_S)

    def read_signal(self, name: str) -> float:
        """Read an analog signal. Raises WebError; WebRefused if there is none."""
        return self._ask(lambda: self._rws.get_analog_io(name))

    def write_signal(self, name: str, value: float) -> None:
        """Set an analog output. Raises WebError; WebRefused if there is none."""
        self._ask(lambda: self._rws.set_analog_io(name, value))

    def close(self) -> None:
        """Log out if the controller answers, and close the connection; at most 2 `REQUEST_S`.

        A controller keeps an abandoned session for minutes, and supports only a few.
        """
        with self._lock:
            if self._answers:
                self._rws.close()
            else:
                self._rws._session.close()

    def _ask(self, request: Callable[[], T], within_s: float = -1) -> T:
        """Return the result of requests, which wait for earlier ones: for `within_s`, if given."""
        if not self._lock.acquire(timeout=within_s):
            raise WebError("the controller's web services have not answered an earlier request")
        try:
            self._answers = True
            return request()
        except requests.RequestException as error:
            self._answers = False
            raise WebError(f"the controller's web services do not answer: {error}") from None
        except ABBException as error:
            raise WebRefused(f"the controller refused: {error}") from None
        except Exception as error:  # the client raises bare exceptions too
            raise WebRefused(str(error)) from None
        finally:
            self._lock.release()


def abb_health(web: WebServices, notes: tuple[str, ...]) -> DeviceHealth:
    """Return the health report of an ABB controller from its web services (RobotWare 6).

    Args:
        web: a session of the web services.
        notes: the driver's additional notes.

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
