"""`port list` and `run --check` beside a sound server, and where there is none."""

import pytest

pytestmark = pytest.mark.realtime


def test_port_list_shows_serial_ports_and_what_records_and_plays(sound_server, command_line):
    ended = command_line("port", "list", "--json")
    listed = ended.told
    assert ended.code == 0 and isinstance(listed["ports"], list) and listed["microphone_problem"] is None
    devices = {row["name"]: row for row in listed["microphones"]}
    assert devices["default"]["default"] and devices["default"]["description"] == "--audio mic:default"
    assert devices["person.monitor"]["description"] == "--agent-audio device:person.monitor"
    assert {row["name"]: row["description"] for row in listed["loudspeakers"]}["person"] == "--play person"


@pytest.mark.slow
def test_a_check_says_what_it_heard_of_nobody(sound_server, command_line):
    ended = command_line("run", "--audio", "mic:person", "--check", "--duration", "0.4", "--json")
    heard = ended.told
    assert ended.code == 0 and heard["seconds"] == 0.4 and heard["source"]["voice"]["device"] == "person.monitor"
    assert "digital silence" in heard["findings"][0]
