"""Draw docs/listening.webp: ten seconds of a run, the face that the listener plans and the robot that shows it.

python docs/draw_listening.py     (needs the extra `pictures`; takes a minute)
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.replay.run_file import read_recording
from sfms_robot.config import load_head
from sfms_robot.face.drawing import BACKGROUND, add_head, add_renderer, add_robot, load_vtk, look, open_window, save
from sfms_robot.face.human import load_human, with_hair

RUN = ["run", "--head", "reachy_mini", "--fast", "--seed", "1", "--duration", "20"]
START_S, SECONDS, RATE_HZ = 3.0, 10.0, 12.5
PANE_PX = (300, 300)
VOICE_PX = 44
HEARD, AHEAD, CURSOR = (168, 119, 44), (214, 208, 196), (31, 111, 156)


def panes(folder):
    """Yield one picture for each instant: the human head on the left, the robot on the right."""
    recording = read_recording(folder)
    vtk, human = load_vtk(), with_hair(load_human())
    scene = scene_of(load_head(recording.about["head"]))
    angles_rad = np.where(np.isnan(recording.present_rad), recording.goals_rad, recording.present_rad)
    wide, high = PANE_PX
    for time_s in np.arange(START_S, START_S + SECONDS, 1.0 / RATE_HZ):
        row = min(int(np.searchsorted(recording.times_s, time_s)), len(recording.times_s) - 1)
        window = open_window(vtk, (2 * wide, high))
        portrait = add_renderer(vtk, window, (0.0, 0.0, 0.5, 1.0), BACKGROUND)
        add_head(vtk, portrait, human, recording.motion[row])
        look(portrait, (1.07, 0.36, 0.07), (0.012, 0.0, 0.020), 17.4)
        robot = add_renderer(vtk, window, (0.5, 0.0, 1.0, 1.0), BACKGROUND)
        add_robot(vtk, robot, scene, scene.values(angles_rad[row].astype(np.float64)))
        file = folder / "frame.png"
        save(vtk, window, file)
        yield time_s, Image.open(file).convert("RGB")


def with_voice(recording, time_s, pane):
    """Return the picture with the speaker's voice below, and a line at the current time."""
    wide, high = pane.size
    picture = Image.new("RGB", (wide, high + VOICE_PX), "white")
    picture.paste(pane)
    draw = ImageDraw.Draw(picture)
    shown = recording.audio[int(START_S * 16000) : int((START_S + SECONDS) * 16000)]
    loud = np.abs(shown[: len(shown) // wide * wide].reshape(wide, -1)).max(axis=1)
    middle, now = high + VOICE_PX // 2, (time_s - START_S) / SECONDS * wide
    for x, size in enumerate(loud / max(float(loud.max()), 1e-6) * (VOICE_PX // 2 - 4)):
        draw.line([(x, middle - size), (x, middle + size)], fill=HEARD if x <= now else AHEAD)
    draw.line([(now, high + 2), (now, high + VOICE_PX - 2)], fill=CURSOR, width=2)
    return picture


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        program = "from sfms_robot.cli.main import main; main()"
        subprocess.run([sys.executable, "-c", program, *RUN, "--record", str(folder)], check=True)
        recording = read_recording(folder)
        frames = [with_voice(recording, time_s, pane) for time_s, pane in panes(folder)]
    file = Path(__file__).with_name("listening.webp")
    each_ms = round(1000.0 / RATE_HZ)
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=each_ms, loop=0, quality=60, method=4)
    print(f"{file.name}: {len(frames)} pictures, {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
