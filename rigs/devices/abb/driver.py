"""Driver of ABB arms on an IRC5 controller by motion programs: the default way in.

A path is one motion program (abb-motion-program-exec 0.7.4): the controller plans each straight
move at a constant speed of the tool centre point, from rest to rest. Poses come by EGM, the state
and the commands go through Robot Web Services. That this host or the network has gone is noticed
by a task on the controller, which stops the arm then (`watchdog`, `docs/arms.md`).
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Sequence

from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    DeviceHealth,
    Pose,
    Progress,
    Segment,
)
from sliplab.rigs.core.pose import compose, distance_mm
from sliplab.rigs.core.pose_stream import Sample
from sliplab.rigs.core.threaded_arm import Run, SegmentWatch, ThreadedArm, has_left, is_at
from sliplab.rigs.devices.abb.egm import EgmCounts, EgmFault, EgmPose, EgmReceiver
from sliplab.rigs.devices.abb.program import PAUSE_S, motion_program
from sliplab.rigs.devices.abb.rws import (
    FULL_SPEED_PERCENT,
    REQUEST_S,
    STATUS_REQUESTS,
    WebError,
    WebRefused,
    WebServices,
    WebStatus,
    abb_health,
)
from sliplab.rigs.devices.abb.settings import AbbSettings
from sliplab.rigs.devices.abb.watchdog import Watchdog
from sliplab.storage.streams import Json

ENTRY, MODULES = "motion_program_main", "motion_program"
"""Task that runs motion programs, and the prefix of its modules' names."""
MONITOR_S = 0.2
"""Period at which the web services are asked for the state, in four requests, s."""
FAILURES = 2
"""So many askings in a row without an answer are a lost connection."""
FIRST_POSE_S = 3.0
"""From a motion program being started to its first pose by EGM, s."""
SILENCE_S = 0.5
"""Poses that stay away for this long are not fresh any more, s."""
STOPPED_S = 2.0
"""From a stop being taken to the arm standing still, s."""
STILL_S = 0.2
"""An arm whose poses have not changed for so long stands; more than the rest after a segment, s."""
UNSEEN_STILL_S = 0.5
"""The same where only its poses say so, because the web services do not answer, s."""
LOOK_S = MONITOR_S + 2 * STATUS_REQUESTS * REQUEST_S
"""To the answer to a look at the state that has begun after now, s."""
OVERTIME_S = 5.0
"""Time beyond 1.5 times its duration after which a path is stopped, s."""
AGREE_MM = 0.5
"""Largest difference between the positions of EGM and the web services, mm."""


class AbbArm(ThreadedArm):
    """An ABB arm by motion programs; an `Arm` of `rigs.core.capabilities`."""

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
        """A path was sent, and nobody has seen the arm at rest since."""
        self._not_stopped: tuple[float, ArmFault] | None = None
        """When the last attempt to stop it failed, and how."""
        self._began_s = 0.0
        """When the last path was started."""
        self._stands_at: tuple[Pose, int] | None = None
        """Commanded pose that all newer ones are the same as, and when it came, host's ns."""

    def connect(self) -> None:
        """Reach the web services, start the pose stream, see that both tell the same place.

        Takes at most (14 + `rws.START_REQUESTS`) `REQUEST_S` + `FIRST_POSE_S` + `LOOK_S`.

        Raises:
            ArmFault: no connection, no poses, no watchdog, or the arm may not move now.
        """
        if self._lost is None:
            return
        try:
            self._open()
        except WebError as error:
            self._release()
            raise ArmFault("arm", f"{error}; check its power, network and address") from None
        except BaseException:
            self._release()
            raise

    def recover(self) -> None:
        """Connect again after a person has put right what stopped the arm; unlocks nothing.

        Raises:
            ArmFault: the arm is still stopped or cannot be reached.
        """
        with contextlib.suppress(ArmFault):  # connecting finds out, and says so
            self.close()
        self.connect()

    def state(self) -> ArmState:
        """The arm's state as last reported; never waits."""
        if self._lost is not None or self._status is None:
            return ArmState.DISCONNECTED
        if self._status.state is not ArmState.READY:
            return self._status.state
        return ArmState.READY if self._run.done else ArmState.MOVING

    def pose(self) -> Pose:
        """Return where the tool centre point is: by the last EGM pose, else by the web services.

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
        """Return the controller's own report; takes at most 6 `REQUEST_S`.

        Raises:
            ArmFault: it does not answer.
        """
        if self._web is None:
            raise self._fault(ArmState.DISCONNECTED, "cannot be asked")
        try:
            return abb_health(self._web, self._notes())
        except WebError as error:
            raise ArmFault("arm", str(error)) from None

    def describe(self) -> Json:
        """Packets of its poses that gave none since connecting, by why."""
        return {**self._losses()}

    def start(self, path: Sequence[Segment]) -> None:
        """Begin to follow `path`: checked against the limits, uploaded, started.

        Takes at most (13 + `rws.START_REQUESTS`) `REQUEST_S` + `STOPPED_S`.

        Raises:
            GuardError: a limit forbids the path; nothing was sent.
            ArmFault: the arm cannot move, or not at the speed asked for.
            RigError: it is still moving, or the path is empty.
        """
        with self._starting:
            self._refuse(path, moving=not self._run.done)
            if self._lost is not None or self._web is None:
                raise self._fault(ArmState.DISCONNECTED, "cannot move")
            begin = self.pose()
            try:
                self._see(self._web.status())
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
                self._began_s, self._may_move = math.inf, True  # no state tells of it until later
                self._web.start(program)
            except WebError as error:
                self._give_up()
                raise ArmFault("arm", f"did not take a path: {error}") from None
            self._began_s = time.monotonic()
            self._begin(run)

    def progress(self) -> Progress:
        """Return how far the path has come.

        Raises:
            ArmFault: the path was given up for a reason that `state` does not tell.
        """
        run, state = self._run, self.state()
        if run.error is not None and run.done and state is ArmState.DISCONNECTED:
            raise run.error  # it says more than that the arm cannot be reached
        return run.progress(state)

    def stop(self) -> None:
        """Stop the program and the arm; safe at any time; never unlocks anything.

        Every way is tried: the connection there is, a new one, and no more beats for the
        controller's watchdog. Takes at most 6 `REQUEST_S` + `STOPPED_S`, or, where poses still
        come, `settings.watchdog_s` + `UNSEEN_STILL_S` longer; twice that if another thread is
        about to stop it.

        Raises:
            ArmFault: a path was sent, and the arm was not seen at rest since.
        """
        began_s, run = time.monotonic(), self._run
        run.cancelled = True
        self._stream.wake()
        with self._stopping:
            if self._not_stopped is not None and self._not_stopped[0] > began_s:
                raise self._not_stopped[1]  # another thread has tried meanwhile
            if self._may_move:
                self._halt(run)
        run.join(SILENCE_S + 1.0)

    def close(self) -> None:
        """Stop if it moves, and give every connection back.

        Raises:
            ArmFault: it was not seen at rest; the connections are given back all the same.
        """
        try:
            self.stop()
        finally:
            self._release()

    def _release(self) -> None:
        """Give every connection back; the watchdog goes on watching an arm that may move."""
        self._closing.set()
        self._lost = self._lost or "closed"
        self._run.cancelled = True
        self._stream.wake()
        for thread in self._threads:
            thread.join(LOOK_S)
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
        """Stop by every way there is, and see that it stands.

        Raises:
            ArmFault: it was not seen to.
        """
        left_s = sum(self._seconds(run))
        try:
            self._halt_and_see(left_s)
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

    def _halt_and_see(self, left_s: float) -> None:
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
                lambda: self._stands_since(UNSEEN_STILL_S), self._unseen_s(watched or 0.0)
            ):
                return
            ends = (
                f"its path of {left_s:.0f} s runs to its end"
                if watched is None
                else f"its controller stops it {watched:g} s after the last beat, unseen from here"
            )
            raise ArmFault(
                "arm",
                f"cannot be reached to be stopped ({why}); {ends}: press its emergency stop",
            ) from None
        finally:
            web.close()

    def _unseen_s(self, watched_s: float) -> float:
        """Return how long to look at its poses for standing still; 0 where none come."""
        last = self._stream.last
        if last is None or self._is_stale(last):
            return 0.0
        return watched_s + UNSEEN_STILL_S + STOPPED_S

    def _await_rest(self, web: WebServices) -> None:
        """Wait until no program runs and the arm stands, by its poses or by the web services.

        Raises:
            ArmFault: it goes on.
            WebError: no answer.
        """
        deadline, before = time.monotonic() + STOPPED_S, None
        while True:
            if not web.is_running():
                if self._stream.wait_for(lambda: self._stands_since(STILL_S), 2 * STILL_S):
                    return
                here = web.flange()[0]
                if before is not None and is_at(before, here):
                    return
                before = here
            if time.monotonic() > deadline:
                raise ArmFault("arm", "does not stop: press its emergency stop")

    def _stands_since(self, seconds: float) -> bool:
        """Return whether fresh poses have not moved for so long."""
        last, first = self._stream.last, self._stands_at
        if last is None or first is None or self._is_stale(last):
            return False
        return last.host_ns - first[1] >= seconds * 1e9

    def _open(self) -> None:
        settings = self._settings
        self._closing = threading.Event()
        sender = settings.egm_host or settings.host
        try:
            self._egm = EgmReceiver(settings.egm_bind, settings.egm_port, sender)
        except OSError as error:
            raise ArmFault(
                "arm",
                f"UDP port {settings.egm_port} cannot be opened for poses from {sender}: {error}",
            ) from None
        self._web = WebServices(settings)
        self._see(self._web.status())
        self._lost = None
        if self.state() is not ArmState.READY:
            raise self._fault(self.state(), "cannot connect")
        self._check_speed()
        self._check_task()
        for work in (self._listen, self._monitor):
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
            others = f" ({counts.foreign} packets of others were dropped)" if counts.foreign else ""
            raise ArmFault(
                "arm",
                f"no pose came on UDP port {settings.egm_port} from {sender}{others}: check the "
                "address and port of the device 'UCdevice' in the controller's configuration",
            )
        self._agree()
        asked = time.monotonic()
        if not self._stream.wait_for(lambda: self._has_stopped(asked), STOPPED_S + LOOK_S):
            raise ArmFault("arm", "its program does not end")
        self._may_move, self._not_stopped = False, None

    def _begin_watch(self) -> None:
        """Have the controller stop the arm when this host is gone. Raises WebError, ArmFault."""
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
                f"has no watchdog that would stop it when this computer is gone ({error}); load "
                "docs/rapid/sliplab_watchdog.mod into its controller (docs/arms.md), or write "
                "devices.arm.watchdog_s: null to do without",
            ) from None

    def _check_task(self) -> None:
        """Refuse to start or to end what is somebody else's. Raises ArmFault, WebError."""
        assert self._web is not None
        task = self._settings.task
        entry = self._web.about(f"rw/rapid/tasks/{task}").get("prodentrypt", ENTRY)
        if entry.lower() != ENTRY:
            raise ArmFault(
                "arm",
                f"has a task {task} that begins with {entry}, so that starting it would run "
                f"somebody else's program: it is to begin with {ENTRY} of abb-motion-program-exec",
            )
        # RobotWare's own spelling of the key, and the right one
        pointer = self._web.about(f"rw/rapid/tasks/{task}/pcp")
        module = pointer.get("modulemame", pointer.get("modulename", ""))
        if module and not module.lower().startswith(MODULES):
            raise ArmFault(
                "arm",
                f"has somebody else's program paused in module {module} of task {task}: let that "
                "person end it (PP to Main at the pendant)",
            )

    def _check_speed(self) -> None:
        status = self._status
        if status is not None and status.speed_percent != FULL_SPEED_PERCENT:
            raise ArmFault(
                "arm",
                f"its speed ratio stands at {status.speed_percent:g} %, so every move would be "
                "slower than asked for: set it to 100 % at the pendant",
            )

    def _await_end(self) -> None:
        """Wait for the last program's end, a rest after its last segment. Raises as it says."""
        assert self._web is not None
        deadline = time.monotonic() + STOPPED_S
        while self._web.is_running():
            if time.monotonic() > deadline:
                raise ArmFault("arm", "runs a program already: stop it at the pendant")

    def _notes(self) -> tuple[str, ...]:
        """Return notes for a person on its poses and its watchdog."""
        limit_s = self._settings.watchdog_s
        watch = (
            "no watchdog: a path runs to its end if this computer is gone"
            if limit_s is None
            else f"stopped by its controller {limit_s:g} s after this computer is gone"
        )
        losses = ", ".join(f"{name} {count}" for name, count in self._losses().items())
        return (watch, losses)

    def _losses(self) -> dict[str, int]:
        counts = EgmCounts() if self._egm is None else self._egm.counts
        return {
            "poses_missing": counts.lost,
            "poses_late": counts.late,
            "packets_malformed": counts.malformed,
            "packets_of_others": counts.foreign,
        }

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
        """Every pose that comes, until the arm is closed or its poses cannot be used."""
        flange = self._settings.egm_point == "flange"
        egm = self._egm
        while egm is not None and not self._closing.is_set():
            try:
                came = egm.read(MONITOR_S)
            except EgmFault as fault:
                if not self._run.done:
                    self._run.error = ArmFault("arm", f"{fault}; its path was given up")
                self._lost = str(fault)
                self._stream.wake()
                return
            if came is not None:
                self._take(came, self._tool if flange else None)
            else:
                self._stream.wake()  # who waits for a pose looks at how long it has stayed away

    def _take(self, came: EgmPose, tool: Pose | None) -> None:
        planned = came.planned if tool is None else compose(came.planned, tool)
        measured = came.measured if tool is None else compose(came.measured, tool)
        self._planned = planned
        watch, run = self._watch, self._run
        if watch is not None and not run.done:
            times = watch.see(came.t_ns, planned)
            if times is not None:
                run.finished.append(times)
        if self._stands_at is None or has_left(self._stands_at[0], planned):
            self._stands_at = planned, came.host_ns
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
        if self._run.done and self._has_stopped(self._began_s):
            self._may_move = False
        self._stream.wake()

    def _follow_path(self, run: Run) -> None:
        """Wait until all segments have ended, or something else has."""
        watch = self._watch
        assert watch is not None

        def ended() -> bool:
            return watch.done or run.cancelled or self._has_stopped(self._began_s)

        def over() -> bool:
            return ended() or not self.state().healthy or self._why_given_up() is not None

        seconds = sum(self._seconds(run))
        if not self._stream.wait_for(over, 1.5 * seconds + OVERTIME_S):
            raise ArmFault("arm", f"did not end a path of {seconds:.1f} s in time")
        why = self._why_given_up()
        if why is not None and not ended():
            raise ArmFault("arm", why)
        if self._has_stopped(self._began_s):  # the last poses may still be on their way
            self._stream.wait_for(lambda: watch.done, SILENCE_S)
            self._finish(run)
        elif self._lost is not None and not run.cancelled:
            self._give_up()

    def _path_is_over(self) -> None:
        if self._has_stopped(self._began_s):
            self._may_move = False
        super()._path_is_over()

    def _why_given_up(self) -> str | None:
        """Return why the path is to be given up, if it is: no poses, or another speed."""
        watch, last, status = self._watch, self._stream.last, self._status
        seen_s = max(self._began_s, last.host_ns / 1e9 if last is not None else 0.0)
        silent_s = time.monotonic() - seen_s
        if silent_s > (SILENCE_S if watch is not None and watch.begun else FIRST_POSE_S):
            return f"sent no pose for {silent_s:.1f} s while it moved; its path was given up"
        if status is not None and status.speed_percent != FULL_SPEED_PERCENT:
            return (
                f"had its speed ratio set to {status.speed_percent:g} % while it moved; its path "
                "was given up: set it to 100 % at the pendant"
            )
        return None

    def _finish(self, run: Run) -> None:
        """The program ended by itself: the last segment has too if the arm is at its target."""
        last = self._stream.last
        if last is None or self._is_stale(last):
            raise ArmFault("arm", "sent no poses to the end of its path")
        one_left = len(run.finished) == len(run.path) - 1
        if one_left and not run.cancelled and is_at(last.pose, run.path[-1].to):
            begin = run.finished[-1][1] if run.finished else last.t_ns
            run.finished.append((begin, last.t_ns))
        if len(run.finished) == len(run.path) or run.cancelled:
            return
        web, watchdog = self._web, self._watchdog
        if web is None or watchdog is None:
            return
        with contextlib.suppress(WebError):  # then the link is lost, and the state says so
            if watchdog.stopped_it(web):
                raise ArmFault(
                    "arm",
                    "was stopped by its controller's watchdog: no beat of this computer reached "
                    f"it for {self._settings.watchdog_s:g} s; look at the network and the load",
                )

    def _give_up(self) -> None:
        """Stop what nobody follows any more; `stop` tells if it does not."""
        self._run.done = True
        with self._stopping, contextlib.suppress(ArmFault):
            if self._may_move:
                self._halt(self._run)

    def _has_stopped(self, since_s: float) -> bool:
        """Return whether no program runs, by a question asked after `since_s`."""
        status = self._status
        return status is not None and self._asked_s > since_s and status.execution == "stopped"

    def _fresh_since(self, host_ns: int) -> bool:
        last = self._stream.last
        return last is not None and last.host_ns > host_ns

    def _is_stale(self, sample: Sample) -> bool:
        return time.monotonic_ns() - sample.host_ns > SILENCE_S * 1e9

    def _seconds(self, run: Run) -> list[float]:
        """Return how long each segment takes, without its ramps."""
        places = [self._planned or run.path[0].to, *(segment.to for segment in run.path)]
        return [
            distance_mm(one, segment.to) / segment.speed_mm_s + PAUSE_S
            for one, segment in zip(places, run.path, strict=False)
        ]
