"""Units are data: one table, and more of them from installed packages."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
import yaml

from sliplab.protocols import InputError, Plan, load_plan, units
from sliplab.protocols.quantity import parse
from sliplab.protocols.units import TABLE, file_text, find_unit, symbols_of
from tests.conftest import ROOT, SMALL
from tests.packages import write_metadata
from tests.protocols.planning import plan_of, refused, rows, said_by

PRESSURE = '{"kPa": ("pressure", "1"), "Pa": ("pressure", "0.001"), "bar": ("pressure", "100")}'
INCH = '{"inch": ("length", "25.4"), "inch/s": ("speed", "25.4")}'


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Packages are looked for anew in each test, and forgotten after it."""
    units.forget_packages()
    yield
    units.forget_packages()


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Install a package with units: its module's text, what its entry point names, its name."""

    def installed(text: str, target: str = "{module}:UNITS", name: str = "lab_units") -> None:
        site = tmp_path / name
        write_metadata(site, name, {"sliplab.units": {name: target.format(module=name)}})
        (site / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(str(site))
        monkeypatch.delitem(sys.modules, name, raising=False)

    return installed


def changed(folder: Path, change: Any = None, enable: tuple[str, ...] = ()) -> Plan:
    data = copy.deepcopy(SMALL)
    if change is not None:
        change(data["collection"])
    return plan_of(data, folder, *enable)


def test_every_unit_has_a_dimension_and_an_exact_factor() -> None:
    assert len({each.symbol for each in TABLE}) == len(TABLE)
    firsts: dict[str, Decimal] = {}
    for each in TABLE:
        assert each.factor > 0
        firsts.setdefault(each.dimension, each.factor)
    assert set(firsts.values()) == {Decimal(1)}
    assert {"force", "temperature", "angle", "angular speed"} <= set(firsts)


def test_a_unit_becomes_text_that_a_file_name_may_hold() -> None:
    texts = [file_text(unit) for unit in ("mm", "mm/s", "percent", "deg/s", None)]
    assert texts == ["mm", "mmps", "pct", "degps", ""]


def in_micrometres(collection: dict[str, Any]) -> None:
    collection["factors"]["depth"] = {"unit": "um", "values": [2400, 2800, 3400]}
    speeds = {"from": 0.06, "to": 0.16, "step": 0.1}
    collection["factors"]["speed"] = {"unit": "cm/s", "range": speeds, "optional": [0.1]}


def test_a_factor_may_be_in_any_unit_of_its_dimension(tmp_path: Path) -> None:
    """Its levels, ids and hashes are those of the same levels in the canonical unit."""

    def in_millimetres(collection: dict[str, Any]) -> None:
        speeds = {"from": 0.6, "to": 1.6, "step": 1}
        collection["factors"]["speed"] = {"unit": "mm/s", "range": speeds, "optional": [1]}

    same = changed(tmp_path, in_millimetres)
    plan = changed(tmp_path, in_micrometres)
    assert list(plan) == list(same)
    assert plan.collection_hash == same.collection_hash
    assert "depth=2.4mm,direction=0deg,speed=0.6mmps,r=1" in {trial.id for trial in plan}
    more = changed(tmp_path, in_micrometres, ("speed=0.1cm/s",))
    assert list(more) == list(changed(tmp_path, in_millimetres, ("speed=1",)))


def test_a_reference_condition_is_in_the_unit_of_its_factor(tmp_path: Path) -> None:
    condition = {"depth": 2800, "speed": 0.16, "direction": 0}

    def change(collection: dict[str, Any]) -> None:
        in_micrometres(collection)
        collection["references"] = {"every": 10, "condition": condition}

    reference = changed(tmp_path, change).trials[0]
    assert reference.id == "reference,depth=2.8mm,direction=0deg,speed=1.6mmps,r=1"


def test_a_level_in_another_unit_is_held_against_the_limits(tmp_path: Path) -> None:
    def change(collection: dict[str, Any]) -> None:
        collection["factors"]["depth"] = {"unit": "um", "values": [2400, 3700]}

    with pytest.raises(InputError, match=r"3\.7 mm: exceeds collection\.limits\.depth") as caught:
        changed(tmp_path, change)
    assert caught.value.key == "collection.factors.depth.values[1]"


def test_a_package_brings_units_and_a_dimension(install: Any, tmp_path: Path) -> None:
    install(f"UNITS = {PRESSURE}\n", name="pressures")
    install(f"UNITS = {INCH}\n", name="inches")

    def change(collection: dict[str, Any]) -> None:
        collection["factors"]["depth"] = {"unit": "inch", "values": [0.1]}
        collection["motion"][1]["speed"] = "0.1 inch/s"
        collection["context"] = {"air": {"unit": "bar", "values": [1, 1.5]}}

    plan = changed(tmp_path, change)
    assert {dict(trial.condition)["depth"] for trial in plan} == {Decimal("2.54")}
    assert {plan.describe(trial)["air"] for trial in plan} == {"100 kPa", "150 kPa"}
    assert "air=150kPa,depth=2.54mm,direction=0deg,speed=0.6mmps,r=1" in {t.id for t in plan}
    press = next(step for step in plan.program(plan.trials[0]).steps if step.phase == "press")
    assert press.speed_mm_s == 2.54
    assert {"mm", "inch"} <= set(symbols_of("mm"))
    assert "air_kPa" in plan.table()


def test_nothing_is_imported_until_a_unit_is_unknown(
    install: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(f"UNITS = {INCH}\n", name="inches")
    changed(tmp_path)
    assert parse("2400 um", "mm") == Decimal("2.4")
    assert "inches" not in sys.modules
    assert find_unit("inch") is not None
    assert "inches" in sys.modules


BROKEN = """
    raise RuntimeError('no\\nlicence') | RuntimeError: no licence
    | has no attribute 'UNITS'
    elsewhere | No module named 'elsewhere'
    UNITS = 5 | must be a mapping of symbols, not int
    UNITS = {'furlong': 201168} | furlong: must be (dimension, decimal
    UNITS = {'a b': ('length', '1')} | a b: a symbol is letters
    UNITS = {'ell': ('length', 1.14)} | ell: must be (dimension, decimal
    UNITS = {'ell': ('length', '-1')} | must be more than 0
    UNITS = {'ell': ('length', 'nan')} | must be a finite number
    UNITS = {'mm': ('length', '2')} | mm: is a unit already
    UNITS = {'hPa': ('pressure', '0.1')} | pressure: has no unit of fac
"""


@pytest.mark.parametrize(("text", "says"), rows(BROKEN))
def test_a_broken_package_is_named_in_one_line(
    text: str, says: str, install: Any, tmp_path: Path
) -> None:
    install(*(("", "elsewhere:UNITS") if text == "elsewhere" else (text,)))
    install(f"UNITS = {INCH}\n", name="inches")
    data = copy.deepcopy(SMALL)
    data["collection"]["factors"]["depth"] = {"unit": "furlong", "values": [1]}
    error = refused(data, tmp_path)
    assert error.key == "collection.factors.depth.unit"
    assert "must be one of" in error.expected
    assert "the units of lab_units 1.0 cannot be used: " in error.expected
    assert says in error.expected
    assert "\n" not in error.message
    data["collection"]["factors"]["depth"] = {"unit": "inch", "values": [0.1]}
    assert len(plan_of(data, tmp_path)) == 12


def test_two_packages_may_not_disagree(install: Any, tmp_path: Path) -> None:
    install("UNITS = {'ell': ('length', '1143')}", name="one")
    install("UNITS = {'ell': ('length', '570')}", name="two")
    found = find_unit("ell")
    assert found is not None
    with pytest.raises(ValueError, match=r"must be one of.*ell: is a unit already"):
        parse("1 furlong", "mm")


def test_the_schema_for_editors_knows_units_of_packages(install: Any, tmp_path: Path) -> None:
    install(f"UNITS = {INCH}\n", name="inches")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'inches')!r})\n"
        "import json; from sliplab.flows.planning.json_schemas import file_schema\n"
        "print(json.dumps(file_schema('protocol')))"
    )
    models = json.loads(said_by(code))["definitions"]
    assert "inch" in models["Factor"]["properties"]["unit"]["enum"]
    assert "|inch)" in json.dumps(models["Press"]["properties"]["depth"])


WRITTEN = [
    ("values: [2.4, 2.8, 3.4]", "values: [2.4 mm, '2.80 mm', 0.34 cm]"),
    ("unit: mm, values: [2.4, 2.8, 3.4]", "unit: cm, values: [0.24, 2.8 mm, 0.34 cm]"),
]


@pytest.mark.parametrize("change", WRITTEN, ids=["canonical", "centimetres"])
def test_levels_with_and_without_unit_give_the_same_trials(tmp_path: Path, change: Any) -> None:
    text = (ROOT / "protocols" / "pilot.yaml").read_text()
    path = tmp_path / "pilot.yaml"
    path.write_text(text.replace(*change))
    ours, shipped = ([(t.id, t.seed) for t in load_plan(each)] for each in (path, Path("pilot")))
    assert ours == shipped


@pytest.mark.parametrize("level", ["2.4", "2.4 mm", "0.24 cm"])
def test_held_out_reference_and_claimed_levels_take_a_unit_or_none(
    tmp_path: Path, level: str
) -> None:
    data = copy.deepcopy(SMALL)
    given: Any = yaml.safe_load(f"[{level}]")
    data["analysis"]["split"] = {"method": "leave_conditions_out", "test_levels": {"depth": given}}
    condition = {"depth": given[0], "speed": 1, "direction": 0}
    data["collection"]["references"] = {"every": 9, "condition": condition}
    claim: dict[str, Any] = {"figure": "slip_duration", "at_most": "90 ms"}
    claim["between"] = {"factor": "depth", "levels": [*given, "3.4 mm"]}
    data["collection"]["stopping"] = {"claims": [claim]}
    plan = plan_of(data, tmp_path)
    analysis, collection = plan.protocol.analysis, plan.protocol.collection
    assert analysis.split.test_levels == {"depth": ("2.4 mm",)}
    assert collection.references.condition["depth"] == Decimal("2.4")
    between = collection.stopping.claims[0].between
    assert between.levels == (Decimal("2.4"), Decimal("3.4"))


def test_every_level_in_a_wrong_unit_is_named(tmp_path: Path) -> None:
    data = copy.deepcopy(SMALL)
    data["collection"]["factors"]["depth"]["values"] = ["2.4 s", 2.8, "3.4 kg"]
    error = refused(data, tmp_path)
    keys = [each.key for each in error.faults]
    assert keys == ["collection.factors.depth.values[0]", "collection.factors.depth.values[2]"]
    assert "must be one of: mm" in error.expected
