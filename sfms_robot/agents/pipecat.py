"""A head in a pipecat pipeline (pipecat.ai).

    Pipeline([transport.input(), stt, ..., tts, transport.output(), ListeningHead(robot)])        in and out
    PipelineWorker(pipeline, observers=[HeadObserver(robot)])                                     in

`ListeningHead` sends the robot the person's and the bot's sound that passes it, and pushes a `ListenerEventFrame` in
both directions for each event that the listener decides, before the servos move. After the output transport the bot's
sound arrives while it is played. After the text to speech a whole sentence arrives at once, which the robot plays in
real time. `HeadObserver` needs no place in the pipeline: it sees the frames of all transports.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sfms_robot import ListenerEvent
from sfms_robot.agents import KINDS, HeadLink
from sfms_robot.errors import optional

with optional("sfms_robot.agents.pipecat"):
    from pipecat.frames.frames import (
        CancelFrame,
        EndFrame,
        Frame,
        InputAudioRawFrame,
        InterruptionFrame,
        SpeechOutputAudioRawFrame,
        StartFrame,
        SystemFrame,
        TTSAudioRawFrame,
    )
    from pipecat.observers.base_observer import BaseObserver, FramePushed
    from pipecat.processors.frame_processor import FrameDirection, FrameProcessor
    from pipecat.transports.base_output import BaseOutputTransport

if TYPE_CHECKING:
    from sfms_robot import Robot


@dataclass
class ListenerEventFrame(SystemFrame):
    """An event that the head is about to show.

    Attributes:
        event: its `kind`, times, `size` and `probability`.
    """

    event: ListenerEvent


class ListeningHead(FrameProcessor):
    """Processor that sends sound to a robot, and pushes its events as frames. All frames pass it unchanged.

    Args:
        robot: a robot that is running.
        kinds: kinds of events that are pushed.

    Raises InputError for an unknown kind.
    """

    def __init__(self, robot: Robot, kinds: Sequence[str] = KINDS, **of_pipecat: Any) -> None:
        super().__init__(**of_pipecat)
        self.robot_link = HeadLink(robot, "pipecat")
        self.robot_link.on(kinds, self._decided)

    async def process_frame(self, frame: Frame, direction: FrameDirection) -> None:
        """Send the sound of a frame to the robot, and pass the frame on."""
        await super().process_frame(frame, direction)
        if direction is FrameDirection.DOWNSTREAM:
            _hand_over(self.robot_link, frame)
        if isinstance(frame, EndFrame | CancelFrame):
            self.robot_link.close()
        await self.push_frame(frame, direction)
        if isinstance(frame, StartFrame):  # a pipeline drops frames pushed before it
            self.robot_link.open()

    async def cleanup(self) -> None:
        """Stop passing events on."""
        self.robot_link.close()
        await super().cleanup()

    def _decided(self, event: ListenerEvent) -> None:
        self.create_task(self.broadcast_frame(ListenerEventFrame, event=event), f"{event.kind}")


class HeadObserver(BaseObserver):
    """Observer that sends a robot the sound of the person, and the sound that the output transport plays.

    Args:
        robot: a robot that is running. Its events come from `Robot.on` and `agents.events`.
    """

    def __init__(self, robot: Robot, **of_pipecat: Any) -> None:
        super().__init__(**of_pipecat)
        self.robot_link = HeadLink(robot, "pipecat")
        self._newest = -1

    async def on_push_frame(self, data: FramePushed) -> None:
        """Send the sound of a frame to the robot, only once, because each processor pushes it again."""
        frame = data.frame
        if data.direction is not FrameDirection.DOWNSTREAM:
            return
        if isinstance(frame, InputAudioRawFrame):  # in order: the ids of frames only grow
            if frame.id <= self._newest:
                return
            self._newest = frame.id
        elif not isinstance(data.source, BaseOutputTransport):
            return
        _hand_over(self.robot_link, frame)


def _hand_over(link: HeadLink, frame: Frame) -> None:
    """Send sound to the robot; on an interruption, drop the speech that was not played yet."""
    if isinstance(frame, InputAudioRawFrame):
        link.hear(frame.audio, frame.sample_rate, frame.num_channels)
    elif isinstance(frame, TTSAudioRawFrame | SpeechOutputAudioRawFrame):  # other frames are music and effects
        link.say(frame.audio, frame.sample_rate, frame.num_channels)
    elif isinstance(frame, InterruptionFrame):
        link.hush()
