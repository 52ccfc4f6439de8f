"""`port list` and `run --check` beside a sound server, and where there is none."""

import pytest

from sfms_robot.app.listen.sound_check import LevelMeter, meter_line

pytestmark = pytest.mark.realtime


def test_port_list_shows_serial_ports_and_what_records_and_plays(sound_server, command_line):
    ended = command_line("port", "list", "--json")
    listed = ended.told
    assert ended.code == 0 and isinstance(listed["ports"], list) and listed["microphone_problem"] is None
    devices = {row["name"]: row for row in listed["microphones"]}
    assert devices["default"]["default"] and devices["default"]["description"] == "--audio mic:default"
    assert devices["person.monitor"]["description"] == "--agent-audio device:person.monitor"
    assert {row["name"]: row["description"] for row in listed["loudspeakers"]}["person"] == "--play person"


def test_a_check_says_what_it_heard_of_nobody(sound_server, command_line):
    ended = command_line("run", "--audio", "mic:person", "--check", "--duration", "0.4", "--json")
    heard = ended.told
    assert ended.code == 0 and heard["seconds"] == 0.4
    assert heard["source"]["voice"]["device"] == "person.monitor"
    assert "digital silence" in heard["findings"][0]


@pytest.mark.parametrize(
    ("level_db", "loudest_db", "full", "mark"),
    [(-60.0, -60.0, 0, 0), (-30.0, -30.0, 20, None), (-30.0, -15.0, 20, 29), (0.0, 0.0, 40, None), (5.0, 5.0, 40, None),
     (-100.0, -30.0, 0, 19)],
)  # fmt: skip
def test_the_meter_is_as_full_as_the_sound_is_loud(level_db, loudest_db, full, mark):
    bar = meter_line(level_db, loudest_db, clipped=False).plain[:40]
    assert bar.count("█") == full
    assert bar.find("│") == (-1 if mark is None else mark)


def test_a_meter_says_that_it_has_clipped_and_shows_nothing_where_nobody_looks(capsys):
    assert "clips" in meter_line(-3.0, -3.0, clipped=True).plain
    with LevelMeter() as meter:
        meter(-20.0, True)
    assert capsys.readouterr().err == ""
