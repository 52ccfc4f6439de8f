"""Pictures of a robot's URDF, off-screen, by vtk (extra `pictures`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.face.drawing import BACKGROUND, add_light, add_renderer, add_text, load_vtk, look, open_window, save
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.face.urdf import Visual
from sfms_robot.frames import Doubles

_ROUND: Final = 48  # corners of a circle
_DIRECTION: Final = np.array([1.0, 0.42, 0.22]) / np.linalg.norm([1.0, 0.42, 0.22])  # of the camera, from the robot
_ANGLE_DEG: Final = 24.0
_ROOM: Final = 1.12  # of a picture, by what it shows
_LIGHTS: Final = (((2.0, 1.0, 2.0), 0.72), ((2.2, -2.0, 0.2), 0.42), ((-1.0, 2.0, 2.0), 0.30))
_READERS: Final = {".stl": "STLReader", ".obj": "OBJReader", ".ply": "PLYReader"}


def render_robot(file: Path | str, scene: RobotScene, values: Doubles, size_px: tuple[int, int] = (640, 640)) -> None:
    """Draw a scene with these joint values (U,) as a PNG. Raises ConfigError, MissingExtra without vtk."""
    vtk = load_vtk()
    window = open_window(vtk, size_px)
    add_robot(vtk, add_renderer(vtk, window, (0, 0, 1, 1), BACKGROUND), scene, values)
    save(vtk, window, file)


def render_robots(
    file: Path | str, robots: Sequence[tuple[str, RobotScene, Doubles]], columns: int, cell_px: tuple[int, int]
) -> None:
    """Draw several, each with its name below, as one PNG. Raises ConfigError, MissingExtra without vtk."""
    vtk = load_vtk()
    rows, (wide, high), caption = -(-len(robots) // columns), cell_px, 26
    size = (columns * wide, rows * (high + caption))
    window = open_window(vtk, size)
    paper = add_renderer(vtk, window, (0, 0, 1, 1), BACKGROUND)
    for index, (name, scene, values) in enumerate(robots):
        left, low = index % columns * wide, size[1] - (index // columns + 1) * (high + caption) + caption
        box = (left / size[0], low / size[1], (left + wide) / size[0], (low + high) / size[1])
        add_robot(vtk, add_renderer(vtk, window, box, BACKGROUND), scene, values)
        add_text(vtk, paper, name, (left + wide // 2, low - caption + 8), 15).SetJustificationToCentered()
    save(vtk, window, file)


def add_robot(vtk: Any, renderer: Any, scene: RobotScene, values: Doubles) -> None:
    """Add every visual in its place, three lights, and the camera before it. Raises ConfigError for a bad mesh.

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
    """From where a camera along `_DIRECTION` sees a box (3, 2) with room around it; aspect: width by height."""
    corners = np.stack(np.meshgrid(*bounds), axis=-1).reshape(8, 3) - bounds.mean(axis=1)
    aside = np.cross([0.0, 0.0, 1.0], _DIRECTION)
    aside /= np.linalg.norm(aside)
    slope = math.tan(math.radians(_ANGLE_DEG / 2)) / _ROOM
    away = np.maximum(np.abs(corners @ aside) / aspect, np.abs(corners @ np.cross(_DIRECTION, aside))) / slope
    return float((away + corners @ _DIRECTION).max())


def _add_visuals(vtk: Any, renderer: Any, scene: RobotScene, values: Doubles) -> None:
    places = scene.robot.link_places(dict(zip(scene.joints, values.tolist(), strict=True)))
    for visual in scene.robot.visuals:
        renderer.AddActor(_actor(vtk, visual, places[visual.link] @ visual.place, scene.meshes))


def _actor(vtk: Any, visual: Visual, place: Doubles, meshes: Mapping[str, Path]) -> Any:
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    matrix, mapper, actor = vtkMatrix4x4(), vtk.PolyDataMapper(), vtk.Actor()
    full = place @ _upright(visual)
    matrix.DeepCopy(full.ravel().tolist())
    source = _source(visual, meshes)
    source.Update()
    mapper.SetInputData(source.GetOutput())
    mapper.ScalarVisibilityOff()
    actor.SetMapper(mapper)
    actor.SetUserMatrix(matrix)
    style = actor.GetProperty()
    style.SetColor(*visual.color[:3])
    style.SetOpacity(visual.color[3])
    style.SetInterpolationToPhong()
    style.SetAmbient(0.12)
    style.SetSpecular(0.18)
    style.SetSpecularPower(24)
    return actor


def _upright(visual: Visual) -> Doubles:
    """(4, 4): vtk's cylinders lie along y, those of URDF along z; a mesh has a scale."""
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
    if visual.shape == "box":
        box = sources.vtkCubeSource()
        for axis, length in zip("XYZ", visual.size, strict=True):
            getattr(box, f"Set{axis}Length")(length)
        return box
    if visual.shape == "sphere":
        ball = sources.vtkSphereSource()
        ball.SetRadius(visual.size[0])
        ball.SetThetaResolution(_ROUND)
        ball.SetPhiResolution(_ROUND // 2)
        return ball
    rod = sources.vtkCylinderSource()
    rod.SetRadius(visual.size[0])
    rod.SetHeight(visual.size[1])
    rod.SetResolution(_ROUND)
    return rod


def _mesh(file: Path) -> Any:
    from vtkmodules import vtkIOGeometry, vtkIOPLY

    name = _READERS.get(file.suffix.lower())
    if name is None:
        raise ConfigError(f"{file}: a picture needs one of {', '.join(_READERS)}")
    reader = getattr(vtkIOPLY if name == "PLYReader" else vtkIOGeometry, f"vtk{name}")()
    reader.SetFileName(str(file))
    for part in (reader, reader.GetExecutive()):  # of a part with an observer vtk prints no error
        part.AddObserver("ErrorEvent", lambda *_: None)
    reader.Update()
    if reader.GetErrorCode() or not reader.GetOutput().GetNumberOfPoints():
        raise ConfigError(f"{file}: not a mesh that can be read")
    return reader
