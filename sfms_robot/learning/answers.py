"""What an SFMS listener answers to a whole dyad, in its own motion space, several times over.

The same roll-out as streaming, from arrays: the features of a dyad are worked out once and serve all samples. Speaker
and plans stay in the model's space, so that data in DECA or FaceVerse coefficients, with mel in place of a waveform,
are answered in their own terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from sfms_robot.corpora.clips import Dyad
from sfms_robot.learning.sfms.corpus import Corpus, gather
from sfms_robot.listeners.sfms.predictor import Context
from sfms_robot.listeners.sfms.stream import SfmsListener, passed


@dataclass(frozen=True)
class Answers:
    """S streams that heard one dyad of N frames: motion (S, N, D) in the model's space, tokens (S, N', G) as drawn."""

    motion: Tensor
    tokens: Tensor


def heard_by(listener: SfmsListener, dyad: Dyad) -> Corpus:
    """A dyad as the listener takes it in. Raises ConfigError when it is in a space that cannot become its own."""
    return gather([dyad], 1, listener.space, listener.hearing)


@torch.inference_mode()
def answers(listener: SfmsListener, heard: Corpus, seeds: Sequence[int]) -> Answers:
    """Streams of those seeds that hear the one dyad of `heard`, each plan shown until the next one."""
    model, past, ahead = listener.model, listener.settings.past_frames, listener.horizon
    frames = len(heard.motion)
    sound = model.standardise_sound(torch.cat([torch.zeros_like(heard.sound[:1]), heard.sound]).float())
    sound = torch.where(pad(heard.heard, (1, 0))[:, None, None], sound, 0.0)
    voice = model.predictor.speaker.listen(sound.flatten(0, 1)[None])[0]
    face, voice, phase = (pad(part, (0, 0, past, 0)) for part in (model.standardise(heard.face), voice, heard.phase))
    known, audible = (pad(part, (past, 0)) for part in (heard.face_known, heard.heard))  # frame t at index past + t
    tokens, path = (part.expand(len(seeds), *part.shape) for part in listener.at_rest())
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    drawn = []
    shown = path[:, :1].expand(-1, frames + ahead + 1, -1).clone()
    for now in range(0, frames, listener.hop):  # the newest frame heard
        tokens, path = passed(tokens, path, listener.hop if now else 1)
        window = slice(now + 1, now + 1 + past)
        seen = Context(
            face[None, window],
            known[None, window],
            voice[None, window],
            audible[None, window],
            phase[None, window],
            tokens,
        )
        tokens, path = listener.plan(seen, path, generators)
        shown[:, now + 1 : now + 1 + ahead] = listener.shown(path)
        drawn.append(tokens[:, -listener.hop :])
    return Answers(model.restore(shown[:, :frames]), torch.cat(drawn, dim=1))
