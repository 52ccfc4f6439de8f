"""A head that listens, as an object: its loop has its own thread, and any thread may use the object.

person  ->  hear, see, say      sound and faces from a program; or a source of `run`
face    ->  show, look_at       replaces the plan of the listener for a while, under the same limits
plans   ->  on                  nods, smiles, "mm-hm" and so on before the servos do them
rates   ->  calm                how often it does them
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final, Self

from sfms_robot.app.api.servos import Background, Driven, head_name
from sfms_robot.app.listen.knobs import LiveKnobs, RunControls
from sfms_robot.app.open_head import prepare_head
from sfms_robot.app.options import SIM, RunOptions, record_format_named, words_of
from sfms_robot.app.session import run
from sfms_robot.config import Calmness, Head, parse
from sfms_robot.data import Report
from sfms_robot.errors import ConfigError, InputError
from sfms_robot.frames import FaceFrame, Floats, ListenerEvent
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.thread import ListenerThread
from sfms_robot.outputs.registry import check_outputs
from sfms_robot.ports import Listener, Source
from sfms_robot.runtime.planned_events import EventWatch
from sfms_robot.sources.paired import JudgedSource, PairedSource
from sfms_robot.sources.playback import open_playback
from sfms_robot.sources.push import Pcm, PushedSight, PushedSpeech, PushedVoice
from sfms_robot.sources.registry import split_kind

PUSH: Final = "push"
EVENTS_LIMIT_S: Final = 1.0  # longest wait of `stop` for callbacks


class Robot(Driven):
    """A run of `sfms-robot run`, with its options by name, in its own thread.

    Use `with Robot(...) as robot:`, or `Robot(...).start()` and `stop()`: the head moves from `start` to `stop`. It
    works in a script, a notebook or any thread, and changes no signal handler. Methods may be called from any thread;
    only `start`, `wait` and `stop` wait for the loop.

    Args:
        head: shipped name, folder, or the result of `load_head`; "none": no servos, only `outputs` show the face.
        port: "sim" for emulated servos, "auto", a device, or NAME=DEVICE[,NAME=DEVICE].
        listener: shipped name, folder, zenoh/NAME, a name that another package registers; or an object that implements
            `Listener`, which is then stepped in a thread of this process.
        audio: "push" for the data passed to `hear`, `see` and `say`; else a source of `run --audio`.
        face, agent_audio: as `run --face`, `--agent-audio`, only with a source other than "push".
        play: the device that plays the robot's speech, by number, name or part of a name, or "default"; None: the
            caller of `say` plays it.
        source: an object of a class derived from `Source`, instead of `audio`, `face` and `agent_audio`. Its `read` is
            called in the loop: it must not block.
        duration_s: seconds after which it ends; None for that of the source.
        fast: virtual time on emulated servos, as fast as they compute; not with "push".
        seed: seed of everything that is drawn at random.
        record: folder for the recording; `overwrite` if the folder may have a recording already.
        record_format: "json", or "ros2" for tools of ROS.
        yes: hobby servos may jump when they come on.
        without: joints that are left alone.
        intensity, style: values by region, as in `knobs`.
        calmness, addressed: as in `calm`.
        outputs: KIND or KIND:ADDRESS each, as `run --output`: "vmc:127.0.0.1:39539".

    Raises ConfigError, PortError, InputError for invalid arguments, before anything is opened.
    """

    def __init__(
        self,
        head: Head | str = "face28",
        *,
        port: str = SIM,
        listener: Listener | str | Path = "sfms-small",
        audio: str = PUSH,
        face: str = "auto",
        agent_audio: str = "none",
        play: str | None = None,
        source: Source | None = None,
        duration_s: float | None = None,
        fast: bool = False,
        seed: int = 0,
        record: Path | str | None = None,
        record_format: str = "json",
        overwrite: bool = False,
        yes: bool = False,
        without: Sequence[str] = (),
        intensity: Mapping[str, float] | None = None,
        style: Mapping[str, float] | None = None,
        calmness: Mapping[str, float] | None = None,
        addressed: str = "sense",
        engine: EngineName = "auto",
        outputs: Sequence[str] = (),
    ) -> None:
        pushed = source is None and audio == PUSH
        if pushed and (face, agent_audio) != ("auto", "none"):
            raise InputError('with audio="push" the face comes by see() and the robot\'s own voice by say()')
        if pushed and fast:
            raise InputError('fast=True needs another source than audio="push": what a program hears takes real time')
        if play is not None and source is not None:
            raise InputError(f"play={play!r}: what a source of your own says is not played; leave it out")
        own = listener if not isinstance(listener, (str, Path)) else None
        self._options = RunOptions(
            head=head_name(head),
            port=port,
            fast=fast,
            yes=yes,
            without=tuple(without),
            listener=type(own).__name__ if own is not None else str(listener),
            audio="none" if pushed else audio,
            face=face,
            agent_audio=agent_audio,
            play=play,
            duration_s=duration_s,
            seed=seed,
            engine=engine,
            intensity=words_of(intensity or {}),
            style=words_of(style or {}),
            calmness=parse(Calmness, {**(calmness or {}), "addressed": addressed}, "calmness"),
            record=None if record is None else Path(record),
            record_format=record_format_named(record_format),
            overwrite=overwrite,
            outputs=tuple(outputs),
        )
        prepared = prepare_head(self._options)
        check_outputs(self._options.outputs)
        self._listener = own
        self._person = (PushedVoice(), PushedSight()) if pushed else None
        hears = source is None and split_kind(self._options.hears)[0] == "mic" and agent_audio == "none"
        self._speech = PushedSpeech() if pushed or hears else None
        self._source: Source | None = None if source is None else JudgedSource(source)
        self._hears = audio if source is None else type(source).__name__
        self._events = EventWatch()
        self._controls = RunControls(prepared, self._options)
        self._controls.speech = self._speech

    def __enter__(self) -> Self:
        return self.start()

    def start(self) -> Self:
        """Open the head, switch torque on, listen. Blocks until the first tick, one to three seconds.

        Raises RobotError.
        """
        if self._run is not None:
            raise ConfigError("this robot was started before: make another Robot")
        self._run = Background(self._drive, self._controls.interrupt, self._controls.halt)
        self._run.start()
        return self

    def wait(self, limit_s: float | None = None) -> bool:
        """Block until the run has ended, or for `limit_s`; return whether it has ended."""
        return self._run is None or self._run.wait(limit_s)

    def stop(self) -> None:
        """Come to rest, switch torque off. Blocks until then, 4 s at most once it has started. Idempotent.

        A joint that was found far outside its range takes as long as its limits require, up to a minute. Raises once,
        as RobotError, the error that ended the run before.
        """
        if self._run is not None:
            try:
                super().stop()
            finally:
                self._events.close()
                self._events.join(EVENTS_LIMIT_S)

    def halt(self) -> None:
        """Stop in an emergency: from the next tick on every joint brakes as fast as its limits allow.

        Joints that bear weight then hold, the others are released. Latched until `resume`. Does not wait,
        raises nothing.
        """
        if self._run is not None:
            self._run.halt.close("Robot.halt()")

    def resume(self) -> None:
        """End a halt, whatever caused it: torque comes on again, joints ease in from where they stand.

        Does not wait. Raises HaltedError while a switch is still on.
        """
        if self._run is not None:
            self._run.halt.resume("device")

    # --- sound and sight of the robot ---

    def hear(self, pcm: Pcm, rate_hz: float) -> None:
        """Pass the person's voice: the next piece of sound, of any length. Never blocks.

        (n,), (n, channels) or (channels, n), float of full scale 1 or int16; or bytes of 16-bit little-endian mono. The
        piece begins at the time of the call, so pass pieces as they come, 10 to 100 ms each. Of a piece longer than a
        second the newest second is kept. Raises ConfigError for another type, shape, scale or rate.
        """
        self._pushed("hear")[0].hear(pcm, rate_hz)

    def see(self, face: FaceFrame | Floats | Mapping[str, float] | None) -> None:
        """Pass the person's face now: a FaceFrame, motion (58,) or channels by name; None when it is lost.

        It holds for 250 ms. Never blocks. Raises ConfigError for another shape, an unknown channel, and values that are
        not radians or 0 to 1.
        """
        self._pushed("see")[1].see(face)

    def say(self, pcm: Pcm, rate_hz: float, at_s: float | None = None) -> None:
        """Pass the robot's own speech, as in `hear`: the lips follow it, and it does not count as the person's.

        With `play=` it is played here, as soon as possible. Else play it yourself, one frame (40 ms) after this call,
        after the speech that still waits. Instead, `at_s` (`time.monotonic`) sets the time at which its first sample is
        played: that replaces the speech from then on. Up to two minutes may wait. Never blocks. With a microphone
        (`audio="mic"`) it is removed from the sound. Raises InputError with another source.
        """
        self._spoken("say").say(pcm, rate_hz, at_s)

    def hush(self) -> None:
        """Drop the speech that still waits, after an interruption. Never blocks.

        With `play=` the buffer of the device is still played.
        """
        self._spoken("hush").hush()

    def _spoken(self, what: str) -> PushedSpeech:
        if self._speech is None:
            raise InputError(f'{what}() needs audio="push" or "mic"; this robot listens to {self._hears!r}')
        return self._speech

    def _pushed(self, what: str) -> tuple[PushedVoice, PushedSight]:
        if self._person is None:
            raise InputError(f'{what}() needs audio="push"; this robot listens to {self._hears!r}')
        return self._person

    # --- the face ---

    def show(self, face58: Floats | Mapping[str, float], seconds: float = 0.5) -> None:
        """Show a face (58,), or some channels by name, over the plan of the listener, for `seconds`.

        Rises in 0.25 s, falls in 0.35 s, under the same limits as all motion; a newer face starts from the present one.
        Never blocks. Raises InputError for another shape, an unknown channel, or a value that is not finite.
        """
        self._controls.puppet.show(face58, seconds)

    def look_at(self, x_m: float, y_m: float, z_m: float, seconds: float = 2.0) -> None:
        """Look at a point for `seconds`, in metres from the middle of the head: x forward, y to its left, z up.

        Eyes first, then the head with its share. Never blocks. Raises InputError for a point that is not finite.
        """
        self._controls.puppet.look_at(x_m, y_m, z_m, seconds)

    @property
    def knobs(self) -> LiveKnobs:
        """Regions of the head: `robot.knobs["neck"].intensity = 0.5`, `.style`, 0..2."""
        return self._controls.knobs

    def calm(self, addressed: str | None = None, **per_minute: float | None) -> None:
        """Set the rate of events per minute: `robot.calm(nod=2.2, addressed="assume")`; None: the rate of people.

        Kinds that are not named keep their rate. It has no effect on a listener that decides no events, nor in virtual
        time once it runs. Raises ConfigError for an unknown kind and an invalid rate.
        """
        self._controls.calm(per_minute if addressed is None else {**per_minute, "addressed": addressed})

    # --- events, state, report ---

    def on(self, kind: str, callback: Callable[[ListenerEvent], object]) -> None:
        """Call `callback` with a `ListenerEvent` before the servos execute it.

        `kind` is one of `frames.EVENT_KINDS`: "nod", "mm_hm", "smile" and so on. A listener that decides events reports
        all of them; for other listeners, nods, blinks and smiles are found in the plans. The callback runs in a
        separate thread, one event after the other; a callback that raises is detached and named in the log. Raises
        InputError for another kind.
        """
        self._events.on(kind, callback)

    @property
    def state(self) -> str:
        """ "starting", "idle", "listening", "speaking", "degraded", "halted", "stopping", "stopped" or "fault" (ended
        by an error, which `stop` raises): see docs/safety.md."""
        return "stopped" if self._run is None else self._run.state

    def report(self) -> Report:
        """Return the report of `run --json`; during the run only the keys known so far, with "exit": "running"."""
        report = self._run.report if self._run is not None else None
        if report is None:
            options, now = self._options, self._controls.document()
            report = {
                "version": 1,
                "head": Path(options.head).name,
                "listener": options.listener_name,
                "port": options.port,
                "seed": options.seed,
                "exit": "running",
                "torque_unconfirmed": [],
                "duration_s": now.get("time_s", 0.0),
                "frames": now.get("frames", 0),
                "ticks": now.get("ticks", 0),
            }
        return {**report, "callbacks_detached": dict(self._events.detached)}

    def _drive(self, now: Background) -> Report:
        options, source = self._options, self._source
        feed = None
        with ExitStack() as stack:
            if self._listener is not None:
                feed = ListenerThread(self._listener, options.seed)
                stack.callback(feed.close)
            if self._person is not None and self._speech is not None:
                own = self._speech if options.play is None else open_playback(options.play, self._speech)
                source = PairedSource(*self._person, own)
                stack.callback(source.close)
            return run(
                options, source=source, feed=feed, observers=[now, self._events], controls=self._controls, signals=False
            )
