"""Pictures of a recorded run: a plot over time, and a contact sheet of twelve instants.

The plot (extra `plots`) shows voice, head pose, six face channels, the neck, and every other joint as a coloured band.
The sheet (extra `pictures`) shows the virtual head, and beside it the robot: the largest nod from its top over its
lowest point to its end, the firmest blink, the broadest smile, the furthest look aside; the rest are spread in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import find_peaks

from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.output_paths import FAINT, INK, checked_png
from sfms_robot.app.replay.run_file import RunRecording, read_recording, summary
from sfms_robot.config import load_head
from sfms_robot.errors import ConfigError, optional
from sfms_robot.face.drawing import (
    BACKGROUND,
    add_head,
    add_renderer,
    add_robot,
    add_text,
    load_vtk,
    look,
    open_window,
    save,
)
from sfms_robot.face.human import HumanHead, load_human
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.frames import AUDIO_HZ, CHANNEL_INDEX, FRAME_S, Doubles, Floats

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

_NOD_RAD: Final = np.radians(2.0)  # pitch below its own median of `_NOD_WINDOW_S` that counts as a nod
_NOD_WINDOW_S: Final = 1.6
_HALF_NOD_S: Final = 0.5
_BLINK, _SMILE, _BROWS, _JAW, _ASIDE = 0.45, 0.25, 0.30, 0.30, 0.25
_TURN_RAD: Final = np.radians(7.0)
_TILT_RAD: Final = np.radians(5.0)


_SIZE_IN: Final = (16.0, 12.0)
_DPI: Final = 100
_PHRASE, _VOICE = "#f4e9d2", "#a8772c"
_COLORS: Final = ("#1f6f9c", "#c8553d", "#5b8c5a", "#8b6bb1", "#c29a2e", "#3f8f8b")
_NECK_JOINTS: Final = 3
_COMING_IN_S: Final = (
    1.0  # joints come from where they stood when torque came on: left out of the scale of the neck's panel
)
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


def replay_run(folder: Path, plot_png: Path | None, sheet_png: Path | None) -> dict[str, Any]:
    """Draw the pictures that are wanted; return a summary of the recording. Raises ConfigError, MissingExtra."""
    for png, option in ((plot_png, "--plot"), (sheet_png, "--sheet")):
        if png is not None:
            checked_png(png, option)
    recording = read_recording(folder)
    if plot_png is not None:
        plot(recording, plot_png)
    if sheet_png is not None:
        sheet(recording, sheet_png)
    return summary(recording)


def sheet(recording: RunRecording, png: Path | str) -> list[SheetInstant]:
    """Draw virtual head and robot at twelve instants: the face of the listener, the servos. Return the instants.

    A head that is not at hand, has other joints now or names no URDF is left out. Raises MissingExtra without vtk.
    """
    talking = recording.talks_at(recording.times_s) if recording.has_voice else None
    robot = None
    with suppress(ConfigError):
        head = load_head(recording.about["head"])
        scene = scene_of(head) if tuple(head.joints) == recording.joints else None
        if scene is not None:
            read_rad = recording.present_rad.astype(np.float64)
            robot = scene, np.where(np.isnan(read_rad), recording.goals_rad, read_rad)
    return render_sheet(png, recording.times_s, recording.motion, talking, recording.title, robot)


# --- plot -------------------------------------------------------------------------------------------------------------


def plot(recording: RunRecording, png: Path | str) -> None:
    """Draw the run as a PNG of 1600 x 1200. Raises MissingExtra without matplotlib."""
    with optional("a plot"):
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    if not Path(png).parent.is_dir():
        raise ConfigError(f"{png}: cannot be written: no folder {Path(png).parent}")
    style: dict[Any, Any] = {
        "font.size": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": FAINT,
        "xtick.color": FAINT,
        "ytick.color": FAINT,
        "axes.labelcolor": INK,
        "text.color": INK,
        "axes.titlesize": 11,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "axes.titlepad": 4.0,
    }
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
    """Draw the states of the run as a band, and on it the planned events."""
    axes.set_title("state of the run, and planned events")
    ends_s = [*(since_s for since_s, _, _ in recording.states[1:]), recording.duration_s]
    for (since_s, name, why), end_s in zip(recording.states, ends_s, strict=False):
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
    if recording.events:
        _legend(axes)


def _voice(axes: Axes, recording: RunRecording) -> None:
    """Draw the envelope of the sound: the least and the most of every hundredth of a second."""
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
        axes.text(0.5, 0.5, "nothing was heard", transform=axes.transAxes, ha="center", va="center", color=FAINT)
    axes.set_yticks([])


def _pose(axes: Axes, recording: RunRecording) -> None:
    axes.set_title("head pose of the listener, deg  (pitch + nose down, yaw + own left, roll + right ear down)")
    for color, name in zip(_COLORS, ("pitch", "yaw", "roll"), strict=False):
        angle_deg = np.degrees(recording.motion[:, CHANNEL_INDEX[name]])
        axes.plot(recording.times_s, angle_deg, color=color, lw=2.0 if name == "pitch" else 1.3, label=name)
    pitch = recording.motion[:, CHANNEL_INDEX["pitch"]]
    nods = _nods(recording.times_s, recording.motion)
    if len(nods):
        at_deg = np.degrees(pitch[nods]) + 1.2
        axes.plot(recording.times_s[nods], at_deg, "v", color=_COLORS[0], ms=6, label="nod")
    axes.margins(y=0.12)
    axes.axhline(0, color=FAINT, lw=0.6)
    _legend(axes)


def _below_median(times_s: Doubles, motion: Floats) -> Floats:
    """Return (N,) how far pitch is below its own median of `_NOD_WINDOW_S` [rad], positive nose down."""
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0
    pitch = motion[:, CHANNEL_INDEX["pitch"]]
    below: Floats = pitch - median_filter(pitch, size=max(3, round(_NOD_WINDOW_S / step_s)), mode="nearest")
    return below


def _nods(times_s: Doubles, motion: Floats) -> NDArray[np.int64]:
    """Return the rows of the lowest points of nods."""
    if len(times_s) < 3:
        return np.zeros(0, dtype=np.int64)
    apart = max(1, round(0.25 / float(np.median(np.diff(times_s)))))
    peaks = find_peaks(_below_median(times_s, motion), height=_NOD_RAD, prominence=_NOD_RAD, distance=apart)
    rows: NDArray[np.int64] = peaks[0]
    return rows


def _lanes(axes: Axes, recording: RunRecording) -> None:
    """Draw six channels in a lane each, 0 to 1 (gaze -1 to 1), the first on top."""
    axes.set_title("face of the listener, 0 to 1 per lane")
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
        axes.axhline(base, color=FAINT, lw=0.5)
    axes.set_yticks([lanes - 1 - lane + 0.42 for lane in range(lanes)], [name for name, _, _ in _LANES], color=INK)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(-0.05, lanes)


def _neck_joints(recording: RunRecording) -> list[int]:
    """Return the joints that are drawn large: the neck, or else those that travel furthest."""
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
        axes.plot(recording.times_s, present_deg, color=INK, lw=0.8)
    if joints and (shown := recording.times_s > _COMING_IN_S).any():
        shown_deg = np.degrees(recording.goals_rad[shown][:, list(joints)])
        room_deg = max(0.12 * float(np.ptp(shown_deg)), _LEAST_SCALE_DEG)
        axes.set_ylim(float(shown_deg.min()) - room_deg, float(shown_deg.max()) + room_deg)
    axes.axhline(0, color=FAINT, lw=0.6)
    if joints:
        _legend(axes)


def _heat(axes: Axes, recording: RunRecording, joints: Sequence[int]) -> None:
    """Draw every other joint as a band: its goal from its median, red up and blue down, full at its furthest."""
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
    size: dict[str, Any] = {"fontsize": min(10.0, max(6.0, 8.0 * 26 / len(joints))), "color": INK}
    axes.set_yticks(rows, [recording.joints[joint] for joint in joints], **size)
    axes.tick_params(axis="y", length=0)
    for row in rows:
        axes.axhline(row + 0.5, color="white", lw=1.0)
        axes.text(1.005, row, f"{travel_deg[row]:.0f}", transform=axes.get_yaxis_transform(), va="center", **size)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, frameon=False, fontsize=9.5, borderpad=0.1)


@dataclass(frozen=True)
class SheetInstant:
    """One picture of a sheet: row of the motion, time, what is happening."""

    row: int
    time_s: float
    label: str


# --- contact sheet: the instants -------------------------------------------------------------------------------------


def pick_instants(times_s: Doubles, motion: Floats, count: int = _INSTANTS) -> list[SheetInstant]:
    """Return `count` instants of a motion (N, 58) that show its events, in order. Raises ValueError when N = 0."""
    if not len(times_s):
        raise ValueError("a sheet needs at least one frame")
    signals = _signals(times_s, motion)
    nod = _nod_rows(times_s, signals["nod"])
    rows = list(dict.fromkeys([*nod, *_peaks(signals)]))[: min(count, len(times_s))]
    while len(rows) < min(count, len(times_s)):
        rows.append(_loneliest(times_s, rows))
    return [SheetInstant(row, float(times_s[row]), nod.get(row) or _label(signals, row)) for row in sorted(rows)]


def _signals(times_s: Doubles, motion: Floats) -> dict[str, Floats]:
    """Return signals (N,) of events: nod, turn, tilt [rad], blink, smile, brows, jaw [0..1], aside (+ own left)."""

    def mean(*names: str) -> Floats:
        out: Floats = np.mean([motion[:, CHANNEL_INDEX[name]] for name in names], axis=0)
        return out

    left = mean("eyeLookOutLeft", "eyeLookInRight") - mean("eyeLookInLeft", "eyeLookOutRight")
    return {
        "nod": _below_median(times_s, motion),
        "blink": mean("eyeBlinkLeft", "eyeBlinkRight"),
        "smile": mean("mouthSmileLeft", "mouthSmileRight"),
        "brows": motion[:, CHANNEL_INDEX["browInnerUp"]],
        "jaw": motion[:, CHANNEL_INDEX["jawOpen"]],
        "aside": left,
        "turn": motion[:, CHANNEL_INDEX["yaw"]],
        "tilt": motion[:, CHANNEL_INDEX["roll"]],
    }


def _nod_rows(times_s: Doubles, nod: Floats) -> dict[int, str]:
    """Return the top before, the lowest point and the end of the largest nod, by row; empty without a nod."""
    low = int(np.argmax(nod))
    if nod[low] < _NOD_RAD:
        return {}
    rows = {low: "nod, lowest"}
    before = np.flatnonzero((times_s >= times_s[low] - _HALF_NOD_S) & (times_s < times_s[low]))
    after = np.flatnonzero((times_s > times_s[low]) & (times_s <= times_s[low] + _HALF_NOD_S))
    if len(before):
        rows[int(before[np.argmin(nod[before])])] = "nod begins"
    if len(after):
        rows[int(after[np.argmin(nod[after])])] = "nod ends"
    return rows


def _peaks(signals: dict[str, Floats]) -> list[int]:
    """Return the strongest instant of each kind of event that occurs; all but the blink with open eyes, to see it."""
    wanted = (("blink", _BLINK), ("smile", _SMILE), ("aside", _ASIDE), ("brows", _BROWS), ("turn", _TURN_RAD))
    rows = []
    for name, least in wanted:
        strength = np.abs(signals[name])
        row = int(np.argmax(strength if name == "blink" else strength * (signals["blink"] < _BLINK)))
        if strength[row] >= least:
            rows.append(row)
    return rows


def _loneliest(times_s: Doubles, rows: Sequence[int]) -> int:
    """Return the row furthest in time from those chosen; the middle of the run when there is none."""
    if not rows:
        return len(times_s) // 2
    away_s = np.min(np.abs(times_s[:, None] - times_s[list(rows)][None, :]), axis=1)
    away_s[list(rows)] = -1
    return int(np.argmax(away_s))


def _label(signals: dict[str, Floats], row: int) -> str:
    at = {name: float(values[row]) for name, values in signals.items()}
    seen = {
        "nod": at["nod"] > _NOD_RAD,
        "blink": at["blink"] > _BLINK,
        "smile": at["smile"] > _SMILE,
        "brows up": at["brows"] > _BROWS,
        "mouth open": at["jaw"] > _JAW,
        "looks left": at["aside"] > _ASIDE,
        "looks right": at["aside"] < -_ASIDE,
        "turns left": at["turn"] > _TURN_RAD,
        "turns right": at["turn"] < -_TURN_RAD,
        "tilts": abs(at["tilt"]) > _TILT_RAD,
    }
    return ", ".join([name for name, there in seen.items() if there][:3]) or "-"


# --- contact sheet: the picture --------------------------------------------------------------------------------------


def render_sheet(
    file: Path | str,
    times_s: Doubles,
    motion: Floats,
    talking: NDArray[np.bool_] | None = None,
    title: str = "",
    robot: tuple[RobotScene, Doubles] | None = None,
) -> list[SheetInstant]:
    """Draw twelve instants of a motion (N, 58) as one PNG, 4 x 3; return them.

    talking: (N,) whether the speaker talks, written under each picture. robot: its scene, and the angles (N, J) that it
    showed; None leaves it out. Raises ConfigError for a bad mesh, MissingExtra without vtk.
    """
    vtk = load_vtk()
    instants = pick_instants(times_s, motion)
    widths, cell_high = _ALONE_PX if robot is None else _BESIDE_PX
    wide, high = sum(widths) + _GAP_PX, cell_high + _CAPTION_PX
    size = (_COLUMNS * wide + _GAP_PX, -(-len(instants) // _COLUMNS) * high + _TITLE_PX)
    window, head = open_window(vtk, size), load_human(hair=True)
    paper = add_renderer(vtk, window, (0, 0, 1, 1), _PAPER)
    add_text(vtk, paper, title, (_GAP_PX + 4, size[1] - 42), 24).SetBold(True)
    for index, instant in enumerate(instants):
        left = _GAP_PX + index % _COLUMNS * wide
        low = size[1] - _TITLE_PX - index // _COLUMNS * high - cell_high

        def cell(begin: int, end: int, left: int = left, low: int = low) -> Any:
            ends = ((left + begin) / size[0], low / size[1], (left + end) / size[0], (low + cell_high) / size[1])
            return add_renderer(vtk, window, ends, BACKGROUND)

        _add_portrait(vtk, cell(0, widths[0]), head, motion[instant.row])
        if robot is not None:
            scene, angles_rad = robot
            add_robot(vtk, cell(widths[0], sum(widths)), scene, scene.values(angles_rad[instant.row]))
        add_text(vtk, paper, f"{instant.time_s:.2f} s", (left + 4, low - 26), 19).SetBold(True)
        add_text(vtk, paper, instant.label, (left + 96, low - 26), 19, _ACCENT).SetBold(instant.label != "-")
        if talking is not None:
            text = "speaker talks" if talking[instant.row] else "speaker silent"
            add_text(vtk, paper, text, (left + 4, low - 46), 14, _PALE)
    save(vtk, window, file)
    return instants


def _add_portrait(vtk: Any, renderer: Any, head: HumanHead, motion: Floats) -> None:
    """Add the head, seen from a little to its left."""
    add_head(vtk, renderer, head, motion)
    look(renderer, (1.07, 0.36, 0.07), (0.012, 0.0, 0.020), 17.4)
