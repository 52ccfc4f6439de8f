"""The grid: every index one frame, whatever voice and sight do; whole finite frames or none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, FaceFrame, Sighting, SpeakerFrame
from sfms_robot.ports import Source
from sfms_robot.sources import paired
from sfms_robot.sources.live_voice import SourcePart
from sfms_robot.sources.paired import ALLOWANCE_S, FACE_S, LONGEST_WAIT_S, FrameJudge, JudgedSource, PairedSource

anything = st.floats(width=32) | st.just(float("nan"))
samples = hnp.arrays(np.float32, st.sampled_from([0, 1, 639, FRAME_SAMPLES, 641, (2, 640)]), elements=anything)
vectors = st.sampled_from([0, 3, 6, 52]).flatmap(lambda n: hnp.arrays(np.float32, n, elements=anything))
faces = st.none() | st.builds(FaceFrame, anything, vectors, vectors, st.none() | vectors)
given_frames = st.builds(
    SpeakerFrame, anything, samples, faces, st.none() | samples, st.none() | anything, st.none() | vectors
)


class Own(Source):
    """Somebody's own source: `read` is all it has to have."""

    def __init__(self, *frames: SpeakerFrame):
        self.frames = list(frames)

    def read(self, now_s: float):
        return [self.frames.pop(0)] if self.frames else []


@given(st.lists(given_frames, max_size=4))
def test_only_whole_finite_frames_on_the_grid_get_through(given_frames):
    source = JudgedSource(Own(*given_frames))
    for index in range(len(given_frames)):
        (frame,) = source.read(0.0)
        assert frame.time_s == (index + 1) / 25
        for audio in (frame.audio, *(() if frame.agent_audio is None else (frame.agent_audio,))):
            assert audio.dtype == np.float32 and audio.shape in ((0,), (FRAME_SAMPLES,)) and (np.abs(audio) <= 1).all()
        if frame.face is not None:
            assert np.isfinite(frame.face.motion).all() and frame.face.motion.shape == (58,)
            assert ((frame.face.blendshapes >= 0) & (frame.face.blendshapes <= 1)).all()
        assert frame.attention is None or (0 <= frame.attention <= 1 and frame.face is not None)
        assert frame.place_m is None or (frame.place_m.shape == (3,) and np.isfinite(frame.place_m).all())
    assert source.statistics()["frames"] == len(given_frames)


SILENCE = np.zeros(0, np.float32)
IN_DEGREES = FaceFrame(0.04, np.array([0, 0, 20, 0, 0, 0], np.float32), np.zeros(52, np.float32))


@pytest.mark.parametrize(
    ("frame", "part", "told"),
    [
        (SpeakerFrame(0.0, np.full(FRAME_SAMPLES, np.nan, np.float32)), "voice", "values that are not finite"),
        (SpeakerFrame(0.0, SILENCE, IN_DEGREES), "face", "yaw: expected radians (in degrees?), got 20"),
    ],
)
def test_what_is_left_out_is_said_once_and_counted(frame, part, told, caplog):
    source = JudgedSource(Own(frame, frame, frame))
    given_frames = [source.read(0.0)[0] for _ in range(3)]
    assert all(not len(each.audio) and each.face is None for each in given_frames)
    assert source.statistics() == {"frames": 3, "left_out": {part: 3}} and len(caplog.records) == 1
    assert f"frame 0: {part} left out: {told}" in caplog.text


@pytest.mark.parametrize(("pause", "lines"), [([], 1), ([0.1], 0)])
def test_a_face_that_smiles_for_a_minute_without_a_pause_is_named_once(pause, lines, caplog):
    levels = [0.6] * (paired.SMILED_FRAMES - 1) + pause + [0.6] * 100
    shown = [FaceFrame(0.0, np.zeros(6, np.float32), np.full(52, level, np.float32)) for level in levels]
    source = JudgedSource(Own(*(SpeakerFrame(0.0, SILENCE, face) for face in shown)))
    given_frames = [source.read(0.0)[0].face.blendshapes[0] for _ in levels]
    assert np.allclose(given_frames, levels) and len(caplog.records) == lines
    assert caplog.text.count("smiled for 60 s without a pause") == lines


def test_good_frames_go_through_as_they_are():
    audio = np.linspace(-1, 1, FRAME_SAMPLES, dtype=np.float32)
    face = FaceFrame(0.04, np.ones(6, dtype=np.float32), np.full(52, 0.5, dtype=np.float32))
    place = np.array([0.6, 0.1, 0.0], dtype=np.float32)
    (frame,) = JudgedSource(Own(SpeakerFrame(0.04, audio, face, audio, 0.7, place))).read(0.04)
    np.testing.assert_array_equal(frame.audio, audio)
    np.testing.assert_array_equal(frame.agent_audio, audio)
    np.testing.assert_array_equal(frame.face.motion, face.motion)
    np.testing.assert_array_equal(frame.place_m, place)
    assert frame.attention == 0.7


def test_an_object_that_is_no_source_is_told_what_it_lacks():
    hum = type("Hum", (), {"duration_s": None, "read": lambda self, now_s: []})()
    told = "Hum lacks latency_s, missing, start, moves, statistics, close: derive it from sfms_robot"
    with pytest.raises(ConfigError, match=told):
        JudgedSource(hum)


class Scripted(SourcePart):
    """A voice whose frame i is at hand `late_s[i]` after its end, and a sight whose faces come at `seen_s`."""

    def __init__(self, late_s=(), seen_s=(), latency_s=0.0):
        self.late_s, self.seen_s, self.latency_s, self.now_s = late_s, sorted(seen_s), latency_s, 0.0
        self.asked = []

    def start(self, origin_s):
        self.origin_s = origin_s

    def take(self, index):
        self.asked.append(index)
        late_s = self.late_s[index] if index < len(self.late_s) else 0.0
        if self.now_s + 1e-9 < (index + 1) / 25 + late_s:
            return None
        return np.full(FRAME_SAMPLES, np.float32((index + 1) / 1000))

    def at(self, time_s):
        seen = [each for each in self.seen_s if each <= time_s]
        return Sighting(FaceFrame.of(seen[-1], np.full(58, seen[-1] / 100)), 0.5) if seen else None

    def statistics(self):
        return {"told": 1}

    def close(self):
        self.closed = True


def played(voice, sight=None, agent=None, until_s=2.0, tick_s=0.01, **more):
    """Frames, and when each was given."""
    source, frames, given_s = PairedSource(voice, sight, agent, **more), [], []
    for tick in range(round(until_s / tick_s) + 1):
        now_s = tick * tick_s
        for part in (voice, sight, agent):
            if part is not None:
                part.now_s = now_s
        new = source.read(now_s)
        frames += new
        given_s += [now_s] * len(new)
    return source, frames, given_s


lateness = st.lists(st.floats(-0.04, 0.3) | st.just(float("inf")), max_size=40)


@given(lateness, st.sampled_from([0.004, 0.01, 0.033, 0.1]), st.floats(0, 1))
def test_every_index_yields_one_frame_in_order_that_waits_no_longer_than_it_says(late_s, tick_s, latency_s):
    voice = Scripted(late_s, latency_s=latency_s)
    source, frames, given_s = played(voice, tick_s=tick_s)
    wait_s = min(latency_s + ALLOWANCE_S, LONGEST_WAIT_S)
    assert [frame.time_s for frame in frames] == [index / 25 for index in range(1, len(frames) + 1)]
    assert len(frames) >= (2.0 - wait_s) * 25 - 1 - tick_s * 25
    for index, (frame, at_s) in enumerate(zip(frames, given_s, strict=True)):
        assert -1e-6 <= at_s - frame.time_s < wait_s + tick_s + 1e-6
        assert frame.audio.shape in ((0,), (FRAME_SAMPLES,))
        assert not len(frame.audio) or frame.audio[0] == np.float32((index + 1) / 1000)
    assert voice.asked == sorted(voice.asked)
    assert source.statistics()["overruns"] == sum(not len(frame.audio) for frame in frames)


@given(st.lists(st.floats(0, 0.035), min_size=45, max_size=45))
def test_steady_jitter_costs_no_frame(late_s):
    source, _, _ = played(Scripted(late_s))
    assert source.statistics()["overruns"] == 0


@given(st.lists(st.floats(0, 2), max_size=30))
def test_the_face_is_the_newest_at_the_end_of_its_frame_and_none_when_it_is_old(seen_s):
    source, frames, _ = played(None, Scripted(seen_s=seen_s))
    for frame in frames:
        newest_s = max((each for each in seen_s if each <= frame.time_s), default=-1.0)
        assert (frame.face is not None) == (frame.time_s - newest_s <= FACE_S + 1e-6)
        if frame.face is not None:
            assert frame.face.pose[0] == np.float32(newest_s / 100) and frame.attention == 0.5
            assert frame.face.time_s == pytest.approx(newest_s, abs=1e-5)
    assert source.statistics()["faces_lost"] == sum(frame.face is None for frame in frames)


def test_all_parts_start_and_close_together_and_their_age_and_latency_are_measured():
    source, _, _ = played(Scripted([0.02] * 99, latency_s=0.03), Scripted(seen_s=np.arange(0.03, 2.0, 0.04)))
    assert source.statistics()["face_age_ms"] == {"p50": pytest.approx(10.0), "p99": pytest.approx(10.0)}
    assert source.latency_s == 0.03 and source.statistics()["wait_ms"]["p50"] <= 20.0
    parts = [Scripted(), Scripted(), Scripted()]
    source = PairedSource(*parts)
    source.start(17.0)
    source.close()
    assert all(part.origin_s == 17.0 and part.closed for part in parts)


def test_a_face_tells_attention_where_the_source_does_not() -> None:
    seen = FaceFrame.of(0.0, np.full(58, 0.01))
    place_m, no_place = np.array([[1.0, 0.0, 0.0], [np.nan] * 3], np.float32)
    sights = (None, Sighting(seen), Sighting(seen, 0.25, place_m), Sighting(seen, 0.25, no_place))
    blind, told, given, nowhere = (FrameJudge().frame(0, SILENCE, sight, None) for sight in sights)
    assert blind.attention is None and blind.place_m is None
    assert told.attention is not None and told.attention > 0.9 and told.place_m is None
    assert given.attention == nowhere.attention == 0.25 and nowhere.place_m is None
    assert given.place_m is not None and np.array_equal(given.place_m, place_m)


@pytest.mark.parametrize(("seen_s", "kept_s"), [(0.93, 0.93), (1.0, 1.0), (0.5, 1.0), (1.2, 1.0), (float("nan"), 1.0)])
def test_a_face_keeps_the_time_that_it_was_seen_where_that_can_be(seen_s: float, kept_s: float) -> None:
    face = FaceFrame.of(seen_s, np.full(58, 0.01))
    frame = FrameJudge().frame(24, np.zeros(0, np.float32), Sighting(face), None)
    assert frame.face is not None and frame.face.time_s == pytest.approx(kept_s)


def test_a_live_face_does_not_wait_for_the_voice_beside_it():
    """A frame that is given late, since its voice was, shows the newest face, up to a frame newer than itself."""

    class Filmed(SourcePart):
        def at(self, time_s):
            return Sighting(FaceFrame.of(np.floor(time_s * 100 + 1e-6) / 100, np.ones(58)))

    live, recorded = Filmed(), Filmed()
    recorded.duration_s = 10.0
    for sight, ages_s in ((live, (0.0, 0.03, 0.04)), (recorded, (0.0, 0.0, 0.0))):
        for late_s, newer_s in zip((0.0, 0.03, 0.5), ages_s, strict=True):
            frame = PairedSource(None, sight).read(0.04 + late_s)[0]
            assert frame.face.time_s - frame.time_s == pytest.approx(newer_s, abs=1e-6)
