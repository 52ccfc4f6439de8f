"""Pictures of a recorded run: a plot over time, and a contact sheet of twelve instants.

The plot (extra `plots`) shows voice, head pose, six face channels, the neck, and every other joint as a coloured band.
The sheet (extra `pictures`) shows the virtual head, and next to it the robot: the largest nod from its top over its
lowest point to its end, the strongest blink, smile and look aside; the other instants are spread in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.output_paths import FAINT, INK, checked_png, new_figure, plain, save
from sfms_robot.app.progress import tracked
from sfms_robot.app.replay.run_file import RunRecording, read_recording, summary
from sfms_robot.config import load_head
from sfms_robot.data import Report
from sfms_robot.errors import ConfigError
from sfms_robot.face import drawing
from sfms_robot.face.human import load_human
from sfms_robot.frames import AUDIO_HZ, CHANNEL_INDEX, FRAME_S, Doubles, Floats
from sfms_robot.signals.events import find_nods, runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS: Final = 4
_INSTANTS: Final = 12
_ALONE_PX: Final = ((392,), 352)  # widths of the pictures of an instant, and their height: the virtual head
_BESIDE_PX: Final = ((258, 182), 316)  # the virtual head and the robot
_CAPTION_PX: Final = 58
_GAP_PX: Final = 8
_TITLE_PX: Final = 62
_PAPER: Final = (1.0, 1.0, 1.0)
_PALE: Final = (0.45, 0.46, 0.49)
_ACCENT: Final = (0.10, 0.38, 0.55)

_SIZE_IN: Final = (16.0, 12.0)
_DPI: Final = 100
_PHRASE, _VOICE = "#f4e9d2", "#a8772c"
_COLORS: Final = ("#1f6f9c", "#c8553d", "#5b8c5a", "#8b6bb1", "#c29a2e", "#3f8f8b")
_NECK_JOINTS: Final = 3
# The joints first move in from where they stood when torque came on: left out of the scale of the neck's panel.
_COMING_IN_S: Final = 1.0
_LEAST_SCALE_DEG: Final = 1.0  # a joint that hardly moves stays pale

_STATES: Final = {
    "starting": "#b8d4e3",
    "idle": "#dfe3e8",
    "listening": "#cfe5c8",
    "speaking": "#d9cce9",
    "degraded": "#f2d9a0",
    "halted": "#dd6b5a",
    "stopping": "#b8d4e3",
}
_EVENTS: Final = {"nod": "v", "blink": "|", "smile": "^"}
_LEAST_LABEL: Final = 0.04  # share of the width; a shorter state has a color but no label

# Signals of a face: the mean of channels, less the mean of others. The plot has a lane for each of the first six.
_SIGNALS: Final = {
    "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
    "squint": ("eyeSquintLeft", "eyeSquintRight"),
    "gaze left +": ("eyeLookOutLeft", "eyeLookInRight"),
    "brow inner up": ("browInnerUp",),
    "smile": ("mouthSmileLeft", "mouthSmileRight"),
    "jaw open": ("jawOpen",),
    "turn": ("yaw",),
    "tilt": ("roll",),
}
_LESS: Final = {"gaze left +": ("eyeLookInLeft", "eyeLookOutRight")}
_LANES: Final = list(_SIGNALS)[:6]
# Labels below an instant of a sheet: signal, direction, least value that counts (rad for turn and tilt), label.
_LABELS: Final = (
    ("blink", 1, 0.45, "blink"),
    ("smile", 1, 0.25, "smile"),
    ("brow inner up", 1, 0.30, "brows up"),
    ("jaw open", 1, 0.30, "mouth open"),
    ("gaze left +", 1, 0.25, "looks left"),
    ("gaze left +", -1, 0.25, "looks right"),
    ("turn", 1, np.radians(7.0), "turns left"),
    ("turn", -1, np.radians(7.0), "turns right"),
    ("tilt", 1, np.radians(5.0), "tilts"),
    ("tilt", -1, np.radians(5.0), "tilts"),
)
_SEEN_ONLY: Final = ("jaw open", "tilt")  # these are labelled where they occur, and get no picture of their own


def replay_run(folder: Path, plot_png: Path | None, sheet_png: Path | None) -> Report:
    """Draw the requested pictures; return a summary of the recording. Raises ConfigError, MissingExtra."""
    pictures = (plot_png, "--plot", plot), (sheet_png, "--sheet", sheet)
    wanted = [(checked_png(png, option), draw) for png, option, draw in pictures if png is not None]
    recording = read_recording(folder)
    for png, draw in tracked(wanted, "drawing"):
        draw(recording, png)
    return summary(recording)


# --- plot -------------------------------------------------------------------------------------------------------------


def plot(recording: RunRecording, png: Path) -> None:
    """Draw the run as a PNG of 1600 x 1200. Raises MissingExtra without matplotlib."""
    figure = new_figure(*_SIZE_IN, _DPI)
    panels = figure.subplots(len(_PANELS), 1, sharex=True, height_ratios=[height for height, _, _ in _PANELS])
    figure.suptitle(recording.title, color=INK, fontsize=15, fontweight="bold")
    phrases = runs(recording.talking)
    for axes, (_, title, draw) in zip(panels, _PANELS, strict=True):
        plain(axes, grid="x")
        axes.set_title(title, loc="left", color=INK, fontsize=11, fontweight="bold")
        draw(axes, recording)
        if draw not in (_states, _heat):
            for start, end in phrases:
                span_s = recording.heard_s[start] - FRAME_S, recording.heard_s[end - 1]
                axes.axvspan(*span_s, color=_PHRASE, lw=0, zorder=0)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, frameon=False, fontsize=9.5)
    panels[0].set_xlim(0, max(recording.duration_s, FRAME_S))
    panels[-1].set_xlabel("time, s", color=INK)
    save(figure, png)


def _states(axes: Axes, recording: RunRecording) -> None:
    """Draw the states of the run as a band, and on it the planned events."""
    for (since_s, name, why), (end_s, _, _) in pairwise([*recording.states, (recording.duration_s, "", ())]):
        axes.axvspan(since_s, end_s, color=_STATES.get(name, FAINT), lw=0)
        if end_s - since_s > _LEAST_LABEL * recording.duration_s:
            text = f"{name}: {', '.join(why)}" if why else name
            axes.text(since_s, 0.7, f" {text}", va="center", fontsize=9, clip_on=True)
    for kind, marker in _EVENTS.items():
        at_s = [start_s for start_s, planned in recording.events if planned == kind]
        if at_s:
            axes.plot(at_s, [0.25] * len(at_s), marker, color=INK, ms=6, ls="", label=kind)
    axes.set_ylim(0, 1)
    axes.set_yticks([])


def _voice(axes: Axes, recording: RunRecording) -> None:
    """Draw the envelope of the sound: minimum and maximum of every hundredth of a second."""
    piece = AUDIO_HZ // 100
    pieces = recording.audio[: len(recording.audio) // piece * piece].reshape(-1, piece)
    if len(pieces):
        times_s = recording.heard_s[0] - FRAME_S + (np.arange(len(pieces)) + 0.5) / 100
        axes.fill_between(times_s, pieces.min(axis=1), pieces.max(axis=1), color=_VOICE, lw=0)
        top = max(0.05, float(np.abs(recording.audio).max()))
        axes.set_ylim(-top, top)
    if not recording.has_voice:
        axes.text(0.5, 0.5, "nothing was heard", transform=axes.transAxes, ha="center", va="center", color=FAINT)
    axes.set_yticks([])


def _pose(axes: Axes, recording: RunRecording) -> None:
    for color, name in zip(_COLORS, ("pitch", "yaw", "roll"), strict=False):
        angle_deg = np.degrees(recording.motion[:, CHANNEL_INDEX[name]])
        axes.plot(recording.times_s, angle_deg, color=color, lw=2.0 if name == "pitch" else 1.3, label=name)
    lowest = [low for _, low, _ in _nods(recording.times_s, recording.motion)]
    if lowest:
        at_deg = np.degrees(recording.motion[lowest, CHANNEL_INDEX["pitch"]]) + 1.2
        axes.plot(recording.times_s[lowest], at_deg, "v", color=_COLORS[0], ms=6, label="nod")
    axes.margins(y=0.12)
    axes.axhline(0, color=FAINT, lw=0.6)


def _lanes(axes: Axes, recording: RunRecording) -> None:
    """Draw six channels in a lane each, 0 to 1 (gaze -1 to 1), the first on top."""
    lanes = len(_LANES)
    for lane, (name, color) in enumerate(zip(_LANES, _COLORS, strict=True)):
        base = float(lanes - 1 - lane)
        value, middle = _signal(recording.motion, name), 0.5 if name in _LESS else 0.0
        curve = base + 0.84 * (middle + (1 - middle) * value)
        axes.fill_between(recording.times_s, base + 0.84 * middle, curve, color=color, alpha=0.35, lw=0)
        axes.plot(recording.times_s, curve, color=color, lw=1.2)
        axes.axhline(base, color=FAINT, lw=0.5)
    axes.set_yticks([lanes - 1 - lane + 0.42 for lane in range(lanes)], _LANES)
    axes.set_ylim(-0.05, lanes)


def _neck_joints(recording: RunRecording) -> list[int]:
    """Return the joints that are drawn large: the neck, or else those that travel furthest."""
    neck = [n for n, name in enumerate(recording.joints) if "neck" in name or name.startswith("head_")]
    travel = np.abs(np.diff(recording.goals_rad, axis=0)).sum(axis=0)
    return (neck or np.argsort(-travel).tolist())[:_NECK_JOINTS]


def _neck(axes: Axes, recording: RunRecording) -> None:
    joints = _neck_joints(recording)
    for color, joint in zip(_COLORS, joints, strict=False):
        goal_deg, present_deg = (np.degrees(a[:, joint]) for a in (recording.goals_rad, recording.present_rad))
        axes.plot(recording.times_s, goal_deg, color=color, lw=2.6, alpha=0.75, label=recording.joints[joint])
        axes.plot(recording.times_s, present_deg, color=INK, lw=0.8)
    if joints and (shown := recording.times_s > _COMING_IN_S).any():
        shown_deg = np.degrees(recording.goals_rad[shown][:, joints])
        room_deg = max(0.12 * float(np.ptp(shown_deg)), _LEAST_SCALE_DEG)
        axes.set_ylim(float(shown_deg.min()) - room_deg, float(shown_deg.max()) + room_deg)
    axes.axhline(0, color=FAINT, lw=0.6)


def _heat(axes: Axes, recording: RunRecording) -> None:
    """Draw every other joint as a band: its goal from its median, red up and blue down, full color at the furthest."""
    neck = _neck_joints(recording)
    joints = [n for n in range(len(recording.joints)) if n not in neck]
    axes.grid(visible=False)
    goals_deg, times_s = np.degrees(recording.goals_rad[:, joints]), recording.times_s
    if not joints:
        axes.set_yticks([])
        return
    off = goals_deg - np.median(goals_deg, axis=0)
    scaled = off / np.maximum(np.abs(off).max(axis=0), _LEAST_SCALE_DEG)
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else FRAME_S
    edges_s = np.append(times_s, times_s[-1] + step_s) - step_s / 2  # ticks that were skipped leave a longer cell
    axes.pcolormesh(edges_s, np.arange(len(joints) + 1) - 0.5, scaled.T, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_ylim(len(joints) - 0.5, -0.5)
    axes.set_yticks(range(len(joints)), [recording.joints[joint] for joint in joints])
    for row, travel_deg in enumerate(np.ptp(goals_deg, axis=0)):
        axes.axhline(row + 0.5, color="white", lw=1.0)
        axes.text(1.005, row, f"{travel_deg:.0f}", transform=axes.get_yaxis_transform(), va="center", fontsize=8)


_PANELS: Final = (  # height, title, and the function that draws it
    (0.3, "state of the run, and planned events", _states),
    (0.8, "speaker's voice (shaded: in a phrase)", _voice),
    (1.45, "head pose of the listener, deg  (pitch + nose down, yaw + own left, roll + right ear down)", _pose),
    (2.1, "face of the listener, 0 to 1 per lane", _lanes),
    (1.45, "joint angles, deg  (thick: goal written to the servo, thin dark: where the servo is)", _neck),
    (3.6, "the other joints: goal from its median, each scaled to its own travel (deg, right)", _heat),
)


# --- contact sheet: the instants -------------------------------------------------------------------------------------


def pick_instants(times_s: Doubles, motion: Floats) -> dict[int, str]:
    """Return the labels of twelve rows of a motion (N, 58), by row, in order. Raises ValueError when N = 0."""
    if not len(times_s):
        raise ValueError("a sheet needs at least one frame")
    signals = {name: _signal(motion, name) for name in _SIGNALS}
    nods = _nods(times_s, motion)
    labels = {}
    if nods:
        largest = max(nods, key=lambda nod: np.ptp(motion[nod[0] : nod[2] + 1, CHANNEL_INDEX["pitch"]]))
        labels = dict(zip(largest, ("nod begins", "nod, lowest", "nod ends"), strict=True))
    rows = list(dict.fromkeys([*labels, *_peaks(signals)]))[:_INSTANTS]
    while len(rows) < min(_INSTANTS, len(times_s)):
        rows.append(_loneliest(times_s, rows))
    for row in rows:
        there = [label for name, sign, least, label in _LABELS if sign * signals[name][row] > least]
        there = ["nod"] * any(begin <= row <= end for begin, _, end in nods) + there
        labels.setdefault(row, ", ".join(there[:3]) or "-")
    return dict(sorted(labels.items()))


def _signal(motion: Floats, name: str) -> Floats:
    """Return a signal (N,) of `_SIGNALS`."""
    plus, minus = ([CHANNEL_INDEX[channel] for channel in each] for each in (_SIGNALS[name], _LESS.get(name, ())))
    value: Floats = motion[:, plus].mean(axis=1)
    return value - motion[:, minus].mean(axis=1) if minus else value


def _nods(times_s: Doubles, motion: Floats) -> list[tuple[int, int, int]]:
    """Return the rows at which nods begin, are lowest and end. A move up and back is a look, not a nod."""
    if len(times_s) < 2:
        return []
    pitch, rate_hz = motion[:, CHANNEL_INDEX["pitch"]], 1.0 / float(np.median(np.diff(times_s)))
    ends = [(round(start_s * rate_hz), round(end_s * rate_hz)) for start_s, end_s, _ in find_nods(pitch, rate_hz)]
    return [
        (begin, low, end)
        for begin, end in ends
        if begin < (low := begin + int(np.argmax(pitch[begin : end + 1]))) < end
    ]


def _peaks(signals: dict[str, Floats]) -> list[int]:
    """Return the strongest instant of each kind of event that occurs; except for the blink, with open eyes."""
    least = {name: least for name, _, least, _ in _LABELS if name not in _SEEN_ONLY}
    rows = []
    for name in least:
        strength = np.abs(signals[name])
        row = int(np.argmax(strength if name == "blink" else strength * (signals["blink"] < least["blink"])))
        if strength[row] >= least[name]:
            rows.append(row)
    return rows


def _loneliest(times_s: Doubles, rows: Sequence[int]) -> int:
    """Return the row that is furthest in time from the chosen rows; the middle of the run when none is chosen."""
    if not rows:
        return len(times_s) // 2
    away_s = np.abs(times_s[:, None] - times_s[rows]).min(axis=1)
    away_s[rows] = -1
    return int(np.argmax(away_s))


# --- contact sheet: the picture --------------------------------------------------------------------------------------


def sheet(recording: RunRecording, png: Path | str) -> dict[int, str]:
    """Draw virtual head and robot at twelve instants: the face of the listener, the servos. Return the instants.

    The robot is left out if its head is not available or has other joints now. Raises MissingExtra without vtk.
    """
    vtk, scene, motion = drawing.load_vtk(), None, recording.motion
    with suppress(ConfigError):
        head = load_head(recording.about["head"])
        scene = scene_of(head) if tuple(head.joints) == recording.joints else None
    instants = pick_instants(recording.times_s, motion)
    talking = recording.talks_at(recording.times_s)
    angles_rad = np.where(np.isnan(recording.present_rad), recording.goals_rad, recording.present_rad)
    widths, cell_high = _ALONE_PX if scene is None else _BESIDE_PX
    wide, high = sum(widths) + _GAP_PX, cell_high + _CAPTION_PX
    size = (_COLUMNS * wide + _GAP_PX, -(-len(instants) // _COLUMNS) * high + _TITLE_PX)
    window, human = drawing.open_window(vtk, size), load_human(hair=True)
    paper = drawing.add_renderer(vtk, window, (0, 0, 1, 1), _PAPER)
    drawing.add_text(vtk, paper, recording.title, (_GAP_PX + 4, size[1] - 42), 24).SetBold(True)
    for index, (row, label) in enumerate(instants.items()):
        left = _GAP_PX + index % _COLUMNS * wide
        low = size[1] - _TITLE_PX - index // _COLUMNS * high - cell_high
        cells = []
        for begin, width in zip((0, widths[0]), widths, strict=False):
            x0, x1 = (left + begin) / size[0], (left + begin + width) / size[0]
            ends = x0, low / size[1], x1, (low + cell_high) / size[1]
            cells.append(drawing.add_renderer(vtk, window, ends, drawing.BACKGROUND))
        drawing.add_head(vtk, cells[0], human, motion[row])
        drawing.look(cells[0], (1.07, 0.36, 0.07), (0.012, 0.0, 0.020), 17.4)  # from a little to the left of the head
        if scene is not None:
            drawing.add_robot(vtk, cells[1], scene, scene.values(angles_rad[row].astype(np.float64)))
        drawing.add_text(vtk, paper, f"{recording.times_s[row]:.2f} s", (left + 4, low - 26), 19).SetBold(True)
        drawing.add_text(vtk, paper, label, (left + 96, low - 26), 19, _ACCENT).SetBold(label != "-")
        if recording.has_voice:
            speaks = "talks" if talking[row] else "silent"
            drawing.add_text(vtk, paper, f"speaker {speaks}", (left + 4, low - 46), 14, _PALE)
    drawing.save(vtk, window, png)
    return instants
