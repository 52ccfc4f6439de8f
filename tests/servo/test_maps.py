"""Every shipped firmware map, and what a map must not say."""

import json
import re
from pathlib import Path

import pytest
import typer
import yaml
from published import rows
from typer.testing import CliRunner

from sfms_robot.app.servo.maps import check_maps, list_maps
from sfms_robot.app.servo.serial_line import table_of
from sfms_robot.cli import servo_command
from sfms_robot.config import FirmwareMap, load, load_firmware_map, map_files, parse, variant
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.servo.registers import Table

MODELS = [file.stem for file in map_files()]
FACTS = rows("servo_addresses.csv")

CLI = typer.Typer()
CLI.command()(servo_command.maps)

REGISTERS = {
    "id": {"address": 3, "size": 1, "access": "RW", "area": "EEPROM", "unit": "id", "min": 0, "max": 253, "initial": 1},
    "goal_position": {"address": 30, "size": 2, "access": "RW", "area": "RAM", "unit": "deg"},
}
MADE_UP = {
    "model": "made-up", "vendor": "nobody", "model_number": 60000, "family": "dynamixel", "protocol": 1,
    "source": "invented", "ticks_per_revolution": 1000, "center_ticks": 500, "baud_codes": {1: 1000000},
    "registers": REGISTERS,
}  # fmt: skip
BOARD = {
    "family": "ssc32", "protocol": None, "model_number": None, "registers": {}, "channels": 4, "tick_us": 1,
    "pulse_us": {"min": 500, "max": 2500},
}  # fmt: skip


def goal(**changes: object) -> dict[str, object]:
    """The map with another goal position."""
    return {"registers": REGISTERS | {"goal_position": REGISTERS["goal_position"] | changes}}


def other_id(**changes: object) -> dict[str, object]:
    """The map with another id register."""
    return {"registers": REGISTERS | {"id": REGISTERS["id"] | changes}}


def wide(**changes: object) -> dict[str, object]:
    """The map with a 4-byte register beside the others."""
    counter = {"address": 40, "size": 4, "access": "R", "area": "RAM"}
    return {"protocol": 2, "registers": goal(**changes)["registers"] | {"counter": counter}}


def write(folder: Path, **changes: object) -> Path:
    raw = MADE_UP | changes
    file = folder / f"{raw['model']}.yaml"
    file.write_text(yaml.safe_dump(raw), encoding="utf-8")
    return file


@pytest.mark.parametrize("fact", FACTS, ids=lambda fact: fact["model"])
def test_registers_lie_where_the_makers_say(fact):
    table = Table.of(load_firmware_map(fact["model"]))
    assert str(table.model_number or "") == fact["number"]
    for role in ("goal_position", "present_position", "torque_enable", "id", "baud_rate", "voltage", "temperature"):
        field = table.role(role)
        assert field is not None
        assert f"{field.address}/{field.size}" == fact[role], role
    current = table.role("present_current")
    assert (f"{current.address}/{current.size}" if current else "") == fact["current"]


def test_every_table_of_the_facts_has_a_map_and_the_rest_are_boards():
    boards = [row["model"] for row in list_maps() if row["channels"]]
    assert sorted(MODELS) == sorted([fact["model"] for fact in FACTS] + boards)
    assert sorted(boards) == ["maestro-12", "maestro-18", "maestro-24", "maestro-6", "ssc-32"]


@pytest.mark.parametrize("model", MODELS)
def test_map_names_its_public_source(model):
    assert re.search(r"[\w-]+/[\w-]+ @[0-9a-f]{7}|pololu\.com|user guide", load_firmware_map(model).source)


@pytest.mark.parametrize(
    ("model", "firmware", "layout", "data"),
    [
        ("xl330-m288", 51, "xl330-m288_fw52", 208),
        ("xl330-m288", 53, "xl330-m288", 224),
        ("xc330-t181", 52, "xc330-t181_fw52", 208),
    ],
)
def test_firmware_read_from_the_servo_picks_the_layout(model, firmware, layout, data):
    for named in (model, layout):
        found = variant(named, firmware)
        assert found.model == layout and found.registers["indirect_data_1"].address == data


def test_a_servo_of_ones_own_is_a_file_and_no_python(tmp_path):
    file = write(tmp_path, firmware={"min": 3, "max": 9})
    assert Table.of(load_firmware_map(str(file))).role("goal_position").address == 30
    assert not check_maps([file]) and list_maps([file])[-1].items() >= {"model": "made-up", "firmware": "3..9"}.items()


def test_a_map_in_the_users_folder_is_found_by_name_and_number(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    folder = tmp_path / "sfms-robot" / "firmware_maps"
    folder.mkdir(parents=True)
    text = (data_dir("firmware_maps") / "feetech" / "sts3215.yaml").read_text()
    own = text.replace("sts3215", "sts9999").replace("model_number: 777", "model_number: 61999")
    (folder / "sts9999.yaml").write_text(own)
    assert load_firmware_map("sts9999").model_number == 61999 and list_maps()[-1]["model"] == "sts9999"
    assert table_of("feetech", 61999, None).model == "sts9999"
    (folder / "STS8888.yaml").write_text(own.replace("61999", "61998").replace("sts9999", "STS8888"))
    assert load_firmware_map("STS8888").model_number == 61998 and table_of("feetech", 61998, None).model == "STS8888"
    (folder / "sts3032.yaml").write_text(text)
    load_firmware_map.cache_clear()
    with pytest.raises(ConfigError, match="sts3032.yaml: expected another name, as sts3032 has a map already"):
        load_firmware_map("sts3032")


def test_a_map_that_cannot_be_had_is_named_with_those_at_hand(tmp_path):
    own = load_firmware_map(str(write(tmp_path, firmware={"min": 10})))
    assert variant(own, 10) is own
    with pytest.raises(ConfigError, match=r"firmware = 9 of made-up has no firmware map \(made-up 10..255\)"):
        variant(own, 9)
    with pytest.raises(ConfigError, match=r"model = 'xl333' has no firmware map \(.*xl330-m288"):
        load_firmware_map("xl333")
    file = tmp_path / "made-up.yaml"
    file.write_text("model: made-up\nbaud_codes: {1: 9600, 1: 57600}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"made-up.yaml:2: 1 is given twice"):
        load(FirmwareMap, file)


WRONG = {
    "registers.goal_position.address = 3 overlaps id (ends at 4)": goal(address=3),
    "registers.id.address = 31 overlaps goal_position (ends at 32)": other_id(address=31),
    "registers.goal_position.address = 31 is odd, which 2 bytes cannot be": wide(address=31),
    "registers.goal_position.address = 255 ends past the address space (256 bytes)": goal(address=255),
    "registers.goal_position.size = 3": goal(size=3),
    "registers.goal_position.unit = 'furlong'": goal(unit="furlong"),
    "registers.goal_position.signed = 'sign_bit_x': String should match pattern": goal(signed="sign_bit_x"),
    "registers.id.signed = 'sign_bit_11' does not fit 1 byte(s)": other_id(signed="sign_bit_11"),
    "registers.id.signed = 'offset_2048' needs a size of 2": other_id(signed="offset_2048"),
    "registers.id.max = 300 does not fit 1 byte(s) (0..255)": other_id(max=300),
    "registers.id.min = -1 does not fit 1 byte(s)": other_id(min=-1),
    "registers.id.min = 254 is above max = 253": other_id(min=254),
    "registers.id.initial = 254 is outside min..max (0..253)": other_id(initial=254),
    "roles.voltage = 'volts' is not a register of this map": {"roles": {"voltage": "volts"}},
    "roles.volts": {"roles": {"volts": "id"}},
    "baud_codes.2 = 1000000 is also code 1": {"baud_codes": {1: 1000000, 2: 1000000}},
    "faults.16": {"faults": {16: "too far"}},
    "protocol = 2 is not one of family feetech (1)": {"family": "feetech", "protocol": 2},
    "channels belongs to a board, not to family dynamixel": {"channels": 24},
    "registers is empty": {"registers": {}},
    "tick_us is missing: a ssc32 board has it": BOARD | {"tick_us": None},
    "pulse_us.min = 2500.0 is not below pulse_us.max = 2500.0": BOARD | {"pulse_us": {"min": 2500, "max": 2500}},
    "registers: a ssc32 board has none": BOARD | {"registers": REGISTERS},
    "firmware: min = 53 is above max = 52": {"firmware": {"min": 53, "max": 52}},
}


@pytest.mark.parametrize("problem", WRONG)
def test_wrong_map_is_refused_with_its_reason(problem):
    with pytest.raises(ConfigError, match=f"^made-up.yaml: .*{re.escape(problem)}"):
        parse(FirmwareMap, MADE_UP | WRONG[problem], "made-up.yaml")


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"model_number": 12}, "model_number = 12 is also ax-12a, for some of the same firmware"),
        ({"same_number_as": "ax-12b", "model_number": 12}, "same_number_as = 'ax-12b' has no map"),
        ({"variant_of": "ax-12a"}, "variant_of = 'ax-12a' has another family, protocol or model number"),
        ({"model": "ax-12a", "model_number": 60000}, "model = 'ax-12a' is also"),
    ],
)
def test_check_finds_what_two_maps_cannot_both_say(tmp_path, changes, problem):
    file = write(tmp_path, **changes)
    found = check_maps([file])
    assert [each.file for each in found] == [str(file)] * len(found)
    assert any(problem in each.problem for each in found)


def test_check_finds_another_name_and_allows_one_number_where_the_map_says_so(tmp_path):
    file = write(tmp_path).rename(tmp_path / "other.yaml")
    assert [each.problem for each in check_maps([file])] == ["model = 'made-up' is not the file's name (other)"]
    assert check_maps([write(tmp_path, model_number=12, same_number_as="ax-12a")]) == []


def test_one_number_is_fine_for_two_firmwares(tmp_path):
    write(tmp_path, firmware={"min": 10})
    write(tmp_path, model="made-up_fw9", variant_of="made-up", firmware={"max": 9})
    assert check_maps([tmp_path]) == []
    write(tmp_path, model="made-up_fw9", variant_of="made-up", firmware={"max": 10})
    [found] = check_maps([tmp_path])
    assert found.problem == "model_number = 60000 is also made-up, for some of the same firmware"


def test_the_command_lists_and_checks_maps(tmp_path):
    rows = json.loads(CliRunner().invoke(CLI, ["--json"]).stdout)["maps"]
    assert sorted(row["model"] for row in rows) == sorted(MODELS)
    shown = CliRunner().invoke(CLI, []).stdout
    assert "xl330-m288_fw52" in shown and "maestro-24" in shown
    result = CliRunner().invoke(CLI, ["--check", "--json"])
    assert result.exit_code == 0 and json.loads(result.stdout) == {"sound": True, "findings": []}
    file = write(tmp_path, registers={})
    result = CliRunner().invoke(CLI, ["--check", "--json", str(file)])
    found = [{"file": str(file), "problem": "registers is empty"}]
    assert result.exit_code == 2 and json.loads(result.stdout) == {"sound": False, "findings": found}
