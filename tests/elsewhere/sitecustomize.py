"""A computer without what only Linux, or only POSIX, has; for processes with this folder on PYTHONPATH.

No pseudo terminals, no sockets in the file system, no /proc; `select` takes sockets alone, as on Windows.
"""

import os
import select
import signal
import socket
import stat
import sys
from importlib import import_module

HIDDEN = ("fcntl", "pty", "resource", "termios", "tty")
_select = select.select

for name in ("asyncio", "serial", "subprocess"):  # made for POSIX here: they keep what they need of it
    import_module(name)
for name in HIDDEN:
    sys.modules[name] = None
for module, name in ((os, "openpty"), (socket, "AF_UNIX"), (signal, "SIGHUP"), (signal, "SIGUSR1")):
    delattr(module, name)


def of_sockets(read, write, other, timeout=None):
    """Wait as `select.select`. Raises OSError for what is not a socket."""
    for each in (*read, *write, *other):
        number = each if isinstance(each, int) else each.fileno()
        if not stat.S_ISSOCK(os.fstat(number).st_mode):
            raise OSError(f"{number}: not a socket")
    return _select(read, write, other, timeout)


def socket_pair():
    """Return two sockets that are connected by loopback."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return socket.create_connection(server.getsockname()), server.accept()[0]


def hide_proc(event, arguments):
    """Refuse to open what is in /proc, and to list it."""
    if event in ("open", "os.listdir", "os.scandir") and str(arguments[0]).startswith("/proc"):
        raise PermissionError(f"{arguments[0]} is hidden")


select.select, socket.socketpair = of_sockets, socket_pair
sys.addaudithook(hide_proc)
