"""Whatever a source does, a listener gets whole finite frames; kinds of other packages are found."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_SAMPLES, FaceFrame, SpeakerFrame
from sfms_robot.sources.registry import SOURCES, check_source, open_source, source_kinds
from sfms_robot.sources.validated import ValidatedSource


class Own:
    """Somebody's own source: any object with these three."""

    def __init__(self, *frames: SpeakerFrame):
        self.frames = list(frames)
        self.closed = False
        self.duration_s = None

    def read(self, now_s: float):
        return [self.frames.pop(0)] if self.frames else []

    def close(self) -> None:
        self.closed = True


anything = st.floats(width=32) | st.just(float("nan"))
samples = hnp.arrays(np.float32, st.sampled_from([0, 1, 639, FRAME_SAMPLES, 641, (2, 640)]), elements=anything)
vectors = st.sampled_from([0, 3, 6, 52]).flatmap(lambda n: hnp.arrays(np.float32, n, elements=anything))
faces = st.none() | st.builds(FaceFrame, anything, vectors, vectors, st.none() | vectors)
frames = st.builds(SpeakerFrame, anything, samples, faces, st.none() | samples)


@given(st.lists(frames, max_size=4))
def test_only_whole_finite_frames_on_the_grid_get_through(given_frames):
    source = ValidatedSource(Own(*given_frames))
    for index in range(len(given_frames)):
        (frame,) = source.read(0.0)
        assert frame.time_s == (index + 1) / 25
        for audio in (frame.audio, *(() if frame.agent_audio is None else (frame.agent_audio,))):
            assert audio.dtype == np.float32 and audio.shape in ((0,), (FRAME_SAMPLES,))
            assert (np.abs(audio) <= 1).all()
        if frame.face is not None:
            assert np.isfinite(frame.face.motion).all() and frame.face.motion.shape == (58,)
            assert ((frame.face.blendshapes >= 0) & (frame.face.blendshapes <= 1)).all()
    assert source.statistics()["frames"] == len(given_frames)


def test_a_face_tells_attention_where_the_source_does_not():
    seen = FaceFrame.of(0.0, np.full(58, 0.01))
    place_m = np.array([1.0, 0.0, 0.0])
    given_frames = [
        SpeakerFrame(0.0, np.zeros(0, np.float32)),
        SpeakerFrame(0.0, np.zeros(0, np.float32), seen),
        SpeakerFrame(0.0, np.zeros(0, np.float32), seen, attention=0.25, place_m=place_m),
        SpeakerFrame(0.0, np.zeros(0, np.float32), seen, attention=0.25, place_m=np.full(3, np.nan)),
        SpeakerFrame(0.0, np.zeros(0, np.float32), None, attention=0.25, place_m=place_m),
    ]
    source = ValidatedSource(Own(*given_frames))
    blind, told, given, nowhere, lost = (source.read(0.0)[0] for _ in given_frames)
    assert blind.attention is None and lost.attention is None and lost.place_m is None
    assert told.attention is not None and told.attention > 0.9 and told.place_m is None
    assert given.attention == nowhere.attention == 0.25 and nowhere.place_m is None
    assert np.array_equal(given.place_m, [1, 0, 0]) and source.statistics() == {"frames": 5, "place": 1}


def test_what_is_left_out_is_said_once_and_counted(caplog):
    wrong = [SpeakerFrame(0.0, np.full(FRAME_SAMPLES, np.nan, dtype=np.float32)) for _ in range(3)]
    source = ValidatedSource(Own(*wrong, SpeakerFrame(0.0, np.zeros(100, dtype=np.float32))))
    for _ in range(4):
        source.read(0.0)
    assert source.statistics() == {"frames": 4, "voice": 4} and len(caplog.records) == 1
    assert "frame 0: voice left out: samples that are not finite" in caplog.text


def test_good_frames_go_through_as_they_are():
    audio = np.linspace(-1, 1, FRAME_SAMPLES, dtype=np.float32)
    (frame,) = ValidatedSource(Own(SpeakerFrame(0.04, audio, None, audio))).read(0.04)
    np.testing.assert_array_equal(frame.audio, audio)
    np.testing.assert_array_equal(frame.agent_audio, audio)


class Entry:
    """The part of importlib's EntryPoint that is used."""

    def __init__(self, name, value, loaded=None):
        self.name, self.value, self.loaded = name, value, loaded

    def load(self):
        if self.loaded is None:
            raise ImportError("no module named so")
        return self.loaded


def test_a_kind_is_chosen_by_its_name_and_gets_what_stands_behind_the_colon():
    inner, told = Own(), []
    ear = Entry("ear", "ears:Ear", lambda *arguments: told.append(arguments) or inner)
    source = open_source("ear:left:2", duration_s=3.0, kinds=source_kinds([ear]))
    source.close()
    assert told == [("left:2", 3.0)] and inner.closed
    assert open_source("push", duration_s=1.5).duration_s == 1.5
    with pytest.raises(ConfigError, match="--face webcam: --audio push brings its own"):
        open_source("push", "webcam")


def test_kinds_of_other_packages_are_imported_when_opened_and_never_replace_ours():
    kinds = source_kinds([Entry("push", "theirs:Push"), Entry("broken", "nowhere:Ear")])
    assert kinds["push"] is SOURCES["push"]
    check_source("broken", kinds=kinds)
    with pytest.raises(ConfigError, match="--audio broken: nowhere:Ear cannot be imported: no module named so"):
        open_source("broken", kinds=kinds)


def test_a_name_that_is_wrong_is_found_before_anything_is_loaded():
    code = (
        "import sys; from sfms_robot.sources.registry import check_source\n"
        "check_source('push')\n"
        "sys.exit(bool({'numpy', 'soundfile', 'soxr'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    with pytest.raises(ConfigError, match="--audio nothing-so: no such file"):
        check_source("nothing-so")
