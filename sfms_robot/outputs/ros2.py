"""The head in a graph of ROS 2, without ROS installed: `--output ros2[:DOMAIN][,humble]`.

    /joint_states               sensor_msgs/JointState: goals of the servos, by the names of head.yaml
    /robot_face/action_units    hri_msgs/FacialActionUnits of the face and the head
    /robot_face/expression      hri_msgs/Expression: the nearest of seven of its words, with valence and arousal
    /sfms_robot/events          std_msgs/String: JSON of each nod, smile, ... when it begins
    /diagnostics                diagnostic_msgs/DiagnosticArray: state of the run, once a second and at every change
    /robot_face/look_at         subscribed, geometry_msgs/PointStamped in the head's frame: the head looks there

Names are those of ROS4HRI's robots. The domain is DOMAIN, else ROS_DOMAIN_ID, else 0; Humble has no type hashes.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Final

from sfms_robot.errors import OutputError, PacketError, PortError
from sfms_robot.network import LOCAL, Ros2Node, Router, ros_domain
from sfms_robot.ports import Facts, Output, OutputFrame
from sfms_robot.signals.ros2_messages import (
    POINT,
    STRING,
    TYPED_TOPICS,
    Message,
    diagnostics,
    expression_of,
    header,
    read_message,
    to_cdr,
    units_of,
    wire_name,
)

LOOK_AT: Final = "/robot_face/look_at"
SENT: Final[Mapping[str, str]] = {**TYPED_TOPICS, "/sfms_robot/events": STRING}
OPEN_S: Final = 1.8
CHECK_S: Final = 1.0  # period of checks of the router, and of diagnostics
FRAMES: Final = ("", "head", "head_link", "sellion_link")  # frames whose points need no transform


class Ros2Output(Output):
    """`ports.Output` of `--output ros2`. Raises ConfigError for another address.

    wall: function that returns seconds since 1970, for the headers.
    """

    kind = "ros2"

    def __init__(self, address: str, router: Router = LOCAL, wall: Callable[[], float] = time.time) -> None:
        domain, humble, rest = address.partition(",humble")
        self._domain = ros_domain(domain + rest, "--output ros2")
        self._hashed, self._router, self._wall = not humble, router, wall
        self.peer = str(self._domain)
        self._node: Ros2Node | None = None
        self._checked_s = -math.inf
        self._state = ""

    def open(self) -> None:
        self.close()
        self._checked_s = -math.inf
        self._node = Ros2Node(
            "sfms_robot",
            self._domain,
            self._router,
            sends={topic: wire_name(kind, self._hashed) for topic, kind in SENT.items()},
            takes={LOOK_AT: wire_name(POINT, self._hashed)},
            received=self._take_point,
            limit_s=OPEN_S,
        )
        try:
            linked = self._node.wait(OPEN_S)
        except PortError:
            linked = False
        if not linked:
            raise OutputError(self._node.absence(LOOK_AT))

    def send(self, frame: OutputFrame, now_s: float) -> None:
        node = self._node
        if node is None:
            raise OutputError("not connected")
        due = now_s - self._checked_s >= CHECK_S
        if due and not node.connected:
            raise OutputError(node.absence(LOOK_AT))
        time_s = self._wall()
        head = {"header": header(time_s, "head")}
        units = units_of(frame.motion)
        messages: list[tuple[str, Message]] = [
            ("/robot_face/action_units", head | units),
            ("/robot_face/expression", head | expression_of(units["intensity"])),
        ]
        if frame.joints:
            joints = {"name": frame.joints, "position": frame.goals_rad}
            messages.append(("/joint_states", {"header": header(time_s), **joints}))
        messages += [
            ("/sfms_robot/events", {"data": json.dumps(asdict(event), default=float)}) for event in frame.events
        ]
        if due or frame.state != self._state:
            self._checked_s, self._state = now_s, frame.state
            messages.append(("/diagnostics", diagnostics(header(time_s), frame.state, {"time_s": frame.time_s})))
        for topic, message in messages:
            node.publish(topic, to_cdr(SENT[topic], message), round(time_s * 1e9))

    def statistics(self) -> Facts:
        """Return counts of messages, since the last connection."""
        return {} if self._node is None else dict(self._node.counts)

    def close(self) -> None:
        if self._node is not None:
            self._node.close()

    def _take_point(self, topic: str, wire: str, data: bytes) -> None:
        message = read_message(POINT, wire, data)
        frame, point = message["header"]["frame_id"].lstrip("/"), message["point"]
        if frame not in FRAMES:
            raise PacketError(f"frame_id: expected the head's ({', '.join(FRAMES[1:])}) or none, got {frame!r}")
        if self.look_at is not None:
            self.look_at(point["x"], point["y"], point["z"])
