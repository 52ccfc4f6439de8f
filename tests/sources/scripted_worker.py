"""Work for a `SourceWorker` that is known beforehand, and a wait for what one sends."""

import threading


def shows(messages):
    """Yield these, then nothing more, but do not end."""
    yield from messages
    threading.Event().wait()


def wait_for_message(worker, limit_s):
    """Wait until a worker has sent something, for `limit_s` at most; `messages` still returns it."""
    message = worker._supervised.child.receive(limit_s)
    if message is not None:
        worker._first.append(message)
