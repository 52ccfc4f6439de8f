"""From a score of events to a listener's motion: recorded primitives, stretched and laid where things happened.

Everything is added to a head and a face that never stand still. Layers are joined so that neither value nor speed
jumps: primitives start and end at rest, gaze steps go through smooth kernels, loops are crossfaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.corpora.compose.motions import SHAPE, Motions, edges, slow
from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_S, MOTION_DIM, POSE, SHAPES, Doubles, Floats

EYE_PAN_RAD: Final = np.deg2rad(30)  # full eyeLook curve, sideways
EYE_TILT_RAD: Final = np.deg2rad(20)
NOD_RAD_S2: Final = np.deg2rad(1600)  # necks of heads that will play this stay below 1800 deg/s^2
_FADE: Final = FRAME_HZ
_GLANCE_S: Final = 1.5
_MIRROR: Final = [
    BLENDSHAPES.index(
        name.replace("Left", "\0").replace("Right", "Left").replace("\0", "Right")
        if name.endswith(("Left", "Right"))
        else name
    )
    for name in BLENDSHAPES
]


@dataclass(frozen=True)
class Score:
    """What happens in `frames` frames, in seconds from their beginning; spans are (K, 2) start, end.

    Attributes:
        nods, shakes, tilts, laughs, talk, backchannels: the listener's own.
        gaze: (start, end, where) of looks away from the speaker: "side A".."side E", "down", "screen" or "away".
        shared_laughs: laughs of the others.
        asked, ends: instants at which the others asked something, and at which their phrases ended.
        mouth: (frames, 52) that belongs to his own recorded voice, or None: a recorded mouth that fits none.
    """

    frames: int
    nods: Doubles
    shakes: Doubles
    tilts: Doubles
    laughs: Doubles
    talk: Doubles
    backchannels: Doubles
    gaze: tuple[tuple[float, float, str], ...]
    shared_laughs: Doubles
    asked: Doubles
    ends: Doubles
    mouth: Floats | None = None


def listener_motion(score: Score, motions: Motions, rng: np.random.Generator) -> Floats:
    """(N, 58) of one listener, whose manners (size and pace of nods, how often he blinks, where he looks) are drawn."""
    motion = np.zeros((score.frames, MOTION_DIM), np.float32)
    pose, shapes = motion[:, POSE], motion[:, SHAPES]  # views
    gaze, head, shifts = _gaze(score, rng)
    pose[:, :3] = _sway(motions, score.frames, rng) + _head_of_gaze(head, rng)
    pose[:, 3:] = _drift(motions, score.frames, rng)
    pose[:, 1] += _swings(score.nods, motions.nods, score.frames, rng)
    for start, end in score.shakes:
        side = rng.choice([-1, 1])
        pose[:, 2] += side * 0.8 * _swings(np.array([[start, end]]), motions.shakes, score.frames, rng)
    for start, end in score.tilts:
        hold = max(12, int((end - start) * FRAME_HZ) + 12)
        pose[:, 0] += _placed(
            rng.choice([-1, 1]) * np.deg2rad(rng.uniform(2, 6)) * edges(hold, 12), start, score.frames
        )
    _look(shapes, gaze, pose, rng)
    shapes += _idle(motions, score.frames, rng)
    _smile(shapes, score, motions, rng)
    _raise_brows(shapes, score, motions, rng)
    _speak(shapes, score, motions, rng)
    _blink(shapes, np.concatenate([score.ends, shifts]), motions, rng)
    np.clip(shapes, 0, 1, out=shapes)
    return mirrored(motion) if rng.random() < 0.5 else motion


def speaker_motion(mouth: Floats, motions: Motions, rng: np.random.Generator) -> Floats:
    """(N, 58) of somebody who speaks with this mouth (N, 52); head and the rest of the face from recordings."""
    motion = np.zeros((len(mouth), MOTION_DIM), np.float32)
    motion[:, POSE] = rng.uniform(0.5, 1.1) * tiled(motions.heads, len(mouth), rng)
    motion[:, SHAPES] = np.clip(tiled(motions.faces, len(mouth), rng) + rng.uniform(0.8, 1.1) * mouth, 0, 1)
    return mirrored(motion) if rng.random() < 0.5 else motion


def mirrored(motion: Floats) -> Floats:
    """The same motion (N, 58) of the mirror image."""
    out = motion.copy()
    out[:, SHAPES] = motion[:, SHAPES][:, _MIRROR]
    out[:, [0, 2, 4]] *= -1  # roll, yaw, y
    return out


# --- joining ----------------------------------------------------------------------------------------------------


def tiled(pieces: Sequence[Floats], frames: int, rng: np.random.Generator, fade: int = _FADE) -> Floats:
    """Random pieces (K, C) one after the other, each crossfaded over `fade` frames, cut to (frames, C)."""
    usable = [piece for piece in pieces if len(piece) > 2 * fade] or [max(pieces, key=len)]
    fade = min(fade, min(len(piece) for piece in usable) // 2)
    total = frames + 2 * fade
    out = np.zeros((total, usable[0].shape[1]), np.float32)
    at = 0
    while at < total:
        piece = usable[rng.integers(len(usable))]
        piece = piece[int(rng.integers(0, max(1, (len(piece) - 2 * fade) // 2))) :]
        piece = piece * edges(len(piece), fade)[:, None]
        out[at : at + len(piece)] += piece[: total - at]
        at += len(piece) - fade
    return out[fade : fade + frames]


def stretched(curve: Floats, frames: int) -> Floats:
    """A curve (K,) or (K, C) played over `frames` frames."""
    at = np.linspace(0, len(curve) - 1, max(2, frames))
    if curve.ndim == 1:
        return np.interp(at, np.arange(len(curve)), curve).astype(np.float32)
    low = np.minimum(at.astype(int), len(curve) - 2)
    part = (at - low)[:, None]
    return np.asarray(curve[low] * (1 - part) + curve[low + 1] * part, np.float32)


def _placed(curve: Floats, start_s: float, frames: int) -> Floats:
    """Zeros (frames,) or (frames, C) with the curve from `start_s` on."""
    out = np.zeros((frames, *curve.shape[1:]), np.float32)
    first = int(round(start_s * FRAME_HZ))
    low, high = max(0, first), min(frames, first + len(curve))
    if high > low:
        out[low:high] = curve[low - first : high - first]
    return out


def _pick(pieces: Sequence[Floats], rng: np.random.Generator) -> Floats:
    return pieces[int(rng.integers(len(pieces)))]


# --- head -------------------------------------------------------------------------------------------------------


def _sway(motions: Motions, frames: int, rng: np.random.Generator) -> Floats:
    """Idle roll, pitch, yaw: recorded slow motion brought to about a degree."""
    unit = [piece / (piece.std(axis=0) + 1e-6) for piece in motions.sway]
    size = np.deg2rad(rng.uniform(0.4, 1.1)) * np.array([1.0, 0.8, 1.0], np.float32)
    return np.asarray(tiled(unit, frames, rng, fade=2 * _FADE) * size * rng.choice([-1, 1], 3), np.float32)


def _drift(motions: Motions, frames: int, rng: np.random.Generator) -> Floats:
    """Idle x, y, z: millimetres."""
    slowly = [slow(head[:, 3:], 0.5) for head in motions.heads]
    return np.asarray(rng.uniform(0.2, 0.5) * tiled(slowly, frames, rng), np.float32)


def _swings(spans: Doubles, shapes: Sequence[Floats], frames: int, rng: np.random.Generator) -> Floats:
    """Nods (frames,) [rad, nose down]: 1 to 4 cycles each, 1.5 to 4 Hz, 2 to 12 degrees, dying away."""
    out = np.zeros(frames, np.float32)
    times = np.arange(1, frames + 1) * FRAME_S
    habit, pace_hz = np.deg2rad(rng.normal(5.0, 1.0)), rng.uniform(1.8, 3.0)
    for start, end in spans:
        shape = _pick(shapes, rng)
        count = int(np.clip(round((end - start) * pace_hz), 1, 4))
        length = float(np.clip((end - start) / count, 0.3, 0.66))
        size = np.clip(habit * np.exp(rng.normal(0, 0.35)), np.deg2rad(2.2), np.deg2rad(12))
        size = min(size, NOD_RAD_S2 * length**2 / max(_bend(shape, length), 1.0))
        fall = rng.uniform(0.65, 0.95)
        for cycle in range(count):
            phase = (times - start - cycle * length) / length
            out += size * fall**cycle * np.interp(phase, np.linspace(0, 1, len(shape)), shape, left=0, right=0)
    return out


def _bend(shape: Floats, length_s: float) -> float:
    """Largest second derivative of a unit cycle over unit time, as seen at the frame rate."""
    samples = max(4, int(round(length_s * FRAME_HZ)))
    played = np.interp(np.linspace(0, 1, samples + 1), np.linspace(0, 1, len(shape)), shape)
    twice = np.concatenate([[0, 0], np.tile(played[:-1], 2), [0, 0, 0]])
    return float(np.abs(np.diff(twice, 2)).max()) * samples**2


def _gaze(score: Score, rng: np.random.Generator) -> tuple[Floats, Floats, Doubles]:
    """Where his eyes and where his head look, (N, 2) yaw and pitch [rad] in steps, the speaker straight ahead.

    Also when he shifts, seconds. The head stays for a glance.
    """
    seats = np.deg2rad(rng.uniform(16, 28)) * np.array([-1, 1, 0.7, -0.7, 1])
    gaze = np.zeros((2, score.frames, 2), np.float32)
    shifts = []
    for start, end, where in score.gaze:
        kind = where.split()[0]
        if kind == "side":
            target = (seats[ord(where[-1]) % len(seats)], 0.0)
        elif kind == "down":
            target = (np.deg2rad(rng.normal(0, 5)), np.deg2rad(rng.uniform(11, 18)))
        elif kind == "screen":
            target = (seats[0] * 1.2, np.deg2rad(-3))
        else:
            target = (np.deg2rad(rng.normal(0, 12)), np.deg2rad(rng.normal(0, 6)))
        low, high = (max(0, int(round(at * FRAME_HZ))) for at in (start, end))
        gaze[0, low:high] = target
        if end - start >= _GLANCE_S:
            gaze[1, low:high] = target
        shifts += [start, end]
    return gaze[0], gaze[1], np.array(sorted(shifts))


def _fixations(frames: int, rng: np.random.Generator) -> Floats:
    """Eyes wander over the face they look at: (N, 2) small steps, a new one every second or so."""
    held = np.maximum(rng.exponential(0.9, frames), 0.24)
    index = np.searchsorted(np.cumsum(held), np.arange(frames) * FRAME_S)
    return np.deg2rad(rng.normal(0, 0.7, (frames, 2)))[index].astype(np.float32)


def _head_of_gaze(gaze: Floats, rng: np.random.Generator) -> Floats:
    """The head's part of a look, (N, 3): later and slower than the eyes', bell-shaped speed."""
    width = int(rng.integers(11, 17))
    phase = (np.arange(width) + 0.5) / width
    kernel = phase**2 * (1 - phase) ** 2  # speed of a minimum-jerk move
    kernel = np.r_[0, kernel / kernel.sum()]
    share = rng.uniform(0.4, 0.65)
    padded = np.concatenate([np.repeat(gaze[:1], width, axis=0), gaze])
    head = np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)
    yaw, pitch = share * head[:, 0], 0.8 * share * head[:, 1]
    return np.stack([-0.08 * yaw, pitch, yaw], axis=1).astype(np.float32)


def _look(shapes: Floats, gaze: Floats, pose: Floats, rng: np.random.Generator) -> None:
    """Eyes do what the head leaves over, and hold their target while the head nods."""
    kernel = np.array([0.3, 0.4, 0.3])
    target = gaze + _fixations(len(gaze), rng)
    eyes = np.stack([np.convolve(np.r_[[c[0]] * 2, c], kernel)[2 : 2 + len(c)] for c in target.T], axis=1)
    yaw = (eyes[:, 0] - pose[:, 2]) / EYE_PAN_RAD
    down = (eyes[:, 1] - 0.9 * pose[:, 1]) / EYE_TILT_RAD
    for left, right, amount in (("Out", "In", yaw), ("In", "Out", -yaw), ("Down", "Down", down), ("Up", "Up", -down)):
        shapes[:, SHAPE[f"eyeLook{left}Left"]] = np.clip(amount, 0, 1)
        shapes[:, SHAPE[f"eyeLook{right}Right"]] = np.clip(amount, 0, 1)


# --- face -------------------------------------------------------------------------------------------------------


def _idle(motions: Motions, frames: int, rng: np.random.Generator) -> Floats:
    """The motion of a resting face, lifted so that it hardly ever falls below the neutral."""
    moving = tiled(motions.idle, frames, rng, fade=12)
    return np.asarray(rng.uniform(0.7, 1.2) * (moving - np.percentile(moving, 20, axis=0)), np.float32)


def _smile(shapes: Floats, score: Score, motions: Motions, rng: np.random.Generator) -> None:
    """Own laughs always, laughs of others often, backchannels and nods now and then; only a laugh opens the jaw."""
    events = [(start, end, rng.uniform(0.5, 0.9), 0.7) for start, end in score.laughs]
    events += [(a, b, rng.uniform(0.3, 0.6), 0.2) for a, b in score.shared_laughs if rng.random() < 0.6]
    events += [(a, b, rng.uniform(0.2, 0.4), 0.1) for a, b in score.backchannels if rng.random() < 0.3]
    events += [(a, b, rng.uniform(0.2, 0.4), 0.1) for a, b in score.nods if rng.random() < 0.12]
    for start, end, size, jaw in events:
        curve = _pick(motions.smiles, rng)
        wanted = (end - start + rng.uniform(0.8, 1.8)) * FRAME_HZ
        length = int(np.clip(wanted, 0.7 * len(curve), 1.8 * len(curve)))
        curve = size * stretched(curve, length) * edges(length, 9)[:, None]
        curve[:, SHAPE["jawOpen"]] *= jaw
        np.copyto(shapes, _over(shapes, _placed(curve.astype(np.float32), start - 0.2, len(shapes))))


def _over(below: Floats, above: Floats) -> Floats:
    """Two activations of the same muscles: sums while small, saturates at 1, smooth."""
    return np.asarray(below + above - np.clip(below, 0, 1) * np.clip(above, 0, 1), np.float32)


def _raise_brows(shapes: Floats, score: Score, motions: Motions, rng: np.random.Generator) -> None:
    """After half of the questions, with some of the nods."""
    at = [instant for instant in score.asked if rng.random() < 0.5]
    at += [start for start, _ in score.nods if rng.random() < 0.15]
    for instant in at:
        curve = _pick(motions.brows, rng)
        length = int(len(curve) * rng.uniform(0.7, 1.3))
        curve = rng.uniform(0.2, 0.5) * stretched(curve, length) * edges(length, 6)[:, None]
        placed = _placed(curve.astype(np.float32), instant - 0.1, len(shapes))
        np.copyto(shapes, _over(shapes, placed))


def _speak(shapes: Floats, score: Score, motions: Motions, rng: np.random.Generator) -> None:
    """His own words: the mouth of his voice, or else some recorded mouth over them, small for an "mm-hm"."""
    if score.mouth is not None:
        np.copyto(shapes, _over(shapes, score.mouth))
        return
    source = motions.talk[0]
    short = {float(start) for start, _ in score.backchannels}
    for start, end in score.talk:
        length = max(4, int((end - start) * FRAME_HZ))
        gain = rng.uniform(0.25, 0.45) if any(abs(start - other) < 0.3 for other in short) else rng.uniform(0.6, 0.9)
        offset = int(rng.integers(max(1, len(source) - length)))
        piece = source[offset : offset + length]
        placed = _placed((gain * piece * edges(len(piece), 3)[:, None]).astype(np.float32), start, len(shapes))
        np.copyto(shapes, _over(shapes, placed))


def _blink(shapes: Floats, cues: Doubles, motions: Motions, rng: np.random.Generator) -> None:
    """Recorded intervals at a personal rate; half the blinks wait for a cue (gaze shift, phrase end) close by."""
    end_s = len(shapes) * FRAME_S
    pace, gaps = rng.uniform(0.75, 1.4), np.concatenate(motions.gaps)
    at, times = rng.uniform(0, 3), []
    while at < end_s:
        near = cues[np.abs(cues - at) < 0.6] if len(cues) else cues
        times.append(float(rng.choice(near)) if len(near) and rng.random() < 0.5 else at)
        at += pace * float(rng.choice(gaps))
    times += [cue for cue in cues if rng.random() < 0.08]
    last = -1.0
    for instant in sorted(times):
        if instant - last < 0.5:
            continue
        last = instant
        curve = _pick(motions.blinks, rng)
        size = rng.uniform(0.55, 0.8) if rng.random() < 0.15 else rng.uniform(0.85, 1.0)
        placed = _placed((size * curve).astype(np.float32), instant, len(shapes))
        np.maximum(shapes, placed, out=shapes)
