"""A router of zenoh in this process, on a free port, as the middleware of ROS 2 has one."""

import json
import socket
import threading
from contextlib import contextmanager

from sfms_robot.network import Router, close_session, serve_session, session_config


def free_endpoint():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def client(folder, endpoint):
    """Return the router of a configuration file in `folder`, at an endpoint."""
    file = folder / "robot.json5"
    alone = {"scouting": {"multicast": {"enabled": False}}}
    file.write_text(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}, **alone}))
    return Router(file)


@contextmanager
def serving(endpoint):
    config = session_config("serve")
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    served = serve_session(config)
    yield
    close_session(served)


def until(true):
    """Wait until it is true; messages of two sessions take some milliseconds. Fails after some 20 s."""
    for _ in range(4000):
        if true():
            return
        threading.Event().wait(0.005)
    raise AssertionError("nothing came")
