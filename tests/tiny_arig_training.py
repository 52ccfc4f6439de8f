"""A few seconds of conversation with both voices and states, and a training small enough for every test."""

from pathlib import Path

import numpy as np

from sfms_robot import config
from sfms_robot.config import parse_training
from sfms_robot.frames import CHANNEL_INDEX, FRAME_SAMPLES, ListenerEvent
from sfms_robot.lab.corpora import clips, conversational_states

HZ = 25
TINY = {
    "kind": "arig",
    "width": 16,
    "feedforward": 24,
    "heads": 2,
    "context_chunks": 8,
    "context_layers": 1,
    "diffusion": {"width": 24, "blocks": 2, "steps": 4, "train_steps": 50},
}


def settings(listener: dict | None = None, **phase) -> config.ArigTraining:
    training = {"steps": 6, "batch": 4, "learning_rate": 5e-3, "window_frames": 24, "warm_up_steps": 2} | phase
    found = parse_training({"listener": TINY | (listener or {}), "training": training}, "tiny")
    assert isinstance(found, config.ArigTraining)
    return found


def dyad(name: str, scene: str, seed: int) -> clips.Dyad:
    """12 s: who speaks does so in turns of a second; the agent's jaw follows its voice, its head the user's."""
    rng, frames = np.random.default_rng(seed), 12 * HZ
    turn = (np.arange(frames) // HZ + seed) % 2 == 0
    agent = turn if scene != "listening" else np.zeros(frames, bool)
    user = ~turn if scene != "speaking" else np.zeros(frames, bool)

    def voice(active: np.ndarray) -> np.ndarray:
        level = np.where(active, 0.1, 0.0).repeat(FRAME_SAMPLES)
        return (level * rng.standard_normal(len(level))).astype(np.float32)

    motion = np.zeros((frames, 58), np.float32)
    motion[:, CHANNEL_INDEX["jawOpen"]] = 0.4 * agent
    motion[:, CHANNEL_INDEX["pitch"]] = 0.05 * np.sin(np.arange(frames) / 3) * user
    face = motion[::-1].copy() if scene != "speaking" else np.full((frames, 58), np.nan, np.float32)
    return clips.Dyad(
        name=name,
        audio=voice(user),
        speaker=face,
        listener=motion,
        listening=user & ~agent,
        agent_audio=voice(agent),
        states=conversational_states.states_of_activity(agent, user),
        events=tuple(ListenerEvent("nod", start_s, 0.6, 0.05, 2) for start_s in (2.0, 5.0, 9.0)),
        head_of_gaze_rad=np.zeros((frames, 3), np.float32),
    )


def write(folder: Path) -> Path:
    """Train, validation and test of all three scenes."""
    for scene, place in (("listening", "."), ("speaking", "speaking"), ("interaction", "interaction")):
        clips.save(folder / place / "train", [dyad(f"a{seed}", scene, seed) for seed in (0, 1)])
        for split in ("validation", "test"):
            clips.save(folder / place / split, [dyad("v", scene, 2)])
    return folder
