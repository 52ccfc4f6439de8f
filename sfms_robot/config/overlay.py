"""Measurements of one built head, applied on top of its shipped file: `heads/NAME.yaml` in the user's folder.

Two builds of a head differ in their zeros, ranges and directions, and in how their skin responds. These differences are
kept apart from the shipped file, in layers that are applied in this order:

    head file -> calibrate (zero, ends and direction of each joint) -> stored (registers of a servo, as confirmed)
              -> fit (drives learnt from sight)

A measurement is valid for the servo and the head file that it was made with. If one of them has changed since, the
joint counts as not calibrated.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import Field

from sfms_robot.config.base import Model, Name, Problems, load, parse, read, with_number
from sfms_robot.config.consistency import problems
from sfms_robot.config.firmware import load_firmware_map
from sfms_robot.config.head import IN_OPPOSITE, Head, load_head
from sfms_robot.config.joint import Expression, Joint, Safety
from sfms_robot.data import Names, data_dir, head_file, user_dir, write_whole
from sfms_robot.errors import ConfigError
from sfms_robot.ports import Facts

CALIBRATE: Final = "calibrate"
FIT: Final = "fit"
LAYERS: Final = (CALIBRATE, "stored", FIT)
OLD_FILE: Final = "the head's file has changed since"

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Identity(Model):
    """Identity of a servo. Values that its family does not report are None; `drive_mode` is only the direction bit."""

    id: int = Field(ge=0, le=253)
    model: str
    firmware: int | None = None
    homing_offset: int | None = None
    drive_mode: int | None = None

    @property
    def stored(self) -> dict[str, int]:
        """Values of the servo's stored registers on which a measurement of zero and direction depends."""
        return self.model_dump(include={"homing_offset", "drive_mode"}, exclude_none=True)

    def difference(self, now: Identity) -> str | None:
        """Return a text about the first difference from `now`, or None."""
        for key in Identity.model_fields:
            was, is_ = getattr(self, key), getattr(now, key)
            if was != is_:
                return f"{key} was {was} and is {is_}"
        return None


class Measured(Identity):
    """Measurement of one joint in servo ticks; `sign` +1: ticks rise towards the joint's upper end."""

    date: date
    min_ticks: int
    center_ticks: int
    max_ticks: int
    sign: Literal[1, -1]

    def contradictions(self) -> Problems:
        if not self.sign * self.min_ticks <= self.sign * self.center_ticks <= self.sign * self.max_ticks:
            ticks = f"{self.min_ticks}, {self.center_ticks}, {self.max_ticks}"
            yield f"min_ticks, center_ticks, max_ticks = {ticks} are not in the order of sign {self.sign}"
        if self.min_ticks == self.max_ticks:
            yield f"min_ticks and max_ticks are both {self.min_ticks}: no travel"


class Layer(Model):
    """Part of an overlay, and the head file that it was made for."""

    head_sha256: Sha256


class CalibrateLayer(Layer):
    """Joints measured so far."""

    joints: dict[Name, Measured] = {}


class StoredLayer(Layer):
    """Registers that the servos of joints store, confirmed by the user."""

    joints: dict[Name, dict[Name, int]] = {}


class Fitted(Model):
    """A learnt drive, which replaces that of the joint."""

    drive: Expression


class FitLayer(Layer):
    """Drives learnt from sight."""

    date: date
    note: str = ""
    joints: dict[Name, Fitted] = {}


class Overlay(Model):
    """The file of one built head."""

    head: Name
    calibrate: CalibrateLayer | None = None
    stored: StoredLayer | None = None
    fit: FitLayer | None = None

    @property
    def measured(self) -> dict[str, Measured]:
        """Measurements of joints, valid or not."""
        return {} if self.calibrate is None else self.calibrate.joints

    def confirmed(self, sha256: str) -> dict[str, dict[str, int]]:
        """Return the registers that are recorded as stored in servos, by joint, for a head file with this hash."""
        return self.stored.joints if self.stored is not None and self.stored.head_sha256 == sha256 else {}

    def recorded(self, sha256: str, joint: str, stored: Mapping[str, int]) -> Overlay:
        """Return the overlay with more registers of one joint recorded."""
        before = self.confirmed(sha256)
        joints = {**before, joint: {**before.get(joint, {}), **stored}}
        return self.replaced(stored=StoredLayer(head_sha256=sha256, joints=joints))


@dataclass(frozen=True, kw_only=True)
class Layered:
    """A head with its overlay applied.

    Attributes:
        calibrated: joints with a valid measurement.
        refused: joint -> reason why its measurement is not valid.
        fitted: joints with a learnt drive.
        notes: one line for each layer that is not used at all.
    """

    head: Head
    calibrated: frozenset[str] = frozenset()
    refused: Mapping[str, str] = field(default_factory=dict)
    fitted: frozenset[str] = frozenset()
    notes: Names = ()


def overlay_file(head: str, practice: bool = False) -> Path:
    """Return the file of a head's overlay; `practice`: that of emulated servos, which no run uses."""
    return user_dir() / "heads" / (f"{head}.practice.yaml" if practice else f"{head}.yaml")


def head_hash(name: str) -> str:
    """Return the SHA-256 of a head's file, by shipped name or folder."""
    return hashlib.sha256(head_file(name).read_bytes()).hexdigest()


def load_overlay(head: Head, file: Path | None = None) -> Overlay:
    """Return a head's overlay, empty without a file. Raises ConfigError if its head differs or a joint is unknown."""
    file = file or overlay_file(head.name)
    if not file.is_file():
        return Overlay(head=head.name)
    overlay = load(Overlay, file)
    if overlay.head != head.name:
        raise ConfigError.at(file, "head", overlay.head, "is another head", [head.name])
    for layer in LAYERS:
        part = getattr(overlay, layer)
        for joint in part.joints if part is not None else ():
            if joint not in head.joints:
                raise ConfigError.at(file, f"{layer}.joints", joint, "is not a joint of this head", head.joints)
    return overlay


def check_writable(file: Path) -> Path:
    """Return the file of an overlay after making its folder. Raises ConfigError at once if it cannot be written."""
    write_whole(probe := file.with_name(f".{file.name}.try"), "")
    probe.unlink()
    return file


def save_overlay(overlay: Overlay, file: Path) -> None:
    """Write an overlay completely or not at all. Raises ConfigError."""
    plain = overlay.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    text = "# Of one built head: written by `sfms-robot head calibrate`, `head fit` and `doctor --fix`.\n"
    write_whole(file, text + yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=120))


def layered(head: Head, overlay: Overlay, sha256: str, servos: Mapping[str, Identity | None] | None = None) -> Layered:
    """Apply all layers to a head.

    Args:
        sha256: hash of the head's present file.
        servos: identity of the servo that answers at each joint, or None; without `servos` only the file is compared.

    Raises ConfigError for a layer that contradicts other parts of the head.
    """
    joints, refused, notes = dict(head.joints), dict[str, str](), list[str]()
    for name, found in overlay.measured.items():
        joint, now = head.joints[name], found if servos is None else servos.get(name, found)
        if overlay.calibrate is None or overlay.calibrate.head_sha256 != sha256:
            refused[name] = OLD_FILE
        elif (found.id, found.model) != (joint.id, joint.model):
            was = f"measured on {found.model} id {found.id}"
            refused[name] = f"{was}, the head's file says {joint.model} id {joint.id}"
        elif now is None:
            refused[name] = "its servo does not answer"
        elif (changed := found.difference(now)) is not None:
            refused[name] = changed
        else:
            joints[name] = calibrated(joint, found, head.safety)
    joints |= {name: declared(joints[name], each, head.safety) for name, each in overlay.confirmed(sha256).items()}
    fit, fitted = overlay.fit, frozenset[str]()
    if fit is not None and fit.head_sha256 != sha256:
        notes.append(f"the fit of {fit.date} is not used: {OLD_FILE}")
    elif fit is not None:
        fitted = frozenset(fit.joints)
        drives = {name: learnt.drive for name, learnt in fit.joints.items()}
        checked = {name: head.joints[name].replaced(drive=drive) for name, drive in drives.items()}
        if wrong := problems(head.replaced(joints={**head.joints, **checked})):
            raise ConfigError(f"{overlay_file(head.name)}: fit: {wrong[0]}")
        joints |= {name: joints[name].replaced(drive=drive) for name, drive in drives.items()}
    return Layered(
        head=head.replaced(joints=joints),
        calibrated=frozenset(overlay.measured) - frozenset(refused),
        refused=refused,
        fitted=fitted,
        notes=tuple(notes),
    )


def calibrated(joint: Joint, found: Measured, usual: Safety) -> Joint:
    """Return the joint with measured zero, direction and ends; its rest angle is kept and lies at the measured centre.

    `usual`: safety section of the head, which that of the joint overrides.
    """
    ticks_per_deg = found.sign * joint.ratio * load_firmware_map(joint.model).ticks_per_revolution / 360.0
    zero_ticks = round(found.center_ticks - ticks_per_deg * joint.rest_deg)
    low, high = ((ticks - zero_ticks) / ticks_per_deg for ticks in (found.min_ticks, found.max_ticks))
    ends = {"min_deg": min(low, joint.rest_deg), "max_deg": max(high, joint.rest_deg)}
    joint = declared(joint, found.stored, usual)
    return joint.replaced(zero_ticks=zero_ticks, sign=found.sign, **ends)


def declared(joint: Joint, stored: Mapping[str, int], usual: Safety) -> Joint:
    """Return the joint with `stored` added to the register values that its servo has to store."""
    stored = {**usual.merged(joint.safety).stored, **stored}
    return joint.replaced(safety=(joint.safety or Safety()).replaced(stored=stored))


def record_stored(name: str, joint: str, stored: Mapping[str, int], practice: bool = False) -> Path:
    """Record in the file of head `name` the registers that the servo of a joint stores; return the file written.

    The head.yaml of the user is edited. The overlay is written instead for a shipped head, for a head that has an
    overlay (an edit would invalidate its measurements), for a file that cannot be written, and for a file whose form
    (an alias, a twin) does not allow a change of one joint alone.
    `practice`: the servos are emulated. Raises ConfigError if the overlay cannot be written.
    """
    head = load_head(name)
    own, file = head_file(name), overlay_file(head.name, practice)
    if not overlay_file(head.name).exists() and data_dir("configs").resolve() not in own.resolve().parents:
        text = own.read_bytes().decode()
        for register, value in stored.items():
            text = with_number(text, ("joints", joint, "safety", "stored", register), value)
        with suppress(ConfigError, yaml.YAMLError):
            edited = parse(Head, yaml.safe_load(text), own)
            wanted = {key: head.safety_of(key) for key in head.joints}
            wanted[joint] = wanted[joint].replaced(stored=stored)
            if {key: edited.safety_of(key) for key in edited.joints} == wanted:
                write_whole(own.resolve(), text)
                return own
    save_overlay(load_overlay(head, file).recorded(head_hash(name), joint, stored), file)
    return file


# --- Origin of each value: its own line, its twin, the head's defaults, or nowhere; then this build -------------------

SHOWN: Final = tuple(key for key in Joint.model_fields if key not in ("mirror_of", "mirror_sense", "safety", "note"))
MEASURED: Final = ("zero_ticks", "sign", "min_deg", "max_deg")  # set by a calibration


def provenance(name: str) -> tuple[dict[str, dict[str, tuple[Any, str]]], list[str]]:
    """Return the value and its origin per joint and key; and a line for each measurement and fit that is not valid.

    Measurements count here regardless of the servos that are plugged in. Raises ConfigError for an invalid head.
    """
    head = load_head(name)
    raw = read(head_file(name))
    overlay = load_overlay(head)
    layers = layered(head, overlay, head_hash(name))
    found = {}
    for joint, config in layers.head.joints.items():
        origins = {key: _origin(key, head.joints[joint], raw["joints"][joint], raw) for key in SHOWN}
        if joint in layers.calibrated:
            origins |= dict.fromkeys(MEASURED, f"{CALIBRATE} {overlay.measured[joint].date}")
        if joint in layers.fitted and overlay.fit is not None:
            origins |= {"drive": f"{FIT} {overlay.fit.date}"}
        values = config.model_dump(include={*SHOWN})
        if config.drive is not None:
            values["drive"] = config.drive.model_dump(mode="json", exclude_defaults=True)
        found[joint] = {key: (values[key], origins[key]) for key in SHOWN}
    refused = [f"{joint}: its calibration does not hold: {why}" for joint, why in layers.refused.items()]
    return found, [*refused, *layers.notes]


def _origin(key: str, config: Joint, own: Facts, raw: Facts) -> str:
    if key in own:
        return "head file"
    twin = config.mirror_of
    if config.mirror_sense == "opposite":
        key = IN_OPPOSITE.get(key, key)
    if twin is not None and (key in raw["joints"][twin] or key == "sign"):
        return f"mirror of {twin}"
    return "joint_defaults" if key in (raw.get("joint_defaults") or {}) else "built in"
