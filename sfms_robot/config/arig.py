"""A listener of kind `arig`: its sizes, its sampler, and the ablations of the paper's tables 1 and 4 as switches."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from sfms_robot.config.base import Model, NonNegative
from sfms_robot.config.listener import Count, Listener, check_heads

# Conversational states (3.3), in the order of the model's classes.
STATES: Final = ("speaking", "listening", "receiving_feedback", "thinking", "interrupted", "waiting", "giving_feedback")
# Those of a listener with events: feedback that is seen, by how, apart from that which is heard.
EVENT_STATES: Final = (*STATES, "giving_feedback_nod", "giving_feedback_smile")


def paper_state(state: int) -> int:
    """A state of `EVENT_STATES` as one of the paper's seven."""
    return min(state, len(STATES) - 1)


def _both(value: Any) -> Any:
    return (value, value) if isinstance(value, int | float) else value


Temperature = Annotated[tuple[NonNegative, NonNegative], BeforeValidator(_both)]  # first and last; one number is both


class Diffusion(Model):
    """The DiffusionMLP and how it is sampled.

    Attributes:
        width: of its condition and blocks; the paper takes that of its motion, 262.
        train_steps: noise levels in training.
        steps: of them used to sample one frame, spread evenly.
        sampler: `ddpm` is the paper's (4); `ddim` adds no noise between steps, which suits few of them.
        temperature: factor on the noise that is added between steps; two: after the first step and before the last,
            evenly in between. Early noise decides what happens, late noise is jitter.
        temperatures: the same, in its place, for channels whose names begin so: `{eye: 1.1}`; the first that fits.
        clamp: is every estimate of the clean motion kept within the range of the data? (4) does not.
    """

    width: Annotated[int, Field(ge=2, multiple_of=2)] = 262
    blocks: Count = 3
    train_steps: Annotated[int, Field(ge=2)] = 1000
    steps: Count = 15
    sampler: Literal["ddpm", "ddim"] = "ddpm"
    temperature: Temperature = (1.0, 1.0)
    temperatures: dict[str, Temperature] = {}
    clamp: bool = True

    def temperature_of(self, channel: str) -> tuple[float, float]:
        fits = (value for prefix, value in self.temperatures.items() if channel.startswith(prefix))
        return next(fits, self.temperature)

    @model_validator(mode="after")
    def _fits(self) -> Diffusion:
        if self.steps > self.train_steps:
            raise ValueError(f"steps {self.steps} is above train_steps {self.train_steps}")
        return self


class Arig(Listener):
    """Frame-wise autoregression with a diffusion head.

    Attributes:
        sound: `mel` (4 rows of 128 per frame) or `wav2vec2` (768 per frame, brought with the data: trains, never runs).
        phase: is each track's place in a phrase (`signals.phase`) beside its sound? Beyond the paper; it reaches back
            further than a short context.
        width, feedforward: of every block; heads: of every attention.
        chunk_frames: c of the paper; context_chunks: w (4: ablation "w/o long-range context").
        bidirectional_layers: 2 in the paper; integrated_layers, context_layers: the paper leaves them open.
        sound_frames: of the agent, that the coarse motion looks at; motion_frames: that the temporal layer looks at.
        state_guidance: false leaves the conversational states out; visual: false leaves motion out of the behaviours;
            interaction: `linear` puts plain layers in place of bidirectional-integrated learning;
            discrete: codes of `code_levels` and a softmax in place of diffusion (tables 1 and 4), codes of `motion`
            itself: what codes of steps get wrong would add up.
        draws: what the sampler draws of a frame: its `motion`, as in the paper; the `step` from the frame before, which
            is small where a face is still, and with it what the sampler gets wrong, but that stays; or the
            `innovation` of a first-order autoregression fitted on the data, a step that is forgotten as fast as
            people's motion returns to its mean.
        precision: of the running model's large layers; auto: int8 where the processor has it, else fp32.
    """

    kind: Literal["arig"]
    sound: Literal["mel", "wav2vec2"] = "mel"
    phase: bool = True
    width: Count = 512
    feedforward: Count = 2048
    heads: Count = 8
    chunk_frames: Count = 6
    context_chunks: Annotated[int, Field(ge=2)] = 512
    bidirectional_layers: Count = 2
    integrated_layers: Count = 1
    context_layers: Count = 4
    sound_frames: Count = 3
    motion_frames: Count = 5
    state_guidance: bool = True
    visual: bool = True
    interaction: Literal["bidirectional", "linear"] = "bidirectional"
    discrete: bool = False
    code_levels: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)] = (8, 5, 5, 5)
    draws: Literal["motion", "step", "innovation"] = "motion"
    diffusion: Diffusion = Diffusion()
    precision: Literal["auto", "fp32", "int8"] = "auto"

    @model_validator(mode="after")
    def _heads_fit(self) -> Arig:
        check_heads(self.heads, width=self.width)
        return self

    @model_validator(mode="after")
    def _codes_are_of_motion(self) -> Arig:
        if self.discrete and self.draws != "motion":
            raise ValueError(f"discrete: true is of draws: motion, not {self.draws}")
        return self

    @property
    def states(self) -> tuple[str, ...]:
        """Conversational states it tells apart."""
        return EVENT_STATES if self.events else STATES

    @model_validator(mode="after")
    def _events_fit(self) -> Arig:
        if self.events and self.motion_space != "arkit58":
            raise ValueError(f"events: true needs motion_space arkit58, not {self.motion_space}")
        return self

    @model_validator(mode="after")
    def _temperatures_fit(self) -> Arig:
        for prefix in self.diffusion.temperatures:
            if not any(channel.startswith(prefix) for channel in self.channels):
                raise ValueError(f"diffusion.temperatures.{prefix}: no channel of {self.motion_space} begins so")
        return self
