"""The pseudo terminal that an emulated chain sits behind, under a name that stays when it is hung up and comes back."""

from __future__ import annotations

import fcntl
import os
import select
import struct
import tty
from typing import Final

_TCGETS2: Final = 0x802C542A  # struct termios2 tells any rate as a number, odd ones too
_TERMIOS2: Final = struct.Struct("=4IB19s2I")
_OUTPUT_RATE: Final = -1


class PseudoTerminal:
    """An open pty. `link` is a symbolic link to it, replaced when it is opened and removed when it is closed."""

    def __init__(self, link: str) -> None:
        self.link = link
        self.fd, self._slave = os.openpty()  # the slave stays open, so that hosts may come and go
        tty.setraw(self._slave)
        os.set_blocking(self.fd, False)
        self.path = os.ttyname(self._slave)
        beside = f"{link}.new"
        if os.path.lexists(beside):
            os.unlink(beside)
        os.symlink(self.path, beside)
        os.replace(beside, link)

    def baud(self) -> int:
        """What the host has set."""
        raw = fcntl.ioctl(self.fd, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(raw)[_OUTPUT_RATE])

    def send(self, data: bytes, patience_s: float) -> None:
        """Write what the terminal takes within `patience_s`; the rest is lost, as on a wire."""
        view = memoryview(data)
        while view and select.select([], [self.fd], [], patience_s)[1]:
            view = view[os.write(self.fd, view) :]

    def close(self) -> None:
        """Hosts see the device vanish. The link goes too, unless somebody else has taken its name."""
        if os.path.islink(self.link) and os.readlink(self.link) == self.path:
            os.unlink(self.link)
        os.close(self.fd)
        os.close(self._slave)
