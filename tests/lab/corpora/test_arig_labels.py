"""State labels: one state per frame, one that its voices allow, and the cases that the rule is made of."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sfms_robot.config.listener import STATES
from sfms_robot.lab.corpora.conversational_states import STATE, short_answers, states_of, states_of_activity

# (agent speaks, user speaks) that a state may have.
PATTERNS = {
    "speaking": frozenset({(True, False)}),
    "listening": frozenset({(False, True)}),
    "receiving_feedback": frozenset({(True, True), (False, True)}),
    "thinking": frozenset({(False, False)}),
    "interrupted": frozenset({(True, True)}),
    "waiting": frozenset({(False, False)}),
    "giving_feedback": frozenset({(True, False), (True, True), (False, True)}),
}
MASKS = st.integers(0, 60).flatmap(lambda n: arrays(bool, (5, n)))


def mask(text: str) -> np.ndarray:
    return np.array([c == "x" for c in text])


def said(agent: str, user: str, agent_feedback: str = "", user_feedback: str = "", nods: str = "") -> list[str]:
    tracks = [mask(text.ljust(len(agent), ".")) for text in (agent, user, agent_feedback, user_feedback, nods)]
    return [STATES[state] for state in states_of(*tracks)]


def test_every_state_has_a_pattern_and_every_pattern_a_state():
    assert set(PATTERNS) == set(STATES)
    assert frozenset.union(*PATTERNS.values()) == {(a, b) for a in (True, False) for b in (True, False)}


@given(MASKS)
def test_every_frame_has_one_state_that_its_voices_allow_and_swapping_who_speaks_swaps_it(masks):
    states = states_of(*masks)
    assert states.shape == masks[0].shape
    for state, agent, user in zip(states, masks[0], masks[1], strict=True):
        assert (bool(agent), bool(user)) in PATTERNS[STATES[state]]
    agent, user = masks[0] & ~masks[1], masks[1] & ~masks[0]
    never = np.zeros_like(agent)
    ours, theirs = states_of(agent, user, never, never, never), states_of(user, agent, never, never, never)
    assert np.array_equal(ours == STATE["speaking"], theirs == STATE["listening"])
    silent = np.zeros_like(masks[0])
    assert (states_of(silent, silent, *masks[2:]) == STATE["waiting"]).all()


def test_a_pause_inside_the_own_turn_is_thinking_and_any_other_is_waiting():
    assert said("x..x..", "......") == ["speaking", "thinking", "thinking", "speaking", "waiting", "waiting"]
    assert said("x.....", "...x..") == ["speaking", "waiting", "waiting", "listening", "waiting", "waiting"]


def test_feedback_does_not_take_the_floor():
    found = said("x....x", "..x...", user_feedback="..x...")
    assert found == ["speaking", "thinking", "receiving_feedback", "thinking", "thinking", "speaking"]


def test_an_answer_while_the_agent_speaks_is_received_and_anything_else_interrupts():
    assert said("xxx", ".x.", user_feedback=".x.")[1] == "receiving_feedback"
    assert said("xxx", ".x.")[1] == "interrupted"


def test_words_and_nods_give_feedback():
    assert said(".x.", "xxx", agent_feedback=".x.")[1] == "giving_feedback"
    assert said("...", "xxx", nods=".x.") == ["listening", "giving_feedback", "listening"]
    assert said(".x.", "x.x", agent_feedback=".x.")[1] == "giving_feedback"


@pytest.mark.parametrize(("frames", "answer"), [(24, True), (25, False)])
def test_without_dialogue_acts_short_words_in_the_others_turn_are_answers(frames, answer):
    other, active = np.ones(100, bool), np.zeros(100, bool)
    active[40 : 40 + frames] = True
    assert short_answers(active, other).any() == answer and not short_answers(active, ~other).any()


def test_activity_alone_is_labelled_too():
    found = states_of_activity(mask("xxxx...."), mask("....xxxx"))
    assert [STATES[state] for state in found] == ["speaking"] * 4 + ["listening"] * 4
