"""Packets of each kind, read back by our own decoders and by independent readers."""

import asyncio
import json
import math
import socket

import numpy as np
import pytest
from free_ports import free_udp_port
from pythonosc.osc_packet import OscPacket
from websockets.sync.client import connect

from sfms_robot.errors import ConfigError, OutputError, PortError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, MOTION_DIM, SHAPES, ListenerEvent
from sfms_robot.outputs.avatars import LARGEST_PACKET, LiveLinkOutput, VmcOutput, VmcSingleOutput
from sfms_robot.outputs.json_stream import MOST_CLIENTS, MOST_RECEIVED, JsonStream, json_of
from sfms_robot.outputs.registry import open_output
from sfms_robot.ports import OutputFrame
from sfms_robot.sources.live_link import LiveLinkDecoder, parse_packet
from sfms_robot.sources.vmc import VmcDecoder


def face(seed=0, turned=0.6):
    """Return a frame with every channel at work, but for positions, which avatars are not sent."""
    rng, motion = np.random.default_rng(seed), np.zeros(MOTION_DIM, np.float32)
    motion[:3] = rng.uniform(-turned, turned, 3)
    motion[SHAPES] = rng.uniform(0, 1, len(BLENDSHAPES))
    return OutputFrame(time_s=12.34, motion=motion, state="listening")


@pytest.mark.parametrize("output", [VmcOutput(), VmcSingleOutput()], ids=["bundles", "single"])
@pytest.mark.parametrize("seed", range(5))
def test_our_decoder_reads_vmc_back(output, seed):
    decoder, frame = VmcDecoder(), face(seed)
    read = [decoder.decode(bytes(packet), 0.0) for packet in output.packets(frame, 0.0)]
    assert np.abs([each for each in read if each is not None][-1] - frame.motion).max() < 1e-3
    assert decoder.remark() is None and decoder.statistics()["wrong_messages"] == 0


def test_python_osc_reads_every_message_of_vmc():
    packets = VmcOutput().packets(face(), 0.0)
    assert max(map(len, packets)) <= LARGEST_PACKET
    messages = [each.message for packet in packets for each in OscPacket(bytes(packet)).messages]
    assert [(each.address, each.params) for each in messages[:1]] == [("/VMC/Ext/OK", [1, 3, 0, 1])]
    assert messages[1].address == "/VMC/Ext/T" and messages[1].params == [pytest.approx(12.34)]
    assert [each.params[0] for each in messages[2:6]] == ["Neck", "Head", "LeftEye", "RightEye"]
    values = {each.params[0]: each.params[1] for each in messages if each.address.endswith("Val")}
    assert list(values) == list(BLENDSHAPES)
    assert list(values.values()) == pytest.approx(face().motion[SHAPES].tolist())
    assert messages[-1].address == "/VMC/Ext/Blend/Apply" and len(messages) == 59


@pytest.mark.parametrize("seed", range(5))
def test_our_decoder_reads_live_link_back(seed):
    frame, output = face(seed), LiveLinkOutput()
    (data,) = output.packets(frame, 100.0)
    assert np.abs(LiveLinkDecoder().decode(data, 0.0) - frame.motion).max() < 1e-3
    packet = parse_packet(data)
    assert (packet.subject, packet.sent, packet.rate_hz) == ("sfms-robot", 61, 50.0)
    left = packet.values[55:58]
    look = {name: frame.motion[CHANNEL_INDEX[f"eyeLook{name}Left"]] for name in ("In", "Out", "Up", "Down")}
    assert left[0] == pytest.approx(math.radians(30) * (look["Out"] - look["In"]), abs=1e-6)
    assert left[1] == pytest.approx(math.radians(20) * (look["Down"] - look["Up"]), abs=1e-6) and left[2] == 0


def test_live_link_counts_frames_so_that_none_is_late_or_lost():
    output, decoder = LiveLinkOutput(), LiveLinkDecoder()
    for step in range(50):
        decoder.decode(output.packets(face(step), 7.0 + step / 50 + 0.015 * (step % 2))[0], step / 50)
    assert {decoder.statistics()[key] for key in ("lost", "late", "doubled")} == {0}


@pytest.mark.parametrize("kind", ["vmc", "live-link"])
def test_a_receiver_that_is_away_is_reported_on_this_machine(kind):
    output = open_output(f"{kind}:{free_udp_port()}")
    output.open()
    with pytest.raises(OutputError, match="nothing listens there: start "):
        for _ in range(10):
            output.send(face(), 0.0)
    output.close()


def test_a_name_without_an_address_is_reported():
    with pytest.raises(OutputError, match=r"no address found for no\.such\.machine\.invalid"):
        VmcOutput("no.such.machine.invalid").open()


def test_the_object_of_a_frame():
    motion = np.zeros(MOTION_DIM, np.float32)
    motion[:6] = 0.1, 0.2, 0.3, 0.01, 0.02, 0.03
    motion[SHAPES] = np.arange(52) / 52
    nod = ListenerEvent("nod", 1.0, 0.5, 0.2, swings=2, probability=0.25)
    found = json.loads(json_of(OutputFrame(time_s=1.02, motion=motion, state="listening", events=(nod,))))
    assert list(found) == "t state pose shapes events yaw pitch ts source frame".split()
    assert list(found["pose"]) == ["roll", "pitch", "yaw", "x", "y", "z"] and list(found["shapes"]) == [*BLENDSHAPES]
    assert [*found["pose"].values(), *found["shapes"].values()] == pytest.approx(motion.tolist(), abs=1e-4)
    assert (found["yaw"], found["pitch"]) == pytest.approx((math.degrees(0.3), math.degrees(0.2)), abs=1e-2)
    assert (found["t"], found["ts"], found["source"], found["frame"]) == (1.02, 1020, "sfms-robot", "base")
    assert list(found["events"][0].values()) == ["nod", 1.0, 0.5, 0.2, 2, 0.25]


@pytest.fixture
def stream():
    output = JsonStream("0")
    output.open()
    yield output
    output.close()


def served(output, client):
    """Return the first frame that reaches a client."""
    while not output.statistics()["clients"]:
        pass
    output.send(face(), 0.0)
    return json.loads(client.recv(timeout=60))


def test_a_plain_client_reads_frames_and_a_flood_is_disconnected(stream):
    with connect(f"ws://{stream.peer}/") as client:
        assert served(stream, client)["shapes"]["jawOpen"] == pytest.approx(
            face().motion[CHANNEL_INDEX["jawOpen"]], abs=1e-4
        )
        for _ in range(MOST_RECEIVED):
            client.send("hello")
        with pytest.raises(Exception, match=r"1008.*this server reads no messages"):
            while True:
                client.recv(timeout=60)


@pytest.mark.parametrize(
    "headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}], ids=["host", "origin"]
)
def test_requests_of_other_sites_are_refused(stream, headers):
    host, _, port = stream.peer.partition(":")
    with socket.create_connection((host, int(port))) as plain:
        lines = {"Host": stream.peer, "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        lines |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="} | headers
        plain.sendall(("GET / HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n").encode())
        assert plain.recv(4096).startswith(b"HTTP/1.1 403")
    assert stream.statistics()["refused"] == 1


def test_connections_that_stay_half_open_make_room(stream):
    host, _, port = stream.peer.partition(":")
    idle = [socket.create_connection((host, int(port))) for _ in range(MOST_CLIENTS + 3)]
    with connect(f"ws://{stream.peer}/") as client:
        assert served(stream, client)["source"] == "sfms-robot"
    for each in idle:
        each.close()


@pytest.mark.slow
def test_a_client_that_does_not_read_misses_frames_and_nothing_waits(stream):
    async def slow():
        from websockets.asyncio.client import connect as connect_async

        async with connect_async(f"ws://{stream.peer}/", max_queue=1) as client:
            while not stream.statistics()["missed"]:
                stream.send(face(), 0.0)
                await asyncio.sleep(0)
            assert json.loads(await client.recv())["t"] == 12.34

    asyncio.run(asyncio.wait_for(slow(), 30))


def test_a_port_that_is_taken_or_not_one_is_refused_at_once(stream):
    port = stream.peer.rpartition(":")[2]
    with pytest.raises(PortError, match=rf"^--output json: TCP port {port} on 127.0.0.1: is used by another program"):
        JsonStream(port)
    with pytest.raises(ConfigError, match=r"^--output json:0.0.0.0:1: expected a TCP port of this machine .* got"):
        JsonStream("0.0.0.0:1")
