"""What a microphone and a tracker make of a speaker: everything shifts, nothing that happened moves."""

import csv
import gzip

import numpy as np
import pytest
import soundfile

from sfms_robot.data import data_dir
from sfms_robot.frames import AUDIO_HZ, CHANNEL_INDEX, FRAME_HZ, MOTION_DIM, SHAPES
from sfms_robot.lab.corpora.compose.composed import heard, seen
from sfms_robot.lab.corpora.compose.voices import find_laughter, laugh, lay, mouth_over, read_voice
from sfms_robot.lab.corpora.phrase_timing import phrase_ends, voice_activity
from sfms_robot.signals.motion_primitives import read_motions

JAW = CHANNEL_INDEX["jawOpen"]


@pytest.fixture(scope="module")
def katie():
    return read_voice(data_dir("sim") / "speakers" / "katie" / "speech.flac")


@pytest.fixture
def clips(tmp_path):
    """A clip of training with laughs at 1 s, at 5 s (spoken into) and after its end, and one of test with a puff."""
    rng = np.random.default_rng(0)
    for name in ("audio_EN2001a_0-30s", "audio_EN2005a_0-30s"):
        soundfile.write(tmp_path / f"{name}.wav", rng.normal(0, 0.1, 8 * AUDIO_HZ), AUDIO_HZ)
    rows = [
        ("audio_EN2001a_0-30s.wav", 1.0, 1.8, "vocalsound", "laugh"),
        ("audio_EN2001a_0-30s.wav", 5.0, 6.0, "vocalsound", "laugh"),
        ("audio_EN2001a_0-30s.wav", 5.5, 5.9, "w", "yes"),
        ("audio_EN2001a_0-30s.wav", 8.0, 9.0, "vocalsound", "laugh"),
        ("audio_EN2005a_0-30s.wav", 2.0, 2.1, "vocalsound", "laugh"),
    ]
    with gzip.open(tmp_path / "words.csv.gz", "wt", newline="") as file:
        csv.writer(file).writerows([("clip", "start_s", "end_s", "kind", "text"), *rows])
    return tmp_path


def test_laughs_that_nobody_speaks_into_go_to_the_part_of_their_clip_and_sound_in_their_spans_alone(clips):
    found = find_laughter([clips])
    assert [len(one) for one in found["train"]] == [round(0.8 * AUDIO_HZ)]
    assert found["validation"] == found["test"] == []
    quiet = np.zeros(4 * AUDIO_HZ, np.float32)
    spans = np.array([[0.5, 1.0], [2.0, 3.5]])
    laughing = laugh(quiet, spans, find_laughter([clips])["train"], np.random.default_rng(0))
    times = np.arange(len(quiet)) / AUDIO_HZ
    inside = ((times >= 0.5) & (times < 1.0)) | ((times >= 2.0) & (times < 3.5))
    assert not laughing[~inside].any() and np.sqrt(np.mean(laughing[inside] ** 2)) > 0.02
    np.testing.assert_array_equal(laugh(quiet, spans, [], np.random.default_rng(0)), quiet)


def test_phrases_end_when_they_did_in_any_room_but_the_noisiest(katie):
    late = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        speech, _ = lay(np.array([[1.0, 3.0], [4.5, 7.0]]), 10 * FRAME_HZ, katie, rng)
        audio = heard(speech, katie, rng)
        assert audio.shape == speech.shape and np.abs(audio).max() <= 1
        ends = phrase_ends(voice_activity(audio))
        late += [np.abs(ends - end).min(initial=10.0) for end in (3.0, 7.0)]
    assert np.mean(np.array(late) < 0.3) > 0.85


def test_a_tracker_shifts_and_loses_a_face_and_moves_nothing_else():
    motion = np.zeros((3000, MOTION_DIM), np.float32)
    motion[:, SHAPES] = 0.3
    motion[:, JAW] = 0.3 + 0.3 * np.sin(np.arange(3000) / 5)
    lost = []
    for seed in range(12):
        face = seen(motion, np.random.default_rng(seed))
        gone = np.isnan(face).any(axis=1)
        assert (np.isnan(face).all(axis=1) == gone).all()
        lost.append(gone.mean())
        assert np.corrcoef(face[~gone, JAW], motion[~gone, JAW])[0, 1] > 0.98
        assert face[~gone][:, :3].std(axis=0).max() < np.deg2rad(0.4)
        assert face[~gone][:, SHAPES].min() >= 0 and face[~gone][:, SHAPES].max() <= 1
    assert min(lost) == 0 and 0 < max(lost) < 0.3


def test_a_mouth_that_was_not_filmed_opens_when_its_voice_sounds(katie):
    rng = np.random.default_rng(0)
    speech, _ = lay(np.array([[2.0, 6.0]]), 250, katie, rng)
    talk = read_motions(data_dir("sim") / "listeners" / "motions.npz")["train"].talk
    opens = mouth_over(speech, talk, 250, rng)[:, JAW - SHAPES.start]
    assert opens[60:140].max() > 0.1 and opens[:45].max() < 0.01 and opens[160:].max() < 0.01
