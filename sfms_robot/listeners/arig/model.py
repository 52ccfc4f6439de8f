"""ARIG put together: sounds and motions of two people up to now -> the agent's motion of the next frame, eq. (1).

Frame T of the agent's motion is made from both people's sound and motion of frames 0..T-1 and the agent's own sound of
frame T. Offline everything is parallel over T. For training:

    dyad = Dyad(...)                                    # N aligned frames of both people, in plain units
    losses = model.losses(dyad, states)                 # teacher forcing: frames 1..N-1 are predicted
    (losses.motion.mean() + 0.1 * losses.state.mean()).backward()

`condition` is the part before the sampler, `model.head.sample` the sampler, `generate` both with a given past (what
`stream.ArigListener` computes frame by frame, the law its tests hold). Buffers that training sets from its data:
`motion_mean`, `motion_std`, `sound_mean`, `sound_std`, and of the diffusion head `low`, `high`, the range of what it
draws. Where that is steps (`draws: step`, ours), `step_std` and the range `motion_low`, `motion_high` that motion keeps
to join them; `moved` is what the sampler learns and `drawn` its inverse. Everything that goes in and out here is in
plain units: motion of the listener's motion space, sound features of `sound.track`.

Beyond the paper, too:
 - `draws: innovation`: x_t = rho x_(t-1) + step_std * sinh(spread * drawn), standardised, with the lag-1
   autocorrelation `rho` < 1 of the data. Whatever is drawn wrongly is forgotten at that rate, so a head stays as near
   its mean as in the data however long a stream runs: its place is that of a first-order autoregression, not a sum of
   steps. A face mostly hardly moves and at times moves a hundred times as fast: companded by asinh above `step_std`,
   what moves fast leaves precision to what hardly moves. What was drawn last is told to the sampler beside z: how fast
   the face moves is too fine for the few numbers of z. The mean of what is to be drawn is predicted, and the sampler
   draws what is left: an event that is told shows after few steps of training, whatever the sampler's temperature.
 - `sway: true`: slow motion of the head is made apart (`listeners.idle`) and is in no motion here: what is left of the
   head is what it does, and soon over, so `rho` forgets it within frames. Carried on as slowly as a head sways, what
   was drawn beside a nod left it some degrees off when the nod was over. Of what is left neither its past nor what was
   drawn last is told: told of its own head, a network learned to swing it from one end of its range to the other.
 - `events`: the control rows of the frame and the one before it (`signals.control`) are a token of the fine prediction
   and told to the sampler beside z. Where the eyes look is not drawn: they rest. Innovations are of what is left beside
   the motion b to be expected of the events (`told`): x_t = b_t + rho f_t (x_(t-1) - b_(t-1)) + ..., with f_t < 1 while
   an event moves the channel, so that by its end nothing is left of what was drawn beside it (`told.remains`). A face
   that nothing moves, no event and no word of its own, is held to `rest_range`, how far such faces of the data are off
   b, and beyond that comes back by rho a frame, whatever is drawn: told of its own past, a network holds a raised brow
   up for good.

B batch, N frames, C channels of the motion space, A sound features, D width, K numbers of a control row.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.arig import told
from sfms_robot.listeners.arig.audio_frontend import WIDTHS
from sfms_robot.listeners.arig.modules import LongRange, Merge, Progressive, ShortRange, StateUnderstanding
from sfms_robot.listeners.arig.parts import Linear, weighted_mean, windows
from sfms_robot.listeners.arig.sampler import CodeHead, Denoiser
from sfms_robot.listeners.arig.sojourns import CONTROL_ROWS, FIRST
from sfms_robot.listeners.idle import BANDS, head_channels
from sfms_robot.signals import phase
from sfms_robot.signals.control import COLUMNS

MEAN_WIDTH = 256
UNBOUNDED = 1e3  # deviations
MEAN_DELTA = 4.0  # deviations beyond which an error of the mean counts linearly: above, hardly any event is told


@dataclass(frozen=True)
class Dyad:
    """N aligned frames of a conversation; frame t of every array is the same 40 ms.

    Attributes:
        user_sound, agent_sound: (B, N, A) features of `sound.track`; anything where not heard.
        user_heard, agent_heard: (B, N) bool.
        user_motion: (B, N, C) motion of the listener's space; anything where not seen.
        user_seen: (B, N) bool.
        agent_motion: (B, N, C), without its sway where that is apart.
        voiced: (B, N, 2) bool: speech of agent, user.
        control: (B, N, K) of the agent's events; any for a model without.
    """

    user_sound: Tensor
    user_heard: Tensor
    agent_sound: Tensor
    agent_heard: Tensor
    user_motion: Tensor
    user_seen: Tensor
    agent_motion: Tensor
    voiced: Tensor
    control: Tensor | None = None

    def check(self, sound: int, channels: int, events: bool = False) -> None:
        """Raise ValueError, naming the array, when one has another shape or there are fewer than two frames."""
        b, n = self.agent_motion.shape[:2]
        wanted = {
            "user_sound": (b, n, sound), "agent_sound": (b, n, sound), "user_heard": (b, n), "agent_heard": (b, n),
            "user_motion": (b, n, channels), "agent_motion": (b, n, channels), "user_seen": (b, n), "voiced": (b, n, 2),
        }  # fmt: skip
        for name, shape in wanted.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"{name} is {found}, not {shape}")
        rows = None if self.control is None else tuple(self.control.shape)
        if events and rows != (b, n, len(COLUMNS)):
            raise ValueError(f"control is {rows}, not {(b, n, len(COLUMNS))}")
        if n < 2:
            raise ValueError(f"a dyad needs two frames or more, got {n}")


@dataclass(frozen=True)
class Condition:
    """What the sampler is told of frames 1..N-1.

    Attributes:
        z: (B, N-1, D), and beside it what the sampler is told besides.
        states: the states' logits (B, N-1, S) or None.
        outline: (B, N-1, D) coarse motion.
        moved: (B, N-1, C) `ArigModel.moved` of the frame before.
    """

    z: Tensor
    states: Tensor | None
    outline: Tensor
    moved: Tensor


@dataclass(frozen=True)
class Losses:
    """Of frames 1..N-1, (B, N-1) each: equation (3), or the codes' loss; cross-entropy of the states or None."""

    motion: Tensor
    state: Tensor | None


class ArigModel(nn.Module):
    """Weights of one listener, with the scales of its motion and sound."""

    motion_mean: Tensor
    motion_std: Tensor
    motion_low: Tensor
    motion_high: Tensor
    step_std: Tensor
    rho: Tensor
    spread: Tensor
    told: Tensor
    moves: Tensor
    rest_range: Tensor
    sway_mixture: Tensor
    sway_spread: Tensor
    is_drawn: Tensor
    is_recalled: Tensor
    sound_mean: Tensor
    sound_std: Tensor

    def __init__(self, settings: config.Arig) -> None:
        super().__init__()
        d, hidden, heads = settings.width, settings.feedforward, settings.heads
        self.settings = settings
        self.channels, self.sound_width = len(settings.channels), WIDTHS[settings.sound]
        self.register_buffer("motion_mean", torch.zeros(self.channels))
        self.register_buffer("motion_std", torch.ones(self.channels))
        self.register_buffer("motion_low", torch.full((self.channels,), -8.0))
        self.register_buffer("motion_high", torch.full((self.channels,), 8.0))
        self.register_buffer("step_std", torch.ones(self.channels))
        self.is_told = settings.events and settings.draws == "innovation"
        if settings.draws == "innovation":
            self.register_buffer("rho", torch.zeros(self.channels))
            self.register_buffer("spread", torch.ones(self.channels))
            if self.is_told:
                self.register_buffer("told", torch.zeros(told.FEATURES, self.channels))
                self.register_buffer("moves", told.moves(settings.channels), persistent=False)
                self.register_buffer("rest_range", torch.full((self.channels,), UNBOUNDED))
        is_drawn = torch.tensor([name in settings.drawn_channels for name in settings.channels])
        self.register_buffer("is_drawn", is_drawn, persistent=False)
        is_recalled = torch.ones(self.channels, dtype=torch.bool)
        if settings.sway:
            head = head_channels(settings.channels)
            is_recalled[head] = False
            self.register_buffer("sway_mixture", torch.zeros(BANDS, len(head), len(head)))
            self.register_buffer("sway_spread", torch.zeros(()))
        self.register_buffer("is_recalled", is_recalled, persistent=False)
        self.register_buffer("sound_mean", torch.zeros(self.sound_width))
        self.register_buffer("sound_std", torch.ones(self.sound_width))
        self.sounds_read = self.sound_width - (0 if settings.phase else phase.FEATURES)  # the place in a phrase is last
        self.sound_in = nn.Sequential(Linear(self.sounds_read, d), nn.GELU(), Linear(d, d))
        self.motion_in = Linear(self.channels, d)
        self.no_user_sound = nn.Parameter(torch.randn(d) * 0.02)
        self.no_agent_sound = nn.Parameter(torch.randn(d) * 0.02)
        self.no_face = nn.Parameter(torch.randn(d) * 0.02) if settings.visual else None
        self.merge_agent = Merge(d, settings.visual)
        self.merge_user = Merge(d, settings.visual)
        depths = (settings.bidirectional_layers, settings.integrated_layers)
        linear = settings.interaction == "linear"
        self.short = ShortRange(d, hidden, heads, settings.chunk_frames, depths, linear)
        self.long = LongRange(d, hidden, heads, settings.context_layers, settings.chunk_frames, settings.context_chunks)
        guided, events = settings.state_guidance, settings.events
        self.states = StateUnderstanding(d, hidden, heads, events) if guided else None
        self.progress = Progressive(d, hidden, heads, settings.sound_frames, settings.motion_frames, guided, events)
        self.events_in = (
            nn.Sequential(Linear(CONTROL_ROWS * len(COLUMNS), d), nn.GELU(), Linear(d, d)) if events else None
        )
        condition = d + d * events + self.channels * (settings.draws == "innovation")
        self.head: Denoiser | CodeHead = (
            CodeHead(self.channels, d, condition, settings.code_levels)
            if settings.discrete
            else Denoiser(settings.channels, condition, settings.diffusion)
        )
        self.mean = (
            nn.Sequential(Linear(condition, MEAN_WIDTH), nn.GELU(), Linear(MEAN_WIDTH, self.channels))
            if settings.draws == "innovation"
            else None
        )

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Standard normal numbers that one frame takes: (steps, channels)."""
        return (1, 1) if self.settings.discrete else (self.settings.diffusion.steps, self.channels)

    def standardise(self, motion: Tensor) -> Tensor:
        """Motion (..., C) of the motion space -> the units the model works in."""
        return (motion - self.motion_mean) / self.motion_std

    def restore(self, motion: Tensor) -> Tensor:
        """The inverse of `standardise`."""
        return motion * self.motion_std + self.motion_mean

    def moved(self, motion: Tensor, last: Tensor, rows: Tensor | None = None) -> Tensor:
        """The step to motion (..., C) after `last` (..., C), both standardised, as the sampler draws steps: (..., C).

        `rows` (..., 2K): control of both frames.
        """
        if self.settings.draws == "motion":
            return motion
        step = (motion - self.expected(last, rows)) / self.step_std
        return self.companded(step) if self.settings.draws == "innovation" else step

    def drawn(self, sample: Tensor, last: Tensor, rows: Tensor | None = None, speaks: Tensor | None = None) -> Tensor:
        """The inverse of `moved`; a step never leads out of the range of the motion, and what is not drawn rests.

        `speaks` (...) bool, the agent in this frame; None: it may.
        """
        if self.settings.draws == "motion":
            return self._at_rest(sample)
        step = self.expanded(sample) if self.settings.draws == "innovation" else sample
        begins = self.expected(last, rows)
        made = torch.addcmul(begins, step, self.step_std)
        if self.is_told and rows is not None and speaks is not None:
            made = self._held(made, begins, rows.chunk(2, dim=-1)[1], speaks)
        return self._at_rest(made.clamp(self.motion_low, self.motion_high))

    def _held(self, made: Tensor, begins: Tensor, row: Tensor, speaks: Tensor) -> Tensor:
        """Motion (..., C) that would begin at `begins`, where nothing moves the face not beyond where faces rest."""
        course = told.features(row) @ self.told
        free = speaks[..., None] | told.moved_channels(row, self.moves)
        most = torch.where(free, UNBOUNDED, torch.maximum(self.rest_range, (begins - course).abs()))
        return course + torch.minimum(torch.maximum(made - course, -most), most)

    def companded(self, step: Tensor) -> Tensor:
        """Steps (..., C), in `step_std`, as they are drawn."""
        return step.asinh() / self.spread

    def expanded(self, drawn: Tensor) -> Tensor:
        """The inverse of `companded`."""
        return (drawn * self.spread).sinh()

    def _at_rest(self, motion: Tensor) -> Tensor:
        """Standardised motion (..., C) with what is not drawn at its mean, which is 0."""
        return motion.where(self.is_drawn, 0.0) if self.settings.events else motion

    def expected(self, last: Tensor, rows: Tensor | None = None) -> Tensor:
        """Where a step after `last` (..., C), standardised, begins: there, or a little on its way back to the mean.

        With events, to what is told of the frame, from what was told of the last: `rows` (..., 2K).
        """
        if self.settings.draws != "innovation":
            return last
        if not self.is_told or rows is None:
            return self.rho * last
        before, now = rows.chunk(2, dim=-1)
        off = last - told.features(before) @ self.told
        return told.features(now) @ self.told + self.rho * told.remains(before, now, self.moves) * off

    def sample(self, z: Tensor, noise: Tensor, levels: Tensor | None = None) -> Tensor:
        """Of the sampler (N, C), the mean included: z (N, D and beside it), noise and levels of `Denoiser.sample`.

        What is left beside the mean has the sampler's range, and so has the sum: nothing moves faster than in the data.
        """
        if not isinstance(self.head, Denoiser):
            return self.head.sample(z, noise)
        drawn = self.head.sample(z, noise, levels)
        return drawn if self.mean is None else (drawn + self.mean(z)).clamp(self.head.low, self.head.high)

    def sample_loss(
        self,
        z: Tensor,
        wanted: Tensor,
        draws: int = 1,
        generator: torch.Generator | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Equation (3) at `draws` noise levels, or the loss of codes, and that of the mean, (N,).

        `wanted` (N, C): `moved` of the frame.
        """
        mean = torch.zeros_like(wanted) if self.mean is None else self.mean(z)
        left, z = (each.repeat(draws, 1) for each in (wanted - mean.detach(), z))
        drawn = self.head.loss(z, left, generator, weights).view(draws, -1).mean(0)
        return (
            drawn
            if self.mean is None
            else drawn + weighted_mean(F.huber_loss(mean, wanted, reduction="none", delta=MEAN_DELTA), weights)
        )

    def beside(self, z: Tensor, events: Tensor | None, moved: Tensor) -> Tensor:
        """z (..., D) and what the sampler is told besides: embedded events (..., D), the last step (..., C)."""
        told = [z] if events is None else [z, events]
        if self.settings.draws == "innovation":
            told.append(moved.where(self.is_recalled, 0.0))
        return torch.cat(told, dim=-1) if len(told) > 1 else z

    def embed_events(self, rows: Tensor) -> Tensor | None:
        """Control rows of the frame before and the frame (..., 2K) -> (..., D), or None without events."""
        return None if self.events_in is None else self.events_in(rows)

    def embed_sound(self, sound: Tensor, heard: Tensor, absent: Tensor) -> Tensor:
        """Features (..., A), heard (...) bool, embedding (D,) or (..., D) of what is not heard -> (..., D)."""
        standard = (sound - self.sound_mean) / self.sound_std
        out: Tensor = self.sound_in(standard[..., : self.sounds_read])
        return torch.where(heard[..., None], out, absent)

    def embed_motion(self, motion: Tensor) -> Tensor:
        """Standardised motion (..., C) -> (..., D)."""
        out: Tensor = self.motion_in(motion)
        return out

    def embed_own(self, motion: Tensor) -> Tensor:
        """`embed_motion` of the agent, of whose past the head may be none of the network's business."""
        return self.embed_motion(motion.where(self.is_recalled, 0.0))

    def embed_face(self, motion: Tensor, seen: Tensor) -> Tensor:
        """Standardised motion (..., C) of the user, seen (...) bool -> (..., D)."""
        embedded = self.embed_motion(motion)
        return embedded if self.no_face is None else torch.where(seen[..., None], embedded, self.no_face)

    def condition(self, dyad: Dyad, states: Tensor | None = None) -> Condition:
        """Everything before the sampler, for frames 1..N-1 at once.

        `states` (B, N): the state of every frame, of which each frame is told the one before. Without, each frame goes
        on from the model's own answer, as a stream does. Raises ValueError for shapes that do not fit.
        """
        dyad.check(self.sound_width, self.channels, self.settings.events)
        user = self.embed_sound(dyad.user_sound, dyad.user_heard, self.no_user_sound)[:, :-1]
        agent = self.embed_sound(dyad.agent_sound, dyad.agent_heard, self.no_agent_sound)
        standard = self.standardise(dyad.agent_motion)[:, :-1]
        motion = self.embed_own(standard)
        face = self.embed_face(self.standardise(dyad.user_motion), dyad.user_seen)[:, :-1]
        b, t, d = motion.shape  # frame t of what follows is made from frames 0..t and makes frame t + 1
        c = self.settings.chunk_frames
        now = agent[:, 1:].reshape(b * t, d)
        summaries = self.short(
            windows(self.merge_agent(agent[:, :-1], motion), c).reshape(b * t, c, d),
            windows(self.merge_user(user, face), c).reshape(b * t, c, d),
            now,
            user.reshape(b * t, d),
        )
        cis = self.long(summaries.view(b, t, d)).reshape(b * t, d)
        voiced = torch.stack([dyad.voiced[:, 1:, 0], dyad.voiced[:, :-1, 1]], dim=-1)
        feature, logits = self._states(cis, voiced, states)
        rows = self.rows(dyad)
        events = None if rows is None else self.embed_events(rows)
        outline = self.progress.coarse(
            motion.reshape(b * t, d),
            windows(self.progress.coarse.keys(agent), self.settings.sound_frames)[:, 1:].flatten(0, 1),
        )
        z = self.progress.refine(
            outline,
            windows(self.progress.temporal.keys(motion), self.settings.motion_frames).flatten(0, 1),
            now,
            cis,
            feature,
            None if events is None else events.flatten(0, 1),
        )
        moved = self.moved(standard[:, 1:], standard[:, :-1], None if rows is None else rows[:, :-1])
        moved = torch.cat([torch.zeros_like(standard[:, :1]), moved], dim=1)
        return Condition(self.beside(z.view(b, t, d), events, moved), logits, outline.view(b, t, d), moved)

    def rows(self, dyad: Dyad) -> Tensor | None:
        """Control (B, N - 1, 2K) of the frames before and of frames 1..N-1, or None without events."""
        if dyad.control is None or not self.settings.events:
            return None
        return torch.cat([dyad.control[:, :-1], dyad.control[:, 1:]], dim=-1)

    def _states(self, cis: Tensor, voiced: Tensor, states: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """cis (B * T, D), voiced (B, T, 2) -> features (B * T, D), logits (B, T, S)."""
        if self.states is None:
            return None, None
        b, t = voiced.shape[:2]
        keys = self.states.condition(cis, voiced.reshape(b * t, 2))
        if states is None:
            first = torch.full((b,), FIRST, device=cis.device)
            features, logits = self.states.roll(keys.view(b, t, *keys.shape[1:]), first)
            return features.flatten(0, 1), logits
        feature, scores = self.states(keys, states[:, :-1].reshape(b * t))
        return feature, scores.view(b, t, -1)

    def losses(self, dyad: Dyad, states: Tensor | None = None, generator: torch.Generator | None = None) -> Losses:
        """Losses of frames 1..N-1, every one told the true past.

        `states` (B, N) int64, -1 where not labelled: such a frame has no state loss (0) and, as the previous state,
        counts as `waiting`.
        """
        known = None if states is None else torch.where(states < 0, FIRST, states)
        found = self.condition(dyad, known)
        standard = self.standardise(dyad.agent_motion)
        wanted = self.moved(standard[:, 1:], standard[:, :-1], self.rows(dyad))
        motion = self.sample_loss(found.z.flatten(0, 1), wanted.flatten(0, 1), generator=generator)
        motion = motion.view(wanted.shape[:2])
        if found.states is None or states is None:
            return Losses(motion, None)
        wrong = F.cross_entropy(found.states.transpose(1, 2), states[:, 1:], ignore_index=-1, reduction="none")
        return Losses(motion, wrong)

    def generate(self, dyad: Dyad, noise: Tensor, states: Tensor | None = None) -> Tensor:
        """Motion (B, N-1, C) of frames 1..N-1 from the given past, noise (B, N-1, *noise_shape); states: above."""
        found = self.condition(dyad, states)
        made = self.sample(found.z.flatten(0, 1), noise.flatten(0, 1)).view(found.moved.shape)
        last = self.standardise(dyad.agent_motion[:, :-1])
        return self.restore(self.drawn(made, last, self.rows(dyad), dyad.voiced[:, 1:, 0]))
