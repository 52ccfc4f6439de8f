"""A real Chromium without a window, and a run whose page it looks at. What is asked for is waited for, no time is."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue

import numpy as np

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip
LIMIT_S = 180.0  # for anything to come to pass: pictures are drawn without a graphics card
_NAMED = re.compile(r"https?://[^ \s]+")
_NO_WEBGL = """
const context = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return /webgl/.test(kind) ? null : context.call(this, kind, ...more);
};
"""


class Page:
    """A browser's window on one page. Blocks until what is asked for is there, `LIMIT_S` at most.

    It finds no machine but this one: a page that asks another is told on the console that there is none.

    flags: more of Chromium's, such as fake devices. size: of the window's inside, pixels.
    """

    def __init__(self, folder: Path, *flags: str, size: tuple[int, int] = (1000, 700), dark: bool = False) -> None:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = str(BROWSER)
        for flag in (*FLAGS, *flags, f"--user-data-dir={folder}", f"--window-size={size[0]},{size[1]}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Service(DRIVER))
        self.size = size
        self.look(size, dark)

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.quit()

    def look(self, size: tuple[int, int], dark: bool = False) -> None:
        """From now on with a window of this size; a narrow one is a phone's."""
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 500},
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})

    @contextmanager
    def without_webgl(self) -> Iterator[None]:
        """Pages that are loaded meanwhile find no WebGL."""
        script = self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _NO_WEBGL})
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)

    def leave(self) -> None:
        """Have no page open."""
        self.driver.get("about:blank")
        self.complaints()

    def open(self, url: str) -> Page:
        """And wait for the first picture of the face, and the first frame of the run, or a recording of it."""
        self.driver.get(url)
        self.until("performance.getEntriesByName('first picture').length && (page.newest || page.replay)")
        return self

    def ask(self, expression: str, *values: object):
        """The value of a JavaScript expression; `arguments[0]` is the first of `values`."""
        return self.driver.execute_script(f"return ({expression})", *values)

    def until(self, expression: str, *values: object) -> None:
        """Block until `expression` is true."""
        from selenium.common.exceptions import TimeoutException
        from selenium.webdriver.support.ui import WebDriverWait

        try:
            WebDriverWait(self.driver, LIMIT_S).until(lambda _: self.ask(f"!!({expression})", *values))
        except TimeoutException:
            notice = self.ask("document.getElementById('notice')?.textContent")
            raise AssertionError(f"never came: {expression} (notice {notice!r}; {self.complaints()})") from None

    def drawn(self) -> None:
        """Block until what has come by now is in the picture."""
        pictures = self.ask("page.stage.pictures")
        self.until(f"page.stage.pictures > {pictures + 1}")

    def picture(self, element: str) -> np.ndarray:
        """(H, W, 3) 0..255 of the element with this id, as the screen shows it."""
        from PIL import Image

        x, y, width, height = self.ask(
            "(({x, y, width, height}) => [x, y, width, height])"
            "(document.getElementById(arguments[0]).getBoundingClientRect())",
            element,
        )
        shot = Image.open(io.BytesIO(self.screen())).convert("RGB")
        return np.asarray(shot.crop((int(x), int(y), int(x + width), int(y + height)))).astype(float)

    def press(self, words: str) -> None:
        """Press the button among the controls that begins with these words, once it is there."""
        buttons = "[...document.querySelectorAll('#controls button')]"
        button = f"{buttons}.find((each) => each.textContent.startsWith(arguments[0]))"
        self.until(button, words)
        self.driver.execute_script(f"{button}.click()", words)

    def screen(self) -> bytes:
        """PNG of the window, while the page stands still."""
        self.ask("globalThis.page && (page.still = true)")
        try:
            return self.driver.get_screenshot_as_png()
        finally:
            self.ask("globalThis.page && (page.still = false, 1)")

    def complaints(self) -> list[str]:
        """What the browser's console has to say that is a warning or worse."""
        return [line["message"] for line in self.driver.get_log("browser") if line["level"] in ("SEVERE", "WARNING")]

    def addresses(self) -> set[str]:
        """Hosts, or schemes that are none's, of everything that the page has loaded, and of its WebSocket."""
        urls = self.ask("[page.connection.address, ...performance.getEntriesByType('resource').map((e) => e.name)]")
        return {re.split(r"[:/]+", url)[1 if re.match(r"(https?|wss?):", url) else 0] for url in urls}


class ServedRun:
    """A command of `sfms-robot` with `--view`, in a process of its own, once its first frame has come.

    words: `run` or `replay`, and what follows it. view: where the page is.

    Attributes:
        url: of the page, without its token. token: "" where none is needed.
    """

    def __init__(self, *words: str, view: str = "0") -> None:
        call = "from sfms_robot.cli.main import main; main()"
        command = [sys.executable, "-c", call, *words, "--view", view]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | {"COLUMNS": "200"}
        )
        self.said: list[str] = []
        self._named: SimpleQueue[str | None] = SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        url = self._named.get(timeout=LIMIT_S)
        assert url is not None, f"the run ended: {''.join(self.said)}"
        self.url, _, self.token = url.partition("?token=")

    def __enter__(self) -> ServedRun:
        try:
            self._begun()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()

    def _read(self) -> None:
        """All that it says, so that it never waits for a reader."""
        assert self.process.stdout is not None
        with self.process.stdout:
            for line in self.process.stdout:
                self.said.append(line)
                if (found := _NAMED.search(line)) is not None:
                    self._named.put(found[0])
        self._named.put(None)

    def _begun(self) -> None:
        """Block until there is something to be seen: until then a browser would only be in its way."""
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        try:
            with connect(self.url.replace("http", "ws", 1) + "ws", open_timeout=LIMIT_S) as socket:
                while True:
                    message = json.loads(socket.recv(timeout=LIMIT_S))
                    if message["type"] == "frame" or message.get("over"):
                        return
        except (ConnectionClosed, TimeoutError) as error:
            raise AssertionError(f"no frame came: {error}; {''.join(self.said)}") from error


def missing() -> str | None:
    """What a test in a browser lacks here; None: nothing."""
    if BROWSER is None or DRIVER is None:
        return "chromium and chromium-driver"
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "the package selenium"
    return None
