"""Work for a `SourceWorker` that is known beforehand."""

import threading


def shows(messages):
    """Yields these, then nothing more, but does not end."""
    yield from messages
    threading.Event().wait()
