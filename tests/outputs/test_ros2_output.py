"""The output to a graph of ROS 2, read by another session of zenoh."""

import json
from contextlib import closing
from functools import partial
from itertools import count

import numpy as np
import pytest
from ros2_graph import client, free_endpoint, serving, until

from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError, OutputError
from sfms_robot.frames import CHANNEL_INDEX, ListenerEvent
from sfms_robot.network import Ros2Node
from sfms_robot.outputs.registry import open_output
from sfms_robot.outputs.ros2 import LOOK_AT, SENT
from sfms_robot.ports import OutputFrame
from sfms_robot.retarget.puppet import Puppet
from sfms_robot.signals.ros2_messages import POINT, STRING, from_cdr, header, to_cdr, wire_name

pytest.importorskip("zenoh", reason="needs the extra [ros2]")

YAW = CHANNEL_INDEX["yaw"]


def frame(state="listening", events=(), joints=("neck_yaw", "jaw")):
    motion = np.zeros(58, np.float32)
    motion[[CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["mouthSmileRight"]]] = 0.5
    goals_rad = np.array([0.25, -0.5][: len(joints)])
    return OutputFrame(time_s=2.0, motion=motion, state=state, events=events, goals_rad=goals_rad, joints=joints)


class Reader:
    """A node that keeps the last message that it receives of each topic."""

    def __init__(self, router, hashed=True, domain=0):
        self.last = {}
        takes = {topic: wire_name(kind, hashed) for topic, kind in SENT.items()}
        self.node = Ros2Node("reader", domain, router, takes=takes, received=self.take)
        self.wires = takes
        self.close = self.node.close

    def take(self, topic, wire, data):
        assert wire == self.wires[topic]
        self.last[topic] = from_cdr(SENT[topic], data)


def send_until(output, sent, true):
    """Send a frame again and again, a tenth of a second apart by the clock of the output, until it is true."""
    times_s = count()

    def again():
        output.send(sent, next(times_s) / 10)
        return true()

    until(again)


@pytest.mark.parametrize(("address", "domain", "hashed"), [("", 0, True), ("7,humble", 7, False)])
def test_joints_face_expression_and_state_are_read_by_another_node(router, address, domain, hashed):
    output = open_output(f"ros2:{address}", router=router)
    with closing(output), closing(Reader(router, hashed, domain)) as reader:
        output.open()
        send_until(output, frame(), lambda: len(reader.last) == 4)
        joints, face, expression, state = (reader.last[topic] for topic in list(SENT)[:4])
        assert joints["name"] == ["neck_yaw", "jaw"] and joints["position"].tolist() == [0.25, -0.5]
        assert face["intensity"][12] == 0.5 and face["confidence"][12] == 1.0
        assert (expression["expression"], expression["confidence"]) == ("happy", 0.5)
        assert [each["message"] for each in state["status"]] == ["listening"]
        event = ListenerEvent("nod", 1.9, 0.6, 0.2, swings=2, target_rad=(0.1, np.float64(0.2)))
        send_until(output, frame("halted", (event,)), lambda: "/sfms_robot/events" in reader.last)
        send_until(output, frame("halted"), lambda: reader.last["/diagnostics"]["status"][0]["level"] == 1)
        assert json.loads(reader.last["/sfms_robot/events"]["data"])["kind"] == "nod"
        assert output.statistics()["sent"] > 5


def test_without_a_router_one_line_says_so_and_a_router_that_goes_away_is_a_loss(tmp_path):
    endpoint = free_endpoint()
    output = open_output("ros2", router=client(tmp_path, endpoint))
    with closing(output):
        with pytest.raises(OutputError, match=r"^no router at .*robot.json5 \(ros2 run rmw_zenoh_cpp rmw_zenohd; "):
            output.open()
        with serving(endpoint):
            output.open()
            output.send(frame(), 0.0)
        with pytest.raises(OutputError, match="^no router at"):
            for step in range(1, 100_000):
                output.send(frame(), 2.0 * step)
        with serving(endpoint):
            output.open()
            output.send(frame(joints=()), 0.0)


@pytest.mark.parametrize(
    ("point", "frame_id", "problem"),
    [
        ((1.0, -0.5, 0.25), "head", None),
        ((1.0, 0.0, 0.0), "map", "frame_id: expected the head's (head, head_link, sellion_link) or none, got 'map'"),
        ((np.nan, 0.0, 0.0), "", "look_at(nan, 0, 0) is not a point in front of a head, in metres"),
    ],
)
def test_a_point_to_look_at_reaches_the_head_or_is_one_line(router, caplog, point, frame_id, problem):
    output, puppet = open_output("ros2", router=router), Puppet(load_head("face28").life.gaze, frozenset())
    output.look_at = partial(puppet.look_at, seconds=2.0)
    message = {"header": header(5.0, frame_id), "point": dict(zip("xyz", point, strict=True))}
    with closing(output), closing(Ros2Node("tester", 0, router, sends={LOOK_AT: wire_name(POINT)})) as node:
        output.open()
        until(lambda: node.matched(LOOK_AT))
        node.publish(LOOK_AT, to_cdr(POINT, message), 0)
        times_s, still = count(), np.zeros((1, 58), np.float32)
        until(lambda: caplog.messages or puppet.overlay(still, np.array([next(times_s) / 10]))[0, YAW] < -0.1)
    said = [line for line in caplog.messages if "left out" in line]
    assert said == [f"sfms_robot: {LOOK_AT}: left out: {problem} (said once)"] * (problem is not None)


def test_the_attachment_counts_and_names_the_sender_and_the_node_is_present(router):
    import zenoh

    from sfms_robot.network import session_config

    samples, tokens = [], []
    topic, wire = "/sfms_robot/events", wire_name(STRING)
    with zenoh.open(session_config("call", router)) as session:
        session.declare_subscriber(f"0{topic}/{wire}", samples.append)
        session.liveliness().declare_subscriber("@ros2_lv/**", lambda each: tokens.append(str(each.key_expr)))
        with closing(Ros2Node("sfms_robot", 0, router, sends={topic: wire})) as node:
            until(lambda: node.matched(topic) and len(tokens) == 2)
            node.publish(topic, b"a", 1_500_000_000)
            node.publish(topic, b"b", 2_500_000_000)
            until(lambda: len(samples) == 2)
        first, second = (each.attachment.to_bytes() for each in samples)
        assert first[:17].hex() == "0100000000000000" + "002f685900000000" + "10" and second[0] == 2
        assert len(first) == 33 and first[17:] == second[17:]
        zid = tokens[0].split("/")[2]
        assert sorted(set(tokens)) == [
            f"@ros2_lv/0/{zid}/0/0/NN/%/%/sfms_robot",
            f"@ros2_lv/0/{zid}/0/1/MP/%/%/sfms_robot/%sfms_robot%events/{wire}/::,10:,:,:,,",
        ]


@pytest.mark.parametrize("address", ["233", "mine", "1:2", "7,jazzy"])
def test_a_domain_that_is_none_is_one_line(address):
    with pytest.raises(ConfigError, match=r"^--output ros2: domain: expected 0 to 232, got '"):
        open_output(f"ros2:{address}")
