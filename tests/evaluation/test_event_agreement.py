"""What people did agrees with itself; what is late, missing or small is found to be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.corpora.clips import Dyad
from sfms_robot.evaluation.event_agreement import event_agreement, pairs_within
from sfms_robot.frames import CHANNEL_INDEX, ListenerEvent

STARTS_S = (2.0, 5.0, 9.0, 13.0)


def nodding(size: float = 0.1, late_s: float = 0.0, starts_s=STARTS_S) -> np.ndarray:
    motion = np.zeros((450, 58), np.float32)
    times_s = (1 + np.arange(450)) * 0.04
    for start_s in starts_s:
        since = times_s - start_s - late_s
        during = (since >= 0) & (since < 0.6)
        motion[:, CHANNEL_INDEX["pitch"]] += during * size / 2 * (1 - np.cos(2 * np.pi * since / 0.6))
    return motion


def dyad() -> Dyad:
    events = tuple(ListenerEvent("nod", start, 0.6, 0.1) for start in STARTS_S)
    motion = nodding()
    return Dyad("a", None, motion * 0, motion, np.ones(len(motion), bool), events=events)


def test_people_agree_with_themselves():
    found = event_agreement([dyad().listener], [dyad()])["nod"]
    assert found.asked == 4 and found.recall == found.precision == found.people_recall == 1.0
    assert found.size_ratio == 1.0


def test_nods_that_are_small_or_late_or_too_many_are_told():
    assert event_agreement([nodding(0.05)], [dyad()])["nod"].size_ratio == pytest.approx(0.5, abs=0.03)
    late = event_agreement([nodding(late_s=0.2)], [dyad()])["nod"]
    assert late.recall == 0.0 and late.people_recall == 1.0
    more = event_agreement([nodding(starts_s=(*STARTS_S, 15.5))], [dyad()])["nod"]
    assert more.recall == 1.0 and more.precision == 0.8
    none = event_agreement([nodding() * 0], [dyad()])["nod"]
    assert none.recall == 0.0 and np.isnan(none.precision) and np.isnan(none.size_ratio)


TIMES = st.lists(st.floats(0, 10), max_size=7).map(sorted).map(np.array)


@given(TIMES, TIMES)
def test_pairs_are_the_same_from_both_sides_and_no_more_than_either(first, second):
    pairs = pairs_within(first, second, 0.5)
    assert pairs == pairs_within(second, first, 0.5) <= min(len(first), len(second))
    assert pairs_within(first, first, 0.5) == len(first)
