import copy
import math
from pathlib import Path

import pytest
import yaml

from sfms_robot.config import Head, load, load_head
from sfms_robot.errors import ConfigError

SMALL = {
    "name": "small",
    "description": "two joints",
    "buses": {"main": {"family": "dynamixel2", "baud": 1000000}},
    "limits": {"slow": {"speed_deg_s": 90, "acceleration_deg_s2": 900, "jerk_deg_s3": 9000}},
    "joints": {
        name: {
            "bus": "main", "id": number, "model": "xl330-m288", "zero_ticks": 2048,
            "min_deg": -10, "max_deg": 20, "limits": "slow", "drive": channel,
        }
        for number, name, channel in ((1, "jaw", "jawOpen"), (2, "lid", "eyeBlinkLeft"))
    },
}  # fmt: skip


def written(folder: Path, *path_and_value) -> Path:
    """The small head with one value changed (or, for "DELETE", left out), as a file."""
    raw = copy.deepcopy(SMALL)
    if path_and_value:
        *path, last, value = path_and_value
        place = raw
        for key in path:
            place = place[key]
        place[last] = value
        if value == "DELETE":
            del place[last]
    file = folder / "head.yaml"
    file.write_text(yaml.safe_dump(raw, sort_keys=False))
    return file


def test_a_right_head_loads(tmp_path):
    head = load(Head, written(tmp_path))
    assert list(head.joints) == ["jaw", "lid"]
    assert head.joints["jaw"].max_rad == pytest.approx(math.radians(20))


WRONG = {
    "unknown channel": (
        ("joints", "jaw", "drive", {"sum": ["jawOpne"]}),
        ["joints.jaw.drive", "'jawOpne' is not a channel", "jawOpen"],
    ),
    "unknown bus": (("joints", "jaw", "bus", "mian"), ["joints.jaw.bus = 'mian'", "(main)"]),
    "unknown limit class": (("joints", "jaw", "limits", "fast"), ["joints.jaw.limits = 'fast'", "(slow)"]),
    "id used twice": (("joints", "lid", "id", 1), ["joints.lid.id = 1 is used twice", "'main'", "jaw"]),
    "limits reversed": (("joints", "jaw", "min_deg", 30), ["joints.jaw", "min_deg 30", "max_deg 20", "reversed"]),
    "rest outside": (("joints", "jaw", "rest_deg", 25), ["joints.jaw", "rest_deg 25 is outside -10..20"]),
    "unknown key": (("joints", "jaw", "speed", 3), ["joints.jaw", "'speed' is not a known key", "min_deg", "lag_ms"]),
    "not a number": (("joints", "jaw", "max_deg", math.nan), ["joints.jaw.max_deg", "nan", "finite"]),
    "infinite": (("joints", "jaw", "max_deg", math.inf), ["joints.jaw.max_deg", "finite"]),
    "infinite gain": (
        ("joints", "jaw", "drive", {"channel": "jawOpen", "gain": math.inf}),
        ["joints.jaw.drive.gain", "finite"],
    ),
    "no speed": (("limits", "slow", "speed_deg_s", 0), ["limits.slow.speed_deg_s = 0", "greater than 0"]),
    "key missing": (("joints", "jaw", "id", "DELETE"), ["joints.jaw.id", "required"]),
    "unknown family": (
        ("buses", "main", "family", "dynamixle"),
        ["buses.main.family = 'dynamixle'", "(dynamixel2, dynamixel1,"],
    ),
    "two kinds": (
        ("joints", "jaw", "drive", {"sum": ["jawOpen"], "max": ["jawOpen"]}),
        ["joints.jaw.drive", "sum, max"],
    ),
    "empty sum": (("joints", "jaw", "drive", {"sum": []}), ["joints.jaw.drive.sum", "at least 1 item"]),
    "clamp reversed": (
        ("joints", "jaw", "drive", {"channel": "jawOpen", "clamp": [1, 0]}),
        ["joints.jaw.drive", "clamp [1.0, 0.0] is reversed"],
    ),
    "no joints": (("joints", {}), ["joints"]),
}


@pytest.mark.parametrize("change, told", WRONG.values(), ids=WRONG.keys())
def test_a_wrong_head_is_one_line_with_file_key_value_and_choices(tmp_path, change, told):
    file = written(tmp_path, *change)
    with pytest.raises(ConfigError) as caught:
        load(Head, file)
    text = str(caught.value)
    assert text.startswith(f"{file}: ") and "\n" not in text
    for part in told:
        assert part in text


def test_a_joint_given_twice_is_told_with_its_line(tmp_path):
    file = written(tmp_path)
    text = file.read_text()
    file.write_text(text + text[text.index("  jaw:") :])
    with pytest.raises(ConfigError, match=r"head.yaml:\d+: 'jaw' is given twice"):
        load(Head, file)


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "joints: [", "name: \x00"])
def test_a_file_that_is_no_mapping_is_one_line(tmp_path, text):
    file = tmp_path / "head.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load(Head, file)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_an_unknown_head_lists_the_shipped_ones():
    with pytest.raises(ConfigError, match=r"head 'face82'.*face28"):
        load_head("face82")
