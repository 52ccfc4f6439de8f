"""Head folders from the files of other software: LeRobot's calibration, pypot's robots, Reachy Mini's hardware.

Each reader turns one format into the plain data of a head.yaml, and adds a remark for each value that has no place
there. The head is checked as any other before a file is written.

Sources of the formats: huggingface/lerobot `motors/motors_bus.py` (MotorCalibration), poppy-project/pypot
`robot/config.py` and `dynamixel/motor.py`, pollen-robotics/reachy_mini `assets/config/hardware_config.yaml`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal

import yaml
from pydantic import BaseModel, RootModel

from sfms_robot.app.output_paths import made_folder
from sfms_robot.config import FirmwareMap, Head, load_firmware_map, map_files, parse
from sfms_robot.config.base import read
from sfms_robot.data import Report, head_file
from sfms_robot.errors import ConfigError

LIMITS: Final = {"speed_deg_s": 150, "acceleration_deg_s2": 1500, "jerk_deg_s3": 90_000}  # limits of a slow neck
_BAUD: Final = 1_000_000  # LeRobot's and pypot's default
_CHANNELS: Final = {  # the words of a joint's name that stand for a channel; axes only count in a neck
    "yaw": ("yaw", "pan", "rotation", "neck z"),
    "pitch": ("pitch", "tilt", "nod", "neck y"),
    "roll": ("roll", "neck x"),
    "jawOpen": ("jaw", "mouth", "beak"),
}
_PYPOT_MODELS: Final = {"ax-12": "ax-12a", "ax-18": "ax-18a"}  # model by pypot's name; MX models depend on the protocol
_REACHY: Final = "reachy_mini"

Draft = tuple[Report, list[str]]  # the plain data of a head.yaml, and the remarks


def import_head(file: Path, folder: Path | None = None, model: str | None = None) -> Report:
    """Write a head folder from the file of another program. The servos are neither read nor moved.

    Returns the `folder`, the kind of file that it was `read_as`, the `joints`, and `remarks`: one line for each
    value that was left out, was assumed or has to be checked.

    Args:
        folder: a new folder; None: a folder with the file's name in the current folder.
        model: model of the servos, for LeRobot's calibration, which does not name it.

    Raises ConfigError for a file of another kind, a file that makes no valid head, and a folder that exists.
    """
    folder = folder or Path(re.sub(r"\W+", "_", file.stem).strip("_") or "head")
    if folder.exists():
        raise ConfigError(f"{folder}: exists already; name a new folder with --to DIR")
    source, reader = _reader(file, raw := _plain(file))
    name = re.sub(r"\W+", "_", folder.name)
    head, remarks = reader(raw, file, name if name[:1].isalpha() else f"head_{name}", model)
    parse(Head, head, file)
    lines = [f"# From {file.name}, read as {source}.", *(f"# {remark}" for remark in remarks)]
    text = yaml.safe_dump(head, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
    (made_folder(folder, "--to") / "head.yaml").write_text("\n".join([*lines, text]), encoding="utf-8")
    return {"version": 1, "folder": str(folder), "read_as": source, "joints": list(head["joints"]), "remarks": remarks}


def _plain(file: Path) -> Any:
    if file.suffix.lower() != ".json":
        return read(file)
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: cannot be read as JSON: {error}") from error


def _reader(file: Path, raw: Any) -> tuple[str, Callable[[Any, Path, str, str | None], Draft]]:
    keys = set(raw) if isinstance(raw, dict) else set()
    if {"motors", "controllers"} <= keys:
        return "a robot of pypot", _from_pypot
    if isinstance(raw, dict) and isinstance(raw.get("motors"), list):
        return "Reachy Mini's hardware", _from_reachy
    if keys and all(isinstance(motor, dict) and "homing_offset" in motor for motor in raw.values()):
        return "a calibration of LeRobot", _from_lerobot
    got = ", ".join(map(str, raw)) if isinstance(raw, dict) else type(raw).__name__
    raise ConfigError(
        f"{file}: expected a calibration of LeRobot (JSON), a robot of pypot (JSON) or Reachy Mini's "
        f"hardware_config.yaml, got {got[:80] or 'nothing'}"
    )


# --- LeRobot --------------------------------------------------------------------------------------------------------


class LeRobotMotor(BaseModel):
    """One motor of LeRobot's calibration; ticks are those that the servo reports, its homing offset included."""

    id: int
    drive_mode: Literal[0, 1] = 0
    homing_offset: int
    range_min: int
    range_max: int


class LeRobotCalibration(RootModel[dict[str, LeRobotMotor]]):
    """A file below `~/.cache/huggingface/lerobot/calibration`."""


def _from_lerobot(raw: Any, file: Path, name: str, model: str | None) -> Draft:
    motors = parse(LeRobotCalibration, raw, file).root
    remarks = []
    if model is None:
        model = "sts3215"
        remarks.append("model: the file names none; sts3215 is assumed (another: --model)")
    table = load_firmware_map(model)
    if table.family not in ("dynamixel", "feetech") or table.protocol is None:
        driven = [each.stem for each in map_files() if each.parent.name in ("dynamixel", "feetech")]
        raise ConfigError.at(file, "--model", model, "is a model that LeRobot does not drive", driven)
    feetech = table.family == "feetech"
    family = "feetech" if feetech else f"dynamixel{table.protocol}"
    # LeRobot's homing sets the middle of the joint, where it was held by hand, to half a turn: 2047 of 4096.
    zero = int((table.ticks_per_revolution - 1) / 2)
    joints = {}
    for title, motor in motors.items():
        # For a Feetech servo LeRobot negates values itself; a Dynamixel has a register for the mode.
        sign = -1 if motor.drive_mode and feetech else 1
        joint = _joint(motor.id, table, zero, sign, (motor.range_min, motor.range_max))
        stored = {"homing_offset": motor.homing_offset} if "homing_offset" in table.registers else {}
        if not feetech and "drive_mode" in table.registers:
            stored["drive_mode"] = motor.drive_mode
        joints[_name(title, remarks)] = joint | {"safety": {"stored": stored}}
    return _finished(
        name, "from a calibration of LeRobot", {"main": {"family": family, "baud": _BAUD}}, joints, remarks
    )


# --- pypot ----------------------------------------------------------------------------------------------------------


class PypotController(BaseModel):
    """A bus of pypot; `attached_motors` holds motors and groups of them."""

    attached_motors: list[str]
    port: str = "auto"
    protocol: Literal[1, 2] = 1
    baudrate: int = _BAUD


class PypotMotor(BaseModel):
    """A motor of pypot, in degrees. `angle_limit` is that of the servo, without `offset` and `orientation`."""

    id: int
    type: str
    orientation: Literal["direct", "indirect"]
    offset: float
    angle_limit: tuple[float, float]
    broken: bool = False


class PypotRobot(BaseModel):
    """A robot of pypot: `software/NAME/configuration/NAME.json` of Poppy's projects."""

    controllers: dict[str, PypotController]
    motorgroups: dict[str, list[str]] = {}
    motors: dict[str, PypotMotor]


def _from_pypot(raw: Any, file: Path, name: str, model: str | None) -> Draft:
    robot = parse(PypotRobot, raw, file)
    remarks: list[str] = []
    buses: Report = {}
    joints: Report = {}
    attached = set[str]()
    for title, controller in robot.controllers.items():
        bus = _name(title, remarks)
        buses[bus] = {"family": f"dynamixel{controller.protocol}", "baud": controller.baudrate}
        remarks.append(f"{bus}: port {controller.port!r} is given to each command instead: --port {bus}=DEVICE")
        for motor in _members(controller.attached_motors, robot.motorgroups, robot.motors, file):
            attached.add(motor)
            given = robot.motors[motor]
            table = _pypot_map(given.type, controller.protocol)
            if given.broken or table is None:
                why = "it is marked as broken" if given.broken else f"servo {given.type} has no map here"
                remarks.append(f"{motor}: left out, {why}")
                continue
            # Position of pypot = sign * angle - offset, the angle from the middle of the servo (motor.py).
            sign = 1 if given.orientation == "direct" else -1
            per_deg = table.ticks_per_revolution / 360
            zero = round(table.center_ticks + sign * given.offset * per_deg)
            low, high = (round(table.center_ticks + angle * per_deg) for angle in given.angle_limit)
            joints[_name(motor, remarks)] = {"bus": bus} | _joint(given.id, table, zero, sign, (low, high))
    remarks += [f"{motor}: left out, on no controller" for motor in robot.motors if motor not in attached]
    if not joints:
        raise ConfigError(f"{file}: motors: none can be taken over: {'; '.join(remarks)}")
    used = {joint["bus"] for joint in joints.values()}
    return _finished(name, "from a robot of pypot", {bus: buses[bus] for bus in buses if bus in used}, joints, remarks)


def _members(
    names: list[str], groups: Mapping[str, list[str]], motors: Mapping[str, PypotMotor], file: Path, depth: int = 0
) -> Iterator[str]:
    """Yield the motors of a list of motors and groups, which may hold groups."""
    for name in names:
        if name in motors:
            yield name
        elif name in groups and depth < len(groups):
            yield from _members(groups[name], groups, motors, file, depth + 1)
        else:
            raise ConfigError.at(file, "attached_motors", name, "is neither a motor nor a group", [*motors, *groups])


def _pypot_map(kind: str, protocol: int) -> FirmwareMap | None:
    kind = _PYPOT_MODELS.get(kind.lower(), kind.lower())
    found = {file.stem: file for file in map_files()}
    model = f"{kind}-{protocol}.0" if f"{kind}-{protocol}.0" in found else kind
    return load_firmware_map(model) if model in found else None


# --- Reachy Mini ----------------------------------------------------------------------------------------------------


class ReachyMotor(BaseModel):
    """A motor of Reachy Mini's hardware file; limits in ticks around 2048, after the homing offset."""

    id: int
    offset: int = 0
    lower_limit: int
    upper_limit: int
    pid: tuple[int, int, int] = (400, 0, 0)


class ReachySerial(BaseModel):
    """The serial line of Reachy Mini."""

    baudrate: int = _BAUD


class ReachyHardware(BaseModel):
    """Reachy Mini's `hardware_config.yaml`."""

    serial: ReachySerial = ReachySerial()
    motors: list[dict[str, ReachyMotor]]


def _from_reachy(raw: Any, file: Path, name: str, model: str | None) -> Draft:
    """Return the shipped Reachy Mini with the ids, limits, offsets and gains of the file."""
    hardware = parse(ReachyHardware, raw, file)
    motors = {title: motor for each in hardware.motors for title, motor in each.items()}
    shipped = read(head_file(_REACHY))
    remarks = [f"{title}: left out, no joint of Reachy Mini" for title in motors if title not in shipped["joints"]]
    joints = {}
    for title, joint in shipped["joints"].items():
        if title not in motors:
            remarks.append(f"{title}: not in the file, left out")
            continue
        motor, twin = motors[title], joint.get("mirror_of")
        if twin is not None and twin not in motors:
            remarks.append(f"{title}: left out, as it follows {twin}, which the file lacks")
            continue
        low, high = ((limit - 2048) * 360 / 4096 for limit in (motor.lower_limit, motor.upper_limit))
        joint = {**joint, "id": motor.id}
        if twin is None:  # the common part of both ranges; a twin mirrors the range of the other joint
            joint |= {"min_deg": max(low, joint["min_deg"]), "max_deg": min(high, joint["max_deg"])}
        joint["safety"] = {"registers": {"position_p_gain": motor.pid[0]}, "stored": {"homing_offset": motor.offset}}
        joints[title] = {key: value for key, value in joint.items() if key != "note"}
        if any(motor.pid[1:]):
            remarks.append(f"{title}: pid I and D {list(motor.pid[1:])} are not taken over")
    if not joints:
        raise ConfigError(f"{file}: motors: expected joints of Reachy Mini, got {', '.join(motors) or 'none'}")
    remarks.append("return_delay_time, shutdown_error: stay in the servos; `sfms-robot doctor` compares them")
    head = {**shipped, "name": name, "joints": joints, "description": "Reachy Mini, from its hardware_config.yaml"}
    head["buses"] = {"main": {**shipped["buses"]["main"], "baud": hardware.serial.baudrate}}
    needed = [leg["joint"] for leg in shipped["kinematics"]["legs"]] + [shipped["kinematics"]["body_yaw"]["joint"]]
    if missing := [joint for joint in needed if joint not in joints]:
        del head["kinematics"]
        remarks.append(f"kinematics: left out, without {', '.join(missing)} the platform cannot be posed")
    head["regions"] = {
        region: {"joints": kept}
        for region, given in shipped["regions"].items()
        if (kept := [joint for joint in given["joints"] if joint in joints])
    }
    return head, remarks


# --- What the formats share -----------------------------------------------------------------------------------------


def _joint(servo: int, table: FirmwareMap, zero: int, sign: int, ticks: tuple[int, int]) -> Report:
    """Return the place, direction and range of a joint; its rest is zero, or the end of its range nearest to zero."""
    low, high = (sign * (tick - zero) * 360 / table.ticks_per_revolution for tick in ticks[::sign])
    joint = {"id": servo, "model": table.model, "zero_ticks": zero, "min_deg": round(low, 2), "max_deg": round(high, 2)}
    if sign < 0:
        joint["sign"] = sign
    if not low <= 0 <= high:
        joint["rest_deg"] = joint["min_deg"] if low > 0 else joint["max_deg"]
    return joint


def _name(given: str, remarks: list[str]) -> str:
    name = re.sub(r"\W+", "_", given, flags=re.ASCII).strip("_")
    name = name if name[:1].isalpha() else f"joint_{name}"
    if name != given:
        remarks.append(f"{given}: is called {name} here")
    return name


def _finished(name: str, description: str, buses: Report, joints: Report, remarks: list[str]) -> Draft:
    """Return the head; a joint gets a drive if it is the only one whose name stands for a channel."""
    words = {joint: set(re.split(r"[_\d]+", joint.lower().replace("head", "neck"))) for joint in joints}
    for channel, known in _CHANNELS.items():
        named = [joint for joint, has in words.items() if any(has.issuperset(each.split()) for each in known)]
        if len(named) == 1:
            joint = joints[named[0]]
            opens = 1 if joint["max_deg"] >= -joint["min_deg"] else -1  # a jaw opens to the longer side of its range
            drive = {"channel": channel, "gain": opens} if channel == "jawOpen" and opens < 0 else channel
            joint |= {"unit": "range" if channel == "jawOpen" else "rad", "drive": drive}
            remarks.append(f"{named[0]}: drive {channel} is taken from its name; see that it turns the right way")
    for joint in joints.values():
        joint |= {"limits": "all", "bus": joint.get("bus", "main")}
    if undriven := [joint for joint, keys in joints.items() if "drive" not in keys]:
        remarks.append(f"no drive: {', '.join(undriven)}; at rest until you write one")
    remarks.append("limits: the file has no speeds; a slow neck's are assumed (150 deg/s)")
    head = {
        "version": 1,
        "name": name,
        "description": description,
        "calibrate_first": True,  # directions were not measured on the assembled head
        "buses": buses,
        "limits": {"all": dict(LIMITS)},
        "joints": joints,
        "life": {"idle": {}, "person": {}},
    }
    return head, remarks
