"""A network and a protocol that the tests of live detection share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.flows.conftest import write
from tests.flows.detect.detecting import model_in, short_slide


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return model_in(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def protocol(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("protocol") / "p.yaml", short_slide())
