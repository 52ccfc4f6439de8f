"""Hop of a listener, the time between its plans, in frames of T = 40 ms.

A sound comes at any time within a hop, and reaches the goals after

    0 .. hop T      until the end of the frame with which the next plan is made
    source          until that frame is complete, and the next tick passes it to the listener
    step            until the plan is made, and the next tick has its first goals
    T               more if a plan is a single frame, which is played one frame late (`motion.timeline`)

Half of all sounds come in the later half of a hop, so p50 is the time of a sound 0.5 hop T before its end, and p95 of
one 0.95 hop T before its end.

A plan of H frames is followed until the next one is ready, which is hop T + source + step after its own last speaker
frame. The part of its (H - 1) T that is left by then is available for leads. (A single frame played late has T.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sfms_robot.frames import FRAME_S

STEP_S: Final = 0.025  # longest computation of a plan (99th percentile, paper size, two CPU cores)
LEAD_S: Final = 0.080  # longest lead of a joint: the lag of the slowest servo plus a tick
P50_S: Final = 0.095  # wanted median time from a sound to the first goal of a plan made with it
P95_S: Final = 0.135
_EPS_S: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class Probe:
    """Measurements of a listener: frames of a plan, possible hops, and the time of a plan."""

    horizon: int
    hop: int
    hops: tuple[int, ...]
    step_p50_s: float
    step_p99_s: float


@dataclass(frozen=True, kw_only=True)
class Latencies:
    """Measurements of a run before its hop is chosen, in seconds.

    Attributes:
        horizon: frames of a plan, H.
        source_s: time from the end of a frame until it is complete.
        step_p50_s, step_p99_s: time to make a plan.
        lead_s: longest lead of a joint.
        tick_s: period of the servo loop.
    """

    horizon: int
    source_s: float
    step_p50_s: float
    step_p99_s: float
    lead_s: float
    tick_s: float

    def goal_s(self, hop: int, share: float, step_s: float) -> float:
        """Return the time from a sound, `share` of a hop before the hop's end, to the first goal of a plan with it."""
        given_s = _next_tick(self.source_s, self.tick_s)
        played_late_s = FRAME_S if self.horizon == 1 else 0.0
        return share * hop * FRAME_S + _next_tick(given_s + step_s, self.tick_s) + played_late_s

    def p50_s(self, hop: int) -> float:
        return self.goal_s(hop, 0.5, self.step_p50_s)

    def p95_s(self, hop: int) -> float:
        return self.goal_s(hop, 0.95, self.step_p99_s)

    def left_s(self, hop: int) -> float:
        """Return the time that is left of a plan when the next one comes; negative if the plan has run out by then."""
        return (max(self.horizon - 1, 1) - hop) * FRAME_S - self.source_s - self.step_p99_s

    def fits(self, hop: int) -> bool:
        """Return whether plans leave room for the leads, sounds are answered in time, and the listener keeps up."""
        return not self.given_up(hop)

    def given_up(self, hop: int) -> list[str]:
        """Return a text about each part that does not fit."""
        lost = []
        short_s, p50_s, p95_s = self.lead_s - self.left_s(hop), self.p50_s(hop), self.p95_s(hop)
        if short_s > _EPS_S:
            lost.append(f"the slowest joint moves up to {min(short_s, self.lead_s) * 1e3:.0f} ms late")
        if p50_s > P50_S + _EPS_S or p95_s > P95_S + _EPS_S:
            lost.append(
                f"a sound is answered after {p50_s * 1e3:.0f} ms, 1 of 20 after {p95_s * 1e3:.0f} ms or more"
                f" (wanted: {P50_S * 1e3:.0f} and {P95_S * 1e3:.0f})"
            )
        if not self.keeps_up(hop):
            lost.append(
                f"a plan takes {self.step_p50_s * 1e3:.0f} ms, 1 of 100 {self.step_p99_s * 1e3:.0f} ms or more, "
                f"and is needed every {hop * FRAME_S * 1e3:.0f} ms"
            )
        return lost

    def keeps_up(self, hop: int) -> bool:
        """Return whether a plan takes at most half of its hop (median), and at most all of it (99th percentile).

        The rest of the time is needed to catch up with the sound that came while graphs were built.
        """
        return self.step_p50_s <= hop * FRAME_S / 2 and self.step_p99_s <= hop * FRAME_S


@dataclass(frozen=True)
class HopChoice:
    """A hop, its time budget, and a text about the parts that do not fit; None if all fit."""

    hop: int
    budget_ms: dict[str, float]
    given_up: str | None


def default_hop(horizon: int) -> int:
    """Return the largest hop with hop T + step + lead <= (H - 1) T, at least 1.

    Used in virtual time and in training, where nothing is measured.
    """
    return max(1, math.floor((horizon - 1) - (STEP_S + LEAD_S) / FRAME_S + _EPS_S))


def choose_hop(hops: Sequence[int], measured: Latencies) -> HopChoice:
    """Return the largest of `hops` (at least one) that fits, else the smallest with which the listener keeps up.

    Of the hops that do not fit, the smallest gives up least. If the listener keeps up with none, return the largest.
    """
    fitting = [hop for hop in hops if measured.fits(hop)]
    otherwise = min((hop for hop in hops if measured.keeps_up(hop)), default=max(hops))
    hop = max(fitting, default=otherwise)
    budget_s = {
        "horizon": measured.horizon * FRAME_S,
        "hop": hop * FRAME_S,
        "source": measured.source_s,
        "step": measured.step_p99_s,
        "lead": measured.lead_s,
        "lead_cut": min(max(measured.lead_s - measured.left_s(hop), 0.0), measured.lead_s),
        "tick": measured.tick_s,
        "sound_to_goal_p50": measured.p50_s(hop),
        "sound_to_goal_p95": measured.p95_s(hop),
    }
    budget_ms = {name: round(1e3 * value, 1) for name, value in budget_s.items()}
    return HopChoice(hop, budget_ms, "; ".join(measured.given_up(hop)) or None)


def _next_tick(time_s: float, tick_s: float) -> float:
    return math.ceil(time_s / tick_s - 1e-6) * tick_s
