"""Who is in front of the page, as voice and sight: one visitor at a time, with its own clock."""

import numpy as np
import pytest

from sfms_robot.errors import ConfigError, PacketError
from sfms_robot.frames import FRAME_S
from sfms_robot.sources.browser import Visitor
from sfms_robot.sources.net_messages import FACE, SPEECH, VOICE, face_message, sound_message
from sfms_robot.sources.registry import open_source

RATE_HZ = 48_000
PIECE = np.full(RATE_HZ // 50, 8192, np.int16)  # 20 ms of a quarter of full scale
FACE_58 = np.zeros(58, np.float32)


class Here:
    """A visitor with a clock that is set, of which the sender's is `ahead_s`."""

    def __init__(self):
        self.now_s = 1000.0
        self.visitor = Visitor(lambda: self.now_s)

    def speaks(self, number, seconds, ahead_s=-990.0):
        for _ in range(round(seconds * 50)):
            self.now_s += 0.02
            at_s = self.now_s + ahead_s
            self.visitor.received(number, sound_message(VOICE, RATE_HZ, at_s, at_s, PIECE))


def test_a_visitors_voice_comes_in_frames_whatever_their_clock() -> None:
    here = Here()
    here.visitor.came(7, ["voice"])
    voice = here.visitor.voice
    voice.start(here.now_s)
    here.speaks(7, 1.0)
    frames = [voice.take(index) for index in range(20)]
    assert all(frame is not None and frame.shape == (640,) for frame in frames)
    assert np.allclose(frames[10], 0.25, atol=0.01) and not voice.lost


def test_a_face_is_given_at_its_time_and_grows_old_when_none_comes() -> None:
    here = Here()
    here.visitor.came(7, ["face"])
    sight = here.visitor.sight
    sight.start(here.now_s)
    here.visitor.received(7, face_message(5.0, 5.0, FACE_58))
    here.visitor.received(7, face_message(5.1, 5.1, None))
    seen = sight.at(1.0)
    assert seen is not None and seen.face.time_s == pytest.approx(0.0, abs=0.11)


def test_what_was_not_announced_is_refused() -> None:
    here = Here()
    sound, face = sound_message(VOICE, RATE_HZ, 1.0, 1.0, PIECE), face_message(1.0, 1.0, FACE_58)
    with pytest.raises(PacketError, match="voice was not announced by `source`"):
        here.visitor.received(7, sound)
    here.visitor.came(7, ["voice"])
    with pytest.raises(PacketError, match="face was not announced"):
        here.visitor.received(7, face)
    with pytest.raises(PacketError, match="voice was not announced"):
        here.visitor.received(8, sound)
    with pytest.raises(PacketError, match="only voice and face"):
        here.visitor.received(7, sound_message(SPEECH, RATE_HZ, 1.0, 1.0, PIECE))
    with pytest.raises(PacketError, match="shorter than a header"):
        here.visitor.received(7, bytes([FACE]))


def test_who_has_gone_is_lost_until_somebody_comes() -> None:
    here = Here()
    voice, sight = here.visitor.voice, here.visitor.sight
    assert not voice.lost and not sight.lost  # nobody came yet: nobody is missed
    here.visitor.came(7, ["voice", "face"])
    here.visitor.gone(8)
    assert not voice.lost
    here.visitor.gone(7)
    assert voice.lost and sight.lost
    here.visitor.came(9, ["voice"])
    assert not voice.lost and sight.lost


def test_the_next_visitor_has_another_clock() -> None:
    here = Here()
    here.visitor.came(7, ["voice"])
    here.visitor.voice.start(here.now_s)
    here.speaks(7, 0.4, ahead_s=-990.0)
    here.visitor.gone(7)
    here.visitor.came(8, ["voice"])
    here.speaks(8, 1.0, ahead_s=+5000.0)
    assert here.visitor.statistics() == {"old": 0, "too_fast": 0}
    assert here.visitor.voice.take(round(1.2 / FRAME_S)) is not None


def test_a_source_of_a_visitor_needs_a_page() -> None:
    with pytest.raises(ConfigError, match="there is no page"):
        open_source("none", "browser")
    source = open_source("browser", "browser", visitor=Visitor())
    assert source.duration_s is None
    source.close()
