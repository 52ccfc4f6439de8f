"""A head in a pipecat pipeline, run by pipecat's own test runner. In an environment of its own: `make test-all`."""

import asyncio
import warnings

import pytest
from noted import NOD, NotedRobot

import sfms_robot as sr

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of pipecat's own imports
    pytest.importorskip("pipecat", reason="pipecat has an environment of its own")
    from pipecat.frames.frames import (
        InputAudioRawFrame,
        InterruptionFrame,
        OutputAudioRawFrame,
        TextFrame,
        TTSAudioRawFrame,
        TTSStoppedFrame,
    )
    from pipecat.pipeline.pipeline import Pipeline
    from pipecat.processors.frame_processor import FrameProcessor
    from pipecat.tests.utils import SleepFrame, run_test
    from pipecat.transports.base_output import BaseOutputTransport
    from pipecat.transports.base_transport import TransportParams

    from sfms_robot.agents.pipecat import HeadObserver, ListenerEventFrame, ListeningHead

pytestmark = [pytest.mark.realtime, pytest.mark.filterwarnings("ignore::DeprecationWarning")]
VOICE, SPEECH = bytes(range(1, 201)) * 2, b"\x11\x22" * 480


def pcm(frame, sound, rate_hz, channels=1):
    return frame(audio=sound, sample_rate=rate_hz, num_channels=channels)


def run(processor, frames, **more):
    """Send frames through a processor. Return what came out downstream and upstream."""
    return asyncio.run(run_test(processor, frames_to_send=frames, **more))


class Decides(FrameProcessor):
    """A processor at which, once the pipeline runs, the robot decides to nod."""

    def __init__(self, robot):
        super().__init__()
        self._robot = robot

    async def process_frame(self, frame, direction):
        await super().process_frame(frame, direction)
        if isinstance(frame, TextFrame):
            await asyncio.to_thread(self._robot.decide, NOD)
        await self.push_frame(frame, direction)


class Played(BaseOutputTransport):
    """An output transport that plays at once."""

    async def start(self, frame):
        await super().start(frame)
        await self.set_transport_ready(frame)

    async def write_audio_frame(self, frame):
        return True


def test_sound_that_passes_reaches_the_robot_and_every_frame_passes():
    robot, voice, speech = NotedRobot(), pcm(InputAudioRawFrame, VOICE, 16000), pcm(TTSAudioRawFrame, SPEECH, 24000)
    music, stop = pcm(OutputAudioRawFrame, SPEECH, 24000), InterruptionFrame()
    down, _ = run(ListeningHead(robot), [voice, speech, music, SleepFrame(0.05), stop])
    assert {id(frame) for frame in down} == {id(voice), id(speech), id(music), id(stop)}
    assert robot.heard == [(VOICE, 16000)] and robot.said == [(SPEECH, 24000)] and robot.hushed == 1


def test_an_event_comes_out_both_ways_with_its_probability():
    robot = NotedRobot()
    down, up = run(Pipeline([Decides(robot), ListeningHead(robot)]), [TextFrame("go"), SleepFrame(0.1)])
    for found in (down, up):
        (frame,) = [each for each in found if isinstance(each, ListenerEventFrame)]
        assert frame.event == NOD and frame.event.probability == 0.03
    robot.decide(NOD)  # after the pipeline's end: nothing happens


def test_an_unknown_kind_of_event_is_refused():
    with pytest.raises(sr.InputError, match="no such event"):
        ListeningHead(NotedRobot(), kinds=["nods"])


def test_sound_that_cannot_be_used_is_named_and_the_pipeline_continues(caplog):
    robot = NotedRobot()
    odd, text = pcm(InputAudioRawFrame, b"123", 16000), pcm(InputAudioRawFrame, VOICE, "16000")
    lame = pcm(InputAudioRawFrame, VOICE[:6], 16000, channels=2)
    head = ListeningHead(robot)
    run(head, [odd, odd, text, lame, pcm(InputAudioRawFrame, b"\1\0\3\0" * 99, 16000, channels=2)])
    assert robot.heard == [(b"\2\0" * 99, 16000)] and head.robot_link.refused == {"voice": 4}
    lines = [record.message for record in caplog.records if record.name == "sfms_robot.agents"]
    assert lines == [
        "pipecat: voice: pcm: expected 16-bit samples, got 3 bytes (said once)",
        "pipecat: voice: rate_hz = '16000': expected a rate of speech (4000 to 384000) (said once)",
        "pipecat: voice: pcm: expected 16-bit samples in 2 channels, got 6 bytes (said once)",
    ]


def test_an_observer_takes_each_piece_once_and_what_the_transport_plays():
    robot = NotedRobot()
    transport = Played(TransportParams(audio_out_enabled=True, audio_out_sample_rate=24000))
    frames = [
        *(pcm(InputAudioRawFrame, VOICE, 16000) for _ in range(3)),
        pcm(TTSAudioRawFrame, SPEECH * 4, 24000),  # two chunks of 40 ms
        TTSStoppedFrame(),
        SleepFrame(0.2),
        InterruptionFrame(),
    ]
    run(Pipeline([Decides(robot), transport]), frames, observers=[HeadObserver(robot)])
    assert robot.heard == [(VOICE, 16000)] * 3
    assert b"".join(sound for sound, _ in robot.said).startswith(SPEECH * 4) and robot.said[0][1] == 24000
    assert robot.hushed == 1
