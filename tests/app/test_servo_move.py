"""`servo move`: slowly there, and the servo left as it was found; `servo release`: torque off, whatever its state."""

import pytest
from test_single_servo import new, put, wire_on

from sfms_robot.app.open_head import build_bus
from sfms_robot.app.servo.move import BEHIND_DEG, SILENT, SPEED_DEG_S, move, release, release_chain
from sfms_robot.app.servo.single_servo import read_registers
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.errors import NOTE, BusError, ConfigError, PortError, ServoError, TorqueError
from sfms_robot.lab.bench.campaign_rig import FAMILIES, head_of
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.servo.port import WrappedPort
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import limit_names

MODELS = {"xl330-m288": "dynamixel2", "xl-320": "dynamixel2", "ax-12a": "dynamixel1", "sts3215": "feetech"}


class Watched(WrappedPort):
    """A port that keeps the servo's state each time its clock is waited for."""

    def __init__(self, wire, chain):
        super().__init__(wire.port)
        self.wire, self.chain, self.seen = wire, chain, []

    def wait_until(self, time_s):
        super().wait_until(time_s)
        self.chain.time_is(self.now_s())
        self.seen.append((self.now_s(), self.chain.state(1)["position"]))

    def fastest_deg_s(self, table):
        steps = zip(self.seen, self.seen[1:], strict=False)
        speeds = [abs(b - a) / (t - s) for (s, a), (t, b) in steps if t > s]
        return max(speeds, default=0.0) * 360.0 / table.ticks_per_revolution


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("by", [90, -90, 3])
def test_it_gets_there_slowly_and_torque_and_profile_are_put_back(model, by):
    with wire_on(new(1, model), family=MODELS[model]) as (wire, chain):
        seen = wire.find(1)
        table = seen.registers()
        speed, torque = table.role("moving_speed"), seen.named("torque_enable")
        before = seen.read(speed)
        wire.port = watched = Watched(wire, chain)
        result = move(seen, None, str(by))
        assert abs(result["reached"] - (table.center_ticks + by)) <= table.ticks_per_revolution / 200
        assert (seen.read(torque), seen.read(speed)) == (0, before)
        assert watched.fastest_deg_s(table) <= 2.5 * SPEED_DEG_S


def test_degrees_are_those_of_the_shaft_and_a_servo_that_held_goes_on_holding():
    with wire_on(new(1, "xl330-m288")) as (wire, _):
        put(wire, 1, "torque_enable", 1)
        assert move(wire.find(1), None, "-9deg")["to"] == 2048 - 102
        assert wire.find(1).read(wire.find(1).named("torque_enable")) == 1


@pytest.mark.parametrize(
    ("to", "by", "stored", "problem"),
    [
        ("9999", None, {}, "outside its limits"),
        ("2200", None, {"min_position_limit": 2000, "max_position_limit": 2100}, "2000..2100"),
        (None, None, {}, "expected either --to or --by"),
        ("5", "5", {}, "expected either --to or --by"),
        ("x", None, {}, "not a place"),
        ("2050", None, {"operating_mode": 1}, "sfms-robot servo write 1 operating_mode 3 --port /"),
    ],
)
def test_what_is_no_goal_is_refused_with_nothing_moved(to, by, stored, problem):
    with wire_on(new(1, "xl330-m288", **stored)) as (wire, chain):
        with pytest.raises((ConfigError, ServoError), match=problem):
            move(wire.find(1), to, by)
        assert not chain.state(1)["torque"]


def outside(model, degrees=-12.0):
    """A servo that stands that far below limits which somebody has stored in it."""
    table = Table.of(load_firmware_map(model))
    low, high = limit_names(table)
    first = table.center_ticks - round(20 / 360 * table.ticks_per_revolution)
    start = first + round(degrees / 360 * table.ticks_per_revolution)
    registers = {low: first, high: table.center_ticks + 200}
    return EmulatedServo(1, model, start_ticks=start, registers=registers), first, table


@pytest.mark.parametrize("model", MODELS)
def test_one_outside_its_own_limits_is_brought_in_slowly_and_moved_on(model, caplog):
    caplog.set_level(NOTE)
    servo, first, table = outside(model)
    with wire_on(servo, family=MODELS[model]) as (wire, chain):
        seen = wire.find(1)
        with pytest.raises(ConfigError, match="outside its limits"):
            move(seen, None, "1")
        assert not chain.state(1)["torque"] and chain.state(1)["position"] == servo.start_ticks
        speed, torque = table.role("moving_speed"), seen.named("torque_enable")
        before = seen.read(speed)
        wire.port = watched = Watched(wire, chain)
        result = move(seen, str(table.center_ticks), None)
        assert abs(result["reached"] - table.center_ticks) <= table.ticks_per_revolution / 200
        assert (seen.read(torque), seen.read(speed)) == (0, before)
        assert watched.fastest_deg_s(table) <= 2.5 * SPEED_DEG_S
    assert f"stands at {servo.start_ticks}, outside its own limits {first}.." in caplog.text
    assert "moving it inside at 20 deg/s" in caplog.text


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("ends", ["stuck", "Ctrl-C"])
def test_one_that_does_not_come_in_has_no_torque_before_its_usual_profile_is_back(model, ends):
    servo, first, table = outside(model)

    class Ended(Watched):
        def wait_until(self, time_s):
            super().wait_until(time_s)
            if ends == "stuck":
                self.chain.turn(1, servo.start_ticks)
            elif self.seen[-1][1] > servo.start_ticks:
                raise KeyboardInterrupt

    with wire_on(servo, family=MODELS[model]) as (wire, chain):
        seen = wire.find(1)
        speed, port = table.role("moving_speed"), wire.port
        before = seen.read(speed)
        wire.port = Ended(wire, chain)
        with pytest.raises((ServoError, KeyboardInterrupt)):
            move(seen, str(table.center_ticks), None)
        wire.port = port
        assert seen.read(speed) == before and not chain.state(1)["torque"] and chain.state(1)["position"] < first


def test_something_in_the_way_ends_it_without_torque():
    with wire_on(new(1, "xl330-m288")) as (wire, chain):

        class Blocked(Watched):
            def wait_until(self, time_s):
                super().wait_until(time_s)
                self.chain.turn(1, 2048)  # a hand that keeps the shaft where it is

        wire.port = Blocked(wire, chain)
        with pytest.raises(ServoError, match="something is in the way"):
            move(wire.find(1), None, "60deg")
        assert not chain.state(1)["torque"] and abs(chain.state(1)["position"] - 2048) < BEHIND_DEG * 4096 / 360


class Interrupted(Watched):
    """Ctrl-C on the way; `more` then happens to the wire, once."""

    def __init__(self, wire, chain, more):
        super().__init__(wire, chain)
        self.more = more

    def wait_until(self, time_s):
        super().wait_until(time_s)
        if len(self.seen) == 5:
            self.more(self.wire, self.chain)
            raise KeyboardInterrupt


class InterruptedPort(WrappedPort):
    """A port on which the first write of each packet is cut short by another Ctrl-C, before anything is sent."""

    def __init__(self, inner):
        super().__init__(inner)
        self.cut = set()

    def write(self, data):
        if bytes(data) not in self.cut:
            self.cut.add(bytes(data))
            raise KeyboardInterrupt
        super().write(data)


def again(wire, chain):
    wire.link.port = InterruptedPort(wire.link.port)


def cable_out(wire, chain):
    chain.kill(1)


@pytest.mark.parametrize(("more", "ends"), [(again, KeyboardInterrupt), (cable_out, TorqueError)])
def test_after_an_interrupt_torque_is_off_or_named(more, ends):
    with wire_on(new(1, "ax-12a"), family="dynamixel1") as (wire, chain):
        seen = wire.find(1)
        wire.port = Interrupted(wire, chain, more)
        with pytest.raises(ends) as ended:
            move(seen, None, "200")
        assert chain.state(1)["torque"] == (ends is TorqueError)
    assert ends is KeyboardInterrupt or str(ended.value).startswith("torque of id 1 could not be confirmed off")


def left_by_a_killed_run(head, chains, clock):
    """Torque on, ports closed, nothing switched off."""
    bus = build_bus(head, chains, clock, confirmed=True)
    bus.connect()
    bus.write(bus.enable(list(head.joints)), clock.now_s())
    bus.poll(clock.now_s())
    bus.close()
    assert all(chains[joint.bus].state(joint.id)["torque"] for joint in head.joints.values())


def off(rows):
    return {row["joint"] or row["id"]: row["torque"] == "off" for row in rows}


@pytest.mark.parametrize("everything", [False, True])
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_is_released_and_confirms_it(family, everything):
    head, clock = head_of(family), VirtualClock()
    servos = emulated(head)["main"]
    other = [EmulatedServo(9, servos[0].model, servos[0].baud)] if load_firmware_map(servos[0].model).protocol else []
    with launch([*servos, *other], virtual=True) as chain:
        left_by_a_killed_run(head, {"main": chain}, clock)
        rows = release(head, {"main": chain}, clock, everything)
        chain.time_is(clock.now_s())
        assert not any(chain.state(joint.id)["torque"] for joint in head.joints.values())
    ours = {name: row for row in rows if (name := row["joint"])}
    assert off(ours.values()) == dict.fromkeys(head.joints, True)
    more = {9} if other else set(range(24 if family.startswith("maestro") else 32)) - {0, 1, 2, 5}
    assert {row["id"] for row in rows if row["joint"] is None} == (more if everything else set())


def test_every_bus_of_a_head_is_released_though_the_port_of_one_fails():
    head, clock = head_of("sts", reconnect_s=1.0), VirtualClock()
    servos = emulated(head)
    with launch(servos["main"], virtual=True) as chain:
        with launch(servos["other"], virtual=True) as other:
            left_by_a_killed_run(head, {"main": chain, "other": other}, clock)
        rows = release(head, {"main": chain, "other": other}, clock)
        assert off(rows) == {"joint1": True, "joint2": True, "joint3": False, "joint4": False}
        assert "no emulator" in rows[2]["note"] and not chain.state(1)["torque"]
        with pytest.raises(PortError, match="no emulator"):
            release(head, {"other": other}, clock)
        chain.hang_up()
        with pytest.raises((BusError, PortError)):
            release(head, {"main": chain}, clock)


@pytest.mark.parametrize(
    ("fault", "notes"),
    [
        ("overload:2", {2: ""}),
        ("silent:3", {3: SILENT}),
        ("mute:3", {3: SILENT}),
        ("silent", dict.fromkeys((1, 2, 3, 4), SILENT)),
    ],
)
@pytest.mark.parametrize("family", ["dynamixel2", "dynamixel1", "sts", "scs"])
def test_a_servo_in_an_error_is_released_and_a_silent_one_is_named(family, fault, notes):
    head, clock = head_of(family), VirtualClock()
    with launch(emulated(head)["main"], virtual=True, behind_silent="skip") as chain:
        left_by_a_killed_run(head, {"main": chain}, clock)
        chain.inject(fault)
        rows = release(head, {"main": chain}, clock)
        assert {row["id"]: row["note"] for row in rows} == {1: "", 2: "", 3: "", 4: ""} | notes
        chain.time_is(clock.now_s())
        still = [i for i in (1, 2, 3, 4) if chain.state(i)["torque"]]
        assert still == ([i for i in notes if notes[i]] if fault.startswith("silent") else [])  # a mute one obeys


@pytest.mark.parametrize("named", ["xl330-m288", "xl-320"])
@pytest.mark.parametrize("model", ["xl330-m288", "xl-320"])
def test_nothing_but_torque_is_written_whatever_model_the_head_names(model, named):
    with wire_on(new(1, model), EmulatedServo(2, model), baud=1_000_000) as (wire, chain):
        for servo in (1, 2):
            put(wire, servo, "torque_enable", 1)
        if model == "xl330-m288":  # a host that died: its watchdog trips and refuses goals
            put(wire, 1, "bus_watchdog", 5)
            wire.port.wait_until(wire.port.now_s() + 1.0)
        live = ("present", "moving", "realtime", "torque_enable", "velocity_trajectory", "position_trajectory")

        def settings(servo):
            values = read_registers(wire.find(servo), ["all"])
            return {value["register"]: value["raw"] for value in values if not value["register"].startswith(live)}

        before = settings(1)
        assert release_chain(wire, dict.fromkeys((1, 2), Table.of(load_firmware_map(named))), False) == {1: "", 2: ""}
        assert settings(1) == before and not chain.state(1)["torque"] and not chain.state(2)["torque"]
        if model == "xl330-m288":
            put(wire, 1, "torque_enable", 1)
            level = wire.find(1).registers()["status_return_level"]
            wire.link.write(1, level.address, b"\0")  # it answers pings only
            note = release_chain(wire, {1: Table.of(load_firmware_map(model))}, False)[1]
            assert "status return level" in note and not chain.state(1)["torque"]
