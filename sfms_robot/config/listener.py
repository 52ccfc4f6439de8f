"""Settings of a listener, from the config.yaml in its folder, and its rate of each kind of event."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field, NonNegativeInt, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive, Problems, Share, parse, read
from sfms_robot.config.hop import default_hop
from sfms_robot.data import Names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, PITCH_CHANNEL, SMILE_CORNERS, SPACE_CHANNELS

Count = Annotated[int, Field(ge=1)]
PerMinute = Annotated[float, Field(ge=0, le=60)]
Levels = Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)]
MotionSpace = Literal["arkit58", "faceverse58", "deca56"]
Placement = Literal["exact", "penalised", "static", "static_paper", "learned_paper", "adaptive", "learned"]
GAZE_CHANNELS: Final = tuple(name for name in BLENDSHAPES if name.startswith("eyeLook"))
# Conversational states of ARIG (3.3), in the order of the model's classes.
STATES: Final = ("speaking", "listening", "receiving_feedback", "thinking", "interrupted", "waiting", "giving_feedback")
# States of a listener with events: kinds of visible feedback are separate from audible feedback.
EVENT_STATES: Final = (*STATES, "giving_feedback_nod", "giving_feedback_smile")


class Calmness(Model):
    """Events per minute by kind: more is livelier, 0 is never, None is the rate of people.

    A rate is the mean over a meeting in which people look at the head some of the time. A head that is addressed and
    looked at nods more often, a head that is not nods less often. Without listening only blinks, gaze shifts and
    answers to a smile begin.

    Attributes:
        nod, shake, tilt: movements of the head. A head in a meeting nods at this rate, within a tenth, also when the
            effect of earlier nods is included.
        gaze_shift: looks away from the person; each is followed by a look back.
        addressed: sense: the person's attention decides whether the head is addressed, and without any face it is;
            assume: it always is; never: it never is.
    """

    nod: PerMinute | None = 2.0
    shake: PerMinute | None = None
    tilt: PerMinute | None = None
    laugh: PerMinute | None = None
    smile: PerMinute | None = None
    mm_hm: PerMinute | None = None
    brow_raise: PerMinute | None = None
    blink: PerMinute | None = None
    gaze_shift: PerMinute | None = None
    addressed: Literal["sense", "assume", "never"] = "sense"

    def per_minute(self, kind: str) -> float | None:
        """Return the rate of one of `frames.EVENT_KINDS`; None: the rate of people."""
        rate: float | None = getattr(self, kind)
        return rate


class ChannelGroup(Model):
    """Channels that share one keyframe track: at most one code per frame, out of `levels[0] * levels[1] * ...` codes.

    Attributes:
        keyframes: number per window. keyframe_cost: replaces `keyframes` for placement `penalised`: squared error that
            a keyframe has to save, summed over the group's channels, in standard deviations.
        transition_bias: added to the logit of class 0 (no keyframe); a larger value leads to fewer keyframes.
    """

    channels: Names = Field(min_length=1)
    levels: Levels
    keyframes: Count | None = None
    keyframe_cost: Positive | None = None
    transition_bias: Finite = 0.0

    @property
    def codes(self) -> int:
        return math.prod(self.levels)


class SmileCourse(Model):
    """Course of a smile that has been decided (`listeners.sfms.draw`), in shares of its size, from training dyads.

    Attributes:
        rise: at 0, 0.12, 0.24, 0.36, 0.48, 0.6, 0.72 and 0.96 s after the beginning (`RISE_S`). fall: at 0, 0.12, 0.24,
            0.36, 0.48, 0.6 and 0.96 s before the end (`FALL_S`).
        spread: deviation from the course that is left to the predictor, for corners of the mouth from 0 to 1.
    """

    RISE_S: ClassVar[tuple[float, ...]] = (0.0, 0.12, 0.24, 0.36, 0.48, 0.6, 0.72, 0.96)
    FALL_S: ClassVar[tuple[float, ...]] = (0.0, 0.12, 0.24, 0.36, 0.48, 0.6, 0.96)

    spread: Positive
    rise: tuple[Share, ...] = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 1.0)
    fall: tuple[Share, ...] = (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 1.0)

    def contradictions(self) -> Problems:
        for key, shares, at in (("rise", self.rise, self.RISE_S), ("fall", self.fall, self.FALL_S)):
            if len(shares) != len(at):
                yield f"{key}: {len(shares)} shares, {len(at)} are needed"


class NodCourse(Model):
    """Course of a nod that has been decided (`listeners.sfms.draw`), in shares of its size.

    Attributes:
        fall: size of each swing relative to the swing before it, from training dyads.
        spread: deviation from the course that is left to the predictor where swings turn.
    """

    spread: Positive
    fall: Share = 0.8


class Sampling(Model):
    """Settings for drawing tokens and showing them as motion.

    Attributes:
        seam_frames: number of frames over which a new plan blends in with the motion before it.
        smoothing: share, 0 to 1, by which each frame of the head moves toward the mean of its two neighbours: motion
            between coarse codes has corners, which make servos audible. 0, no smoothing, is the paper's.
        reach: a code may follow another only as fast as faces moved in training (`listeners.sfms.draw.CodeReach`). Not
            in the paper.
        nod, smile: courses of nods and smiles of a listener with `events`; None: the predictor's own.
    """

    temperature: Positive = 1.0
    nucleus: float = Field(default=1.0, gt=0, le=1)
    seam_frames: Count = 4
    smoothing: Share = 0.0
    reach: bool = True
    nod: NodCourse | None = None
    smile: SmileCourse | None = None


def uneven_heads(heads: int, **widths: int) -> Problems:
    """Yield the problem of each width, by its key, that cannot be divided into `heads` heads of even width."""
    for key, width in widths.items():
        if width % (2 * heads):
            yield f"{key} {width} is not a multiple of twice heads ({heads})"


class Scores(Model):
    """The network that scores keyframes for learned placements. `sweeps`: rounds of corrections for `learned`."""

    width: Count = 32
    layers: Count = 2
    heads: Count = 4
    sweeps: NonNegativeInt = 2

    def contradictions(self) -> Problems:
        yield from uneven_heads(self.heads, width=self.width)


class ListenerSettings(Model):
    """Settings of every kind of listener: `configs/listeners/NAME/config.yaml`.

    Attributes:
        motion_space: channels of the model (`frames.SPACE_CHANNELS`); plans are `FaceFrame`s for every space.
        neutral: face at rest in that space, one number per channel; None: that of the space.
        metres_per_unit: scale of the space's translation; None: it has no scale and is left out.
        flame_matrix: file with a matrix FLAME -> ARKit, relative to config.yaml or absolute; without it `deca56` moves
            only pose and jaw.
        events: nods, smiles and blinks are inputs of the model, decided elsewhere (`signals.control`). The model draws
            everything except gaze: the direction of the eyes and the head's part of it come from kinematics.
        sway: slow motion of the head is a separate process (`listeners.idle`), not drawn by the model. Needs `events`.
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
    def channels(self) -> Names:
        return SPACE_CHANNELS[self.motion_space]

    @property
    def drawn_channels(self) -> Names:
        """Channels that the model draws; the others stay 0."""
        return tuple(name for name in self.channels if not (self.events and name in GAZE_CHANNELS))

    def contradictions(self) -> Problems:
        if self.neutral is not None and len(self.neutral) != len(self.channels):
            yield f"neutral: {len(self.neutral)} numbers, {self.motion_space} has {len(self.channels)}"
        if self.flame_matrix is not None and self.motion_space != "deca56":
            yield f"flame_matrix: {self.motion_space} already is ARKit's expression (deca56 takes one)"
        if self.sway and not self.events:
            yield "sway: expected events: true, without which a nod counts as sway"


class Sfms(ListenerSettings):
    """Settings of an SFMS listener: sparse keyframe tokens and their predictor.

    `groups` lists every group by name, or names a preset: `{preset: one|four|all, levels: [...], keyframes: k}`.

    Attributes:
        hop: frames between plans; auto: chosen at the start of a run from measurements (`hop.choose_hop`), or
            `hop.default_hop` without measurements.
        audio: features of the voice: mel (4 rows of 128 per frame, aligned by convolution and max-pool), mfcc78 or
            wav2vec2 (768), one row per frame.
        wav2vec2: folder of a model in the layout of transformers, relative to config.yaml or absolute; only streams
            need it.
        phase: the speaker's place in a phrase is an input. Not in the paper; it reaches back further than 40 frames.
        sequential: each frame depends on the keyframes drawn before it. Not in the paper, which draws 8 in parallel.
        placement: method that places keyframes (`listeners.sfms.placement`); max_gap_frames: largest gap between them,
            for `exact` and `penalised`.
        ramp_frames: motion toward a keyframe begins at most this many frames before it; until then the previous one is
            held. None: a straight line all the way, as in the paper, which a stream cannot know beyond its plan.
        quantizer: a fixed grid (fsq) or learned vectors of `code_dims` dimensions (vq). Both have the product of a
            group's levels as its number of codes. squashed: learned vectors are in -1..1, like the grid's codes.
        inpainter: its output is added to straight lines (residual) or replaces them (paper).
        tokenizer_layers: number of transformer blocks in each of the inpainter's three parts.
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
    groups: dict[Name, ChannelGroup] = Field(min_length=1)
    scores: Scores = Scores()
    quantizer: Literal["fsq", "vq"] = "fsq"
    code_dims: Count = 4
    squashed: bool = False
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
        """Replace a preset by its groups: one, four (neck, brows, eyes, mouth and jaw), or a group for each channel."""
        if not (isinstance(raw, dict) and isinstance(raw.get("groups"), dict) and "preset" in raw["groups"]):
            return raw
        wanted, space = raw["groups"], raw.get("motion_space", "arkit58")
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
            parts = ("neck", "brows", "eyes", "mouth")
            sets = {part: tuple(each for each in channels if _part(each) == part) for part in parts}
        else:
            raise ValueError(f"groups.preset: {wanted['preset']!r} is none of one, four (not for deca56), all")
        rest = {key: wanted[key] for key in ("levels", "keyframes")}
        return raw | {"groups": {name: {"channels": members, **rest} for name, members in sets.items()}}

    def contradictions(self) -> Problems:
        yield from super().contradictions()
        owner: dict[str, str] = {}
        for name, group in self.groups.items():
            for channel in group.channels:
                if channel not in self.drawn_channels:
                    yield f"groups.{name}.channels: {channel!r} is not a channel ({', '.join(self.drawn_channels)})"
                if owner.setdefault(channel, name) != name:
                    yield f"groups.{name}.channels: {channel!r} is already in group {owner[channel]}"
        missing = [channel for channel in self.drawn_channels if channel not in owner]
        if missing:
            yield f"groups: no group holds {', '.join(missing)}"
        if len({len(group.levels) for group in self.groups.values()}) != 1:
            yield "groups: every group needs the same number of levels"
        penalised = self.placement == "penalised"
        key, other = ("keyframe_cost", "keyframes") if penalised else ("keyframes", "keyframe_cost")
        for name, group in self.groups.items():
            if getattr(group, key) is None or getattr(group, other) is not None:
                yield f"groups.{name}: placement {self.placement} takes {key}, not {other}"
        for kind in ("nod", "smile"):
            if getattr(self.sampling, kind) is not None and not self.events:
                yield f"sampling.{kind}: expected events: true, without which there is no {kind}"
        if self.sampling.smile is not None and self.smiling_group is None:
            yield f"sampling.smile: no group holds both of {', '.join(SMILE_CORNERS)}"
        if self.wav2vec2 is not None and self.audio != "wav2vec2":
            yield f"wav2vec2: audio is {self.audio}, which needs no model"
        if self.hop_frames > self.future_frames:
            yield f"hop {self.hop} is above future_frames {self.future_frames}"
        yield from uneven_heads(self.heads, tokenizer_width=self.tokenizer_width, predictor_width=self.predictor_width)

    @property
    def smiling_group(self) -> str | None:
        """Name of the group that holds both corners of the mouth, or None."""
        return next((name for name, group in self.groups.items() if {*SMILE_CORNERS} <= {*group.channels}), None)

    @property
    def nodding_group(self) -> str:
        """Name of the group that turns the head up and down."""
        pitch = PITCH_CHANNEL[self.motion_space]
        return next(name for name, group in self.groups.items() if pitch in group.channels)

    @property
    def hop_frames(self) -> int:
        return default_hop(self.future_frames) if self.hop == "auto" else self.hop

    @property
    def window_frames(self) -> int:
        return self.past_frames + self.future_frames


def _part(channel: str) -> str:
    if channel not in BLENDSHAPES:
        return "neck"
    return "brows" if channel.startswith("brow") else "eyes" if channel.startswith("eye") else "mouth"


def paper_state(state: int) -> int:
    """Return a state of `EVENT_STATES` as one of the paper's seven."""
    return min(state, len(STATES) - 1)


def _both(value: Any) -> Any:
    return (value, value) if isinstance(value, int | float) else value


Temperature = Annotated[tuple[NonNegative, NonNegative], BeforeValidator(_both)]  # first and last; one number is both


class Diffusion(Model):
    """Settings of the DiffusionMLP and of its sampling.

    Attributes:
        width: width of its condition and blocks; the paper uses the width of its motion, 262.
        train_steps: number of noise levels in training. schedule: `cosine`, or `logarithmic`, with equally many levels
            for each factor of noise over motion, so that small motion is learned too.
        steps: number of these levels that are used to sample one frame, spread evenly.
        sampler: `ddpm` is equation (4) of the paper; `ddim` adds no noise between steps, which suits few steps.
        temperature: factor on the noise that is added between steps. Two numbers: after the first step and before the
            last, changing evenly in between. Early noise decides what happens, late noise is jitter.
        temperatures: replaces `temperature` for channels whose names begin with a key: `{eye: 1.1}`; the first match
            counts.
        clamp: every estimate of the clean motion is kept within the range of the data; equation (4) does not do this.
    """

    width: int = Field(default=262, ge=2, multiple_of=2)
    blocks: Count = 3
    train_steps: int = Field(default=1000, ge=2)
    schedule: Literal["cosine", "logarithmic"] = "cosine"
    steps: Count = 15
    sampler: Literal["ddpm", "ddim"] = "ddpm"
    temperature: Temperature = (1.0, 1.0)
    temperatures: dict[str, Temperature] = {}
    clamp: bool = True

    def temperature_of(self, channel: str) -> tuple[float, float]:
        fits = (value for prefix, value in self.temperatures.items() if channel.startswith(prefix))
        return next(fits, self.temperature)

    def contradictions(self) -> Problems:
        if self.steps > self.train_steps:
            yield f"steps {self.steps} is above train_steps {self.train_steps}"


class Arig(ListenerSettings):
    """Settings of an ARIG listener: frame-wise autoregression with a diffusion head.

    Attributes:
        sound: `mel` (4 rows of 128 per frame) or `wav2vec2` (768 per frame, from the data: for training, not for runs).
        phase: each track's place in a phrase (`signals.phase`) is an input in addition to its sound. Not in the paper;
            it reaches back further than a short context.
        width, feedforward: width and hidden width of every block; heads: number of heads of every attention.
        chunk_frames: c in the paper; context_chunks: w in the paper (4: ablation "w/o long-range context").
        bidirectional_layers: 2 in the paper; integrated_layers, context_layers: the paper leaves them open.
        sound_frames: number of the agent's last sound frames that the coarse motion attends to; motion_frames: number
            of its last motion frames that the temporal layer attends to.
        state_guidance: false leaves the conversational states out; visual: false leaves motion out of the behaviours;
            interaction: `linear` puts plain layers in place of bidirectional-integrated learning;
            discrete: codes of `code_levels` and a softmax in place of diffusion (tables 1 and 4). The codes are of
            `motion` itself, because errors of codes of steps would add up.
        draws: target of the sampler: the `motion` of a frame, as in the paper; the `step` from the frame before, whose
            errors are small where a face is still, but add up; or the `innovation` of a first-order autoregression
            fitted on the data, a step that decays as fast as people's motion returns to its mean.
        precision: of large layers on onnxruntime; auto: int8 if the folder has such graphs. torch computes in fp32.
    """

    kind: Literal["arig"]
    sound: Literal["mel", "wav2vec2"] = "mel"
    phase: bool = True
    width: Count = 512
    feedforward: Count = 2048
    heads: Count = 8
    chunk_frames: Count = 6
    context_chunks: int = Field(default=512, ge=2)
    bidirectional_layers: Count = 2
    integrated_layers: Count = 1
    context_layers: Count = 4
    sound_frames: Count = 3
    motion_frames: Count = 5
    state_guidance: bool = True
    visual: bool = True
    interaction: Literal["bidirectional", "linear"] = "bidirectional"
    discrete: bool = False
    code_levels: Levels = (8, 5, 5, 5)
    draws: Literal["motion", "step", "innovation"] = "motion"
    diffusion: Diffusion = Diffusion()
    precision: Literal["auto", "fp32", "int8"] = "auto"

    def contradictions(self) -> Problems:
        yield from super().contradictions()
        yield from uneven_heads(self.heads, width=self.width)
        if self.discrete and self.draws != "motion":
            yield f"discrete: true is of draws: motion, not {self.draws}"
        if self.events and self.motion_space != "arkit58":
            yield f"events: true needs motion_space arkit58, not {self.motion_space}"
        for prefix in self.diffusion.temperatures:
            if not any(channel.startswith(prefix) for channel in self.channels):
                yield f"diffusion.temperatures.{prefix}: no channel of {self.motion_space} begins so"

    @property
    def states(self) -> Names:
        """Conversational states that the model distinguishes."""
        return EVENT_STATES if self.events else STATES


# The model of config.yaml for each kind of listener in a folder; for listeners of other packages see `plugins`.
LISTENER_KINDS: Final[Mapping[str, type[ListenerSettings]]] = {"sfms": Sfms, "arig": Arig}


def load_listener(file: Path) -> ListenerSettings:
    """Read one listener's YAML file, of any kind. Raises ConfigError."""
    return parse_listener(read(file), file)


def parse_listener(raw: Any, file: Path | str) -> ListenerSettings:
    """Validate plain data of a listener. Raises ConfigError."""
    name = str(raw.get("kind")) if isinstance(raw, dict) else ""
    if name not in LISTENER_KINDS:
        raise ConfigError.at(file, "kind", name, "is not a kind of listener", LISTENER_KINDS)
    return parse(LISTENER_KINDS[name], raw, file)
