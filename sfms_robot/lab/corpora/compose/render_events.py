"""A listener's motion from a score of events: recorded primitives, stretched and placed at the times of the events.

Everything is added to a head and a face that never stand still. Layers are joined so that neither value nor speed
jumps: primitives start and end at rest, looks follow `signals.gaze_kinematics`, loops are crossfaded. The times and
sizes of the placed primitives are returned as events. The motion has no others of their kind, except the movements of a
head that speaks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np

from sfms_robot.config.head import other_side
from sfms_robot.frames import (
    BLENDSHAPES,
    CHANNEL_INDEX,
    FRAME_HZ,
    FRAME_S,
    LATERAL_POSE,
    MOTION_DIM,
    POSE,
    SHAPES,
    Doubles,
    Floats,
    ListenerEvent,
    clip_shapes,
)
from sfms_robot.lab.corpora.compose.motions import (
    FADE,
    SHAPE,
    SMILE,
    Rng,
    edges,
    first_frame,
    held,
    laid_event,
    over,
    pick,
    placed,
    slow,
    stretched,
    tiled,
)
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals import gaze_kinematics
from sfms_robot.signals.events import runs
from sfms_robot.signals.motion_primitives import Motions

NOD_RAD_S2: Final = np.deg2rad(1600)  # the heads that will play this limit their necks to 1800 deg/s^2
_LIDS: Final = [SHAPE["eyeBlinkLeft"], SHAPE["eyeBlinkRight"]]
_MIRROR: Final = [BLENDSHAPES.index(other_side(name)) for name in BLENDSHAPES]
_TURNED: Final = [CHANNEL_INDEX[name] for name in LATERAL_POSE]


Events = list[ListenerEvent]
NO_SPANS: Final = np.zeros((0, 2))
NEVER: Final = np.zeros(0)


class Score(NamedTuple):
    """Events within `frames` frames, in seconds from their beginning; spans are (K, 2) start, end.

    Attributes:
        nods, shakes, tilts, laughs, talk, backchannels, mm_hms: the listener's own.
        gaze: (start, end, where) of looks away from the speaker: "side A".."side E", "down", "screen" or "away". Angle
            and side are drawn by `signals.event_sizes`, since a robot does not sit at their table.
        shared_laughs: laughs of the others.
        smiles: the listener's answers to others' smiles, (K, 3): start, end, size.
        asked, ends: instants at which the others asked something, and at which their phrases ended.
        mouth: (frames, 52) that belongs to the listener's own recorded voice, or None.
    """

    frames: int
    nods: Doubles = NO_SPANS
    shakes: Doubles = NO_SPANS
    tilts: Doubles = NO_SPANS
    laughs: Doubles = NO_SPANS
    talk: Doubles = NO_SPANS
    backchannels: Doubles = NO_SPANS
    mm_hms: Doubles = NO_SPANS
    gaze: tuple[tuple[float, float, str], ...] = ()
    shared_laughs: Doubles = NO_SPANS
    smiles: Doubles = NO_SPANS
    asked: Doubles = NEVER
    ends: Doubles = NEVER
    mouth: Floats | None = None


@dataclass(frozen=True)
class Acted:
    """Motion (N, 58), its events sorted by start, and the part (N, 3) of its head's angles that belongs to the gaze."""

    motion: Floats
    events: tuple[ListenerEvent, ...]
    head_of_gaze_rad: Floats


def act(score: Score, motions: Motions, rng: Rng) -> Acted:
    """Return the motion of a listener whose habits (size and pace of nods, blinks, directions of looks) are drawn."""
    motion = np.zeros((score.frames, MOTION_DIM), np.float32)
    pose, shapes = motion[:, POSE], motion[:, SHAPES]  # views
    targets, looks = _targets(score, rng)
    _sway(pose, motions, rng)
    pose += _talking_head(score, motions, rng)
    events = looks + _swing(pose, "nod", score.nods, motions, rng)
    events += _swing(pose, "shake", score.shakes, motions, rng)
    events += _tilt(pose, score.tilts, rng)
    shapes += _idle(motions, score.frames, rng)
    events += _smile(shapes, score, motions, rng)
    events += _raise_brows(shapes, score, motions, rng)
    events += _speak(shapes, score, motions, rng)
    cues = np.concatenate([score.ends, [look.start_s for look in looks]])
    events += _blink(shapes, cues, motions, rng)
    clip_shapes(motion)
    head = _look(motion, targets, int(rng.integers(2**31)))
    acted = Acted(motion, tuple(sorted(events, key=lambda event: event.start_s)), head)
    return _mirror_image(acted) if rng.random() < 0.5 else acted


def speaker_motion(
    mouth: Floats,
    motions: Motions,
    rng: Rng,
    attention: Floats,
    laughs: Doubles = NO_SPANS,
    nods: Doubles = NO_SPANS,
    smiles: Doubles = NO_SPANS,
) -> Floats:
    """Return motion (N, 58) of a person who speaks with this mouth (N, 52); head and the rest of the face are recorded.

    Args:
        smiles: (K, 3) start, end [s], size.
        attention: (N,) 1 where they look at the listener, 0 where they do not, NaN where unknown.
        laughs, nods: (K, 2) seconds.
    """
    motion = np.zeros((len(mouth), MOTION_DIM), np.float32)
    pose, shapes = motion[:, POSE], motion[:, SHAPES]  # views
    pose += rng.uniform(0.5, 1.1) * tiled(motions.heads, len(mouth), rng)
    _swing(pose, "nod", nods, motions, rng)
    shapes += np.clip(tiled(motions.faces, len(mouth), rng) + rng.uniform(0.8, 1.1) * mouth, 0, 1)
    for start, end in laughs:
        lay_smile(shapes, start - 0.2, end - start + rng.uniform(0.8, 1.8), rng.uniform(0.5, 0.9), 0.7, motions, rng)
    for start, end, size in smiles.tolist():
        lay_smile(shapes, start, end - start, size, 0.1, motions, rng)
    clip_shapes(motion)
    seed = int(rng.integers(2**31))
    _look(motion, _speaker_targets(attention, rng), seed)
    return mirrored(motion) if rng.random() < 0.5 else motion


def mirrored(motion: Floats) -> Floats:
    """Return the motion (N, 58) of the mirror image."""
    out = motion.copy()
    out[:, SHAPES] = motion[:, SHAPES][:, _MIRROR]
    out[:, _TURNED] *= -1
    return out


def _mirror_image(acted: Acted) -> Acted:
    head = acted.head_of_gaze_rad * np.array([-1, 1, -1], np.float32)
    events = tuple(
        event
        if event.target_rad is None
        else replace(event, target_rad=(0.0 - event.target_rad[0], event.target_rad[1]))
        for event in acted.events
    )
    return Acted(mirrored(acted.motion), events, head)


# --- head -------------------------------------------------------------------------------------------------------


def _sway(pose: Floats, motions: Motions, rng: Rng) -> None:
    """Fill a pose (N, 6) with the slow motion of a head at rest, as recorded: about a degree, and millimetres."""
    unit = [piece / (piece.std(axis=0) + 1e-6) for piece in motions.sway]
    size = np.deg2rad(rng.uniform(0.4, 1.1)) * np.array([1.0, 0.8, 1.0], np.float32)
    pose[:, :3] = tiled(unit, len(pose), rng, fade=2 * FADE) * size * rng.choice([-1, 1], 3)
    slowly = [slow(head[:, 3:], 0.5) for head in motions.heads]
    pose[:, 3:] = rng.uniform(0.2, 0.5) * tiled(slowly, len(pose), rng)


def _talking_head(score: Score, motions: Motions, rng: Rng) -> Floats:
    """Return the head (N, 6) of a person who speaks."""
    talks = np.zeros(score.frames, np.float32)
    for start, end in score.talk:
        talks[max(0, first_frame(start)) : max(0, first_frame(end))] = 1
    ramp = edges(FRAME_HZ, FRAME_HZ // 2)
    eased = np.convolve(talks, ramp / ramp.sum(), "same")[:, None]
    return np.asarray(eased * rng.uniform(0.2, 0.4) * tiled(motions.heads, score.frames, rng), np.float32)


def nod_habit(rng: Rng) -> tuple[float, float]:
    """Draw a person's usual size of nods [rad, peak to peak], about 5 degrees, and their 1.8 to 3 swings a second."""
    usual = sizes.NOD_DEG[1]
    size = np.deg2rad(rng.normal(usual, usual * sizes.HABIT_SPREAD))
    return float(size), rng.uniform(*sizes.SWINGS_HZ)


def nod_of(kind: str, start_s: float, length_s: float, habit: tuple[float, float], rng: Rng) -> ListenerEvent:
    """Return a nod of about this duration: 1 to 4 swings of 1.5 to 3.3 Hz, the first of 2.2 to 12 degrees.

    `habit`: from `nod_habit`.
    """
    usual_rad, pace_hz = habit
    swings, lasts_s = sizes.swings(length_s, pace_hz)
    least, _, most = np.deg2rad(sizes.NOD_DEG)
    size = np.clip(usual_rad * np.exp(rng.normal(0, sizes.NOD_SPREAD)), least, most)
    return ListenerEvent(kind, start_s, lasts_s, float(size), swings)


def nod_curve(nod: ListenerEvent, fall: float, shape: Floats, frames: int) -> Floats:
    """Return the pitch [rad], nose down, (frames,) of a nod, with a smaller size if a neck could not follow.

    `fall`: size of each swing relative to the swing before.
    """
    out = np.zeros(frames)
    each_s = nod.duration_s / nod.swings
    size = min(nod.size, NOD_RAD_S2 * each_s**2 / max(_bend(shape, each_s), 1.0))
    low, high = max(0, first_frame(nod.start_s) - 1), min(frames, first_frame(nod.start_s + nod.duration_s) + 2)
    times = np.arange(low + 1, high + 1) * FRAME_S - nod.start_s
    for swing in range(nod.swings):
        phase = times / each_s - swing
        out[low:high] += size * fall**swing * np.interp(phase, np.linspace(0, 1, len(shape)), shape, 0, 0)
    return out.astype(np.float32)


def _swing(pose: Floats, kind: Literal["nod", "shake"], spans: Doubles, motions: Motions, rng: Rng) -> Events:
    """Add nods or shakes to a pose (N, 6)."""
    habit, events = nod_habit(rng), []
    for start, end in spans.tolist():
        nod, fall = nod_of(kind, start, end - start, habit, rng), rng.uniform(0.65, 0.95)
        curve = nod_curve(nod, fall, pick(motions.nods if kind == "nod" else motions.shakes, rng), len(pose))
        if kind == "shake":
            curve = rng.choice([-1, 1]) * (sizes.SHAKE * curve)
        pose[:, 1 if kind == "nod" else 2] += curve
        events.append(replace(nod, size=float(np.ptp(curve))))
    return events


def _tilt(pose: Floats, spans: Doubles, rng: Rng) -> Events:
    """Add tilts to a pose (N, 6)."""
    events = []
    for start, end in spans:
        curve = np.deg2rad(rng.uniform(*sizes.TILT_DEG)) * edges(max(12, int((end - start) * FRAME_HZ) + 12), 12)
        pose[:, 0] += rng.choice([-1, 1]) * placed(curve, start, len(pose))
        events.append(laid_event("tilt", start, curve, curve.max()))
    return events


def _bend(shape: Floats, length_s: float) -> float:
    """Return the largest second derivative of a unit cycle over unit time, sampled at the frame rate."""
    samples = max(4, round(length_s * FRAME_HZ))
    played = np.interp(np.linspace(0, 1, samples + 1), np.linspace(0, 1, len(shape)), shape)
    twice = np.concatenate([[0, 0], np.tile(played[:-1], 2), [0, 0, 0]])
    return float(np.abs(np.diff(twice, 2)).max()) * samples**2


# --- gaze -------------------------------------------------------------------------------------------------------


def _look(motion: Floats, targets: Floats, seed: int) -> Floats:
    """Turn eyes and head of a motion (N, 58) to targets (N, 2); return the angles added to the head (N, 3)."""
    head, eyes, _ = gaze_kinematics.follow(targets, motion[:, POSE], gaze_kinematics.start(seed))
    motion[:, POSE][:, :3] += head
    motion[:, list(gaze_kinematics.EYE_CHANNELS)] = eyes
    return head


def _targets(score: Score, rng: Rng) -> tuple[Floats, Events]:
    """Return gaze targets (N, 2) yaw and pitch [rad] in steps, the speaker straight ahead, and the gaze shifts."""
    seats: dict[str, tuple[float, float]] = {}
    out = np.zeros((score.frames, 2), np.float32)
    for start, end, where in score.gaze:
        far, side, up = rng.random(3).tolist()
        target = sizes.aside(sizes.aside_rad(far), side, up)
        if where.startswith("side"):  # a person stays in the same seat
            target = seats.setdefault(where, target)
        out[max(0, first_frame(start)) : max(0, first_frame(end))] = target
    return out, _shifts(out)


def _shifts(targets: Floats) -> Events:
    """Return one event at each step of the targets (N, 2); before the first frame the listener looks at the person."""
    before = np.concatenate([np.zeros((1, 2), np.float32), targets])
    at = np.flatnonzero((np.diff(before, axis=0) != 0).any(axis=1)).tolist()
    return [
        ListenerEvent(
            "gaze_shift",
            first * FRAME_S,
            (last - first) * FRAME_S,
            float(np.hypot(*(targets[first] - before[first]))),
            target_rad=(float(targets[first, 0]), float(targets[first, 1])),
        )
        for first, last in pairwise([*at, len(targets)])
    ]


def _speaker_targets(attention: Floats, rng: Rng) -> Floats:
    """Return gaze targets (N, 2) of a speaker: at the listener or not as `attention` says, at random where unknown."""
    at_listener = attention > 0.5
    unknown = np.isnan(attention)
    looks, row = rng.random() < 0.6, 0
    while row < len(attention):
        long = max(5, int(FRAME_HZ * 1.5 * np.exp(rng.normal(0, 0.7))))
        at_listener[row : row + long] |= unknown[row : row + long] & looks
        looks, row = not looks, row + long
    out = np.zeros((len(attention), 2), np.float32)
    for start, end in runs(~at_listener):
        while start < end:
            long = int(FRAME_HZ * rng.uniform(1, 4))
            aside = rng.choice([-1, 1]) * rng.uniform(15, 32), rng.normal(4, 6)
            out[start : min(end, start + long)] = np.deg2rad(aside)
            start += long
    return out


# --- face -------------------------------------------------------------------------------------------------------


def _idle(motions: Motions, frames: int, rng: Rng) -> Floats:
    """Return the motion of a resting face, lifted so that it hardly ever falls below the neutral."""
    moving = tiled(motions.idle, frames, rng, fade=12)
    return np.asarray(rng.uniform(0.7, 1.2) * (moving - np.percentile(moving, 20, axis=0)), np.float32)


def _smile(shapes: Floats, score: Score, motions: Motions, rng: Rng) -> Events:
    """Add smiles: to own laughs and returned smiles always, to others' laughs often, to backchannels and nods seldom.

    A laugh opens the jaw by 0.7 of the recorded opening, other smiles by 0.1 or 0.2.
    A smile that would begin during another smile is left out.
    """
    wanted = [
        ("laugh", a, b - a + rng.uniform(*sizes.LAUGH_LONGER_S), rng.uniform(*sizes.LAUGH), 0.7)
        for a, b in score.laughs
    ]
    wanted += [
        ("smile", a, max(b - a, sizes.smile_s(rng)), rng.uniform(0.35, 0.7), 0.2)
        for a, b in score.shared_laughs
        if rng.random() < sizes.SMILES_AFTER["laugh"]
    ]
    for kind, spans in (("mm_hm", score.backchannels), ("nod", score.nods)):
        some = [a for a, _ in spans if rng.random() < sizes.SMILES_AFTER[kind]]
        wanted += [("smile", a, sizes.smile_s(rng), rng.uniform(0.3, 0.5), 0.1) for a in some]
    wanted += [("smile", a + 0.2, b - a, max(size, sizes.SMILE[0]), 0.1) for a, b, size in score.smiles]
    events: Events = []
    for kind, start, seen_s, size, jaw in sorted(wanted, key=lambda one: (one[0] != "laugh", one[1])):
        if any(event.start_s - seen_s < start < event.end_s for event in events):
            continue
        curve = lay_smile(shapes, start - 0.2, seen_s, size, jaw, motions, rng)
        events.append(laid_event(kind, start - 0.2, curve, curve[:, SMILE].mean(axis=1).max()))
    return events


def lay_smile(
    shapes: Floats,
    start_s: float,
    seen_s: float,
    size: float,
    jaw: float,
    motions: Motions,
    rng: Rng,
) -> Floats:
    """Add a recorded smile to the face (N, 52) from `start_s` on; return its curve (K, 52)."""
    curve = held(pick(motions.smiles, rng), int(seen_s * FRAME_HZ))
    knots = np.arange(0, len(curve) + FRAME_HZ, FRAME_HZ)
    breath = np.interp(np.arange(len(curve)), knots, rng.uniform(0.9, 1.0, len(knots)))  # a smile never stands still
    curve = (size * curve * (breath * edges(len(curve), 9))[:, None]).astype(np.float32)
    curve[:, SHAPE["jawOpen"]] *= jaw
    np.copyto(shapes, over(shapes, placed(curve, start_s, len(shapes))))
    return curve


def _raise_brows(shapes: Floats, score: Score, motions: Motions, rng: Rng) -> Events:
    """Raise the brows after half of the questions and with some of the nods."""
    at = [instant for instant in score.asked if rng.random() < 0.5]
    at += [start for start, _ in score.nods if rng.random() < 0.15]
    events: Events = []
    for instant in sorted(at):
        if events and instant - 0.1 < events[-1].end_s:
            continue
        curve, size = pick(motions.brows, rng), rng.uniform(*sizes.BROW_RAISE)
        length = int(len(curve) * rng.uniform(*sizes.BROW_STRETCH))
        curve = (size * stretched(curve, length) * edges(length, 6)[:, None]).astype(np.float32)
        np.copyto(shapes, over(shapes, placed(curve, instant - 0.1, len(shapes))))
        events.append(laid_event("brow_raise", instant - 0.1, curve, size))
    return events


def _speak(shapes: Floats, score: Score, motions: Motions, rng: Rng) -> Events:
    """Add the mouth of the listener's own words: the voice's own, or else a recorded one, smaller for an "mm-hm".

    The size of an "mm-hm" event is its largest jaw opening.
    """
    said = np.zeros_like(shapes) if score.mouth is None else score.mouth
    source = motions.talk[0]
    short = {float(start) for start, _ in np.concatenate([score.backchannels, score.mm_hms])}
    for start, end in score.talk if score.mouth is None else ():
        length = max(4, int((end - start) * FRAME_HZ))
        gain = rng.uniform(*sizes.MM_HM) if any(abs(start - other) < 0.3 for other in short) else rng.uniform(0.6, 0.9)
        offset = rng.integers(max(1, len(source) - length))
        piece = source[offset : offset + length]
        said = said + placed((gain * piece * edges(len(piece), 3)[:, None]).astype(np.float32), start, len(shapes))
    np.copyto(shapes, over(shapes, said))
    events = []
    for start, end in score.mm_hms.tolist():
        low, high = max(0, first_frame(start)), max(first_frame(start) + 1, first_frame(end))
        jaw = float(said[low:high, SHAPE["jawOpen"]].max(initial=0.0))
        events.append(ListenerEvent("mm_hm", start, end - start, min(1.0, jaw)))
    return events


def _blink(shapes: Floats, cues: Doubles, motions: Motions, rng: Rng) -> Events:
    """Add blinks at recorded intervals and a personal rate; half of those near a gaze shift or phrase end are at it."""
    end_s = len(shapes) * FRAME_S
    pace, gaps = rng.uniform(0.75, 1.4), np.concatenate(motions.gaps)
    at, times = rng.uniform(0, 3), []
    while at < end_s:
        near = cues[np.abs(cues - at) < 0.6] if len(cues) else cues
        times.append(float(rng.choice(near)) if len(near) and rng.random() < 0.5 else at)
        at += pace * float(rng.choice(gaps))
    times += [cue for cue in cues if rng.random() < 0.08]
    events: Events = []
    for instant in sorted(times):
        if events and instant - events[-1].start_s < 0.5:
            continue
        curve = pick(motions.blinks, rng)
        size = rng.uniform(*sizes.BLINK[0 if rng.random() < sizes.SLIGHT_BLINKS else 1])
        curve = (size * curve).astype(np.float32)
        np.maximum(shapes, placed(curve, instant, len(shapes)), out=shapes)
        events.append(laid_event("blink", instant, curve, curve[:, _LIDS].mean(axis=1).max()))
    return events
