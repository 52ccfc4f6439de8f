"""SFMS as it runs: one speaker frame in, and on every `hop`-th a plan of the next 8 frames out.

Tokens once drawn stay drawn: a new plan keeps what is left of the one before and draws only the `hop` frames at its
far end. So a keyframe is decided (future - hop) to future frames ahead, 0.16 to 0.32 s with hop 4, and movement
that has begun toward it is never called off; re-planning cannot jitter. What is behind the last keyframe drawn is an
extrapolation, which the next plan may correct: it starts where the motion was, at the speed it had, and the difference
fades over `seam_frames`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sfms_robot import config
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Floats, Plan, SpeakerFrame
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context
from sfms_robot.listeners.sfms.reach import Reach
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel

NEUTRAL_STRIDE = 8  # frames between the keyframes of the neutral face a stream begins with


@dataclass(frozen=True)
class Memory:
    """What one stream remembers; P past frames, the newest last. Values only: a step makes a new one.

    Attributes:
        frames: how many have been heard.
        sound: samples that unfinished mel rows still need.
        mel: (4P, 128) standardised; heard: (P,) bool.
        face: (P, C) standardised; face_known: (P,) bool.
        past: (P, G) own tokens up to now.
        ahead: (A, G) own tokens already drawn for the next A frames.
        path: (2 + H, C) standardised: the frame before, this frame, then the plan in force.
        random: state of the stream's own generator.
    """

    frames: int
    sound: Floats
    mel: Tensor
    heard: Tensor
    face: Tensor
    face_known: Tensor
    past: Tensor
    ahead: Tensor
    path: Tensor
    random: Tensor


@torch.no_grad()
def neutral_tokens(model: SfmsModel, space: MotionSpace, frames: int) -> Tensor:
    """(frames, G): a still, neutral face up to now, as tokens."""
    still = model.standardise(_still(space, frames))[None]
    mask = torch.zeros(1, frames, model.tokenizer.member.shape[0])
    mask[:, (frames - 1) % NEUTRAL_STRIDE :: NEUTRAL_STRIDE] = 1.0
    return model.tokenizer.encode(still, mask)[0]


class SfmsListener:
    """`ports.Listener` over an SfmsModel. Holds weights only."""

    def __init__(self, settings: config.Sfms, model: SfmsModel, space: MotionSpace | None = None) -> None:
        self.settings = settings
        self.model = model.eval()
        self.space = space or MotionSpace.of(settings)
        self.reach = Reach(self.model)
        self._neutral = neutral_tokens(self.model, self.space, settings.past_frames)

    @property
    def hop(self) -> int:
        return self.settings.hop

    @property
    def horizon(self) -> int:
        return self.settings.future_frames

    def start(self, seed: int) -> Memory:
        """Memory of a stream that has heard nothing and looked neutral so far."""
        p, h = self.settings.past_frames, self.settings.future_frames
        still = self.model.standardise(_still(self.space, 2 + h))
        return Memory(
            frames=0,
            sound=mel.start(),
            mel=torch.zeros(mel.ROWS_PER_FRAME * p, mel.MEL_BINS),
            heard=torch.zeros(p, dtype=torch.bool),
            face=torch.zeros(p, self.space.dim),
            face_known=torch.zeros(p, dtype=torch.bool),
            past=self._neutral,
            ahead=self._neutral[:0],
            path=still,
            random=torch.Generator().manual_seed(seed).get_state(),
        )

    @torch.inference_mode()
    def step(self, speaker: SpeakerFrame, memory: Memory) -> tuple[Plan | None, Memory]:
        """Take one frame; a Plan on every `hop`-th, None between. Never changes `memory` in place.

        Raises ValueError when the frame holds another number of samples than 640 or none.
        """
        heard = self._hear(speaker, memory)
        if memory.frames % self.hop:
            return None, heard
        generator = torch.Generator()
        generator.set_state(memory.random)
        ahead = draw(self.model, self.settings, self.reach, _context(heard), heard.ahead, generator)
        decoded = self.model.tokenizer.decode(torch.cat([heard.past, ahead])[None])[0, -self.horizon - 2 :]
        path = join(heard.path[:2], decoded, self.settings.sampling.seam_frames)
        now = replace(heard, ahead=ahead, path=path, random=generator.get_state())
        times_s = np.asarray(speaker.time_s + FRAME_S * np.arange(1, self.horizon + 1), dtype=np.float64)
        motion, jaw_rad = self.space.decode(self.model.restore(path[2:]).numpy())
        return Plan(speaker.time_s, times_s, motion, jaw_rad), now

    def _hear(self, speaker: SpeakerFrame, memory: Memory) -> Memory:
        """Memory with the newest frame in place of the oldest."""
        present = len(speaker.audio) > 0
        if present and len(speaker.audio) != FRAME_SAMPLES:
            raise ValueError(f"a frame at {AUDIO_HZ} Hz has {FRAME_SAMPLES} samples or none, got {len(speaker.audio)}")
        samples = speaker.audio if present else np.zeros(FRAME_SAMPLES, dtype=np.float32)
        rows, sound = mel.log_mel(samples, memory.sound)
        face = torch.zeros(self.space.dim)
        known = speaker.face is not None and bool(np.isfinite(speaker.face.motion).all())
        if speaker.face is not None and known:
            face = self.model.standardise(torch.from_numpy(self.space.encode(speaker.face.motion[None])[0]))
        # The frame that has just passed was in the plan; before the first plan it is part of the neutral face.
        passed = memory.ahead[:1] if len(memory.ahead) else torch.zeros_like(memory.past[:1])
        return replace(
            memory,
            frames=memory.frames + 1,
            sound=sound,
            mel=_push(memory.mel, self.model.standardise_mel(torch.from_numpy(rows))),
            heard=_push(memory.heard, torch.tensor([present])),
            face=_push(memory.face, face[None]),
            face_known=_push(memory.face_known, torch.tensor([known])),
            past=_push(memory.past, passed),
            ahead=memory.ahead[1:],
            path=torch.cat([memory.path[1:], memory.path[-1:]]),
        )


def _still(space: MotionSpace, frames: int) -> Tensor:
    """(frames, C) of a face at rest."""
    return torch.tensor(space.neutral, dtype=torch.float32).expand(frames, -1)


def _push(queue: Tensor, new: Tensor) -> Tensor:
    return torch.cat([queue[len(new) :], new])


def _context(memory: Memory) -> Context:
    """A batch of one."""
    return Context(memory.face[None], memory.face_known[None], memory.mel[None], memory.heard[None], memory.past[None])


def draw(
    model: SfmsModel,
    settings: config.Sfms,
    reach: Reach,
    context: Context,
    ahead: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """The tokens (H, G) of the plan: those of `ahead` (A, G) stay, the rest are drawn, some frames at a time."""
    h, known = settings.future_frames, len(ahead)
    future = torch.full((h, ahead.shape[1]), UNDECIDED)
    future[:known] = ahead
    memory = model.predictor.remember(context)
    groups = list(settings.groups.values())
    bias = torch.tensor([group.transition_bias for group in groups])
    nucleus = torch.tensor([group.nucleus or settings.sampling.nucleus for group in groups])
    last, at = _last_keyframes(torch.cat([context.tokens[0], ahead]))
    at = at - settings.past_frames  # future frame 0 is frame 0
    together = settings.sampling.frames_per_pass
    for first in range(known, h, together):
        logits = model.predictor.decode(memory, context.tokens, future[None])
        for frame in range(first, min(first + together, h)):
            rows = pad_sequence([v[0, frame] for v in logits], batch_first=True, padding_value=-torch.inf)  # (G, V)
            rows = rows.masked_fill(~reach.allowed(last, frame - at), -torch.inf)
            drawn = sample(rows / settings.sampling.temperature, bias, nucleus, generator)
            future[frame] = drawn
            last, at = torch.where(drawn > 0, drawn, last), torch.where(drawn > 0, frame, at)
    return future


def _last_keyframes(tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Tokens (T, G) -> the last token above 0 of each group, or 0, and its frame."""
    at = torch.where(tokens > 0, torch.arange(len(tokens))[:, None], -1).amax(0)
    return tokens.gather(0, at.clamp(min=0)[None])[0].clamp(min=0), at


def sample(logits: Tensor, bias: Tensor, nucleus: Tensor, generator: torch.Generator) -> Tensor:
    """One class of each (..., G, V) logits: bias (G,) on class 0, then the likeliest that hold `nucleus` (G,)."""
    biased = torch.cat([logits[..., :1] + bias[:, None], logits[..., 1:]], dim=-1)
    order = torch.softmax(biased, dim=-1).sort(descending=True, stable=True)
    mass = order.values.cumsum(-1)
    kept = ((mass - order.values) < nucleus[:, None]).sum(-1, keepdim=True)
    whole = mass.gather(-1, kept - 1)
    drawn = torch.rand(whole.shape, generator=generator) * whole
    place = torch.minimum((mass <= drawn).sum(-1, keepdim=True), kept - 1)
    return order.indices.gather(-1, place)[..., 0]


def join(tail: Tensor, decoded: Tensor, seam: int) -> Tensor:
    """Plan that goes on from where the motion was.

    Args:
        tail: (2, C) the frame before and this frame as played.
        decoded: (2 + H, C) the same two and the future, as the new tokens have them.
        seam: frames over which the difference fades.

    Returns:
        (2 + H, C): `tail`, then `decoded` plus a cubic that starts with the difference (place and speed), ends flat.
    """
    offset, before = tail[1] - decoded[1], tail[0] - decoded[0]
    speed = offset - before
    u = (torch.arange(1, len(decoded) - 1) / seam).clamp(max=1.0)[:, None]
    fade = offset * (1 - u) ** 2 * (1 + 2 * u) + speed * seam * u * (1 - u) ** 2
    return torch.cat([tail, decoded[2:] + fade])
