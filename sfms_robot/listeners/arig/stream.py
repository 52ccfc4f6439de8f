"""ARIG as it runs: one speaker frame in, our face of the next frame out, and a memory of fixed size.

What has not changed is not computed again: behaviours of old frames, keys and values of old sounds, motions and whole
chunks are kept, as are the embeddings of the sampler's noise levels. Only the chunk in progress is read anew, since
the newest sounds modulate all of it.

A listener with events (`config.Listener.events`) takes two control rows a frame, of the frame heard and of the frame to
be made. Its conversational state is drawn (`csu`); a stream of the paper's goes on from its most probable one.

The robot's own voice belongs to the frame that is made, so `SpeakerFrame.agent_audio` is best given one frame early:
its samples are those the robot says in the 40 ms after `time_s`. Given on time, lips follow one frame late.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_S, Floats, Plan, SpeakerFrame
from sfms_robot.listeners.arig import audio_frontend, fast
from sfms_robot.listeners.arig.audio_frontend import AudioState
from sfms_robot.listeners.arig.csu import FIRST, Sojourn, with_feedback
from sfms_robot.listeners.arig.frame import Draw, Frame, repeated
from sfms_robot.listeners.arig.model import CONTROL_ROWS, ArigModel
from sfms_robot.listeners.graphs import graph
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS

BEYOND = 1e3  # rad, m or of a blendshape: no face


@dataclass(frozen=True)
class Memory:
    """What one stream remembers. Values only, all of fixed size: a step makes a new one.

    Attributes:
        frames: how many have been heard.
        user_voice, agent_voice: samples and phrase of both tracks.
        agent_sound: (1, D) embedded, of the agent's last frame.
        agent_behaviour, user_behaviour: (1, c, D) of the last c frames, the newest last.
        sound_keys: (1, 3, 2D) of the agent's last sounds; motion_keys: (1, 5, 2D) of its last motions.
        context: (L, 2, 1, h, w - 1, D/h) keys and values of whole chunks, the newest last.
        motion: (1, D) embedded motion of the agent's last frame; standard: (1, C) the same, standardised; sample:
            (1, C) what the sampler drew for it.
        state: conversational state of the last frame, of `settings.states`; sojourn: that which it is drawn from, of a
            listener with events.
        random: state of the stream's own generator.
    """

    frames: int
    user_voice: AudioState
    agent_voice: AudioState
    agent_sound: Tensor
    agent_behaviour: Tensor
    user_behaviour: Tensor
    sound_keys: Tensor
    motion_keys: Tensor
    context: Tensor
    motion: Tensor
    standard: Tensor
    sample: Tensor
    state: int
    sojourn: Sojourn
    random: Tensor


class ArigListener:
    """`ports.Listener` over an ArigModel. Holds weights only."""

    def __init__(self, settings: config.Arig, model: ArigModel, space: MotionSpace | None = None) -> None:
        """Raises ModelError for a model that hears with features nothing here computes (sound: wav2vec2)."""
        if settings.sound != "mel":
            raise ModelError(f"sound = {settings.sound!r}: such a model can be trained and evaluated, not run (mel)")
        self.settings = settings
        self.model = fast.with_precision(model, settings.precision).eval()
        self.space = space or MotionSpace.of(settings)
        self._frame = Frame(self.model)
        self._draw = Draw(self.model)
        self._frame_of_one: Callable[..., Any] = self._frame  # graphs, once they are built
        self._draw_of_one: Callable[..., Any] = self._draw

    @property
    def hop(self) -> int:
        return 1

    @property
    def horizon(self) -> int:
        return 1

    @property
    def control_frames(self) -> tuple[int, int]:
        """Control rows that a step takes: up to the newest frame heard, and after it."""
        return (1, CONTROL_ROWS - 1) if self.settings.events else (0, 0)

    @torch.inference_mode()
    def build_graphs(self) -> ArigListener:
        """The weights stay as they are from now on: what a single stream computes of a frame becomes graphs. Itself."""
        memory = self.start(0)
        told, _ = self._frame_inputs(SpeakerFrame(0.0, np.zeros(0, np.float32)), [memory], self._rows(None, 1))
        z, *_ = self._frame(*told)
        noise = torch.zeros(1, *self.model.noise_shape)
        self._frame_of_one = graph(Frame(self.model), told)
        self._draw_of_one = graph(Draw(self.model), (z, noise, memory.standard, memory.motion_keys))
        return self

    @torch.inference_mode()
    def start(self, seed: int) -> Memory:
        """Memory of a stream that has heard nothing and looked neutral so far (A.2)."""
        model, settings = self.model, self.settings
        d, c, heads = settings.width, settings.chunk_frames, settings.heads
        still = model.standardise(torch.tensor(self.space.neutral, dtype=torch.float32)[None])
        motion, silence = model.embed_motion(still), model.no_agent_sound[None]
        return Memory(
            frames=0,
            user_voice=audio_frontend.start(),
            agent_voice=audio_frontend.start(),
            agent_sound=silence,
            agent_behaviour=torch.zeros(1, c, d),
            user_behaviour=torch.zeros(1, c, d),
            sound_keys=repeated(model.progress.coarse.keys(silence), settings.sound_frames),
            motion_keys=repeated(model.progress.temporal.keys(motion), settings.motion_frames),
            context=torch.zeros(settings.context_layers, 2, 1, heads, settings.context_chunks - 1, d // heads),
            motion=motion,
            standard=still,
            sample=torch.zeros_like(still),
            state=FIRST,
            sojourn=Sojourn(FIRST, 0),
            random=torch.Generator().manual_seed(seed).get_state(),
        )

    def step(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Plan, Memory]:
        """Take one frame, plan the next. Never changes `memory` in place.

        `control` (2, K): rows of `signals.control` of the frame heard and of the next; None: nothing happens. Raises
        ValueError when the frame holds another number of samples than 640 or none, for control of another shape, and
        for any where the listener has no events.
        """
        (plan,), (now,) = self.step_many(speaker, [memory], None if control is None else [control])
        return plan, now

    @torch.inference_mode()
    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], controls: Sequence[Floats] | None = None
    ) -> tuple[list[Plan], list[Memory]]:
        """`step` of streams that began together and heard the same speaker ever since, each with its own control.

        Each draws from its own randomness, as it would alone, at a fraction of the time.
        """
        rows = self._rows(controls, len(memories))
        z, logits, now = self._conditions(speaker, memories, rows)
        generators = [torch.Generator().set_state(memory.random) for memory in now]
        noise = torch.cat([torch.randn(1, *self.model.noise_shape, generator=each) for each in generators])
        draw = self._draw_of_one if len(now) == 1 else self._draw
        drawn = draw(z, noise, _joined([m.standard for m in now]), _joined([m.motion_keys for m in now]))
        made, standard, sample, motion, keys = (part.split(1) for part in drawn)
        sojourns, states = self._states(logits, now, rows, generators)
        plans, after = [], []
        for index, memory in enumerate(now):
            frames, jaw_rad = self.space.decode(made[index].numpy())
            plans.append(Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), frames, jaw_rad))
            after.append(
                replace(
                    memory,
                    motion=motion[index],
                    standard=standard[index],
                    sample=sample[index],
                    motion_keys=keys[index],
                    state=states[index],
                    sojourn=sojourns[index],
                    random=generators[index].get_state(),
                )
            )
        return plans, after

    @torch.inference_mode()
    def condition(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Tensor, Memory]:
        """What the sampler is told of the next frame, (1, its width), and the memory but for what is to be drawn."""
        rows = self._rows(None if control is None else [control], 1)
        z, _, (now,) = self._conditions(speaker, [memory], rows)
        return z, now

    def _conditions(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], rows: Tensor
    ) -> tuple[Tensor, Tensor, list[Memory]]:
        """What the sampler is told (N, its width), logits of the states (N, S), and memories but for what is drawn."""
        told, (user_voice, agent_voice) = self._frame_inputs(speaker, memories, rows)
        found = (self._frame_of_one if len(memories) == 1 else self._frame)(*told)
        z, logits, made, *rest = found
        agent_sound, agent_behaviour, user_behaviour, sound_keys = (part.split(1) for part in rest)
        frames = memories[0].frames + 1
        whole = frames % self.settings.chunk_frames == 0
        after = [
            replace(
                memory,
                frames=frames,
                user_voice=user_voice,
                agent_voice=agent_voice,
                agent_sound=agent_sound[index],
                agent_behaviour=agent_behaviour[index],
                user_behaviour=user_behaviour[index],
                sound_keys=sound_keys[index],
                context=torch.cat([memory.context[..., 1:, :], summary], dim=-2) if whole else memory.context,
            )
            for index, (memory, summary) in enumerate(zip(memories, made.split(1, dim=2), strict=True))
        ]
        return z, logits, after

    def _states(
        self, logits: Tensor, now: Sequence[Memory], rows: Tensor, generators: Sequence[torch.Generator]
    ) -> tuple[list[Sojourn], list[int]]:
        """States of the frame that is made: the most probable, or drawn where the model has events."""
        before = [memory.sojourn for memory in now]
        if self.model.states is None:
            return before, [memory.state for memory in now]
        if not self.settings.events:
            return before, logits.argmax(-1).tolist()
        voiced = (now[0].agent_voice.voiced, now[0].user_voice.voiced)
        sojourns = [
            self.model.states.draw(scores, voiced, last, torch.rand(2, generator=generator))
            for scores, last, generator in zip(logits, before, generators, strict=True)
        ]
        drawn = torch.tensor([sojourn.state for sojourn in sojourns])
        return sojourns, with_feedback(drawn, rows[:, -len(COLUMNS) :]).tolist()

    def _rows(self, controls: Sequence[Floats] | None, streams: int) -> Tensor:
        """(streams, 2K); of a listener without events (streams, 0)."""
        if not self.settings.events:
            if controls is not None:
                raise ValueError("control is for a listener with events: true")
            return torch.zeros(streams, 0)
        if controls is None:
            return torch.zeros(streams, CONTROL_ROWS * len(COLUMNS))
        rows = np.stack([np.asarray(control, np.float32) for control in controls])
        if rows.shape != (streams, CONTROL_ROWS, len(COLUMNS)):
            raise ValueError(
                f"control is {rows.shape[1:]} of {len(rows)}, not {(CONTROL_ROWS, len(COLUMNS))} of {streams}"
            )
        return torch.from_numpy(rows.reshape(streams, -1))

    def _frame_inputs(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], rows: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[AudioState, AudioState]]:
        """What `Frame` takes, and user and agent heard."""
        heard_so_far = memories[0]
        user, heard, user_voice = audio_frontend.hear(speaker.audio, heard_so_far.user_voice)
        agent, says, agent_voice = audio_frontend.hear(
            audio_frontend.fit_frame(speaker.agent_audio), heard_so_far.agent_voice
        )
        face, seen = self._face(speaker)
        told = (
            torch.from_numpy(np.stack([user, agent])),
            torch.tensor([heard, says]),
            torch.tensor([[agent_voice.voiced, user_voice.voiced]]),
            face,
            seen,
            torch.tensor(heard_so_far.frames == 0),
            torch.tensor([memory.state for memory in memories]),
            self.model.long.rotary(torch.tensor([heard_so_far.frames // self.settings.chunk_frames])),
            self._in_view(heard_so_far.frames, _joined([memory.context for memory in memories], dim=2)),
            _joined([memory.agent_sound for memory in memories]),
            _joined([memory.agent_behaviour for memory in memories]),
            _joined([memory.user_behaviour for memory in memories]),
            _joined([memory.sound_keys for memory in memories]),
            _joined([memory.motion for memory in memories]),
            _joined([memory.motion_keys for memory in memories]),
            _joined([memory.sample for memory in memories]),
            rows,
        )
        return told, (user_voice, agent_voice)

    def _face(self, speaker: SpeakerFrame) -> tuple[Tensor, Tensor]:
        """(1, C) standardised, (1,) seen; what is not finite or beyond all faces is not: memory would keep it."""
        motion = None if speaker.face is None else speaker.face.motion
        if motion is None or not np.abs(motion).max() < BEYOND:  # false for NaN too
            return torch.zeros(1, self.model.channels), torch.tensor([False])
        return self.model.standardise(torch.from_numpy(self.space.encode(motion[None]))), torch.tensor([True])

    def _in_view(self, frames: int, context: Tensor) -> Tensor:
        """Keys and values of the whole chunks there are after so many frames."""
        room = context.shape[-2]
        return context[..., room - min(frames // self.settings.chunk_frames, room) :, :]


def _joined(parts: Sequence[Tensor], dim: int = 0) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts), dim)
