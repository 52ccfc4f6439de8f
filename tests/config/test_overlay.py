"""Measurements of one build: laid over the head's file, they hold only for the servo and file they were made with."""

import math
from datetime import date

import numpy as np
import pytest
import yaml

from sfms_robot.config import load_firmware_map, load_head
from sfms_robot.config import overlay as overlays
from sfms_robot.config.joint import Expression
from sfms_robot.data import find, head_file
from sfms_robot.errors import ConfigError
from sfms_robot.motion.calibration import Calibration

DAY = date(2026, 5, 17)
SHA = overlays.head_hash("face28")
FACE = load_head("face28")


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))


def measured(joint="jaw", low=1800, rest=2000, high=2400, sign=1, **more) -> overlays.Measured:
    config = FACE.joints[joint]
    known = {"id": config.id, "model": config.model, "firmware": 53, "homing_offset": 0, "drive_mode": 0}
    ticks = {"min_ticks": low, "center_ticks": rest, "max_ticks": high}
    return overlays.Measured.model_validate({**known, "date": DAY, "sign": sign, **ticks, **more})


def identity(found: overlays.Measured) -> overlays.Identity:
    return overlays.Identity(**{key: getattr(found, key) for key in overlays.Identity.model_fields})


def overlay(sha256=SHA, fit=None, **joints) -> overlays.Overlay:
    return overlays.Overlay(
        head="face28", calibrate=overlays.CalibrateLayer(head_sha256=sha256, joints=joints), fit=fit
    )


FITTED = "brow_inner_left"
LEARNT = overlays.Fitted(drive=Expression(channel="browInnerUp", curve=((0, 0), (1, 0.5))))
FIT = overlays.FitLayer(head_sha256=SHA, date=DAY, joints={FITTED: LEARNT})


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("joint", ["jaw", "lid_left", "neck_yaw", "eye_tilt_right"])
def test_ends_and_rest_lie_where_they_were_measured(joint, sign):
    config = FACE.joints[joint]
    at_end = config.rest_deg == config.min_deg
    ticks = (1800, 1800 if at_end else 2010, 2400)
    low, rest, high = ticks if sign > 0 else [4095 - t for t in ticks]
    found = overlays.calibrated(config, measured(joint, low, rest, high, sign), FACE.safety)
    conversion = Calibration({joint: found}, np.array([load_firmware_map(config.model).ticks_per_revolution]))
    angles = [[math.radians(found.min_deg)], [found.rest_rad], [found.max_rad]]
    assert [int(conversion.to_ticks(np.array(a))[0]) for a in angles] == pytest.approx([low, rest, high], abs=1)
    assert found.rest_deg == config.rest_deg and found.min_deg <= found.rest_deg <= found.max_deg
    assert conversion.low_ticks[0] >= min(low, high) and conversion.high_ticks[0] <= max(low, high)


def test_it_is_read_back_as_it_was_written():
    whole = overlay(jaw=measured(), lid_left=measured("lid_left", firmware=None), fit=FIT)
    overlays.save_overlay(whole, overlays.overlay_file("face28"))
    assert overlays.load_overlay(FACE) == whole
    assert list(overlays.overlay_file("face28").parent.iterdir()) == [overlays.overlay_file("face28")]


def test_without_an_overlay_the_head_is_as_its_file_says_and_with_one_only_what_was_measured_changes():
    layers = overlays.layered(FACE, overlays.load_overlay(FACE), SHA)
    assert layers.head == FACE and not layers.calibrated and not layers.refused
    layers = overlays.layered(FACE, overlay(jaw=measured()), SHA, {"jaw": identity(measured())})
    assert layers.calibrated == {"jaw"} and not layers.refused
    assert layers.head.joints["jaw"] == overlays.calibrated(FACE.joints["jaw"], measured(), FACE.safety)
    assert {**layers.head.joints, "jaw": None} == {**FACE.joints, "jaw": None}


@pytest.mark.parametrize(
    ("now", "why"),
    [
        ({"firmware": 52}, "firmware was 53 and is 52"),
        ({"homing_offset": -40}, "homing_offset was 0 and is -40"),
        ({"drive_mode": 1}, "drive_mode was 0 and is 1"),
        ({"model": "xl330-m077"}, "model was xl330-m288 and is xl330-m077"),
        (None, "its servo does not answer"),
    ],
)
def test_a_joint_with_another_servo_is_to_be_calibrated_first_and_no_other(now, why):
    both = overlay(jaw=measured(), lid_left=measured("lid_left"))
    servos = {"jaw": identity(measured()), "lid_left": identity(measured("lid_left"))}
    servos["jaw"] = None if now is None else overlays.Identity(**{**servos["jaw"].model_dump(), **now})
    layers = overlays.layered(FACE, both, SHA, servos)
    assert layers.refused == {"jaw": why} and layers.calibrated == {"lid_left"}
    assert layers.head.joints["jaw"] == FACE.joints["jaw"]


def test_a_fitted_drive_lies_over_a_measured_joint_and_an_edited_head_file_puts_every_joint_back():
    joint = FITTED
    layers = overlays.layered(FACE, overlay(fit=FIT, **{joint: measured(joint)}), SHA)
    assert layers.head.joints[joint].zero_ticks != FACE.joints[joint].zero_ticks
    assert layers.head.joints[joint].drive == FIT.joints[joint].drive
    layers = overlays.layered(FACE, overlay("0" * 64, jaw=measured(), fit=FIT), SHA)
    assert layers.refused == {"jaw": overlays.OLD_FILE} and layers.fitted == {FITTED}
    old = FIT.model_copy(update={"head_sha256": "0" * 64})
    layers = overlays.layered(FACE, overlay(jaw=measured(), fit=old), SHA)
    assert layers.calibrated == {"jaw"} and not layers.fitted and overlays.OLD_FILE in layers.notes[0]


def test_show_tells_calibrated_and_fitted_values_from_those_of_the_file():
    overlays.save_overlay(overlay(jaw=measured(), fit=FIT), overlays.overlay_file("face28"))
    told, refused = overlays.provenance("face28")
    assert told["jaw"]["sign"] == (1, "calibrate 2026-05-17")
    assert told["jaw"]["max_deg"][1] == "calibrate 2026-05-17" and told["jaw"]["id"][1] == "head file"
    assert told[FITTED]["drive"][1] == "fit 2026-05-17" and told["lid_left"]["drive"][1] == "head file"
    assert refused == []


def test_show_names_the_origin_of_an_end_that_a_twin_of_the_opposite_sense_has(tmp_path):
    raw = yaml.safe_load(head_file("face28").read_text())
    raw["joint_defaults"]["max_deg"] = raw["joints"]["eye_pan_left"].pop("max_deg")
    (tmp_path / "head.yaml").write_text(yaml.safe_dump(raw))
    told = overlays.provenance(str(tmp_path))[0]["eye_pan_right"]
    assert [told[key][1] for key in ("min_deg", "max_deg")] == ["joint_defaults", "mirror of eye_pan_left"]


def test_show_tells_what_does_not_hold():
    overlays.save_overlay(overlay("0" * 64, jaw=measured()), overlays.overlay_file("face28"))
    told, refused = overlays.provenance("face28")
    assert refused == [f"jaw: its calibration does not hold: {overlays.OLD_FILE}"]
    assert told["jaw"]["sign"][1] == "built in"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": {"chin": {}}}, "calibrate.joints.chin.id"),
        ({"joints": {"chin": measured().model_dump(mode="json")}}, "'chin' is not a joint of this head .*jaw"),
        ({"sign": 2}, "calibrate.joints.jaw.sign = 2"),
        ({"min_ticks": 2100}, "are not in the order of sign 1"),
        ({"min_ticks": 2400, "center_ticks": 2400}, "no travel"),
        ({"colour": "red"}, "'colour' is not a known key"),
    ],
)
def test_a_mistake_in_the_overlay_is_named_with_its_file(change, message):
    plain = overlay(jaw=measured()).model_dump(mode="json", exclude_none=True)
    if "joints" in change:
        plain["calibrate"] |= change
    else:
        plain["calibrate"]["joints"]["jaw"] |= change
    file = overlays.overlay_file("face28")
    file.parent.mkdir(parents=True)
    file.write_text(yaml.safe_dump(plain))
    with pytest.raises(ConfigError, match=message) as caught:
        overlays.load_overlay(FACE)
    assert str(file) in str(caught.value)


def copied(folder, *changes):
    """A head of the user's own: a shipped one, some words of its file changed."""
    text = (find("heads", "interbotix_wxxms", "head.yaml") / "head.yaml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    folder.mkdir()
    (folder / "head.yaml").write_text(text)
    return str(folder)


def test_a_stored_value_goes_into_the_user_s_own_file_and_all_else_in_it_stays(tmp_path):
    name = copied(tmp_path / "turret")
    file = tmp_path / "turret" / "head.yaml"
    before = file.read_text()
    assert overlays.record_stored(name, "tilt", {"drive_mode": 0, "homing_offset": -100}) == file
    changed = "{stored: {homing_offset: -100, drive_mode: 0}}"
    assert file.read_text() == before.replace("{stored: {drive_mode: 1}}", changed)
    head = load_head(name)
    assert head.safety_of("tilt").stored == {"drive_mode": 0, "homing_offset": -100}
    assert head.safety_of("pan").stored == {"drive_mode": 0} and not overlays.overlay_file(head.name).exists()


SHARED = {
    "alias": (
        ("safety: {stored: {drive_mode: 0}}", "safety: &same {stored: {drive_mode: 1}}"),
        ("safety: {stored: {drive_mode: 1}}", "safety: *same"),
    ),
    "mirror": (("    safety: {stored: {drive_mode: 1}}\n", "    mirror_of: pan\n"),),
}


@pytest.mark.parametrize("form", SHARED)
def test_a_file_in_which_one_joint_cannot_change_alone_gets_an_overlay(tmp_path, form):
    name = copied(tmp_path / "turret", *SHARED[form])
    before, head = (tmp_path / "turret" / "head.yaml").read_text(), load_head(name)
    assert overlays.record_stored(name, "pan", {"drive_mode": 4}) == overlays.overlay_file(head.name)
    assert (tmp_path / "turret" / "head.yaml").read_text() == before
    now = overlays.layered(head, overlays.load_overlay(head), overlays.head_hash(name)).head
    assert now.safety_of("pan").stored == {"drive_mode": 4} and now.joints["tilt"] == head.joints["tilt"]


def test_a_shipped_head_and_one_that_was_calibrated_are_not_edited(tmp_path):
    shipped = find("heads", "interbotix_wxxms", "head.yaml") / "head.yaml"
    before = shipped.read_bytes()
    for name in ("interbotix_wxxms", str(shipped.parent), copied(tmp_path / "turret")):
        assert overlays.record_stored(name, "tilt", {"drive_mode": 0}) == overlays.overlay_file("interbotix_wxxms")
    assert shipped.read_bytes() == before == (tmp_path / "turret" / "head.yaml").read_bytes()
    overlays.record_stored("interbotix_wxxms", "pan", {"drive_mode": 1}, practice=True)
    head, sha256 = load_head("interbotix_wxxms"), overlays.head_hash("interbotix_wxxms")
    now = overlays.layered(head, overlays.load_overlay(head), sha256).head
    assert [now.safety_of(joint).stored["drive_mode"] for joint in ("pan", "tilt")] == [0, 0]
    assert overlays.layered(head, overlays.load_overlay(head), "0" * 64).head == head  # recorded for another file


def test_what_was_measured_keeps_what_the_head_declares_for_all_joints():
    usual = FACE.safety.model_copy(update={"stored": {"operating_mode": 3}})
    now = overlays.layered(FACE.model_copy(update={"safety": usual}), overlay(jaw=measured()), SHA).head
    assert now.safety_of("jaw").stored == {"operating_mode": 3, "homing_offset": 0, "drive_mode": 0}


def test_a_value_comes_from_its_own_line_its_twin_the_defaults_or_nowhere():
    told, _ = overlays.provenance("face28")
    assert told["eye_pan_right"]["id"] == (2, "head file")
    assert told["eye_pan_right"]["max_deg"] == (30.0, "mirror of eye_pan_left")
    assert told["eye_pan_right"]["model"] == ("xl330-m288", "joint_defaults")
    assert told["eye_pan_right"]["ratio"] == (1.0, "built in")
    assert told["lid_right"]["sign"] == (-1, "mirror of lid_left")
    assert told["lid_right"]["drive"][1] == "mirror of lid_left" and told["lid_left"]["drive"][1] == "head file"
