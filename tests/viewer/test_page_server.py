"""One visitor holds the controls; who needs a token only looks until it is shown."""

import asyncio
import json

import pytest
from starlette.requests import Request

from sfms_robot.errors import PacketError
from sfms_robot.viewer.page_server import IDLE_S, MOST_VISITORS, OUTBOX, PageServer, Visitors


class Here:
    """Visitors, and a clock that is set."""

    def __init__(self, token=None):
        self.now_s, self.left = 100.0, []
        self.visitors = Visitors(token, self.left.append, lambda: self.now_s)


def told(visitor):
    """What waits for a visitor."""

    async def all_of_it():
        found = []
        while visitor._something.is_set():
            found.append(await visitor.next())
        return found

    return [json.loads(each) if each.startswith("{") else each for each in asyncio.run(all_of_it())]


def test_who_does_something_first_has_the_controls_until_given_back_or_not_used():
    here = Here()
    a, b = here.visitors.enter(), here.visitors.enter()
    here.visitors.take(a)
    assert here.visitors.controls(a) == "you" and here.visitors.controls(b) == "other"
    assert told(b) == [{"type": "controls", "held": "other", "needs_token": False}]
    with pytest.raises(PacketError, match="another visitor holds the controls"):
        here.visitors.take(b)
    here.visitors.give(a)
    assert here.left == [a.number] and here.visitors.controls(b) == "nobody"
    here.visitors.take(b)
    assert here.visitors.controls(b) == "you"
    here = Here()
    a, b = here.visitors.enter(), here.visitors.enter()
    here.visitors.take(a)
    here.now_s += IDLE_S - 1
    assert here.visitors.holds(a) and not here.visitors.holds(b)  # a piece of voice counts as use
    here.now_s += IDLE_S - 1
    with pytest.raises(PacketError):
        here.visitors.take(b)
    here.now_s += 2
    here.visitors.take(b)
    assert here.visitors.controls(b) == "you" and here.left == [a.number]


def test_there_is_room_for_some_and_who_goes_leaves_the_controls():
    here = Here()
    a, b = here.visitors.enter(), here.visitors.enter()
    here.visitors.take(a)
    here.visitors.leave(a)
    assert here.left == [a.number] and here.visitors.controls(b) == "nobody" and len(here.visitors) == 1
    here = Here()
    first = [here.visitors.enter() for _ in range(MOST_VISITORS)][0]
    with pytest.raises(PacketError, match="look at this head already"):
        here.visitors.enter()
    here.visitors.leave(first)
    assert here.visitors.enter().number == MOST_VISITORS + 1


def test_a_page_of_another_version_is_to_be_loaded_again():
    here = Here()
    with pytest.raises(PacketError, match="version: expected 1, got 0: load the page again"):
        here.visitors.greet(here.visitors.enter(), 0, "")


def test_of_pictures_the_newest_is_sent_who_reads_nothing_is_found_out_and_a_flood_is_read_slowly():
    visitor = Here().visitors.enter()
    for picture in ("old", "new"):
        visitor.show(picture)
    visitor.tell(b'{"n":1}')
    visitor.tell(b'{"n":2}')
    assert told(visitor) == [{"n": 1}, {"n": 2}, "new"]
    for _ in range(OUTBOX):
        visitor.tell(b"{}")
    assert not visitor.behind
    visitor.tell(b"{}")
    assert visitor.behind
    pauses = [visitor.pause_s(0.01, 100.0) for _ in range(100)]
    assert pauses[:24] == [0.0] * 24 and pauses[-1] == pytest.approx(0.75)


def test_a_run_that_is_over_is_served_until_each_page_has_its_replay():
    async def served():
        sent = []
        page = PageServer(lambda _, content: sent.append(content["watched"]), None)
        await page._index(Request({"type": "http", "method": "GET", "headers": []}))
        assert sent == [1]  # a browser that loads the page stays a visitor, however slow it is
        page.begin({}, lambda: None)
        await page.replayed()  # a run that goes on has none
        for in_browser in (True, True, False):  # a program fetches nothing
            page._visitors.enter(in_browser)
        page.end({})
        waiting = asyncio.create_task(page.replayed())
        for _ in range(2):
            await asyncio.sleep(0)
            assert not waiting.done()
            assert [line async for line in page._lines()]
        await waiting

    asyncio.run(served())
