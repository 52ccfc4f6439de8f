"""The app: receive the robot's microphone, send motion through the daemon that started it."""

import threading

from reachy_mini import ReachyMini, ReachyMiniApp

import sfms_robot as sr

PIECE_S = 0.02


class SfmsListener(ReachyMiniApp):
    """Reachy Mini that nods while a person talks."""

    custom_app_url = None

    def run(self, reachy_mini: ReachyMini, stop_event: threading.Event) -> None:
        """Listen until the daemon stops the app; the robot then eases to neutral."""
        media = reachy_mini.media
        if media.audio is None:
            raise RuntimeError("the daemon gives no sound: start it with its media")
        media.start_recording()
        with sr.Robot("none", listener="sfms-small", outputs=["reachy-mini"]) as robot:
            robot.on("nod", lambda nod: self.logger.info("nod of %.0f ms", 1e3 * nod.duration_s))
            while not stop_event.wait(PIECE_S):
                while (sound := media.get_audio_sample()) is not None:
                    robot.hear(sound, rate_hz=media.get_input_audio_samplerate())
        media.stop_recording()


if __name__ == "__main__":
    app = SfmsListener()
    try:
        app.wrapped_run()
    except KeyboardInterrupt:
        app.stop()
