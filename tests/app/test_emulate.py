import shutil

import pytest

from sfms_robot.app.servo.emulated_chains import described, emulators, parse_servos
from sfms_robot.config import load_head
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError


def test_servos_are_plugged_in_the_middle_of_their_range_at_a_rate_they_have():
    servos = parse_servos("xl330-m288:1-3,7,ax-12a:20,ssc-32:0-1")
    assert [s.id for s in servos] == [1, 2, 3, 7, 20, 0, 1]
    assert [s.model for s in servos] == ["xl330-m288"] * 4 + ["ax-12a"] + ["ssc-32"] * 2
    assert [s.start_ticks for s in servos[3:5]] == [2048, 512]
    assert [s.baud for s in servos[3:6]] == [1_000_000, 1_000_000, 9600]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("xl330-m288", "has no id for 'xl330-m288'"),
        ("1-3", "has no id for '1-3'"),
        ("xl999:1", "'xl999' has no firmware map"),
        ("xl330-m288:9-1", "holds bad ids: '9-1'"),
        ("xl330-m288:one", "holds bad ids: 'one'"),
    ],
)
def test_servo_list_that_cannot_be_read_is_one_clear_line(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_servos(text)


def test_a_whole_head_is_plugged_in_bus_by_bus_and_faults_may_stand_in_a_file(tmp_path):
    with emulators(head="face28", voltage=6.0, faults=("silent:3",)) as chains:
        assert len(chains) == 1
        [chain] = chains.values()
        assert chain.faults() == ["silent:3"]
        assert chain.state(28)["torque"] is False and chain.state(28)["faults"] == ""
    file = tmp_path / "bad_day.txt"
    file.write_text("# what broke\ndrop:1=0.5\n\nbrownout@3   # somebody trips over the cable\n")
    with emulators(servo="xl330-m288:1", faults=(str(file), "delay=0.001")) as chains:
        assert chains["servos"].faults() == ["drop:1=0.5", "brownout@3", "delay=0.001"]


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ("joints: {nose: {shutdown: 52}}", "joints = 'nose' is not a joint of this head"),
        ("registers: {homing: 3}", "register = 'homing' is not a register of xl330-m288"),
        ("supply_v: -1", "emulate.yaml: supply_v = -1"),
    ],
)
def test_stored_values_that_cannot_be_are_one_clear_line(tmp_path, stored, message):
    shutil.copy(data_dir("configs") / "heads" / "face28" / "head.yaml", tmp_path / "head.yaml")
    (tmp_path / "emulate.yaml").write_text(stored)
    with pytest.raises(ConfigError, match=message), emulators(head=str(tmp_path)):
        pass


def test_what_is_stored_and_where_servos_are_found_is_told_by_id():
    running = emulators(
        servo="xl330-m288:1-3,sts3215:9", stored=("1,3:min_position_limit=1900", "9:phase=28"), starts=("2-3=4150",)
    )
    with running as chains:
        chain = chains["servos"]
        assert [servo.registers for servo in chain.servos] == [
            {"min_position_limit": 1900}, {}, {"min_position_limit": 1900}, {"phase": 28},
        ]  # fmt: skip
        assert [chain.state(i)["position"] for i in (1, 2, 3, 9)] == [2048, 4150, 4150, 2048]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"stored": ("min_position_limit=3",)}, "stored = 'min_position_limit=3' cannot be read: IDS:REGISTER=VALUE"),
        ({"stored": ("1:nose=3",)}, "register = 'nose' is not a register of xl330-m288"),
        ({"stored": ("1:shutdown=300",)}, "shutdown = 300 is out of range of xl330-m288"),
        ({"starts": ("1:4150",)}, "start = '1:4150' cannot be read: IDS=TICKS"),
        ({"starts": ("7=4150",)}, "start = '7=4150' names 7, which no servo has"),
        ({"starts": ("3-1=4150",)}, "start = '3-1=4150' holds bad ids"),
        ({"servo": None}, "either --head NAME or --servo"),
        ({"head": "face28"}, "either --head NAME or --servo"),
    ],
)
def test_start_that_cannot_be_is_one_clear_line(more, message):
    with pytest.raises(ConfigError, match=message), emulators(**{"servo": "xl330-m288:1", **more}):
        pass


def test_what_is_plugged_in_is_described_joint_by_joint():
    with emulators(head="open_duck_mini_v2_head") as chains:
        told = described(chains, "open_duck_mini_v2_head")
    head = load_head("open_duck_mini_v2_head")
    assert set(told["buses"]) == set(head.buses) and len(told["buses"]) > 1
    for bus, each in told["buses"].items():
        assert each["device"] and each["control"]
        for servo in each["servos"]:
            joint = head.joints[servo["joint"]]
            assert (joint.bus, joint.id, joint.model) == (bus, servo["id"], servo["model"])
