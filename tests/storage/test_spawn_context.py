"""Worker processes start without the script that started them."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from sliplab.storage.spawn_context import WORKERS, MainModuleError, check_work, refuse_main
from tests.conftest import ROOT

SCRIPT = """
import operator
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

with Path(sys.argv[1]).open("a") as log:
    log.write("moved\\n")

from sliplab.storage.spawn_context import WORKERS, check_work

with ProcessPoolExecutor(2, WORKERS) as pool:
    print(pool.submit(operator.add, 1, 2).result(60))
process = WORKERS.Process(target=print, args=("in a process",))
process.start()
process.join(60)
print(process.exitcode)


def rule(trial):
    return trial


class Detector:
    pass


for work in (rule, Detector(), [Detector]):
    try:
        check_work(work)
    except TypeError as error:
        print(str(error).partition(":")[0])
"""


@pytest.mark.parametrize("how", ["file", "module"])
def test_worker_does_not_run_the_script_again(how: str, tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    script = [str(tmp_path / "script.py")] if how == "file" else ["-m", "script"]
    line = (sys.executable, *script, str(tmp_path / "log"))
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    words = ["3", "in a process", "0", "rule", "Detector", "Detector"]
    assert done.stdout.splitlines() == words
    assert (tmp_path / "log").read_text() == "moved\n"


def test_main_module_is_unchanged_after_a_start() -> None:
    main = sys.modules["__main__"]
    before = main.__spec__
    with ProcessPoolExecutor(1, WORKERS) as pool:
        assert pool.submit(abs, -1).result(60) == 1
    assert main.__spec__ is before


def test_work_of_a_module_is_accepted() -> None:
    check_work(partial(refuse_main, "numpy"), [Path("trial"), 1.5])
    with pytest.raises(MainModuleError, match="rule: is defined in the script that runs"):
        refuse_main("__main__", "rule")


def test_packages_start_processes_only_as_workers() -> None:
    sources = [
        path
        for package in ("sliplab", "protocols", "storage", "rigs", "analysis", "flows")
        for path in (ROOT / package).rglob("*.py")
        if path.name != "spawn_context.py"
    ]
    others = ("get_context(", "multiprocessing.Process", "multiprocessing.Pool", "import Pool")
    assert len(sources) > 300
    found = [path for path in sources if any(word in path.read_text() for word in others)]
    assert found == []
