"""A recorded run on one page: voice, head pose, six face channels, the neck, every other joint as a coloured band."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

from sfms_robot.app.replay.run_file import RunRecording
from sfms_robot.errors import ConfigError, optional
from sfms_robot.frames import AUDIO_HZ, CHANNEL_INDEX, FRAME_S, Doubles, Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_IN: Final = (16.0, 12.0)
_DPI: Final = 100
_PHRASE, _VOICE, _INK, _FAINT = "#f4e9d2", "#a8772c", "#2a2d34", "#7d828c"
_COLORS: Final = ("#1f6f9c", "#c8553d", "#5b8c5a", "#8b6bb1", "#c29a2e", "#3f8f8b")
_NOD_RAD: Final = np.radians(2.0)
_NECK_JOINTS: Final = 3
_COMING_IN_S: Final = 1.0  # from where the joints stood when torque came on: not what the panel of the neck is about
_LEAST_SCALE_DEG: Final = 1.0  # a joint that hardly moves stays pale

_STATES: Final = {
    "starting": "#b8d4e3", "idle": "#dfe3e8", "listening": "#cfe5c8", "speaking": "#d9cce9", "degraded": "#f2d9a0",
    "halted": "#dd6b5a", "stopping": "#b8d4e3",
}  # fmt: skip
_EVENTS: Final = {"nod": "v", "blink": "|", "smile": "^"}
_LEAST_LABEL: Final = 0.04  # of the width: a state that is shorter has its color alone

# Lane of the face panel: name, channels added, channels taken off.
_LANES: Final = (
    ("blink", ("eyeBlinkLeft", "eyeBlinkRight"), ()),
    ("squint", ("eyeSquintLeft", "eyeSquintRight"), ()),
    ("gaze left +", ("eyeLookOutLeft", "eyeLookInRight"), ("eyeLookInLeft", "eyeLookOutRight")),
    ("brow inner up", ("browInnerUp",), ()),
    ("smile", ("mouthSmileLeft", "mouthSmileRight"), ()),
    ("jaw open", ("jawOpen",), ()),
)


def plot(recording: RunRecording, png: Path | str) -> None:
    """Draw the run as a PNG of 1600 x 1200. Raises MissingExtra without matplotlib."""
    with optional("a plot"):
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    if not Path(png).parent.is_dir():
        raise ConfigError(f"{png}: cannot be written: no folder {Path(png).parent}")
    style: dict[Any, Any] = {
        "font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": _FAINT,
        "xtick.color": _FAINT, "ytick.color": _FAINT, "axes.labelcolor": _INK, "text.color": _INK,
        "axes.titlesize": 11, "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.titlepad": 4.0,
    }  # fmt: skip
    with matplotlib.rc_context(style):
        figure = Figure(figsize=_SIZE_IN, dpi=_DPI)
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(
            6,
            1,
            height_ratios=(0.3, 0.8, 1.45, 2.1, 1.45, 3.6),
            left=0.105,
            right=0.955,
            top=0.925,
            bottom=0.045,
            hspace=0.25,
        )
        first = figure.add_subplot(grid[0])
        panels = [first, *(figure.add_subplot(grid[n], sharex=first) for n in range(1, 6))]
        figure.suptitle(recording.title, x=0.105, y=0.975, ha="left", fontsize=15, fontweight="bold")
        _states(panels[0], recording)
        _voice(panels[1], recording)
        _pose(panels[2], recording)
        _lanes(panels[3], recording)
        neck = _neck_joints(recording)
        _neck(panels[4], recording, neck)
        _heat(panels[5], recording, [n for n in range(len(recording.joints)) if n not in neck])
        for axes in panels[1:5]:
            _phrases(axes, recording)
        for axes in panels[:5]:
            axes.tick_params(labelbottom=False, length=3)
            axes.grid(axis="x", color="#00000012")
        first.set_xlim(0, max(recording.duration_s, FRAME_S))
        panels[5].set_xlabel("time, s")
        figure.savefig(png)


def _phrases(axes: Axes, recording: RunRecording) -> None:
    for start_s, end_s in _spans(recording.heard_s - FRAME_S, recording.heard_s, recording.talking):
        axes.axvspan(start_s, end_s, color=_PHRASE, lw=0, zorder=0)


def _spans(starts_s: Doubles, ends_s: Doubles, there: NDArray[np.bool_]) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], there.astype(int), [0]])))
    return [(float(starts_s[a]), float(ends_s[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _states(axes: Axes, recording: RunRecording) -> None:
    """What the run was doing as a band, and on it what the listener planned."""
    axes.set_title("state of the run, and what the listener planned")
    ends_s = [*(since_s for since_s, _, _ in recording.states[1:]), recording.duration_s]
    for (since_s, name, why), end_s in zip(recording.states, ends_s, strict=False):
        axes.axvspan(since_s, end_s, color=_STATES.get(name, _FAINT), lw=0)
        if end_s - since_s > _LEAST_LABEL * recording.duration_s:
            text = f"{name}: {', '.join(why)}" if why else name
            axes.text(since_s, 0.7, f" {text}", va="center", fontsize=9, clip_on=True)
    for kind, marker in _EVENTS.items():
        at_s = [start_s for start_s, told in recording.events if told == kind]
        if at_s:
            axes.plot(at_s, [0.25] * len(at_s), marker, color=_INK, ms=6, ls="", label=kind)
    axes.set_ylim(0, 1)
    axes.set_yticks([])
    if recording.events:
        _legend(axes)


def _voice(axes: Axes, recording: RunRecording) -> None:
    """Envelope of the sound, mirrored: the least and the most of every hundredth of a second."""
    axes.set_title("speaker's voice (shaded: in a phrase)")
    piece = AUDIO_HZ // 100
    whole = len(recording.audio) // piece * piece
    if whole:
        pieces = recording.audio[:whole].reshape(-1, piece)
        start_s = recording.heard_s[0] - FRAME_S
        times_s = start_s + (np.arange(len(pieces)) + 0.5) / 100
        axes.fill_between(times_s, pieces.min(axis=1), pieces.max(axis=1), color=_VOICE, lw=0)
        top = max(0.05, float(np.abs(recording.audio).max()))
        axes.set_ylim(-top, top)
    if not recording.has_voice:
        axes.text(0.5, 0.5, "nothing was heard", transform=axes.transAxes, ha="center", va="center", color=_FAINT)
    axes.set_yticks([])


def _pose(axes: Axes, recording: RunRecording) -> None:
    axes.set_title("head pose the listener asks for, deg  (pitch + nose down, yaw + own left, roll + right ear down)")
    for color, name in zip(_COLORS, ("pitch", "yaw", "roll"), strict=False):
        angle_deg = np.degrees(recording.motion[:, CHANNEL_INDEX[name]])
        axes.plot(recording.times_s, angle_deg, color=color, lw=2.0 if name == "pitch" else 1.3, label=name)
    pitch = recording.motion[:, CHANNEL_INDEX["pitch"]]
    nods = _nods(recording.times_s, pitch)
    if len(nods):
        axes.plot(
            recording.times_s[nods],
            np.degrees(pitch[nods]) + 1.2,
            "v",
            color=_COLORS[0],
            ms=6,
            label="nod",
        )
    axes.margins(y=0.12)
    axes.axhline(0, color=_FAINT, lw=0.6)
    _legend(axes)


def _nods(times_s: Doubles, pitch: Floats) -> NDArray[np.int64]:
    """Rows at the lowest points of nods: pitch 2 degrees below its own median of 1.6 s."""
    if len(times_s) < 3:
        return np.zeros(0, dtype=np.int64)
    step_s = float(np.median(np.diff(times_s)))
    above = pitch - median_filter(pitch, size=max(3, round(1.6 / step_s)), mode="nearest")
    rows: NDArray[np.int64] = find_peaks(
        above, height=_NOD_RAD, prominence=_NOD_RAD, distance=max(1, round(0.25 / step_s))
    )[0]
    return rows


def _lanes(axes: Axes, recording: RunRecording) -> None:
    """Six channels in lanes of their own, each 0 to 1 (gaze -1 to 1), first on top."""
    axes.set_title("face the listener asks for, 0 to 1 per lane")
    lanes = len(_LANES)
    for lane, (_, plus, minus) in enumerate(_LANES):
        base = float(lanes - 1 - lane)
        value = recording.motion[:, [CHANNEL_INDEX[c] for c in plus]].mean(axis=1)
        if minus:
            value = 0.5 + 0.5 * (value - recording.motion[:, [CHANNEL_INDEX[c] for c in minus]].mean(axis=1))
        zero = base + (0.42 if minus else 0.0)
        color = _COLORS[lane]
        axes.fill_between(recording.times_s, zero, base + 0.84 * value, color=color, alpha=0.35, lw=0)
        axes.plot(recording.times_s, base + 0.84 * value, color=color, lw=1.2)
        axes.axhline(base, color=_FAINT, lw=0.5)
    axes.set_yticks([lanes - 1 - lane + 0.42 for lane in range(lanes)], [name for name, _, _ in _LANES], color=_INK)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(-0.05, lanes)


def _neck_joints(recording: RunRecording) -> list[int]:
    """The joints drawn large: the neck, or else those that travel furthest."""
    neck = [n for n, name in enumerate(recording.joints) if "neck" in name or name.startswith("head_")]
    if not neck:
        travel = np.abs(np.diff(recording.goals_rad, axis=0)).sum(axis=0)
        neck = [int(n) for n in np.argsort(-travel)]
    return neck[:_NECK_JOINTS]


def _neck(axes: Axes, recording: RunRecording, joints: Sequence[int]) -> None:
    axes.set_title("joint angles, deg  (thick: goal written to the servo, thin dark: where the servo is)")
    for color, joint in zip(_COLORS, joints, strict=False):
        goal_deg, present_deg = (np.degrees(a[:, joint]) for a in (recording.goals_rad, recording.present_rad))
        axes.plot(recording.times_s, goal_deg, color=color, lw=2.6, alpha=0.75, label=recording.joints[joint])
        axes.plot(recording.times_s, present_deg, color=_INK, lw=0.8)
    if joints and (shown := recording.times_s > _COMING_IN_S).any():
        shown_deg = np.degrees(recording.goals_rad[shown][:, list(joints)])
        room_deg = max(0.12 * float(np.ptp(shown_deg)), _LEAST_SCALE_DEG)
        axes.set_ylim(float(shown_deg.min()) - room_deg, float(shown_deg.max()) + room_deg)
    axes.axhline(0, color=_FAINT, lw=0.6)
    if joints:
        _legend(axes)


def _heat(axes: Axes, recording: RunRecording, joints: Sequence[int]) -> None:
    """Every other joint as a band: its goal against its own rest, red up and blue down, full at its furthest."""
    axes.set_title("the other joints: goal from its median, each scaled to its own travel (deg, right)")
    if not joints:
        axes.set_yticks([])
        return
    goals_deg = np.degrees(recording.goals_rad[:, list(joints)])
    off = goals_deg - np.median(goals_deg, axis=0)
    travel_deg = np.ptp(goals_deg, axis=0)
    scaled = off / np.maximum(np.abs(off).max(axis=0), _LEAST_SCALE_DEG)
    times_s = recording.times_s
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else FRAME_S
    edges_s = np.append(times_s, times_s[-1] + step_s) - step_s / 2  # ticks that were skipped leave a longer cell
    axes.pcolormesh(edges_s, np.arange(len(joints) + 1) - 0.5, scaled.T, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_ylim(len(joints) - 0.5, -0.5)
    rows = range(len(joints))
    size: dict[str, Any] = {"fontsize": min(10.0, max(6.0, 8.0 * 26 / len(joints))), "color": _INK}
    axes.set_yticks(rows, [recording.joints[joint] for joint in joints], **size)
    axes.tick_params(axis="y", length=0)
    for row in rows:
        axes.axhline(row + 0.5, color="white", lw=1.0)
        axes.text(1.005, row, f"{travel_deg[row]:.0f}", transform=axes.get_yaxis_transform(), va="center", **size)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, frameon=False, fontsize=9.5, borderpad=0.1)
