import shutil

import pytest

from sfms_robot.app.servo.emulated_chains import EmulateOptions, emulators, parse_servos
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError


def test_servos_are_plugged_in_the_middle_of_their_range_at_a_rate_they_have():
    servos = parse_servos("xl330-m288:1-3,7,ax-12a:20,ssc-32:0-1")
    assert [(s.model, s.id) for s in servos] == [
        *(("xl330-m288", i) for i in (1, 2, 3, 7)),
        ("ax-12a", 20),
        ("ssc-32", 0),
        ("ssc-32", 1),
    ]
    assert [s.start_ticks for s in servos[3:5]] == [2048, 512]
    assert [s.baud for s in servos[3:6]] == [1_000_000, 1_000_000, 9600]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("xl330-m288", "has no id for 'xl330-m288'"),
        ("1-3", "has no id for '1-3'"),
        ("xl999:1", "'xl999' has no firmware map"),
        ("xl330-m288:9-1", "holds ids that are none: '9-1'"),
        ("xl330-m288:one", "holds ids that are none: 'one'"),
    ],
)
def test_servo_list_that_cannot_be_read_is_one_clear_line(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_servos(text)


def test_whole_head_is_plugged_in_bus_by_bus():
    with emulators(EmulateOptions(head="face28", voltage=6.0, faults=("silent:3",))) as chains:
        assert len(chains) == 1
        [chain] = chains.values()
        assert chain.faults() == ["silent:3"]
        assert chain.state(28)["torque"] is False and chain.state(28)["faults"] == ""


def test_faults_may_stand_in_a_file(tmp_path):
    file = tmp_path / "bad_day.txt"
    file.write_text("# what broke\ndrop:1=0.5\n\nbrownout@3   # somebody trips over the cable\n")
    with emulators(EmulateOptions(servo="xl330-m288:1", faults=(str(file), "delay=0.001"))) as chains:
        assert chains["servos"].faults() == ["drop:1=0.5", "brownout@3", "delay=0.001"]


def test_either_a_head_or_servos():
    for options in (EmulateOptions(), EmulateOptions(head="face28", servo="ax-12a:1")):
        with pytest.raises(ConfigError, match="either --head NAME or --servo"), emulators(options):
            pass


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ("joints: {nose: {shutdown: 52}}", "joints = 'nose' is no joint of this head"),
        ("registers: {homing: 3}", "register = 'homing' is none of xl330-m288"),
        ("supply_v: -1", "emulate.yaml: supply_v = -1"),
    ],
)
def test_stored_values_that_cannot_be_are_one_clear_line(tmp_path, stored, message):
    shutil.copy(data_dir("configs") / "heads" / "face28" / "head.yaml", tmp_path / "head.yaml")
    (tmp_path / "emulate.yaml").write_text(stored)
    with pytest.raises(ConfigError, match=message), emulators(EmulateOptions(head=str(tmp_path))):
        pass
