"""A head's file -> its buses: what the file may say about safety, and what is refused before a port is opened."""

import pytest

from sfms_robot.app.open_head import build_bus
from sfms_robot.app.wiring import emulated, plugged_in
from sfms_robot.config import Head, Safety, load_head, parse
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.errors import ConfigError, PortError
from sfms_robot.runtime.clock import RealClock, VirtualClock


def head_of(**more) -> Head:
    """Two joints on two buses; `more` goes over the file."""
    joint = {"model": "xl330-m288", "id": 1, "zero_ticks": 2048, "min_deg": -30, "max_deg": 30, "limits": "slow"}
    raw = {
        "name": "two",
        "description": "two joints",
        "buses": {
            "face": {"family": "dynamixel2", "baud": 1_000_000},
            "neck": {"family": "dynamixel2", "baud": 57600, "rate_hz": 25},
        },
        "limits": {"slow": {"speed_deg_s": 90, "acceleration_deg_s2": 900, "jerk_deg_s3": 9000}},
        "joints": {"jaw": {"bus": "face", **joint}, "yaw": {"bus": "neck", **joint}},
    }
    return parse(Head, raw | more, "head.yaml")


def test_joint_says_what_is_different_from_its_head():
    head = head_of(safety={"current_limit_mA": 400, "stop": "hold"})
    assert head.safety_of("jaw") == Safety(current_limit_mA=400, stop="hold")
    yaw = head.joints["yaw"].model_copy(update={"safety": Safety(stop="release", registers={"position_p_gain": 300})})
    head = head.model_copy(update={"joints": {**head.joints, "yaw": yaw}})
    assert head.safety_of("yaw") == Safety(current_limit_mA=400, stop="release", registers={"position_p_gain": 300})


@pytest.mark.parametrize(
    ("safety", "message"),
    [
        ({"registers": {"position_q_gain": 1}}, r"position_q_gain = 1 is not a register of xl330-m288 \(.*pos"),
        ({"registers": {"present_position": 1}}, "present_position = 1 of xl330-m288 must not be set by a head's file"),
        ({"registers": {"position_p_gain": 99999}}, r"position_p_gain = 99999 does not fit xl330-m288 \(0..16383\)"),
    ],
)
def test_register_that_cannot_be_written_is_refused_before_a_port_is_opened(safety, message):
    with pytest.raises(ConfigError, match=message):
        build_bus(head_of(safety=safety), {"face": "/dev/null", "neck": "/dev/null"}, RealClock())


def test_current_limit_that_cannot_be_kept_is_refused():
    head = head_of()
    jaw = head.joints["jaw"].model_copy(update={"model": "xl430-w250", "safety": Safety(current_limit_mA=300)})
    head = head.model_copy(update={"joints": {**head.joints, "jaw": jaw}})
    with pytest.raises(ConfigError, match="current_limit_mA = 300.* be kept: xl430-w250 cannot limit its current"):
        build_bus(head, {"face": "/dev/null", "neck": "/dev/null"}, RealClock())


def test_an_adapter_is_named_while_it_is_there_so_that_it_is_found_again_under_another_device(monkeypatch):
    looks: list[str] = []
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: looks.append("looked") or [])
    bus = build_bus(load_head("op3_head"), {"main": "/dev/ttyUSB99"}, RealClock())
    with pytest.raises(PortError):
        bus.connect()
    assert looks == ["looked"]


def bus_of(family, model, safety, faults=None) -> Head:
    """One joint on one bus of a family."""
    joint = {"bus": "main", "model": model, "id": 1, "min_deg": -30, "max_deg": 30, "limits": "slow"}
    joint["zero_ticks"] = 512 if model == "ax-12a" else 2048
    more = {"buses": {"main": {"family": family, "baud": 1_000_000}}, "joints": {"jaw": joint}}
    return head_of(**more, safety=safety, faults=faults or {})


@pytest.mark.parametrize(
    ("family", "model", "safety", "message"),
    [
        ("dynamixel1", "ax-12a", {"current_limit_mA": 300}, "limit its current; torque_limit_percent limits its"),
        ("dynamixel1", "ax-12a", {"pinch": {"current_mA": 300, "for_s": 1}}, "for jaw: ax-12a does not report its"),
        ("feetech", "scs0009", {"torque_limit_percent": 50}, "for jaw: scs0009 has no torque limit .*percent: null"),
        ("maestro", "maestro-6", {"current_limit_mA": 300}, "for jaw: maestro-6 cannot limit its current \\("),
    ],
)
def test_limit_of_the_whole_head_names_the_joint_that_cannot_keep_it(family, model, safety, message):
    with pytest.raises(ConfigError, match=r"two: safety\..* cannot be kept .*" + message):
        build_bus(bus_of(family, model, safety), {"main": "/dev/null"}, RealClock())


@pytest.mark.parametrize(("mask", "fault"), [([], "input voltage"), (["input voltage"], None)])
@pytest.mark.parametrize(("family", "model"), [("dynamixel1", "ax-12a"), ("feetech", "sts3215")])
def test_masked_fault_is_none_in_every_family(family, model, mask, fault):
    head, clock = bus_of(family, model, {}, {"mask": mask}), VirtualClock()
    servo = EmulatedServo(1, model, start_ticks=head.joints["jaw"].zero_ticks)
    with launch([servo], virtual=True) as chain:
        chain.supply(20.0)
        bus = build_bus(head, {"main": chain}, clock)
        bus.connect()
        held = bus.enable(["jaw"])
        clock.wait_until(0.01)
        bus.write(held, 0.01)
        assert bus.poll(0.01)["jaw"].fault == fault
        bus.stop("release")
        bus.close()


def test_emulated_servos_have_stored_what_those_of_the_head_have():
    head = load_head("reachy_mini")
    legs = {servo.id: servo for servo in plugged_in(head)["main"]}
    assert all(servo.supply_v == 7.2 and servo.registers["shutdown"] == 52 for servo in legs.values())
    assert (legs[11].registers["homing_offset"], legs[12].registers["homing_offset"]) == (1024, -1024)
    assert plugged_in(load_head("face28")) == emulated(load_head("face28"))
