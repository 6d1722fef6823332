"""A slip archive of two simulated campaigns and, if you downloaded it, a public data set.

    python make.py ARCHIVE [DOWNLOADED]

`DOWNLOADED` is the folder or archive of an adapter's data set, by default of `../ev-objects`: its
README says where to get it. It has classes in place of onsets. Ask its authors for a licence before
you pass the archive on.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parent.parent
CAMPAIGNS = ("pilot", "gravity")


def run(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "sliplab", *map(str, words)], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("archive", type=Path, help="folder to write; the store is beside it")
    parser.add_argument("downloaded", type=Path, nargs="?", help="data set of the adapter")
    parser.add_argument(
        "--adapter", type=Path, default=EXAMPLES / "ev-objects" / "adapter.yaml", help="YAML file"
    )
    parser.add_argument("--trials", type=int, default=4, help="of each simulated campaign")
    chosen = parser.parse_args()
    store = chosen.archive.with_name(f"{chosen.archive.name}-store")
    for protocol in CAMPAIGNS:
        run(
            "collect", protocol, "--rig", "rehearsal", "--store", store, "--trials", chosen.trials,
            "--no-stopping",
        )  # fmt: skip
    if chosen.downloaded is not None:
        run("import", "--adapter", chosen.adapter, chosen.downloaded, "--store", store)
    run("label", store)
    run("export", store, "--as", "archive", "--output", chosen.archive, "--title", "Slips")


if __name__ == "__main__":
    main()
