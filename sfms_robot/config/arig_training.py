"""How an ARIG listener is trained: one phase, whose curriculum goes from speaking over listening to interaction."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from sfms_robot.config.arig import Arig
from sfms_robot.config.base import Model, NonNegative, parse
from sfms_robot.config.listener import Count, Share
from sfms_robot.config.training import Phase, Training
from sfms_robot.config.yaml_file import read
from sfms_robot.errors import ConfigError


class Stage(Model):
    """A part of the curriculum.

    Attributes:
        share: of all steps.
        speaking, listening, interaction: how its windows are drawn from the sets of these names, as weights. A set that
            the data lack is left out.
    """

    share: Annotated[float, Field(gt=0, le=1)]
    speaking: NonNegative = 0.0
    listening: NonNegative = 0.0
    interaction: NonNegative = 0.0

    @model_validator(mode="after")
    def _draws(self) -> Stage:
        if not self.speaking + self.listening + self.interaction:
            raise ValueError("a stage needs a weight above 0 (speaking, listening, interaction)")
        return self


class GroupWeights(Model):
    """What the mean loss of a group of channels weighs (`learning.arig.losses.GROUPS`), whatever their number."""

    head: NonNegative = 1.0
    lids: NonNegative = 1.0
    brows: NonNegative = 1.0
    mouth: NonNegative = 1.0

    @model_validator(mode="after")
    def _weighs(self) -> GroupWeights:
        if not self.head + self.lids + self.brows + self.mouth:
            raise ValueError("a group needs a weight above 0 (head, lids, brows, mouth)")
        return self


class ArigPhase(Phase):
    """The training of an ARIG listener.

    Attributes:
        window_frames: frames of one sample; its first one begins a stream, so context reaches no further back.
        draws: noise levels per frame in equation (3): the sampler is small beside what its condition costs.
        state_weight: of the states' cross-entropy (3.3); coarse_weight: of the coarse motion's squared error (3.4);
            equation (3) weighs 1. The paper gives no weights.
        history_noise: most that the past motion is off by, in standard deviations: in a stream it is the model's own.
        speaking_noise: likewise of jaw and mouth while the agent speaks: what it says decides them, not what they did.
        state_noise: share of previous states that are drawn by lot. A stream that goes on from its own best guess needs
            it: true ones would be copied, and it has none. One that draws its states (events) is taught with true ones.
        group_weights: of groups of channels in equation (3); None: every channel counts the same, which is the paper.
        event_windows: share of windows in which an event other than a blink is under way, every kind as often as any
            other, for listeners that are told of them: smiles are rare.
        drop_audio, drop_face: share of windows in which the user is not heard, not seen; drop_agent: of those in which
            the agent says nothing, that have no agent's track.
        quiet_room: share of windows in which what the user's microphone has besides speech is weaker, down to that of a
            gate that is shut; silent_user: share in which it has nothing at all. No recording is as silent as that.
        gain_db: most that either track is louder or softer; colour_db: most that its bands are, smoothly from low to
            high, as another microphone has it; grain_db: deviation of every band of every row.
        stages: the curriculum, in order; shares add up to 1.
    """

    window_frames: Annotated[int, Field(ge=2)] = 96
    draws: Count = 4
    state_weight: NonNegative = 0.1
    coarse_weight: NonNegative = 0.5
    history_noise: NonNegative = 0.3
    speaking_noise: NonNegative = 1.0
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
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)] = (
        Stage(share=0.15, speaking=1.0),
        Stage(share=0.35, speaking=0.2, listening=0.8),
        Stage(share=0.5, speaking=0.15, listening=0.5, interaction=0.35),
    )

    @model_validator(mode="after")
    def _whole(self) -> ArigPhase:
        total = sum(stage.share for stage in self.stages)
        if abs(total - 1) > 1e-6:
            raise ValueError(f"shares of the stages add up to {total:g}, not 1")
        return self

    def stage(self, step: int) -> Stage:
        """The stage of a step; the last one from the end of its shares on."""
        done = 0.0
        for stage in self.stages:
            done += stage.share
            if step < round(done * self.steps):
                return stage
        return self.stages[-1]


class ArigTraining(Model):
    """How an ARIG listener is trained: `configs/training/arig.yaml`."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
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
