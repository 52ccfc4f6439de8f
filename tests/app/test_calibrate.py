"""Leading through a head's joints: somebody who answers lines and turns emulated servos by hand, in virtual time."""

import re
import shlex
import shutil
import socketserver
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest
import yaml
from emulated_devices import device_of, servos_of

from sfms_robot.app.head.calibrate import CalibrationOutcome, Guide, calibrate, calibrate_on
from sfms_robot.app.open_head import calibrated_head, identify, open_head
from sfms_robot.app.options import HeadOptions
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_head
from sfms_robot.config.head import held_back
from sfms_robot.config.overlay import Overlay, calibrated, head_hash, layered, load_overlay, overlay_file, save_overlay
from sfms_robot.data import find
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.servo.port import Port

DAY = date(2026, 5, 17)
LIMIT = {"speed_deg_s": 90, "acceleration_deg_s2": 900, "jerk_deg_s3": 9000}


def written(folder: Path, family: str = "dynamixel2", model: str = "xl330-m288", zero: int = 2048, **more) -> str:
    """A head of a jaw that rests at its lower end and a brow that rests between its ends."""
    joint = {"bus": "main", "model": model, "zero_ticks": zero, "limits": "slow"}
    raw = {
        "name": "two",
        "description": "two joints",
        "calibrate_first": True,
        "buses": {"main": {"family": family, "baud": 1_000_000 if family != "maestro" else 115_200}},
        "limits": {"slow": LIMIT},
        "joints": {
            "jaw": {**joint, "id": 1, "min_deg": 0, "max_deg": 30, "drive": "jawOpen", "note": "+ opens"},
            "brow": {**joint, "id": 2, "min_deg": -20, "max_deg": 40, "drive": "browInnerUp"},
        },
    }
    folder.mkdir(exist_ok=True)
    (folder / "head.yaml").write_text(yaml.safe_dump(raw | more, sort_keys=False))
    return str(folder)


@pytest.fixture
def name(tmp_path, monkeypatch) -> str:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return written(tmp_path / "head")


Answer = str | Callable[[], str] | type[BaseException]


class Person:
    """Answers one line after the other, doing something first where the answer is a function; then has gone."""

    def __init__(self, *answers: Answer) -> None:
        self.answers, self.heard = list(answers), ""

    def say(self, text: str) -> None:
        self.heard += text + "\n"

    def ask(self, prompt: str) -> str:
        self.heard += prompt + "\n"
        answer = self.answers.pop(0) if self.answers else EOFError
        if isinstance(answer, str):
            return answer
        if isinstance(answer, type):
            raise answer
        return answer()


@contextmanager
def head_on_emulated_servos(name: str) -> Iterator[Chain]:
    with launch(emulated(load_head(name))["main"], virtual=True) as chain:
        yield chain


def hand(chain: Chain, servo: int, ticks: int) -> Callable[[], str]:
    def turn() -> str:
        assert chain.state(servo)["torque"] in (0, False)  # a hand could not move it otherwise
        chain.turn(servo, ticks)
        return ""

    return turn


def led(name: str, chain: Chain, person: Person, **more) -> CalibrationOutcome:
    guide = Guide(person.say, person.ask, DAY)
    return calibrate_on(name, {"main": chain}, VirtualClock(), guide, overlay_file("two"), **more)


def by_hand(chain: Chain) -> list[Answer]:
    """Both joints moved by hand, the brow's servo mounted the other way round."""
    jaw: list[Answer] = ["", hand(chain, 1, 1990), hand(chain, 1, 2300), "", ""]
    brow: list[Answer] = ["", hand(chain, 2, 2500), hand(chain, 2, 1800), hand(chain, 2, 2200), "y", "", ""]
    return jaw + brow


def test_joints_moved_by_hand_get_their_ends_rest_and_direction(name):
    with head_on_emulated_servos(name) as chain:
        outcome = led(name, chain, person := Person(*by_hand(chain)))
        stands = [chain.state(servo) for servo in (1, 2)]
    assert (outcome.exit, outcome.measured, outcome.missing, outcome.problems) == ("done", ["jaw", "brow"], [], [])
    layer = load_overlay(load_head(name)).calibrate
    assert layer is not None and layer.head_sha256 == head_hash(name)
    jaw, brow = layer.joints["jaw"], layer.joints["brow"]
    assert (jaw.min_ticks, jaw.center_ticks, jaw.max_ticks, jaw.sign) == (1990, 1990, 2300, 1)
    assert (brow.min_ticks, brow.center_ticks, brow.max_ticks, brow.sign) == (2500, 2200, 1800, -1)
    assert (jaw.id, jaw.model, jaw.firmware, jaw.homing_offset, jaw.drive_mode, jaw.date) == (
        1, "xl330-m288", 53, 0, 0, DAY,
    )  # fmt: skip
    assert [state["position"] for state in stands] == pytest.approx([1990, 2200], abs=10)  # the check ends at rest
    assert not any(state["torque"] for state in stands)
    assert "jaw (+ opens): xl330-m288 id 1" in person.heard and "Ticks fall towards the upper end" in person.heard


def test_keys_move_a_joint_slowly_and_record_it(name):
    with head_on_emulated_servos(name) as chain:
        start = chain.state(1)["position"]
        keys = ["k", "++", "-", "wave", "", "20", "nan", "", "n"]
        outcome = led(name, chain, person := Person(*keys), joints=["jaw"])
        assert outcome.measured == ["jaw"] and outcome.missing == ["brow"]
        layer = load_overlay(load_head(name)).calibrate
    assert layer is not None
    per_deg = 4096 / 360
    assert layer.joints["jaw"].min_ticks == pytest.approx(start + 4 * per_deg, abs=6)
    assert layer.joints["jaw"].max_ticks - layer.joints["jaw"].min_ticks == pytest.approx(20 * per_deg, abs=12)
    assert "'wave' is not a step" in person.heard and "'nan' is not a step" in person.heard


@pytest.mark.parametrize("gone", ["q", EOFError, KeyboardInterrupt])
def test_who_stops_goes_on_there_the_next_time(name, gone):
    with head_on_emulated_servos(name) as chain:
        first = led(name, chain, Person(*by_hand(chain)[:7], gone))
        assert (first.exit, first.measured, first.missing) == ("interrupted", ["jaw"], ["brow"])
        assert not chain.state(2)["torque"]
        second = led(name, chain, person := Person(*by_hand(chain)[5:]))
        assert (second.exit, second.before, second.measured, second.missing) == ("done", ["jaw"], ["brow"], [])
        assert "1 joints are measured, 1 to go" in person.heard
        third = led(name, chain, Person())
        assert (third.exit, third.before, third.measured) == ("done", ["jaw", "brow"], [])


@pytest.mark.parametrize(
    ("ends", "why"),
    [((2048, 2050), "its ends are only 0.2 deg apart"), ((2048, 2400, 2500), "its rest, 2500 ticks, is not between")],
)
def test_what_cannot_be_is_measured_again(name, ends, why):
    joint, servo = ("jaw", 1) if len(ends) == 2 else ("brow", 2)
    with head_on_emulated_servos(name) as chain:
        wrong = ["", *(hand(chain, servo, ticks) for ticks in ends)]
        person = Person(*wrong, EOFError)
        outcome = led(name, chain, person, joints=[joint])
    assert outcome.measured == [] and why in person.heard and "once more" in person.heard
    assert not overlay_file("two").exists()


@pytest.mark.parametrize(("answer", "measured"), [("n", ["jaw"]), ("q", []), (KeyboardInterrupt, [])])
def test_a_joint_whose_torque_is_not_confirmed_off_at_its_end_is_named(name, answer, measured):
    with head_on_emulated_servos(name) as chain:

        def cable_out() -> str:
            chain.kill(1)
            return Person(answer).ask("")

        outcome = led(name, chain, Person("k", "5", "", "20", "", cable_out), joints=["jaw"])
        assert chain.state(1)["torque"]
    assert (outcome.measured, outcome.exit) == (measured, "done" if measured else "interrupted")
    assert outcome.model_dump(mode="json")["torque_unconfirmed"] == ["jaw"]


def test_nobody_is_told_to_move_a_joint_by_hand_whose_torque_is_not_confirmed_off(name):
    with head_on_emulated_servos(name) as chain:

        def not_right() -> str:
            chain.kill(1)
            return "n"

        answers: list[Answer] = ["", hand(chain, 1, 1990), hand(chain, 1, 2300), "", not_right]
        outcome = led(name, chain, person := Person(*answers), joints=["jaw"])
    assert person.heard.count("LOWER end") == 1
    assert outcome.skipped["jaw"].startswith("torque of jaw could not be confirmed off")


def test_a_servo_that_is_silent_or_falls_silent_is_left_out_and_the_others_are_done(name):
    with head_on_emulated_servos(name) as chain:

        def cable_out() -> str:
            chain.kill(1)
            return ""

        jaw: list[Answer] = ["", hand(chain, 1, 1990), hand(chain, 1, 2300), cable_out]
        outcome = led(name, chain, Person(*jaw), joints=["jaw"])
        assert outcome.measured == [] and "jaw (id 1) does not answer" in outcome.skipped["jaw"]
        assert not overlay_file("two").exists()
        outcome = led(name, chain, Person(*by_hand(chain)[5:]))
    assert outcome.skipped == {"jaw": "no answer from id 1 on bus 'main'"} and outcome.measured == ["brow"]


def test_a_swapped_servo_is_measured_again(name):
    with head_on_emulated_servos(name) as chain:
        led(name, chain, Person(*by_hand(chain)))
    servos = [EmulatedServo(1, "xl330-m288", 1_000_000, 2048, firmware=52), EmulatedServo(2)]
    with launch(servos, virtual=True) as chain:
        outcome = led(name, chain, Person(EOFError))
    assert outcome.before == ["brow"] and outcome.missing == ["jaw"]
    assert outcome.problems == ["jaw: firmware was 53 and is 52"]


def test_an_edited_head_file_asks_whether_to_keep_what_was_measured(name, tmp_path):
    with head_on_emulated_servos(name) as chain:
        led(name, chain, Person(*by_hand(chain)))
        written(tmp_path / "head", life={"idle": {"blinks_per_minute": 3}})
        assert led(name, chain, Person("", "q")).missing == ["jaw", "brow"]
        assert led(name, chain, Person("k"), joints=["jaw"]).before == ["jaw"]


def test_hobby_servos_are_moved_by_keys_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    name = written(tmp_path / "board", "maestro", "maestro-12", zero=6000)
    with head_on_emulated_servos(name) as chain:
        outcome = led(name, chain, person := Person("", "5", "", "20", "", "", ""), joints=["jaw"])
    layer = load_overlay(load_head(name)).calibrate
    assert outcome.measured == ["jaw"] and layer is not None and "JUMPS" in person.heard
    jaw, per_deg = layer.joints["jaw"], 16000 / 360
    assert (jaw.firmware, jaw.homing_offset, jaw.model) == (None, None, "maestro-12")
    assert (jaw.min_ticks, jaw.max_ticks) == pytest.approx((6000 + 5 * per_deg, 6000 + 25 * per_deg), abs=2)


@pytest.mark.parametrize(("family", "model", "zero"), [("dynamixel1", "ax-12a", 512), ("feetech", "sts3215", 2048)])
def test_every_family_tells_who_it_is(tmp_path, family, model, zero):
    name = written(tmp_path / "other", family, model, zero)
    with head_on_emulated_servos(name) as chain:
        servos = identify(load_head(name), ["jaw", "brow"], {"main": chain}, VirtualClock())
        chain.kill(2)
        gone = identify(load_head(name), ["brow"], {"main": chain}, VirtualClock())
    assert [each and (each.id, each.model) for each in servos.values()] == [(1, model), (2, model)]
    assert gone == {"brow": None}


def test_practice_on_emulated_servos_is_kept_apart(name):
    person = Person("k", "5", "", "20", "", "n")
    outcome = calibrate(name, "sim", person.say, person.ask, ["jaw"])
    assert outcome.measured == ["jaw"] and outcome.file == overlay_file("two", practice=True)
    assert outcome.file.exists() and not overlay_file("two").exists()


def test_a_stored_value_that_stops_a_joint_names_the_command_with_the_arguments_of_this_one(name):
    person = Person("k", "", "", "", "n")
    with launch([EmulatedServo(1, registers={"startup_configuration": 1}), EmulatedServo(2)]) as chain:
        outcome = calibrate(name, chain.device, person.say, person.ask, ["jaw"])
    assert f"; sfms-robot doctor --port {chain.device} --head {shlex.quote(name)} --fix" in outcome.skipped["jaw"]


def ready_on(name: str, port: str) -> Head:
    kept: dict[str, Port] = {}
    ready = calibrated_head(name, port, RealClock(), kept)
    for each in kept.values():
        each.close()
    return ready


class Adapter(socketserver.ThreadingTCPServer):
    """Servos 1 and 2 behind a network adapter, which counts how often its port is opened."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Connection)
        self.servos, self.opened = device_of(*servos_of("xl330-m288", 1, 2)), 0


class Connection(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        self.server.opened += 1
        while data := self.request.recv(4096):
            self.request.sendall(self.server.servos.receive(data, 1_000_000, time.monotonic()))


def test_a_start_opens_the_port_of_a_calibrated_head_once(name):
    with head_on_emulated_servos(name) as chain:
        led(name, chain, Person(*by_hand(chain)))
    with Adapter() as adapter:
        threading.Thread(target=adapter.serve_forever, daemon=True).start()
        with open_head(HeadOptions(head=name, port=f"socket://127.0.0.1:{adapter.server_address[1]}")) as opened:
            opened.bus.poll(opened.clock.now_s())
        adapter.shutdown()
    assert adapter.opened == 1


def test_a_run_takes_measured_joints_as_they_are_and_holds_the_others_back(name, caplog):
    head = load_head(name)
    with head_on_emulated_servos(name) as chain:
        led(name, chain, Person(*by_hand(chain)[:5]))
    found = load_overlay(head).calibrate
    assert found is not None
    with launch(emulated(head)["main"]) as chain:
        ready = ready_on(name, chain.device)
    assert ready.joints["jaw"] == calibrated(head.joints["jaw"], found.joints["jaw"], head.safety)
    assert ready.joints["brow"] == held_back(head, head.joints).joints["brow"] and ready_on(name, "sim") == head
    assert "not calibrated in brow" in caplog.text


@pytest.fixture
def turret(tmp_path, monkeypatch) -> Path:
    """A copy of a shipped head, and a folder for what belongs to this build."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    folder = tmp_path / "my turret"
    shutil.copytree(find("heads", "interbotix_wxxms", "head.yaml"), folder)
    return folder


def reversed_turret(**registers) -> list[EmulatedServo]:
    """Servos of the turret, of which the second runs the other way than its head's file says."""
    pan, tilt = emulated(load_head("interbotix_wxxms"))["main"]
    return [pan, replace(tilt, registers={"drive_mode": 0, **registers})]


@pytest.mark.parametrize("shipped", [False, True])
def test_the_command_that_a_refusal_names_records_the_value_and_the_head_starts(turret, shipped, command_line):
    head = "interbotix_wxxms" if shipped else str(turret)
    own = find("heads", head, "head.yaml") / "head.yaml"
    before = own.read_bytes()
    with launch(reversed_turret(homing_offset=-100, shutdown=0)) as chain:
        start = ("run", "--head", head, "--port", chain.device, "--dry-run", "--yes", "--json")
        stored = identify(load_head(head), ["pan", "tilt"], {"main": chain.device}, RealClock())
        refused = command_line(*start)
        assert refused.code == 4 and "servo 2 (tilt): homing_offset is -100, wanted 0" in refused.err
        assert f"(sfms-robot head calibrate --port {chain.device} {shlex.quote(head)} --joint tilt)" in refused.err
        cure = shlex.split(refused.err.strip().partition("fits it: sfms-robot ")[2])
        looked = command_line(*cure[:-1], "--json")
        errors = [each for each in looked.told["findings"] if each["severity"] == "error"]
        assert looked.code == 4 and {each["fix"] for each in errors} == {f"sfms-robot {shlex.join(cure)}"}
        assert command_line(*cure, "--yes", "--json").code == 0 and command_line(*start).code == 0
        assert identify(load_head(head), ["pan", "tilt"], {"main": chain.device}, RealClock()) == stored
    written = overlay_file("interbotix_wxxms") if shipped else own
    assert {"homing_offset: -100", "drive_mode: 0"} <= set(re.findall(r"\w+: -?\d+", written.read_text()))
    assert (own.read_bytes() == before) == shipped == overlay_file("interbotix_wxxms").exists()


def test_run_and_doctor_say_alike_that_servos_give_way_under_a_fault_that_the_head_ignores(tmp_path, command_line):
    folder = tmp_path / "mini"
    shutil.copytree(find("heads", "reachy_mini", "head.yaml"), folder)
    head, emulate = folder / "head.yaml", folder / "emulate.yaml"
    head.write_text(head.read_text().replace("{thresholds: {input voltage: {max: 7.8}}}", "{mask: [input voltage]}"))
    stored = emulate.read_text().replace("shutdown: 52", "shutdown: 53")
    emulate.write_text(stored.replace("supply_v: 7.2", "supply_v: 6.0"))
    ended = command_line("run", "--head", folder, "--duration", 0.2, "--fast", "--json")
    (line,) = ended.told["bus"]["stored_warnings"]
    names, _, said = line.partition(": ")
    assert ended.code == 0 and names.startswith("stewart_1, ") and "it switches torque off on input voltage" in said
    findings = command_line("doctor", "--head", folder, "--port", "sim", "--json").told["findings"]
    assert [each["severity"] for each in findings if said in each["problem"]] == ["warning"]


def test_less_protection_is_one_warning_and_a_line_in_the_report(turret, command_line, caplog):
    (turret / "emulate.yaml").write_text("joints: {tilt: {shutdown: 0}, pan: {shutdown: 0}}\n")
    ended = command_line("run", "--head", turret, "--duration", 0.2, "--fast", "--json")
    (line,) = ended.told["bus"]["stored_warnings"]
    assert ended.code == 0 and line.startswith("pan, tilt: shutdown is 0, wanted 52: it does not switch torque off on")
    assert [record for record in caplog.records if "shutdown" in record.getMessage()] == [
        record for record in caplog.records if f"doctor --port sim --head '{turret}' --fix" in record.getMessage()
    ]


def test_a_joint_is_measured_whatever_its_servo_has_stored_and_starts_with_it(name, command_line):
    servos = [EmulatedServo(1, registers={"homing_offset": 300, "drive_mode": 1}), EmulatedServo(2)]
    save_overlay(Overlay(head="two").recorded(head_hash(name), "jaw", {"homing_offset": 1}), overlay_file("two"))
    with launch(servos, virtual=True) as chain:
        outcome = led(name, chain, Person(*by_hand(chain)[:5]), joints=["jaw"])
    assert outcome.measured == ["jaw"]
    head = load_head(name)
    now = layered(head, load_overlay(head), head_hash(name)).head
    assert now.safety_of("jaw").stored == {"homing_offset": 300, "drive_mode": 1}
    with launch(servos) as chain:
        assert command_line("run", "--head", name, "--port", chain.device, "--dry-run").code == 0
