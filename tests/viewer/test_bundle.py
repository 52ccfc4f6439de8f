"""What the server hands out is what the sources in page/ give."""

import gzip
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE, STATIC = ROOT / "page", ROOT / "sfms_robot" / "viewer" / "static"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="needs npm")
def test_the_bundle_is_what_the_sources_give(tmp_path):
    copy = tmp_path / "page"
    shutil.copytree(PAGE, copy, ignore=shutil.ignore_patterns("node_modules"))
    (tmp_path / "sfms_robot" / "viewer").mkdir(parents=True)
    (tmp_path / "sfms_robot" / "viewer" / STATIC.name).symlink_to(STATIC)
    subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=copy, check=True, capture_output=True)
    done = subprocess.run(["npm", "run", "check"], cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_it_is_small_without_face_tracking_and_names_no_registry():
    files = [file for file in STATIC.iterdir() if file.is_file() and file.name != "face.js"]
    assert sum(len(gzip.compress(file.read_bytes())) for file in files) < 1_500_000
    assert "resolved" not in (PAGE / "package-lock.json").read_text()


@pytest.mark.parametrize("page", ["index.html", "people.html"])
def test_everything_that_a_page_names_is_there_and_relative(page):
    named = re.findall(r'(?:href|src)="([^"]+)"', (STATIC / page).read_text())
    ours = [name for name in named if not name.startswith(("data:", "#"))]
    assert all(not name.startswith(("/", "http")) for name in ours)
    assert all((STATIC / name.removeprefix("static/")).is_file() for name in ours if name.startswith("static/"))
