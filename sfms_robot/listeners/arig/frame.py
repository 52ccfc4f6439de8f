"""What a stream computes of one frame, as two functions of tensors: `Frame` up to the sampler, `Draw` from there on.

Offline the same parts run over all frames at once (`model.condition`, `model.generate`); that both agree is a law of
the tests. As functions of tensors alone they can become graphs (`graphs`).

N streams of one speaker, mostly one; A features of sound, C channels, D width, K numbers of a control row, c frames of
a chunk, S whole chunks in view.
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
        sample: Tensor,
        rows: Tensor,
    ) -> tuple[Tensor, ...]:
        """One frame.

        Args:
            sounds: (2, A) of user and agent; heard: (2,) bool, which of them are there.
            voiced: (1, 2) bool, speech of agent, user.
            face: (1, C) standardised motion of the user; seen: (1,) bool.
            first: () bool, of the stream: chunks begin as its behaviour repeated (A.2).
            state: (N,) conversational state of the frame before.
            rotary, past: place and keys of `LongRange.step`.
            agent_sound, ...: of `stream.Memory`, of N streams.
            rows: (N, 2K) control of the frame before and of the frame to be made; anything without events.

        Returns:
            z (N, D) and what the sampler is told beside it, logits of the state (N, 7 or 9), empty without states, keys
            and values of the chunk in progress, and the next agent_sound, agent_behaviour, user_behaviour and
            sound_keys.
        """
        model, n = self.model, motion.shape[0]
        absent = torch.stack([model.no_user_sound, model.no_agent_sound])
        embedded = model.embed_sound(sounds, heard, absent)
        # Streams hear the same; memory holds no more than it needs.
        user_sound, now = embedded[:1].expand(n, -1), embedded[1:].repeat(n, 1)
        face, voiced = model.embed_face(face, seen).expand(n, -1), voiced.expand(n, -1)
        agent_behaviour = _after(agent_behaviour, model.merge_agent(agent_sound, motion), first)
        user_behaviour = _after(user_behaviour, model.merge_user(user_sound, face), first)
        sound_keys = push(sound_keys, model.progress.coarse.keys(now))
        summary = model.short(agent_behaviour, user_behaviour, now, user_sound)
        cis, made = model.long.step(summary, past, rotary)
        feature, logits = None, cis[:, :0]
        if model.states is not None:
            feature, logits = model.states(model.states.condition(cis, voiced), state)
        events = model.embed_events(rows)
        z = model.beside(model.progress(motion, sound_keys, motion_keys, now, cis, feature, events), events, sample)
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
            z: of `Frame`; noise: (N, *model.noise_shape).
            standard: (N, C) standardised motion of the frame before; motion_keys: of `stream.Memory`.

        Returns:
            Motion (N, C) in plain units, the same standardised (N, C), as what the sampler drew (N, C), and embedded
            (N, D), and the next motion_keys.
        """
        model = self.model
        made = model.drawn(model.sample(z, noise, self.levels), standard)
        motion = model.embed_motion(made)
        keys = push(motion_keys, model.progress.temporal.keys(motion))
        return model.restore(made), made, model.target(made, standard), motion, keys


def repeated(x: Tensor, count: int) -> Tensor:
    """(1, D) -> (1, count, D)."""
    return x[:, None].repeat(1, count, 1)


def push(queue: Tensor, new: Tensor) -> Tensor:
    """(N, S, D) without its oldest row and with `new` (N, D) as its newest."""
    return torch.cat([queue[:, 1:], new[:, None]], dim=1)


def _after(queue: Tensor, new: Tensor, first: Tensor) -> Tensor:
    """(N, S, D) with `new` (N, D) as its newest, or all of it new."""
    return torch.where(first, new[:, None], push(queue, new))
