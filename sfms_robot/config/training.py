"""Settings of training: of every phase, of both phases of SFMS, of ARIG, and of the tokenizers in tables."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeInt

from sfms_robot.config.base import Model, Name, NonNegative, Positive, Problems, Share, parse, read
from sfms_robot.config.listener import Arig, Count, Levels, Sfms, uneven_heads
from sfms_robot.errors import ConfigError

Seed = Annotated[int, Field(ge=0, lt=2**63)]
HALVINGS = 3  # halvings of time in a grouped tokenizer: 8 frames per code
_RESUMABLE = frozenset({"checkpoint_every", "checkpoint_minutes", "patience"})


class Phase(Model):
    """Settings of one run of the training loop, for any model.

    Attributes:
        steps, batch: number of steps of the run, and number of samples per step.
        learning_rate: highest learning rate, reached at the end of the warm-up, where the cosine begins.
        warm_up_steps: steps of warm-up, limited to a tenth of `steps`.
        clip_norm: limit of the gradient norm, for the parameters of each optimizer.
        precision: bf16 uses autocast; a CPU without instructions for it always computes in fp32.
        evaluate_every: steps between evaluations of the held-out loss; 0: never, and the last weights are kept.
        patience: evaluations without a better held-out loss before training stops; None: train to the last step.
        checkpoint_every, checkpoint_minutes: steps and minutes between checkpoints, whichever comes first.
    """

    steps: Count
    batch: Count
    learning_rate: Positive
    weight_decay: NonNegative = 0.01
    warm_up_steps: NonNegativeInt = 100
    clip_norm: Positive = 1.0
    precision: Literal["fp32", "bf16"] = "fp32"
    evaluate_every: NonNegativeInt = 200
    patience: Count | None = None
    checkpoint_every: Count = 500
    checkpoint_minutes: Positive = 5.0

    def contradictions(self) -> Problems:
        if self.patience is not None and self.evaluate_every == 0:
            yield f"patience {self.patience} needs evaluate_every above 0"

    def identity(self) -> dict[str, Any]:
        """Return the settings that must not change between a checkpoint and its resumption."""
        return self.model_dump(mode="json", exclude=set(_RESUMABLE))


class TokenizerTraining(Phase):
    """Settings of phase 1, which trains keyframe scores, quantizer and inpainter.

    Attributes:
        score_tracks: tracks (one window of one group each) per step that the scores of placement `learned` learn from.
        mask_loss: alpha of equation (13); temperature: first and last temperature of Algorithm 1. Both are for the
            placements `learned_paper` and `adaptive`.
        tempered_draws: true: the temperature also acts on which frames are drawn, as equation (6) reads; in Algorithm 1
            it does not.
        sparsity: weight of equation (8), for placement `adaptive`.
        commitment: weight of ||sg[z_q] - E(z)||^2 in equation (13), for quantizer `vq`.
        velocity_loss: weight of the error of the change from one frame to the next.
    """

    score_learning_rate: Positive = 3e-3
    score_tracks: Count = 32
    mask_loss: NonNegative = 0.1
    temperature: tuple[Positive, Positive] = (2.0, 0.1)
    tempered_draws: bool = False
    sparsity: NonNegative = 0.1
    commitment: NonNegative = 1.0
    velocity_loss: NonNegative = 0.0


class PredictorTraining(Phase):
    """Settings of phase 2, which trains the next-token predictor.

    Attributes:
        tokens: dyads: keyframes are placed once per dyad, in the whole dyad, long stretches or consecutive windows;
            windows: in each training window separately, as in the paper, whose tokenizer has the predictor's window.
        transition_weight: weight of class 0 in equation (14); a keyframe has weight 1. undo_weight: remove this weight
            from the probabilities after training; the paper leaves this open.
        dtw_weight, dtw_gamma: weight of the soft-DTW on the keyframe indicator (IV-D3), and softness of its minima.
        neutral_prefix: share of windows that begin like a stream; drop_audio, drop_face: share of windows without the
            speaker's sound, without the speaker's face.
        history_noise: share of past keyframes that are one level off (for quantizer `vq`: left out).
        missed_keyframes: share of windows and groups whose last keyframes are left out, as in a roll-out. If the face
            is then wrong by more than `keyframe_cost`, the target is a keyframe at once
            (`learning.sfms.features.without_last_keyframes`). For placement `penalised`.
        group_weights: weight of each group's loss, by name; 1 for a group that is not named.
        event_windows: share of windows drawn from those in whose future an event other than a blink is in progress, for
            listeners with events. The events are inputs, so this does not change their probabilities.
        calibration_rounds: roll-outs that adjust the keyframe rates to those of the data. With any, `sampling.nod` and
            `sampling.smile` of a listener with events also get the median courses of the training dyads.
    """

    tokens: Literal["dyads", "windows"] = "dyads"
    transition_weight: Positive = 0.5
    undo_weight: bool = True
    dtw_weight: NonNegative = 0.1
    dtw_gamma: Positive = 0.1
    neutral_prefix: Share = 0.1
    drop_audio: Share = 0.1
    drop_face: Share = 0.3
    history_noise: Share = 0.05
    missed_keyframes: Share = 0.0
    gain_db: NonNegative = 6.0
    group_weights: dict[Name, Positive] = {}
    event_windows: Share = 0.0
    calibration_rounds: NonNegativeInt = 2


class Training(Model):
    """Training of an SFMS listener: `configs/training/NAME.yaml`."""

    seed: Seed = 1
    listener: Sfms
    tokenizer: TokenizerTraining
    predictor: PredictorTraining

    def contradictions(self) -> Problems:
        for name in self.predictor.group_weights:
            if name not in self.listener.groups:
                groups = ", ".join(self.listener.groups)
                yield f"predictor.group_weights: {name!r} is not a group of the listener ({groups})"


class Stage(Model):
    """A part of the curriculum of an ARIG training.

    Attributes:
        share: share of all steps that this part takes.
        speaking, listening, interaction: weights of the sets of these names when windows are drawn. A set that is
            missing in the data is left out.
    """

    share: float = Field(gt=0, le=1)
    speaking: NonNegative = 0.0
    listening: NonNegative = 0.0
    interaction: NonNegative = 0.0

    def contradictions(self) -> Problems:
        if not self.speaking + self.listening + self.interaction:
            yield "a stage needs a weight above 0 (speaking, listening, interaction)"


class GroupWeights(Model):
    """Weight of each group of channels in the loss, regardless of its size (`learning.arig.trainer.GROUPS`)."""

    head: NonNegative = 1.0
    lids: NonNegative = 1.0
    brows: NonNegative = 1.0
    mouth: NonNegative = 1.0

    def contradictions(self) -> Problems:
        if not self.head + self.lids + self.brows + self.mouth:
            yield "a group needs a weight above 0 (head, lids, brows, mouth)"


class ArigPhase(Phase):
    """Settings for the training of an ARIG listener.

    Attributes:
        window_frames: frames of one sample. The first frame begins a stream, so context reaches no further back.
        draws: number of noise levels per frame in equation (3); the sampler costs little compared to its condition.
        state_weight: weight of the cross-entropy of the states (3.3); coarse_weight: weight of the squared error of the
            coarse motion (3.4). Equation (3) has weight 1. The paper states no weights.
        history_noise: largest noise on the past motion, in standard deviations, as a stream's past is the model's own.
        speaking_noise: the same for jaw, mouth and tongue while the agent speaks: words decide them, not their past.
        own_states: true: previous states are the model's own answers, as in a stream; false: the true states.
        state_noise: share of previous states that are drawn at random. A stream that continues from its most probable
            state needs this, because it would copy true states. A stream that draws its states (`events`) is trained
            with true states.
        group_weights: weights of groups of channels in the losses of the motion; None: every channel counts the same,
            as in the paper.
        event_windows: share of windows drawn from those with an event other than a blink, every kind equally often, for
            listeners with events, because smiles are rare.
        drop_audio, drop_face: share of windows without the user's sound, without the user's face; drop_agent: share of
            the windows with a silent agent in which the agent's track is missing.
        quiet_room: share of windows in which the noise of the user's microphone is weaker, down to that of a closed
            noise gate; silent_user: share of windows without any sound of the user. No recording is that silent.
        gain_db: largest change of the level of either track; colour_db: largest deviation of its bands, smooth from low
            to high, as with another microphone; grain_db: largest deviation of each single band of each row.
        stages: the curriculum, in order; the shares add up to 1.
    """

    window_frames: int = Field(default=96, ge=2)
    draws: Count = 4
    state_weight: NonNegative = 0.1
    coarse_weight: NonNegative = 0.5
    history_noise: NonNegative = 0.3
    speaking_noise: NonNegative = 1.0
    own_states: bool = False
    state_noise: Share = 0.8
    group_weights: GroupWeights | None = None
    event_windows: Share = 0.0
    drop_audio: Share = 0.1
    drop_face: Share = 0.3
    drop_agent: Share = 0.5
    quiet_room: Share = 0.0
    silent_user: Share = 0.0
    gain_db: NonNegative = 6.0
    colour_db: NonNegative = 6.0
    grain_db: NonNegative = 2.0
    stages: tuple[Stage, ...] = Field(
        default=(
            Stage(share=0.15, speaking=1.0),
            Stage(share=0.35, speaking=0.2, listening=0.8),
            Stage(share=0.5, speaking=0.15, listening=0.5, interaction=0.35),
        ),
        min_length=1,
    )

    def contradictions(self) -> Problems:
        yield from super().contradictions()
        total = sum(stage.share for stage in self.stages)
        if abs(total - 1) > 1e-6:
            yield f"shares of the stages add up to {total:g}, not 1"

    def stage(self, step: int) -> Stage:
        """Return the stage of a step; the last stage for a step beyond the end of all shares."""
        done = 0.0
        for stage in self.stages:
            done += stage.share
            if step < round(done * self.steps):
                return stage
        return self.stages[-1]


class ArigTraining(Model):
    """Training of an ARIG listener: `configs/training/arig.yaml`."""

    seed: Seed = 1
    listener: Arig
    training: ArigPhase


def load_training(file: Path) -> Training | ArigTraining:
    """Read a training file of any kind of listener. Raises ConfigError."""
    return parse_training(read(file), file)


def parse_training(raw: Any, file: Path | str) -> Training | ArigTraining:
    """Validate plain data of a training file. Raises ConfigError."""
    listener = raw.get("listener") if isinstance(raw, dict) else None
    kind = str(listener.get("kind")) if isinstance(listener, dict) else ""
    if kind == "arig":
        return parse(ArigTraining, raw, file)
    if kind == "sfms":
        return parse(Training, raw, file)
    raise ConfigError.at(file, "listener.kind", kind, "is not a kind of listener", ("sfms", "arig"))


class Baseline(Model):
    """Common settings of the dense and the grouped tokenizer: transformer encoder, codes, transformer decoder.

    Attributes:
        quantizer: a fixed grid (fsq), or the same number of learned vectors of `code_dims` dimensions (vq).
        levels: their product is the number of codes of a codebook.
        layers: number of transformer blocks of the encoder, and also of the decoder.
    """

    window_frames: Count = 48
    quantizer: Literal["fsq", "vq"]
    levels: Levels
    code_dims: Count = 8
    width: Count = 64
    layers: Count = 2
    heads: Count = 4

    @property
    def codes(self) -> int:
        return math.prod(self.levels)

    def contradictions(self) -> Problems:
        yield from uneven_heads(self.heads, width=self.width)


class Dense(Baseline):
    """A tokenizer with one code for every frame (Dense-FSQ, VQ-only)."""

    kind: Literal["dense"] = "dense"


class Grouped(Baseline):
    """A tokenizer with one code for every 8 frames (Learning2Listen)."""

    kind: Literal["grouped"] = "grouped"

    def contradictions(self) -> Problems:
        yield from super().contradictions()
        if self.window_frames % 2**HALVINGS:
            yield f"window_frames {self.window_frames} is not a multiple of {2**HALVINGS}"


class Recipe(Model):
    """A tokenizer of the comparison tables: its model and its training. Only an sfms tokenizer has keyframes."""

    seed: Seed = 1
    model: Sfms | Dense | Grouped = Field(discriminator="kind")
    training: TokenizerTraining
