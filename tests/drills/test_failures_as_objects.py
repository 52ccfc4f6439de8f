"""`--json` on commands that cannot do their work prints one object all the same."""

import json

import pytest
from drill_rig import HEAD, command

from sfms_robot.emulator.launch import EmulatedServo, launch


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["run", "--head", "nobody"], 2),
        (["run", "--head", HEAD, "--port", "/dev/nowhere"], 3),
        (["run", "--head", HEAD, "--listener", "nobody"], 2),
        (["head", "check", "nobody"], 2),
        (["head", "pose", "--head", "nobody"], 2),
        (["doctor", "--head", HEAD, "--port", "/dev/nowhere"], 3),
        (["servo", "scan", "--port", "/dev/nowhere"], 3),
        (["servo", "read", "1", "all", "--port", "/dev/nowhere"], 3),
        (["replay", "/nowhere"], 2),
        (["emulate", "--head", "nobody"], 2),
    ],
    ids=lambda each: " ".join(each) if isinstance(each, list) else None,
)
def test_what_is_not_there_is_named_in_an_object(words, code):
    ended, out, err = command(*words, "--json")
    told = json.loads(out.splitlines()[-1])
    assert (ended, "Traceback" in err) == (code, False), err
    assert told["exit_code"] == code and (told.get("error") or told["findings"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["run", "--audio", "none", "--duration", "1"], ["run", "--dry-run"], ["doctor"]], ids=" ".join
)
def test_a_dead_bus_is_named_in_an_object(words, device):
    with launch([EmulatedServo(9)], link=str(device)):  # somebody else's servo
        ended, out, err = command(*words, "--head", HEAD, "--port", device, "--json")
    assert ended == 4 and "Traceback" not in err, err
    assert json.loads(out.splitlines()[-1])
