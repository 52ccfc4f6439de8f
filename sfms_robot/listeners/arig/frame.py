"""What a stream computes of one frame, as two functions of tensors: `Frame` up to the sampler, `Draw` from there on.

Offline the same parts run over all frames at once (`model.condition`, `model.generate`); that both agree is a law of
the tests. As functions of tensors alone they can become graphs, or be exported. `Rest` is what a stream remembers
before its first frame.

N streams, mostly one; A features of sound, C channels, D width, K numbers of a control row, c frames of a chunk, S
whole chunks that are remembered, L layers that look at them.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.listeners.arig.audio_frontend import WIDTHS
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.parts import Part
from sfms_robot.listeners.arig.sampler import Denoiser
from sfms_robot.listeners.arig.sojourns import CONTROL_ROWS
from sfms_robot.signals.control import COLUMNS


class Rest(Part):
    """A still face and silence, as a stream remembers them: asked once, when a listener is loaded."""

    def __init__(self, model: ArigModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, still: Tensor) -> tuple[Tensor, ...]:
        """still (1, C) standardised -> embedded motion and silence (1, D), and the keys of each (1, 2D)."""
        progress, motion, silence = self.model.progress, self.model.embed_own(still), self.model.no_agent_sound[None]
        return motion, silence + 0.0, progress.temporal.keys(motion), progress.coarse.keys(silence)


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
        view: Tensor,
        agent_sound: Tensor,
        agent_behaviour: Tensor,
        user_behaviour: Tensor,
        sound_keys: Tensor,
        motion: Tensor,
        motion_keys: Tensor,
        sample: Tensor,
        rows: Tensor,
        *past: Tensor,
    ) -> tuple[Tensor, ...]:
        """One frame.

        Args:
            sounds: (N, 2, A) of user and agent; heard: (N, 2) bool, which of them are there.
            voiced: (N, 2) bool, speech of agent, user.
            face: (N, C) standardised motion of the user; seen: (N,) bool.
            first: (N,) bool, of the stream: chunks begin as its behaviour repeated (A.2).
            state: (N,) conversational state of the frame before.
            rotary, view, past: place, chunks that there have been, and keys and values of `LongRange.step`.
            agent_sound, ...: of `stream.Memory`.
            rows: (N, 2K) control of the frame before and of the frame to be made; anything without events.

        Returns:
            z (N, D) and what the sampler is told beside it, logits of the state (N, 7 or 9), empty without states, keys
            and values of the chunk in progress, and the next agent_sound, agent_behaviour, user_behaviour and
            sound_keys.
        """
        model = self.model
        absent = torch.stack([model.no_user_sound, model.no_agent_sound])
        embedded = model.embed_sound(sounds, heard, absent)
        user_sound, now = embedded[:, 0], embedded[:, 1]
        face = model.embed_face(face, seen)
        agent_behaviour = _after(agent_behaviour, model.merge_agent(agent_sound, motion), first)
        user_behaviour = _after(user_behaviour, model.merge_user(user_sound, face), first)
        sound_keys = push(sound_keys, model.progress.coarse.keys(now))
        summary = model.short(agent_behaviour, user_behaviour, now, user_sound)
        cis, made = model.long.step(summary, past, view, rotary)
        feature, logits = None, cis[:, :0]
        if model.states is not None:
            feature, logits = model.states(model.states.condition(cis, voiced), state)
        events = model.embed_events(rows)
        z = model.beside(model.progress(motion, sound_keys, motion_keys, now, cis, feature, events), events, sample)
        return z, logits, made, now, agent_behaviour, user_behaviour, sound_keys


class Draw(Part):
    """What the sampler is told and its noise -> the agent's motion, and what the stream remembers of it."""

    levels: Tensor | None
    places: Tensor | None

    def __init__(self, model: ArigModel, kept: bool = True) -> None:
        """`kept`: the noise levels, which are always the same, are embedded once; else in every frame, by weights that
        may be others.
        """
        super().__init__()
        self.model = model
        head, levels, places = model.head, None, None
        if isinstance(head, Denoiser):
            places = head.places[head.levels]
            with torch.no_grad():
                levels = head.time(places) if kept else None
        self.register_buffer("levels", levels, persistent=False)
        self.register_buffer("places", places, persistent=False)

    def forward(
        self,
        z: Tensor,
        noise: Tensor,
        standard: Tensor,
        motion_keys: Tensor,
        rows: Tensor | None = None,
        speaks: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """One frame.

        Args:
            z: of `Frame`; noise: (N, *model.noise_shape).
            standard: (N, C) standardised motion of the frame before; motion_keys: of `stream.Memory`.
            rows: (N, 2K) of `Frame`, of a listener with events; speaks: (N,) bool, the agent, likewise.

        Returns:
            Motion (N, C) in plain units, the same standardised (N, C), `model.moved` (N, C), embedded (N, D), and the
            next motion_keys.
        """
        model = self.model
        levels = self.levels
        if levels is None and self.places is not None and isinstance(model.head, Denoiser):
            levels = model.head.time(self.places)
        made = model.drawn(model.sample(z, noise, levels), standard, rows, speaks)
        motion = model.embed_own(made)
        keys = push(motion_keys, model.progress.temporal.keys(motion))
        return model.restore(made), made, model.moved(made, standard, rows), motion, keys


def networks(model: ArigModel, kept: bool = True) -> dict[str, Part]:
    """All of them, by name. `kept`: see `Draw`."""
    return {"rest": Rest(model), "frame": Frame(model), "draw": Draw(model, kept)}


def examples(settings: config.Arig, streams: int) -> Mapping[str, dict[str, Tensor]]:
    """Inputs of every network by its name and theirs, of as many streams."""
    n, d, h, chunk, channels = streams, settings.width, settings.heads, settings.chunk_frames, len(settings.channels)
    room = settings.context_chunks - 1
    told = d + d * settings.events + channels * (settings.draws == "innovation")
    motion_keys = torch.zeros(n, settings.motion_frames, 2 * d)
    names = [f"{part}_{layer}" for layer in range(settings.context_layers) for part in ("keys", "values")]
    frame = {
        "sounds": torch.zeros(n, 2, WIDTHS[settings.sound]),
        "heard": torch.ones(n, 2, dtype=torch.bool),
        "voiced": torch.zeros(n, 2, dtype=torch.bool),
        "face": torch.zeros(n, channels),
        "seen": torch.ones(n, dtype=torch.bool),
        "first": torch.zeros(n, dtype=torch.bool),
        "state": torch.zeros(n, dtype=torch.long),
        "rotary": torch.zeros(n, 2, d // h),
        "view": torch.ones(n, room, dtype=torch.bool),
        "agent_sound": torch.zeros(n, d),
        "agent_behaviour": torch.zeros(n, chunk, d),
        "user_behaviour": torch.zeros(n, chunk, d),
        "sound_keys": torch.zeros(n, settings.sound_frames, 2 * d),
        "motion": torch.zeros(n, d),
        "motion_keys": motion_keys,
        "sample": torch.zeros(n, channels),
        "rows": torch.zeros(n, CONTROL_ROWS * len(COLUMNS) * settings.events),
        **{name: torch.zeros(n, h, room, d // h) for name in names},
    }
    noise = (1, 1) if settings.discrete else (settings.diffusion.steps, channels)
    draw = {
        "z": torch.zeros(n, told),
        "noise": torch.zeros(n, *noise),
        "standard": torch.zeros(n, channels),
        "motion_keys": motion_keys.clone(),
    }
    if settings.events:
        draw["rows"] = torch.zeros(n, CONTROL_ROWS * len(COLUMNS))
        draw["speaks"] = torch.zeros(n, dtype=torch.bool)
    return {"rest": {"still": torch.zeros(1, channels)}, "frame": frame, "draw": draw}


def push(queue: Tensor, new: Tensor) -> Tensor:
    """(N, S, D) without its oldest row and with `new` (N, D) as its newest."""
    return torch.cat([queue[:, 1:], new[:, None]], dim=1)


def _after(queue: Tensor, new: Tensor, first: Tensor) -> Tensor:
    """(N, S, D) with `new` (N, D) as its newest, or all of it new."""
    return torch.where(first[:, None, None], new[:, None], push(queue, new))
