"""What is read from a YAML file, and what is refused with its line."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config.base import DEEPEST, read, with_number
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError

SHIPPED = sorted(file for name in ("configs", "firmware_maps", "sim") for file in data_dir(name).rglob("*.yaml"))


def of(tmp_path, text):
    file = tmp_path / "head.yaml"
    file.write_text(text, encoding="utf-8")
    return read(file)


@pytest.mark.parametrize(
    ("scalar", "value"),
    [
        *((word, word) for word in ("yes", "no", "on", "off", "Yes", "NO", "y", "1:30", "2026-05-17", "1_000", "0x17")),
        ("true", True), ("FALSE", False), ("~", None), ("", None), ("0", 0), ("-17", -17), ("+5", 5), ("0.5", 0.5),
        (".5", 0.5), ("1e3", 1000.0), ("-1.5E-2", -0.015), (".inf", float("inf")), ("'023'", "023"),
    ],
)  # fmt: skip
def test_scalars_are_those_of_yaml_1_2(tmp_path, scalar, value):
    found = of(tmp_path, f"key: {scalar}\n")["key"]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize("number", ["023", "-01", "00", "09"])
def test_a_leading_zero_is_refused_with_its_line(tmp_path, number):
    with pytest.raises(ConfigError, match=rf"head.yaml:2: {number} has a leading zero: write {int(number)}"):
        of(tmp_path, f"name: a\nid: {number}\n")


@pytest.mark.parametrize("number", ["1" * 21, "-" + "1" * 4000, "1" * 5000, "0" + "1" * 5000])
def test_a_number_that_is_too_long_is_refused_with_its_line(tmp_path, number):
    with pytest.raises(ConfigError, match="^.*head.yaml:2: expected a whole number of up to 20 digits, got [-01]{8}"):
        of(tmp_path, f"name: a\nid: {number}\n")


@pytest.mark.parametrize(
    "text", ["joints: [", "a: \0", "[" * 5000 + "]" * 5000, "[" * 30_000, "- " * 5000, "{a: " * 5000]
)
def test_what_cannot_be_read_or_is_nested_too_deeply_is_one_line(tmp_path, text):
    with pytest.raises(ConfigError, match=rf"head.yaml(:\d)?: (nested more than {DEEPEST} levels deep|.*)") as caught:
        of(tmp_path, text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_shipped_files_mean_what_they_meant_to_yaml_1_1(file):
    assert read(file) == yaml.safe_load(file.read_text(encoding="utf-8"))


NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_]*", fullmatch=True)  # what keys and texts of our files are


@given(
    st.dictionaries(
        NAMES, st.one_of(st.integers(-(10**20) + 1, 10**20 - 1), st.booleans(), st.none(), NAMES, st.floats(width=32))
    )
)
def test_what_we_write_is_what_we_read(tmp_path_factory, value):
    text = yaml.safe_dump(value, allow_unicode=False)
    assert repr(of(tmp_path_factory.mktemp("yaml"), text)) == repr(yaml.safe_load(text))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("a: {b: {c: 1, d: 2}}  # why\n", "a: {b: {c: 7, d: 2}}  # why\n"),
        ("a: {b: {d: 2}}\n", "a: {b: {c: 7, d: 2}}\n"),
        ("a: {b: {}}\n", "a: {b: {c: 7, }}\n"),
        ("a: {x: 1}\n", "a: {b: {c: 7}, x: 1}\n"),
        ("# head\r\na:\r\n  x: \u00e9  # kept\r\n", "# head\r\na:\r\n  b: {c: 7}\n  x: \u00e9  # kept\r\n"),
        ("a:\n  b:\n    d: 2\n", "a:\n  b:\n    c: 7\n    d: 2\n"),
        ("a: {b: null}\n", "a: {b: {c: 7}}\n"),
        ("x: 1\n", "a: {b: {c: 7}}\nx: 1\n"),
    ],
)
def test_a_number_is_set_in_a_text_of_which_the_rest_stays(before, after):
    assert with_number(before, ("a", "b", "c"), 7) == after and yaml.safe_load(after)["a"]["b"]["c"] == 7
