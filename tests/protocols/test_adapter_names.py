"""Wrong names of an adapter's entries are shown: they are no secrets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols.adapter import load_adapter
from sliplab.protocols.errors import InputError

TABLE = {"files": "x", "format": "csv", "unit": "s", "columns": {"t": "t", "value": "v"}}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"fields": {"stem": {}}}, "fields.stem: is no right name: is a field that every trial"),
        ({"fields": {"my key": {}}}, "fields.my key: is no right name: match pattern"),
        ({"streams": {"scalars": {"Key": TABLE}}}, "streams.scalars.Key: is no right name: "),
        ({"factors": {"key": {"field": 7}}}, "factors.key.field = 7: must be text"),
    ],
)
def test_wrong_name_is_shown(tmp_path: Path, sections: dict[str, Any], message: str) -> None:
    made = {"adapter": 1, "name": "a", "experiment": "classes", "trials": {"files": "x"}}
    made |= {"streams": {"scalars": {"s": TABLE}}, **sections}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(made))
    with pytest.raises(InputError) as caught:
        load_adapter(tmp_path / "a.yaml")
    assert message in caught.value.message
    assert "****" not in caught.value.message
    assert "[key]" not in caught.value.message
