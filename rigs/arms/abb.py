"""Driver of ABB arms on an IRC5 controller by motion programs: the default way in.

A path is one motion program (abb-motion-program-exec 0.7.4): the controller plans each straight
move at a constant speed of the tool centre point, from rest to rest. Poses come by EGM, the state
and the commands go through Robot Web Services. Nothing on the controller notices that this host
has gone: without a network a path runs to its end (`docs/arms.md`).
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence

from rigs.arms.abb_egm import EgmPose, EgmReceiver
from rigs.arms.abb_program import PAUSE_S, motion_program
from rigs.arms.abb_rws import REQUEST_S, WebError, WebServices, WebStatus
from rigs.arms.guard import Guard
from rigs.arms.health import abb_health
from rigs.arms.pose import compose, distance_mm
from rigs.arms.run import Run
from rigs.arms.segments import SegmentWatch, is_at
from rigs.arms.settings import AbbSettings
from rigs.arms.stream import PoseStream, Sample
from rigs.capabilities import ArmFault, ArmState, DeviceHealth, Pose, Progress, RigError, Segment
from storage.streams import PoseChunk, PulseChunk

MONITOR_S = 0.2
"""How often the web services are asked for the state: three requests each time, s."""
FAILURES = 2
"""So many askings in a row without an answer are a lost connection."""
FIRST_POSE_S = 3.0
"""From a motion program being started to its first pose by EGM, s."""
SILENCE_S = 0.5
"""Poses that stay away for this long are not fresh any more, s."""
STOPPED_S = 2.0
"""From a stop being taken to the program having stopped, s."""
OVERTIME_S = 5.0
"""How much longer than half as long again a path may take before it is stopped, s."""
AGREE_MM = 0.5
"""How far EGM and the web services may differ in where the arm stands, mm."""


class AbbArm:
    """An ABB arm by motion programs; an `Arm` of `rigs.capabilities`."""

    def __init__(self, settings: AbbSettings) -> None:
        self._settings = settings
        self._guard = Guard(settings.limits)
        self._stream = PoseStream()
        self._tool = Pose(settings.tool.tcp_mm, settings.tool.tcp_rotvec_deg)
        self._web: WebServices | None = None
        self._egm: EgmReceiver | None = None
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._status: WebStatus | None = None
        self._asked_s = 0.0
        self._lost: str | None = "not connected"
        self._planned: Pose | None = None
        self._watch: SegmentWatch | None = None
        self._run = Run((), done=True)
        self._starting = threading.Lock()

    def connect(self) -> None:
        """Reach the web services, start the pose stream, see that both tell the same place.

        Takes at most (7 + `abb_rws.START_REQUESTS`) `REQUEST_S` + `FIRST_POSE_S` + `STOPPED_S`.

        Raises:
            ArmFault: no connection, no poses, or the arm may not move now.
        """
        if self._lost is None:
            return
        try:
            self._open()
        except WebError as error:
            self.close()
            raise ArmFault("arm", f"{error}; check its power, network and address") from None
        except BaseException:
            self.close()
            raise

    def recover(self) -> None:
        """Connect again after a person has put right what stopped the arm; unlocks nothing.

        Raises:
            ArmFault: the arm is still stopped or cannot be reached.
        """
        self.close()
        self.connect()

    def state(self) -> ArmState:
        """The arm's state as it was told last; never waits."""
        if self._lost is not None or self._status is None:
            return ArmState.DISCONNECTED
        if self._status.state is not ArmState.READY:
            return self._status.state
        return ArmState.READY if self._run.done else ArmState.MOVING

    def pose(self) -> Pose:
        """Where the tool centre point is: the last pose by EGM, or the web services' without one.

        Raises:
            ArmFault: neither is there. Takes at most `REQUEST_S`.
        """
        last = self._stream.last
        if last is not None and not self._is_stale(last):
            return last.pose
        try:
            return self._stands()
        except WebError as error:
            raise ArmFault("arm", str(error)) from None

    def now_ns(self) -> int:
        """The controller's EGM clock, ns: the last pose's, carried on by the host's if it is old.

        Raises:
            ArmFault: no pose has come yet.
        """
        last = self._stream.last
        if last is None:
            raise self._fault(ArmState.DISCONNECTED, "has no pose")
        if not self._is_stale(last):
            return last.t_ns
        return last.t_ns + time.monotonic_ns() - last.host_ns

    def health(self) -> DeviceHealth:
        """What the controller says of itself; takes at most 5 `REQUEST_S`.

        Raises:
            ArmFault: it does not answer.
        """
        if self._web is None:
            raise self._fault(ArmState.DISCONNECTED, "cannot be asked")
        try:
            return abb_health(self._web)
        except WebError as error:
            raise ArmFault("arm", str(error)) from None

    def start(self, path: Sequence[Segment]) -> None:
        """Begin to follow `path`: checked against the limits, uploaded, started.

        Takes at most (6 + `abb_rws.START_REQUESTS`) `REQUEST_S`.

        Raises:
            GuardError: a limit forbids the path; nothing was sent.
            ArmFault: the arm cannot move.
            RigError: it is still moving, or the path is empty.
        """
        with self._starting:
            if not path:
                raise RigError("arm", "was given an empty path")
            if not self._run.done:
                raise RigError("arm", "is still moving; wait for its path to end, or stop it")
            if self._lost is not None or self._web is None:
                raise self._fault(ArmState.DISCONNECTED, "cannot move")
            begin = self.pose()
            try:
                self._see(self._web.status())
                if self.state() is not ArmState.READY:
                    raise self._fault(self.state(), "cannot move")
                self._guard.check(begin, path)
                self._guard.check_joints(self._web.joints_deg())
                _, configuration = self._web.flange()
                program = motion_program(self._settings.tool, path, configuration)
                run = Run(path)
                self._watch = SegmentWatch(self._planned or begin, path)
                self._run = run
                self._web.start(program)
            except WebError as error:
                self._give_up()
                raise ArmFault("arm", f"did not take a path: {error}") from None
            began_s = time.monotonic()
            run.thread = threading.Thread(target=self._follow, args=(run, began_s), daemon=True)
            run.thread.start()

    def progress(self) -> Progress:
        """How far the path has come.

        Raises:
            ArmFault: the path was given up for a reason that `state` does not tell.
        """
        return self._run.progress(self.state())

    def read_poses(self) -> PoseChunk:
        """Measured poses since the last call; the controller may send none between two paths."""
        return self._stream.read()

    def read_pulses(self) -> PulseChunk:
        """Always empty: EGM carries no digital input, and the web services are far too slow."""
        return self._stream.read_pulses()

    def stop(self) -> None:
        """Stop the program and the arm; safe at any time; never unlocks anything.

        Takes at most 4 `REQUEST_S` + `STOPPED_S`.

        Raises:
            ArmFault: it was moving, and the controller cannot be reached or goes on.
        """
        run, web = self._run, self._web
        run.cancelled = True
        self._stream.wake()
        if run.done or web is None:
            return
        left_s = sum(self._seconds(run))
        try:
            web.stop()
            deadline = time.monotonic() + STOPPED_S
            while web.status().execution != "stopped":
                if time.monotonic() > deadline:
                    raise ArmFault("arm", "does not stop: press its emergency stop")
        except WebError as error:
            raise ArmFault(
                "arm",
                f"cannot be reached to be stopped ({error}); its path of {left_s:.0f} s runs to "
                "its end: press its emergency stop",
            ) from None
        finally:
            run.done = True
        if run.thread is not None and run.thread is not threading.current_thread():
            run.thread.join(SILENCE_S + 1.0)

    def close(self) -> None:
        """Stop if it moves, and give every connection back."""
        with contextlib.suppress(ArmFault):
            self.stop()
        self._closing.set()
        self._lost = self._lost or "closed"
        self._run.cancelled = True
        self._stream.wake()
        for thread in self._threads:
            thread.join(4 * REQUEST_S)
        self._threads.clear()
        if self._egm is not None:
            self._egm.close()
        if self._web is not None:
            self._web.close()
        self._egm = self._web = None
        self._run.done = True

    def _open(self) -> None:
        settings = self._settings
        self._closing = threading.Event()
        try:
            self._egm = EgmReceiver(settings.egm_bind, settings.egm_port)
        except OSError as error:
            raise ArmFault(
                "arm", f"UDP port {settings.egm_port} cannot be opened for its poses: {error}"
            ) from None
        self._web = WebServices(settings)
        self._see(self._web.status())
        self._lost = None
        if self.state() is not ArmState.READY:
            raise self._fault(self.state(), "cannot connect")
        for work in (self._listen, self._monitor):
            self._threads.append(threading.Thread(target=work, daemon=True))
            self._threads[-1].start()
        began_ns = time.monotonic_ns()
        self._web.start(motion_program(settings.tool))  # sets the tool, starts the pose stream
        if not self._stream.wait_for(lambda: self._fresh_since(began_ns), FIRST_POSE_S):
            raise ArmFault(
                "arm",
                f"no pose came on UDP port {settings.egm_port}: check the address and port of "
                "the device 'UCdevice' in the controller's configuration",
            )
        self._agree()
        asked = time.monotonic()
        if not self._stream.wait_for(lambda: self._has_stopped(asked), STOPPED_S):
            raise ArmFault("arm", "its program does not end")

    def _agree(self) -> None:
        last = self._stream.last
        assert last is not None
        apart = distance_mm(last.pose, self._stands())
        if apart > AGREE_MM:
            raise ArmFault(
                "arm",
                f"EGM and web services tell places {apart:.1f} mm apart: set `egm_point` to the "
                "one that this controller's EGM tells, tool or flange",
            )

    def _stands(self) -> Pose:
        """The tool centre point by the web services. Raises WebError."""
        if self._web is None:
            raise self._fault(ArmState.DISCONNECTED, "has no pose")
        return compose(self._web.flange()[0], self._tool)

    def _listen(self) -> None:
        """Every pose that comes, until the arm is closed."""
        flange = self._settings.egm_point == "flange"
        egm = self._egm
        while egm is not None and not self._closing.is_set():
            came = egm.read(MONITOR_S)
            if came is not None:
                self._take(came, self._tool if flange else None)

    def _take(self, came: EgmPose, tool: Pose | None) -> None:
        planned = came.planned if tool is None else compose(came.planned, tool)
        measured = came.measured if tool is None else compose(came.measured, tool)
        self._planned = planned
        watch, run = self._watch, self._run
        if watch is not None and not run.done:
            times = watch.see(came.t_ns, planned)
            if times is not None:
                run.finished.append(times)
        self._stream.add(Sample(came.t_ns, came.host_ns, measured.xyz_mm, measured.rotvec_deg))

    def _monitor(self) -> None:
        """The state, asked for again and again over a session of its own."""
        web, failures = WebServices(self._settings), 0
        while not self._closing.wait(MONITOR_S):
            asked = time.monotonic()
            try:
                self._see(web.status(), asked)
                failures = 0
            except WebError as error:
                failures += 1
                if failures >= FAILURES:
                    self._lost = str(error)
                    self._stream.wake()
                    break
        web.close()

    def _see(self, status: WebStatus, asked_s: float = 0.0) -> None:
        self._status = status
        self._asked_s = max(self._asked_s, asked_s)
        self._stream.wake()

    def _follow(self, run: Run, began_s: float) -> None:
        """A path's thread: until all segments have ended, or something else has."""
        watch = self._watch
        assert watch is not None

        def over() -> bool:
            unhealthy = not self.state().healthy
            return watch.done or run.cancelled or unhealthy or self._has_stopped(began_s)

        seconds = sum(self._seconds(run))
        try:
            if not self._stream.wait_for(over, 1.5 * seconds + OVERTIME_S):
                raise ArmFault("arm", f"did not end a path of {seconds:.1f} s in time")
            if self._has_stopped(began_s):  # the last poses may still be on their way
                self._stream.wait_for(lambda: watch.done, SILENCE_S)
                self._finish(run)
        except ArmFault as error:
            run.error = error
            self._give_up()
        finally:
            run.done = True
            self._stream.wake()

    def _finish(self, run: Run) -> None:
        """The program ended by itself: the last segment has too if the arm is at its target."""
        last = self._stream.last
        if last is None or self._is_stale(last):
            raise ArmFault("arm", "sent no poses to the end of its path")
        one_left = len(run.finished) == len(run.path) - 1
        if one_left and not run.cancelled and is_at(last.pose, run.path[-1].to):
            begin = run.finished[-1][1] if run.finished else last.t_ns
            run.finished.append((begin, last.t_ns))

    def _give_up(self) -> None:
        self._run.done = True
        if self._web is not None:
            with contextlib.suppress(WebError):
                self._web.stop()

    def _has_stopped(self, since_s: float) -> bool:
        """Whether no program runs, by a question asked after `since_s`."""
        status = self._status
        return status is not None and self._asked_s > since_s and status.execution == "stopped"

    def _fresh_since(self, host_ns: int) -> bool:
        last = self._stream.last
        return last is not None and last.host_ns > host_ns

    def _is_stale(self, sample: Sample) -> bool:
        return time.monotonic_ns() - sample.host_ns > SILENCE_S * 1e9

    def _seconds(self, run: Run) -> list[float]:
        """How long each segment takes, without its ramps."""
        places = [self._planned or run.path[0].to, *(segment.to for segment in run.path)]
        return [
            distance_mm(one, segment.to) / segment.speed_mm_s + PAUSE_S
            for one, segment in zip(places, run.path, strict=False)
        ]

    def _fault(self, state: ArmState, what: str) -> ArmFault:
        reason = f" ({self._lost})" if state is ArmState.DISCONNECTED and self._lost else ""
        return ArmFault("arm", f"{what}: {state.value}{reason}; {state.advice}")
