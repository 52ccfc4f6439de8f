"""A page, and the runs behind it: one, or one after the other where visitors may choose listener, speaker and seed.

A visitor's choice brings the head to rest, and the next run begins with it; the page stays.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from sfms_robot.app import session
from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.app.listen.knobs import KNOB_KINDS, LiveKnobs, turned
from sfms_robot.app.listen.page_commands import PageCommands, Reach
from sfms_robot.app.listen.page_facts import page_facts, people_per_minute
from sfms_robot.app.listen.page_observer import PageObserver
from sfms_robot.app.listen.report import run_facts
from sfms_robot.app.options import RunOptions
from sfms_robot.config import Calmness, load_head
from sfms_robot.data import listener_names, speaker_names
from sfms_robot.errors import InputError
from sfms_robot.frames import Plan, SpeakerFrame
from sfms_robot.listeners.remote import NamedFeed, open_feed
from sfms_robot.ports import Observer, Tick
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.retarget.puppet import Puppet
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.recorder import RUN_FILE, Recorder
from sfms_robot.runtime.safety import Interrupt
from sfms_robot.sources.browser import Visitor
from sfms_robot.sources.registry import BROWSER, open_source, split_kind
from sfms_robot.sources.speakers import DEFAULT_SPEAKER
from sfms_robot.viewer.page_process import PageProcess

AWAY_S: Final = 5.0  # nobody has looked for so long: a page that is loaded anew is back sooner
LEFT_S: Final = 30.0
_LOOK_S: Final = 0.5
MAX_SEED: Final = 2**32 - 1

logger = logging.getLogger(__name__)
LONGEST_S: Final = 300.0  # of one recording; what comes after it is left out


class PageSession:
    """One page, from `open_page` on, and what runs behind it.

    Args:
        options: of the first run.
        choices: visitors may choose another listener, speaker and seed, and be the person themselves.

    Attributes:
        options: of the run that goes on, or went on last.
        released: a visitor has ended that run.
    """

    def __init__(self, page: PageProcess, options: RunOptions, folder: Path, choices: bool) -> None:
        self.page, self.options, self.released = page, options, False
        self._folder, self._choices = folder, choices
        self._listeners = {Path(options.listener).name: options.listener, **{name: name for name in listener_names()}}
        self._person = Visitor()
        self._interrupt: Interrupt | None = None
        self._wanted: RunOptions | None = None
        self._set: dict[str, Any] = {}  # options that visitors turned in the run that went on last
        self._chosen = threading.Event()
        self._commands = PageCommands(self._choose, self._feeds, self._person)
        page.answered_by(self._commands)

    def run(
        self,
        panel: session.Panel | None = None,
        feed: NamedFeed | None = None,
        observers: Sequence[Observer] = (),
    ) -> dict[str, Any]:
        """Once, with `options`. Blocks until it is over; returns its report. Raises as `session.run`.

        `feed`: a listener of these options that loads already; None: it is started here, and ended.
        """
        options = self.options
        head = load_head(options.head)
        knobs = turned(head, options.intensity, options.style)
        calmness = options.calmness or Calmness()
        watcher = PageObserver(self.page, list(head.joints))
        self._interrupt = interrupt = Interrupt()
        self._chosen.clear()
        self.released = False
        with ExitStack() as stack:
            if feed is None:
                listened = options.listener, options.seed, options.calmness, options.router, options.engine
                feed = stack.enter_context(closing(open_feed(*listened)))
            halt, puppet = HaltLatch(), Puppet(head.life.gaze, frozenset(HeadRetargeter(head).blind_channels))
            scene = scene_of(head, options.packages)  # a picture that is broken is said before anything moves
            for line in scene.left_out if scene else ():
                logger.warning("%s; the page leaves it out", line)
            self.page.say(
                "begin", scene=str(options.head), packages=options.packages, **self._facts(head, knobs, calmness)
            )
            recorder = PageRecorder(self.page, self._folder, list(head.joints), run_facts(head, options))
            lonely = self._lonely(interrupt)
            stack.callback(recorder.close)
            self._commands.reach = Reach(halt, puppet, knobs, calmness, feed.calm, recorder.record, self._release)
            stack.callback(self._ended, knobs)
            report = session.run(
                options, _told_to(watcher, panel), source=self._source(stack), feed=feed,
                observers=[watcher, recorder, *lonely, *observers], knobs=knobs,
                overlay=puppet.overlay, interrupt=interrupt, halt=halt,
                more=lambda: {"page": self.page.statistics()},
            )  # fmt: skip
        if report["exit"] == "interrupted" and any(each.ended for each in lonely):  # its proper end
            report |= {"exit": "done", "exit_code": 0}
        if self._wanted is None:
            self.page.say("end", report=report)
        return report

    def next(self, stay: bool) -> bool:
        """Whether a visitor has chosen another run, which `options` now name; what visitors turned stays turned.

        `stay`: while somebody looks that is waited for. Blocks until then, or until all have gone for `AWAY_S`.
        """
        alone_s = 0.0
        while self._wanted is None and stay and self.page.visited.is_set() and alone_s < AWAY_S:
            self._chosen.wait(_LOOK_S)
            alone_s = 0.0 if self.page.visitors else alone_s + _LOOK_S
        if self._wanted is None:
            return False
        self.options, self._wanted = replace(self._wanted, **self._set), None
        return True

    def _lonely(self, interrupt: Interrupt) -> list[EndsAlone]:
        """A demo of which a visitor is the person ends when nobody looks any more: nothing else would end it."""
        endless = self._choices and any(_taken_of_visitors(self.options).values())
        return [EndsAlone(self.page, interrupt)] if endless else []

    def _ended(self, knobs: LiveKnobs) -> None:
        """Take the run out of reach, and keep what visitors turned in it."""
        reach, self._commands.reach = self._commands.reach, None
        assert reach is not None
        turned_to = {
            kind: tuple(f"{name}={value}" for name, value in knobs.values[kind].items()) for kind in KNOB_KINDS
        }
        self._set = {**turned_to, "calmness": reach.calmness}

    def _source(self, stack: ExitStack) -> Any:
        """Where a visitor is the person; None: the run opens what its options name."""
        options = self.options
        if not any(_taken_of_visitors(options).values()):
            return None
        source = open_source(
            options.hears, options.face, options.duration_s, agent_audio=options.agent_audio, play=options.play,
            visitor=self._person,
        )  # fmt: skip
        return stack.enter_context(closing(source))

    def _facts(self, head: Any, knobs: Any, calmness: Calmness) -> dict[str, Any]:
        options = self.options
        by_visitor = _taken_of_visitors(options)
        speaker = DEFAULT_SPEAKER if options.hears == "default" else options.hears
        return page_facts(
            head, port=options.port, listener=options.listener, seed=options.seed, calmness=calmness,
            speaker=speaker if speaker in speaker_names() else None, people=people_per_minute(options.listener),
            knobs=knobs, source={feed: self._choices or by for feed, by in by_visitor.items()}, choices=self._choices,
        )  # fmt: skip

    # --- what visitors choose; in the page's thread ---

    def _choose(self, what: str, value: Any) -> None:
        if not self._choices:
            raise InputError(f"{what}: this run keeps what it was started with (`sfms-robot demo` lets you choose)")
        # By name alone: a visitor reaches no folder of this machine, and no address of another.
        offered = {"listener": list(self._listeners), "speaker": speaker_names()}.get(what)
        if offered is not None and value not in offered:
            raise InputError(f"{what} {value!r} is not there ({', '.join(offered)})")
        changes: dict[str, dict[str, Any]] = {
            "listener": {"listener": self._listeners.get(value)},
            "speaker": {"audio": value, "face": "auto", "duration_s": None},
            "seed": {"seed": value},
        }
        self._want(changes[what])

    def _feeds(self, visitor: int, feeds: list[str]) -> None:
        options = self._wanted or self.options
        takes = _taken_of_visitors(options)
        if feeds and self._choices and not all(takes.values()):
            self._want({"audio": BROWSER, "face": BROWSER, "duration_s": None})
        elif missing := [feed for feed in feeds if not takes[feed]]:
            flag = "--audio" if missing[0] == "voice" else "--face"
            raise InputError(f"source: this run takes no {missing[0]} from a visitor ({flag} {BROWSER})")
        self._person.came(visitor, feeds)

    def _release(self) -> None:
        self.released = True
        if self._interrupt is not None:
            self._interrupt.ask()
            self._interrupt.ask()

    def _want(self, changes: Mapping[str, Any]) -> None:
        """Another run, with these options; the one that goes on comes to rest."""
        self._wanted = replace(self._wanted or self.options, record=None, **changes)
        self._chosen.set()
        interrupt = self._interrupt
        if interrupt is not None and not interrupt():
            interrupt.ask()


class EndsAlone(Observer):
    """Ends a run at which nobody has looked for `LEFT_S`.

    Attributes:
        ended: it has done so.
    """

    def __init__(self, page: PageProcess, interrupt: Interrupt) -> None:
        self._page, self._interrupt = page, interrupt
        self.ended = False
        self._seen_s = 0.0

    def tick(self, seen: Tick) -> None:
        if self._page.visitors or self._interrupt():
            self._seen_s = seen.time_s
        elif seen.time_s - self._seen_s > LEFT_S:
            self.ended = True
            self._interrupt.ask()


@contextmanager
def page_session(page: PageProcess, options: RunOptions, choices: bool = False) -> Iterator[PageSession]:
    """What runs behind a page whose process has begun, while inside. Blocks until the page can be opened.

    Raises PortError, ConfigError where it cannot.
    """
    page.wait()
    logger.warning("page: %s", page)
    with TemporaryDirectory(prefix="sfms-robot-", ignore_cleanup_errors=True) as folder:
        yield PageSession(page, options, Path(folder), choices)


def _taken_of_visitors(options: RunOptions) -> dict[str, bool]:
    """Which of voice and face a visitor brings."""
    return {"voice": split_kind(options.hears)[0] == BROWSER, "face": split_kind(options.face)[0] == BROWSER}


def _told_to(watcher: PageObserver, panel: session.Panel | None) -> session.Panel:
    """A panel that is shown as well, and before that the page is told where the status is."""

    def shown(document: session.Document, interrupt: Interrupt, halt: HaltLatch, turn: Callable[[float], None]) -> Any:
        watcher.document = document
        return nullcontext() if panel is None else panel(document, interrupt, halt, turn)

    return shown


class PageRecorder:
    """`ports.Observer`: hands what happens to a `Recorder` while there is one. `record` is called in the page's thread.

    Args:
        folder: where recordings go, each into one of its own. about: see `Recorder`.
    """

    def __init__(self, page: PageProcess, folder: Path, joints: Sequence[str], about: Mapping[str, str]) -> None:
        self._page, self._folder, self._joints, self._about = page, folder, tuple(joints), dict(about)
        self._recorder: Recorder | None = None
        self._into: Path | None = None
        self._began_s = self._now_s = 0.0
        self._tell(False, None)

    def record(self, on: bool) -> None:
        """Begin one, or end it and let it be downloaded; blocks until it is written. Raises ConfigError."""
        if on and self._recorder is None:
            into = self._folder / f"recording-{len(list(self._folder.iterdir())) + 1}"
            recorder = Recorder(into, self._joints, about=self._about)
            self._into, self._began_s, self._recorder = into, self._now_s, recorder
            self._tell(True, 0.0)
        elif not on:
            self.close()

    def tick(self, seen: Tick) -> None:
        self._now_s = seen.time_s
        recorder = self._recorder
        if recorder is not None and seen.time_s - self._began_s <= LONGEST_S:
            recorder.tick(seen)

    def heard(self, frame: SpeakerFrame) -> None:
        recorder = self._recorder
        if recorder is not None and frame.time_s - self._began_s <= LONGEST_S:
            recorder.heard(frame)

    def planned(self, plan: Plan) -> None:
        recorder = self._recorder
        if recorder is not None and plan.made_at_s - self._began_s <= LONGEST_S:
            recorder.planned(plan)

    def close(self) -> None:
        """End the one that goes on."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close()
            self._tell(False, min(LONGEST_S, math.ceil(self._now_s - self._began_s)))

    def _tell(self, on: bool, seconds: float | None) -> None:
        file = None if on or self._into is None else str(self._into / RUN_FILE)
        self._page.say("recorded", file=file, record={"on": on, "seconds": seconds})
