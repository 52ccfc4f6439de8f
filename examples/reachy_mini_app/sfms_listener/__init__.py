"""A Reachy Mini app in which the robot listens."""
