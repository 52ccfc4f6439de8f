"""Pictures of the virtual head and of a robot's URDF, drawn off-screen by vtk (extra `pictures`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError, optional
from sfms_robot.face.human import HumanHead, load_human
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.face.urdf import Visual
from sfms_robot.frames import Doubles, Floats

INK: Final = (0.16, 0.17, 0.20)
BACKGROUND: Final = (0.905, 0.915, 0.925)
PLACE_M: Final = (0.6, 0.0, 0.0)  # place of the virtual webcam's person: arm's length, in the middle of the picture
ANGLE_DEG: Final = 45.0  # view angle across the picture's height, as of a common webcam
SIZE_PX: Final = (640, 480)
_EYES_M: Final = (0.09, 0.0, 0.032)  # eyes of the head at rest
_DIRECTION: Final = np.array([1.0, 0.42, 0.22]) / np.linalg.norm([1.0, 0.42, 0.22])  # from the robot to the camera
_ANGLE_DEG: Final = 24.0
_ROOM: Final = 1.12  # size of a picture divided by that of its content
_LIGHTS: Final = (((2.0, 1.0, 2.0), 0.72), ((2.2, -2.0, 0.2), 0.42), ((-1.0, 2.0, 2.0), 0.30))
# Each shape of a URDF: vtk's names of the shape and of its sizes, and the number of its corners.
_SHAPES: Final[Mapping[str, tuple[str, tuple[str, ...], Mapping[str, int]]]] = {
    "box": ("Cube", ("x_length", "y_length", "z_length"), {}),
    "sphere": ("Sphere", ("radius",), {"theta_resolution": 48, "phi_resolution": 24}),
    "cylinder": ("Cylinder", ("radius", "height"), {"resolution": 48}),
}
_READERS: Final = {".stl": "STLReader", ".obj": "OBJReader", ".ply": "PLYReader"}

Point = Sequence[float] | Doubles  # x, y, z


def load_vtk() -> Any:
    """Return the parts of vtk that are used, as one object. Importing all of vtk takes a second more.

    Raises MissingExtra without it.
    """
    with optional("a picture of the head"):
        import vtkmodules.vtkRenderingFreeType
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401
        from vtkmodules import vtkCommonCore, vtkCommonDataModel, vtkFiltersCore, vtkIOImage, vtkRenderingCore
        from vtkmodules.util import numpy_support
    vtkCommonCore.vtkLogger.SetStderrVerbosity(vtkCommonCore.vtkLogger.VERBOSITY_ERROR)  # no warning without a display
    names: dict[str, Any] = {"arrays": numpy_support}
    for module in (vtkCommonCore, vtkCommonDataModel, vtkFiltersCore, vtkIOImage, vtkRenderingCore):
        names |= {name.removeprefix("vtk"): getattr(module, name) for name in dir(module) if name.startswith("vtk")}
    return type("Vtk", (), names)


def open_window(vtk: Any, size_px: tuple[int, int]) -> Any:
    window = vtk.RenderWindow(off_screen_rendering=True, multi_samples=8)
    window.SetSize(*size_px)
    return window


def add_renderer(vtk: Any, window: Any, box: tuple[float, float, float, float], color: Any) -> Any:
    renderer = vtk.Renderer(viewport=box, background=color)
    window.AddRenderer(renderer)
    return renderer


def add_head(vtk: Any, renderer: Any, head: HumanHead, motion: Floats) -> None:
    """Add the head at one instant, smoothly shaded, and three lights."""
    points, cells = vtk.Points(), vtk.CellArray()
    points.SetData(vtk.arrays.numpy_to_vtk(head.vertices(motion), deep=True))
    starts = np.arange(0, head.triangles.size + 1, 3, dtype=np.int64)
    cells.SetData(*(vtk.arrays.numpy_to_vtkIdTypeArray(each, deep=True) for each in (starts, head.triangles.ravel())))
    mesh = vtk.PolyData(points=points, polys=cells)
    mesh.point_data.SetScalars(vtk.arrays.numpy_to_vtk(head.colors, deep=True))
    normals = vtk.PolyDataNormals(input_data=mesh, splitting=False, consistency=False)
    normals.Update()
    style = vtk.Property(specular=0.12, specular_power=18)
    style.SetInterpolationToPhong()
    renderer.AddActor(vtk.Actor(mapper=vtk.PolyDataMapper(input_data=normals.GetOutput()), property=style))
    for place, strength in (((1.3, 0.6, 0.8), 0.80), ((1.0, -1.2, 0.1), 0.36), ((0.1, 1.3, 0.9), 0.26)):
        add_light(vtk, renderer, place, (0, 0, 0), strength)


def add_light(vtk: Any, renderer: Any, place: Point, towards: Point, strength: float) -> None:
    """Light the scene from one place."""
    light = vtk.Light(position=tuple(place), focal_point=tuple(towards), intensity=strength)
    light.SetLightTypeToSceneLight()
    renderer.AddLight(light)


def add_text(vtk: Any, renderer: Any, text: str, place_px: tuple[int, int], size_px: int, color: Any = INK) -> Any:
    """Write a line of text from `place_px` on, and return its style."""
    actor = vtk.TextActor(input=text, position=place_px)
    style = actor.text_property
    style.font_size, style.color = size_px, color
    renderer.AddViewProp(actor)
    return style


def look(renderer: Any, from_m: Point, to_m: Point, angle_deg: float) -> None:
    """Place the camera, in the axes of the scene; `angle_deg`: view angle across the height of the picture."""
    camera = renderer.active_camera
    camera.view_angle, camera.view_up = angle_deg, (0, 0, 1)
    camera.focal_point, camera.position = tuple(to_m), tuple(from_m)
    renderer.ResetCameraClippingRange()


def save(vtk: Any, window: Any, file: Path | str) -> None:
    if not Path(file).parent.is_dir():
        raise ConfigError(f"{file}: cannot be written: no folder {Path(file).parent}")
    image = _image(vtk, window)  # an output port does not keep its filter alive
    vtk.PNGWriter(file_name=str(file), input_connection=image.GetOutputPort()).Write()


def _image(vtk: Any, window: Any) -> Any:
    """Render, and return the filter that holds the picture."""
    window.Render()
    return vtk.WindowToImageFilter(input=window, read_front_buffer=False)


class VirtualWebcam:
    """A camera in front of the virtual human: pictures with a known face, to test code that reads faces from pictures.

    The person looks straight ahead at rest. Raises MissingExtra without vtk.
    """

    def __init__(self) -> None:
        self._vtk = load_vtk()
        self._window = open_window(self._vtk, SIZE_PX)
        self._human = load_human()

    def picture(self, motion: Floats, place_m: tuple[float, float, float] = PLACE_M) -> NDArray[np.uint8]:
        """Return a picture (H, W, 3) of red, green and blue, not mirrored.

        motion: (58,) of the person. place_m: the eyes at rest, from the camera: x out of its lens, y to its left, z up.
        The lens looks straight along its x, and the person along the same line towards it.
        """
        vtk = self._vtk
        renderer = add_renderer(vtk, self._window, (0, 0, 1, 1), BACKGROUND)
        add_head(vtk, renderer, self._human, motion)
        # The person faces the camera: their left is the camera's right.
        away, left, up = place_m
        lens = (_EYES_M[0] + away, _EYES_M[1] + left, _EYES_M[2] - up)
        look(renderer, lens, (lens[0] - 1.0, lens[1], lens[2]), ANGLE_DEG)
        image = _image(vtk, self._window)
        image.Update()
        self._window.RemoveRenderer(renderer)
        wide, high = self._window.GetSize()
        flat = vtk.arrays.vtk_to_numpy(image.GetOutput().point_data.scalars)
        return np.ascontiguousarray(flat.reshape(high, wide, 3)[::-1])


# --- robots -----------------------------------------------------------------------------------------------------------


def render_robots(
    file: Path | str,
    robots: Sequence[tuple[str, RobotScene, Doubles]],
    columns: int = 1,
    size_px: tuple[int, int] = (640, 640),
) -> None:
    """Draw scenes with joint values (U,), each with its name below if it has one, as one PNG.

    A mesh that cannot be read is added to the scene's `left_out`. Raises MissingExtra without vtk.
    """
    vtk = load_vtk()
    rows, (wide, high), caption = -(-len(robots) // columns), size_px, 26 if any(name for name, *_ in robots) else 0
    size = (columns * wide, rows * (high + caption))
    window = open_window(vtk, size)
    paper = add_renderer(vtk, window, (0, 0, 1, 1), BACKGROUND)
    for index, (name, scene, values) in enumerate(robots):
        left, low = index % columns * wide, size[1] - (index // columns + 1) * (high + caption) + caption
        box = (left / size[0], low / size[1], (left + wide) / size[0], (low + high) / size[1])
        add_robot(vtk, add_renderer(vtk, window, box, BACKGROUND), scene, values)
        if name:
            add_text(vtk, paper, name, (left + wide // 2, low - caption + 8), 15).SetJustificationToCentered()
    save(vtk, window, file)


def add_robot(vtk: Any, renderer: Any, scene: RobotScene, values: Doubles) -> None:
    """Add every visual in its place, three lights, and the camera in front of the robot.

    The camera stands where it sees all of the robot at rest, so pictures of one robot show how it moves.
    """
    at_rest = vtk.Renderer()
    _add_visuals(vtk, at_rest, scene, scene.rest())
    bounds = np.array(at_rest.ComputeVisiblePropBounds()).reshape(3, 2)
    _add_visuals(vtk, renderer, scene, values)
    middle, size = bounds.mean(axis=1), float(np.linalg.norm(np.ptp(bounds, axis=1)))
    away_m = _distance(bounds, renderer.GetTiledAspectRatio())
    look(renderer, middle + away_m * _DIRECTION, middle, _ANGLE_DEG)
    renderer.AutomaticLightCreationOff()
    for place, strength in _LIGHTS:
        add_light(vtk, renderer, middle + size * np.array(place), middle, strength)


def _distance(bounds: Doubles, aspect: float) -> float:
    """Return the distance at which a camera along `_DIRECTION` sees a box (3, 2) with room around it.

    aspect: width by height of the picture.
    """
    corners = np.stack(np.meshgrid(*bounds), axis=-1).reshape(8, 3) - bounds.mean(axis=1)
    aside = np.cross([0.0, 0.0, 1.0], _DIRECTION)
    aside /= np.linalg.norm(aside)
    slope = math.tan(math.radians(_ANGLE_DEG / 2)) / _ROOM
    away = np.maximum(np.abs(corners @ aside) / aspect, np.abs(corners @ np.cross(_DIRECTION, aside))) / slope
    return float((away + corners @ _DIRECTION).max())


def _add_visuals(vtk: Any, renderer: Any, scene: RobotScene, values: Doubles) -> None:
    places = scene.robot.link_places(dict(zip(scene.joints, values.tolist(), strict=True)))
    for visual in scene.robot.visuals:
        try:
            renderer.AddActor(_visual_actor(vtk, visual, places[visual.link] @ visual.place, scene.meshes))
        except ConfigError as error:
            scene.leave_out(visual, str(error))


def _visual_actor(vtk: Any, visual: Visual, place: Doubles, meshes: Mapping[str, Path]) -> Any:
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    matrix.DeepCopy((place @ _upright(visual)).ravel().tolist())
    source = _source(visual, meshes)
    source.Update()
    mapper = vtk.PolyDataMapper(input_data=source.GetOutput(), scalar_visibility=False)
    *color, opacity = visual.color
    style = vtk.Property(color=tuple(color), opacity=opacity, ambient=0.12, specular=0.18, specular_power=24)
    style.SetInterpolationToPhong()
    return vtk.Actor(mapper=mapper, user_matrix=matrix, property=style)


def _upright(visual: Visual) -> Doubles:
    """Return (4, 4) from vtk's shape to the URDF's: cylinders of vtk lie along y, not z, and a mesh has a scale."""
    out = np.eye(4)
    if visual.shape == "cylinder":
        out[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    elif visual.shape == "mesh":
        out[:3, :3] = np.diag(visual.size)
    return out


def _source(visual: Visual, meshes: Mapping[str, Path]) -> Any:
    from vtkmodules import vtkFiltersSources as sources

    if visual.shape == "mesh":
        return _mesh(meshes[visual.mesh])
    name, sizes, more = _SHAPES[visual.shape]
    return getattr(sources, f"vtk{name}Source")(**dict(zip(sizes, visual.size, strict=True)), **more)


def _mesh(file: Path) -> Any:
    from vtkmodules import vtkIOGeometry, vtkIOPLY

    name = _READERS.get(file.suffix.lower())
    if name is None:
        raise ConfigError(f"{file}: a picture needs one of {', '.join(_READERS)}")
    reader = getattr(vtkIOPLY if name == "PLYReader" else vtkIOGeometry, f"vtk{name}")(file_name=str(file))
    for part in (reader, reader.GetExecutive()):  # vtk prints no error of a part with an observer
        part.AddObserver("ErrorEvent", lambda *_: None)
    reader.Update()
    if reader.GetErrorCode() or not reader.GetOutput().GetNumberOfPoints():
        raise ConfigError(f"{file}: not a mesh that can be read")
    return reader
