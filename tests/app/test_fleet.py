"""A head among others: what commands do, what a tile says, and who may send one from a page."""

import json

import pytest

from sfms_robot.app.fleet import GONE_S, FleetControls, fleet_key, fleet_name, proof, tile
from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.options import RunOptions
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError


class Run(RunControls):
    """The controls of a run, and what was asked of its listener."""

    def __init__(self):
        super().__init__(load_head("face28"), RunOptions())
        self.calmed = []
        self.set_rates = self.calmed.append

    def obey(self, **command):
        return FleetControls(self, "", None).obey(json.dumps(command).encode())


@pytest.fixture
def run():
    return Run()


def test_halt_names_who_asked_and_resume_lets_go(run):
    assert run.obey(command="halt", by="  kitchen\n") == {"done": "halt"} and run.halt.by == "kitchen"
    assert run.obey(command="resume") == {"done": "resume"} and run.halt.by is None
    run.obey(command="end")
    assert run.interrupt()


def test_the_fleet_does_not_end_a_halt_of_the_device_and_its_client_is_answered(run):
    run.obey(command="halt", by="key")  # whatever name it gives itself
    run.halt.close("key")
    assert run.obey(command="resume") == {"error": "still halted: key (cleared at the device)"}
    assert run.halt.by == "key"
    run.halt.resume("device")


KEY = b"k" * 64


@pytest.mark.parametrize("command", ["resume", "end"])
def test_resume_and_end_need_a_proof_of_the_key_which_counts_once(run, command):
    controls = FleetControls(run, "hall", KEY)
    assert controls.obey(b'{"command": "halt", "by": "kitchen"}') == {"done": "halt"}  # needs no key

    def sent(**more):
        return controls.obey(json.dumps({"command": command, **more}).encode())

    nonce = controls.nonce
    other = "end" if command == "resume" else "resume"
    made = (b"x" * 64, "hall", command), (KEY, "attic", command), (KEY, "hall", other)
    wrong = [proof(*each, nonce) for each in made]
    for each in ({}, {"proof": 3}, {"proof": "\ud800"}, *({"proof": one} for one in wrong)):
        assert "error" in sent(**each) and "\n" not in sent(**each)["error"]
    assert run.halt.by == "kitchen" and not run.interrupt() and controls.nonce == nonce
    signed = proof(KEY, "hall", command, nonce)
    assert sent(proof=signed) == {"done": command}
    assert (run.halt.by is None) if command == "resume" else run.interrupt()
    assert "--fleet-key" in sent(proof=signed)["error"]  # overheard, and sent again


def test_a_key_is_made_for_its_owner_alone_and_one_that_others_can_read_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    file = tmp_path / "of" / "fleet.key"
    key = fleet_key(file)
    assert len(key) == 64 and file.stat().st_mode & 0o777 == 0o600 and fleet_key(file) == key
    assert fleet_key(None) != key and (tmp_path / "config" / "sfms-robot" / "fleet.key").is_file()
    file.chmod(0o640)
    with pytest.raises(ConfigError, match=f"^--fleet-key {file}: expected mode 600, got 640: chmod 600 {file}$"):
        fleet_key(file)
    file.chmod(0o600)
    file.write_text("short")
    with pytest.raises(ConfigError, match="expected a key of 32 characters or more, got 5"):
        fleet_key(file)


def test_calm_and_knobs_are_turned(run):
    run.calm({"smile": 2.0, "addressed": "never"})  # as a page does
    assert run.obey(command="calm", rates={"nod": 3.0}) == {"done": "calm"}
    assert (run.calmed[1].nod, run.calmed[1].smile, run.calmed[1].addressed) == (3.0, 2.0, "never")
    region = next(iter(run.knobs))
    assert run.obey(command="knobs", intensity={region: 0.5}) == {"done": "knobs"}
    assert run.knobs[region].intensity == 0.5


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ({"command": "dance"}, "'halt', 'resume', 'end', 'calm', 'knobs'"),
        ({}, "discriminator 'command'"),
        ({"command": "calm", "rates": {"nod": -1}}, "nod"),
        ({"command": "calm", "rates": 3}, "rates = 3: "),
        ({"command": "knobs", "intensity": {"tail": 1}}, "'tail' is not a region of this head"),
        ({"command": "knobs", "intensity": {"neck": "1"}}, "neck = '1': Input should be a valid number"),
        ({"command": "knobs", "style": {"neck": 9}}, "not in 0..2"),
    ],
)
def test_what_cannot_be_obeyed_is_one_line(run, command, said):
    answer = run.obey(**command)
    assert said in answer["error"] and "\n" not in answer["error"]


@pytest.mark.parametrize(
    "message",
    [b"", b"\xff\xfe", b"[]", b"{" * 10_000, b'{"command": ["halt"]}',
     b'{"command": "knobs", "intensity": {"neck": 1' + 400 * b"0" + b"}}"],
)  # fmt: skip
def test_nonsense_is_answered_and_does_nothing(run, message):
    assert "error" in FleetControls(run, "", None).obey(message)
    assert run.halt.by is None and not run.interrupt()


@pytest.mark.parametrize("name", ["", "a/b", "a b", "*", "listen", "küche"])
def test_a_name_that_cannot_be_part_of_a_key_is_refused(name):
    with pytest.raises(ConfigError, match="--fleet"):
        fleet_name(name)


def test_a_tile_says_what_a_head_does_and_whether_it_is_away():
    here = tile("a", {"state": "halted", "why": ["kitchen"], "head": "face28", "person": {"voice_db": -30.0}}, 0.04)
    assert (here["name"], here["state"], here["why"], here["voice_db"]) == ("a", "halted", ["kitchen"], -30.0)
    assert here["here"] and not tile("a", {"state": "idle"}, GONE_S + 1)["here"]
    assert not tile("a", {"state": "stopped"})["here"] and tile("a", {})["state"] == "?"
