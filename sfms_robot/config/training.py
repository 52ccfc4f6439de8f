"""How listeners are trained: what every phase of training shares, and the two phases of SFMS."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Model, Name, NonNegative, Positive
from sfms_robot.config.listener import Count, Sfms, Share

_RESUMABLE = frozenset({"checkpoint_every", "checkpoint_minutes", "patience"})


class Phase(Model):
    """One run of the training loop, whatever is trained.

    Attributes:
        steps, batch: length of the run, and samples a step.
        learning_rate: where the warm-up ends and the cosine begins.
        warm_up_steps: at most a tenth of `steps`.
        clip_norm: largest gradient norm of each optimizer's parameters.
        precision: bf16 is autocast; a CPU without instructions for it computes in fp32 whatever is asked.
        evaluate_every: steps from one look at the held-out loss to the next; 0: never, the last weights are kept.
        patience: looks without a better held-out loss before training stops; None: it goes on to the last step.
        checkpoint_every, checkpoint_minutes: whichever comes first.
    """

    steps: Count
    batch: Count
    learning_rate: Positive
    weight_decay: NonNegative = 0.01
    warm_up_steps: Annotated[int, Field(ge=0)] = 100
    clip_norm: Positive = 1.0
    precision: Literal["fp32", "bf16"] = "fp32"
    evaluate_every: Annotated[int, Field(ge=0)] = 200
    patience: Count | None = None
    checkpoint_every: Count = 500
    checkpoint_minutes: Positive = 5.0

    @model_validator(mode="after")
    def _patience_looks(self) -> Phase:
        if self.patience is not None and self.evaluate_every == 0:
            raise ValueError(f"patience {self.patience} needs evaluate_every above 0")
        return self

    def identity(self) -> dict[str, Any]:
        """What must not change between a checkpoint and its resumption: all that decides the weights of a step."""
        return self.model_dump(mode="json", exclude=set(_RESUMABLE))


class TokenizerTraining(Phase):
    """Phase 1: scores, quantizer, inpainter.

    Attributes:
        score_tracks: tracks (a window of one group) that the scores of `learned` learn from in a step.
        mask_loss: alpha of equation (13); temperature: first and last of Algorithm 1. Both of `learned_paper`.
        commitment: weight of ||sg[z_q] - E(z)|| in equation (13), of quantizer vq.
        velocity_loss: weight of the error from one frame to the next.
    """

    score_learning_rate: Positive = 3e-3
    score_tracks: Count = 32
    mask_loss: NonNegative = 0.1
    temperature: tuple[Positive, Positive] = (2.0, 0.1)
    commitment: NonNegative = 1.0
    velocity_loss: NonNegative = 0.0


class PredictorTraining(Phase):
    """Phase 2: the next-token predictor.

    Attributes:
        transition_weight: of class 0 in (14); a keyframe weighs 1. undo_weight: is it taken out of the probabilities
            again afterwards? The paper says nothing of that.
        dtw_weight, dtw_gamma: of the soft-DTW on the keyframe indicator (IV-D3), and how soft its minima are.
        neutral_prefix: share of windows that begin as a stream does; drop_audio, drop_face: that lack a modality.
        history_noise: share of past keyframes that are one level off.
        missed_keyframes: share of windows and groups whose last keyframes are missing, as in a roll-out, and have to be
            made up for (`learning.sfms.missed_keyframes`); of placement `penalised`.
        group_weights: of each group's loss; 1 where it is not named.
        event_windows: share of windows in whose future an event other than a blink is under way, for listeners that are
            told; what is told decides it, so it changes no odds.
        calibration_rounds: roll-outs that bring keyframe rates to those of the data; if any, one more finds how large
            nods come out of a listener that is told how large they are to be.
    """

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
    calibration_rounds: Annotated[int, Field(ge=0)] = 2


class Training(Model):
    """How an SFMS listener is trained: `configs/training/NAME.yaml`."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    listener: Sfms
    tokenizer: TokenizerTraining
    predictor: PredictorTraining

    @model_validator(mode="after")
    def _known_groups(self) -> Training:
        for name in self.predictor.group_weights:
            if name not in self.listener.groups:
                choices = ", ".join(self.listener.groups)
                raise ValueError(f"predictor.group_weights: {name!r} is not a group of the listener ({choices})")
        return self
