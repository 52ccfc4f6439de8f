"""Servos without a face: joint angles in, readings out. The limits in the head's file apply to every goal."""

import numpy as np

import sfms_robot as sr

with sr.open_bus("reachy_mini", port="sim") as bus:  # or port="/dev/ttyUSB0"
    bus.enable()  # torque on: each joint holds its position
    goal_rad = np.array(bus.rest_rad)
    goal_rad[0] += 0.15
    print("arrived:", bus.move(goal_rad))  # blocks; `write` does not
    for joint, reading in bus.read().items():
        print(
            f"{joint:20} {reading.position_rad:7.3f} rad  {reading.age_s * 1e3:.0f} ms old  {reading.fault or 'fine'}"
        )
# Here the joints have come to rest and torque is off.
