"""What a head does of itself: where it keeps its eyes, whom it looks at, and the small motion that was left out."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sfms_robot.config.base import Model, NonNegative, Positive

Share = Annotated[float, Field(ge=0, le=1)]


class Gaze(Model):
    """Eyes that hold and jump.

    Attributes:
        neck_gain: share of the head's yaw and pitch that the eyes turn against (vestibulo-ocular).
        dead_zone_deg: gaze is held until its target is this far away.
        recentre_deg: how far the eyes may be turned from their target by compensating, then they jump back.
        settle_ms: the target has to be away for this long before the eyes follow.
        pause_ms: shortest hold between two jumps.
        full_yaw_deg, full_pitch_deg: the eye's angle for a channel of 1.
    """

    neck_gain: Share = 1.0
    dead_zone_deg: Positive = 1.5
    recentre_deg: Positive = 12.0
    settle_ms: NonNegative = 40.0
    pause_ms: NonNegative = 120.0
    full_yaw_deg: Positive = 30.0
    full_pitch_deg: Positive = 20.0


class Idle(Model):
    """Small motion where the listener gives none. 0 leaves a kind out.

    Attributes:
        blinks_per_minute: wanted in all, those of the listener counted.
        head_deg: half the swing of yaw; pitch and roll swing less.
        glance_deg: how far the eyes wander, for a head that is given no gaze.
        still_deg_s: a head or eyes slower than this are not being moved by the listener.
        fade_s: how long the listener has to be still before idle motion is back in full.
    """

    blinks_per_minute: Annotated[float, Field(ge=0, le=60)] = 14.0
    head_deg: Annotated[float, Field(ge=0, le=10)] = 1.2
    glance_deg: Annotated[float, Field(ge=0, le=15)] = 3.0
    still_deg_s: Positive = 3.0
    fade_s: Positive = 3.0


class Person(Model):
    """Looking at whom the head listens to, and away as people do.

    Attributes:
        head_share: of the direction to a person, what the neck turns; the eyes keep the rest. A head that is given no
            gaze turns its neck all the way.
        look_away: how often the head looks away, people being 1; 0 is never.
    """

    head_share: Share = 0.6
    look_away: Annotated[float, Field(ge=0, le=2)] = 1.0


class Life(Model):
    """All are optional; a section that is left out does nothing."""

    gaze: Gaze | None = None
    idle: Idle | None = None
    person: Person | None = None
