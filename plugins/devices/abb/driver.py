"""Driver of ABB arms on an IRC5 controller by motion programs: the default driver.

A path is one motion program (abb-motion-program-exec 0.7.4): the controller plans each straight
move at a constant speed of the tool centre point, from rest to rest. Poses come by EGM; state and
commands go through Robot Web Services. A watchdog task on the controller stops the arm when it
loses this host or the network (`watchdog`, `docs/arms.md`).
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Sequence

from sliplab.plugins.devices.abb.egm import EgmCounts, EgmFault, EgmPose, EgmReceiver
from sliplab.plugins.devices.abb.program import PAUSE_S, TURN_DEG_S, motion_program
from sliplab.plugins.devices.abb.rws import (
    FULL_SPEED_PERCENT,
    REQUEST_S,
    STATUS_REQUESTS,
    WebError,
    WebRefused,
    WebServices,
    WebStatus,
    abb_health,
)
from sliplab.plugins.devices.abb.settings import (
    AGREE_MM,
    FAILURES,
    FIRST_POSE_S,
    MONITOR_S,
    OVERTIME_S,
    SILENCE_S,
    STILL_S,
    STOPPED_S,
    UNSEEN_STILL_S,
    AbbSettings,
)
from sliplab.plugins.devices.abb.watchdog import Watchdog
from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    DeviceHealth,
    Pose,
    Progress,
    Segment,
)
from sliplab.rigs.core.pose import angle_deg, compose, distance_mm, segment_seconds
from sliplab.rigs.core.pose_stream import Sample
from sliplab.rigs.core.threaded_arm import Run, SegmentWatch, ThreadedArm, has_left, is_at
from sliplab.storage.streams import Json

ENTRY, MODULES = "motion_program_main", "motion_program"
"""Task that runs motion programs, and the prefix of its modules' names."""
STATUS_S = MONITOR_S + 2 * STATUS_REQUESTS * REQUEST_S
"""Longest time to the answer of a status poll that has not begun yet, s."""


class AbbArm(ThreadedArm):
    """An ABB arm driven by motion programs; an `Arm` of `rigs.core.capabilities`."""

    def __init__(self, settings: AbbSettings) -> None:
        super().__init__(settings.limits)
        self._settings = settings
        self._tool = Pose(settings.tool.tcp_mm, settings.tool.tcp_rotvec_deg)
        self._web: WebServices | None = None
        self._egm: EgmReceiver | None = None
        self._watchdog: Watchdog | None = None
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._status: WebStatus | None = None
        self._asked_s = 0.0
        self._planned: Pose | None = None
        self._watch: SegmentWatch | None = None
        self._starting = threading.Lock()
        self._stopping = threading.Lock()
        self._may_move = False
        """True from sending a path until the arm is confirmed at rest."""
        self._not_stopped: tuple[float, ArmFault] | None = None
        """Time and error of the last failed stop."""
        self._began_s = 0.0
        """Start time of the last path."""
        self._at_rest: tuple[Pose, int] | None = None
        """Commanded pose that has not changed since, and its arrival time, host's ns."""

    def connect(self) -> None:
        """Connect to the web services, start the pose stream, and check that their poses agree.

        An open connection is reused if the controller answers; if not, it is closed as by `close`
        first. Takes at most (15 + `rws.START_REQUESTS`) `REQUEST_S` + `FIRST_POSE_S` +
        `STATUS_S` and the time of `close`.

        Raises:
            ArmFault: no connection, no poses, no watchdog, the arm is not ready to move, or the one
                that was lost while it may move is not confirmed at rest.
        """
        if self._lost is None:
            if self._answers():
                return
            self.close()  # lost, and not noticed yet: the arm may still be on its way
        try:
            self._open()
        except WebError as error:
            self._release()
            raise ArmFault("arm", f"{error}; check its power, network and address") from None
        except BaseException:
            self._release()
            raise

    def state(self) -> ArmState:
        """Return the last reported state without waiting."""
        if self._lost is not None or self._status is None:
            return ArmState.DISCONNECTED
        if self._status.state is not ArmState.READY:
            return self._status.state
        return ArmState.READY if self._run.done else ArmState.MOVING

    def pose(self) -> Pose:
        """Return the tool centre point from the last EGM pose, else from the web services.

        Takes at most `REQUEST_S`.

        Raises:
            ArmFault: neither is available.
        """
        last = self._stream.last
        if last is not None and not self._is_stale(last):
            return last.pose
        try:
            return self._web_pose()
        except WebError as error:
            raise ArmFault("arm", str(error)) from None

    def now_ns(self) -> int:
        """Return the controller's EGM clock, ns, extrapolated by the host's if the pose is stale.

        Raises:
            ArmFault: no pose has been received yet.
        """
        last = self._stream.last
        if last is None:
            raise self._fault(ArmState.DISCONNECTED, "has no pose")
        if not self._is_stale(last):
            return last.t_ns
        return last.t_ns + time.monotonic_ns() - last.host_ns

    def health(self) -> DeviceHealth:
        """Return the controller's health report; takes at most 6 `REQUEST_S`.

        Raises:
            ArmFault: it does not answer.
        """
        if self._web is None:
            raise self._fault(ArmState.DISCONNECTED, "cannot report its health")
        try:
            return abb_health(self._web, self._notes())
        except WebError as error:
            raise ArmFault("arm", str(error)) from None

    def describe(self) -> Json:
        """Return the number of lost and rejected pose packets since connecting, by reason."""
        return {**self._losses()}

    def start(self, path: Sequence[Segment]) -> None:
        """Check `path` against the limits, upload and start it.

        Takes at most (13 + `rws.START_REQUESTS`) `REQUEST_S` + `STOPPED_S`.

        Raises:
            GuardError: a limit forbids the path; nothing was sent.
            ArmFault: the arm cannot move, or not at the requested speed.
            RigError: it is still moving, or the path is empty.
        """
        with self._starting:
            self._refuse(path, moving=not self._run.done)
            if self._lost is not None or self._web is None:
                raise self._fault(ArmState.DISCONNECTED, "cannot move")
            begin = self.pose()
            try:
                self._update(self._web.status())
                if self.state() is not ArmState.READY:
                    raise self._fault(self.state(), "cannot move")
                self._check_speed()
                self._await_end()
                self._guard.check(begin, path)
                self._guard.check_joints(self._web.joints_deg())
                _, configuration = self._web.flange()
                program = motion_program(self._settings.tool, path, configuration)
                self._begin_watch()
                run = Run(path)
                self._watch = SegmentWatch(self._planned or begin, path)
                self._run = run
                self._began_s, self._may_move = math.inf, True  # no status covers this path yet
                self._web.start(program)
            except WebError as error:
                self._may_move |= self._began_s == math.inf
                self._abort()
                raise ArmFault("arm", f"did not accept the path: {error}") from None
            self._began_s = time.monotonic()
            if run.cancelled:  # by a stop that may have come before the program had begun
                with self._stopping:
                    self._may_move = True
                    self._halt(run)
                return
            self._begin(run)

    def progress(self) -> Progress:
        """Return how far the path has come.

        Raises:
            ArmFault: the path was aborted for a reason that `state` does not show.
        """
        run, state = self._run, self.state()
        if run.error is not None and run.done and state is ArmState.DISCONNECTED:
            raise run.error  # more specific than that the arm cannot be reached
        return run.progress(state)

    def stop(self) -> None:
        """Stop the program and the arm; safe at any time; never unlocks anything.

        Tries the open connection, then a new one, then withholds the heartbeat of the controller's
        watchdog. Takes at most 6 `REQUEST_S` + `STOPPED_S`; `settings.watchdog_s` +
        `UNSEEN_STILL_S` longer where poses still arrive; twice that if another thread is stopping
        the arm at the same time.

        Raises:
            ArmFault: a path was sent, and the arm is not confirmed at rest since.
        """
        began_s, run = time.monotonic(), self._run
        run.cancelled = True
        self._stream.wake()
        with self._stopping:
            if self._not_stopped is not None and self._not_stopped[0] > began_s:
                raise self._not_stopped[1]  # another thread has just tried
            if self._may_move:
                self._halt(run)
        run.join(SILENCE_S + 1.0)

    def close(self) -> None:
        """Stop the arm if it moves, and close every connection.

        Raises:
            ArmFault: the arm is not confirmed at rest; the connections are closed all the same.
        """
        try:
            self.stop()
        finally:
            self._release()

    def _release(self) -> None:
        """Close every connection; the controller's watchdog stays active if the arm may move."""
        self._closing.set()
        self._lost = self._lost or "closed"
        self._run.cancelled = True
        self._stream.wake()
        for thread in self._threads:
            thread.join(STATUS_S)
        self._threads.clear()
        if self._egm is not None:
            self._egm.close()
        if self._watchdog is not None:
            self._watchdog.close(watch=self._may_move)
        if self._web is not None:
            self._web.close()
        self._egm = self._web = self._watchdog = None
        self._run.done = True

    def _halt(self, run: Run) -> None:
        """Stop the arm by every available means, and confirm that it is at rest.

        Raises:
            ArmFault: this was not confirmed.
        """
        left_s = sum(self._seconds(run))
        try:
            self._halt_and_confirm(left_s)
        except ArmFault as fault:
            self._not_stopped = time.monotonic(), fault
            if self._watchdog is not None:
                self._watchdog.pause()
            raise
        finally:
            run.done = True
            self._stream.wake()
        self._may_move, self._not_stopped = False, None
        if self._watchdog is not None:
            self._watchdog.resume()

    def _halt_and_confirm(self, left_s: float) -> None:
        web = self._web
        try:
            if web is None:
                raise WebError(str(self._lost))
            web.stop()
            self._await_rest(web)
            return
        except WebError as error:
            why = error
        if self._watchdog is not None:
            self._watchdog.pause()
        web = WebServices(self._settings)
        try:
            web.stop()
            self._await_rest(web)
        except WebError:
            watched = self._settings.watchdog_s
            if self._stream.wait_for(
                lambda: self._at_rest_for(UNSEEN_STILL_S), self._rest_timeout_s(watched or 0.0)
            ):
                return
            ends = (
                f"its path of {left_s:.0f} s runs to its end"
                if watched is None
                else f"its controller stops it {watched:g} s after the last beat, unconfirmed"
            )
            raise ArmFault(
                "arm",
                f"cannot be reached to stop it ({why}); {ends}: press its emergency stop",
            ) from None
        finally:
            web.close()

    def _rest_timeout_s(self, watched_s: float) -> float:
        """Return the timeout for the poses to show the arm at rest; 0 where none arrive."""
        last = self._stream.last
        if last is None or self._is_stale(last):
            return 0.0
        return watched_s + UNSEEN_STILL_S + STOPPED_S

    def _await_rest(self, web: WebServices) -> None:
        """Wait until no program runs and poses or web services show the arm at rest.

        Raises:
            ArmFault: the arm does not stop.
            WebError: no answer.
        """
        deadline, before = time.monotonic() + STOPPED_S, None
        while True:
            if not web.is_running():
                if self._stream.wait_for(lambda: self._at_rest_for(STILL_S), 2 * STILL_S):
                    return
                here = web.flange()[0]
                if before is not None and is_at(before, here):
                    return
                before = here
            if time.monotonic() > deadline:
                raise ArmFault("arm", "does not stop: press its emergency stop")

    def _at_rest_for(self, seconds: float) -> bool:
        """Return whether fresh poses have not changed for this long."""
        last, first = self._stream.last, self._at_rest
        if last is None or first is None or self._is_stale(last):
            return False
        return last.host_ns - first[1] >= seconds * 1e9

    def _answers(self) -> bool:
        """Ask the controller for its state; return whether it answered."""
        if self._web is None:
            return False
        try:
            self._update(self._web.status())
        except WebError:
            return False
        return True

    def _open(self) -> None:
        settings = self._settings
        self._closing = threading.Event()
        sender = settings.egm_host or settings.host
        try:
            self._egm = EgmReceiver(
                settings.egm_bind, settings.egm_port, sender, settings.limits.speed_mm_s
            )
        except OSError as error:
            raise ArmFault(
                "arm",
                f"UDP port {settings.egm_port} cannot be opened for poses from {sender}: {error}",
            ) from None
        self._egm.check.active = False  # until the tool is set, which moves its centre point
        self._web = WebServices(settings)
        self._update(self._web.status())
        self._lost = None
        if self.state() is not ArmState.READY:
            raise self._fault(self.state(), "cannot connect")
        self._check_speed()
        self._check_task()
        for work in (self._receive, self._monitor):
            self._threads.append(threading.Thread(target=work, daemon=True))
            self._threads[-1].start()
        began_ns = time.monotonic_ns()
        self._web.start(motion_program(settings.tool))  # sets the tool, starts the pose stream
        self._begin_watch()
        self._stream.wait_for(lambda: self._fresh_since(began_ns) or bool(self._lost), FIRST_POSE_S)
        if self._lost is not None:
            raise self._fault(ArmState.DISCONNECTED, "cannot connect")
        if not self._fresh_since(began_ns):
            counts = self._egm.counts
            foreign = f" ({counts.foreign} from other addresses dropped)" if counts.foreign else ""
            raise ArmFault(
                "arm",
                f"no pose came on UDP port {settings.egm_port} from {sender}{foreign}: check the "
                "address and port of the device 'UCdevice' in the controller's configuration",
            )
        self._check_agreement()
        asked = time.monotonic()
        if not self._stream.wait_for(lambda: self._has_stopped(asked), STOPPED_S + STATUS_S):
            raise ArmFault("arm", "its program does not end")
        self._egm.check.active = True
        self._may_move, self._not_stopped = False, None

    def _begin_watch(self) -> None:
        """Activate the controller's watchdog on this host. Raises WebError, ArmFault."""
        limit_s = self._settings.watchdog_s
        if limit_s is None:
            return
        if self._watchdog is None:
            self._watchdog = Watchdog(self._settings, limit_s)
        try:
            assert self._web is not None
            self._watchdog.begin(self._web)
        except WebRefused as error:
            raise ArmFault(
                "arm",
                f"has no watchdog to stop it when this computer fails ({error}); load "
                "docs/rapid/sliplab_watchdog.mod into its controller (docs/arms.md), or set "
                "devices.arm.watchdog_s: null to run without one",
            ) from None

    def _check_task(self) -> None:
        """Check that the task has no other user's program. Raises ArmFault, WebError."""
        assert self._web is not None
        task = self._settings.task
        entry = self._web.about(f"rw/rapid/tasks/{task}").get("prodentrypt", ENTRY)
        if entry.lower() != ENTRY:
            raise ArmFault(
                "arm",
                f"has a task {task} with the entry routine {entry}, so that starting it would run "
                f"another user's program: set it to {ENTRY} of abb-motion-program-exec",
            )
        # RobotWare misspells the key; the correct spelling is accepted too
        pointer = self._web.about(f"rw/rapid/tasks/{task}/pcp")
        module = pointer.get("modulemame", pointer.get("modulename", ""))
        if module and not module.lower().startswith(MODULES):
            raise ArmFault(
                "arm",
                f"has another user's program paused in module {module} of task {task}: have it "
                "ended first (PP to Main at the pendant)",
            )

    def _check_speed(self) -> None:
        status = self._status
        if status is not None and status.speed_percent != FULL_SPEED_PERCENT:
            raise ArmFault(
                "arm",
                f"its speed ratio is {status.speed_percent:g} %, so every move would be slower "
                "than requested: set it to 100 % at the pendant",
            )

    def _await_end(self) -> None:
        """Wait for the last program to end. Raises ArmFault, WebError."""
        assert self._web is not None
        deadline = time.monotonic() + STOPPED_S
        while self._web.is_running():
            if time.monotonic() > deadline:
                raise ArmFault("arm", "is already running a program: stop it at the pendant")

    def _notes(self) -> tuple[str, ...]:
        """Return the notes of the health report on poses and watchdog."""
        limit_s = self._settings.watchdog_s
        watch = (
            "no watchdog: a path runs to its end if this computer fails"
            if limit_s is None
            else f"stopped by its controller {limit_s:g} s after this computer fails"
        )
        losses = ", ".join(f"{name} {count}" for name, count in self._losses().items())
        return (watch, losses)

    def _losses(self) -> dict[str, int]:
        counts = EgmCounts() if self._egm is None else self._egm.counts
        return {
            "poses_missing": counts.lost,
            "poses_late": counts.late,
            "packets_malformed": counts.malformed,
            "poses_implausible": counts.implausible,
            "packets_of_others": counts.foreign,
        }

    def _check_agreement(self) -> None:
        last = self._stream.last
        assert last is not None
        apart = distance_mm(last.pose, self._web_pose())
        if apart > AGREE_MM:
            raise ArmFault(
                "arm",
                f"EGM and web services report positions {apart:.1f} mm apart: set `egm_point` to "
                "the point that this controller's EGM reports, tool or flange",
            )

    def _web_pose(self) -> Pose:
        """Return the tool centre point from the web services. Raises WebError."""
        if self._web is None:
            raise self._fault(ArmState.DISCONNECTED, "has no pose")
        return compose(self._web.flange()[0], self._tool)

    def _receive(self) -> None:
        """Receive poses until the arm is closed or the stream is unusable; runs in a thread."""
        flange = self._settings.egm_point == "flange"
        egm = self._egm
        while egm is not None and not self._closing.is_set():
            try:
                came = egm.read(MONITOR_S)
                if came is not None:
                    self._take(came, self._tool if flange else None)
            except Exception as error:  # a thread that dies must not look like an arm at rest
                fault = error if isinstance(error, EgmFault) else f"its poses: {error!r}"
                if not self._run.done:
                    self._run.error = ArmFault("arm", f"{fault}; its path was aborted")
                self._lost = str(fault)
                self._stream.wake()
                return
            if came is None:
                self._stream.wake()  # waiting threads check the age of the last pose

    def _take(self, came: EgmPose, tool: Pose | None) -> None:
        planned = came.planned if tool is None else compose(came.planned, tool)
        measured = came.measured if tool is None else compose(came.measured, tool)
        self._planned = planned
        watch, run = self._watch, self._run
        if watch is not None and not run.done:
            times = watch.add(came.t_ns, planned)
            if times is not None:
                run.finished.append(times)
        if self._at_rest is None or has_left(self._at_rest[0], planned):
            self._at_rest = planned, came.host_ns
        self._stream.add(Sample(came.t_ns, came.host_ns, measured.xyz_mm, measured.rotvec_deg))

    def _monitor(self) -> None:
        """Poll the state over a separate session."""
        web, failures = WebServices(self._settings), 0
        while not self._closing.wait(MONITOR_S):
            asked = time.monotonic()
            try:
                self._update(web.status(), asked)
                failures = 0
            except WebError as error:
                failures += 1
                if failures >= FAILURES:
                    self._lost = str(error)
                    self._stream.wake()
                    break
        web.close()

    def _update(self, status: WebStatus, asked_s: float = 0.0) -> None:
        self._status = status
        self._asked_s = max(self._asked_s, asked_s)
        if self._run.done and self._has_stopped(self._began_s):
            self._may_move = False
        self._stream.wake()

    def _follow_path(self, run: Run) -> None:
        """Wait until all segments have ended, or the path has ended otherwise."""
        watch = self._watch
        assert watch is not None

        def ended() -> bool:
            return watch.done or run.cancelled or self._has_stopped(self._began_s)

        def over() -> bool:
            return ended() or not self.state().healthy or self._abort_reason() is not None

        seconds = sum(self._seconds(run))
        if not self._stream.wait_for(over, 1.5 * seconds + OVERTIME_S):
            raise ArmFault("arm", f"did not finish a path of {seconds:.1f} s in time")
        why = self._abort_reason()
        if why is not None and not ended():
            raise ArmFault("arm", why)
        if self._has_stopped(self._began_s):  # the last poses may still be on their way
            self._stream.wait_for(lambda: watch.done, SILENCE_S)
            self._finish(run)
        elif self._lost is not None and not run.cancelled:
            self._abort()

    def _on_path_end(self) -> None:
        if self._has_stopped(self._began_s):
            self._may_move = False
        super()._on_path_end()

    def _abort_reason(self) -> str | None:
        """Return the reason to abort the path, if any: no poses, or a changed speed ratio."""
        watch, last, status = self._watch, self._stream.last, self._status
        seen_s = max(self._began_s, last.host_ns / 1e9 if last is not None else 0.0)
        silent_s = time.monotonic() - seen_s
        if silent_s > (SILENCE_S if watch is not None and watch.begun else FIRST_POSE_S):
            return f"sent no pose for {silent_s:.1f} s while it moved; its path was aborted"
        if status is not None and status.speed_percent != FULL_SPEED_PERCENT:
            return (
                f"had its speed ratio set to {status.speed_percent:g} % while it moved; its path "
                "was aborted: set it to 100 % at the pendant"
            )
        return None

    def _finish(self, run: Run) -> None:
        """Conclude a path whose program has ended; its last segment ended if at its target."""
        last = self._stream.last
        if last is None or self._is_stale(last):
            raise ArmFault("arm", "sent no poses at the end of its path")
        one_left = len(run.finished) == len(run.path) - 1
        if one_left and not run.cancelled and is_at(last.pose, run.path[-1].to):
            begin = run.finished[-1][1] if run.finished else last.t_ns
            run.finished.append((begin, last.t_ns))
        if len(run.finished) == len(run.path) or run.cancelled:
            return
        web, watchdog = self._web, self._watchdog
        if web is None or watchdog is None:
            return
        with contextlib.suppress(WebError):  # then the connection is lost, which the state shows
            if watchdog.stopped_it(web):
                raise ArmFault(
                    "arm",
                    "was stopped by its controller's watchdog: no heartbeat of this computer "
                    f"arrived for {self._settings.watchdog_s:g} s; check the network and the load",
                )

    def _abort(self) -> None:
        """Stop the arm, whose path is no longer followed; `stop` raises if that fails."""
        self._run.done = True
        with self._stopping, contextlib.suppress(ArmFault):
            if self._may_move:
                self._halt(self._run)

    def _has_stopped(self, since_s: float) -> bool:
        """Return whether a status requested after `since_s` shows no running program."""
        status = self._status
        return status is not None and self._asked_s > since_s and status.execution == "stopped"

    def _fresh_since(self, host_ns: int) -> bool:
        last = self._stream.last
        return last is not None and last.host_ns > host_ns

    def _is_stale(self, sample: Sample) -> bool:
        return time.monotonic_ns() - sample.host_ns > SILENCE_S * 1e9

    def _turn_s(self, begin: Pose, segment: Segment) -> float:
        """Return the time that the controller takes for the turn in a segment, s."""
        return angle_deg(begin, segment.to) / (segment.turn_deg_s or TURN_DEG_S)

    def _seconds(self, run: Run) -> list[float]:
        """Return the duration of each segment without its ramps, s."""
        places = [self._planned or run.path[0].to, *(segment.to for segment in run.path)]
        return [
            max(segment_seconds(one, segment), self._turn_s(one, segment)) + PAUSE_S
            for one, segment in zip(places, run.path, strict=False)
        ]
