"""The servo tools on emulated servos in virtual time: what they find, change, and refuse to change."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sfms_robot.app.servo import single_servo as single
from sfms_robot.app.servo.serial_line import Wire, open_wire, other_wires, protocol_hint
from sfms_robot.app.servo.single_servo import set_baud
from sfms_robot.app.wiring import EmulatedPort
from sfms_robot.config import load_firmware_map
from sfms_robot.config.base import load
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.errors import BusError, ConfigError, PortError, ServoError
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.servo.port import VirtualTimePort
from sfms_robot.servo.registers import Table

THREE = (EmulatedServo(1), EmulatedServo(2, baud=57_600, start_ticks=1500), EmulatedServo(7, start_ticks=2300))


def yes(question: str) -> bool:
    return True


def no(question: str) -> bool:
    return False


@contextmanager
def wire_on(
    *servos: EmulatedServo, family: str = "dynamixel2", baud: int | None = None
) -> Iterator[tuple[Wire, Chain]]:
    with launch(servos, virtual=True) as chain:
        clock = VirtualClock()
        port = VirtualTimePort(chain.device, chain.control, baud or 1_000_000, clock)
        try:
            yield Wire(port, family, baud or 1_000_000, fixed=baud is not None), chain
        finally:
            port.close()


@pytest.fixture
def three() -> Iterator[tuple[Wire, Chain]]:
    """Ids 1 and 7 at 1 Mbaud, 2 at the factory rate."""
    with wire_on(*THREE) as both:
        yield both


def put(wire: Wire, servo: int, register: str, value: int) -> None:
    single.write_register(wire.find(servo), register, str(value), yes)


def test_a_scan_finds_every_servo_at_its_own_rate_and_two_with_one_id(three):
    wire, chain = three
    steps = []
    found = single.scan(wire, progress=lambda done, total, what: steps.append((done, total, what)))
    assert sorted((each.id, each.baud, each.model, each.firmware) for each in found) == [
        (1, 1_000_000, "xl330-m288", 53), (2, 57_600, "xl330-m288", 53), (7, 1_000_000, "xl330-m288", 53),
    ]  # fmt: skip
    assert steps[0][0] == 0 and steps[-1][0] == steps[-1][1] and "3 found" in steps[-1][2]
    assert single.scan(wire, ids=range(10)) == found and wire.find(2).baud == 57_600 == wire.baud
    chain.inject("duplicate:7=1")
    assert {each.id for each in single.scan(wire) if each.twice} == {7}


def test_a_fixed_rate_is_the_only_one_looked_at():
    with wire_on(*THREE, baud=1_000_000) as (wire, _):
        assert [each.id for each in single.scan(wire)] == [1, 7]
        with pytest.raises(BusError, match="no answer from id 2 at 1000000 baud"):
            wire.find(2)


def test_a_model_without_a_number_is_read_when_somebody_says_what_it_is():
    with wire_on(EmulatedServo(1, "sts3032"), family="feetech") as (wire, _):
        with pytest.raises(ConfigError, match=r"no firmware map.*sts3032.*--model"):
            single.read_registers(wire.find(1), ["voltage"])
        told = Wire(wire.port, "feetech", wire.baud, model="sts3032")
        assert single.read_registers(told.find(1), ["voltage"])[0]["raw"] > 0


def test_an_id_out_of_range_and_one_of_two_servos_are_left_alone(three):
    wire, chain = three
    before = chain.digest()
    with pytest.raises(ConfigError, match=r"0\.\.252"):
        wire.find(253)
    assert chain.digest() == before
    chain.inject("duplicate:1=1")
    with pytest.raises(ServoError, match="two servos seem to answer"):
        single.set_id(wire.find(1), 5, yes, in_chain=True)


def test_registers_are_read_by_name_in_raw_and_unit(three):
    wire, _ = three
    (goal, volt) = single.read_registers(wire.find(2), ["present_position", "voltage"])
    assert goal["raw"] == 1500 and goal["value"] == pytest.approx(1500 * 360 / 4096) and goal["unit"] == "deg"
    assert volt["register"] == "present_input_voltage" and volt["unit"] == "V"
    values = single.read_registers(wire.find(7), ["all"])  # one by one
    state = single.read_all(wire.find(7))
    addresses = [each["address"] for each in values]
    assert addresses == sorted(addresses) and len(values) == len(load_firmware_map("xl330-m288").registers)
    for each in values:
        assert each["register"] == "realtime_tick" or state.value(each["register"]) == each["raw"]


def test_a_ram_register_is_written_unasked_and_eeprom_stays_closed_while_torque_is_on(three):
    wire, _ = three
    written = single.write_register(wire.find(1), "led", "1", no)
    assert (written["before"], written["raw"]) == (0, 1)
    put(wire, 1, "torque_enable", 1)
    with pytest.raises(ServoError, match="servo write 1 torque_enable 0"):
        single.write_register(wire.find(1), "return_delay_time", "0", yes)


def test_a_value_may_carry_the_unit_of_the_register():
    position = Table.of(load_firmware_map("xl330-m288"))["goal_position"]
    assert single.parse_value("m", position, "180deg") == 2048 and single.parse_value("m", position, "-7") == -7
    for text, problem in (("180rad", "not a v"), ("1.5", "not a v"), ("x", "not a v"), ("9999999", "range")):
        with pytest.raises(ConfigError, match=problem):
            single.parse_value("m", position, text)


@pytest.mark.parametrize(
    ("register", "value", "problem"),
    [
        ("present_position", "1", "read-only"),
        ("return_delay_time", "255", r"0\.\.254"),
        ("id", "5", "set-id"),
        ("baud_rate", "3", "set-baud"),
        ("goal_postion", "3", "goal_postion.*goal_position"),
    ],
)
def test_what_may_not_be_written_is_refused_before_anything_is_sent(three, register, value, problem):
    wire, chain = three
    seen, before = wire.find(1), chain.digest()
    with pytest.raises(ConfigError, match=problem):
        single.write_register(seen, register, value, yes)
    assert chain.digest() == before


def test_a_servo_that_answers_pings_only_is_said_to_be_one(three):
    wire, _ = three
    put(wire, 1, "status_return_level", 1)  # it acknowledges nothing
    assert single.write_register(wire.find(1), "led", "1", yes)["raw"] == 1
    seen = wire.find(1)
    field = seen.registers()["status_return_level"]
    wire.link.write(1, field.address, field.to_bytes(0))
    with pytest.raises(ServoError, match="status return level 0"):
        single.read_registers(seen, ["led"])
    put(wire, 1, "status_return_level", 2)
    assert single.read_registers(seen, ["led"])[0]["raw"] == 1


def test_an_id_is_changed_and_on_a_wire_of_several_needs_to_be_meant(three):
    with wire_on(EmulatedServo(1, baud=57_600)) as (wire, _):
        changed = single.set_id(wire.find(1), 5, yes)
        assert (changed.id, changed.baud, [each.id for each in single.scan(wire)]) == (5, 57_600, [5])
    wire, _ = three
    with pytest.raises(ConfigError, match="id 7.*--in-chain"):
        single.set_id(wire.find(1), 5, yes)
    assert single.set_id(wire.find(1), 5, yes, in_chain=True).id == 5
    assert sorted(each.id for each in single.scan(wire, ids=range(10))) == [2, 5, 7]


@pytest.mark.parametrize(
    ("new", "problem"), [(7, "taken"), (253, r"0\.\.252"), (-1, r"0\.\.252"), (1, "the id it has")]
)
def test_an_id_that_cannot_be_had_is_refused(three, new, problem):
    wire, _ = three
    with pytest.raises(ConfigError, match=problem):
        single.set_id(wire.find(1), new, yes, in_chain=True)
    assert wire.find(1).id == 1


def test_a_wire_that_loses_answers_now_and_then_only_needs_patience(three):
    wire, chain = three
    chain.inject("drop=0.2")
    assert [single.read_registers(wire.find(7), ["present_position"])[0]["raw"] for _ in range(20)] == [2300] * 20


def test_nothing_changes_when_the_answer_is_no():
    with wire_on(EmulatedServo(1)) as (wire, _):
        for change in (
            lambda: single.set_id(wire.find(1), 5, no),
            lambda: set_baud(wire.find(1), 57_600, no),
            lambda: single.factory_reset(wire.find(1), "all", no),
            lambda: single.write_register(wire.find(1), "return_delay_time", "0", no),
        ):
            with pytest.raises(ConfigError, match="not confirmed"):
                change()
        assert wire.find(1).baud == 1_000_000
        assert single.read_registers(wire.find(1), ["return_delay_time"])[0]["raw"] == 250
        assert single.write_register(wire.find(1), "return_delay_time", "0us", yes)["raw"] == 0


def test_a_rate_the_servo_does_not_have_lists_those_it_has_and_another_is_changed_and_met_again(three):
    wire, _ = three
    with pytest.raises(ConfigError, match=r"250000.*57600.*1000000"):
        set_baud(wire.find(1), 250_000, yes)
    assert set_baud(wire.find(2), 1_000_000, yes).baud == 1_000_000
    assert sorted(each.id for each in single.scan(wire) if each.baud == 1_000_000) == [1, 2, 7]


def test_a_reboot_forgets_a_fault_and_asks_before_it_lets_go(three):
    wire, chain = three
    put(wire, 1, "torque_enable", 1)
    with pytest.raises(ConfigError, match="lets go"):
        single.reboot(wire.find(1), no)
    chain.fault(1, 0x20)
    assert single.watched(wire.find(1))["faults"] == "overload" and single.reboot(wire.find(1), yes).id == 1
    assert single.watched(wire.find(1))["faults"] == ""


@pytest.mark.parametrize(("keep", "servo", "baud"), [("all", 1, 57_600), ("keep-id", 7, 57_600),
                                                     ("keep-id-and-baud", 7, 1_000_000)])  # fmt: skip
def test_a_factory_reset_ends_where_it_says(keep, servo, baud):
    with wire_on(EmulatedServo(7)) as (wire, _):
        back = single.factory_reset(wire.find(7), keep, yes)
        assert (back.id, back.baud) == (servo, baud)


@pytest.mark.parametrize(
    ("model", "number", "baud"), [("ax-12a", 1, 1_000_000), ("ax-12a", 7, 57_600), ("sts3215", 7, 115_200)]
)
@pytest.mark.parametrize("keep", ["all", "keep-id", "keep-id-and-baud"])
def test_what_a_protocol_without_options_resets_is_written_back(model, number, baud, keep):
    """A servo of Protocol 1 has id 1 and 1 Mbaud afterwards, whatever it was asked to keep."""
    servo = EmulatedServo(number, model, baud, load_firmware_map(model).center_ticks, registers={"max_torque": 300})
    family = "feetech" if model == "sts3215" else "dynamixel1"
    with wire_on(servo, family=family) as (wire, _):
        back = single.factory_reset(wire.find(number), keep, yes)
        assert back.id == (1 if keep == "all" else number)
        assert back.baud == (baud if keep == "keep-id-and-baud" else 1_000_000)
        assert wire.find(back.id).baud == back.baud
        assert single.read_registers(back, ["max_torque"])[0]["raw"] == back.registers()["max_torque"].initial


def test_a_factory_reset_takes_no_other_servos_id():
    """Id 1 is at the rate that id 7 had: it must not get the id of the other."""
    center = load_firmware_map("ax-12a").center_ticks
    with wire_on(*(EmulatedServo(i, "ax-12a", 57_600, center) for i in (1, 7)), family="dynamixel1") as (wire, _):
        assert single.factory_reset(wire.find(7), "keep-id-and-baud", yes).id == 7
        assert [wire.find(i).baud for i in (1, 7)] == [57_600, 57_600]
    with wire_on(EmulatedServo(1, baud=57_600), EmulatedServo(7)) as (wire, _):
        with pytest.raises(ConfigError, match="id 1.*unplug"):
            single.factory_reset(wire.find(7), "all", yes)
        assert wire.find(7).baud == 1_000_000


def test_the_second_number_of_an_sts_firmware_is_read():
    with wire_on(EmulatedServo(1, "sts3215", registers={"firmware_minor": 9}), family="feetech") as (wire, _):
        row = wire.find(1).row()
        assert (row["firmware"], row["firmware_minor"]) == (53, 9)


def test_emulated_servos_confirm_a_silence_as_in_a_run():
    with open_wire("sim", "dynamixel2", None, "op3_head") as wire:
        assert isinstance(wire.port, EmulatedPort)
        assert [wire.ping(servo) is not None for servo in (19, 20, 21)] == [True, True, False]


class Choosy(VirtualTimePort):
    """The port of an adapter that cannot do 2 Mbaud and more."""

    def set_baud(self, baud: int) -> None:
        if baud >= 2_000_000:
            raise PortError(f"{self.name}: the adapter cannot do {baud} baud")
        super().set_baud(baud)


def test_rates_that_the_adapter_cannot_do_are_passed_over_and_never_set():
    with launch(THREE, virtual=True) as chain:
        clock = VirtualClock()
        port = Choosy(chain.device, chain.control, 1_000_000, clock)
        wire = Wire(port, "dynamixel2", 1_000_000)
        assert len(single.scan(wire)) == 3
        with pytest.raises(PortError, match="cannot do 4000000"):
            set_baud(wire.find(1), 4_000_000, yes)
        assert wire.find(1).baud == 1_000_000
        port.close()


SET = {
    "xl330-m288": ("dynamixel2", {"homing_offset": 120, "min_position_limit": 900, "current_limit": 800}),
    "ax-12a": ("dynamixel1", {"cw_angle_limit": 200, "ccw_angle_limit": 800}),
    "sts3215": ("feetech", {"homing_offset": -40, "max_position_limit": 3000}),
}


def new(servo, model, **registers):
    return EmulatedServo(servo, model, start_ticks=load_firmware_map(model).center_ticks, registers=registers)


@pytest.mark.parametrize("model", SET)
def test_a_new_servo_becomes_the_old_one_and_keeps_its_own_id(model, tmp_path):
    family, registers = SET[model]
    with wire_on(new(1, model, **registers), new(2, model), family=family) as (wire, _):
        single.save_dump(single.dump([wire.find(1)]), tmp_path / "servos.yaml")
        with pytest.raises(ConfigError, match="exists already"):  # it may be the only copy
            single.save_dump(single.dump([wire.find(2)]), tmp_path / "servos.yaml")
        (was,) = load(single.Dump, tmp_path / "servos.yaml").servos
        assert (was.id, was.model) == (1, model)
        assert {name for name, *_ in single.differences(wire.find(2), was)} == set(registers)
        rows = single.restore(wire.find(2), was, yes)
        assert {row["register"]: row["raw"] for row in rows} == registers
        assert single.differences(wire.find(2), was) == []


def test_id_and_rate_come_along_only_when_asked_for(tmp_path):
    with wire_on(EmulatedServo(5, baud=57_600)) as (wire, _):
        kept = single.dump([wire.find(5)]).servos[0]
    with wire_on(EmulatedServo(1)) as (wire, _):
        assert single.restore(wire.find(1), kept, yes) == []
        single.restore(wire.find(1), kept, yes, identity=True)
        assert (wire.find(5).id, wire.baud) == (5, 57_600)


def test_nothing_is_written_unasked_or_under_torque_or_to_another_model():
    servos = EmulatedServo(1, registers={"homing_offset": 120}), EmulatedServo(2), EmulatedServo(3, "xl330-m077")
    with wire_on(*servos) as (wire, _):
        kept = single.dump([wire.find(1)]).servos[0]
        with pytest.raises(ConfigError, match="is not the model of the file"):
            single.restore(wire.find(3), kept, yes)
        with pytest.raises(ConfigError, match="not confirmed"):
            single.restore(wire.find(2), kept, no)
        put(wire, 2, "torque_enable", 1)
        with pytest.raises(ServoError, match="has torque on"):
            single.restore(wire.find(2), kept, yes)
        assert [name for name, *_ in single.differences(wire.find(2), kept)] == ["homing_offset"]


SPOKEN = {"xl330-m288": "dynamixel2", "ax-12a": "dynamixel1", "sts3215": "feetech"}
ASKED = ("dynamixel2", "dynamixel1", "feetech")


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize(("model", "baud"), [("xl330-m288", 57_600), ("ax-12a", 1_000_000), ("sts3215", 1_000_000)])
def test_servos_of_another_protocol_are_named(model, baud, asked):
    servo = EmulatedServo(1, model, baud, load_firmware_map(model).center_ticks)
    with wire_on(servo, family=asked) as (wire, chain):
        before, began_s = wire.baud, wire.port.now_s()
        hint, spoken = protocol_hint(other_wires(wire)), SPOKEN[model]
        assert ("" if spoken == asked else f"--family {spoken}") in hint and bool(hint) == (spoken != asked)
        assert wire.baud == before and wire.port.now_s() - began_s < 3.0
        chain.kill(1)
        assert protocol_hint(other_wires(wire)) == ""  # an empty wire


@pytest.mark.parametrize("asked", ["dynamixel2", "feetech"])
def test_a_scan_of_a_mixed_wire_lists_the_servos_of_every_protocol(asked):
    mixed = EmulatedServo(1), EmulatedServo(7, "sts3215", 1_000_000), EmulatedServo(8, "sts3215", 1_000_000)
    with wire_on(*mixed, family=asked) as (wire, _):
        found, hint = single.scan_all(wire, [1, 7, 8])
        assert {(seen.id, seen.model, seen.wire.family) for seen in found} == {
            (1, "xl330-m288", "dynamixel2"), (7, "sts3215", "feetech"), (8, "sts3215", "feetech")
        }  # fmt: skip
        assert hint.endswith({"dynamixel2": "--family feetech", "feetech": "--family dynamixel2"}[asked])
