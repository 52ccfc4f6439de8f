"""How people hold their heads, for tests of listeners."""

# Roll, pitch, yaw of listeners of composed dyads (`data compose`, training), less gaze: 1st and 99th percentile.
PEOPLE_RAD = ((-0.030, 0.030), (-0.024, 0.058), (-0.033, 0.033))
