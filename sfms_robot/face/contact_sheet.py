"""Pictures of the virtual head: a contact sheet of a run, and one face alone. Needs the extra `pictures`.

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

from sfms_robot.errors import ConfigError, MissingExtra
from sfms_robot.face.human import HumanHead, load_human
from sfms_robot.frames import CHANNEL_INDEX, Doubles, Floats

_COLUMNS: Final = 4
_INSTANTS: Final = 12
_CELL_PX: Final = (392, 352)  # one picture
_CAPTION_PX: Final = 58
_GAP_PX: Final = 8
_TITLE_PX: Final = 62
_PAPER: Final = (1.0, 1.0, 1.0)
_BACKGROUND: Final = (0.905, 0.915, 0.925)
_INK: Final = (0.16, 0.17, 0.20)
_FAINT: Final = (0.45, 0.46, 0.49)
_ACCENT: Final = (0.10, 0.38, 0.55)
_COLLAR: Final = (0.23, 0.29, 0.36)

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
) -> list[Instant]:
    """Draw twelve instants of a motion (N, 58) as one PNG, 4 x 3, and say which.

    talking: (N,) whether the speaker talks, told under each picture. Raises MissingExtra without vtk.
    """
    vtk = _vtk()
    instants = pick_instants(times_s, motion)
    wide, high = _CELL_PX[0] + _GAP_PX, _CELL_PX[1] + _CAPTION_PX
    size = (_COLUMNS * wide + _GAP_PX, -(-len(instants) // _COLUMNS) * high + _TITLE_PX)
    window, head = _window(vtk, size), load_human()
    paper = _renderer(vtk, window, (0, 0, 1, 1), _PAPER)
    _text(vtk, paper, title, (_GAP_PX + 4, size[1] - 42), 24, _INK, bold=True)
    for index, instant in enumerate(instants):
        left = _GAP_PX + index % _COLUMNS * wide
        low = size[1] - _TITLE_PX - index // _COLUMNS * high - _CELL_PX[1]
        box = (left / size[0], low / size[1], (left + _CELL_PX[0]) / size[0], (low + _CELL_PX[1]) / size[1])
        _add_head(vtk, _renderer(vtk, window, box, _BACKGROUND), head, motion[instant.row])
        _text(vtk, paper, f"{instant.time_s:.2f} s", (left + 4, low - 26), 19, _INK, bold=True)
        _text(vtk, paper, instant.label, (left + 96, low - 26), 19, _ACCENT, bold=instant.label != "-")
        if talking is not None:
            _text(
                vtk,
                paper,
                "speaker talks" if talking[instant.row] else "speaker silent",
                (left + 4, low - 46),
                14,
                _FAINT,
            )
    _save(vtk, window, file)
    return instants


def _vtk() -> Any:
    """The parts of vtk that are used. Importing the whole takes a second more."""
    try:
        import vtkmodules.vtkRenderingFreeType
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401
        from vtkmodules import (
            vtkCommonCore,
            vtkCommonDataModel,
            vtkFiltersCore,
            vtkIOImage,
            vtkRenderingCore,
        )
        from vtkmodules.util import numpy_support
    except ImportError as error:
        raise MissingExtra.of("a picture of the head", "pictures") from error
    vtkCommonCore.vtkLogger.SetStderrVerbosity(vtkCommonCore.vtkLogger.VERBOSITY_ERROR)  # no display is no warning
    names: dict[str, Any] = {"arrays": numpy_support}
    for module in (vtkCommonCore, vtkCommonDataModel, vtkFiltersCore, vtkIOImage, vtkRenderingCore):
        names |= {name.removeprefix("vtk"): getattr(module, name) for name in dir(module) if name.startswith("vtk")}
    return type("Vtk", (), names)


def _window(vtk: Any, size_px: tuple[int, int]) -> Any:
    window = vtk.RenderWindow()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(8)
    window.SetSize(*size_px)
    return window


def _renderer(vtk: Any, window: Any, box: tuple[float, float, float, float], color: Any) -> Any:
    renderer = vtk.Renderer()
    renderer.SetViewport(*box)
    renderer.SetBackground(*color)
    window.AddRenderer(renderer)
    return renderer


def _add_head(vtk: Any, renderer: Any, head: HumanHead, motion: Floats) -> None:
    """The head at one instant, its collar, three lights, and a camera a little to its left."""
    skin = _actor(vtk, head.vertices(motion), head.triangles)
    colors = vtk.arrays.numpy_to_vtk(head.colors, deep=True)
    skin.GetMapper().GetInput().GetPointData().SetScalars(colors)
    skin.GetProperty().SetSpecular(0.12)
    skin.GetProperty().SetSpecularPower(18)
    renderer.AddActor(skin)
    collar = _actor(vtk, *_collar())
    collar.GetProperty().SetColor(*_COLLAR)
    renderer.AddActor(collar)
    for place, strength in (((1.3, 0.6, 0.8), 0.80), ((1.0, -1.2, 0.1), 0.36), ((0.1, 1.3, 0.9), 0.26)):
        light = vtk.Light()
        light.SetLightTypeToSceneLight()
        light.SetPosition(*place)
        light.SetFocalPoint(0, 0, 0)
        light.SetIntensity(strength)
        renderer.AddLight(light)
    camera = renderer.GetActiveCamera()
    camera.SetViewAngle(16.4)
    camera.SetFocalPoint(0.012, 0, 0.008)
    camera.SetPosition(1.07, 0.36, 0.07)
    camera.SetViewUp(0, 0, 1)
    renderer.ResetCameraClippingRange()


def _actor(vtk: Any, vertices: Floats, triangles: NDArray[np.int64]) -> Any:
    """A smooth-shaded mesh: vertices (V, 3), triangles (T, 3)."""
    mesh, points, cells = vtk.PolyData(), vtk.Points(), vtk.CellArray()
    points.SetData(vtk.arrays.numpy_to_vtk(np.ascontiguousarray(vertices, dtype=np.float32), deep=True))
    corners = np.ascontiguousarray(triangles, dtype=np.int64).ravel()
    starts = np.arange(0, len(corners) + 1, 3, dtype=np.int64)
    cells.SetData(
        vtk.arrays.numpy_to_vtkIdTypeArray(starts, deep=True), vtk.arrays.numpy_to_vtkIdTypeArray(corners, deep=True)
    )
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    normals = vtk.PolyDataNormals()
    normals.SetInputData(mesh)
    normals.SplittingOff()
    normals.ConsistencyOff()
    normals.Update()
    mesh.GetPointData().SetNormals(normals.GetOutput().GetPointData().GetNormals())
    mapper, actor = vtk.PolyDataMapper(), vtk.Actor()
    mapper.SetInputData(mesh)
    actor.SetMapper(mapper)
    actor.GetProperty().SetInterpolationToPhong()
    return actor


def _collar(around: int = 64) -> tuple[Floats, NDArray[np.int64]]:
    """A roll-neck that hides the cut edge of the neck: rings of centre x, height z, half width, half depth."""
    rings = (
        (-0.012, -0.100, 0.050, 0.046),
        (-0.012, -0.084, 0.054, 0.051),
        (-0.012, -0.082, 0.059, 0.056),
        (-0.012, -0.090, 0.064, 0.061),
        (-0.012, -0.112, 0.066, 0.063),
        (-0.014, -0.124, 0.078, 0.066),
        (-0.018, -0.140, 0.125, 0.078),
        (-0.020, -0.165, 0.190, 0.090),
        (-0.020, -0.250, 0.215, 0.095),
    )
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    # The neck leans forward: the rim is lower in front than behind.
    points = [
        np.stack([x + depth * np.cos(angle), width * np.sin(angle), z - 0.012 * np.cos(angle)], axis=1)
        for x, z, width, depth in rings
    ]
    here = np.arange(around)
    there = (here + 1) % around
    triangles = []
    for ring in range(len(rings) - 1):
        a, b = ring * around, (ring + 1) * around
        triangles += [np.stack([a + here, b + here, b + there], axis=1)]
        triangles += [np.stack([a + here, b + there, a + there], axis=1)]
    return np.concatenate(points).astype(np.float32), np.concatenate(triangles)


def _text(
    vtk: Any, renderer: Any, text: str, place_px: tuple[int, int], size_px: int, color: Any, bold: bool = False
) -> None:
    actor = vtk.TextActor()
    actor.SetInput(text)
    actor.SetPosition(*place_px)
    style = actor.GetTextProperty()
    style.SetFontFamilyToArial()
    style.SetFontSize(size_px)
    style.SetColor(*color)
    style.SetBold(bold)
    renderer.AddViewProp(actor)


def _save(vtk: Any, window: Any, file: Path | str) -> None:
    if not Path(file).parent.is_dir():
        raise ConfigError(f"{file}: cannot be written: no folder {Path(file).parent}")
    window.Render()
    image, writer = vtk.WindowToImageFilter(), vtk.PNGWriter()
    image.SetInput(window)
    image.ReadFrontBufferOff()
    writer.SetFileName(str(file))
    writer.SetInputConnection(image.GetOutputPort())
    writer.Write()
