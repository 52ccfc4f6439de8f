"""States of a run, and the presence of a person."""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.runtime.states import ARROWS, GONE_S, TURN_GAP_S, Presence, RunState, Situation, following

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


SILENCE = np.zeros(FRAME_SAMPLES, np.float32)
NONE = np.zeros(0, np.float32)
RNG = np.random.default_rng(0)
FACE = FaceFrame(0.0, np.zeros(6, np.float32), np.zeros(52, np.float32))


def voice() -> Floats:
    return RNG.normal(0, 0.1, FRAME_SAMPLES).astype(np.float32)


def hum() -> Floats:
    return RNG.normal(0, 0.001, FRAME_SAMPLES).astype(np.float32)


class Room:
    """Frames one after the other."""

    def __init__(self) -> None:
        self.presence, self.now_s = Presence.start(), 0.0

    def goes_on(
        self, seconds: float, audio: object = hum, face: FaceFrame | None = None, says: Floats | None = None
    ) -> None:
        for _ in range(round(seconds / FRAME_S)):
            self.now_s += FRAME_S
            heard = audio() if callable(audio) else audio
            self.presence = self.presence.after(SpeakerFrame(self.now_s, heard, face, says))  # type: ignore[arg-type]


def test_a_voice_is_somebody_within_two_frames_and_hum_is_nobody() -> None:
    room = Room()
    room.goes_on(5.0)
    assert not room.presence.person(room.now_s)
    room.goes_on(2 * FRAME_S, voice)
    assert room.presence.person(room.now_s)


def test_a_face_alone_is_somebody_and_a_sound_card_that_gives_nothing_is_nobody() -> None:
    room = Room()
    room.goes_on(1.0, NONE)
    assert not room.presence.person(room.now_s)
    room.goes_on(FRAME_S, NONE, FACE)
    assert room.presence.person(room.now_s)


def test_who_is_neither_seen_nor_heard_is_gone_after_a_while_and_not_before() -> None:
    room = Room()
    room.goes_on(3.0)
    room.goes_on(2.0, voice)
    room.goes_on(GONE_S - 0.2)
    assert room.presence.person(room.now_s)
    room.goes_on(0.4)
    assert not room.presence.person(room.now_s)


def test_pauses_between_its_words_and_what_the_person_says_do_not_end_its_turn() -> None:
    room = Room()
    room.goes_on(1.0, says=voice())
    assert room.presence.speaking(room.now_s)
    room.goes_on(TURN_GAP_S - 0.1, voice, says=SILENCE)
    assert room.presence.speaking(room.now_s)
    room.goes_on(0.2, voice, says=SILENCE)
    assert not room.presence.speaking(room.now_s)


def test_a_face_that_is_lost_leaves_the_person_where_they_were_seen() -> None:
    place_m = np.array([1.0, 0.2, 0.0], np.float32)
    face = FaceFrame(0.9, FACE.pose, FACE.blendshapes)
    seen = Presence.start().after(SpeakerFrame(1.0, NONE, face, attention=0.5, place_m=place_m))
    assert (seen.watched.seen_s, seen.watched.attention) == (0.9, 0.5) and seen.watched.place_m is place_m
    assert seen.after(SpeakerFrame(1.04, NONE)).watched == seen.watched
    assert seen.after(SpeakerFrame(1.04, NONE, face)).watched.place_m is None


def test_the_robot_talks_while_its_own_voice_is_loud() -> None:
    presence = Presence.start()
    for time_s, said in ((0.04, None), (0.08, voice()), (0.12, SILENCE), (0.16, NONE)):
        presence = presence.after(SpeakerFrame(time_s, NONE, agent_audio=said))
    assert presence.watched.said_s == 0.08 and presence.watched.seen_s is None


def test_what_does_not_come_any_more_is_not_answered_after_half_a_second() -> None:
    room = Room()
    room.goes_on(2.0, voice, FACE)
    assert room.presence.answered(room.now_s)
    room.goes_on(0.6, NONE)
    assert room.presence.person(room.now_s) and not room.presence.answered(room.now_s)
