"""wav2vec2 features of each 40 ms frame of a stream, from a model folder on disk; the same however it is cut.

The transformer processes a whole recording at once, including the future. A listener receives a stream, so each frame
has a separate window: the last 50 frames (2 s) and 80 samples, so that the last two latents end with the frame; their
mean is the frame's feature. That is a pass over 2 s per frame: a GPU keeps up with a stream, a CPU does not.

With a hop of h frames one pass returns h rows when the last of them is complete, at 1/h of the cost: a listener that
plans every h frames loses nothing. Its windows are h - 1 frames longer, so that every row has its 2 s.

This scheme is ours, because rows of a whole recording contain the future: REACT's baselines process whole recordings
and stretch 50 latents a second to 25.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from sfms_robot.errors import ModelError, first_line, optional
from sfms_robot.frames import FRAME_SAMPLES, Floats

CONTEXT_FRAMES: Final = 50
STRIDE: Final = 320  # samples from one latent to the next
FIELD: Final = 400  # samples that a latent sees
WINDOW: Final = CONTEXT_FRAMES * FRAME_SAMPLES + FIELD - STRIDE  # 32,080, at a hop of one frame
LATENTS_PER_FRAME: Final = FRAME_SAMPLES // STRIDE
BATCH: Final = 16
FILES: Final = ("config.json", "preprocessor_config.json", "model.safetensors", "pytorch_model.bin")


class Wav2Vec2:
    """A wav2vec2 model from a local folder. Holds weights only; the caller keeps the past of a stream."""

    def __init__(self, folder: Path | str, device: str = "cpu", hop_frames: int = 1) -> None:
        """Load the model. Raises MissingExtra without transformers, ModelError for a folder without such a model."""
        with optional("wav2vec2"):
            import transformers
        self.folder = Path(folder)
        config = self.folder / FILES[0]
        settings = _json(config)
        if settings.get("model_type") != "wav2vec2":
            raise ModelError(f"{config}: model_type = {settings.get('model_type')!r} is not wav2vec2")
        try:
            model: Any = transformers.Wav2Vec2Model.from_pretrained(str(self.folder), local_files_only=True)
        except (OSError, ValueError, RuntimeError) as error:
            raise ModelError(f"{self.folder}: no wav2vec2 weights that can be read: {first_line(error)}") from error
        kernels, strides = model.config.conv_kernel, model.config.conv_stride
        if _reach(kernels, strides) != (FIELD, STRIDE):
            raise ModelError(f"{config}: conv_stride = {list(strides)} is not a latent every 20 ms")
        self._model = model.eval().to(device)
        self._device = device
        self.hop_frames = hop_frames
        self._hop = hop_frames * FRAME_SAMPLES
        self._window = WINDOW + self._hop - FRAME_SAMPLES
        preprocessor = self.folder / FILES[1]
        self._normalise = bool(_json(preprocessor).get("do_normalize", True)) if preprocessor.is_file() else True
        self.dim = int(model.config.hidden_size)

    def start(self) -> Floats:
        """Return the past of a new stream: (31440,) zeros."""
        return np.zeros(self._window - self._hop, dtype=np.float32)

    def step(self, samples: Floats, past: Floats) -> tuple[Floats, Floats]:
        """Return the rows of the hops that `samples` complete, and the past of the next call.

        Args:
            samples: (n,) mono 16 kHz, -1..1; any n.
            past: from the last call, or `start()`; not changed.

        Returns:
            (frames, dim), a multiple of `hop_frames`, and the samples to pass next time: 31440 and those of an
            incomplete hop.
        """
        seen = np.concatenate([past, samples]).astype(np.float32)
        hops = max(0, (len(seen) - self._window) // self._hop + 1)
        if not hops:
            return np.zeros((0, self.dim), np.float32), seen
        return self._rows(seen), seen[hops * self._hop :].copy()

    @torch.no_grad()
    def _rows(self, samples: Floats) -> Floats:
        """Return the rows (hops * hop_frames, dim) of all hops that are whole in `samples` (n,), the past first."""
        windows = np.lib.stride_tricks.sliding_window_view(samples, self._window)[:: self._hop]
        rows = list[Floats]()
        for at in range(0, len(windows), BATCH):
            sound = torch.from_numpy(windows[at : at + BATCH].copy()).to(self._device)
            if self._normalise:
                mean = sound.mean(dim=1, keepdim=True)
                sound = (sound - mean) / (sound.var(dim=1, correction=0, keepdim=True) + 1e-7).sqrt()
            latents = self._model(sound).last_hidden_state
            newest = latents[:, -LATENTS_PER_FRAME * self.hop_frames :].unflatten(1, (-1, LATENTS_PER_FRAME))
            rows.append(newest.mean(dim=2).flatten(0, 1).float().cpu().numpy())
        return np.concatenate(rows)


def _reach(kernels: list[int], strides: list[int]) -> tuple[int, int]:
    """Return the samples that a latent sees, and the samples from one to the next."""
    field, stride = 1, 1
    for kernel, step in zip(kernels, strides, strict=True):
        field += (kernel - 1) * stride
        stride *= step
    return field, stride


def _json(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(f"{file}: no such file: a model folder holds {FILES[0]} and {FILES[2]}") from error
    except ValueError as error:
        raise ModelError(f"{file}: not JSON: {error}") from error
    if not isinstance(found, dict):
        raise ModelError(f"{file}: not a table of settings")
    return found
