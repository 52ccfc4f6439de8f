"""docs/reference/protocol.md says of the page's WebSocket what the code does: every message, every key, every limit."""

import json
import re
from pathlib import Path

import numpy as np

import sfms_robot
from sfms_robot.app.listen.knobs import LiveKnobs
from sfms_robot.app.listen.page_observer import page_facts
from sfms_robot.app.options import RunOptions
from sfms_robot.config import load_head
from sfms_robot.frames import MOTION_DIM
from sfms_robot.viewer import page_messages

DOCS = Path(sfms_robot.__file__).parents[1] / "docs"
PAGE = (DOCS / "reference" / "protocol.md").read_text(encoding="utf-8").partition("## The page's WebSocket\n")[2]
TOLD, ASKED = PAGE.partition("### From the robot to the page\n")[2].split("### What a page asks for\n")
# Of a hello: they differ between visitors, or change.
OF_VISITORS = {"controls", "needs_token", "over", "record", "torque_unconfirmed"}


def rows(part: str) -> dict[str, set[str]]:
    """Message -> every word in backticks of what a table says of it."""
    table = [re.findall(r"^\| (`.+?) \| (.*) \|$", line) for line in part.splitlines()]
    words = [
        (re.findall(r"`(\w+)`", names), set(re.findall(r"`(\w+)`", text))) for [(names, text)] in filter(None, table)
    ]
    return {name: found for names, found in words for name in names}


def test_every_command_is_described_with_all_its_keys():
    described = rows(ASKED)
    assert set(described) == set(page_messages.COMMANDS)
    for name, command in page_messages.COMMANDS.items():
        keys = command.model_fields
        assert set(keys) - {"seconds"} <= described[name], name
        assert ("seconds" in described[name]) == ("seconds" in keys), name


def test_every_message_and_every_key_of_a_hello_and_of_a_frame_is_described():
    kinds = ("hello", "frame", "event", "status", "controls", "record", "over", "error", "pong")
    assert tuple(rows(TOLD)) == kinds
    head = load_head("face28")
    facts = page_facts(head, RunOptions(), LiveKnobs(head), None, choices=True)
    keys = set(facts) | OF_VISITORS | set(facts["joints"][0]) | set(facts["listeners"][0]) | set(facts["source"])
    assert keys <= rows(TOLD)["hello"]
    record = page_messages.pack_picture(
        0.0, np.zeros(MOTION_DIM), np.zeros(1), np.zeros(1, np.float32), page_messages.rare_json("idle", (), {}, None)
    )
    assert set(json.loads(page_messages.frame_json(record))) - {"type"} <= rows(TOLD)["frame"]
