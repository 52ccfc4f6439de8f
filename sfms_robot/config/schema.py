"""JSON schema of a head's file, for editors: `python -m sfms_robot.config.schema > configs/heads/head.schema.json`."""

from __future__ import annotations

import json
import sys
from typing import Any

from sfms_robot.config.head import Head
from sfms_robot.frames import CHANNELS


def head_schema() -> dict[str, Any]:
    """What pydantic knows, and what it cannot: bare names for expressions, and joints that inherit what they need."""
    schema = Head.model_json_schema()
    parts = schema["$defs"]
    names = [{"enum": list(CHANNELS)}, {"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9_]*$"}]
    parts["Node"] = {k: v for k, v in parts["Expression"].items() if k != "title"}
    parts["Expression"] = {"title": "Expression", "anyOf": [*names, {"$ref": "#/$defs/Node"}]}
    parts["Node"]["properties"]["channel"]["anyOf"][0] = {"enum": list(CHANNELS)}
    parts["Fold"]["properties"]["channel"] = {"enum": list(CHANNELS), "title": "Channel"}
    parts["Joint"]["required"] = ["id"]  # joint_defaults or mirror_of may give the others
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def text() -> str:
    """The schema as it is shipped."""
    return json.dumps(head_schema(), indent=1) + "\n"


if __name__ == "__main__":
    sys.stdout.write(text())
