"""How a command line ended."""

import json
from typing import NamedTuple


class Ended(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def told(self):
        """The last line of stdout, as JSON."""
        return json.loads(self.out.splitlines()[-1])

    @property
    def complaint(self) -> str:
        """The one line on stderr."""
        (line,) = self.err.strip().splitlines()
        return line
