"""Somebody is there while seen or heard; the robot speaks while its voice sounds."""

import numpy as np

from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.runtime.states import GONE_S, TURN_GAP_S, Presence

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
