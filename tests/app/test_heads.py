"""A head's file -> its buses: what the file may say about safety, and what is refused before a port is opened."""

import numpy as np
import pytest

from sfms_robot.app.heads import FAMILIES, build_bus, emulated
from sfms_robot.config import Faults, Head, Safety, load_head, parse
from sfms_robot.errors import ConfigError
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.simulator.launch import launch


def head_of(**more) -> Head:
    """Two joints on two buses; `more` goes over the file."""
    joint = {"model": "xl330-m288", "id": 1, "zero_ticks": 2048, "min_deg": -30, "max_deg": 30, "limits": "slow"}
    raw = {
        "name": "two",
        "description": "two joints",
        "buses": {
            "face": {"family": "dynamixel", "baud": 1_000_000},
            "neck": {"family": "dynamixel", "baud": 57600, "rate_hz": 25},
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
        (
            {"registers": {"position_q_gain": 1}},
            r"position_q_gain = 1 is no register of xl330-m288 to be written \(.*pos",
        ),
        ({"registers": {"present_position": 1}}, "present_position = 1 is no register of xl330-m288 to be written"),
        ({"registers": {"position_p_gain": 99999}}, r"position_p_gain = 99999 does not fit xl330-m288 \(0..16383\)"),
    ],
)
def test_register_that_cannot_be_written_is_refused_before_a_port_is_opened(safety, message):
    with pytest.raises(ConfigError, match=message):
        build_bus(head_of(safety=safety), {"face": "/dev/null", "neck": "/dev/null"}, RealClock())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"safety": {"on_fault": "explode"}}, "safety.on_fault = 'explode'"),
        ({"safety": {"pinch": {"current_mA": -1, "for_s": 1}}}, "safety.pinch.current_mA = -1"),
        (
            {"faults": {"thresholds": {"shock": {"max": 1}}}},
            r"shock is about nothing that is measured \(input voltage, o",
        ),
        ({"faults": {"masks": ["overload"]}}, "'masks' is not a known key"),
    ],
)
def test_mistake_in_the_file_is_named(more, message):
    with pytest.raises(ConfigError, match=message):
        head_of(**more)


def test_bare_off_in_yaml_is_understood():
    buses = {"face": {"family": "dynamixel", "baud": 57600, "fast_read": False}}
    joints = {"jaw": head_of().joints["jaw"].model_dump(exclude_unset=True)}
    assert head_of(buses=buses, joints=joints).buses["face"].fast_read == "off"


def test_masks_are_those_of_the_head():
    assert head_of(faults={"mask": ["input voltage"]}).faults == Faults(mask=("input voltage",))


def test_every_family_has_a_bus_and_every_bus_of_a_shipped_head_a_family():
    for path in FAMILIES.values():
        module, name = path.split(":")
        assert name in (
            kind.__name__ for kind in vars(__import__(module, fromlist=[name])).values() if isinstance(kind, type)
        )
    assert {bus.family for bus in load_head("face28").buses.values()} <= set(FAMILIES)


@pytest.mark.parametrize("virtual", [True, False])
def test_two_buses_drive_one_head(virtual):
    head = head_of(safety={"current_limit_mA": 400})
    servos = emulated(head)
    with launch(servos["face"], virtual) as face, launch(servos["neck"], virtual) as neck:
        clock = VirtualClock() if virtual else RealClock()
        bus = build_bus(head, {"face": face, "neck": neck}, clock)
        bus.connect()
        held = bus.enable(["jaw", "yaw"])
        for k in range(1, 41):
            clock.wait_until(0.01 * k)
            bus.write(held * (1 - k / 40), clock.now_s())
            bus.poll(clock.now_s())
        clock.wait_until(1.0)
        bus.stop("hold")
        counts = bus.statistics()["buses"]
        positions = [reading.position_rad for reading in bus.poll(clock.now_s()).values()]
        bus.stop("release")
        bus.close()
    assert positions == pytest.approx(np.zeros(2), abs=0.02)
    assert counts["face"]["writes"] == 40 if virtual else counts["neck"]["writes"] < counts["face"]["writes"] <= 40


def test_current_limit_that_cannot_be_kept_is_refused():
    head = head_of()
    jaw = head.joints["jaw"].model_copy(update={"model": "xl430-w250", "safety": Safety(current_limit_mA=300)})
    head = head.model_copy(update={"joints": {**head.joints, "jaw": jaw}})
    with pytest.raises(ConfigError, match="current_limit_mA = 300.* cannot be kept: xl430-w250 has no current sensor"):
        build_bus(head, {"face": "/dev/null", "neck": "/dev/null"}, RealClock())
