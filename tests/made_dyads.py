"""Dyads and people of meetings, of what a test needs of them."""

import numpy as np

from sfms_robot.lab.corpora.clips import Dyad, samples_of
from sfms_robot.lab.corpora.compose.ami import MeetingPerson

NONE = np.zeros((0, 2))


def made_dyad(listener: np.ndarray, **changes) -> Dyad:
    """One whose listener moves so (N, C), and listens all the time to noise beside a face at rest."""
    frames = len(listener)
    noise = np.random.default_rng(0).normal(0, 0.05, samples_of(frames, changes.get("fps", 25.0)))
    whole = {
        "name": "a",
        "audio": noise.astype(np.float32),
        "speaker": np.zeros_like(listener),
        "listener": listener,
        "listening": np.ones(frames, bool),
    }
    return Dyad(**whole | changes)


def meeting_person(**changes) -> MeetingPerson:
    """One to whom nothing happens in a meeting of five minutes, and who does nothing."""
    spans = "nods shakes tilts unseen laughs mm_hms talk backchannels others others_laughs others_backchannels".split()
    whole = {
        "meeting": "M1a", "agent": "B", "participant": "P1", "until_s": 300.0, "asked": np.zeros(0), "words": {},
        "gaze": None, "gaze_known": frozenset(), "floor": (), "others_nods": (), "looked_at": (),
    }  # fmt: skip
    return MeetingPerson(**dict.fromkeys(spans, NONE) | whole | changes)
