"""Chain buses on emulated servos in this process: what each family makes of the contract, and what only some do."""

import numpy as np
import pytest
from chain_rig import plugged, rig_of
from emulated_devices import table_of

from sfms_robot.config import LoadRule, Safety, load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import ConfigError, ServoError

MODELS = ["xl330-m288", "ax-12a", "mx-28-1.0", "mx-64-1.0", "sts3215", "scs0009"]
OLDER = MODELS[1:]


def starts(model, *offsets):
    return [table_of(model).center_ticks + offset for offset in offsets]


@pytest.fixture(params=MODELS)
def model(request):
    return request.param


@pytest.fixture
def rig(model):
    """Four servos that stand here and there."""
    rig = rig_of(model, starts(model, -40, 0, 60, 20))
    yield rig
    rig.bus.close()


def tick_rad(rig):
    return rig.conversion.rad


def test_a_servo_that_lost_its_supply_between_stop_and_enable_is_set_up_again(rig):
    rig.hold()
    speed = rig.register(2, "moving_speed")
    rig.bus.stop("release")
    rig.servo(2).power_cycle(rig.clock.t)
    rig.clock.t += 1.0
    rig.set(2, "moving_speed", speed + 1)
    rig.bus.enable(rig.bus.joints)
    assert rig.register(2, "moving_speed") == speed and rig.torques() == [1] * 4


def test_families_and_byte_orders_cannot_share_a_bus():
    with pytest.raises(ConfigError, match="scs0009 and sts3215 have present_position at different places or"):
        rig_of(["sts3215", "scs0009"], [2048, 512])
    with pytest.raises(ConfigError, match="sts3215 does not speak dynamixel protocol 1"):
        rig_of(["ax-12a", "sts3215"], [512, 2048])


@pytest.mark.parametrize(
    "models",
    [
        ["xl-320", "xl-320"],
        ["xl430-w250", "2xl430-w250"],
        ["mx-28-2.0", "xm430-w350", "xl330-m288"],
        ["xc330-m181_fw52", "xw540-t260"],
    ],
)
def test_models_of_dynamixel_2_share_a_bus_and_follow(models):
    maps = [load_firmware_map(model) for model in models]
    servos = [
        EmulatedServo(
            i, each.variant_of or each.model, start_ticks=each.center_ticks, firmware=min(53, each.firmware.max)
        )
        for i, each in enumerate(maps, 1)
    ]
    rig = plugged(servos, maps=maps)
    held = rig.hold()
    for share in np.linspace(0, 1, 60):
        rig.ticks(held + 0.3 * share, 1)
    readings = rig.ticks(held + 0.3, 60)
    for each, (joint, reading) in zip(maps, readings.items(), strict=True):
        assert reading.position_rad == pytest.approx(0.3, abs=0.01) and reading.age_s == 0.0
        assert ("current_mA" in reading.extra) == ("current" in rig.bus.capabilities[joint])
        assert "current" not in rig.bus.capabilities[joint] or "present_current" in each.registers


def test_wire_that_is_wholly_quiet_blames_nobody_at_once(rig):
    held = rig.hold()
    rig.kill(1, 2, 3, 4)
    rig.ticks(held, 2)
    assert rig.bus.statistics()["silent"] == []
    rig.revive(1, 2, 3, 4)
    assert all(r.age_s == 0.0 for r in rig.ticks(held, 1).values())


@pytest.mark.parametrize("model", OLDER)
def test_servo_that_went_limp_gets_no_goals_until_it_is_enabled_again(rig):
    held = rig.hold()
    rig.servo(3).fail(1 << 5, rig.clock.t)  # overload: torque is gone
    assert rig.ticks(held, 20)["joint3"].fault == "overload"
    rig.ticks(held + 0.2, 50)
    assert rig.torques() == [1, 1, 0, 1]  # a goal would have switched it on
    assert rig.bus.enable(["joint3"]) == pytest.approx([held[2]], abs=tick_rad(rig))
    arrived = rig.ticks(held + 0.2, 100)
    assert arrived["joint3"].position_rad == pytest.approx(held[2] + 0.2, abs=tick_rad(rig))
    assert arrived["joint3"].fault is None


@pytest.mark.parametrize("model", OLDER)
def test_torque_lost_without_a_silence_is_noticed(rig):
    held = rig.hold()
    rig.ticks(held, 3)
    rig.servo(4).power_cycle(rig.clock.t)
    rig.servo(4).write(rig.servo(4).table["torque_enable"].address, b"\x00", rig.clock.t)
    for _ in range(20):  # no goals, which would switch it on
        rig.clock.t += 0.01
        rig.bus.poll(rig.clock.t)
    assert rig.bus.statistics()["faults"] == ["joint4: torque lost"]
    assert rig.ticks(held, 60)["joint4"].fault is None and rig.torques() == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("policy", "torques", "moves"), [("hold", [1, 1], False), ("limp", [1, 0], False), ("reduce", [1, 1], True)]
)
def test_fault_is_met_by_the_policy_of_the_head(policy, torques, moves):
    rig = rig_of("sts3215", [2048, 2048], safety=Safety(on_fault=policy))
    rig.hold()
    rig.ticks([0.0, 0.0], 2)
    rig.servo(2).fail(1 << 1, rig.clock.t)  # the encoder, which does not switch it off
    rig.ticks([0.0, 0.0], 2)
    rig.ticks([0.2, 0.2], 80)
    assert rig.torques() == torques and (abs(rig.servo(2).plant.position - 2048) > 100) is moves
    assert rig.register(2, "torque_limit") == (500 if policy == "reduce" else 1000)
    assert rig.bus.statistics()["faults"] == ["joint2: motor encoder"]


@pytest.mark.parametrize(
    "models", [["sts3215"], ["mx-64-1.0"], ["mx-28-1.0", "mx-64-1.0"], ["mx-106-1.0", "mx-28-1.0"]]
)
def test_pinched_joint_is_let_go_by_whoever_tells_its_current(models):
    rule = LoadRule(current_mA=400, for_s=0.1, then="limp")
    rig = rig_of(models, [2048] * len(models), safety=Safety(pinch=rule))
    held = rig.hold()
    for servo in rig.device.servos:
        servo.plant.stuck = True
    rig.ticks(held + 0.5, 40)
    tells = ["current" in what for what in rig.bus.capabilities.values()]
    assert tells == [model != "mx-28-1.0" for model in models]
    assert rig.torques() == [int(not each) for each in tells]
    assert all(": pinched" in fault for fault in rig.bus.statistics()["faults"])


def test_servo_that_shut_down_gets_its_strength_back_only_where_it_stands():
    rig = rig_of("ax-12a", [512], safety=Safety(torque_limit_percent=30))
    rig.set(1, "torque_limit", 0)
    rig.bus.connect()
    assert rig.register(1, "torque_limit") == 0
    rig.bus.enable(rig.bus.joints)
    assert rig.register(1, "torque_limit") == 300 and rig.register(1, "goal_position") == 512


def test_answers_are_switched_on_before_anything_is_asked(model):
    rig = rig_of(model, starts(model, 0, 0))
    level = rig.servo(1).table.role("status_level").name
    rig.set(1, level, 0)
    rig.hold()
    assert rig.register(1, level) == rig.servo(1).table[level].high


def test_mode_that_cannot_be_changed_under_torque_is_an_error():
    rig = rig_of("sts3215", [2048])
    rig.set(1, "operating_mode", 1)
    rig.set(1, "torque_enable", 1)
    with pytest.raises(ServoError, match=r"joint1 \(id 1\) has torque on and operating_mode 1, must be 0"):
        rig.bus.connect()


def test_reading_one_by_one_keeps_to_its_budget_and_reaches_everybody():
    rig = rig_of("scs0009", [512] * 28)
    readings = rig.ticks(rig.hold(), 8)
    ages = sorted(r.age_s for r in readings.values())
    assert ages[7] == 0.0 and ages[8] > 0.0  # eight of 28 in 6 ms at 1 Mbps
    assert ages[-1] == pytest.approx(0.03)  # and all of them within four ticks
