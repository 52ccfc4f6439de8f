"""The command line in a process, and how it ended."""

import json
import sys
from typing import NamedTuple

PROGRAM = [sys.executable, "-P", "-c", "from sfms_robot.cli.main import main; main()"]


class Ended(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def told(self):
        """The last line of stdout, as JSON: NaN and Infinity are errors."""
        return json.loads(self.out.splitlines()[-1], parse_constant=_no_json)

    @property
    def complaint(self) -> str:
        """The one line on stderr."""
        (line,) = self.err.strip().splitlines()
        return line


def _no_json(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON")
