"""A rearranged project prints, sends and computes as its golden files say. New options and keys may join."""

import pins
import pytest
from ended import Ended
from seeded_faults import FAULTS, ROOT

FAILED = {"version", "exit", "error", "exit_code"}


def test_every_command_is_pinned_and_its_options_keep_their_names_types_and_defaults():
    now = pins.options()
    assert set(pins.golden("options")) == set(now), "pins.py write options"
    for words, before in pins.golden("options").items():
        assert before.items() <= now[words].items(), words


@pytest.mark.parametrize("words", sorted(pins.golden("options")))
def test_a_command_that_fails_prints_the_same_keys(command_line, words):
    ended: Ended = command_line(*words.split(), "--no-such-option", "--json")
    assert (ended.code, set(ended.told)) == (2, FAILED)


def test_contract_rigs_send_the_same_bytes():
    assert pins.wire() == pins.golden("wire")


def same(value, before):
    """Assert that two JSON values differ by `TOLERANCE` of a figure at most."""
    if isinstance(before, dict):
        for key, each in before.items():
            same(value[key], each)
    elif isinstance(before, list):
        assert len(value) == len(before)
        for one, other in zip(value, before, strict=True):
            same(one, other)
    elif isinstance(before, float):
        assert value == pytest.approx(before, rel=pins.TOLERANCE, abs=pins.TOLERANCE)
    else:
        assert value == before


def test_figures_are_the_same():
    same(pins.figures(), pins.golden("figures"))


def test_every_seeded_fault_can_still_be_made():
    assert not [each for each in FAULTS if (ROOT / "sfms_robot" / each.file).read_text().count(each.old) != 1]
