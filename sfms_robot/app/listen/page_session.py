"""A page and the runs behind it: one run, or a series if visitors may choose listener, speaker and seed.

After a visitor's choice, the head comes to rest and the next run begins with that choice; the page stays. Commands go
through the limits of the head, as all motion does. A command that cannot be carried out raises a RobotError, which is
sent to its visitor.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from sfms_robot.app import session
from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.head.pose import expressions
from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.listen.page_observer import PageObserver, PageRecorder, page_facts, people_per_minute
from sfms_robot.app.listen.report import run_facts
from sfms_robot.app.options import FEEDS, RunOptions, words_of
from sfms_robot.config import load_head
from sfms_robot.data import Report, listener_names, speaker_names
from sfms_robot.errors import NOTE, InputError
from sfms_robot.frames import NEUTRAL
from sfms_robot.ports import Facts, Observer, PlanFeed, Tick
from sfms_robot.runtime.safety import Interrupt
from sfms_robot.sources.net_person import PageVisitor
from sfms_robot.sources.registry import BROWSER
from sfms_robot.viewer.page_process import PageProcess

AWAY_S: Final = 5.0  # time without visitors after which the page is given up
LEFT_S: Final = 30.0
PAUSE_S: Final = 3.0  # pause at rest before the next recorded person talks
BY_PAGE: Final = "page"  # a cause of a halt, and the door that clears it (`runtime.halt`)
_LOOK_S: Final = 0.5

logger = logging.getLogger(__name__)


class PageSession:
    """One page, from `page_session` on, and the runs behind it. Commands of visitors come in the page's thread.

    Args:
        options: options of the first run.
        choices: visitors may choose another listener, speaker and seed, and be the person themselves.

    Attributes:
        options: options of the present run, or of the last one.
        released: True if a visitor has switched torque off, which ended that run.
        reach: controls of the present run; None: there is none.
        recorder: recorder of that run.
    """

    def __init__(self, page: PageProcess, options: RunOptions, folder: Path, choices: bool) -> None:
        self.page, self.options, self.released = page, options, False
        self.reach: RunControls | None = None
        self.recorder: PageRecorder | None = None
        self._folder, self._choices = folder, choices
        self._listeners = {options.listener_name: options.listener, **{name: name for name in listener_names()}}
        self._visitor = PageVisitor()
        self._wanted: RunOptions | None = None
        self._further = False  # the present run is not the first
        self._set: Report = {}  # options as visitors left them in the last run
        self._chosen = threading.Event()
        page.answered_by(self)

    def run(
        self, panel: session.Panel | None = None, feed: PlanFeed | None = None, observers: Sequence[Observer] = ()
    ) -> Report:
        """Run once, with `options`. Blocks until it is over; returns its report. Raises as `session.run`.

        `feed`: a listener of these options that is already loading.
        """
        options, head = self.options, load_head(self.options.head, servos=False)
        joints, by_visitor = list(head.joints), options.visitor_feeds
        controls, watcher = RunControls(head, options), PageObserver(self.page, joints)
        self.released = False
        self._chosen.clear()
        watcher.document, controls.visitor = lambda: controls.document(), self._visitor
        with ExitStack() as stack:
            scene = scene_of(head, options.packages)  # a broken picture is reported before anything moves
            for line in scene.left_out:
                logger.warning("picture of the head: %s", line)
            facts = page_facts(
                head,
                options,
                controls.knobs,
                options.hears if options.hears in ("default", *speaker_names()) else None,
                feeds=FEEDS if self._choices else by_visitor,
                choices=self._choices,
            )
            facts["people_per_minute"] = people_per_minute(options.listener)
            self.page.say("begin", scene=str(options.head), packages=options.packages, **facts)
            self.recorder = PageRecorder(self.page, self._folder, joints, run_facts(head, options))
            stack.callback(self.recorder.close)
            self.reach = controls
            stack.callback(self._ended, controls)
            lonely = EndsAlone(page=self.page, interrupt=controls.interrupt, left_s=LEFT_S if by_visitor else AWAY_S)
            watchers = [watcher, self.recorder, *observers]
            if self._choices and (by_visitor or self._further):  # only visitors keep it running
                watchers.append(lonely)
            report = session.run(
                options, panel, feed=feed, observers=watchers, controls=controls,
                more=lambda: {"page": self.page.statistics()},
            )  # fmt: skip
        if report["exit"] == "interrupted" and lonely.ended:  # the regular end of such a run
            report |= {"exit": "done", "exit_code": 0}
        if self._wanted is None:
            self.page.say("end", report=report)
        return report

    def next(self, stay: bool, speaker: str | None = None) -> bool:
        """Return whether another run is to begin, and set `options` for it; settings of visitors are kept.

        `stay`: wait for a choice while there are visitors. Blocks until then, or until there are none for `AWAY_S`;
        with a `speaker`, which is used if no visitor has chosen, for `PAUSE_S`.
        """
        if stay and self.page.visited.is_set():
            stay_for_visitors(self.page, self._chosen, math.inf if speaker is None else PAUSE_S)
            if speaker is not None and self._wanted is None and self.page.visitors:
                self._wanted = replace(self.options, record=None, audio=speaker, face="auto")
        if self._wanted is None:
            return False
        self.options, self._wanted, self._further = replace(self._wanted, **self._set), None, True
        return True

    def _ended(self, controls: RunControls) -> None:
        """Forget the controls of the run, and keep the settings that visitors changed in it."""
        self.reach = None
        self._set = {kind: words_of(values) for kind, values in controls.knobs.values.items()}
        self._set["calmness"] = controls.calmness

    # --- from visitors; in the page's thread ---

    def command(self, visitor: int, name: str, values: Facts) -> None:
        """Carry out a command of a visitor. Raises RobotError."""
        if name in ("listener", "speaker", "seed"):
            self._choose(name, values["seed" if name == "seed" else "name"])
            return
        if name == "source":
            self._feeds(visitor, values["feeds"])
            return
        if (run := self.reach) is None:
            raise InputError(f"{name}: no run is on")
        match name:
            case "halt":
                run.halt.close(BY_PAGE, BY_PAGE)
            case "resume":
                run.halt.resume(BY_PAGE)
            case "release":
                self.released = True
                run.release()
            case "neutral":
                run.puppet.show(NEUTRAL, values["seconds"])
            case "show":
                run.puppet.show(values["channels"], values["seconds"])
            case "expression":
                if values["name"] not in expressions():
                    raise InputError(f"expression {values['name']!r} is not there ({', '.join(expressions())})")
                run.puppet.show(expressions()[values["name"]], values["seconds"])
            case "look_at":
                run.puppet.look_at(**values)
            case "knobs":
                run.knobs.turn(values["intensity"], values["style"])
            case "calm":
                run.calm(values["rates"])
            case "record" if self.recorder is not None:
                self.recorder.record(values["on"])

    def person(self, visitor: int, message: bytes) -> None:
        """Receive a piece of the voice, or a face, of the visitor that is the person. Raises PacketError."""
        self._visitor.received(visitor, message)

    def left(self, visitor: int) -> None:
        """Note that a visitor has lost the controls."""
        self._visitor.gone(visitor)

    def _choose(self, what: str, value: Any) -> None:
        if not self._choices:
            raise InputError(f"{what}: this run keeps what it was started with (`sfms-robot demo` lets you choose)")
        # Only names are accepted, so a visitor cannot reach a folder of this machine or the address of another.
        offered = {"listener": list(self._listeners), "speaker": speaker_names()}.get(what)
        if offered is not None and value not in offered:
            raise InputError(f"{what} {value!r} is not there ({', '.join(offered)})")
        changes: dict[str, Report] = {
            "listener": {"listener": self._listeners.get(value)},
            "speaker": {"audio": value, "face": "auto", "duration_s": None},
            "seed": {"seed": value},
        }
        self._want(changes[what])

    def _feeds(self, visitor: int, feeds: Sequence[str]) -> None:
        taken = (self._wanted or self.options).visitor_feeds
        if feeds and self._choices and len(taken) < len(FEEDS):
            self._want({"audio": BROWSER, "face": BROWSER, "duration_s": None})
        elif missing := [feed for feed in feeds if feed not in taken]:
            flags = {"voice": "--audio", "face": "--face"}
            raise InputError(f"source: this run accepts no {missing[0]} from a visitor ({flags[missing[0]]} {BROWSER})")
        self._visitor.came(visitor, feeds)

    def _want(self, changes: Facts) -> None:
        """Request another run with these options; the present run comes to rest."""
        self._wanted = replace(self._wanted or self.options, record=None, **changes)
        self._chosen.set()
        if self.reach is not None and not self.reach.interrupt():
            self.reach.interrupt.ask()


@dataclass(kw_only=True, eq=False)
class EndsAlone(Observer):
    """An observer that ends a run which has had no visitors for `left_s`.

    Attributes:
        ended: True if it has ended the run.
        seen_s: time of the last visitor.
    """

    page: PageProcess
    interrupt: Interrupt
    left_s: float
    ended: bool = False
    seen_s: float = 0.0

    def tick(self, seen: Tick) -> None:
        """Count the time without visitors."""
        if self.page.visitors or self.interrupt():
            self.seen_s = seen.time_s
        elif seen.time_s - self.seen_s > self.left_s:
            self.ended = True
            self.interrupt.ask()


def stay_for_visitors(page: PageProcess, over: threading.Event, longest_s: float = math.inf) -> None:
    """Block until `over` is set, there are visitors after `longest_s`, or there have been none for `AWAY_S`."""
    alone_s = stayed_s = 0.0
    while alone_s < AWAY_S and not (page.visitors and stayed_s >= longest_s) and not over.wait(_LOOK_S):
        alone_s, stayed_s = 0.0 if page.visitors else alone_s + _LOOK_S, stayed_s + _LOOK_S


@contextmanager
def page_session(page: PageProcess, options: RunOptions, choices: bool = False) -> Iterator[PageSession]:
    """Yield the session of a page whose process has begun. Blocks until the page can be opened.

    Raises PortError, ConfigError if it cannot be opened.
    """
    page.wait()
    logger.log(NOTE, "page: %s", page)
    with TemporaryDirectory(prefix="sfms-robot-", ignore_cleanup_errors=True) as folder:
        yield PageSession(page, options, Path(folder), choices)
