"""A listener: what its folder's config.yaml holds."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name, Positive
from sfms_robot.config.hop import default_hop
from sfms_robot.frames import BLENDSHAPES, PITCH_CHANNEL, SMILE_CORNERS, SPACE_CHANNELS

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]
MotionSpace = Literal["arkit58", "faceverse58", "deca56"]
Placement = Literal["exact", "penalised", "static", "static_paper", "learned_paper", "learned"]
GAZE_CHANNELS = tuple(name for name in BLENDSHAPES if name.startswith("eyeLook"))


class ChannelGroup(Model):
    """Channels that share one keyframe track: at most one code per frame, from `levels[0] * levels[1] * ...`.

    Attributes:
        keyframes: of a window. keyframe_cost: in its place where placement is penalised, what a keyframe has to save in
            squared error, summed over the group's channels in deviations.
        transition_bias: on the logit of class 0, more for fewer keyframes.
    """

    channels: Annotated[tuple[str, ...], Field(min_length=1)]
    levels: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)]
    keyframes: Count | None = None
    keyframe_cost: Positive | None = None
    transition_bias: Finite = 0.0

    @property
    def codes(self) -> int:
        return math.prod(self.levels)


class SmileCourse(Model):
    """How a smile that is told goes (`listeners.sfms.courses`), in shares of its size; found in training dyads.

    Attributes:
        rise: at `RISE_S` after its beginning. fall: `FALL_S` before its end.
        spread: deviation of the corners of a mouth (0 to 1) from that which is left to what the predictor draws.
    """

    RISE_S: ClassVar[tuple[float, ...]] = (0.0, 0.12, 0.24, 0.36, 0.48, 0.6, 0.72, 0.96)
    FALL_S: ClassVar[tuple[float, ...]] = (0.0, 0.12, 0.24, 0.36, 0.48, 0.6, 0.96)

    spread: Positive
    rise: tuple[Share, ...] = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 1.0)
    fall: tuple[Share, ...] = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 1.0)

    @model_validator(mode="after")
    def _complete(self) -> SmileCourse:
        for key, shares, at in (("rise", self.rise, self.RISE_S), ("fall", self.fall, self.FALL_S)):
            if len(shares) != len(at):
                raise ValueError(f"{key}: {len(shares)} shares, {len(at)} are needed")
        return self


class NodCourse(Model):
    """How a nod that is told goes (`listeners.sfms.courses`), in shares of its size.

    Attributes:
        fall: how large each swing is beside the one before it; found in training dyads.
        spread: deviation, where swings turn, that is left to what the predictor draws.
    """

    spread: Positive
    fall: Share = 0.8


class Sampling(Model):
    """How tokens are drawn and shown.

    Attributes:
        seam_frames: over these a plan fades into the motion before it.
        smoothing: how far the head moves from each frame toward the mean of the two beside it, 0 to 1: motion between
            coarse codes has corners, which servos would make heard. 0 is the paper.
        reach: may a code follow another only as fast as faces moved in training (`listeners.sfms.reachable`)? The paper
            has no such rule.
        nod, smile: the course that they keep to, of a listener with `events`; None: the predictor's own.
    """

    temperature: Positive = 1.0
    nucleus: Annotated[float, Field(gt=0, le=1)] = 1.0
    seam_frames: Count = 4
    smoothing: Share = 0.0
    reach: bool = True
    nod: NodCourse | None = None
    smile: SmileCourse | None = None


def check_heads(heads: int, **widths: int) -> None:
    """Raises ValueError for a width, by its key, that cannot be cut into `heads` heads of even width."""
    for key, width in widths.items():
        if width % (2 * heads):
            raise ValueError(f"{key} {width} is not a multiple of twice heads ({heads})")


class Scores(Model):
    """The network that ranks keyframes, of the learned placements. `sweeps`: rounds of second thoughts of `learned`."""

    width: Count = 32
    layers: Count = 2
    heads: Count = 4
    sweeps: Annotated[int, Field(ge=0)] = 2

    @model_validator(mode="after")
    def _heads_fit(self) -> Scores:
        check_heads(self.heads, width=self.width)
        return self


class Listener(Model):
    """What every family of listeners says of itself: `configs/listeners/NAME/config.yaml`.

    Attributes:
        motion_space: what the model works in (`frames.SPACE_CHANNELS`); plans are `FaceFrame`s whatever it is.
        neutral: face at rest in that space, one number per channel; None: the space's own.
        metres_per_unit: scale of the space's translation; None: it has none and is left out.
        flame_matrix: file with FLAME -> ARKit, beside config.yaml or absolute; deca56 moves pose and jaw only without.
        events: is it told of nods, smiles and blinks that were decided elsewhere (`signals.control`)? Then it draws
            everything but gaze: not the eyes' direction, nor the head's part of it, which follow it by kinematics.
        sway: is slow motion of the head a process of its own (`listeners.idle`), not drawn by the model? Needs events.
    """

    kind: str
    description: str = ""
    motion_space: MotionSpace = "arkit58"
    neutral: tuple[Finite, ...] | None = None
    metres_per_unit: Positive | None = None
    flame_matrix: str | None = None
    events: bool = False
    sway: bool = False

    @property
    def channels(self) -> tuple[str, ...]:
        return SPACE_CHANNELS[self.motion_space]

    @property
    def drawn_channels(self) -> tuple[str, ...]:
        """Those that the model draws; the others stay 0."""
        return tuple(name for name in self.channels if not (self.events and name in GAZE_CHANNELS))

    @model_validator(mode="after")
    def _fits_space(self) -> Listener:
        if self.neutral is not None and len(self.neutral) != len(self.channels):
            raise ValueError(f"neutral: {len(self.neutral)} numbers, {self.motion_space} has {len(self.channels)}")
        if self.flame_matrix is not None and self.motion_space != "deca56":
            raise ValueError(f"flame_matrix: {self.motion_space} already is ARKit's expression (deca56 takes one)")
        if self.sway and not self.events:
            raise ValueError("sway: without events a nod cannot be told from it")
        return self


class Sfms(Listener):
    """Sparse keyframe tokens and their predictor.

    `groups` are written out, or named as a whole: `{preset: one|four|all, levels: [...], keyframes: k}`.

    Attributes:
        hop: frames between plans; auto: chosen at the start of a run by what is measured (`hop.choose_hop`), and
            `default_hop` where nothing is.
        audio: features of the voice: mel (4 rows of 128 per frame, aligned by convolution and max-pool), mfcc78 or
            wav2vec2 (768), one row per frame.
        wav2vec2: folder of a model in the layout of transformers, beside config.yaml or absolute; only streams need it.
        phase: is the speaker's place in a phrase an input? Beyond the paper; it reaches back further than 40 frames.
        sequential: does each frame know the keyframes drawn before it? Beyond the paper, which draws 8 in parallel.
        placement: where keyframes go (`listeners.sfms.placement`); max_gap_frames bounds `exact` and `penalised`.
        ramp_frames: motion toward a keyframe begins so many frames before it at most; the one before is held till then;
            None: a straight line all the way, the paper's, which a stream cannot know beyond its plan.
        quantizer: a fixed grid (fsq) or learned vectors of `code_dims` dimensions (vq); either has a group's number of
            codes, the product of its levels.
        inpainter: added to straight lines (residual), or all by itself (paper).
        tokenizer_layers: transformer blocks in each of the inpainter's three parts.
    """

    kind: Literal["sfms"]
    past_frames: Count = 40
    future_frames: Count = 8
    hop: Literal["auto"] | Count = "auto"
    audio: Literal["mel", "mfcc78", "wav2vec2"] = "mel"
    wav2vec2: str | None = None
    phase: bool = True
    sequential: bool = True
    placement: Placement = "exact"
    max_gap_frames: Count = 24
    ramp_frames: Count | None = None
    groups: Annotated[dict[Name, ChannelGroup], Field(min_length=1)]
    scores: Scores = Scores()
    quantizer: Literal["fsq", "vq"] = "fsq"
    code_dims: Count = 4
    inpainter: Literal["residual", "paper"] = "residual"
    tokenizer_width: Count = 96
    tokenizer_layers: Count = 1
    predictor_width: Count = 96
    predictor_layers: Count = 2
    speaker_layers: Count = 1
    heads: Count = 4
    sampling: Sampling = Sampling()

    @model_validator(mode="before")
    @classmethod
    def _presets(cls, raw: Any) -> Any:
        if isinstance(raw, dict) and isinstance(raw.get("groups"), dict) and "preset" in raw["groups"]:
            return raw | {"groups": preset_groups(raw.get("motion_space", "arkit58"), raw["groups"])}
        return raw

    @model_validator(mode="after")
    def _consistent(self) -> Sfms:
        owner: dict[str, str] = {}
        for name, group in self.groups.items():
            for channel in group.channels:
                if channel not in self.drawn_channels:
                    choices = ", ".join(self.drawn_channels)
                    raise ValueError(f"groups.{name}.channels: {channel!r} is not a channel ({choices})")
                if owner.setdefault(channel, name) != name:
                    raise ValueError(f"groups.{name}.channels: {channel!r} is already in group {owner[channel]}")
        missing = [channel for channel in self.drawn_channels if channel not in owner]
        if missing:
            raise ValueError(f"groups: no group holds {', '.join(missing)}")
        if len({len(group.levels) for group in self.groups.values()}) != 1:
            raise ValueError("groups: every group needs the same number of levels")
        for name, group in self.groups.items():
            if self.placement == "penalised" and (group.keyframe_cost is None or group.keyframes is not None):
                raise ValueError(f"groups.{name}: placement penalised takes keyframe_cost, not keyframes")
            if self.placement != "penalised" and (group.keyframes is None or group.keyframe_cost is not None):
                raise ValueError(f"groups.{name}: placement {self.placement} takes keyframes, not keyframe_cost")
        for kind in ("nod", "smile"):
            if getattr(self.sampling, kind) is not None and not self.events:
                raise ValueError(f"sampling.{kind}: without events no {kind} is told")
        if self.sampling.smile is not None and self.smiling_group is None:
            raise ValueError(f"sampling.smile: no group holds both of {', '.join(SMILE_CORNERS)}")
        if self.wav2vec2 is not None and self.audio != "wav2vec2":
            raise ValueError(f"wav2vec2: audio is {self.audio}, which needs no model")
        if self.hop_frames > self.future_frames:
            raise ValueError(f"hop {self.hop} is above future_frames {self.future_frames}")
        check_heads(self.heads, tokenizer_width=self.tokenizer_width, predictor_width=self.predictor_width)
        return self

    @property
    def smiling_group(self) -> str | None:
        """The group that holds both corners of the mouth; None: there is none."""
        return next((name for name, group in self.groups.items() if {*SMILE_CORNERS} <= {*group.channels}), None)

    @property
    def nodding_group(self) -> str:
        """The group that turns the head up and down."""
        pitch = PITCH_CHANNEL[self.motion_space]
        return next(name for name, group in self.groups.items() if pitch in group.channels)

    @property
    def hop_frames(self) -> int:
        return default_hop(self.future_frames) if self.hop == "auto" else self.hop

    @property
    def window_frames(self) -> int:
        return self.past_frames + self.future_frames


def preset_groups(space: str, wanted: dict[str, Any]) -> dict[str, Any]:
    """Groups of channels by the number of keyframe sets: one, four (neck, brows, eyes, mouth and jaw), or all.

    Raises ValueError for an unknown preset, key or space.
    """
    if set(wanted) != {"preset", "levels", "keyframes"}:
        raise ValueError(f"groups: a preset takes the keys preset, levels, keyframes, not {', '.join(wanted)}")
    if space not in SPACE_CHANNELS:
        raise ValueError(f"motion_space: {space!r} is not known ({', '.join(SPACE_CHANNELS)})")
    channels = SPACE_CHANNELS[space]
    if wanted["preset"] == "one":
        sets = {"face": channels}
    elif wanted["preset"] == "all":
        sets = {channel: (channel,) for channel in channels}
    elif wanted["preset"] == "four" and space != "deca56":  # FLAME's components are not parts of a face
        sets = {"neck": (), "brows": (), "eyes": (), "mouth": ()}
        for channel in channels:
            sets[_part(channel)] += (channel,)
    else:
        raise ValueError(f"groups.preset: {wanted['preset']!r} is none of one, four (not for deca56), all")
    return {
        name: {"channels": c, "levels": wanted["levels"], "keyframes": wanted["keyframes"]} for name, c in sets.items()
    }


def _part(channel: str) -> str:
    if channel not in BLENDSHAPES:
        return "neck"
    return "brows" if channel.startswith("brow") else "eyes" if channel.startswith("eye") else "mouth"
