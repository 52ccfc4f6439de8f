"""The command line. This file is loaded first and imports almost nothing, so that Ctrl-C is quiet from the start."""

import gc
import os
import signal
import sys


def start() -> None:
    """Run `sfms-robot`. Ctrl-C while its modules are imported ends the process with exit code 130 and no message."""
    before = signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    gc.disable()  # imported objects stay: searching them for garbage would only delay the command
    from sfms_robot.cli.main import main

    gc.freeze()
    gc.enable()
    try:
        signal.signal(signal.SIGINT, before)
        main()
    except KeyboardInterrupt:
        sys.exit(130)
