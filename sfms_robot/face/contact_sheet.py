"""A contact sheet of a run: the virtual head, and beside it the robot. Needs the extra `pictures`.

A sheet is twelve instants, chosen to show what happened: the largest nod from its top over its lowest point to its end,
the firmest blink, the broadest smile, the furthest look aside; the rest are spread where nothing is shown yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from sfms_robot.face.drawing import BACKGROUND, add_head, add_renderer, add_text, load_vtk, look, open_window, save
from sfms_robot.face.human import HumanHead, load_human
from sfms_robot.face.human_mesh import with_hair
from sfms_robot.face.robot_drawing import add_robot
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.frames import CHANNEL_INDEX, Doubles, Floats

_COLUMNS: Final = 4
_INSTANTS: Final = 12
_ALONE_PX: Final = ((392,), 352)  # widths of the pictures of an instant, and their height: the virtual head
_BESIDE_PX: Final = ((258, 182), 316)  # the virtual head and the robot
_CAPTION_PX: Final = 58
_GAP_PX: Final = 8
_TITLE_PX: Final = 62
_PAPER: Final = (1.0, 1.0, 1.0)
_FAINT: Final = (0.45, 0.46, 0.49)
_ACCENT: Final = (0.10, 0.38, 0.55)

_NOD_RAD: Final = np.radians(2.0)  # pitch below its own median of 1.6 s that shows as a nod
_NOD_WINDOW_S: Final = 1.6
_HALF_NOD_S: Final = 0.5
_BLINK, _SMILE, _BROWS, _JAW, _ASIDE = 0.45, 0.25, 0.30, 0.30, 0.25
_TURN_RAD: Final = np.radians(7.0)
_TILT_RAD: Final = np.radians(5.0)


@dataclass(frozen=True)
class Instant:
    """One picture of a sheet: row of the motion, time, what is happening."""

    row: int
    time_s: float
    label: str


# --- what is shown ----------------------------------------------------------------------------------------------


def pick_instants(times_s: Doubles, motion: Floats, count: int = _INSTANTS) -> list[Instant]:
    """`count` instants of a motion (N, 58) that show what it holds, in order of time. Raises ValueError when N = 0."""
    if not len(times_s):
        raise ValueError("a sheet needs at least one frame")
    signals = _signals(times_s, motion)
    nod = _nod_rows(times_s, signals["nod"])
    rows = list(dict.fromkeys([*nod, *_peaks(signals)]))[: min(count, len(times_s))]
    while len(rows) < min(count, len(times_s)):
        rows.append(_loneliest(times_s, rows))
    return [Instant(row, float(times_s[row]), nod.get(row) or _label(signals, row)) for row in sorted(rows)]


def _signals(times_s: Doubles, motion: Floats) -> dict[str, Floats]:
    """What is looked for, each (N,): nod, turn, tilt [rad], blink, smile, brows, jaw [0..1], aside (+ own left)."""

    def mean(*names: str) -> Floats:
        out: Floats = np.mean([motion[:, CHANNEL_INDEX[name]] for name in names], axis=0)
        return out

    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0
    pitch = motion[:, CHANNEL_INDEX["pitch"]]
    window = max(3, round(_NOD_WINDOW_S / step_s))
    left = mean("eyeLookOutLeft", "eyeLookInRight") - mean("eyeLookInLeft", "eyeLookOutRight")
    return {
        "nod": pitch - median_filter(pitch, size=window, mode="nearest"),
        "blink": mean("eyeBlinkLeft", "eyeBlinkRight"),
        "smile": mean("mouthSmileLeft", "mouthSmileRight"),
        "brows": motion[:, CHANNEL_INDEX["browInnerUp"]],
        "jaw": motion[:, CHANNEL_INDEX["jawOpen"]],
        "aside": left,
        "turn": motion[:, CHANNEL_INDEX["yaw"]],
        "tilt": motion[:, CHANNEL_INDEX["roll"]],
    }


def _nod_rows(times_s: Doubles, nod: Floats) -> dict[int, str]:
    """Top before, lowest point, and end of the largest nod, by row; nothing when there is none."""
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
    """The strongest instant of each kind of event that is there at all; all but the blink with open eyes, to see it."""
    wanted = (("blink", _BLINK), ("smile", _SMILE), ("aside", _ASIDE), ("brows", _BROWS), ("turn", _TURN_RAD))
    rows = []
    for name, least in wanted:
        strength = np.abs(signals[name])
        row = int(np.argmax(strength if name == "blink" else strength * (signals["blink"] < _BLINK)))
        if strength[row] >= least:
            rows.append(row)
    return rows


def _loneliest(times_s: Doubles, rows: Sequence[int]) -> int:
    """The row furthest in time from those chosen; the middle of the run when there is none."""
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


# --- how it is drawn --------------------------------------------------------------------------------------------


def render_sheet(
    file: Path | str,
    times_s: Doubles,
    motion: Floats,
    talking: NDArray[np.bool_] | None = None,
    title: str = "",
    robot: tuple[RobotScene, Doubles] | None = None,
) -> list[Instant]:
    """Draw twelve instants of a motion (N, 58) as one PNG, 4 x 3, and say which.

    talking: (N,) whether the speaker talks, told under each picture. robot: what it looks like, and the angles (N, J)
    that it showed; None leaves it out. Raises ConfigError for a bad mesh, MissingExtra without vtk.
    """
    vtk = load_vtk()
    instants = pick_instants(times_s, motion)
    widths, cell_high = _ALONE_PX if robot is None else _BESIDE_PX
    wide, high = sum(widths) + _GAP_PX, cell_high + _CAPTION_PX
    size = (_COLUMNS * wide + _GAP_PX, -(-len(instants) // _COLUMNS) * high + _TITLE_PX)
    window, head = open_window(vtk, size), with_hair(load_human())
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
            add_text(vtk, paper, text, (left + 4, low - 46), 14, _FAINT)
    save(vtk, window, file)
    return instants


def _add_portrait(vtk: Any, renderer: Any, head: HumanHead, motion: Floats) -> None:
    """The head, seen from a little to its left."""
    add_head(vtk, renderer, head, motion)
    look(renderer, (1.07, 0.36, 0.07), (0.012, 0.0, 0.020), 17.4)
