"""States of a run, and the presence of a person."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.runtime.states import ARROWS, GONE_S, TURN_GAP_S, Presence, RunState

SITUATION = {
    "starting": {"eased_in": False},
    "idle": {},
    "listening": {"person": True},
    "speaking": {"person": True, "speaking": True},
    "degraded": {"person": True, "lost": ("voice",)},
    "halted": {"halted": ("key",)},
    "stopping": {"ending": True},
}
situations = st.fixed_dictionaries({
    **dict.fromkeys(("eased_in", "person", "speaking", "ending"), st.booleans()),
    "lost": st.sampled_from([(), ("voice",), ("listener", "yaw")]),
    "halted": st.sampled_from([(), ("key",), ("key", "page")]),
})  # fmt: skip


@pytest.mark.parametrize(("before", "after"), sorted(ARROWS))
def test_every_arrow_is_taken_by_what_causes_it(before: str, after: str) -> None:
    state = RunState().then(1.0, **SITUATION[before])
    assert state.name == before
    if after in ("stopped", "fault"):
        ended = state.ended(2.0, "the supply is gone" if after == "fault" else None)
    else:
        ended = state.then(2.0, **SITUATION[after])
    assert ended.name == after and ended.since_s == 2.0


@given(st.lists(situations, min_size=1, max_size=30), st.booleans())
def test_only_arrows_of_the_table_are_taken_and_a_state_says_why(path, failed) -> None:
    """A halt comes before everything but the end; lost parts are named; the end is final."""
    state = RunState()
    for now_s, facts in enumerate(path, 1):
        before, state = state, state.then(float(now_s), **facts)
        assert state.name == before.name or (before.name, state.name) in ARROWS
        assert state.since_s == (before.since_s if state.name == before.name else now_s)
        if facts["halted"] and state.name != "stopping":
            assert (state.name, state.why) == ("halted", facts["halted"])
        if state.name == "degraded":
            assert state.why == facts["lost"] != ()
        if state.name in ("listening", "speaking", "idle"):
            assert not facts["lost"] and state.doing == state.name
    over = state.then(99.0, ending=True).ended(100.0, "gone" if failed else None)
    assert over.name == ("fault" if failed else "stopped") and over.then(101.0, person=True) == over


def test_the_page_on_safety_has_every_arrow_with_its_cause_and_its_longest_time() -> None:
    page = (Path(__file__).parents[2] / "docs" / "safety.md").read_text(encoding="utf-8")
    _, _, section = page.partition("## States of a run")
    names, told = {name for arrow in ARROWS for name in arrow}, set()
    for line in section.partition("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and " to " in cells[0]:
            left, _, right = cells[0].partition(" to ")
            befores, afters = (re.findall(r"[a-z]+", side) for side in (left, right))
            assert cells[1] and cells[2], line
            told |= {(a, b) for a in befores for b in afters if a != b and {a, b} <= names}
    assert told == ARROWS


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
        self.presence, self.now_s = Presence(), 0.0

    def goes_on(
        self, seconds: float, audio: object = hum, face: FaceFrame | None = None, says: Floats | None = None
    ) -> None:
        for _ in range(round(seconds / FRAME_S)):
            self.now_s += FRAME_S
            heard = audio() if callable(audio) else audio
            self.presence = self.presence.after(SpeakerFrame(self.now_s, heard, face, says))  # type: ignore[arg-type]


def test_a_voice_or_a_face_is_a_person_until_both_are_gone_for_a_while() -> None:
    room = Room()
    for seconds, audio, face, person in (
        (5.0, hum, None, False),
        (2 * FRAME_S, voice, None, True),
        (GONE_S - 0.2, hum, None, True),
        (0.4, hum, None, False),
        (1.0, NONE, None, False),  # a sound card that gives nothing
        (FRAME_S, NONE, FACE, True),
    ):
        room.goes_on(seconds, audio, face and FaceFrame(room.now_s + FRAME_S, face.pose, face.blendshapes))
        assert room.presence.person(room.now_s) == person


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
    seen = Presence().after(SpeakerFrame(1.0, NONE, face, attention=0.5, place_m=place_m))
    assert (seen.watched.seen_s, seen.watched.attention) == (0.9, 0.5) and seen.watched.place_m is place_m
    assert seen.after(SpeakerFrame(1.04, NONE)).watched == seen.watched
    assert seen.after(SpeakerFrame(1.04, NONE, face)).watched.place_m is None


def test_what_does_not_come_any_more_is_not_answered_after_half_a_second() -> None:
    room = Room()
    room.goes_on(2.0, voice, FACE)
    assert room.presence.answered(room.now_s)
    room.goes_on(0.6, NONE)
    assert room.presence.person(room.now_s) and not room.presence.answered(room.now_s)
