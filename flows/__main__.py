"""Entry point of the program: runs the command line, maps errors to messages and exit codes.

Almost nothing is imported before `main`, so that import failures for lack of
memory or open files are reported in one line as well.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import sys
import threading
from contextlib import suppress

_PROGRAM = __name__ == "__main__" or sys.argv[0].endswith("/sliplab")
# it imports the program of its parent, with the same arguments
_WORKER = "--multiprocessing-fork" in sys.orig_argv
if _PROGRAM and not _WORKER and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # no traceback from a module that is just imported; the code is `exit_codes.INTERRUPTED`,
    # which is not imported yet
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from sliplab.flows.running import exit_codes  # noqa: E402
from sliplab.flows.running.process import exhausted, run_in_child, too_few_threads  # noqa: E402

END_LIMIT_S = 1.0
"""Longest wait for semaphores to be removed when the program ends at once, s."""


def main() -> None:
    """Run the command line; ends the process with its exit code."""
    own = getattr(sys.modules["__main__"], "main", None) is main  # not called by another program
    if own:
        _end_on_signals()
    if reason := too_few_threads() or run_in_child():
        sys.exit(_fail(reason, exit_codes.FAILED))
    try:
        from sliplab.flows.running.process import OutputLost, collect_garbage_seldom, guarded

        collect_garbage_seldom()
        try:
            with guarded():
                code = _run()
        except OutputLost as error:  # of output still to be written
            code = exit_codes.UNREAD if error.unread else _fail(str(error), exit_codes.FAILED)
    except KeyboardInterrupt:
        code = _fail("interrupted", exit_codes.INTERRUPTED)
    except (ImportError, MemoryError, OSError, SystemError) as error:
        code = _fail(exhausted(error) or f"{type(error).__name__}: {error}", exit_codes.FAILED)
    if own:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: _end(code))  # all messages are printed
    orchestration = sys.modules.get("sliplab.flows.running.orchestration")
    if orchestration is not None and not orchestration.close():
        _end(code)
    sys.exit(code)


def _end(code: int) -> None:
    """End the program at once.

    Semaphores of worker processes are removed first: their tracker would report a leak.
    """
    util = sys.modules.get("multiprocessing.util")
    if util is not None:
        with suppress(RuntimeError):  # no thread can be started
            # in a thread: the main one may hold a lock that is needed
            cleaning = threading.Thread(target=util._run_finalizers, args=(0,), daemon=True)
            cleaning.start()
            cleaning.join(END_LIMIT_S)
    os._exit(code)


def _end_on_signals() -> None:
    """End the program at once on a signal before it has begun or after its last message.

    A signal while the interpreter is taken down, when all is done, changes no exit code.
    """

    def end(*_: object) -> None:
        stopping = sys.modules.get("sliplab.flows.running.stopping")
        requested = getattr(stopping, "requested", None)  # it may just be imported
        known = requested and requested()
        _end(exit_codes.INTERRUPTED if known else _fail("interrupted", exit_codes.INTERRUPTED))

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # such as SIGHUP under nohup
            signal.signal(number, end)
        # registered first, called last; of an ignored signal the interpreter restores nothing
        atexit.register(signal.signal, number, signal.SIG_IGN)


def _run() -> int:
    from sliplab.flows.running import console, stopping

    console.begin(as_json="--json" in sys.argv[1:])
    with stopping.signals():
        from sliplab.flows.cli import errors

        try:
            from sliplab.flows.cli.app import command_line

            code = command_line(sys.argv[1:])(standalone_mode=False)
            if code == exit_codes.INTERRUPTED:
                _ignore_signals()
                return errors.interruption().report()
            return code if isinstance(code, int) else exit_codes.DONE
        except KeyboardInterrupt:
            _ignore_signals()
            return errors.interruption().report()
        except Exception as error:
            return _explain(error)


def _ignore_signals() -> None:
    """Ignore signals until `stopping.signals` ends, while the message about the stop is printed."""
    from sliplab.flows.running import stopping

    if threading.current_thread() is threading.main_thread():
        for number in stopping.SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _explain(error: Exception) -> int:
    """Report the error that ended the command; return the exit code."""
    from sliplab.flows.cli import errors
    from sliplab.flows.running import stopping
    from sliplab.protocols.errors import InputError

    if stopping.requested() and not (isinstance(error, InputError) or errors.is_arm_fault(error)):
        _ignore_signals()
        return errors.interruption().report()
    return errors.failure(error).report()


def _fail(message: str, code: int) -> int:
    """Report in one line an error before or after normal error reporting is available."""
    stated = message if code == exit_codes.INTERRUPTED else f"error: {message}"
    with suppress(OSError):
        os.write(2, f"{stated}\n".encode(errors="backslashreplace"))
    console = sys.modules.get("sliplab.flows.running.console")
    if "--json" in sys.argv[1:] and not (console and console.printed()):
        known = {"file": None, "key": None, "value": None, "message": message, "exit_code": code}
        with suppress(OSError):
            os.write(1, f"{json.dumps({'error': known})}\n".encode())
    return code


if __name__ == "__main__":
    main()
