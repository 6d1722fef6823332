"""Other packages' code: errors, exits and hangs of an import are one error."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from sliplab.protocols import plugins
from sliplab.protocols.plugins import PluginError, import_foreign

BAD = [
    ("import sys; sys.exit(3)", "ended with exit code 3"),
    ("raise SystemExit", "ended with exit code None"),
    ("raise RuntimeError('no licence')", "RuntimeError: no licence"),
    ("class Odd(BaseException): pass\nraise ValueError('a\\nb')", "ValueError: a b"),
    ("import nothing_of_this_name", "ModuleNotFoundError: No module named 'nothing_of"),
    ("", "has no attribute 'DRIVER'"),
    ("while True: pass", r"TimeoutError: it was not done after 0\.2 s"),
    (
        "import threading\nwhile True:\n    try: threading.Event().wait()\n"
        "    except Exception: break",
        "TimeoutError|has no attribute",
    ),
]


@pytest.mark.parametrize(("text", "said"), BAD)
def test_package_that_fails_exits_or_hangs_on_import_is_one_error(
    text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(plugins, "LONGEST_S", 0.2 if "while" in text else 60.0)
    name = f"lab_{tmp_path.name.replace('-', '_').replace('[', '_')}"
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.delitem(sys.modules, name, raising=False)  # pytest uses a folder's name again
    before = signal.getsignal(plugins._SIGNAL)
    with pytest.raises(PluginError, match=said) as caught:
        import_foreign(f"{name}:DRIVER")
    assert "\n" not in str(caught.value)
    assert signal.getsignal(plugins._SIGNAL) is before
    assert all(thread.name != "limit of an import" for thread in threading.enumerate())


def test_package_that_imports_gives_its_attribute(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_good_one.py").write_text("DRIVER = 5")
    assert import_foreign("lab_good_one:DRIVER") == 5


def test_interrupt_during_an_import_is_passed_on(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_stopped.py").write_text("raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        import_foreign("lab_stopped:DRIVER")


def test_handler_that_a_library_has_set_for_alarms_stays() -> None:
    code = (
        "import ctypes, os, signal\n"
        "from sliplab.protocols.plugins import import_foreign\n"
        "ctypes.CDLL(None).signal(int(signal.SIGALRM), ctypes.c_void_p(1))  # ignored\n"
        "import_foreign('json:loads')\n"
        "os.kill(os.getpid(), signal.SIGALRM)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
