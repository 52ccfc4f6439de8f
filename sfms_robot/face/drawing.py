"""How the virtual head is drawn, off-screen, by vtk (extra `pictures`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError, optional
from sfms_robot.face.human import HumanHead, grid_triangles, load_human
from sfms_robot.frames import Doubles, Floats

INK: Final = (0.16, 0.17, 0.20)
BACKGROUND: Final = (0.905, 0.915, 0.925)
PLACE_M: Final = (0.6, 0.0, 0.0)  # of the virtual webcam's person: arm's length, in the middle of the picture
ANGLE_DEG: Final = 45.0  # across the picture's height: a common webcam
SIZE_PX: Final = (640, 480)
_EYES_M: Final = (0.09, 0.0, 0.032)  # of the head at rest
_COLLAR: Final = (0.23, 0.29, 0.36)

Point = Sequence[float] | Doubles  # x, y, z


def load_vtk() -> Any:
    """The parts of vtk that are used. Importing the whole takes a second more. Raises MissingExtra without it."""
    with optional("a picture of the head"):
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
    vtkCommonCore.vtkLogger.SetStderrVerbosity(vtkCommonCore.vtkLogger.VERBOSITY_ERROR)  # no display is no warning
    names: dict[str, Any] = {"arrays": numpy_support}
    for module in (vtkCommonCore, vtkCommonDataModel, vtkFiltersCore, vtkIOImage, vtkRenderingCore):
        names |= {name.removeprefix("vtk"): getattr(module, name) for name in dir(module) if name.startswith("vtk")}
    return type("Vtk", (), names)


def open_window(vtk: Any, size_px: tuple[int, int]) -> Any:
    window = vtk.RenderWindow()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(8)
    window.SetSize(*size_px)
    return window


def add_renderer(vtk: Any, window: Any, box: tuple[float, float, float, float], color: Any) -> Any:
    renderer = vtk.Renderer()
    renderer.SetViewport(*box)
    renderer.SetBackground(*color)
    window.AddRenderer(renderer)
    return renderer


def add_head(vtk: Any, renderer: Any, head: HumanHead, motion: Floats) -> None:
    """Add the head at one instant, its collar and three lights."""
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
        add_light(vtk, renderer, place, (0, 0, 0), strength)


def add_light(vtk: Any, renderer: Any, place: Point, towards: Point, strength: float) -> None:
    """Light the scene from one place."""
    light = vtk.Light()
    light.SetLightTypeToSceneLight()
    light.SetPosition(*place)
    light.SetFocalPoint(*towards)
    light.SetIntensity(strength)
    renderer.AddLight(light)


def add_text(vtk: Any, renderer: Any, text: str, place_px: tuple[int, int], size_px: int, color: Any = INK) -> Any:
    """Write a line of text from `place_px` on, and return its style."""
    actor = vtk.TextActor()
    actor.SetInput(text)
    actor.SetPosition(*place_px)
    style = actor.GetTextProperty()
    style.SetFontFamilyToArial()
    style.SetFontSize(size_px)
    style.SetColor(*color)
    renderer.AddViewProp(actor)
    return style


def look(renderer: Any, from_m: Point, to_m: Point, angle_deg: float) -> None:
    """Place the camera, in the axes of the scene; `angle_deg` is what it sees across the height of the picture."""
    camera = renderer.GetActiveCamera()
    camera.SetViewAngle(angle_deg)
    camera.SetFocalPoint(*to_m)
    camera.SetPosition(*from_m)
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
    return np.concatenate(points).astype(np.float32), grid_triangles(len(rings), around)


def save(vtk: Any, window: Any, file: Path | str) -> None:
    if not Path(file).parent.is_dir():
        raise ConfigError(f"{file}: cannot be written: no folder {Path(file).parent}")
    image, writer = _image(vtk, window), vtk.PNGWriter()  # an output port does not keep its filter alive
    writer.SetFileName(str(file))
    writer.SetInputConnection(image.GetOutputPort())
    writer.Write()


def _image(vtk: Any, window: Any) -> Any:
    """Render, and return the filter that gives the picture."""
    window.Render()
    image = vtk.WindowToImageFilter()
    image.SetInput(window)
    image.ReadFrontBufferOff()
    return image


class VirtualWebcam:
    """A camera with the virtual human before it: pictures with a known face, to try what reads faces from pictures.

    The person looks straight ahead at rest. Raises MissingExtra without vtk.
    """

    def __init__(self, size_px: tuple[int, int] = SIZE_PX, angle_deg: float = ANGLE_DEG) -> None:
        self._vtk = load_vtk()
        self._window, self._angle_deg = open_window(self._vtk, size_px), angle_deg
        self._human = load_human()

    def picture(self, motion: Floats, place_m: tuple[float, float, float] = PLACE_M) -> NDArray[np.uint8]:
        """(H, W, 3) red, green, blue, not mirrored.

        motion: (58,) of the person. place_m: the eyes at rest, from the camera: x out of its lens, y to its left, z up;
        the lens looks straight along its x, and the person along the same line towards it.
        """
        vtk = self._vtk
        renderer = add_renderer(vtk, self._window, (0, 0, 1, 1), BACKGROUND)
        add_head(vtk, renderer, self._human, motion)
        # The person looks the other way: their left is the camera's right.
        away, left, up = place_m
        lens = (_EYES_M[0] + away, _EYES_M[1] + left, _EYES_M[2] - up)
        look(renderer, lens, (lens[0] - 1.0, lens[1], lens[2]), self._angle_deg)
        image = _image(vtk, self._window)
        image.Update()
        self._window.RemoveRenderer(renderer)
        wide, high = self._window.GetSize()
        flat = vtk.arrays.vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
        return np.ascontiguousarray(flat.reshape(high, wide, 3)[::-1])
