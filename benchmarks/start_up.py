"""From the command `sliplab collect` to the first motion of a mock rig.

Run as a module it is the command line, but for one thing: when the arm is commanded to move for the
first time it says when that was, and ends.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.measure import Seconds

ROOT = Path(__file__).parent.parent
LIMIT_S = 300


def startup_seconds(runs: int, protocol: str = "pilot", rig: str = "mock") -> Seconds:
    """Seconds of each run, each in a new store, after one that does not count."""
    taken = []
    for number in range(runs + 1):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            command = [
                *(sys.executable, "-m", "benchmarks.start_up", "collect"),
                *(str(ROOT / "protocols" / f"{protocol}.yaml"), "--rig", rig),
                *("--store", str(Path(folder) / "store"), "--trials", "1"),
            ]
            environment = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_")}
            began = time.monotonic_ns()
            done = subprocess.run(
                command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, timeout=LIMIT_S
            )
            if not done.stdout.strip().isdigit():
                raise RuntimeError(f"the arm was never commanded to move ({done.returncode})")
            if number:
                taken.append((int(done.stdout) - began) / 1e9)
    return taken


def main() -> None:
    """The command line up to the first motion."""
    from importlib.abc import MetaPathFinder
    from importlib.util import find_spec

    class _Watch(MetaPathFinder):
        """Puts the watch in place when the arm's module is imported, not earlier."""

        def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
            """As without it, but for the one module."""
            if name != "sliplab.plugins.simulation.arm":
                return None
            sys.meta_path.remove(self)
            found: Any = find_spec(name)
            load = found.loader.exec_module

            def loaded(module: Any) -> None:
                load(module)
                module.MockArm.start = _moved

            found.loader.exec_module = loaded
            return found

    sys.meta_path.insert(0, _Watch())
    from sliplab.flows.__main__ import main as command_line

    command_line()


def _moved(*motion: object, **options: object) -> None:
    """The arm was commanded to move."""
    os.write(1, f"{time.monotonic_ns()}\n".encode())
    os._exit(0)


if __name__ == "__main__":
    main()
