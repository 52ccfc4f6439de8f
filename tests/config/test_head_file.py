"""Values of a head's file that would hurt, and what a run may write into a servo."""

import re

import pytest

from sfms_robot.config import FirmwareMap, Safety, load_firmware_map, load_head, map_files
from sfms_robot.config.check import check_head, is_harmless, register_problems
from sfms_robot.config.consistency import highest_rate_hz
from sfms_robot.errors import ConfigError

HEAD = """
{more}
name: small
description: two joints
buses: {{main: {{family: dynamixel2, baud: 57600, rate_hz: 50{bus}}}}}
limits: {{slow: {{speed_deg_s: 90, acceleration_deg_s2: 900, jerk_deg_s3: 9000}}}}
joint_defaults: {{bus: main, model: xl330-m288, zero_ticks: 2048, min_deg: -10, max_deg: 20, limits: slow}}
joints:
  jaw: {{id: 1{joint}}}
  lid: {{id: 2}}
"""


def written(folder, more="", bus="", joint=""):
    (folder / "head.yaml").write_text(HEAD.format(more=more, bus=bus, joint=joint))
    return str(folder)


WRONG = {
    "rate of a baud slip": (dict(bus=", rate_hz: 1000000"), "'rate_hz' is given twice"),
    "id by yes": (dict(joint=", ratio: yes"), "joints.jaw.ratio = 'yes'"),
    "id by true": (dict(joint=", ratio: true"), "joints.jaw: ratio = true is neither a number nor a name"),
    "lag of days": (dict(joint=", lag_ms: 1.0e9"), "joints.jaw.lag_ms = 1000000000.0: .*less than or equal to 500"),
    "deadline of days": (dict(bus=", read_deadline_ms: 1.0e9"), "buses.main.read_deadline_ms = .* to 100"),
    "stagger of days": (dict(bus=", stagger_ms: 1.0e9"), "buses.main.stagger_ms = .* equal to 1000"),
    "crc of servos": (dict(bus=", crc: true"), "buses.main.crc = True: expected false, as only a Maestro"),
    "register by true": (dict(joint=", safety: {registers: {led: true}}"), "joints.jaw.safety.registers.led = True"),
    "a newer version": (dict(more="version: 2\nunheard_of: 3"), "version = 2 is of a newer sfms-robot; .* version 1"),
    "no version": (dict(more="version: -1"), "version = -1"),
    "octal": (dict(joint=", ratio: 010"), "leading zero"),
}


@pytest.mark.parametrize(("change", "told"), WRONG.values(), ids=WRONG.keys())
def test_what_would_hurt_is_one_line(tmp_path, change, told):
    name = written(tmp_path, **change)
    with pytest.raises(ConfigError, match=told) as caught:
        load_head(name)
    assert "\n" not in str(caught.value)
    assert check_head(name) and all("\n" not in line for line in check_head(name))


def changed(tmp_path, before, after):
    """A small head with other words in its file."""
    name, file = written(tmp_path), tmp_path / "head.yaml"
    file.write_text(file.read_text().replace(before, after))
    return name


def test_a_rate_that_the_wire_cannot_carry_is_refused_with_the_highest_it_can(tmp_path):
    highest = highest_rate_hz("dynamixel2", 57600, 2)
    assert highest == 240  # 14 bytes and 5 for each of two servos, 10 bits each
    with pytest.raises(ConfigError, match=r"buses.main.rate_hz = 241 is more than 57600 baud carry .* \(at most 240\)"):
        load_head(changed(tmp_path, "rate_hz: 50", "rate_hz: 241"))
    assert any("at most 240" in line for line in check_head(str(tmp_path)))
    assert load_head(changed(tmp_path, "rate_hz: 50", "rate_hz: 240")).buses["main"].rate_hz == 240
    with pytest.raises(ConfigError, match="rate_hz = 1000000.*less than or equal to 1000"):
        load_head(changed(tmp_path, "rate_hz: 50", "rate_hz: 1000000"))


@pytest.mark.parametrize(
    ("family", "model", "most"),
    [("dynamixel2", "xl330-m288", 202), ("dynamixel1", "ax-12a", 80), ("feetech", "sts3215", 83)],
)
def test_more_servos_than_one_packet_of_goals_holds_are_refused(tmp_path, family, model, most):
    for count in (most, most + 1):
        text = HEAD.format(more="", bus="", joint="").replace("dynamixel2, baud: 57600", f"{family}, baud: 4000000")
        text = text.replace("rate_hz: 50", "rate_hz: 20").replace("xl330-m288", model)
        joints = "".join(f"  j{servo}: {{id: {servo}}}\n" for servo in range(3, count + 1))
        (tmp_path / "head.yaml").write_text(text + joints)
        if count == most:
            assert len(load_head(str(tmp_path)).joints) == most and check_head(str(tmp_path)) == []
    problem = rf"head.yaml: buses.main: expected at most {most} joints .*{family}.*, got {most + 1}"
    with pytest.raises(ConfigError, match=problem):
        load_head(str(tmp_path))
    assert re.search(problem, check_head(str(tmp_path))[0])


@pytest.mark.parametrize("family", ["dynamixel2", "dynamixel1", "feetech", "maestro", "ssc32"])
@pytest.mark.parametrize("baud", [1200, 57_600, 4_000_000])
def test_no_family_goes_beyond_a_thousand_and_none_comes_to_a_stop(family, baud):
    rates = [highest_rate_hz(family, baud, joints) for joints in range(1, 60)]
    assert all(1 <= rate <= 1000 for rate in rates) and rates == sorted(rates, reverse=True)


MAPS = [load_firmware_map(file.stem) for file in map_files()]
HURTS = {
    "goal_position", "torque_enable", "id", "baud_rate", "status_level", "lock", "torque_limit", "bus_watchdog",
    "operating_mode", "return_delay", "error_status",
}  # fmt: skip


@pytest.mark.parametrize("table", MAPS, ids=lambda table: table.model)
def test_nothing_that_says_who_a_servo_is_or_what_it_does_may_be_written_unasked(table: FirmwareMap):
    names = HURTS | {table.roles.get(role) or role for role in HURTS}
    for name, register in table.registers.items():
        if (
            name in names
            or register.area == "EEPROM"
            or register.access == "R"
            or name.startswith(("goal", "indirect"))
        ):
            assert not is_harmless(table, name), name


def test_what_is_stored_is_stored_for_good_and_fits():
    table = load_firmware_map("xl330-m288")
    assert not [*register_problems(Safety(stored={"drive_mode": 1, "homing_offset": -5}), table)]
    (forgotten,) = register_problems(Safety(stored={"led": 1}), table)
    assert "is forgotten" in forgotten[2]
    (too_large,) = register_problems(Safety(stored={"drive_mode": 999}), table)
    assert "does not fit" in too_large[2]
