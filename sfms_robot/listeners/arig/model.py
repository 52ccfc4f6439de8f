"""ARIG put together: sounds and motions of two people up to now -> the agent's motion of the next frame, eq. (1).

Frame T of the agent's motion is made from both people's sound and motion of frames 0..T-1 and the agent's own sound of
frame T. Offline everything is parallel over T (teacher forcing):

    dyad = ArigDyad(...)                          # N aligned frames of both people, in plain units
    found = model.condition(dyad, states)     # of frames 1..N-1: z, logits of the states, coarse motion
    motion = model.sample_loss(found.z.flatten(0, 1), model.moved(...).flatten(0, 1))

`condition` is the part before the sampler, `sample` the sampler; `stream.ArigListener` computes both frame by frame,
with the same results (a law of the tests). Buffers that training sets from its data: `motion_mean`, `motion_std`,
`sound_mean`, `sound_std`, and of the diffusion head `low`, `high`, the range of its draws. All inputs and outputs here
are in plain units: motion of the listener's motion space, sound features of `audio_frontend.track`.

Sections of the paper and the files of this folder that follow them:

    3.1, (1), (2)   what a frame is made from            model.py; streaming: stream.py
    3.2             interactive behaviour understanding  modules.py, ShortRange and LongRange
    3.3             conversational states                modules.py, StateUnderstanding
    3.4             progressive motion prediction        modules.py, Progressive
    3.4, (3), (4)   diffusion head                       sampler.py
    ours            curves of events                     event_curves.py
    ours            networks of a stream, 8-bit layers   networks.py

B batch, N frames, C channels of the motion space, A sound features, D width, K numbers of a control row.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.arig import event_curves
from sfms_robot.listeners.arig.modules import LongRange, Merge, Progressive, ShortRange, StateUnderstanding
from sfms_robot.listeners.arig.sampler import CodeHead, Denoiser
from sfms_robot.listeners.arig.stream import CONTROL_ROWS
from sfms_robot.listeners.audio_frontend import WIDTHS
from sfms_robot.listeners.layers import ListenerModel, mlp, weighted_mean, windows
from sfms_robot.signals import phase
from sfms_robot.signals.control import COLUMNS

MEAN_WIDTH = 256
UNBOUNDED = 1e3  # deviations
MEAN_DELTA = 4.0  # deviations beyond which an error of the mean counts linearly: hardly any event reaches further

# --- What the sampler draws -------------------------------------------------------------------------------------------
#
# In the paper the sampler draws the motion of a frame, equation (4) (`draws: motion`). The others are ours, because a
# stream that draws motion from its own past becomes restless or drifts. x_t is standardised motion, s the draw of a
# frame:
#
#     draws        x_t =                                          s = `moved`
#     motion       s                                              x_t
#     step         x_(t-1) + step_std s                           (x_t - x_(t-1)) / step_std
#     innovation   rho x_(t-1) + step_std sinh(spread s)          asinh((x_t - rho x_(t-1)) / step_std) / spread
#
# - `step` is small where a face is still, and so are errors of the sampler; but errors add up.
# - `innovation` is a first-order autoregression, rho < 1 the lag-1 autocorrelation of the data: errors decay at that
#   rate, so a head stays as near its mean as in the data, however long a stream runs. A face mostly hardly moves and at
#   times moves a hundred times as fast: asinh above `step_std` compresses fast motion and leaves precision to slow
#   motion. The last draw is an input of the sampler in addition to z, because the speed of the face is too fine for the
#   few numbers of z. The mean of s is predicted (`mean`), and the sampler draws the rest: an event shows after few
#   steps of training, whatever the sampler's temperature.
# - `events`: control rows of the frame and of the one before it (`signals.control`) are a token of the fine prediction
#   and an input of the sampler. The direction of the eyes is not drawn: it stays at rest. Innovations are around the
#   motion b expected of the events (`event_curves`),
#
#         x_t = b_t + rho f_t (x_(t-1) - b_(t-1)) + step_std sinh(spread s),
#
#   with f_t < 1 while an event moves the channel (`event_curves.remains`), so that by its end nothing is left of other
#   motion. A face that neither an event nor its own speech moves is held within `rest_range` of b, the distance of such
#   faces in the data. Beyond that it comes back by rho per frame, whatever is drawn: otherwise a network that sees its
#   own past holds a raised brow up forever.
# - `sway`: slow motion of the head is made separately (`listeners.idle`) and is not part of any motion here. The rest
#   of the head's motion is short, so it decays by `rho` within frames. Its past and its last draw are not inputs of the
#   network (`is_recalled`): with them, it learned to swing the head from one end of its range to the other.


@dataclass(frozen=True, kw_only=True)
class ArigDyad:
    """N aligned frames of a conversation; frame t of every array is the same 40 ms.

    Attributes:
        user_sound, agent_sound: (B, N, A) features of `audio_frontend.track`; arbitrary where not heard.
        user_heard, agent_heard: (B, N) bool.
        user_motion: (B, N, C) motion of the listener's space; arbitrary where not seen.
        user_seen: (B, N) bool.
        agent_motion: (B, N, C), without its sway if that is made separately.
        voiced: (B, N, 2) bool: speech of agent, user.
        control: (B, N, K) control rows of the agent's events; arbitrary for a model without events.
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


@dataclass(frozen=True)
class SamplerCondition:
    """Inputs of the sampler for frames 1..N-1.

    Attributes:
        z: (B, N-1, D) with the further inputs of `ArigModel.beside`.
        states: (B, N-1, S) logits of the states, or None.
        outline: (B, N-1, D) coarse motion.
        moved: (B, N-1, C) `ArigModel.moved` of the frame before.
    """

    z: Tensor
    states: Tensor | None
    outline: Tensor
    moved: Tensor


class ArigModel(ListenerModel):
    """Weights of one listener, with the scales of its motion and sound."""

    def __init__(self, settings: config.Arig) -> None:
        super().__init__(settings, WIDTHS[settings.sound])
        d, innovation, events = settings.width, settings.draws == "innovation", settings.events
        self.settings = settings
        self.channels, self.sound_width = len(settings.channels), WIDTHS[settings.sound]
        self._register_scales()
        self.sounds_read = self.sound_width - (0 if settings.phase else phase.FEATURES)  # the place in a phrase is last
        self.sound_in = mlp(self.sounds_read, d, d)
        self.motion_in = nn.Linear(self.channels, d)
        self.no_user_sound = nn.Parameter(torch.randn(d) * 0.02)
        self.no_agent_sound = nn.Parameter(torch.randn(d) * 0.02)
        self.no_face = nn.Parameter(torch.randn(d) * 0.02) if settings.visual else None
        self.merge_agent = Merge(d, settings.visual)
        self.merge_user = Merge(d, settings.visual)
        self.short = ShortRange(settings)
        self.long = LongRange(settings)
        self.states = StateUnderstanding(settings) if settings.state_guidance else None
        self.progress = Progressive(settings)
        self.events_in = mlp(CONTROL_ROWS * len(COLUMNS), d, d) if events else None
        condition = d + d * events + self.channels * innovation
        self.head: Denoiser | CodeHead = (
            CodeHead(self.channels, d, condition, settings.code_levels)
            if settings.discrete
            else Denoiser(settings.channels, condition, settings.diffusion)
        )
        self.mean = mlp(condition, MEAN_WIDTH, self.channels) if innovation else None

    def _register_scales(self) -> None:
        """Register the buffers that training sets from its data, and which channels are drawn and recalled."""
        settings, c = self.settings, self.channels
        self.motion_low = nn.Buffer(torch.full((c,), -8.0))
        self.motion_high = nn.Buffer(torch.full((c,), 8.0))
        self.step_std = nn.Buffer(torch.ones(c))
        self.is_told = settings.events and settings.draws == "innovation"  # draws around the motion expected of events
        if settings.draws == "innovation":
            self.rho = nn.Buffer(torch.zeros(c))
            self.spread = nn.Buffer(torch.ones(c))
            if self.is_told:
                self.told = nn.Buffer(torch.zeros(event_curves.FEATURES, c))
                self.moves = nn.Buffer(event_curves.moves(settings.channels), persistent=False)
                self.knots = nn.Buffer(event_curves.knots(), persistent=False)
                self.rest_range = nn.Buffer(torch.full((c,), UNBOUNDED))
        drawn = [name in settings.drawn_channels for name in settings.channels]
        self.is_drawn = nn.Buffer(torch.tensor(drawn), persistent=False)
        is_recalled = torch.ones(c, dtype=torch.bool)
        is_recalled[self.swaying] = False
        self.is_recalled = nn.Buffer(is_recalled, persistent=False)

    # --- Motion and draws: the table above ----------------------------------------------------------------------------

    def expected(self, last: Tensor, rows: Tensor | None) -> Tensor:
        """Return the standardised motion (..., C) that a draw of 0 leads to after `last` (..., C); `rows` (..., 2K)."""
        if self.settings.draws != "innovation":
            return last  # ours (`step`), because a still face stays still
        if not self.is_told or rows is None:
            return self.rho * last  # ours, because errors decay at the rate of the data
        before, now = rows.chunk(2, dim=-1)
        off = last - self._course(before)  # x_(t-1) - b_(t-1)
        # b_t + rho f_t (x_(t-1) - b_(t-1))
        return self._course(now) + self.rho * event_curves.remains(before, now, self.moves) * off

    def _course(self, row: Tensor) -> Tensor:
        """Return b (..., C), the motion expected of the events of control rows (..., K)."""
        return event_curves.features(row, self.knots) @ self.told

    def moved(self, motion: Tensor, last: Tensor, rows: Tensor | None = None) -> Tensor:
        """Return the draw (..., C) that leads to motion (..., C) after `last` (..., C), both standardised.

        `rows` (..., 2K): control of both frames.
        """
        if self.settings.draws == "motion":
            return motion  # the paper's M_T, equation (3)
        step = (motion - self.expected(last, rows)) / self.step_std
        return self.companded(step) if self.settings.draws == "innovation" else step

    def companded(self, step: Tensor) -> Tensor:
        """Return the draws (..., C) of steps (..., C) in units of `step_std`: fast motion is compressed."""
        return step.asinh() / self.spread

    def drawn(self, sample: Tensor, last: Tensor, rows: Tensor | None = None, speaks: Tensor | None = None) -> Tensor:
        """Return the standardised motion (..., C) that a draw leads to, the inverse of `moved`.

        `speaks` (...) bool: whether the agent speaks in this frame; None: it may.
        """
        if self.settings.draws == "motion":
            made = sample  # the paper's, equation (4)
        else:
            step = (sample * self.spread).sinh() if self.settings.draws == "innovation" else sample
            begins = self.expected(last, rows)
            made = torch.addcmul(begins, step, self.step_std)
            if self.is_told and rows is not None and speaks is not None:
                made = self._held(made, begins, rows.chunk(2, dim=-1)[1], speaks)
            made = made.clamp(self.motion_low, self.motion_high)  # ours, because steps could leave the data's range
        # Ours: channels that are not drawn (gaze) rest at their mean, which is 0.
        return made.where(self.is_drawn, 0.0) if self.settings.events else made

    def _held(self, made: Tensor, begins: Tensor, row: Tensor, speaks: Tensor) -> Tensor:
        """Return motion (..., C), held near rest where no event of control `row` (..., K) and no speech moves the face.

        There |x - b| <= max(rest_range, |begins - b|): a draw may not lead further from the expected motion b than
        faces at rest are, and motion that is already further away comes back at least as fast as without a draw.
        """
        course = self._course(row)  # b_t
        free = speaks[..., None] | event_curves.moved_channels(row, self.moves)
        most = torch.where(free, UNBOUNDED, torch.maximum(self.rest_range, (begins - course).abs()))
        return course + torch.minimum(torch.maximum(made - course, -most), most)

    # --- Sampler (3.4) ------------------------------------------------------------------------------------------------

    def sample(self, z: Tensor, noise: Tensor) -> Tensor:
        """Return a draw (N, C), the mean included; z as returned by `beside`, noise as for `Denoiser.sample`.

        The part drawn around the mean is within the sampler's range, and so is the sum: no step is larger than in the
        data.
        """
        drawn = self.head.sample(z, noise)
        if self.mean is not None and isinstance(self.head, Denoiser):
            drawn = (drawn + self.mean(z)).clamp(self.head.low, self.head.high)
        return drawn

    def sample_loss(
        self,
        z: Tensor,
        wanted: Tensor,
        draws: int = 1,
        generator: torch.Generator | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Return the loss (N,): equation (3) at `draws` noise levels, or the loss of codes, plus that of the mean.

        `wanted` (N, C): `moved` of the frame.
        """
        mean = torch.zeros_like(wanted) if self.mean is None else self.mean(z)
        left, z = (each.repeat(draws, 1) for each in (wanted - mean.detach(), z))
        drawn = self.head.loss(z, left, generator, weights).view(draws, -1).mean(0)
        if self.mean is None:
            return drawn
        return drawn + weighted_mean(F.huber_loss(mean, wanted, reduction="none", delta=MEAN_DELTA), weights)

    def beside(self, z: Tensor, events: Tensor | None, moved: Tensor) -> Tensor:
        """Return z (..., D) with further inputs of the sampler: embedded events (..., D), the last draw (..., C)."""
        told = [z] if events is None else [z, events]
        if self.settings.draws == "innovation":
            told.append(moved.where(self.is_recalled, 0.0))
        return torch.cat(told, dim=-1) if len(told) > 1 else z

    # --- Embeddings (A.2) ---------------------------------------------------------------------------------------------

    def embed_events(self, rows: Tensor) -> Tensor | None:
        """Return the embedding (..., D) of control rows (..., 2K), frame before and frame; None without events."""
        return None if self.events_in is None else self.events_in(rows)

    def embed_sound(self, sound: Tensor, heard: Tensor, absent: Tensor) -> Tensor:
        """Return the embedding (..., D) of features (..., A); `absent`, (D,) or (..., D), where not `heard` (...)."""
        out: Tensor = self.sound_in(self.standardise_sound(sound)[..., : self.sounds_read])
        return torch.where(heard[..., None], out, absent)

    def embed_own(self, motion: Tensor) -> Tensor:
        """Return the embedding (..., D) of the agent's standardised motion (..., C), recalled channels only."""
        out: Tensor = self.motion_in(motion.where(self.is_recalled, 0.0))
        return out

    def embed_face(self, motion: Tensor, seen: Tensor) -> Tensor:
        """Return the embedding (..., D) of the user's standardised motion (..., C); `seen` (...) bool."""
        embedded: Tensor = self.motion_in(motion)
        return embedded if self.no_face is None else torch.where(seen[..., None], embedded, self.no_face)

    # --- All frames at once -------------------------------------------------------------------------------------------

    def condition(self, dyad: ArigDyad, states: Tensor | None = None) -> SamplerCondition:
        """Return the inputs of the sampler for frames 1..N-1 at once.

        `states` (B, N): the state of every frame; each frame gets the state of the frame before. Without it, each frame
        continues from the model's own answer, as a stream does.
        """
        user = self.embed_sound(dyad.user_sound, dyad.user_heard, self.no_user_sound)[:, :-1]
        agent = self.embed_sound(dyad.agent_sound, dyad.agent_heard, self.no_agent_sound)
        standard = self.standardise(dyad.agent_motion)[:, :-1]
        motion = self.embed_own(standard)
        face = self.embed_face(self.standardise(dyad.user_motion), dyad.user_seen)[:, :-1]
        b, t, d = motion.shape  # below, index t is made from frames 0..t and is for frame t + 1
        c = self.settings.chunk_frames
        now = agent[:, 1:].flatten(0, 1)
        summaries = self.short(
            windows(self.merge_agent(agent[:, :-1], motion), c).flatten(0, 1),
            windows(self.merge_user(user, face), c).flatten(0, 1),
            now,
            user.flatten(0, 1),
        )
        cis = self.long(summaries.view(b, t, d)).flatten(0, 1)
        voiced = torch.stack([dyad.voiced[:, 1:, 0], dyad.voiced[:, :-1, 1]], dim=-1)
        feature, logits = self._states(cis, voiced, states)
        rows = self.rows(dyad)
        events = None if rows is None else self.embed_events(rows)
        outline = self.progress.coarse(
            motion.flatten(0, 1),
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
        return SamplerCondition(self.beside(z.view(b, t, d), events, moved), logits, outline.view(b, t, d), moved)

    def rows(self, dyad: ArigDyad) -> Tensor | None:
        """Return control (B, N - 1, 2K) of the frames before and of frames 1..N-1, or None without events."""
        if dyad.control is None or not self.settings.events:
            return None
        return torch.cat([dyad.control[:, :-1], dyad.control[:, 1:]], dim=-1)

    def _states(self, cis: Tensor, voiced: Tensor, states: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """Return features (B * T, D) and logits (B, T, S) of cis (B * T, D) and voiced (B, T, 2)."""
        if self.states is None:
            return None, None
        b, t = voiced.shape[:2]
        keys = self.states.condition(cis, voiced.flatten(0, 1))
        before = self.states.follow(keys, b) if states is None else states[:, :-1]
        feature, scores = self.states(keys, before.flatten())
        return feature, scores.view(b, t, -1)
