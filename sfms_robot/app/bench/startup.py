"""Process start of the command line."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

from sfms_robot.app.bench.measure import Row, row, times


def startup() -> dict[str, Row]:
    def python(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)

    ours = times(
        python("-c", "from sfms_robot.cli.main import main; import sys; sys.argv[1:] = ['--help']; main()"), 10
    )
    return {"help": row(ours, times(python("-c", "pass"), 10), "ms", "python -c pass")}
