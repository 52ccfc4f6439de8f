"""What the loop tells a head's life of the person."""

import numpy as np

from sfms_robot.frames import CHANNEL_INDEX, FRAME_SAMPLES, MOTION_DIM, FaceFrame, SpeakerFrame
from sfms_robot.ports import Watched
from sfms_robot.runtime.watching import turned_by_hand, watch

NONE = np.zeros(0, np.float32)
FACE = FaceFrame.of(0.9, np.zeros(MOTION_DIM))


def test_a_face_that_is_lost_leaves_the_person_where_they_were_seen():
    place_m = np.array([1.0, 0.2, 0.0], np.float32)
    seen = watch(SpeakerFrame(1.0, NONE, FACE, attention=0.5, place_m=place_m), Watched())
    assert (seen.seen_s, seen.attention) == (0.9, 0.5) and seen.place_m is place_m
    assert watch(SpeakerFrame(1.04, NONE), seen) == seen
    assert watch(SpeakerFrame(1.04, NONE, FACE), seen).place_m is None


def test_the_robot_talks_while_its_own_voice_is_loud():
    loud, silent = np.full(FRAME_SAMPLES, 0.1, np.float32), np.zeros(FRAME_SAMPLES, np.float32)
    watched = Watched()
    for time_s, said in ((0.04, None), (0.08, loud), (0.12, silent), (0.16, NONE)):
        watched = watch(SpeakerFrame(time_s, NONE, agent_audio=said), watched)
    assert watched.said_s == 0.08 and watched.seen_s is None


def test_only_what_turns_head_or_eyes_is_by_hand():
    planned = np.zeros((3, MOTION_DIM), np.float32)
    assert not turned_by_hand(planned, planned)
    for channel, turned in (("mouthSmileLeft", False), ("eyeBlinkLeft", False), ("yaw", True), ("eyeLookUpLeft", True)):
        asked = planned.copy()
        asked[1, CHANNEL_INDEX[channel]] = 0.3
        assert turned_by_hand(planned, asked) == turned
