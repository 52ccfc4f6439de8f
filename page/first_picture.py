"""How soon the face is seen, beside an empty three.js page in the same browser.

    PYTHONPATH=.:tests/viewer .venv/bin/python page/first_picture.py [REPEATS]

Each page is loaded in turn, with nothing cached, from the same server; milliseconds from navigation to the first
picture. The empty page has a renderer, an empty scene and a camera, and draws once.
"""

from __future__ import annotations

import functools
import http.server
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from statistics import median

from chromium import Page

from sfms_robot.face.human import load_human, packed_human

HERE = Path(__file__).parent
STATIC = HERE.parent / "sfms_robot" / "viewer" / "static"
EMPTY = """
import { PerspectiveCamera, Scene, WebGLRenderer } from 'three';
const renderer = new WebGLRenderer({ antialias: true });
renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement);
requestAnimationFrame(() => {
  renderer.render(new Scene(), new PerspectiveCamera(50, 1, 0.1, 10));
  renderer.getContext().finish();
  performance.mark('first picture');
});
"""


def site(folder: Path) -> None:
    (folder / "static").symlink_to(STATIC)
    (folder / "index.html").write_bytes((STATIC / "index.html").read_bytes())
    (folder / "human").mkdir()
    (folder / "human" / "head.bin").write_bytes(packed_human(load_human()))
    build = [
        str(HERE / "node_modules/.bin/esbuild"),
        "--bundle",
        "--minify",
        "--format=esm",
        f"--outfile={folder}/empty.js",
    ]
    subprocess.run(build, input=EMPTY, text=True, cwd=HERE, check=True, capture_output=True)
    (folder / "empty.html").write_text('<!doctype html><body><script type="module" src="empty.js"></script>')


class Quiet(http.server.SimpleHTTPRequestHandler):
    protocol_version = "HTTP/1.1"  # connections stay, as the page's own server keeps them

    def log_message(self, *_: object) -> None:
        """Nothing."""


def main(repeats: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        site(Path(folder))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        seen: dict[str, list[float]] = {"empty.html": [], "index.html": []}
        for _ in range(repeats):
            for name, times in seen.items():
                with tempfile.TemporaryDirectory() as profile, Page(Path(profile)) as page:
                    page.driver.get(f"http://127.0.0.1:{server.server_port}/{name}")
                    page.until("performance.getEntriesByName('first picture').length")
                    times.append(page.ask("performance.getEntriesByName('first picture')[0].startTime"))
        server.shutdown()
    for name, times in seen.items():
        print(f"{name:12} {median(times):7.0f} ms  ({', '.join(f'{each:.0f}' for each in times)})")  # noqa: T201
    print(f"ratio {median(seen['index.html']) / median(seen['empty.html']):.2f}")  # noqa: T201


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 5)
