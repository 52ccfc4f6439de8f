"""Data of 30 frames a second: a listener hears and sees at each frame what there is by then."""

import numpy as np
import pytest
import torch
from made_dyads import made_dyad

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, FRAME_SAMPLES
from sfms_robot.lab.corpora.clips import Dyad, at_rate, samples_of
from sfms_robot.lab.corpora.conversion import at_frame_rate
from sfms_robot.lab.learning.sfms.features import gather
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.space import MotionSpace, rest_of
from sfms_robot.signals import phase

RNG = np.random.default_rng(5)


def dyad(frames: int, fps: float, space: str = "arkit58", mel: bool = False) -> Dyad:
    """A face that moves in proportion to time, beside somebody who talks for the first half."""
    ends_s = (np.arange(frames) + 1) / fps
    width = 58 if space == "arkit58" else 56
    motion = np.tile(0.05 * ends_s[:, None], (1, width)).astype(np.float32)
    audio = RNG.normal(0, 0.1, samples_of(frames, fps)).astype(np.float32)
    audio[len(audio) // 2 :] *= 1e-3
    sound = {"audio": audio}
    if mel:
        rows = np.repeat(np.where(ends_s < ends_s[-1] / 2, -5.0, -20.0), 4)[:, None] * np.ones(128)
        sound = {"audio": None, "mel": rows.astype(np.float32)}
    return made_dyad(motion, speaker=motion.copy(), listening=ends_s < 1.0, space=space, fps=fps, **sound)


@pytest.mark.parametrize("fps", [24.0, 30.0, 50.0, 60.0])
def test_of_other_rates_the_newest_row_that_is_complete_stands_at_each_time(fps):
    ends_s, wanted_s = (np.arange(200) + 1) / fps, (np.arange(60) + 1) / FRAME_HZ
    chosen = at_rate(ends_s, fps, 60, FRAME_HZ)
    for wanted, given in zip(wanted_s, chosen, strict=True):
        complete = ends_s[ends_s <= wanted + 1e-6]
        assert given == (complete[-1] if len(complete) else ends_s[0])


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0])
def test_motion_keeps_its_place_in_time(fps):
    ours = at_frame_rate(dyad(int(3 * fps), fps))
    assert ours.fps == FRAME_HZ and len(ours.listener) == 75 and len(ours.audio) == 75 * FRAME_SAMPLES
    wanted = 0.05 * np.maximum((np.arange(75) + 1) / FRAME_HZ, 1 / fps)
    still = [0, 1, 2, 3, 4, 5]  # blinks take a maximum
    np.testing.assert_allclose(ours.listener[:, still], np.repeat(wanted[:, None], 6, axis=1), atol=1e-6)
    assert abs(int(ours.listening.sum()) - 25) <= 1


def test_a_face_unknown_for_a_while_stays_so_and_what_cannot_be_resampled_is_said():
    one = dyad(90, 30.0)
    one.speaker[30:60] = np.nan
    known = np.isfinite(at_frame_rate(one).speaker).all(axis=1)
    assert known[:24].all() and not known[26:49].any() and known[51:].all()
    with pytest.raises(ConfigError, match="30 fps in deca56, a listener is streamed at 25"):
        at_frame_rate(dyad(90, 30.0, "deca56"))
    with pytest.raises(ConfigError, match="not one frame"):
        at_frame_rate(dyad(1, 30.0))
    same = dyad(50, 25.0)
    assert at_frame_rate(same) is same


@pytest.mark.parametrize("audio", ["mel", "mfcc78"])
def test_a_corpus_at_30_fps_hears_in_real_time(audio):
    space, frontend = MotionSpace("arkit58", rest_of("arkit58")), AudioFrontend(audio, phased=True)
    one = dyad(121, 30.0)  # 4.03 s: no whole number of our frames
    corpus = gather([one], 48, space, frontend).frames
    assert corpus.sound.shape == (121, *frontend.shape) and corpus.heard.all() and len(corpus.phase) == 121
    ours = phase.of_audio(np.pad(one.audio, (0, -len(one.audio) % FRAME_SAMPLES)))
    for frame in range(1, 121):
        complete = int((frame + 1) / 30 * FRAME_HZ + 1e-6)
        np.testing.assert_array_equal(corpus.phase[frame], ours[complete - 1])


def test_phrases_of_mel_at_30_fps_last_as_long_as_they_do():
    space = MotionSpace("deca56", rest_of("deca56"))
    place = gather([dyad(240, 30.0, "deca56", mel=True)], 48, space, AudioFrontend("mel", phased=True)).frames.phase
    slow = gather([dyad(200, 25.0, "deca56", mel=True)], 48, space, AudioFrontend("mel", phased=True)).frames.phase
    for second in range(1, 8):
        assert torch.equal(place[30 * second - 1], slow[25 * second - 1])
