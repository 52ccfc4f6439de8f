"""ARIG as it runs: one speaker frame in, our face of the next frame out, and a memory of fixed size.

What has not changed is not computed again: behaviours of old frames, keys and values of old sounds, motions and whole
chunks are kept, as are the embeddings of the sampler's noise levels. Only the chunk in progress is read anew, since
the newest sounds modulate all of it.

The robot's own voice belongs to the frame that is made, so `SpeakerFrame.agent_audio` is best given one frame early:
its samples are those the robot says in the 40 ms after `time_s`. Given on time, lips follow one frame late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_S, Plan, SpeakerFrame
from sfms_robot.listeners.arig import fast, sound
from sfms_robot.listeners.arig.csu import FIRST
from sfms_robot.listeners.arig.diffusion import Denoiser
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.sound import Ears
from sfms_robot.listeners.space import MotionSpace

BEYOND = 1e3  # rad, m or of a blendshape: no face


@dataclass(frozen=True)
class Memory:
    """What one stream remembers. Values only, all of fixed size: a step makes a new one.

    Attributes:
        frames: how many have been heard.
        user_ears, agent_ears: samples and phrase of both tracks.
        agent_sound: (1, D) embedded, of the agent's last frame.
        agent_behaviour, user_behaviour: (1, c, D) of the last c frames, the newest last.
        sound_keys: (1, 3, 2D) of the agent's last sounds; motion_keys: (1, 5, 2D) of its last motions.
        context: (L, 2, 1, h, w - 1, D/h) keys and values of whole chunks, the newest last.
        motion: (1, D) embedded motion of the agent's last frame; standard: (1, C) the same, standardised.
        state: conversational state of the last frame.
        random: state of the stream's own generator.
    """

    frames: int
    user_ears: Ears
    agent_ears: Ears
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
        head = self.model.head
        with torch.no_grad():
            self._levels = head.level(torch.tensor(head.levels)) if isinstance(head, Denoiser) else None

    @property
    def hop(self) -> int:
        return 1

    @property
    def horizon(self) -> int:
        return 1

    @torch.inference_mode()
    def start(self, seed: int) -> Memory:
        """Memory of a stream that has heard nothing and looked neutral so far (A.2)."""
        model, settings = self.model, self.settings
        d, c, heads = settings.width, settings.chunk_frames, settings.heads
        still = model.standardise(torch.tensor(self.space.neutral, dtype=torch.float32)[None])
        motion, silence = model.embed_motion(still), model.no_agent_sound[None]
        return Memory(
            frames=0,
            user_ears=sound.start(),
            agent_ears=sound.start(),
            agent_sound=silence,
            agent_behaviour=torch.zeros(1, c, d),
            user_behaviour=torch.zeros(1, c, d),
            sound_keys=_repeated(model.progress.coarse.keys(silence), settings.sound_frames),
            motion_keys=_repeated(model.progress.temporal.keys(motion), settings.motion_frames),
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
        sample, random = self._sample(z, now.random)
        standard = self.model.drawn(sample, now.standard)
        motion = self.model.embed_motion(standard)
        keys = self.model.progress.temporal.keys(motion)
        after = replace(now, motion=motion, standard=standard, motion_keys=_push(now.motion_keys, keys), random=random)
        frames, jaw_rad = self.space.decode(self.model.restore(standard).numpy())
        return Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), frames, jaw_rad), after

    @torch.inference_mode()
    def condition(self, speaker: SpeakerFrame, memory: Memory) -> tuple[Tensor, Memory]:
        """What the sampler is told of the next frame, z (1, D), and the memory but for the motion to be drawn."""
        model = self.model
        now, user_sound = self._hear(speaker, memory)
        cis, made = model.long.step(
            model.short(now.agent_behaviour, now.user_behaviour, now.agent_sound, user_sound),
            self._in_view(now),
            model.long.turn(torch.tensor([memory.frames // self.settings.chunk_frames])),
        )
        feature, state = None, now.state
        if model.states is not None:
            voiced = torch.tensor([[now.agent_ears.voiced, now.user_ears.voiced]])
            feature, logits = model.states(model.states.condition(cis, voiced), torch.tensor([now.state]))
            state = int(logits.argmax())
        z = model.progress(now.motion, now.sound_keys, now.motion_keys, now.agent_sound, cis, feature)
        whole = now.frames % self.settings.chunk_frames == 0
        context = torch.cat([now.context[..., 1:, :], made], dim=-2) if whole else now.context
        return z, replace(now, context=context, state=state)

    def _hear(self, speaker: SpeakerFrame, memory: Memory) -> tuple[Memory, Tensor]:
        """Memory with the behaviours of this frame and the agent's sound of the next, and the user's sound (1, D)."""
        model = self.model
        user, heard, user_ears = sound.hear(speaker.audio, memory.user_ears)
        agent, says, agent_ears = sound.hear(sound.fit_frame(speaker.agent_audio), memory.agent_ears)
        sounds = model.embed_sound(
            torch.from_numpy(np.stack([user, agent])),
            torch.tensor([heard, says]),
            torch.stack([model.no_user_sound, model.no_agent_sound]),
        )
        user_sound, agent_sound = sounds[:1], sounds[1:].clone()  # memory holds no more than it needs
        agent_behaviour = model.merge_agent(memory.agent_sound, memory.motion)
        user_behaviour = model.merge_user(user_sound, self._face(speaker))
        first = memory.frames == 0
        c = self.settings.chunk_frames
        now = replace(
            memory,
            frames=memory.frames + 1,
            user_ears=user_ears,
            agent_ears=agent_ears,
            agent_sound=agent_sound,
            agent_behaviour=_repeated(agent_behaviour, c) if first else _push(memory.agent_behaviour, agent_behaviour),
            user_behaviour=_repeated(user_behaviour, c) if first else _push(memory.user_behaviour, user_behaviour),
            sound_keys=_push(memory.sound_keys, model.progress.coarse.keys(agent_sound)),
        )
        return now, user_sound

    def _face(self, speaker: SpeakerFrame) -> Tensor:
        """(1, D) embedded; what is not finite or beyond all faces is not seen: memory would never be rid of it."""
        motion = None if speaker.face is None else speaker.face.motion
        if motion is None or not np.abs(motion).max() < BEYOND:  # false for NaN too
            return self.model.embed_face(torch.zeros(1, self.model.channels), torch.tensor([False]))
        face = self.model.standardise(torch.from_numpy(self.space.encode(motion[None])))
        return self.model.embed_face(face, torch.tensor([True]))

    def _in_view(self, memory: Memory) -> Tensor:
        """Keys and values of the whole chunks there are; `memory.frames` counts the newest frame."""
        room = memory.context.shape[-2]
        chunks = min((memory.frames - 1) // self.settings.chunk_frames, room)
        return memory.context[..., room - chunks :, :]

    def _sample(self, z: Tensor, random: Tensor) -> tuple[Tensor, Tensor]:
        """z (1, D) -> what the sampler draws (1, C), and the generator's next state."""
        generator = torch.Generator()
        generator.set_state(random)
        noise = torch.randn(1, *self.model.noise_shape, generator=generator)
        head = self.model.head
        motion = head.sample(z, noise, self._levels) if isinstance(head, Denoiser) else head.sample(z, noise)
        return motion, generator.get_state()


def _repeated(x: Tensor, count: int) -> Tensor:
    """(1, D) -> (1, count, D)."""
    return x[:, None].repeat(1, count, 1)


def _push(queue: Tensor, new: Tensor) -> Tensor:
    """(1, S, D) without its oldest row and with `new` (1, D) as its newest."""
    return torch.cat([queue[:, 1:], new[:, None]], dim=1)
