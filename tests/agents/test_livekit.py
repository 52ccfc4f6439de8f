"""Taps of a LiveKit session's sound, with livekit-agents' own classes and without a server."""

import asyncio

import pytest
from noted import NotedRobot, Stopped

import sfms_robot as sr

pytest.importorskip("livekit.agents")
from livekit import rtc
from livekit.agents import Agent, AgentSession
from livekit.agents.voice.avatar import AudioSegmentEnd, QueueAudioOutput
from livekit.agents.voice.io import AudioInput

from sfms_robot.agents.livekit import AgentTap, PersonTap, attach, hear_track

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
RATE_HZ = 24000


def frame(value, seconds=0.1, channels=1):
    samples = round(seconds * RATE_HZ)
    return rtc.AudioFrame(bytes([value, 0]) * samples * channels, RATE_HZ, channels, samples)


class Microphone(AudioInput):
    """Sound input that ends after its frames."""

    def __init__(self, frames):
        super().__init__(label="microphone")
        self._frames = iter(frames)

    async def __anext__(self):
        for each in self._frames:
            return each
        raise StopAsyncIteration


class PausableOutput(QueueAudioOutput):
    """Output that can pause."""

    def __init__(self):
        super().__init__()
        self._capabilities.pause = True


def values(said):
    return [sound[0] for sound, _ in said]


def test_the_persons_sound_passes_and_reaches_the_robot():
    robot, frames = NotedRobot(), [frame(1), frame(2, channels=2)]

    async def heard():
        await hear_track(robot, Microphone([rtc.AudioFrameEvent(frame=frame(3))]))  # as of rtc.AudioStream
        return [each async for each in PersonTap(robot, Microphone(frames))]

    assert asyncio.run(heard()) == frames
    assert robot.heard == [(bytes([value, 0]) * 2400, RATE_HZ) for value in (3, 1, 2)]


def test_the_agents_sound_passes_and_an_interruption_drops_it_on_both_ways():
    robot = NotedRobot()

    async def speak():
        tap = AgentTap(robot, output := PausableOutput())
        await tap.capture_frame(frame(1))
        tap.flush()
        passed = [await anext(output.__aiter__()) for _ in range(2)]
        await tap.capture_frame(frame(2))
        tap.clear_buffer()
        assert output._data_ch.empty()
        return passed, tap.captured_playout_segments

    (first, end), segments = asyncio.run(speak())
    assert bytes(first.data[:1]) == b"\1\0" and isinstance(end, AudioSegmentEnd) and segments == 2
    assert values(robot.said) == [1, 2] and robot.hushed == 1


def test_a_pause_keeps_what_was_not_played_and_says_it_at_the_end_of_the_pause():
    robot, clock = NotedRobot(), Stopped()

    async def speak():
        tap = AgentTap(robot, PausableOutput(), clock)
        assert tap.can_pause
        for value in range(1, 6):
            await tap.capture_frame(frame(value))
        clock.now_s += 0.25  # two frames were played, and half of the third
        tap.pause()
        tap.pause()
        await tap.capture_frame(frame(6))
        clock.now_s += 5.0
        tap.resume()
        clock.now_s += 9.0
        tap.pause()
        tap.resume()

    asyncio.run(speak())
    assert values(robot.said) == [1, 2, 3, 4, 5, 3, 4, 5, 6] and robot.hushed == 2


def test_a_session_speaks_through_the_robot():
    robot = NotedRobot()

    async def talk():
        session, output = AgentSession(), PausableOutput()
        session.input.audio, session.output.audio = Microphone([frame(1)]), output
        attach(session, robot)
        await session.start(Agent(instructions=""))

        async def sound():
            yield frame(9)

        handle = session.say("Hello", audio=sound(), add_to_chat_ctx=False)
        played = await anext(output.__aiter__())
        output.notify_playback_finished(0.1, interrupted=False)
        await handle.wait_for_playout()
        await session.aclose()
        return bytes(played.data[:1])

    assert asyncio.run(talk()) == b"\x09\0"
    assert values(robot.said) == [9] and values(robot.heard) == [1]


def test_a_session_without_sound_is_refused_in_one_line():
    async def wrong():
        attach(AgentSession(), NotedRobot())

    with pytest.raises(sr.InputError, match=r"^attach: session.input.audio: expected sound, got None: start the"):
        asyncio.run(wrong())
