"""A program on the other side of `net_messages`: what it packs."""

import struct

import numpy as np

from sfms_robot.sources.net_messages import FACE

HEADER = struct.Struct("<BBHIdd")
LENGTH = struct.Struct("<I")


def face_message(sent_s, at_s, motion, attention=None):
    """A face (58,), None: it is lost."""
    values = [] if motion is None else [*motion, *([] if attention is None else [attention])]
    return HEADER.pack(FACE, 1, 0, 0, sent_s, at_s) + np.array(values, "<f4").tobytes()


def framed(message):
    """A message as it goes over TCP."""
    return LENGTH.pack(len(message)) + message
