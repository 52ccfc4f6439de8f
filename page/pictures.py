"""Takes the pictures under docs/guide/page/: the page in Chromium without a window, on runs of emulated heads.

    PYTHONPATH=.:tests/viewer .venv/bin/python page/pictures.py [NAME ...]

All but `fault` show a run in virtual time, played again: the same on any machine. A picture is looked at before it is
committed, and weighs less than 120 kB.
"""

from __future__ import annotations

import functools
import http.server
import io
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chromium import Page, ServedRun
from first_picture import STATIC, Quiet
from PIL import Image

from sfms_robot.app.head.head_scene import scene_of
from sfms_robot.config import load_head
from sfms_robot.data import data_dir

OUT = Path(__file__).parent.parent / "docs" / "guide" / "page"
HEADS = ("face28", "reachy_mini", "face24_maestro", "inmoov2_maestro", "inmoov2_ssc32", "interbotix_wxxms", "op3_head",
         "open_duck_mini_v2_head", "poppy_head")  # fmt: skip
DESKTOP, PHONE = (1280, 980), (390, 844)
RUN = ("--head", "face28", "--seed", "1", "--duration", "40")
FROM_S = 20  # on: the curves are full
BROKEN = ("--head", "reachy_mini")
FAULTS = ("--fault", "silent:17@40", "--fault", "overheat:10@40")
LINK = "./reachy_mini"
QUALITY = 76
LIMIT_BYTES = 120_000
COMMAND = (sys.executable, "-c", "from sfms_robot.cli.main import main; main()")
SHOW_HEAD = """
const [address, names, values, caption, done] = arguments;
document.getElementById('robot-caption').textContent = caption;
import(`${location.origin}/static/robot.js`).then(async ({ loadRobot }) => {
  const robot = await loadRobot(address, names, done);
  robot.show(values);
  page.stage.setRobot(robot);
  done('');
}).catch((error) => done(String(error)));
"""


@contextmanager
def replayed() -> Iterator[ServedRun]:
    """A run in virtual time, put on a page."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([*COMMAND, "run", "--fast", *RUN, "--record", folder], check=True, stdout=subprocess.DEVNULL)
        with ServedRun("replay", folder) as run:
            yield run


@contextmanager
def broken_chain() -> Iterator[str]:
    """The port of an emulated head with a servo that falls silent and one that runs hot."""
    chain = subprocess.Popen([*COMMAND, "emulate", *BROKEN, *FAULTS, "--link", LINK], stdout=subprocess.PIPE)
    try:
        assert chain.stdout is not None
        chain.stdout.readline()  # where it is: now it is there
        yield LINK
    finally:
        chain.terminate()
        chain.wait()


@contextmanager
def robots() -> Iterator[str]:
    """The page's files and the robots of all heads on a server of their own, with no run behind them."""
    with tempfile.TemporaryDirectory() as folder:
        for name, there in (
            ("static", STATIC),
            ("index.html", STATIC / "index.html"),
            ("heads", data_dir("sim") / "heads"),
        ):
            (Path(folder) / name).symlink_to(there)
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/index.html"
        finally:
            server.shutdown()


def save(png: bytes, name: str) -> None:
    file = OUT / f"{name}.jpg"
    Image.open(io.BytesIO(png)).convert("RGB").save(file, quality=QUALITY, optimize=True, progressive=True)
    assert file.stat().st_size < LIMIT_BYTES, f"{file}: {file.stat().st_size} bytes"


def desktop(page: Page, run: ServedRun) -> None:
    """The instant at which it smiles most."""
    page.open(run.url)
    page.until("page.replay && page.stage.robot")
    page.driver.execute_script(
        "const smile = page.hello.channels.indexOf('mouthSmileLeft');"
        "const late = page.replay.frames.filter(({t}) => t > arguments[0]);"
        "const best = late.reduce((most, frame) => frame.m[smile] > most.m[smile] ? frame : most);"
        "page.replay.pause(best.t + 0.001)",
        FROM_S,
    )
    page.until(
        "page.stage.seen?.every((value, i) => Math.abs(value - page.timeline.frames.at(-1).m[i]) < 0.001)"
        " && !page.replay.playing"
    )


def fault(page: Page, run: ServedRun) -> None:
    page.open(run.url)
    page.until("page.stage.robot")
    page.until(
        "page.newest.f.right_antenna && page.newest.f.body_rotation && Object.keys(page.newest.f).length === 2"
        " && (page.still = true)"
    )


def take(name: str, page: Page, size: tuple[int, int], run: ServedRun, show, dark: bool = False) -> None:
    page.look(size, dark)
    show(page, run)
    save(page.screen(), name)
    print(name, flush=True)  # noqa: T201


def heads(page: Page) -> None:
    """The robot's half of the stage, of each head at rest: one picture of nine."""
    page.look(DESKTOP)
    cells = []
    with robots() as address:
        page.driver.get(address)
        page.until("!document.documentElement.classList.contains('early')")  # until then it has no captions
        for name in HEADS:
            scene = scene_of(load_head(name))
            assert scene is not None
            pictures = page.ask("page.stage.pictures")
            problem = page.driver.execute_async_script(
                SHOW_HEAD, f"heads/{name}/{scene.urdf.name}", list(scene.joints), scene.rest().tolist(), name
            )
            assert not problem, problem
            page.until(f"page.stage.pictures > {pictures}")
            cell = Image.fromarray(page.picture("robot-cell").astype("uint8"))
            cell.thumbnail((300, 330))
            cells.append(cell)
            print(name, flush=True)  # noqa: T201
    wide, tall = cells[0].size
    sheet = Image.new("RGB", (3 * wide, -(-len(cells) // 3) * tall), "white")
    for number, cell in enumerate(cells):
        sheet.paste(cell, (wide * (number % 3), tall * (number // 3)))
    png = io.BytesIO()
    sheet.save(png, "png")
    save(png.getvalue(), "heads")


def main(names: list[str]) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    wanted = set(names or ("desktop", "dark", "phone", "fault", "heads"))
    with tempfile.TemporaryDirectory() as profile, Page(Path(profile)) as page:
        if wanted & {"desktop", "dark", "phone"}:
            with replayed() as run:
                if "desktop" in wanted:
                    take("desktop", page, DESKTOP, run, desktop)
                if "dark" in wanted:
                    take("dark", page, DESKTOP, run, desktop, dark=True)
                if "phone" in wanted:
                    take("phone", page, PHONE, run, desktop)
                page.leave()
        if "fault" in wanted:
            with (
                broken_chain() as port,
                ServedRun("run", *BROKEN, "--port", port, "--audio", "katie", "--duration", "600") as run,
            ):
                take("fault", page, DESKTOP, run, fault)
                page.leave()
        if "heads" in wanted:
            heads(page)


if __name__ == "__main__":
    main(sys.argv[1:])
