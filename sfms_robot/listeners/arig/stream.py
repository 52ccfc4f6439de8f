"""ARIG as it runs: one speaker frame in, our face of the next frame out, and a memory of fixed size.

What has not changed is not computed again: behaviours of old frames, keys and values of old sounds, motions and whole
chunks are kept, as are the embeddings of the sampler's noise levels. Only the chunk in progress is read anew, since
the newest sounds modulate all of it.

The robot's own voice belongs to the frame that is made, so `SpeakerFrame.agent_audio` is best given one frame early:
its samples are those the robot says in the 40 ms after `time_s`. Given on time, lips follow one frame late.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_S, Plan, SpeakerFrame
from sfms_robot.listeners.arig import audio_frontend, fast
from sfms_robot.listeners.arig.audio_frontend import AudioState
from sfms_robot.listeners.arig.csu import FIRST
from sfms_robot.listeners.arig.frame import Draw, Frame, repeated
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.graphs import graph
from sfms_robot.listeners.space import MotionSpace

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
        motion: (1, D) embedded motion of the agent's last frame; standard: (1, C) the same, standardised.
        state: conversational state of the last frame.
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
    state: int
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
        self._frame: Callable[..., Any] = Frame(self.model)
        self._draw: Callable[..., Any] = Draw(self.model)

    @property
    def hop(self) -> int:
        return 1

    @property
    def horizon(self) -> int:
        return 1

    @torch.inference_mode()
    def build_graphs(self) -> ArigListener:
        """The weights stay as they are from now on: what a frame computes becomes graphs. Itself."""
        memory = self.start(0)
        told, _ = self._frame_inputs(SpeakerFrame(0.0, np.zeros(0, np.float32)), memory)
        z, *_ = self._frame(*told)
        noise = torch.zeros(1, *self.model.noise_shape)
        self._frame = graph(Frame(self.model), told)
        self._draw = graph(Draw(self.model), (z, noise, memory.standard, memory.motion_keys))
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
            state=FIRST,
            random=torch.Generator().manual_seed(seed).get_state(),
        )

    @torch.inference_mode()
    def step(self, speaker: SpeakerFrame, memory: Memory) -> tuple[Plan, Memory]:
        """Take one frame, plan the next. Never changes `memory` in place.

        Raises ValueError when the frame holds another number of samples than 640 or none.
        """
        z, now = self.condition(speaker, memory)
        generator = torch.Generator()
        generator.set_state(now.random)
        noise = torch.randn(1, *self.model.noise_shape, generator=generator)
        made, standard, motion, keys = self._draw(z, noise, now.standard, now.motion_keys)
        after = replace(now, motion=motion, standard=standard, motion_keys=keys, random=generator.get_state())
        frames, jaw_rad = self.space.decode(made.numpy())
        return Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), frames, jaw_rad), after

    @torch.inference_mode()
    def condition(self, speaker: SpeakerFrame, memory: Memory) -> tuple[Tensor, Memory]:
        """What the sampler is told of the next frame, z (1, D), and the memory but for the motion to be drawn."""
        told, now = self._frame_inputs(speaker, memory)
        z, logits, made, agent_sound, agent_behaviour, user_behaviour, sound_keys = self._frame(*told)
        whole = now.frames % self.settings.chunk_frames == 0
        after = replace(
            now,
            agent_sound=agent_sound,
            agent_behaviour=agent_behaviour,
            user_behaviour=user_behaviour,
            sound_keys=sound_keys,
            context=torch.cat([now.context[..., 1:, :], made], dim=-2) if whole else now.context,
            state=int(logits.argmax()) if logits.numel() else now.state,
        )
        return z, after

    def _frame_inputs(self, speaker: SpeakerFrame, memory: Memory) -> tuple[tuple[Tensor, ...], Memory]:
        """What `Frame` takes, and memory with both tracks heard."""
        user, heard, user_voice = audio_frontend.hear(speaker.audio, memory.user_voice)
        agent, says, agent_voice = audio_frontend.hear(
            audio_frontend.fit_frame(speaker.agent_audio), memory.agent_voice
        )
        face, seen = self._face(speaker)
        told = (
            torch.from_numpy(np.stack([user, agent])),
            torch.tensor([heard, says]),
            torch.tensor([[agent_voice.voiced, user_voice.voiced]]),
            face,
            seen,
            torch.tensor(memory.frames == 0),
            torch.tensor([memory.state]),
            self.model.long.rotary(torch.tensor([memory.frames // self.settings.chunk_frames])),
            self._in_view(memory),
            memory.agent_sound,
            memory.agent_behaviour,
            memory.user_behaviour,
            memory.sound_keys,
            memory.motion,
            memory.motion_keys,
        )
        return told, replace(memory, frames=memory.frames + 1, user_voice=user_voice, agent_voice=agent_voice)

    def _face(self, speaker: SpeakerFrame) -> tuple[Tensor, Tensor]:
        """(1, C) standardised, (1,) seen; what is not finite or beyond all faces is not: memory would keep it."""
        motion = None if speaker.face is None else speaker.face.motion
        if motion is None or not np.abs(motion).max() < BEYOND:  # false for NaN too
            return torch.zeros(1, self.model.channels), torch.tensor([False])
        return self.model.standardise(torch.from_numpy(self.space.encode(motion[None]))), torch.tensor([True])

    def _in_view(self, memory: Memory) -> Tensor:
        """Keys and values of the whole chunks there are; `memory.frames` does not count the frame to come."""
        room = memory.context.shape[-2]
        chunks = min(memory.frames // self.settings.chunk_frames, room)
        return memory.context[..., room - chunks :, :]
