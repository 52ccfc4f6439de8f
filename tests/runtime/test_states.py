"""Every arrow of the states can be taken, and no other ever is."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.runtime.states import ARROWS, RunState, Situation, following

SITUATION = {
    "starting": Situation(eased_in=False),
    "idle": Situation(),
    "listening": Situation(person=True),
    "speaking": Situation(person=True, speaking=True),
    "degraded": Situation(person=True, lost=("voice",)),
    "halted": Situation(halted=("key",)),
    "stopping": Situation(ending=True),
}
situations = st.builds(
    Situation,
    eased_in=st.booleans(),
    person=st.booleans(),
    speaking=st.booleans(),
    lost=st.sampled_from([(), ("voice",), ("listener", "yaw")]),
    halted=st.sampled_from([(), ("key",), ("key", "page")]),
    ending=st.booleans(),
)


@pytest.mark.parametrize(("before", "after"), sorted(ARROWS))
def test_every_arrow_is_taken_by_what_causes_it(before: str, after: str) -> None:
    state = following(RunState(), SITUATION[before], 1.0)
    assert state.name == before
    if after in ("stopped", "fault"):
        ended = state.ended(2.0, "the supply is gone" if after == "fault" else None)
    else:
        ended = following(state, SITUATION[after], 2.0)
    assert ended.name == after and ended.since_s == 2.0


@given(st.lists(situations, min_size=2, max_size=30))
def test_no_arrow_is_taken_that_the_table_does_not_have(path: list[Situation]) -> None:
    state = RunState()
    for now_s, situation in enumerate(path, 1):
        after = following(state, situation, float(now_s))
        assert after.name == state.name or (state.name, after.name) in ARROWS
        assert (after.since_s == now_s) == (after.name != state.name)
        state = after


@given(st.lists(situations, min_size=1, max_size=10), st.booleans())
def test_what_is_said_is_so(path: list[Situation], failed: bool) -> None:
    """A halt goes before everything but the end; what is lost is named; the end is final."""
    state = RunState()
    for now_s, situation in enumerate(path, 1):
        state = following(state, situation, float(now_s))
        if situation.halted and state.name != "stopping":
            assert (state.name, state.why) == ("halted", situation.halted)
        if state.name == "degraded":
            assert state.why == situation.lost != ()
        if state.name in ("listening", "speaking", "idle"):
            assert not situation.lost and state.doing == state.name
    over = following(state, Situation(ending=True), 99.0).ended(100.0, "gone" if failed else None)
    assert over.name == ("fault" if failed else "stopped")
    assert following(over, Situation(person=True), 101.0) == over


def test_the_page_on_safety_has_every_arrow_with_its_cause_and_its_longest_time() -> None:
    page = (Path(__file__).parents[2] / "docs" / "safety.md").read_text(encoding="utf-8")
    _, _, section = page.partition("## States of a run")
    names = {name for arrow in ARROWS for name in arrow}
    told = set()
    for line in section.partition("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and " to " in cells[0]:
            left, _, right = cells[0].partition(" to ")
            befores, afters = (re.findall(r"[a-z]+", side) for side in (left, right))
            assert cells[1] and cells[2], line
            told |= {(a, b) for a in befores for b in afters if a != b and {a, b} <= names}
    assert told == ARROWS


def test_states_follow_one_another_in_time() -> None:
    state, seen = RunState(), []
    for now_s, name in enumerate(("starting", "idle", "listening", "degraded", "speaking", "halted", "starting"), 1):
        state = following(state, SITUATION[name], float(now_s))
        seen.append(state.since_s)
    assert all(a <= b for a, b in pairwise(seen))
