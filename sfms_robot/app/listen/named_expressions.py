"""Faces by name, for buttons of a page: channels of `frames.CHANNELS`, everything else is left to the listener."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final


def _both(**values: float) -> dict[str, float]:
    """Of a pair of channels, left and right."""
    return {f"{name}{side}": value for name, value in values.items() for side in ("Left", "Right")}


NAMED_EXPRESSIONS: Final[Mapping[str, Mapping[str, float]]] = {
    "smile": _both(mouthSmile=0.8, cheekSquint=0.4, eyeSquint=0.2),
    "laugh": {**_both(mouthSmile=1.0, cheekSquint=0.8, eyeSquint=0.5), "jawOpen": 0.35, "pitch": -0.08},
    "surprise": {**_both(browOuterUp=0.9, eyeWide=0.9), "browInnerUp": 0.9, "jawOpen": 0.4},
    "doubt": {"browDownLeft": 0.6, "browOuterUpRight": 0.8, "mouthLeft": 0.4, "roll": 0.12},
    "frown": _both(browDown=0.9, eyeSquint=0.3, mouthFrown=0.3),
    "sad": {**_both(mouthFrown=0.8), "browInnerUp": 0.8, "mouthShrugLower": 0.4, "pitch": 0.15},
    "disgust": _both(noseSneer=0.9, mouthUpperUp=0.6, browDown=0.5, eyeSquint=0.4),
    "kiss": {"mouthPucker": 0.9, "mouthFunnel": 0.2},
    "wink": {"eyeBlinkLeft": 1.0, "cheekSquintLeft": 0.6, "mouthSmileLeft": 0.5},
    "eyes closed": _both(eyeBlink=1.0),
}
