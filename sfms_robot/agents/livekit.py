"""A head for a LiveKit agent (livekit-agents): taps of the sound of a session.

    await session.start(agent, room=room)
    attach(session, robot)

The agent hears and speaks as before; a copy of the sound goes to the robot. `hear_track` is for a participant outside a
session. `agents.events` yields the events that the head decides.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterable, Callable
from typing import TYPE_CHECKING, Any

from sfms_robot import InputError
from sfms_robot.agents import HeadLink
from sfms_robot.errors import optional

with optional("sfms_robot.agents.livekit"):
    from livekit import rtc
    from livekit.agents.voice.io import AudioInput, AudioOutput, AudioOutputCapabilities

if TYPE_CHECKING:
    from livekit.agents import AgentSession

    from sfms_robot import Robot


class PersonTap(AudioInput):
    """Sound input of a session that sends a copy of its sound to a robot.

    Args:
        robot: a robot that is running.
        source: the input that was there before.
    """

    def __init__(self, robot: Robot, source: AudioInput) -> None:
        super().__init__(label="sfms-robot", source=source)
        self.robot_link = HeadLink(robot, "livekit")

    async def __anext__(self) -> rtc.AudioFrame:
        frame = await super().__anext__()
        self.robot_link.hear(bytes(frame.data), frame.sample_rate, frame.num_channels)
        return frame


class AgentTap(AudioOutput):
    """Sound output of a session that sends a robot a copy of the sound for the next output.

    In a pause, speech that was not played yet is kept, and is spoken when the session resumes. A session pauses while
    it finds out whether the person interrupts.

    Args:
        robot: a robot that is running.
        output: the next output in the chain.
        now: a monotonic clock [s].
    """

    def __init__(self, robot: Robot, output: AudioOutput, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__(
            label="sfms-robot",
            capabilities=AudioOutputCapabilities(pause=True),
            next_in_chain=output,
            sample_rate=output.sample_rate,
        )
        self.robot_link = HeadLink(robot, "livekit")
        self._now = now
        self._waiting: list[rtc.AudioFrame] = []  # `_given_s` long, played from `_since_s` on
        self._given_s = self._since_s = 0.0
        self._paused = False

    async def capture_frame(self, frame: rtc.AudioFrame) -> None:
        """Send a frame of speech to the robot, and pass it on."""
        await super().capture_frame(frame)
        if self._unplayed_s() <= 0.0:
            self._waiting, self._given_s, self._since_s = [], 0.0, self._now()
        self._waiting.append(frame)
        self._given_s += frame.duration
        if not self._paused:
            self._say(frame)
        if self.next_in_chain is not None:
            await self.next_in_chain.capture_frame(frame)

    def flush(self) -> None:
        """Pass on the end of a segment."""
        super().flush()
        if self.next_in_chain is not None:
            self.next_in_chain.flush()

    def clear_buffer(self) -> None:
        """Drop the speech that was not played yet, because the person has interrupted."""
        self._waiting, self._given_s = [], 0.0
        self.robot_link.hush()
        if self.next_in_chain is not None:
            self.next_in_chain.clear_buffer()

    def pause(self) -> None:
        """Stop the speech, and keep the part that was not played."""
        if not self._paused:
            played_s, self._paused = self._given_s - self._unplayed_s(), True
            while self._waiting and (played_s := played_s - self._waiting[0].duration) >= 0.0:
                self._given_s -= self._waiting.pop(0).duration  # a frame played in part is spoken again
            self.robot_link.hush()
        super().pause()

    def resume(self) -> None:
        """Speak the part that was kept."""
        if self._paused:
            self._paused, self._since_s = False, self._now()
            for frame in self._waiting:
                self._say(frame)
        super().resume()

    def _unplayed_s(self) -> float:
        """Return how much of the waiting speech was not played [s], if it is played in real time."""
        return self._given_s if self._paused else self._given_s - (self._now() - self._since_s)

    def _say(self, frame: rtc.AudioFrame) -> None:
        self.robot_link.say(bytes(frame.data), frame.sample_rate, frame.num_channels)


def attach(session: AgentSession[Any], robot: Robot) -> None:
    """Let a robot listen to a session that was started: to its person, and to its agent.

    Raises InputError for a session without sound.
    """
    heard, said = session.input.audio, session.output.audio
    if heard is None or said is None:
        way = "input" if heard is None else "output"
        raise InputError(f"attach: session.{way}.audio: expected sound, got None: start the session first")
    session.input.audio, session.output.audio = PersonTap(robot, heard), AgentTap(robot, said)


async def hear_track(robot: Robot, frames: AsyncIterable[Any]) -> None:
    """Send a robot the person's sound from `rtc.AudioStream(track)` until the track ends, without a session."""
    link = HeadLink(robot, "livekit")
    async for each in frames:
        frame: rtc.AudioFrame = getattr(each, "frame", each)  # it may be an AudioFrameEvent
        link.hear(bytes(frame.data), frame.sample_rate, frame.num_channels)
