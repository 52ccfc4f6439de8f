"""Motion of a whole corpus as tokens: what phase 2 is trained on."""

from __future__ import annotations

import torch
from torch import Tensor

from sfms_robot.learning.sfms.corpus import Corpus, place_all
from sfms_robot.listeners.sfms.model import SfmsModel


@torch.no_grad()
def tokenise(model: SfmsModel, corpus: Corpus) -> Tensor:
    """Tokens (N, G) of every listener in the corpus."""
    motion = model.standardise(corpus.motion)
    mask = place_all(model.tokenizer, motion, corpus.lengths)
    parts = zip(torch.split(motion, 4096), torch.split(mask, 4096), strict=True)
    return torch.cat([model.tokenizer.encode(m[None], k[None])[0] for m, k in parts])
