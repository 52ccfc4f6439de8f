"""A few seconds of made-up conversation, and the configuration of a training on it that takes a second."""

from pathlib import Path
from typing import Any

import numpy as np

from sfms_robot.frames import BLENDSHAPES, FRAME_SAMPLES, POSE_CHANNELS
from sfms_robot.lab.corpora import clips

FRAMES = 110


def write_dyads(folder: Path) -> Path:
    """Write one conversation to train on and another to validate on."""
    for split, seed in (("train", 0), ("validation", 1)):
        rng = np.random.default_rng(seed)
        motion = (0.2 + 0.1 * np.sin(np.arange(FRAMES)[:, None] / 6 + rng.uniform(0, 6, 58))).astype(np.float32)
        audio = rng.normal(0, 0.05, FRAMES * FRAME_SAMPLES).astype(np.float32)
        shared = {"listener": motion, "listening": np.ones(FRAMES, bool)}
        dyad = clips.Dyad(name=split, audio=audio, speaker=motion[::-1].copy(), **shared)
        clips.save(folder / split, [dyad])
    return folder


def configuration(steps: int = 6) -> dict[str, Any]:
    phase = {"steps": steps, "batch": 4, "learning_rate": 0.005, "evaluate_every": max(1, steps // 2)}
    channels = {"neck": POSE_CHANNELS, "face": BLENDSHAPES}
    return {
        "seed": 2,
        "listener": {
            "kind": "sfms", "placement": "static", "tokenizer_width": 8, "predictor_width": 8, "predictor_layers": 1,
            "heads": 2,
            "groups": {name: {"channels": [*of], "levels": [3, 3], "keyframes": 6} for name, of in channels.items()},
        },
        "tokenizer": phase, "predictor": {**phase, "calibration_rounds": 0},
    }  # fmt: skip
