"""The virtual human as pages load it."""

from __future__ import annotations

import gzip
from functools import cache

_LEVEL = 6


@cache
def human_gz() -> bytes:
    """`face.human_mesh`, compressed. Blocks for a second, once."""
    from sfms_robot.face.human import load_human  # scipy's trees: in the thread that makes it, not at start-up
    from sfms_robot.face.human_mesh import packed_human

    return gzip.compress(packed_human(load_human()), _LEVEL)
