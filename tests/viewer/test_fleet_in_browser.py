"""The fleet's page in a real browser: a tile per head over real zenoh, and a button that halts all of them."""

from contextlib import closing

import pytest
from chromium import Page, missing

from sfms_robot.app.fleet import FleetControls, FleetHead, fleet_key, fleet_page, open_fleet
from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.app.options import RunOptions
from sfms_robot.config import load_head

pytest.importorskip("zenoh", reason="needs the extra [remote]")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=f"needs {missing()}"), pytest.mark.realtime]

TILES = "[...document.querySelectorAll('#heads li')]"
NAMES = ("hall", "kitchen")


class Head:
    """A run as a fleet knows it: what it tells, and what may be done to it."""

    def __init__(self, name, router):
        run = RunControls(load_head("face28"), RunOptions())
        self.halt, run.document = run.halt, self.document
        self.head = FleetHead(FleetControls(run, name, fleet_key(None)), router)

    def document(self):
        by = self.halt.by
        return {
            "head": "face28", "listener": "sfms-small", "state": "listening" if by is None else "halted",
            "why": [] if by is None else [by], "hottest": {"joint": "jaw", "temperature_C": 41}, "faults": {},
        }  # fmt: skip


@pytest.fixture
def fleet(router, tmp_path):
    """Two heads, their page, and the browser that looks at it."""
    heads = {name: Head(name, router) for name in NAMES}
    try:
        with open_fleet(router.file) as met, closing(fleet_page(met, 0)) as page, Page(tmp_path / "chrome") as browser:
            browser.driver.get(page.url)
            browser.ask("(said.textContent = nobody)")  # as of a page that was there before the heads
            browser.until(f"{TILES}.length == {len(NAMES)}")
            yield heads, browser
    finally:
        for each in heads.values():
            each.head.close()


def test_a_tile_says_what_a_head_does_and_one_button_halts_all(fleet):
    heads, browser = fleet
    assert browser.ask(f"{TILES}.map(each => [each.children[0].textContent, each.children[1].textContent])") == [
        [name, "listening"] for name in NAMES
    ]
    browser.until("said.textContent == ''")
    browser.ask("document.getElementById('all').click()")
    browser.until(f"{TILES}.every(each => each.className == 'halted')")
    assert {each.halt.by for each in heads.values()} == {"the fleet's page"}
    browser.ask(f"{TILES}[0].querySelectorAll('button')[1].click()")
    browser.until(f"{TILES}[0].className == 'listening'")
    assert heads["hall"].halt.by is None and heads["kitchen"].halt.by is not None
    assert "hall: resume" in browser.ask("document.getElementById('said').textContent")
    assert browser.complaints() == []
