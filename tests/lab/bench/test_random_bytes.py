"""Random bytes on the line of every family of servos, in virtual time, half of them shaped like packets.

A port delivers them before the servos' answers while the loop continues. Afterwards every joint has to recover within
2 s, without an exception or growing memory. An 8-bit checksum accepts one forged answer in 256, so positions are not
judged, but the goals that servos hold are.
"""

import random
import resource

import pytest

from sfms_robot.lab.bench.campaign_rig import FAMILIES, RECOVERY_S, Judge, head_of, plugged_in
from sfms_robot.servo.port import WrappedPort

MOST = 1024  # bytes in one tick
WAITING = 8 * MOST  # a driver's buffer holds no more
CALM_TICKS = 240
GROWN_MIB = 64.0
NOISY = 0.8  # share of the ticks
BEGINNINGS = (b"\xff\xff\xfd\x00", b"\xff\xff", b"\xff\xf5", b"\xff\xff\xfd\x00\xfe", b"\xff\xff\xfe")


class NoisyPort(WrappedPort):
    """Delivers random bytes before the servos' answers, and counts those read or discarded."""

    def __init__(self, inner, seed):
        super().__init__(inner)
        self.dice, self.waiting, self.count = random.Random(seed), bytearray(), 0

    def rise(self):
        """Add the bytes of one tick."""
        if self.dice.random() < NOISY and len(self.waiting) < WAITING:
            start = self.dice.choice(BEGINNINGS) if self.dice.random() < 0.5 else b""
            self.waiting += start + self.dice.randbytes(self.dice.randint(1, MOST))

    def read(self, n, deadline_s):
        if not self.waiting:
            return super().read(n, deadline_s)
        piece = bytes(self.waiting[: self.dice.randint(1, n)])
        del self.waiting[: len(piece)]
        self.count += len(piece)
        return piece

    def discard_input(self):
        self.count += len(self.waiting)
        self.waiting.clear()
        super().discard_input()


@pytest.mark.parametrize("count", [5_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", FAMILIES)
def test_random_bytes_do_no_harm(family, count):
    ports = []

    def noisy(port):
        if ports:  # the bus has opened its port again
            ports[0].inner = port
        else:
            ports.append(NoisyPort(port, seed=0))
        return ports[0]

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with plugged_in(head_of(family), wrap=noisy) as rig:
        rig.hold()
        (noise,), judge, calm, end_s = ports, Judge(rig), 0, 0.0
        while calm < CALM_TICKS:
            if noise.count < count:
                noise.rise()
                end_s = rig.clock.now_s()
            else:
                noise.waiting.clear()
                calm += 1
            judge.see(rig.tick())
        assert noise.count >= count and not judge.outside and judge.recovered_s(end_s) <= RECOVERY_S
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024 < GROWN_MIB
