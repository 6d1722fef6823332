"""LSL streams: real liblsl, a sender whose clock drifts and jumps."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from sliplab.plugins.record.lsl import ClockReading, JumpRemover, LslSettings
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import lsl
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.trials.store import TrialStore
from tests.plugins.record.lsl_clocks import available, recordings

pylsl = pytest.importorskip("pylsl")
from sliplab.plugins.record.lsl_fake import FakeLsl  # noqa: E402  (needs pylsl)

pytestmark = pytest.mark.skipif(not available(), reason="needs gcc and pylsl")


@pytest.mark.long
@pytest.mark.realtime
def test_events_lie_within_the_stated_bound_where_the_clock_drifts_and_jumps(
    tmp_path: Path,
) -> None:
    found = recordings(tmp_path, 8, seed=1)
    assert len(found) == 8
    known = [each for each in found if each.bound_us is not None]
    assert len(known) >= 7
    assert sum(each.within for each in known) >= len(known) - 1
    assert float(np.median([each.bound_us for each in known])) < 2000


def test_a_stream_that_nobody_sends_is_named(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="no stream of this name"):
        record([lsl("nobody", find_s=0.3)], tmp_path, "none").__enter__()


@pytest.mark.parametrize("jump_ns", [0, 300_000_000, -50_000_000])
def test_jumps_are_taken_out_at_the_sample_where_they_happened(jump_ns: int) -> None:
    """Readings each 2 s to 100 us, samples each 10 ms, a drift of 100 ppm, a jump at 7.005 s."""
    rng, remover = np.random.default_rng(3), JumpRemover()
    true_ns = np.arange(0, 20_000_000_000, 10_000_000)
    jumped = true_ns > 7_005_000_000
    stamp_ns = true_ns + true_ns // 10_000 + jump_ns * jumped
    host_ns = true_ns + rng.integers(100_000, 400_000, len(true_ns))
    found, before = [], None
    for at in range(0, 20_000_000_001, 2_000_000_000):
        device = at + at // 10_000 + (jump_ns if at > 7_005_000_000 else 0)
        reading = ClockReading(device, at - device + int(rng.integers(-50_000, 50_000)), 100_000)
        jump = remover.reading(reading)
        part = (true_ns >= at - 2_000_000_000) & (true_ns < at)
        found.append(remover.times(stamp_ns[part], host_ns[part], before, jump))
        remover.shift_ns += jump
        before = reading
    error_ns = np.concatenate(found) - (true_ns + true_ns // 10_000)
    assert np.abs(error_ns).max() <= remover.error_ns <= 300_000
    assert abs(remover.shift_ns - jump_ns) <= remover.error_ns


@pytest.mark.realtime
def test_stamps_that_fall_back_widen_the_bound_and_what_are_none_are_counted(
    tmp_path: Path,
) -> None:
    fake = FakeLsl(LslSettings(name="falling"))
    sent = 100
    try:
        with (
            record([lsl(fake.address["name"], "g")], tmp_path, "lsl") as recorder,
            recorder.trial(),
        ):
            for k in range(sent):
                threading.Event().wait(0.01)  # the sensor's period
                t_s = pylsl.local_clock() - (0.03 if k % 10 == 9 else 0.0)
                fake._outlet.push_sample(np.array([float(k)]), np.nan if k == 5 else t_s)
    finally:
        fake.close()
    (found,) = TrialStore.open(tmp_path).campaign("lsl").recordings()
    rows, about = found.record.streams["g"].rows, found.record.imported
    assert rows + about.dropped["rows of g that were lost"] == sent
    assert about.dropped["rows of g that were lost"] == 1
    times = found.samples("g")
    moved_ns = (times["t"] - times["stamp"]).max()
    assert found.clocks.streams["g"].uncertainty_ns >= moved_ns > 10e6
