"""Every value of a joint is told with the place it comes from."""

from sfms_robot.config import load_head
from sfms_robot.config.overlay import SHOWN, provenance


def test_a_value_comes_from_its_own_line_its_twin_the_defaults_or_nowhere():
    told = provenance("face28")
    assert told["eye_pan_right"]["id"] == (2, "head file")
    assert told["eye_pan_right"]["max_deg"] == (30.0, "mirror of eye_pan_left")
    assert told["eye_pan_right"]["model"] == ("xl330-m288", "joint_defaults")
    assert told["eye_pan_right"]["ratio"] == (1.0, "built in")
    assert told["lid_right"]["sign"] == (-1, "mirror of lid_left")
    assert told["lid_right"]["drive"][1] == "mirror of lid_left"
    assert told["lid_left"]["drive"][1] == "head file"


def test_every_joint_and_key_is_there():
    told = provenance("reachy_mini")
    assert list(told) == list(load_head("reachy_mini").joints)
    assert all(tuple(values) == SHOWN for values in told.values())
