"""Values in messages: as a person wrote them, in one line, without secrets and control codes."""

from __future__ import annotations

import re
from datetime import date
from decimal import Decimal
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from sliplab.protocols.errors import InputError
from sliplab.protocols.model import Protocol
from sliplab.protocols.shown import MASK, is_secret, plural, printable, shown, shown_key
from sliplab.protocols.yaml_file import mask_secrets, parse_yaml, without_secrets
from sliplab.rigs.core.registry import listed, load_driver
from sliplab.rigs.rig_file import RigFile
from tests.conftest import ROOT
from tests.protocols.planning import rows

NAMES = """password passwrd pasword passord paswrd Passwort pass pwd passphrase secret secrt token
client_secret tokn api_key apiKey key auth credentials AWS_SECRET_ACCESS_KEY"""
SECRETS = NAMES.split()


@pytest.mark.parametrize("name", SECRETS)
def test_names_of_secrets(name: str) -> None:
    assert is_secret(name)
    error = InputError("rig.yaml", f"devices.arm.{name}", "hunter2", "is 'hunter2': unknown key")
    assert error.message == f"rig.yaml: devices.arm.{name} = {MASK}: is '{MASK}': unknown key"
    text = f"{{arm: [{{{name}: {MASK}, n: 2.4}}]}}"
    assert shown({"arm": [{name: "hunter2", "n": Decimal("2.4")}]}) == text


def _names(kind: Any, seen: set[Any]) -> set[str]:
    """Names of all keys of a file's model."""
    found: set[str] = set()
    if isinstance(kind, type) and issubclass(kind, BaseModel) and kind not in seen:
        seen.add(kind)
        for name, field in kind.model_fields.items():
            found |= {field.alias or name} | _names(field.annotation, seen)
    for part in get_args(kind):
        found |= _names(part, seen)
    return found


def test_no_other_key_of_our_files_counts_as_a_secret() -> None:
    names = _names(Protocol, set()) | _names(RigFile, set())
    for item in listed().values():
        names |= _names(load_driver(item).settings, set())
    assert len(names) > 300
    assert {name for name in names if is_secret(name)} == {"password"}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (Decimal("2.4"), "2.4"),
        ([Decimal("2.40"), 1, True], "[2.40, 1, true]"),
        ((), "[]"),
        ({"a": {"b": None}}, "{a: {b: null}}"),
        (date(2026, 11, 23), "2026-11-23"),
        (Decimal("Infinity"), ".inf"),
        ([float("-inf"), float("nan")], "[-.inf, .nan]"),
        ("two\nlines\x1b[31m", "two lines\\x1b[31m"),
        ("password: hunter2", f"password: {MASK}"),
        ("user=a password=hunter2", f"user=a password={MASK}"),
        ("http://anna:hunter2@host/x", f"http://anna:{MASK}@host/x"),
        ("x" * 201, "x" * 197 + "..."),
    ],
)
def test_values_as_yaml_writes_them(value: object, text: str) -> None:
    assert shown(value) == text


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.decimals(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)
SEEN = re.compile(r"[^\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]*")


@given(st.text(), st.text(), JSON, st.text())
def test_no_message_steers_a_terminal(file: str, key: str, value: object, expected: str) -> None:
    error = InputError(file, key, value, expected)
    assert SEEN.fullmatch(error.message)
    again = error.replaced(file=file)
    assert again.message == error.message
    assert "Decimal(" not in shown(value).replace(str(value), "")


@given(st.text())
def test_text_for_people_keeps_its_lines(text: str) -> None:
    left = printable(text)
    assert SEEN.fullmatch(left.replace("\n", "").replace("\t", ""))
    assert left.count("\n") == text.count("\n")
    assert printable(left) == left


@given(st.sampled_from(SECRETS), st.text(min_size=8, alphabet="abc123"), st.sampled_from(":="))
def test_a_secret_in_a_key_is_masked(name: str, secret: str, sign: str) -> None:
    assert secret not in shown_key(f"devices.arm.{name}{sign}{secret}")


def test_long_text_is_shown_at_once() -> None:
    for text in ("x" * 10**6, "a: " * 300_000, "://" * 300_000, "a" * 10**6 + ": b"):
        assert len(shown(text)) == 200
        assert len(shown_key(text)) <= 1000


WRITTEN = """hunter2 | 'hunter2' | "hunter2" | |-\n    hunter2\n    hunter2 | >\n    hunter2
 | hunter2 hunter2 | !!str hunter2 | 12345 | [hunter2, 1] | {a: hunter2} | &x hunter2"""


@pytest.mark.parametrize("value", re.split(r"\s\| ", WRITTEN))
def test_a_file_without_its_secrets(value: str) -> None:
    text = f"# a rig\narm:\n  passwrd: {value}\n  port: 5  # kept\nlist: [{{token: {'7' * 9}}}]\n"
    assert mask_secrets(text) == (
        f'# a rig\narm:\n  passwrd: "{MASK}"\n  port: 5  # kept\nlist: [{{token: "{MASK}"}}]\n'
    ).replace("!", "")
    assert mask_secrets(mask_secrets(text)) == mask_secrets(text)
    read = without_secrets(parse_yaml(mask_secrets(text), "rig.yaml"))
    assert read == {"arm": {"port": 5}, "list": [{}]}


def test_a_file_without_secrets_stays_as_it_is() -> None:
    for path in (*(ROOT / "rigs").glob("*.yaml"), *(ROOT / "protocols").glob("*.yaml")):
        if path.stem != "irb120":
            assert mask_secrets(path.read_text()) == path.read_text()


def test_sections_called_key_hold_no_secret() -> None:
    error = InputError("adapter.yaml", "factors.key.field", 7, "must be text")
    assert error.message == "adapter.yaml: factors.key.field = 7: must be text"
    assert MASK in InputError("rig.yaml", "devices.arm.key", "hunter2", "is unknown").message
    assert MASK in InputError("rig.yaml", "devices.auth.user", "hunter2", "is unknown").message


SHOWN = """
    collection.factors.grip_key.values[0] | 99 mm | 99 mm
    collection.context.wear_token.levels[1] | soft | soft
    collection.references.condition.grip_key | 2.4 mm | 2.4 mm
    streams.house_keys.device.port | 5 | 5
    collection.factors | {grip_key: {unit: mm}} | {grip_key: {unit: mm}}
    trial | grip_key=2.8mm,wear_token=soft,r=1 | grip_key=2.8mm,wear_token=soft,r=1
    collection.factors.grip_key | hunter2 | ****
    streams.api_key | hunter2 | ****
    streams.client_secret.port | hunter2 | ****
    streams.house_keys.token | hunter2 | ****
    streams | {api_key: hunter2} | {api_key: ****}
    devices.arm.grip_key | 99 mm | ****
    trial | password=hunter2,r=1 | password=****
    trial | api_key=hunter2, r=1 | api_key=****
"""


@pytest.mark.parametrize(("key", "value", "text"), rows(SHOWN))
def test_a_name_that_a_user_gives_is_no_secrets(key: str, value: str, text: str) -> None:
    read = parse_yaml(f"a: {value}", "a.yaml")["a"]
    assert shown(read, key) == text
    if "=" in value:
        assert shown_key(f"trials.{value}") == f"trials.{text}"


def test_a_stream_that_is_named_like_a_secret_is_copied_without_its_secrets() -> None:
    text = "streams: {house_keys: {port: 5, token: 12345}, api_key: hunter2}\n"
    masked = text.replace("12345", f'"{MASK}"').replace("hunter2", f'"{MASK}"')
    assert mask_secrets(text) == masked
    assert without_secrets(parse_yaml(text, "rig.yaml")) == {"streams": {"house_keys": {"port": 5}}}


def test_plural_of_one_has_no_ending() -> None:
    counts = [plural(n, noun) for n, noun in ((0, "trial"), (1, "trial"), (2, "missing trial"))]
    assert counts == ["0 trials", "1 trial", "2 missing trials"]
    assert [plural(2, noun) for noun in ("touch", "box")] == ["2 touches", "2 boxes"]
