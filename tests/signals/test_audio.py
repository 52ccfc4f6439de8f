import numpy as np
import pytest
import soundfile

from sfms_robot.errors import ConfigError
from sfms_robot.signals.audio import energy_db, read_audio


def tone(rate_hz, seconds=0.5, frequency_hz=440):
    return 0.5 * np.sin(2 * np.pi * frequency_hz * np.arange(int(rate_hz * seconds)) / rate_hz)


@pytest.mark.parametrize("rate_hz", [8000, 16000, 22050, 44100, 48000])
@pytest.mark.parametrize("suffix", ["wav", "flac"])
def test_any_rate_becomes_the_same_tone_at_16_khz(tmp_path, rate_hz, suffix):
    soundfile.write(tmp_path / f"a.{suffix}", tone(rate_hz), rate_hz)
    samples = read_audio(tmp_path / f"a.{suffix}")
    assert samples.dtype == np.float32 and len(samples) == pytest.approx(8000, abs=1)
    np.testing.assert_allclose(samples[500:7500], tone(16000)[500:7500], atol=0.005)


def test_stereo_is_the_mean_of_its_channels(tmp_path):
    left, right = tone(16000), tone(16000, frequency_hz=300)
    soundfile.write(tmp_path / "a.wav", np.stack([left, right], axis=1), 16000, subtype="FLOAT")
    np.testing.assert_allclose(read_audio(tmp_path / "a.wav"), (left + right) / 2, atol=1e-6)


def test_level_is_in_decibels_of_full_scale():
    assert energy_db(np.ones(100, dtype=np.float32)) == pytest.approx(0.0)
    assert energy_db(np.full(100, 0.1, dtype=np.float32)) == pytest.approx(-20.0, abs=1e-4)
    assert energy_db(np.zeros(0, dtype=np.float32)) == energy_db(np.zeros(640, dtype=np.float32)) == -100.0


def test_what_is_no_sound_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.wav").write_text("this is not a sound")
    (tmp_path / "zero.wav").write_bytes(b"")
    soundfile.write(tmp_path / "empty.wav", np.zeros(0), 16000)
    soundfile.write(tmp_path / "nan.wav", np.full(10, np.nan), 16000, subtype="FLOAT")
    for name, message in {
        "text.wav": "not a sound file",
        "zero.wav": "not a sound file",
        "empty.wav": "holds no samples",
        "nan.wav": "not finite",
        "missing.wav": "no such file",
        ".": "is a folder",
    }.items():
        with pytest.raises(ConfigError, match=message) as error:
            read_audio(tmp_path / name)
        assert "\n" not in str(error.value)
