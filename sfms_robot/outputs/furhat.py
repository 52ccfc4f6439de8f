"""Furhat, or its virtual robot: `--output furhat[:HOST:PORT]`, over the robot's Realtime API (docs.furhat.io).

JSON events over ws://HOST:9000/v1/events:

    request.auth             once; answered by response.auth {access, scope}. FURHAT_KEY in the environment is the key
    request.face.config      once: the robot's own blinking, microexpressions and sway off; on again at the end
    request.face.headpose    once: slowly to neutral
    request.face.params      each frame: the 52 blendshapes as BROW_DOWN_LEFT and so on, 0..1; NECK_PAN, NECK_TILT,
                             NECK_ROLL and GAZE_PAN, GAZE_TILT in degrees

The eight EYE_LOOK shapes are 0, because GAZE turns the eyes. Signs are those of the maker's telepresence example,
where a tracked person's yaw to the own left, pitch down and roll to the right ear are +, as here. It was not tried with
a robot.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sfms_robot.errors import OutputError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, SHAPES, Floats
from sfms_robot.outputs.websocket_peer import CONNECT_S, Message, WebSocketOutput
from sfms_robot.ports import ChannelLimit, OutputFrame
from sfms_robot.signals.gaze_kinematics import EYES_RAD, directions

KEY: Final = "FURHAT_KEY"

_OWN: Final = ("blinking", "microexpressions", "head_sway")  # motions that the robot makes itself
_NAMES: Final = ["".join(f"_{each}" if each.isupper() else each.upper() for each in name) for name in BLENDSHAPES]
_LOOKS: Final = [place for place, name in enumerate(BLENDSHAPES) if name.startswith("eyeLook")]
_NECK: Final = {"NECK_PAN": "yaw", "NECK_TILT": "pitch", "NECK_ROLL": "roll"}


def _neck(degrees: float) -> ChannelLimit:
    reach = math.radians(degrees)
    return ChannelLimit(-reach, reach, math.radians(150), math.radians(1500))


def params_of(motion: Floats) -> dict[str, float]:
    """Return the parameters of a face for motion (58,)."""
    shapes = motion[SHAPES].astype(np.float64)
    shapes[_LOOKS] = 0.0
    pan, tilt = np.degrees(directions(motion, EYES_RAD).mean(axis=0)).round(2).tolist()
    turns = {name: round(math.degrees(float(motion[CHANNEL_INDEX[channel]])), 3) for name, channel in _NECK.items()}
    return {**dict(zip(_NAMES, shapes.round(4).tolist(), strict=True)), **turns, "GAZE_PAN": pan, "GAZE_TILT": tilt}


class Furhat(WebSocketOutput):
    """Face, eyes and neck of a Furhat."""

    kind = "furhat"
    neutral_s = 1.0  # duration of the way to neutral
    usual_port = 9000
    path = "/v1/events"
    absent = "name the robot's host and switch on its Realtime API"
    rate_hz = 50.0  # the maker's example sends faces every 20 ms
    moves = True
    answers = False
    limits: Mapping[str, ChannelLimit] = {"yaw": _neck(45), "pitch": _neck(25), "roll": _neck(20)}

    def greet(self) -> None:
        now_s = time.monotonic()
        key = {"key": os.environ[KEY]} if KEY in os.environ else {}
        self.say({"type": "request.auth", **key})
        answers = (each for each in self.link.until(now_s + CONNECT_S) if each.get("type") == "response.auth")
        if (answer := next(answers, None)) is None:
            raise OutputError("does not answer request.auth: is it a Furhat's Realtime API?")
        if answer.get("access") is not True:
            raise OutputError(f"refuses access: set {KEY} to the key in the robot's web interface")
        self._configure(own=False)
        neutral = {"yaw": 0.0, "pitch": 0.0, "roll": 0.0, "relative": False, "speed": "slow"}
        self.say({"type": "request.face.headpose", **neutral})
        began_s = time.monotonic()
        self.heard(list(self.link.until(began_s + self.neutral_s)), began_s)

    def message(self, frame: OutputFrame, now_s: float) -> Message:
        return {"type": "request.face.params", "params": params_of(frame.motion)}

    def heard(self, messages: Sequence[Message], now_s: float) -> None:
        for message in messages:
            if str(message.get("type")).endswith("error"):
                raise OutputError(f"answers {message.get('type')}: {message.get('message') or message}")

    def farewell(self) -> None:
        """Switch the robot's own blinking, microexpressions and sway on again."""
        self._configure(own=True)

    def _configure(self, own: bool) -> None:
        self.say({"type": "request.face.config", **dict.fromkeys(_OWN, own)})
