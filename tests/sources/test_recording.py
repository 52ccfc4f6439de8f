import struct
import tracemalloc

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from recorded_sound import recorded_voice

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_SAMPLES
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.tracks import Track
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.recording import RecordedSight
from sfms_robot.sources.registry import open_source


def recorded(audio, track, duration_s=None, loop=True, agent_audio=None):
    """As `open_source` joins them."""
    loop = loop and duration_s is not None
    voice = None if audio is None else recorded_voice(audio, loop)
    sight = None if track is None else RecordedSight(track, loop, voice and voice.frames)
    return PairedSource(voice, sight, None if agent_audio is None else recorded_voice(agent_audio), duration_s)


def voice(frames):
    return np.repeat(np.arange(1, frames + 1, dtype=np.float32) / 1000, FRAME_SAMPLES)


def face(seconds):
    motion = np.zeros((int(seconds * 50) + 1, 58), dtype=np.float32)
    motion[:, 0] = np.arange(len(motion)) / 50  # roll tells the time
    return Track(np.arange(len(motion)) / 50, motion, frozenset(CHANNELS))


@given(st.lists(st.floats(0, 0.3), max_size=20))
def test_frames_do_not_depend_on_when_they_are_asked_for(steps_s):
    source, now_s, frames = recorded(voice(10), face(0.3)), 0.0, []
    for step_s in [*steps_s, 1.0]:
        now_s += step_s
        frames += source.read(now_s)
        assert all(frame.time_s <= now_s + 1e-6 for frame in frames)
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(1, 11) / 25)
    assert [frame.audio[0] for frame in frames] == [np.float32(n / 1000) for n in range(1, 11)]


def test_a_face_belongs_to_the_end_of_its_frame_and_ends_with_its_track():
    frames = recorded(voice(10), face(0.2)).read(1.0)
    assert [frame.face is not None for frame in frames] == [True] * 5 + [False] * 5
    for frame in frames[:5]:
        assert frame.face.time_s == frame.time_s and frame.face.pose[0] == pytest.approx(frame.time_s, abs=1e-6)


def test_a_short_voice_starts_again_after_a_second_of_silence_and_without_loop_never():
    frames = recorded(voice(10), face(0.4), duration_s=2.0, agent_audio=voice(5)).read(9.0)
    heard = [float(frame.audio[0]) for frame in frames]
    assert len(frames) == 50
    assert heard[10:35] == [0.0] * 25 and heard[35:45] == heard[:10]
    assert frames[20].face is None and frames[35].face.pose[0] == frames[0].face.pose[0]
    assert not any(frame.agent_audio.any() for frame in frames[5:])  # the robot's own voice does not
    frames = recorded(voice(1)[:100], None, duration_s=2.0, loop=False).read(2.0)
    assert frames[0].audio[:100].all() and not frames[0].audio[100:].any()
    assert not any(frame.audio.any() for frame in frames[1:])


@pytest.mark.parametrize("duration_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_run_needs_a_length(duration_s):
    with pytest.raises(ConfigError, match="--duration"):
        recorded(None, None, duration_s)


def test_the_robots_voice_comes_one_frame_early_and_silence_follows():
    frames = recorded(voice(5), None, duration_s=0.4, agent_audio=voice(3)).read(1.0)
    assert [float(frame.agent_audio[0]) * 1000 for frame in frames] == pytest.approx([2, 3] + [0] * 8)
    assert all(len(frame.agent_audio) == FRAME_SAMPLES for frame in frames)
    assert all(frame.agent_audio is None for frame in recorded(voice(3), None).read(1.0))


def test_a_run_lasts_until_the_robot_has_spoken_and_the_person_does_not_begin_again():
    assert recorded(None, None, agent_audio=voice(7)).duration_s == pytest.approx(0.28)
    source = recorded(voice(3), None, agent_audio=voice(40))
    frames = source.read(60.0)
    assert len(frames) == 40 and source.duration_s == pytest.approx(1.6)
    assert frames[38].agent_audio.any() and not any(frame.audio.any() for frame in frames[3:])


def test_a_recording_read_from_its_file_is_the_recording_held_in_memory(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.random.default_rng(5).uniform(-1, 1, (30_000, 2)), 22050)
    held = recorded(read_audio(tmp_path / "a.wav"), None, 7.0, agent_audio=read_audio(tmp_path / "a.wav"))
    streamed = open_source(str(tmp_path / "a.wav"), "none", 7.0, agent_audio=str(tmp_path / "a.wav"))
    for one, other in zip(held.read(7.0), streamed.read(7.0), strict=True):  # it starts again twice
        np.testing.assert_array_equal(one.audio, other.audio)
        np.testing.assert_array_equal(one.agent_audio, other.agent_audio)
    streamed.close()


def test_three_hours_are_not_loaded(tmp_path):
    size = 3 * 3600 * 8000 * 2
    header = struct.pack("<4sI4s4sIHHIIHH", b"RIFF", size + 36, b"WAVE", b"fmt ", 16, 1, 1, 8000, 16000, 2, 16)
    header += struct.pack("<4sI", b"data", size)
    with (tmp_path / "long.wav").open("wb") as file:
        file.write(header)
        file.truncate(len(header) + size)  # a hole: silence that takes no room on the disk
    open_source(str(tmp_path / "long.wav"), "none").close()  # what is imported on first use is not counted
    tracemalloc.start()
    source = open_source(str(tmp_path / "long.wav"), "none")
    assert source.duration_s == 3 * 3600 and len(source.read(20.0)) == 500
    assert tracemalloc.get_traced_memory()[1] < 8_000_000
    tracemalloc.stop()
    source.close()
