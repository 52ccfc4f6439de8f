"""A listener small enough to build in every test."""

import numpy as np
import torch

from sfms_robot import config
from sfms_robot.frames import BLENDSHAPES, FRAME_S, FRAME_SAMPLES, POSE_CHANNELS, FaceFrame, SpeakerFrame
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.torch_engine import torch_engine
from sfms_robot.signals.control import control_track


def tiny_settings(**changes) -> config.Sfms:
    raw = {
        "kind": "sfms",
        "groups": {
            "neck": {"channels": POSE_CHANNELS, "levels": (3, 2), "keyframes": 6},
            "face": {"channels": BLENDSHAPES, "levels": (2, 4), "keyframes": 5},
        },
        "tokenizer_width": 16,
        "predictor_width": 16,
        "predictor_layers": 1,
        "heads": 2,
    }
    return config.parse(config.Sfms, raw | changes, "tiny")


def tiny_listener(**changes) -> SfmsListener:
    settings = tiny_settings(**changes)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SfmsListener(settings, torch_engine(SfmsModel(settings)))


def told_listener(**changes) -> SfmsListener:
    """One that is told of events and sways by itself."""
    face = [name for name in BLENDSHAPES if not name.startswith("eyeLook")]
    raw = {
        "events": True,
        "sway": True,
        "placement": "penalised",
        "ramp_frames": 5,
        "groups": {
            "neck": {"channels": POSE_CHANNELS, "levels": (3, 2), "keyframe_cost": 1.0},
            "face": {"channels": face, "levels": (2, 4), "keyframe_cost": 1.0},
        },
    }
    listener = tiny_listener(**raw | changes)
    if listener.engine.model.swaying:
        listener.engine.model.sway_mixture.copy_(0.003 * torch.eye(listener.engine.model.sway_mixture.shape[-1]))
        listener.engine.model.sway_spread.fill_(0.3)
    return listener


def speech(frames: int, seed: int = 0, face: bool = True, audio: bool = True) -> list[SpeakerFrame]:
    rng, out = np.random.default_rng(seed), []
    for index in range(frames):
        time_s = (index + 1) * FRAME_S
        sound = rng.normal(0, 0.1, FRAME_SAMPLES).astype(np.float32)
        shown = FaceFrame.of(time_s, rng.uniform(0, 0.3, 58))
        out.append(SpeakerFrame(time_s, sound if audio else sound[:0], shown if face else None))
    return out


def plans_of(listener, speaker, seed=1, events=()):
    """Every plan of a stream, by the index of the frame it was made at; of `events` each is told 3 frames ahead."""
    memory, plans = listener.start(seed), {}
    past, ahead = getattr(listener, "control_frames", (0, 0))
    for index, frame in enumerate(speaker):
        told = [event for event in events if event.start_s <= (index + 3) * FRAME_S + 1e-9]
        control = control_track(told, index + 1 - past, past + ahead) if past else None
        plan, memory = listener.step(frame, memory, *([control] if past else []))
        if plan is not None:
            plans[index] = plan
    return plans
