"""Settings of training: those of every phase, of the two phases of SFMS, of ARIG, and of the tokenizers in tables."""

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
    """One run of the training loop, whatever is trained.

    Attributes:
        steps, batch: length of the run, and samples a step.
        learning_rate: where the warm-up ends and the cosine begins.
        warm_up_steps: at most a tenth of `steps`.
        clip_norm: largest gradient norm of each optimizer's parameters.
        precision: bf16 is autocast; a CPU without instructions for it always computes in fp32.
        evaluate_every: steps between evaluations of the held-out loss; 0: never, the last weights are kept.
        patience: evaluations without a better held-out loss before training stops; None: train to the last step.
        checkpoint_every, checkpoint_minutes: whichever comes first.
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
    """Phase 1: scores, quantizer, inpainter.

    Attributes:
        score_tracks: tracks (a window of one group) that the scores of `learned` learn from in a step.
        mask_loss: alpha of equation (13); temperature: first and last of Algorithm 1. Both of `learned_paper`.
        tempered_draws: the temperature acts on what is drawn, as equation (6) reads; Algorithm 1 leaves the draw alone.
        sparsity: weight of equation (8), of `adaptive`.
        commitment: weight of ||sg[z_q] - E(z)|| in equation (13), of quantizer vq.
        velocity_loss: weight of the error from one frame to the next.
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
    """Phase 2: the next-token predictor.

    Attributes:
        tokens: keyframes are placed in whole dyads or long stretches (dyads), or in each training window separately
            (windows), as in the paper, whose tokenizer has the predictor's window.
        transition_weight: of class 0 in (14); a keyframe weighs 1. undo_weight: it is taken out of the probabilities
            again afterwards, which the paper leaves open.
        dtw_weight, dtw_gamma: of the soft-DTW on the keyframe indicator (IV-D3), and how soft its minima are.
        neutral_prefix: share of windows that begin as a stream does; drop_audio, drop_face: that lack a modality.
        history_noise: share of past keyframes that are one level off.
        missed_keyframes: share of windows and groups whose last keyframes are missing, as in a roll-out, and have to be
            made up for (`learning.sfms.missed_keyframes`); of placement `penalised`.
        group_weights: of each group's loss; 1 where it is not named.
        event_windows: share of windows in whose future an event other than a blink is under way, for listeners with
            events; the events are given, so it changes no odds.
        calibration_rounds: roll-outs that bring keyframe rates to those of the data; if any, one more measures the size
            of nods that a listener with events produces for a given size.
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
    """A part of the curriculum.

    Attributes:
        share: of all steps.
        speaking, listening, interaction: weights of the sets of these names when windows are drawn. A set that the data
            lack is left out.
    """

    share: float = Field(gt=0, le=1)
    speaking: NonNegative = 0.0
    listening: NonNegative = 0.0
    interaction: NonNegative = 0.0

    def contradictions(self) -> Problems:
        if not self.speaking + self.listening + self.interaction:
            yield "a stage needs a weight above 0 (speaking, listening, interaction)"


class GroupWeights(Model):
    """Weights of the mean loss of each group of channels (`learning.arig.losses.GROUPS`), whatever their number."""

    head: NonNegative = 1.0
    lids: NonNegative = 1.0
    brows: NonNegative = 1.0
    mouth: NonNegative = 1.0

    def contradictions(self) -> Problems:
        if not self.head + self.lids + self.brows + self.mouth:
            yield "a group needs a weight above 0 (head, lids, brows, mouth)"


class ArigPhase(Phase):
    """The training of an ARIG listener.

    Attributes:
        window_frames: frames of one sample; its first one begins a stream, so context reaches no further back.
        draws: noise levels per frame in equation (3): the sampler is small beside what its condition costs.
        state_weight: of the states' cross-entropy (3.3); coarse_weight: of the coarse motion's squared error (3.4);
            equation (3) weighs 1. The paper gives no weights.
        history_noise: most that the past motion is off by, in standard deviations: in a stream it is the model's own.
        speaking_noise: the same of jaw and mouth while the agent speaks: its words decide them, not their past.
        own_states: previous states are the model's own answers, as a stream feeds them; else true ones.
        state_noise: share of previous states that are drawn at random. A stream that continues from its own best guess
            needs it: true ones would be copied. One that draws its states (events) is trained with true ones.
        group_weights: of groups of channels in equation (3); None: every channel counts the same, which is the paper.
        event_windows: share of windows in which an event other than a blink is under way, every kind as often as any
            other, for listeners with events: smiles are rare.
        drop_audio, drop_face: share of windows without the user's sound, without the face; drop_agent: share of the
            windows in which the agent is silent that have no agent's track.
        quiet_room: share of windows in which the noise of the user's microphone is weaker, down to that of a gate that
            is shut; silent_user: share without any sound of it. No recording is that silent.
        gain_db: most that either track is louder or softer; colour_db: most that its bands are, smoothly from low to
            high, as another microphone has it; grain_db: deviation of every band of every row.
        stages: the curriculum, in order; shares add up to 1.
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
        """Return the stage of a step; the last one from the end of its shares on."""
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
    """The common part of the dense and the grouped tokenizer: transformer encoder, codes, transformer decoder.

    Attributes:
        quantizer: a fixed grid (fsq), or as many learned vectors of `code_dims` dimensions (vq).
        levels: multiply to the codes of a codebook.
        layers: transformer blocks of the encoder, and as many of the decoder.
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
    """One tokenizer of the comparison tables and how it is trained; its keyframes are for an sfms tokenizer alone."""

    seed: Seed = 1
    model: Sfms | Dense | Grouped = Field(discriminator="kind")
    training: TokenizerTraining
