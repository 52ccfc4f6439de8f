"""The protocol's bytes: what is written is read, whatever else comes is one line, at any split."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from net_program import HEADER, face_message

from sfms_robot.errors import PacketError
from sfms_robot.sources.net_messages import (
    FACE,
    FEEDS,
    LONGEST,
    SPEECH,
    VOICE,
    Hello,
    Hush,
    SeenMessage,
    SenderClock,
    SoundMessage,
    json_message,
    parse_message,
    sound_message,
)

TIMES = st.floats(allow_nan=False, allow_infinity=False, min_value=1e-3)
HELLO = json_message(type="hello", version=1, feeds=["speech"], wants=["events"])


@given(st.sampled_from([VOICE, SPEECH]), st.integers(4000, 384_000), TIMES, TIMES, st.lists(st.integers(-32768, 32767)))
def test_sound_is_read_as_it_was_written(kind, rate_hz, sent_s, at_s, values):
    told = parse_message(sound_message(kind, rate_hz, sent_s, at_s, np.array(values, np.int16)))
    assert isinstance(told, SoundMessage)
    assert (told.feed, told.rate_hz, told.sent_s, told.at_s) == (FEEDS[kind], rate_hz, sent_s, at_s)
    assert told.samples.dtype == np.int16 and told.samples.tolist() == values


@given(TIMES, st.integers(0, 99), st.none() | st.floats(0, 1, width=32))
def test_a_face_is_read_as_it_was_written(at_s, seed, attention):
    motion = np.random.default_rng(seed).uniform(-0.5, 1, 58).astype(np.float32)
    told = parse_message(face_message(1.0, at_s, motion, attention))
    assert isinstance(told, SeenMessage) and told.attention == attention
    np.testing.assert_array_equal(told.motion, motion)
    lost = parse_message(face_message(1.0, at_s, None))
    assert isinstance(lost, SeenMessage) and lost.motion is None


def test_a_hello_says_what_it_feeds_and_wants():
    told = parse_message(HELLO)
    assert isinstance(told, Hello)
    assert (told.feeds, told.wants, told.token, told.name) == ({"speech"}, {"events"}, "", "")
    assert isinstance(parse_message(b'{"type": "hush"}'), Hush)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "of 0 bytes, shorter than a header"),
        (bytes(23), "of 23 bytes"),
        (bytes(LONGEST + 1), "of 1048577 bytes, more than 1048576: send it in pieces"),
        (bytes(960), r"no header \(raw PCM\?\): sound comes in binary messages"),
        (np.full(480, 8000, "<i2").tobytes(), "raw PCM"),
        (b"UklGRiQAAABXQVZF" * 100, r"a text that is not a JSON object \(base64\?\): sound comes in binary"),
        (b"[1, 2]", "not a JSON object"),
        (b"RIFF" + bytes(99), "a WAV file: sound comes in"),
        (HEADER.pack(VOICE, 1, 0, 16000, 0, 0) + b"RIFF" + bytes(40), "a WAV file behind the header: send its samples"),
        (b'{"type": "session.update", "session": {}}', "'session.update' is an event of the OpenAI Realtime API"),
        (b'{"type": "input_audio_buffer.append", "audio": "' + b"A" * 9000 + b'"}', "Realtime API, .*: sound comes in"),
        (HEADER.pack(VOICE, 2, 0, 16000, 0, 0), "version 2, not 1"),
        (HEADER.pack(9, 1, 0, 16000, 0, 0), r"kind 9, which a program does not send \(voice, face, speech\)"),
        (HEADER.pack(VOICE, 1, 7, 16000, 0, 0), "kind 1"),
        (HEADER.pack(VOICE, 1, 0, 100, 0, 0), r"sound of 100 samples a second \(4000 to 384000\)"),
        (HEADER.pack(VOICE, 1, 0, 16000, 0, 0) + b"abc", "not of 16-bit samples"),
        (HEADER.pack(VOICE, 1, 0, 16000, float("nan"), 0), "a time that is not finite"),
        (HEADER.pack(VOICE, 1, 0, 16000, 0, 5), "a time without the time of sending"),
        (HEADER.pack(FACE, 1, 0, 0, 0, 0) + bytes(4 * 57), "a face of 228 bytes, not of 58 or 59 float32"),
        (HEADER.pack(FACE, 1, 0, 0, 0, 0) + np.full(58, np.inf, "<f4").tobytes(), "not finite"),
        (face_message(0, 0, [20.0] * 58), r"a face left out: roll: expected radians \(in degrees\?\), got 20"),
        (b'{"type": "hello"', "Invalid JSON: EOF"),
        (b'{"a":' * 700, "Invalid JSON: recursion limit"),
        (b"{" + b" " * 5000, "JSON of more than 4096 bytes"),
        (b'{"type": "halt"}', "Input tag 'halt' .* expected tags: 'hello', 'hush'"),
        (b'{"type": "hello", "version": 2}', "hello.version = 2: Input should be 1"),
        (b'{"type": "hello", "version": 1, "feeds": ["voices"]}', "hello.feeds.0 = 'voices': Input should be 'voice'"),
        (b'{"type": "hello", "version": 1, "name": "a\\nb"}', "hello.name = .* printable"),
    ],
)
def test_what_is_no_message_is_one_line(data, told):
    with pytest.raises(PacketError, match=told) as raised:
        parse_message(data)
    assert "\n" not in str(raised.value)


def mutated(rng, message):
    """A message with some of its bytes changed, cut out or put in."""
    data = bytearray(message)
    for _ in range(rng.integers(0, 4)):
        at = int(rng.integers(0, len(data) + 1))
        data[at : at + int(rng.integers(0, 4))] = rng.bytes(int(rng.integers(0, 4)))
    return bytes(data)


def parses(data):
    try:
        return parse_message(data)
    except PacketError:
        return None


@pytest.mark.parametrize("count", [20_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_random_messages_raise_nothing_else_and_what_is_read_is_finite(count):
    rng, read = np.random.default_rng(count), 0
    good = [
        HELLO, b'{"type": "hush"}', sound_message(VOICE, 16000, 1.0, 2.0, np.arange(8, dtype=np.int16)),
        sound_message(SPEECH, 48000, 1.0, 0.0, np.zeros(0, np.int16)), face_message(1.0, 2.0, np.zeros(58), 0.5),
    ]  # fmt: skip
    for index in range(count):
        data = rng.bytes(int(rng.integers(0, 64))) if index % 5 == 0 else mutated(rng, good[index % len(good)])
        told = parses(data)
        read += told is not None
        if isinstance(told, SeenMessage) and told.motion is not None:
            assert np.isfinite(told.motion).all() and np.isfinite([told.sent_s, told.at_s]).all()
    assert count / 10 < read < count


@given(st.floats(-1e6, 1e6), st.lists(st.floats(0.001, 0.3), min_size=40, max_size=200), st.floats(-2e-4, 2e-4))
def test_a_senders_clock_is_never_early_and_late_by_the_quickest_way(origin_s, delays_s, drift):
    """A message every 50 ms by a clock that drifts up to 200 ppm."""
    clock = SenderClock()
    for index, delay_s in enumerate(delays_s):
        true_s = 1000.0 + index * 0.05
        sent_s = origin_s + (true_s - 1000.0) * (1 + drift)
        clock.observe(sent_s, true_s + delay_s)
        late_s = sent_s + clock.offset_s - true_s
        assert late_s >= -20.0 * abs(drift)
        assert late_s <= min(delays_s[max(0, index - 190) : index + 1]) + 20.0 * abs(drift) + 1e-6


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_clock_that_is_set_is_followed_at_once(step_s):
    clock = SenderClock()
    clock.observe(10.0, 100.0)
    clock.observe(10.1 + step_s, 100.1)
    assert clock.offset_s == pytest.approx(90.0 - step_s)
