"""Your own retargeting: a face in numpy, joint angles out. No robot, no loop, no torch."""

import numpy as np

import sfms_robot as sr

head = sr.load_head("face28")  # a shipped name, or the folder of your head.yaml
retargeter = sr.Retargeter(head)

face = np.zeros(len(sr.CHANNELS), np.float32)  # (58,): roll, pitch, yaw [rad], x, y, z [m], 52 blendshapes 0..1
face[sr.CHANNELS.index("yaw")] = 0.2
face[sr.CHANNELS.index("mouthSmileLeft")] = 0.8

angles_rad = retargeter.angles(face)  # (J,) in the order of the head's joints, inside their ranges
for joint, angle_rad in zip(retargeter.joints, angles_rad, strict=True):
    print(f"{joint:20} {np.degrees(angle_rad):7.2f} deg")
