import numpy as np
import pytest

from sfms_robot.frames import FRAME_SAMPLES
from sfms_robot.listeners import audio_frontend
from sfms_robot.signals import mel


def voice(frames: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    loud = np.repeat(np.arange(frames) % 16 > 7, FRAME_SAMPLES)
    return (rng.normal(size=frames * FRAME_SAMPLES) * np.where(loud, 0.2, 1e-4)).astype(np.float32)


def test_a_track_frame_by_frame_is_the_track_as_a_whole():
    samples = voice(64)
    whole, voiced = audio_frontend.track(samples)
    ears = audio_frontend.TRACKS.start()
    for index, frame in enumerate(samples.reshape(64, FRAME_SAMPLES)):
        (features,), (present,), (ears,) = audio_frontend.hear_each([frame], [ears])
        np.testing.assert_array_equal(features, whole[index])
        assert present and ears.voiced == voiced[index]
    assert 0 < voiced.mean() < 1


def test_mel_rows_stand_in_for_samples_and_a_short_recording_has_no_frames():
    samples = voice(64)
    rows = mel.log_mel(samples, mel.start())[0].reshape(64, 4, 128)
    features, voiced = audio_frontend.of_mel(rows)
    assert features.shape == (64, 533)
    np.testing.assert_array_equal(features[:, :512], rows.reshape(64, 512))
    assert (voiced == audio_frontend.track(samples)[1]).mean() > 0.8
    features, voiced = audio_frontend.track(np.zeros(639, np.float32))
    assert features.shape == (0, 533) and voiced.shape == (0,)


@pytest.mark.parametrize("samples", [None, np.zeros(0, np.float32)])
def test_no_samples_are_silence_not_heard(samples):
    silence = np.zeros(FRAME_SAMPLES, np.float32)
    features, present, _ = audio_frontend.hear_each([samples, silence], [audio_frontend.TRACKS.start()] * 2)
    np.testing.assert_array_equal(*features)
    assert present == [False, True]


@pytest.mark.parametrize("samples", [1, 639, 640, 641, 2000])
def test_a_frame_of_the_agent_is_cut_or_filled_up(samples: int):
    fitted = audio_frontend.fit_frame(np.full(samples, 0.5, np.float32))
    assert len(fitted) == FRAME_SAMPLES and fitted.sum() == 0.5 * min(samples, FRAME_SAMPLES)
