"""What a stream computes of one frame, as two functions of tensors: `Frame` up to the sampler, `Draw` from there on.

Offline the same parts run over all frames at once (`model.condition`, `model.generate`); that both agree is a law of
the tests. As functions of tensors alone they can become graphs (`graphs`).

A features of sound, C channels, D width, c frames of a chunk, S whole chunks in view.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.listeners.arig.diffusion import Denoiser
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.parts import Part


class Frame(Part):
    """Sounds and face of one frame, and what the stream remembers -> what the sampler is told of the next."""

    def __init__(self, model: ArigModel) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        sounds: Tensor,
        heard: Tensor,
        voiced: Tensor,
        face: Tensor,
        seen: Tensor,
        first: Tensor,
        state: Tensor,
        rotary: Tensor,
        past: Tensor,
        agent_sound: Tensor,
        agent_behaviour: Tensor,
        user_behaviour: Tensor,
        sound_keys: Tensor,
        motion: Tensor,
        motion_keys: Tensor,
    ) -> tuple[Tensor, ...]:
        """One frame.

        Args:
            sounds: (2, A) of user and agent; heard: (2,) bool, which of them are there.
            voiced: (1, 2) bool, speech of agent, user.
            face: (1, C) standardised motion of the user; seen: (1,) bool.
            first: () bool, of the stream: chunks begin as its behaviour repeated (A.2).
            state: (1,) conversational state of the frame before.
            rotary, past: place and keys of `LongRange.step`.
            agent_sound, ...: of `stream.Memory`.

        Returns:
            z (1, D), logits of the state (1, 7), empty without states, keys and values of the chunk in progress, and
            the next agent_sound, agent_behaviour, user_behaviour and sound_keys.
        """
        model = self.model
        absent = torch.stack([model.no_user_sound, model.no_agent_sound])
        embedded = model.embed_sound(sounds, heard, absent)
        user_sound, now = embedded[:1], embedded[1:].clone()  # memory holds no more than it needs
        agent_behaviour = _after(agent_behaviour, model.merge_agent(agent_sound, motion), first)
        user_behaviour = _after(user_behaviour, model.merge_user(user_sound, model.embed_face(face, seen)), first)
        sound_keys = push(sound_keys, model.progress.coarse.keys(now))
        summary = model.short(agent_behaviour, user_behaviour, now, user_sound)
        cis, made = model.long.step(summary, past, rotary)
        feature, logits = None, cis[:, :0]
        if model.states is not None:
            feature, logits = model.states(model.states.condition(cis, voiced), state)
        z = model.progress(motion, sound_keys, motion_keys, now, cis, feature)
        return z, logits, made, now, agent_behaviour, user_behaviour, sound_keys


class Draw(Part):
    """What the sampler is told and its noise -> the agent's motion, and what the stream remembers of it."""

    levels: Tensor | None

    def __init__(self, model: ArigModel) -> None:
        super().__init__()
        self.model = model
        head = model.head
        with torch.no_grad():  # the noise levels are always the same
            levels = head.level(torch.tensor(head.levels)) if isinstance(head, Denoiser) else None
        self.register_buffer("levels", levels, persistent=False)

    def forward(self, z: Tensor, noise: Tensor, standard: Tensor, motion_keys: Tensor) -> tuple[Tensor, ...]:
        """One frame.

        Args:
            z: (1, D); noise: (1, *model.noise_shape).
            standard: (1, C) standardised motion of the frame before; motion_keys: of `stream.Memory`.

        Returns:
            Motion (1, C) in plain units, the same standardised (1, C) and embedded (1, D), and the next motion_keys.
        """
        model, head = self.model, self.model.head
        sample = head.sample(z, noise, self.levels) if isinstance(head, Denoiser) else head.sample(z, noise)
        standard = model.drawn(sample, standard)
        motion = model.embed_motion(standard)
        keys = push(motion_keys, model.progress.temporal.keys(motion))
        return model.restore(standard), standard, motion, keys


def repeated(x: Tensor, count: int) -> Tensor:
    """(1, D) -> (1, count, D)."""
    return x[:, None].repeat(1, count, 1)


def push(queue: Tensor, new: Tensor) -> Tensor:
    """(1, S, D) without its oldest row and with `new` (1, D) as its newest."""
    return torch.cat([queue[:, 1:], new[:, None]], dim=1)


def _after(queue: Tensor, new: Tensor, first: Tensor) -> Tensor:
    """(1, S, D) with `new` (1, D) as its newest, or all of it new."""
    return torch.where(first, new[:, None], push(queue, new))
