"""Draw a face from the JSON output only, as any other program can: json_avatar.py [PICTURES]."""

import json
import sys

import numpy as np
from websockets.sync.client import connect

import sfms_robot as sr
from sfms_robot.face import drawing
from sfms_robot.face.human import load_human
from sfms_robot.frames import BLENDSHAPES

pictures = int(sys.argv[1]) if len(sys.argv) > 1 else 8
vtk, human, seen = drawing.load_vtk(), load_human(hair=True), []
with sr.Robot("none", audio="katie", outputs=["json"]), connect("ws://127.0.0.1:8782") as output:
    while len(seen) < pictures:  # a frame every second
        frame = json.loads(output.recv())
        if not seen or frame["t"] >= seen[-1]["t"] + 1.0:
            seen.append(frame)

window = drawing.open_window(vtk, (300 * pictures, 300))
for at, frame in enumerate(seen):
    cell = drawing.add_renderer(vtk, window, (at / pictures, 0, (at + 1) / pictures, 1), drawing.BACKGROUND)
    pose = [frame["pose"][name] for name in ("roll", "pitch", "yaw", "x", "y", "z")]  # rad, m
    shapes = [frame["shapes"][name] for name in BLENDSHAPES]  # 0..1
    drawing.add_head(vtk, cell, human, np.array(pose + shapes, np.float32))
    drawing.look(cell, (1.07, 0.36, 0.07), (0.012, 0.0, 0.020), 17.4)
    drawing.add_text(vtk, cell, f"{frame['t']:.1f} s", (10, 272), 18)
drawing.save(vtk, window, "avatar.png")
print(f"avatar.png: {pictures} faces")
