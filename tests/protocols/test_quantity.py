"""Quantities are exact decimals in one unit a kind."""

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.protocols.quantity import canonical, level_order, parse, parse_or_ref, to_decimal
from sliplab.protocols.units import TABLE, Unit, canonical_of

decimals = st.decimals(
    min_value=-1000, max_value=1000, places=4, allow_nan=False, allow_infinity=False
)


WRITTEN = """2.4 mm = 2.4 mm; 2.40mm = 2.4 mm; 0.24 cm = 2.4 mm; 2400 um = 2.4 mm; 1e1 mm = 10 mm
; 50 ms  = 0.05 s; 205 g = 0.205 kg; 125 % = 125 percent; -.5 mm = -0.5 mm"""


@pytest.mark.parametrize("row", WRITTEN.split(";"))
def test_one_quantity_however_it_is_written(row: str) -> None:
    text, same = row.split(" = ")
    value, unit = same.split()
    assert canonical(parse(text, unit)) == value


NUMBER = ("2.4", "nan mm", "inf mm", "two mm", True, None)
LENGTHS = {2.4: "has no unit", "2.4 kg": "must be one of: mm, um, cm, m", "1e999 mm": "at most 1e9"}


@pytest.mark.parametrize(
    ("raw", "says"), [*LENGTHS.items(), *((raw, "number with a unit") for raw in NUMBER)]
)
def test_what_is_no_length_is_refused(raw: object, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        parse(raw, "mm")


@pytest.mark.parametrize("raw", [Decimal("NaN"), float("inf"), Decimal("-Infinity"), "x", True])
def test_numbers_must_be_finite_numbers(raw: object) -> None:
    with pytest.raises(ValueError, match="must be a"):
        to_decimal(raw)


@pytest.mark.parametrize("raw", ["1e1000000", "-1E+999999999999", Decimal("1e12")])
def test_no_number_is_too_large_to_be_refused(raw: object) -> None:
    with pytest.raises(ValueError, match="at most 1e9 in size"):
        to_decimal(raw)


@pytest.mark.parametrize("raw", ["1e-1000000", "-1e-41", "0E-99999999", 1e-300])
def test_no_number_is_too_long_to_be_written(raw: object) -> None:
    with pytest.raises(ValueError, match="at most 40 decimals"):
        to_decimal(raw)
    assert to_decimal("1e-40") > 0


@given(decimals)
def test_canonical_text_stands_for_one_value(value: Decimal) -> None:
    text = canonical(value)
    assert Decimal(text) == value
    assert text == canonical(Decimal(text)) == canonical(value * Decimal("1.000"))
    assert "E" not in text
    assert text != "-0"


@given(decimals.filter(lambda value: abs(value) <= 100), st.sampled_from(TABLE))
def test_units_convert_exactly(value: Decimal, unit: Unit) -> None:
    assert parse(f"{value} {unit.symbol}", canonical_of(unit)) == value * unit.factor


def test_a_reference_is_a_factors_name() -> None:
    assert str(parse_or_ref("$depth", "mm")) == "$depth"
    with pytest.raises(ValueError, match="factor's name"):
        parse_or_ref("$Depth!", "mm")


def test_levels_sort_by_their_number_and_words_last() -> None:
    levels = ["10 mm", "left", "2.4 mm", "", "-1 mm", "above"]
    assert sorted(levels, key=level_order) == ["-1 mm", "2.4 mm", "10 mm", "", "above", "left"]
