"""Puppeteering: faces and points to look at, on a head that continues to listen."""

import sys

import sfms_robot as sr

pause_s = float(sys.argv[1]) if len(sys.argv) > 1 else 2.0
with sr.Robot("face28", port="sim", audio="katie") as robot:
    robot.look_at(1.0, 0.4, 0.1, seconds=pause_s)  # a metre ahead, 40 cm to its left, 10 cm up
    robot.wait(pause_s)
    robot.show({"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}, seconds=pause_s)  # the listener moves the rest
    robot.wait(pause_s)
    robot.knobs["neck"].intensity = 0.5  # half as much head motion from here on
    robot.show({"browInnerUp": 1.0, "jawOpen": 0.3, "pitch": -0.1}, seconds=0.5)
    robot.wait(pause_s)
print(robot.report()["motion"])
