"""Are the fast network's spike counts Sinabs' own on as many windows as one likes?

    python -m benchmarks.spike_equality STORE MODEL 100000

takes the samples that `sliplab train` keeps in the store, counts the output spikes of each by
Sinabs' layers and by the event-driven network, and prints how many differ as one line of JSON.
Exit 1 where one does. tests/analysis/networks/test_spiking.py does the same on few windows and on
extremes.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch

from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.network import exact, matrices, spike_counts
from sliplab.analysis.networks.training import restore
from sliplab.analysis.windows.dataset import SampleSet

PART = 2048


def compare(samples: list[SampleSet], model: Path, most: int) -> dict[str, int | bool]:
    """Return how many of the first `most` windows differ."""
    # waiting for each other, Sinabs' threads take longer beside other work
    torch.set_num_threads(1)
    fitted = model_file.load(model)
    net, fast = restore(fitted), fitted.engine
    compared = differ = with_spikes = 0
    for part in samples:
        for start in range(0, len(part), PART):
            rows = np.arange(start, min(start + PART, len(part), start + most - compared))
            windows = part.windows.take(rows)
            expected = spike_counts(net, windows.dense())
            differ += int((fast.counts(windows) != expected).any(axis=1).sum())
            with_spikes += int(expected.any(axis=1).sum())
            compared += len(rows)
            print(f"{compared} windows, {differ} differ", file=sys.stderr)
            if compared >= most:
                break
    return {
        "windows": compared,
        "with_spikes": with_spikes,
        "differ": differ,
        "exact_by_arithmetic": exact(matrices(net)),
    }


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.spike_equality")
    parser.add_argument("store", type=Path)
    parser.add_argument("model", type=Path, help="such as STORE/models/seed0.pt")
    parser.add_argument("most", type=int, help="windows")
    asked = parser.parse_args()
    paths = sorted((asked.store / "derived" / "samples").glob("*.arrays"))
    found = compare([SampleSet.load(path) for path in paths], asked.model, asked.most)
    print(json.dumps(found))
    return int(found["differ"] > 0)


if __name__ == "__main__":
    sys.exit(main())
