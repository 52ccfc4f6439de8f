"""VTube Studio (Live2D avatars): `--output vtube-studio[:HOST:PORT]`, or `vtube-studio-add` on top of its tracking.

JSON requests over ws://HOST:8001 (API 1.0, github.com/DenchiSoft/VTubeStudio), each answered:

    AuthenticationTokenRequest   opens a window in VTube Studio; answered when its user clicks Allow or Deny
    AuthenticationRequest        with the token, on every connection
    InjectParameterDataRequest   each frame; an input that is not sent again within a second returns to the tracking

The token is kept in the user's folder, readable by the user alone. Frames wait for the user's click. Then `weight`, or
in the mode "add" the values themselves, grow over a second.

Inputs of an avatar are linear functions of our channels. Signs follow Live2D's (x + to the right of the screen, which
is the avatar's left; y + up) and VTube Studio's own mapping, which reverses EyeLeftX and EyeRightX. It was not tried
with VTube Studio.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.data import user_dir
from sfms_robot.errors import OutputError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, Floats
from sfms_robot.outputs.websocket_peer import Message, WebSocketOutput
from sfms_robot.ports import Facts, OutputFrame
from sfms_robot.signals.minimum_jerk import ease

PLUGIN: Final = {"pluginName": "sfms-robot", "pluginDeveloper": "sfms-robot"}
GROW_S: Final = 1.0  # time in which the weight grows, once access is given
ANSWER_S: Final = 5.0  # longest wait for an answer, except for the user's

_API: Final = {"apiName": "VTubeStudioPublicAPI", "apiVersion": "1.0"}
_DENIED, _ASKED_ALREADY, _TAKEN = 50, 51, 454  # numbers of its errors
_DEG: Final = math.degrees(1.0)

# Input of VTube Studio: value of a neutral face, lowest, highest, and the weights of our channels.
_SMILE: Final = {"mouthSmileLeft": 0.25, "mouthSmileRight": 0.25, "mouthFrownLeft": -0.25, "mouthFrownRight": -0.25}
_INPUTS: Final[Mapping[str, tuple[float, float, float, Mapping[str, float]]]] = {
    "FaceAngleX": (0.0, -90.0, 90.0, {"yaw": _DEG}),
    "FaceAngleY": (0.0, -90.0, 90.0, {"pitch": -_DEG}),
    "FaceAngleZ": (0.0, -90.0, 90.0, {"roll": -_DEG}),
    "MouthOpen": (0.0, 0.0, 1.0, {"jawOpen": 1.0, "mouthClose": -1.0}),
    "MouthSmile": (0.5, 0.0, 1.0, _SMILE),
    "MouthX": (0.0, -1.0, 1.0, {"mouthLeft": 1.0, "mouthRight": -1.0}),
    "CheekPuff": (0.0, 0.0, 1.0, {"cheekPuff": 1.0}),
    "TongueOut": (0.0, 0.0, 1.0, {"tongueOut": 1.0}),
    "Brows": (0.5, 0.0, 1.0, {
        "browInnerUp": 0.25, "browOuterUpLeft": 0.125, "browOuterUpRight": 0.125,
        "browDownLeft": -0.25, "browDownRight": -0.25,
    }),
    **{
        f"Brow{side}Y": (0.5, 0.0, 1.0, {"browInnerUp": 0.25, f"browOuterUp{side}": 0.25, f"browDown{side}": -0.5})
        for side in ("Left", "Right")
    },
    **{f"EyeOpen{side}": (1.0, 0.0, 1.0, {f"eyeBlink{side}": -1.0}) for side in ("Left", "Right")},
    "EyeLeftX": (0.0, -1.0, 1.0, {"eyeLookInLeft": 1.0, "eyeLookOutLeft": -1.0}),
    "EyeRightX": (0.0, -1.0, 1.0, {"eyeLookOutRight": 1.0, "eyeLookInRight": -1.0}),
    **{
        f"Eye{side}Y": (0.0, -1.0, 1.0, {f"eyeLookUp{side}": 1.0, f"eyeLookDown{side}": -1.0})
        for side in ("Left", "Right")
    },
}  # fmt: skip
_NEUTRAL, _LOW, _HIGH = np.array([row[:3] for row in _INPUTS.values()]).T
_WEIGHTS: Final = np.zeros((len(_INPUTS), MOTION_DIM))
for _row, (*_, _channels) in enumerate(_INPUTS.values()):
    for _name, _weight in _channels.items():
        _WEIGHTS[_row, CHANNEL_INDEX[_name]] = _weight

logger = logging.getLogger(__name__)


def inputs_of(motion: Floats, added: bool = False) -> dict[str, float]:
    """Return the inputs of VTube Studio for motion (58,). `added`: as differences from a neutral face."""
    values = np.clip(_NEUTRAL + _WEIGHTS @ motion, _LOW, _HIGH)
    if added:
        values -= _NEUTRAL
    return dict(zip(_INPUTS, values.round(4).tolist(), strict=True))


class VtubeStudio(WebSocketOutput):
    """The inputs of VTube Studio's avatar, in place of its tracking."""

    kind = "vtube-studio"
    mode = "set"
    usual_port = 8001
    absent = "start VTube Studio and switch on the plug-in API in its settings"
    answers = False  # it only answers requests; `heard` detects a missing answer

    def __init__(self, address: str = "", folder: Path | None = None) -> None:
        super().__init__(address)
        self._file = (folder or user_dir()) / f"vtube_studio_{re.sub(r'[^A-Za-z0-9.-]', '_', self.host)}.token"
        self._denied = self._access = False
        self._since_s: float | None = None  # time of the first frame
        self._asked_s: float | None = None  # time of the oldest unanswered request, apart from that for a token

    def greet(self) -> None:
        if self._denied:
            raise OutputError("its user denied access: start the run again to be asked again")
        self._access, self._since_s, self._asked_s = False, None, None
        if (token := self._token()) is not None:
            self._authenticate(token)
        else:
            self._ask()

    def message(self, frame: OutputFrame, now_s: float) -> Message | None:
        if not self._access:
            return None
        self._since_s = now_s if self._since_s is None else self._since_s
        share = float(ease((now_s - self._since_s) / GROW_S))
        add = self.mode == "add"
        values = [
            {"id": name, "value": value * share} if add else {"id": name, "value": value, "weight": share}
            for name, value in inputs_of(frame.motion, add).items()
        ]
        return _request("InjectParameterData", {"faceFound": not add, "mode": self.mode, "parameterValues": values})

    def shown(self, frame: OutputFrame, now_s: float) -> None:
        self._asked_s = now_s if self._asked_s is None else self._asked_s

    def heard(self, messages: Sequence[Message], now_s: float) -> None:
        if self._asked_s is not None and not messages and now_s - self._asked_s > ANSWER_S:
            raise OutputError(f"has not answered for {ANSWER_S:g} s")
        for message in messages:
            if (version := message.get("apiVersion")) != _API["apiVersion"]:
                raise OutputError(f"speaks API version {version}, not {_API['apiVersion']}")
            data = message.get("data")
            self._asked_s = None
            self._answered(str(message.get("messageType")), data if isinstance(data, dict) else {})

    def statistics(self) -> Facts:
        """Return the frames that a slow VTube Studio missed, and whether its user gave access."""
        return {**super().statistics(), "access": self._access}

    def _answered(self, kind: str, data: Message) -> None:
        if kind == "AuthenticationTokenResponse":
            token = str(data.get("authenticationToken", ""))
            if not re.fullmatch(r"[!-~]{1,64}", token):
                raise OutputError(f"gives {token[:64]!r}, which is not a token")
            self._keep(token)
            self._authenticate(token)
        elif kind == "AuthenticationResponse" and data.get("authenticated"):
            self._access = True
        elif kind == "AuthenticationResponse":
            logger.info("output %s:%s: the kept token is not valid any more", self.kind, self.peer)
            self._file.unlink(missing_ok=True)
            self._ask()
        elif kind == "APIError":
            self._denied = data.get("errorID") == _DENIED
            hints = {
                _DENIED: "; start the run again to be asked again",
                _ASKED_ALREADY: "; click Allow in its window",
                _TAKEN: "; stop the other plug-in, or use vtube-studio-add",
            }
            text = " ".join(str(data.get("message")).split()).rstrip(".")
            raise OutputError(f"{text} (error {data.get('errorID')}){hints.get(data.get('errorID', -1), '')}")

    def _ask(self) -> None:
        self.note_once("click Allow in the window that VTube Studio shows now")
        self.say(_request("AuthenticationToken", PLUGIN))

    def _authenticate(self, token: str) -> None:
        self._asked_s = self.link.heard_s
        self.say(_request("Authentication", {**PLUGIN, "authenticationToken": token}))

    def _token(self) -> str | None:
        try:
            return self._file.read_text(encoding="ascii").strip() or None
        except FileNotFoundError:
            return None
        except (OSError, UnicodeError) as error:
            raise OutputError(f"{self._file}: expected a token, got {error}; delete the file") from error

    def _keep(self, token: str) -> None:
        """Write the token into a file that only this user can read."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._file.unlink(missing_ok=True)
        self._file.touch(0o600, exist_ok=False)
        self._file.write_text(token, encoding="ascii")


class VtubeStudioAdd(VtubeStudio):
    """The same inputs, added to those of the streamer's own tracking."""

    kind = "vtube-studio-add"
    mode = "add"


def _request(kind: str, data: Message) -> Message:
    return {**_API, "requestID": "sfms-robot", "messageType": f"{kind}Request", "data": data}
