"""The emulator's process as a whole: control socket, device, virtual time, its end; by pty and by TCP."""

import os
import signal
import subprocess
import sys

import pytest
import serial
from virtual_time import Time

from sfms_robot.app.servo.emulated_chains import until_stopped
from sfms_robot.app.wiring import EmulatedPort
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.errors import BusError, ConfigError, PortError
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import encode_instruction, maybe_packet
from sfms_robot.servo.port import SerialPort, VirtualTimePort

POSITIONS = (132).to_bytes(2, "little") + (4).to_bytes(2, "little")
BAUD = 1_000_000


class Host:
    """A host in virtual time."""

    def __init__(self, chain: Chain):
        self.clock = Time()
        self.port = VirtualTimePort(chain.device, chain.control, BAUD, self.clock)

    def ask(self, *ids: int, patience_s: float = 0.003) -> list[int]:
        """Ids that answer a sync read within `patience_s`."""
        self.port.discard_input()
        self.port.write(encode_instruction(dxl2.BROADCAST, dxl2.SYNC_READ, POSITIONS + bytes(ids)))
        buffer = bytearray()
        while data := self.port.read(4096, self.clock.t + patience_s):
            buffer += data
        found = []
        while (packet := maybe_packet(buffer)) is not None:
            found.append(packet.servo)
        return found


@pytest.fixture(params=["pty", "tcp"])
def transport(request):
    return request.param


@pytest.fixture
def virtual(transport):
    """Start a chain in virtual time and a host on it."""
    open_ = []

    def start(*servos: EmulatedServo, **how):
        chain = launch(servos or [EmulatedServo(i) for i in (1, 2, 3)], virtual=True, transport=transport, **how)
        open_.append(chain)
        host = Host(chain)
        open_.append(host.port)
        return chain, host

    yield start
    for each in reversed(open_):
        each.close()


def ping(device: str, servo: int, baud: int = BAUD) -> bytes:
    with serial.serial_for_url(device, baud, timeout=10) as port:
        port.write(encode_instruction(servo, dxl2.PING))
        return port.read(14)


class Resuming(RealClock):
    """A clock that lets a stopped process continue once `at_s` is past."""

    at_s, pid = float("inf"), 0

    def now_s(self):
        now_s = super().now_s()
        if now_s > self.at_s:
            os.kill(self.pid, signal.SIGCONT)
        return now_s


@pytest.mark.parametrize("transport", ["pty", "tcp"])
def test_a_silence_counts_only_if_the_emulator_confirms_it(transport):
    clock = Resuming()
    with launch([EmulatedServo(1), EmulatedServo(2)], transport=transport) as chain:
        port = EmulatedPort(chain.device, chain.control, BAUD, clock)
        port.discard_input()
        chain.kill(2)
        port.write(encode_instruction(2, dxl2.PING))
        assert port.read(14, port.now_s() + 0.001) == b""  # it is silent
        os.kill(chain.pid, signal.SIGSTOP)
        port.write(encode_instruction(1, dxl2.PING))
        clock.pid, clock.at_s = chain.pid, clock.now_s() + 0.001
        deadline_s = port.now_s() + 0.001
        assert len(port.read(14, deadline_s)) == 14  # the emulator is late
        port.wait_until(deadline_s + 0.001)
        assert clock.now_s() > clock.at_s + 0.001  # which is not time of the servos
        assert port.read(14, port.now_s()) == b""
        chain.inject("delay:1=0.01")  # less than the patience, which counts from when the request comes to the servo
        clock.at_s = clock.now_s() + 0.02
        os.kill(chain.pid, signal.SIGSTOP)
        port.write(encode_instruction(1, dxl2.PING))
        assert len(port.read(14, port.now_s() + 0.02)) == 14
        port.close()


@pytest.mark.parametrize(("delay", "later"), [("delay:2=0.005", [1]), ("delay:2@0-0.005=0.0105", [1, 2])])
def test_reply_that_is_late_counts_as_silence_and_is_seen_only_after_the_next_flush(virtual, delay, later):
    chain, host = virtual(faults=[delay])
    assert host.ask(1, 2, 3) == [1, 3]
    host.clock.t = 0.01
    assert host.ask(1) == later  # what came at 0.005 was thrown away


@pytest.mark.parametrize("request_", ["inject dorp", "inject drop:9", "turn 1 x", "turn", "supply", "state 9", "dance"])
def test_request_that_makes_no_sense_is_refused_and_harms_nothing(virtual, request_):
    chain, host = virtual()
    pytest.raises(BusError, chain.ask, request_).match("refuses")
    assert host.ask(1, 2, 3) == [1, 2, 3]


def test_unplugged_device_vanishes_and_comes_back_under_its_name(transport):
    with launch([EmulatedServo(1)], transport=transport) as chain:
        port = SerialPort(chain.device, BAUD, Time())
        chain.hang_up()
        with pytest.raises(BusError):
            for _ in range(3):
                port.write(b"x" * 64)
                port.read(1, 10.0)
        port.close()
        with pytest.raises(PortError, match="no such device|refused"):
            SerialPort(chain.device, BAUD, Time())
        chain.come_back()
        assert len(ping(chain.device, 1)) == 14


@pytest.mark.parametrize(("model", "baud"), [("xl430-w250", 4_500_000), ("xl330-m288", 57_600)])
def test_odd_bauds_are_heard_and_others_are_not(model, baud):
    with launch([EmulatedServo(1, model, baud)]) as chain:
        assert len(ping(chain.device, 1, baud)) == 14
        with serial.Serial(chain.device, 1_000_000, timeout=0) as port:
            port.write(encode_instruction(1, dxl2.PING))
            chain.digest()
            assert port.read(14) == b""


def test_a_link_is_made_replaced_where_its_emulator_was_killed_and_removed(tmp_path):
    link = tmp_path / "servos"
    link.symlink_to(tmp_path / "gone")
    with launch([EmulatedServo(1)], link=str(link)) as chain:
        assert chain.device == str(link) and len(ping(str(link), 1)) == 14
        with pytest.raises(ConfigError, match="is already there"):
            launch([EmulatedServo(1)], link=str(link))
    assert not os.path.lexists(link)
    with launch([EmulatedServo(1)], link=str(link)) as chain:
        os.kill(chain.pid, signal.SIGKILL)
        pytest.raises(BusError, until_stopped, {"servos": chain}).match(f"the emulated chain {chain.device} has ended")
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("servos", "how", "message"),
    [
        ([EmulatedServo(1), EmulatedServo(1)], {}, "id = 1 is used twice"),
        ([EmulatedServo(253)], {}, "id = 253 is not a servo id"),
        ([EmulatedServo(1, baud=12345)], {}, r"baud = 12345 is not a rate of xl330-m288 \(9600, 57600"),
        ([EmulatedServo(1, model="xl999")], {}, "'xl999' has no firmware map"),
        ([EmulatedServo(1, registers={"homing": 3})], {}, "register = 'homing' is not a register of xl330-m288"),
        ([EmulatedServo(1, registers={"shutdown": 300})], {}, r"shutdown = 300 is out of range of xl330-m288 \(0..255"),
        ([EmulatedServo(1, "maestro-24", supply_v=11.0)], {}, "'maestro-24' is a board of hobby servos: it has no"),
        ([EmulatedServo(1, "ssc-32", registers={"crc": 1})], {}, "model = 'ssc-32' is a board of hobby servos"),
        ([EmulatedServo(24, "maestro-24")], {}, r"id = 24 is not a servo id \(0..23\)"),
        ([EmulatedServo(1)], {"faults": ["drop:7"]}, "'drop:7' concerns no servo of this wire"),
        ([EmulatedServo(1)], {"link": "/no/such/folder/x"}, "lies in a folder that does not exist"),
        ([EmulatedServo(1)], {"link": "x", "transport": "tcp"}, "needs a pseudo terminal, which only Linux has"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(servos, how, message):
    with pytest.raises(ConfigError, match=message) as caught:
        launch(servos, **how)
    assert "\n" not in str(caught.value)


def test_hosts_at_a_tcp_port_share_the_wire_and_lose_nothing_they_wrote():
    with launch([EmulatedServo(1), EmulatedServo(2)], transport="tcp") as chain:
        first, second = (SerialPort(chain.device, BAUD, RealClock()) for _ in range(2))
        for port, servo in ((first, 1), (second, 2), (first, 2)):  # the answer is the writer's
            port.write(encode_instruction(servo, dxl2.PING))
            assert port.read(14, port.now_s() + 10.0)[4] == servo
        first.write(encode_instruction(1, dxl2.WRITE, bytes([64, 0, 1])))  # torque
        first.close()
        assert len(ping(chain.device, 1)) == 14 and chain.state(1)["torque"]
        second.close()


def test_emulator_needs_no_heavy_library():
    code = "import sys, sfms_robot.emulator.chain_process, sfms_robot.emulator.servo_chains; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split()
    assert "sfms_robot.emulator.servo_chains" in loaded
    assert not {"torch", "scipy", "numpy", "pydantic", "yaml"} & {*loaded}
