"""Sound files, and a signal between its samples."""

import os
import struct

import numpy as np
import pytest
import soundfile
import soxr
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import ConfigError
from sfms_robot.signals.audio import AudioFile, Downmix, Resampler, at_positions, energy_db, read_audio


def tone(rate_hz, seconds=0.5, frequency_hz=440):
    return 0.5 * np.sin(2 * np.pi * frequency_hz * np.arange(int(rate_hz * seconds)) / rate_hz)


@pytest.mark.parametrize("rate_hz", [8000, 16000, 22050, 44100, 48000])
@pytest.mark.parametrize("suffix", ["wav", "flac"])
def test_any_rate_becomes_the_same_tone_at_16_khz(tmp_path, rate_hz, suffix):
    soundfile.write(tmp_path / f"a.{suffix}", tone(rate_hz), rate_hz)
    samples = read_audio(tmp_path / f"a.{suffix}")
    assert samples.dtype == np.float32 and len(samples) == pytest.approx(8000, abs=1)
    np.testing.assert_allclose(samples[500:7500], tone(16000)[500:7500], atol=0.005)


def test_level_is_in_decibels_of_full_scale_and_a_constant_stays_one():
    assert energy_db(np.ones(100, dtype=np.float32)) == pytest.approx(0.0)
    assert energy_db(np.full(100, 0.1, dtype=np.float32)) == pytest.approx(-20.0, abs=1e-4)
    assert energy_db(np.zeros(0, dtype=np.float32)) == energy_db(np.zeros(640, dtype=np.float32)) == -100.0
    assert at_positions(np.ones(200, np.float32), np.linspace(50, 150, 333)) == pytest.approx(np.ones(333), abs=1e-6)
    assert at_positions(np.ones(3, np.float32), np.zeros(0)).shape == (0,)


UNUSABLE = {
    "no samples": (np.zeros(0), 16000, "PCM_16", "holds no samples"),
    "one sample a second": (np.full(10, 0.1), 1, "PCM_16", "1 samples a second is not a rate of speech"),
    "integers as floats": (np.full(10, 1e6), 16000, "FLOAT", r"samples up to 1e\+06, full scale is 1"),
    "the largest float": (np.full(100_000, 1e38), 48000, "FLOAT", r"samples up to 1e\+38"),
    "one NaN late": (np.r_[np.zeros(200_000), np.nan], 16000, "DOUBLE", "not finite"),
    "text": (b"this is not a sound", 0, "", "not a sound file"),
    "empty": (b"", 0, "", "not a sound file"),
    "missing": (None, 0, "", "no such file"),
}


@pytest.mark.parametrize(("samples", "rate_hz", "subtype", "told"), UNUSABLE.values(), ids=UNUSABLE.keys())
def test_what_is_no_sound_or_would_shake_the_listener_is_refused_before_it_is_played(
    tmp_path, samples, rate_hz, subtype, told
):
    file = tmp_path / "a.wav"
    if isinstance(samples, bytes):
        file.write_bytes(samples)
    elif samples is not None:
        soundfile.write(file, samples, rate_hz, subtype=subtype)
    with pytest.raises(ConfigError, match=told) as error:
        AudioFile(file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", ["wav", "flac"])
def test_a_file_cut_in_half_is_used_as_far_as_it_goes_and_said(tmp_path, caplog, suffix):
    file = tmp_path / f"a.{suffix}"
    soundfile.write(file, tone(16000, seconds=8.0) * np.linspace(0, 1, 128_000), 16000)
    whole = read_audio(file)
    assert not caplog.records
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    part = read_audio(file)
    assert 40_000 < len(part) < 90_000 and (part == whole[: len(part)]).all()
    assert "a." in caplog.text and len(caplog.records) == 1


@given(
    st.sampled_from([8000, 11025, 16000, 22050, 44100, 48000]),
    st.lists(st.integers(0, 3000), min_size=1),
    st.integers(),
)
def test_sound_in_pieces_is_the_sound_resampled_at_once(rate_hz, sizes, seed):
    samples = np.random.default_rng(abs(seed)).uniform(-1, 1, sum(sizes)).astype(np.float32)
    resampler = Resampler(rate_hz)
    pieces = [resampler.push(piece) for piece in np.split(samples, np.cumsum(sizes)[:-1])]
    pieces.append(resampler.push(np.zeros(0, dtype=np.float32), last=True))
    at_once = samples if rate_hz == 16000 else soxr.resample(samples, rate_hz, 16000, quality="HQ")
    np.testing.assert_array_equal(np.concatenate(pieces), np.clip(at_once, -1, 1))


@pytest.mark.parametrize("rate_hz", [16000, 22050])
def test_a_file_read_in_frames_is_the_file_read_at_once_and_can_start_again(tmp_path, rate_hz):
    soundfile.write(tmp_path / "a.wav", np.stack([tone(rate_hz, 6.5), tone(rate_hz, 6.5, 300)], 1), rate_hz)
    whole, file = read_audio(tmp_path / "a.wav"), AudioFile(tmp_path / "a.wav")
    assert file.length == len(whole)
    for _ in range(2):
        frames = [file.read(640) for _ in range(len(whole) // 640 + 1)]
        np.testing.assert_array_equal(np.concatenate(frames), whole)
        assert not len(file.read(640))
        file.rewind()
    file.close()


RATE_HZ = 16_000


@given(frequency_hz=st.floats(50, 6_400), first=st.floats(100, 200), ratio=st.floats(0.1, 1.1))
def test_a_tone_goes_on_between_its_samples(frequency_hz, first, ratio):
    turn = 2 * np.pi * frequency_hz / RATE_HZ
    tone = np.sin(turn * np.arange(1000)).astype(np.float32)
    positions = first + ratio * np.arange(500)
    np.testing.assert_allclose(at_positions(tone, positions), np.sin(turn * positions), atol=1e-3)


@given(seed=st.integers(0, 100), shift=st.integers(-50, 50))
def test_at_whole_positions_samples_are_what_they_are_and_0_around_them(seed, shift):
    samples = np.random.default_rng(seed).normal(size=40).astype(np.float32)
    positions = np.arange(shift, shift + 40, dtype=float)
    expected = np.pad(samples, 100)[100 + shift : 140 + shift]
    np.testing.assert_allclose(at_positions(samples, positions), expected, atol=1e-6)


VOICE = np.random.default_rng(3).normal(0, 0.1, 64_000).astype(np.float32)
OTHER = np.random.default_rng(4).normal(0, 0.1, 64_000).astype(np.float32)
QUIET = np.zeros_like(VOICE)
MIXES = {
    "stereo": ([VOICE, OTHER], (VOICE + OTHER) / 2, False),
    "twice": ([VOICE, VOICE], VOICE, False),
    "one side": ([QUIET, VOICE], VOICE, True),
    "antiphase": ([VOICE, -0.9 * VOICE], VOICE, True),
    "centre of 5.1": ([QUIET, QUIET, VOICE, QUIET, QUIET, QUIET], VOICE, True),
    "silence": ([QUIET, QUIET], QUIET, False),
}


@pytest.mark.parametrize(("channels", "mono", "said"), MIXES.values(), ids=MIXES.keys())
def test_no_mix_loses_the_voice_in_a_file_or_live(tmp_path, caplog, channels, mono, said):
    sound = np.stack(channels, axis=1)
    soundfile.write(tmp_path / "a.wav", sound, 16000, subtype="FLOAT")
    np.testing.assert_allclose(read_audio(tmp_path / "a.wav"), np.clip(mono, -1, 1), atol=1e-6)
    assert [record.getMessage().split(": ")[1][:12] for record in caplog.records] == ["the mean of "] * said
    live = Downmix()
    pieces = [live(piece) for piece in np.split(sound, 100)]
    np.testing.assert_allclose(np.concatenate(pieces), mono, atol=1e-6)
    assert len(caplog.records) == 2 * said


@pytest.mark.parametrize("size", [0, 0xFFFFFFFF, 0x7FFFFFFF])
@pytest.mark.parametrize("extra", [b"", b"LIST\x03\0\0\0abc\0"])
def test_a_wav_file_that_was_streamed_is_whole(tmp_path, caplog, size, extra):
    soundfile.write(tmp_path / "a.wav", tone(16000), 16000)
    data = (tmp_path / "a.wav").read_bytes()
    at, sizes = data.index(b"data"), struct.pack("<I", size)
    (tmp_path / "b.wav").write_bytes(data[:4] + sizes + data[8:at] + extra + b"data" + sizes + data[at + 8 :])
    np.testing.assert_array_equal(read_audio(tmp_path / "b.wav"), read_audio(tmp_path / "a.wav"))
    assert not caplog.records


def test_a_file_that_cannot_seek_can_start_again(tmp_path, caplog):
    soundfile.write(tmp_path / "a.wav", tone(8000, 1.0), 8000, subtype="GSM610")
    file = AudioFile(tmp_path / "a.wav")
    first = file.read(8000)
    file.rewind()
    np.testing.assert_array_equal(file.read(8000), first)
    assert energy_db(first) == pytest.approx(energy_db(tone(16000)), abs=0.5) and not caplog.records
    file.close()


def test_a_path_that_the_locale_cannot_encode_is_opened(tmp_path):
    path = tmp_path / os.fsdecode(b"caf\xe9.wav")
    soundfile.write(tmp_path / "a.wav", tone(16000), 16000)
    (tmp_path / "a.wav").rename(path)
    assert len(read_audio(path)) == 8000


def test_what_is_no_sound_file_says_what_to_do(tmp_path):
    (tmp_path / "a.m4a").write_bytes(bytes(4) + b"ftypM4A " + bytes(400))
    with pytest.raises(ConfigError, match=r"not a sound file that can be read .*ffmpeg -i a.m4a a.wav"):
        AudioFile(tmp_path / "a.m4a")
    (tmp_path / "a.wav").write_bytes(b"PK\x03\x04" + bytes(400))
    with pytest.raises(ConfigError, match=r"is an archive \(zip\): unpack it first$"):
        AudioFile(tmp_path / "a.wav")
    os.mkfifo(tmp_path / "b.wav")
    with pytest.raises(ConfigError, match="is a pipe or a device: sound is read from files"):
        AudioFile(tmp_path / "b.wav")
