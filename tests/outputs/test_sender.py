"""Motion on its way to an output: eased, limited, over losses; every time is an argument."""

import logging

import numpy as np
import pytest

from sfms_robot.errors import ConfigError, OutputError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, ListenerEvent
from sfms_robot.outputs.registry import open_output, parse_address
from sfms_robot.outputs.sender import EASE_S, Outputs, OutputSender
from sfms_robot.ports import ChannelLimit, Output, OutputFrame, Tick

HZ = 50.0
YAW = CHANNEL_INDEX["yaw"]
LIMITS = {"yaw": ChannelLimit(-0.5, 0.5, 1.0, 10.0)}


class Peer(Output):
    """An output that keeps what it is sent; `trouble`: what its methods raise meanwhile."""

    kind, peer, rate_hz = "kept", "here", HZ

    def __init__(self, moves=False, limits=None):
        self.moves, self.limits = moves, limits or {}
        self.frames, self.trouble, self.opened, self.closed = [], None, 0, 0

    def open(self):
        self.opened += 1
        self._fail()

    def send(self, frame, now_s):
        self._fail()
        self.frames.append(frame)

    def close(self):
        self.closed += 1

    def _fail(self):
        if self.trouble is not None:
            raise self.trouble


def looking(yaw=0.4, state="listening"):
    motion = np.zeros(MOTION_DIM, np.float32)
    motion[YAW] = yaw
    return OutputFrame(time_s=0.0, motion=motion, state=state)


def played(sender, frame, start_s, seconds, **more):
    """Send a frame over a time; return the yaw that is shown at each step."""
    for step in range(round(seconds * HZ)):
        sender.step(frame, start_s + step / HZ, **more)
    return np.array([each.motion[YAW] for each in sender.output.frames[-round(seconds * HZ) :]])


def test_motion_begins_and_ends_at_neutral_and_arrives_after_the_easing():
    yaw = played(OutputSender(Peer()), looking(), 0.0, EASE_S + 0.1)
    assert yaw[0] == 0.0 and yaw[-1] == pytest.approx(0.4) and np.abs(np.diff(yaw)).max() < 0.4 * 1.9 / HZ / EASE_S
    assert not played(OutputSender(Peer()), None, 0.0, 0.2).any()
    sender = OutputSender(Peer())
    played(sender, looking(), 0.0, 2.0)
    assert not sender.settled
    yaw = played(sender, looking(), 2.0, EASE_S + 0.1, ending=True)
    assert yaw[0] == pytest.approx(0.4) and yaw[-1] == 0.0 and sender.settled


def test_in_a_halt_an_avatar_goes_neutral_and_a_machine_brakes_and_holds_its_pose():
    sender = OutputSender(Peer())
    played(sender, looking(), 0.0, 2.0)
    assert played(sender, looking(0.0, "halted"), 2.0, 1.2)[-1] == 0.0
    yaw = played(sender, looking(), 4.0, 1.2)
    assert yaw[0] == 0.0 and yaw[-1] == pytest.approx(0.4)
    sender = OutputSender(Peer(True, LIMITS))
    played(sender, looking(0.4), 0.0, 0.5)  # on its way
    yaw = played(sender, looking(0.0, "halted"), 0.5, 2.0).astype(float)
    assert yaw[-1] == yaw[-50] > 0.05 and np.abs(np.diff(yaw, 2)).max() * HZ**2 <= 10.0 + 1e-2
    assert sender.settled


def test_a_halted_machine_is_not_connected_again(caplog):
    peer = Peer(True, LIMITS)
    sender = OutputSender(peer)
    played(sender, looking(), 0.0, 2.0)
    peer.trouble = OSError("gone")
    sender.step(looking(state="halted"), 2.0)
    peer.trouble = None
    for second in range(3, 60):
        sender.step(looking(state="halted"), float(second))
    assert peer.opened == 1
    sender.step(looking(), 60.0)
    assert peer.opened == 2


def test_a_lost_peer_is_reported_once_and_tried_with_growing_pauses(caplog):
    caplog.set_level(logging.INFO)
    peer = Peer()
    sender = OutputSender(peer)
    peer.trouble = OutputError("it is away")
    tries = []
    for step in range(10 * 60):
        before = peer.opened
        sender.step(looking(), step / 10)
        tries += [step / 10] if peer.opened > before else []
    assert np.diff(tries).tolist() == pytest.approx([1, 2, 4, 8, 10, 10, 10, 10])
    assert sender.lost and sender.statistics()["problem"] == "it is away"
    peer.trouble = None
    yaw = played(sender, looking(), 100.0, 2.0)
    assert sender.statistics() == sender.statistics() | {"state": "sending", "frames": 100, "frames_per_s": HZ}
    assert yaw[0] == 0.0 and yaw[-1] == pytest.approx(0.4) and not sender.lost
    assert [(each.levelname, each.message) for each in caplog.records] == [
        ("WARNING", "output kept:here: it is away; it is tried again, the run continues"),
        ("INFO", "output kept:here: connected again"),
    ]


def test_a_peer_that_refuses_after_each_connection_counts_as_away_all_the_time(caplog):
    peer = Peer()
    sender = OutputSender(peer)
    played(sender, looking(), 0.0, 1.0)
    for step in range(50 * 30):
        peer.trouble = ConnectionRefusedError("refused") if step % 3 == 2 else None
        sender.step(looking(), 1.0 + step / HZ)
    assert sender.lost and sender.statistics()["losses"] == 1 and peer.opened < 8
    assert len(caplog.records) == 1


def test_any_error_of_a_plug_in_is_a_loss(caplog):
    peer = Peer()
    peer.trouble = ZeroDivisionError("division by zero\nmore")
    OutputSender(peer).step(looking(), 0.0)
    assert "output kept:here: ZeroDivisionError: division by zero;" in caplog.text and peer.closed == 1


def test_a_plug_in_that_raises_elsewhere_ends_nothing():
    class Broken(Peer):
        def statistics(self):
            raise ValueError("no figures")

        close = statistics

    sender = OutputSender(Broken())
    sender.output.trouble = OSError("gone")
    sender.step(looking(), 0.0)
    sender.close()
    assert sender.statistics()["state"] == "lost"


def test_a_sender_hands_over_the_newest_tick_and_the_events_that_have_begun():
    sender = OutputSender(Peer(), ["neck"])
    assert sender.frame() is None
    for start_s in (0.1, 0.5):
        sender.event(ListenerEvent("nod", start_s, 0.5, 0.2))
    for time_s in (0.1, 0.2):
        sender.tick(Tick(time_s, looking().motion, np.ones(1), {}, "listening"))
    frame = sender.frame()
    assert (frame.time_s, frame.joints, [each.start_s for each in frame.events]) == (0.2, ("neck",), [0.1])
    assert sender.frame().events == ()
    sender.tick(Tick(0.5, looking().motion, np.ones(1), {}, "listening"))
    assert [each.start_s for each in sender.frame().events] == [0.5]


def test_outputs_connect_send_and_end_in_threads_of_their_own():
    peers = [Peer(), Peer()]
    outputs = Outputs(peers)
    outputs.tick(Tick(0.0, looking(0.0).motion, np.zeros(0), {}, "listening"))
    outputs.close()
    outputs.close()
    assert [peer.closed for peer in peers] == [1, 1] and outputs.missing == ()
    assert {each["kind"] for each in outputs.statistics()} == {"kept"}


ADDRESSES = {
    "": ("127.0.0.1", 7), "9000": ("127.0.0.1", 9000), ":9000": ("127.0.0.1", 9000), "robot.local": ("robot.local", 7),
    "10.0.0.2:9000": ("10.0.0.2", 9000), "[::1]:9000": ("::1", 9000), "[fe80::1]": ("fe80::1", 7),
}  # fmt: skip


def test_addresses():
    assert {text: parse_address("vmc", text, 7) for text in ADDRESSES} == ADDRESSES


@pytest.mark.parametrize("text", ": host: ::1 [::1 []:9 host:0 :65536 a,b@c:9 http://h:9 h:x".split())
def test_what_is_not_an_address_is_refused_in_one_line(text):
    with pytest.raises(ConfigError, match=r"^--output vmc:.*: expected HOST:PORT, HOST or :PORT .*, got '.*'$"):
        parse_address("vmc", text, 7)


def test_a_kind_that_gives_no_output_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"^--output vcm: expected KIND or KIND:ADDRESS \(valid: json, vmc"):
        open_output("vcm")
    (tmp_path / "odd-1.0.dist-info").mkdir()
    (tmp_path / "odd-1.0.dist-info" / "entry_points.txt").write_text("[sfms_robot.outputs]\nodd = builtins:list\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match="expected an output from .*, got a list"):
        open_output("odd")
