"""Somebody is there while seen or heard; the robot speaks while its voice sounds."""

import numpy as np

from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, Floats, SpeakerFrame
from sfms_robot.runtime.presence import GONE_S, TURN_GAP_S, Presence

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
