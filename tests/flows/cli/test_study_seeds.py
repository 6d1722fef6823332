"""Networks of a study: how many seeds it trains, and what it says of fewer."""

from __future__ import annotations

from pathlib import Path

import pytest

from sliplab.flows.cli.study import _note_seeds
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.study_defaults import NETWORKS, study_protocols


@pytest.mark.parametrize(("pilot", "trained"), [(True, 1), (False, NETWORKS)])
def test_study_with_few_seeds_says_that_others_would_differ(
    pilot: bool, trained: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    requests = [
        make_request(file, Path("rehearsal"), tmp_path / "store", enable=on)
        for file, on in study_protocols(pilot, extra=False).items()
    ]
    assert len(requests[0].plan.protocol.analysis.training.seeds) == trained
    _note_seeds(requests)
    said = " ".join("".join(capsys.readouterr()).split())
    assert ("Networks of other seeds have other figures" in said) == pilot
    assert ("this study trains 1" in said) == pilot
