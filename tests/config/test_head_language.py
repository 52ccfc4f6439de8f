"""A head's language at the edge: every example of the guide loads, every mistake is told, the schema is in step."""

import copy
import json
import math
import re
import sys
import tempfile
from pathlib import Path

import pytest
import yaml
from pydantic import TypeAdapter

from sfms_robot.config import Arig, Expression, Head, Joint, LimitClass, Region, Sfms, load, parse
from sfms_robot.config.base import read
from sfms_robot.config.check import check_head
from sfms_robot.config.head import Gaze, Idle
from sfms_robot.config.joint import Coupling, Fold
from sfms_robot.config.training import ArigTraining, Training
from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS

CONFIGS = data_dir("configs")
GUIDE = (Path(__file__).parents[2] / "docs" / "guide" / "heads.md").read_text(encoding="utf-8")


def parsed(block: str):
    """As the loader of heads has it: `on` is a text."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "block.yaml"
        file.write_text(block, encoding="utf-8")
        return read(file)


EXAMPLES = [parsed(block) for block in re.findall(r"```yaml\n(.*?)```", GUIDE, re.S)]
OWL = EXAMPLES[0]


def added(example) -> dict:
    """The first head of the guide with the parts of an example added."""
    raw = copy.deepcopy(OWL)
    for key, value in example.items():
        raw[key] = {**raw.get(key, {}), **value} if isinstance(value, dict) else value
    return raw


def written(folder: Path, raw) -> Path:
    file = folder / "head.yaml"
    file.write_text(yaml.safe_dump(raw, sort_keys=False), encoding="utf-8")
    return file


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: "-".join(example))
def test_every_example_of_the_guide_is_a_head_or_part_of_one(example, tmp_path):
    written(tmp_path, added(example))
    assert check_head(str(tmp_path)) == []
    load(Head, tmp_path / "head.yaml")


@pytest.mark.parametrize("model", [Head, LimitClass, Expression, Joint, Coupling, Fold, Region, Gaze, Idle])
def test_the_guide_has_every_key(model):
    for key in model.model_fields:
        assert re.search(rf"\b{key}\b", GUIDE), f"{model.__name__}.{key} is not in docs/guide/heads.md"


def test_the_first_head_of_the_guide_is_short_and_the_schemas_for_editors_are_in_step():
    assert len(re.findall(r"```yaml\n(.*?)```", GUIDE, re.S)[0].splitlines()) <= 22
    shipped = {file: (CONFIGS / file).read_text(encoding="utf-8") for file in schemas()}
    assert shipped == schemas(), "python tests/config/test_head_language.py --write"


def head_schema():
    """Return the JSON schema of a head's file, with bare names of expressions and joints that inherit keys."""
    whole = Head.model_json_schema()
    parts = whole["$defs"]
    names = [{"enum": list(CHANNELS)}, {"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9_]*$"}]
    parts["Node"] = {k: v for k, v in parts["Expression"].items() if k != "title"}
    parts["Expression"] = {"title": "Expression", "anyOf": [*names, {"$ref": "#/$defs/Node"}]}
    parts["Node"]["properties"]["channel"]["anyOf"][0] = {"enum": list(CHANNELS)}
    parts["Fold"]["properties"]["channel"] = {"enum": list(CHANNELS), "title": "Channel"}
    parts["Joint"]["required"] = ["id"]  # joint_defaults or mirror_of may give the others
    return whole


def schemas():
    """Return the JSON schemas for editors, by file: each names the kinds that its files may hold."""
    found = {
        "heads/head.schema.json": head_schema(),
        "listeners/listener.schema.json": TypeAdapter(Sfms | Arig).json_schema(),
        "training/training.schema.json": TypeAdapter(Training | ArigTraining).json_schema(),
    }
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {file: json.dumps(draft | schema, indent=1) + "\n" for file, schema in found.items()}


@pytest.mark.parametrize("pattern", ["heads/*/head.yaml", "listeners/*/config.yaml", "training/*.yaml"])
def test_every_shipped_file_names_its_schema_in_the_first_line(pattern):
    for file in CONFIGS.glob(pattern):
        line = file.read_text(encoding="utf-8").splitlines()[0]
        named = line.removeprefix("# yaml-language-server: $schema=")
        assert named != line and (file.parent / named).is_file(), file


def x(**joint) -> dict:
    """Return a head that has a joint x with these keys."""
    return {"joints": {"x": {"id": 9, "min_deg": -10, "max_deg": 20, **joint}}}


def coupled(*moving: str, at_least=0.0, **keep: float) -> dict:
    return {"keep": keep, "at_least": at_least, "moving": list(moving)}


WRONG = {
    "curve": (
        x(drive={"channel": "jawOpen", "curve": [[0, 0], [0.5, 1], [0.5, 2]]}),
        "joints.x.drive: curve is not a function: x goes from 0.5 to 0.5, it has to rise",
    ),
    "one point": ({"expressions": {"a": {"channel": "yaw", "curve": [[0, 0]]}}}, "a.curve: Tuple should have at least"),
    "circle": (
        {"expressions": {"a": "b", "b": {"sum": ["yaw", "c"]}, "c": {"use": "a", "gain": 2}}},
        "expressions.a uses itself: a -> b -> c -> a",
    ),
    "own circle": ({"expressions": {"a": {"max": ["a", "yaw"]}}}, "expressions.a uses itself: a -> a"),
    "unknown name": (
        {"expressions": {"smile": "mouthSmileLeft", "grin": {"mean": ["yaw", "smlie"]}}},
        "expressions.grin: 'smlie' is not a channel, nor an expression of this head (smile, grin; roll",
    ),
    "channel's name": ({"expressions": {"yaw": "roll"}}, "expressions.yaw has the name of a channel"),
    "mirror of nothing": (x(mirror_of="lid"), "joints.x.mirror_of = 'lid' is not a joint of this head ("),
    "mirror of a mirror": (x(mirror_of="lid_right"), "x.mirror_of = 'lid_right' is itself a mirror; name the joint"),
    "mirror and drive": (x(mirror_of="beak", drive="yaw"), "x: has a drive and is mirror_of 'beak': one of them"),
    "rest outside": (x(rest_deg=25), "joints.x: rest_deg 25 is outside -10..20"),
    "not a number": (x(max_deg=math.nan), "joints.x.max_deg = nan: Input should be"),
    "infinite": (x(max_deg=math.inf), "joints.x.max_deg = inf: Input should be"),
    "infinite gain": (x(drive={"channel": "jawOpen", "gain": math.inf}), "joints.x.drive.gain = inf: Input should be"),
    "two kinds": (x(drive={"sum": ["yaw"], "max": ["yaw"]}), "sum, max"),
    "empty sum": (x(drive={"sum": []}), "drive.sum: Tuple should have at least 1"),
    "clamp reversed": (x(drive={"channel": "jawOpen", "clamp": [1, 0]}), "x.drive: clamp [1.0, 0.0] is reversed"),
    "fold": (
        {"folds": [{"channel": "yaw", "into": "chin", "gain": 1}]},
        "folds.0.into = 'chin' is not a joint of this head (neck_yaw,",
    ),
    "coupling of nothing": (
        {"couplings": [coupled("beak", beak=1, chin=1)]},
        "couplings.0.keep: 'chin' is not a joint of this head (neck_yaw,",
    ),
    "coupling without weight": (
        {"couplings": [coupled("lid_left", beak=1, lid_left=0)]},
        "couplings.0: moving: 'lid_left' has no weight under keep (beak, lid_left)",
    ),
    "coupling that excludes rest": (
        {"couplings": [coupled("beak", beak=1, lid_left=1, at_least=0.1)]},
        "couplings.0.at_least = 0.1: Input should be less than or equal to 0",
    ),
    "couplings that fight": (
        {"couplings": [coupled("beak", beak=1, lid_left=1), coupled("lid_right", beak=-1, lid_right=1)]},
        "couplings.0.moving: 'beak' is also in couplings.1, one would undo the other",
    ),
    "threshold without a reading": ({"faults": {"thresholds": {"shock": {"max": 1}}}}, "faults.thresholds.shock"),
    "two regions": (
        {"regions": {"a": {"joints": ["beak"]}, "b": {"joints": ["beak"]}}},
        "regions.b.joints: 'beak' is already in region a",
    ),
    "knob": ({"regions": {"a": {"joints": ["beak"], "style": 2.5}}}, "regions.a.style = 2.5: Input should be less"),
    "long product": ({"expressions": {"a": {"product": ["yaw"] * 5}}}, "a.product: Tuple should have at most 4 items"),
    "defaults": ({"joint_defaults": {"buss": "main"}}, "joint_defaults: 'buss' is not a known key (bus, model"),
    "life": ({"life": {"gaze": {"neck_gain": -1}}}, "life.gaze.neck_gain = -1: Input should be greater than or equal"),
}


@pytest.mark.parametrize("change, told", WRONG.values(), ids=WRONG.keys())
def test_a_wrong_word_is_told_by_the_check_and_refused_by_the_loader(change, told, tmp_path):
    file, found = written(tmp_path, added(change)), check_head(str(tmp_path))
    assert any(line.startswith(f"{file}: ") and told in line for line in found), found
    with pytest.raises(ConfigError) as caught:
        load(Head, file)
    assert "\n" not in str(caught.value)


def test_expressions_that_multiply_without_end_are_refused():
    doubling = {f"a{i}": {"sum": [f"a{i + 1}", f"a{i + 1}"]} for i in range(40)} | {"a40": "yaw"}
    raw = added({"expressions": doubling, "joints": {"x": {"id": 9, "min_deg": 0, "max_deg": 1, "drive": "a0"}}})
    with pytest.raises(ConfigError, match=r"joints.x.drive has \d+ nodes, .* at most 2000"):
        parse(Head, raw, "head.yaml")


def test_the_check_lists_all_wrong_values_then_all_contradictions(tmp_path):
    raw = added({"expressions": {"a": "b", "b": "a"}, "regions": {"r": {"joints": ["wing"]}}})
    axes = {"yaw": "neck_yaw", "pitch": "neck_ptich"}
    raw["kinematics"] = {"kind": "serial", "order": list(axes), "axes": axes}
    raw["joints"]["neck_yaw"]["bus"] = "mian"
    raw["joints"]["lid_right"]["id"] = 4
    contradictions = (
        "joints.neck_yaw.bus = 'mian'", "joints.lid_right.id = 4 is used twice", "a -> b -> a",
        "regions.r.joints: 'wing' is not a joint", "'neck_ptich' is not a joint", "joints.neck_yaw.drive: the neck",
    )  # fmt: skip
    wrong = raw | {"feather": 1, "kinematics": raw["kinematics"] | {"ordr": 1}}
    del wrong["description"]
    wrong["limits"] = {**raw["limits"], "neck": {**raw["limits"]["neck"], "speed_deg_s": 0}}
    wrong["joints"] = copy.deepcopy(raw["joints"])
    wrong["joints"]["neck_yaw"]["sped"] = 3
    wrong["joints"]["beak"] |= {"max_deg": -5}
    wrong["joints"]["lid_left"]["drive"] = {"channel": "eyeBlnk"}
    values = (
        "'feather' is not a known key", "description: Field required", "limits.neck.speed_deg_s = 0",
        "joints.neck_yaw: 'sped' is not a known key", "'ordr' is not a known key",
        "joints.beak: min_deg 0 is not below max_deg -5", "joints.lid_left.drive.channel = 'eyeBlnk'",
    )  # fmt: skip
    for head, told in ((wrong, values), (raw, contradictions)):
        file, found = written(tmp_path, head), check_head(str(tmp_path))
        assert all(sum(each in line for line in found) == 1 for each in told), found
        assert len(found) == len(told) and all(line.startswith(f"{file}: ") for line in found)


@pytest.mark.parametrize(
    "raw", [[], {}, "head", {"joints": []}, {"joints": {}}, {"joints": {"a": 3}}, {"expressions": {1: "yaw"}}]
)
def test_a_file_of_the_wrong_shape_is_told_and_never_raised(raw, tmp_path):
    written(tmp_path, raw)
    assert check_head(str(tmp_path))


if __name__ == "__main__" and "--write" in sys.argv:
    for name, text in schemas().items():
        (CONFIGS / name).write_text(text, encoding="utf-8")
