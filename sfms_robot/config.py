"""Frozen, validated models of every YAML file, and the loader that names file, key, value and valid choices.

Files speak the units people use (degrees, milliseconds where the key says so); properties give radians and
seconds. Nothing past `load` handles a plain dict.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from sfms_robot.data import data_dir, shipped_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class Model(BaseModel):
    """Base: immutable, and an unknown key is an error rather than a shrug."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: Any) -> Any:
        for key in value if isinstance(value, dict) else ():
            if key not in cls.model_fields:
                raise ValueError(f"{key!r} is not a known key ({', '.join(cls.model_fields)})")
        return value


# --- a head -----------------------------------------------------------------------------------------------------


class Bus(Model):
    """One named bus of a head."""

    family: Literal["dynamixel"]
    baud: Annotated[int, Field(gt=0)]
    rate_hz: Positive = 100.0


class LimitClass(Model):
    """How fast a class of joints may move, in degrees."""

    speed_deg_s: Positive
    acceleration_deg_s2: Positive
    jerk_deg_s3: Positive


class Expression(Model):
    """A node of a joint's drive: one channel, or a sum, maximum or mean of nodes; then x gain + offset, clamped.

    A bare channel name stands for `{channel: NAME}`.
    """

    channel: str | None = None
    sum: tuple[Expression, ...] | None = None
    max: tuple[Expression, ...] | None = None
    mean: tuple[Expression, ...] | None = None
    gain: Finite = 1.0
    offset: Finite = 0.0
    clamp: tuple[Finite, Finite] | None = None

    @model_validator(mode="before")
    @classmethod
    def _bare_name(cls, value: Any) -> Any:
        return {"channel": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _one_kind(self) -> Expression:
        kinds = [k for k in ("channel", "sum", "max", "mean") if getattr(self, k) is not None]
        if len(kinds) != 1:
            raise ValueError(f"needs exactly one of channel, sum, max, mean; has {', '.join(kinds) or 'none'}")
        if self.channel is not None and self.channel not in CHANNEL_INDEX:
            raise ValueError(f"{self.channel!r} is not a channel ({', '.join(CHANNEL_INDEX)})")
        for kind in ("sum", "max", "mean"):
            if getattr(self, kind) == ():
                raise ValueError(f"{kind} is empty")
        if self.clamp is not None and self.clamp[0] >= self.clamp[1]:
            raise ValueError(f"clamp {list(self.clamp)} is reversed or empty")
        return self

    def channels(self) -> set[str]:
        """Every channel below this node."""
        if self.channel is not None:
            return {self.channel}
        return set().union(*(node.channels() for node in self.sum or self.max or self.mean or ()))


class Joint(Model):
    """One joint: where it sits on a bus, how far and fast it may go, and what drives it.

    Ticks = zero_ticks + sign * ratio * angle / (angle per tick of the servo). `drive` is in units of the range
    (-1 = min, 0 = rest, +1 = max) when `unit` is "range", in radians when it is "rad".
    """

    bus: Name
    id: Annotated[int, Field(ge=0, le=252)]
    model: str
    zero_ticks: int
    sign: Literal[1, -1] = 1
    ratio: Positive = 1.0
    min_deg: Finite
    rest_deg: Finite = 0.0
    max_deg: Finite
    limits: Name
    lag_ms: NonNegative = 0.0
    unit: Literal["range", "rad"] = "range"
    drive: Expression | None = None
    note: str = ""

    @model_validator(mode="after")
    def _ordered(self) -> Joint:
        if self.min_deg >= self.max_deg:
            raise ValueError(f"min_deg {self.min_deg:g} is not below max_deg {self.max_deg:g}: limits reversed")
        if not self.min_deg <= self.rest_deg <= self.max_deg:
            raise ValueError(f"rest_deg {self.rest_deg:g} is outside {self.min_deg:g}..{self.max_deg:g}")
        return self

    @property
    def min_rad(self) -> float:
        return math.radians(self.min_deg)

    @property
    def max_rad(self) -> float:
        return math.radians(self.max_deg)

    @property
    def rest_rad(self) -> float:
        return math.radians(self.rest_deg)


class Head(Model):
    """A head: `configs/heads/NAME/head.yaml`."""

    name: Name
    description: str
    buses: Annotated[dict[Name, Bus], Field(min_length=1)]
    limits: dict[Name, LimitClass]
    joints: Annotated[dict[Name, Joint], Field(min_length=1)]

    @model_validator(mode="after")
    def _consistent(self) -> Head:
        seen: dict[tuple[str, int], str] = {}
        for name, joint in self.joints.items():
            if joint.bus not in self.buses:
                raise ValueError(
                    f"joints.{name}.bus = {joint.bus!r} is not a bus of this head ({', '.join(self.buses)})"
                )
            if joint.limits not in self.limits:
                raise ValueError(
                    f"joints.{name}.limits = {joint.limits!r} is not a limit class ({', '.join(self.limits)})"
                )
            other = seen.setdefault((joint.bus, joint.id), name)
            if other != name:
                raise ValueError(f"joints.{name}.id = {joint.id} is used twice on bus {joint.bus!r} (also by {other})")
        return self

    def limit(self, joint: str) -> LimitClass:
        return self.limits[self.joints[joint].limits]


# --- a firmware map ---------------------------------------------------------------------------------------------


class Register(Model):
    """One row of a control table. `scale` turns the raw value into `unit`."""

    address: Annotated[int, Field(ge=0, le=65535)]
    size: Literal[1, 2, 4]
    access: Literal["R", "RW"]
    area: Literal["EEPROM", "RAM"]
    unit: str = ""
    scale: Finite = 1.0
    min: int | None = None
    max: int | None = None
    signed: bool = False
    initial: int | None = None


class FirmwareMap(Model):
    """A servo model's control table: `firmware_maps/FAMILY/MODEL.yaml`."""

    model: str
    vendor: str
    model_number: int
    family: Literal["dynamixel"]
    protocol: Literal[2]
    source: str
    ticks_per_revolution: Positive
    center_ticks: int
    no_load_speed_deg_s: Positive
    baud_codes: dict[int, int]  # code in register baud_rate -> bits per second
    faults: dict[int, str] = Field(default_factory=dict)  # bit of hardware_error_status -> what it means
    registers: Annotated[dict[Name, Register], Field(min_length=1)]

    @model_validator(mode="after")
    def _no_overlap(self) -> FirmwareMap:
        end, last = -1, ""
        for name, register in sorted(self.registers.items(), key=lambda item: item[1].address):
            if register.address < end:
                raise ValueError(f"registers.{name}.address = {register.address} overlaps {last} (ends at {end})")
            end, last = register.address + register.size, name
        return self


# --- a listener and its training --------------------------------------------------------------------------------


Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]


class ChannelGroup(Model):
    """Channels that share one keyframe track: at most one code per frame, from `levels[0] * levels[1] * ...`."""

    channels: Annotated[tuple[str, ...], Field(min_length=1)]
    levels: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)]
    keyframes: Count
    transition_bias: Finite = 0.0

    @model_validator(mode="after")
    def _known(self) -> ChannelGroup:
        for name in self.channels:
            if name not in CHANNEL_INDEX:
                raise ValueError(f"channels: {name!r} is not a channel ({', '.join(CHANNEL_INDEX)})")
        return self

    @property
    def codes(self) -> int:
        return math.prod(self.levels)


class Sampling(Model):
    """How tokens are drawn. `frames_per_pass`: future frames decided by one pass of the decoder."""

    temperature: Positive = 1.0
    nucleus: Annotated[float, Field(gt=0, le=1)] = 1.0
    frames_per_pass: Count = 1
    seam_frames: Count = 4


class Listener(Model):
    """A listener: `configs/listeners/NAME/config.yaml`."""

    kind: Literal["sfms"]
    description: str = ""
    motion_space: Literal["arkit58"] = "arkit58"
    past_frames: Count = 40
    future_frames: Count = 8
    hop: Count = 4
    placement: Literal["exact", "static", "static_paper", "learned"] = "exact"
    max_gap_frames: Count = 24
    groups: Annotated[dict[Name, ChannelGroup], Field(min_length=1)]
    tokenizer_width: Count = 96
    predictor_width: Count = 96
    predictor_layers: Count = 2
    heads: Count = 4
    sampling: Sampling = Sampling()

    @model_validator(mode="after")
    def _consistent(self) -> Listener:
        owner: dict[str, str] = {}
        for name, group in self.groups.items():
            for channel in group.channels:
                if owner.setdefault(channel, name) != name:
                    raise ValueError(f"groups.{name}.channels: {channel!r} is already in group {owner[channel]}")
        missing = [channel for channel in CHANNEL_INDEX if channel not in owner]
        if missing:
            raise ValueError(f"groups: no group holds {', '.join(missing)}")
        if len({len(group.levels) for group in self.groups.values()}) != 1:
            raise ValueError("groups: every group needs the same number of levels")
        if self.hop > self.future_frames:
            raise ValueError(f"hop {self.hop} is above future_frames {self.future_frames}")
        for key, width in (("tokenizer_width", self.tokenizer_width), ("predictor_width", self.predictor_width)):
            if width % (2 * self.heads):
                raise ValueError(f"{key} {width} is not a multiple of twice heads ({self.heads})")
        return self

    @property
    def window_frames(self) -> int:
        return self.past_frames + self.future_frames


class TokenizerTraining(Model):
    """Phase 1: scores, quantizer, inpainter."""

    steps: Count
    batch: Count
    learning_rate: Positive
    score_learning_rate: Positive = 1e-3
    weight_decay: NonNegative = 0.01
    clip_norm: Positive = 1.0
    mask_loss: NonNegative = 0.1
    velocity_loss: NonNegative = 0.0
    temperature: tuple[Positive, Positive] = (2.0, 0.1)


class PredictorTraining(Model):
    """Phase 2: the next-token predictor."""

    steps: Count
    batch: Count
    learning_rate: Positive
    weight_decay: NonNegative = 0.01
    clip_norm: Positive = 1.0
    transition_weight: Positive = 0.5
    neutral_prefix: Share = 0.1
    drop_audio: Share = 0.1
    drop_face: Share = 0.3
    history_noise: Share = 0.05
    gain_db: NonNegative = 6.0


class Training(Model):
    """How a listener is trained: `configs/training/NAME.yaml`."""

    seed: int = 1
    listener: Listener
    tokenizer: TokenizerTraining
    predictor: PredictorTraining


# --- loading ----------------------------------------------------------------------------------------------------

M = TypeVar("M", bound=BaseModel)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # libyaml's is ten times faster
    """Safe YAML that refuses a key given twice instead of keeping the last."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node)
        if key in seen:
            raise yaml.constructor.ConstructorError(None, None, f"{key!r} is given twice", key_node.start_mark)
        seen.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def load(model: type[M], file: Path) -> M:
    """Read one YAML file into `model`, or raise a ConfigError of one line."""
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    try:
        raw = yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        raise ConfigError(f"{file}{where}: {problem}") from error
    return parse(model, raw, file)


def parse(model: type[M], raw: object, file: Path | str) -> M:
    """Validate plain data; `file` is only for the message."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(_first(error, file)) from error


def _first(error: ValidationError, file: Path | str) -> str:
    problems = error.errors()
    first = problems[0]
    key = ".".join(str(part) for part in first["loc"])
    text = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        text = "is not a known key"
    value = first["input"]
    shown = f" = {value!r}" if isinstance(value, (str, int, float, bool)) or value is None else ""
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{file}: {key}{shown}: {text}{more}" if key else f"{file}: {text}{more}"


def find(kind: Literal["heads", "listeners"], name: str, marker: str) -> Path:
    """Folder of a shipped head or listener by name, or of anybody's by path. Raises ConfigError with the choices."""
    root = data_dir("configs") / kind
    for folder in (root / name, Path(name)):
        if (folder / marker).is_file():
            return folder
    shipped = shipped_names(root, marker)
    flag, choices = "--" + kind.removesuffix("s"), ", ".join(shipped)
    raise ConfigError(f"{flag} {name!r} is neither a shipped name nor a folder with a {marker} ({choices})")


def load_head(name: str) -> Head:
    """A head by shipped name or folder."""
    return load(Head, find("heads", name, "head.yaml") / "head.yaml")


@lru_cache
def load_firmware_map(model: str) -> FirmwareMap:
    """A servo's control table by model name. Raises ConfigError listing the shipped models."""
    root = data_dir("firmware_maps")
    for file in sorted(root.glob(f"*/{model}.yaml")):
        return load(FirmwareMap, file)
    shipped = sorted(file.stem for file in root.glob("*/*.yaml"))
    raise ConfigError.at("firmware_maps", "model", model, "has no firmware map", shipped)
