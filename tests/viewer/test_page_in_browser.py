"""The page in a real browser, on a run of the emulated head."""

import signal
import socket

import numpy as np
import pytest
from chromium import Page, ServedRun, missing

from sfms_robot.app.options import RunOptions
from sfms_robot.app.session import run as record
from sfms_robot.face.human import load_human

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(missing()), reason=f"needs {missing()}"), pytest.mark.realtime]

HUMAN = "human-cell"
WINDOW, PHONE = (1000, 700), (390, 844)
JOINTS = "page.hello.joints.map(({name}) => name)"


@pytest.fixture(scope="module")
def run():
    with ServedRun("run", "--port", "sim", "--head", "op3_head", "--duration", "3000", "--seed", "1") as served:
        yield served


@pytest.fixture(scope="module")
def browser(run, tmp_path_factory):
    with Page(tmp_path_factory.mktemp("chromium"), size=WINDOW) as page:
        yield page


@pytest.fixture
def page(browser, run):
    """The run's page; the same for all who leave it as it was."""
    if not browser.driver.current_url.startswith(run.url):
        browser.open(run.url)
    return browser


@pytest.fixture
def own_page(browser, run):
    """A page that is left when the test ends."""
    browser.leave()
    yield browser
    browser.look(WINDOW)
    browser.leave()


def shows(**channels):
    """In JavaScript: that the newest picture shows about this."""
    each = [
        f"Math.abs(page.stage.seen[page.hello.channels.indexOf('{name}')] - {value}) < {0.15 * (abs(value) or 1)}"
        for name, value in channels.items()
    ]
    return " && ".join(["page.stage.seen", *each])


def hold(page, **channels):
    """Show this, and go on showing it until it is drawn; the picture then."""
    page.driver.execute_script(
        "const channels = arguments[0];"
        "globalThis.holding = setInterval(() => page.connection.send('show', {channels, seconds: 5}), 300)",
        channels,
    )
    page.until(shows(**channels))
    shown = page.picture(HUMAN)
    page.ask("clearInterval(globalThis.holding) || 1")
    return shown


def slide(page, channel, value):
    """As a hand does."""
    page.driver.execute_script(
        "const input = document.querySelector(`[data-channel=${arguments[0]}] input`);"
        "input.value = arguments[1]; input.dispatchEvent(new Event('input'))",
        channel,
        value,
    )


def open_all(page):
    page.driver.execute_script("for (const each of document.querySelectorAll('details')) each.open = true")


def comes(page, kind, detail):
    """As if this message came to the page; `detail` in JavaScript, in which `page.hello` is what the run said."""
    page.driver.execute_script(f"page.connection.dispatchEvent(new CustomEvent('{kind}', {{detail: {detail}}}))")


def test_loads_without_a_complaint_and_asks_nobody_but_this_machine(page):
    page.until(
        "page.timeline.frames.length > 30 && page.stage.robot"
        " && document.querySelectorAll('#controls > details').length > 4"
    )
    assert page.complaints() == [] and page.addresses() <= {"127.0.0.1", "data", "blob", "about"}
    assert page.ask("document.getElementById('notice').hidden")


def test_vertices_are_those_that_python_computes(page):
    motion = np.random.default_rng(0).uniform(0, 0.8, 58).astype(np.float32)
    motion[:6] *= 0.4
    flat = page.ask(
        "(() => { const posed = page.stage.human.posed; posed.pose(arguments[0]);"
        " return [...posed.positions.subarray(0, 3 * posed.head.facts.skinned)]; })()".replace(
            "arguments[0]", str(motion.tolist())
        )
    )
    shown = np.array(flat).reshape(-1, 3)
    np.testing.assert_allclose(
        shown, load_human().vertices(motion)[: len(shown)], atol=1e-3
    )  # shares of the turn come in 256 steps


def test_a_blink_is_seen_where_the_eyes_are(page):
    still = hold(page, eyeBlinkLeft=0.0, eyeBlinkRight=0.0, pitch=0.0, yaw=0.0, roll=0.0)
    closed = hold(page, eyeBlinkLeft=1.0, eyeBlinkRight=1.0, pitch=0.0, yaw=0.0, roll=0.0)
    change = np.abs(closed - still).mean(axis=2)
    high, wide = change.shape
    eyes = change[int(0.36 * high) : int(0.50 * high), int(0.30 * wide) : int(0.70 * wide)].mean()
    collar = change[int(0.86 * high) : int(0.92 * high), int(0.30 * wide) : int(0.70 * wide)].mean()
    assert eyes > 3 and eyes > 8 * collar


def test_a_nod_moves_head_and_hair_and_not_the_shoulders(page):
    still = hold(page, pitch=0.0, yaw=0.0, roll=0.0)
    change = np.abs(hold(page, pitch=0.25, yaw=0.0, roll=0.0) - still).mean(axis=2)
    high = len(change)
    assert change[: high // 2].mean() > 4 and change[: high // 2].mean() > 5 * change[int(0.86 * high) :].mean()


@pytest.mark.parametrize("way", ["click", "Escape", "space"])
def test_halt(page, way):
    from selenium.webdriver.common.keys import Keys

    body = page.driver.find_element("tag name", "body")
    if way == "click":
        page.driver.find_element("id", "halt").click()
    else:
        body.send_keys(Keys.ESCAPE if way == "Escape" else " ")
    page.until("page.newest.s === 'halted' && document.getElementById('state').dataset.state === 'halted'")
    page.driver.find_element("id", "resume").click()
    page.until("page.newest.s !== 'halted'")


def test_a_slider_moves_its_joint_and_the_other_stays(page):
    pan, tilt = (page.ask(JOINTS).index(name) for name in ("head_pan", "head_tilt"))
    for channel, value in (("roll", 0.0), ("pitch", 0.0), ("yaw", -0.3)):
        slide(page, channel, value)
    asked = "page.newest.j"
    page.until(f"Math.abs({asked}[{pan}]) > 0.2 && " + shows(yaw=-0.3, pitch=0.0))
    before = page.ask(asked)
    slide(page, "yaw", 0.3)
    page.until(f"Math.abs({asked}[{pan}] - {before[pan]}) > 0.45")
    after = page.ask(asked)
    assert abs(after[tilt] - before[tilt]) < 0.2 * abs(after[pan] - before[pan])
    page.press("Let go of the sliders")


def test_where_it_looks_is_a_slider_of_the_keyboard_and_a_pad(page):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    page.until("document.querySelector('[data-look=aside] input')")
    page.driver.execute_script("document.querySelector('.pad').closest('details').open = true")
    pan = page.ask(JOINTS).index("head_pan")
    aside = page.driver.find_element("css selector", "[data-look=aside] input")
    aside.send_keys(Keys.END)
    page.until(f"page.newest.j[{pan}] > 0.3")  # the viewer's right is its left
    pad = page.driver.find_element("css selector", ".pad")
    ActionChains(page.driver).move_to_element_with_offset(pad, -pad.size["width"] // 2 + 5, 0).click().perform()
    assert float(aside.get_attribute("value")) < -40
    page.until(f"page.newest.j[{pan}] < -0.3")
    page.press("Let it look where it likes")
    assert float(aside.get_attribute("value")) == 0
    page.until(f"Math.abs(page.newest.j[{pan}]) < 0.2")


def test_the_table_of_servos_has_no_column_that_says_nothing(page):
    page.until("document.querySelectorAll('tbody tr').length === page.hello.joints.length")
    titles, cells = page.ask(
        "[[...document.querySelectorAll('thead th')].map((each) => each.textContent),"
        " [...document.querySelectorAll('tbody tr')].map((row) => [...row.children].map((each) => each.textContent))]"
    )
    assert {"is at °", "mA", "°C", "V"} <= set(titles) and "load %" not in titles  # XM430s tell a current
    for column, title in enumerate(titles):
        assert any(row[column] != "–" for row in cells), title


def test_it_comes_back_by_itself_and_after_a_reload(own_page, run):
    page = own_page.open(run.url)
    page.driver.execute_script(
        "page.connection.addEventListener('closed', () => {"
        "  page.newest = null;"
        "  page.connection.addEventListener('frame', () => { globalThis.again = true; }); });"
        "page.connection.close()"
    )
    page.until("globalThis.again && page.newest && document.getElementById('state').dataset.state === page.newest.s")
    page.open(run.url)
    assert page.ask("globalThis.again === undefined")


def test_replay_goes_where_the_scrubber_is_put(page):
    page.until("page.timeline.frames.length > 60")
    page.press("Replay")
    page.until("page.replay && !document.getElementById('replay').hidden")
    at_s = page.ask(
        "(() => { const s = document.getElementById('scrub'); s.value = (+s.min + +s.max) / 2;"
        " s.dispatchEvent(new Event('input')); return +s.value; })()"
    )
    shown = page.ask("page.timeline.frames.at(-1).t")
    assert shown <= at_s + 1e-6
    assert page.ask("page.replay.frames.find(({t}) => t > arguments[0])?.t ?? Infinity", shown) > at_s
    page.driver.find_element("id", "live").click()
    page.until(f"page.replay === null && page.timeline.frames.at(-1)?.t > {at_s}")


def test_a_recording_has_nothing_to_halt_and_nobody_to_tell(browser, tmp_path):
    record(RunOptions(head="op3_head", duration_s=2.0, fast=True, seed=1, record=tmp_path / "run"))
    with ServedRun("replay", str(tmp_path / "run")) as served:
        browser.open(served.url)
        browser.until("page.replay && !document.getElementById('replay').hidden")
        shown = "[...document.querySelectorAll('main > section > details')].map((each) => each.dataset.name)"
        assert browser.ask("document.getElementById('halt').hidden") and browser.ask(shown) == ["servos"]


def test_every_control_has_a_name_that_can_be_read_out(page):
    page.until("document.querySelectorAll('#controls > details').length > 4")
    nameless = page.ask(
        "[...document.querySelectorAll('button, input, select, canvas, video')].filter((e) =>"
        " !(e.getAttribute('aria-label') || e.textContent.trim() || e.closest('label')?.textContent.trim()))"
        ".map((e) => e.outerHTML)"
    )
    assert nameless == []


def own_address():
    """An address of this machine that is no loopback one; None: it has none. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return None
        return probe.getsockname()[0]


def test_beyond_loopback_a_wrong_token_is_refused_in_words_and_the_right_one_does(tmp_path):
    address = own_address()
    if address is None:
        pytest.skip("this machine has no address beyond loopback")
    flag = f"--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE {address}"
    head = ("--port", "sim", "--head", "op3_head", "--duration", "3000")
    notice, form = "document.getElementById('notice').textContent", "document.querySelector('#controls form')"
    with ServedRun("run", *head, view=f"{address}:0") as served, Page(tmp_path, flag) as page:
        assert served.token and address in served.url
        page.open(served.url)
        page.until(f"{form}?.checkVisibility()")
        page.press("Neutral")
        page.until(f"{notice}.includes('the token is needed')")
        box = page.driver.find_element("css selector", "#controls form input")
        box.send_keys("wrong\n")
        page.until(f"{notice}.includes('not the one that was printed')")
        assert page.ask("page.connection.held") == "nobody" and page.ask(f"{form}.checkVisibility()")
        box.clear()
        box.send_keys(served.token + "\n")
        page.until(f"!{form}.checkVisibility()")
        page.press("Neutral")
        page.until("page.connection.held === 'you'")
        page.open(served.url)  # it remembers
        page.until(f"page.connection.allowed && {form} && !{form}.checkVisibility()")


def test_what_is_wrong_with_the_run_is_said(own_page, run):
    page = own_page.open(run.url)
    page.driver.execute_script("globalThis.whole = page.hello; sessionStorage.setItem('reloaded for 2', '1')")
    for change, notice in (
        ("version: 2", "version 2: reload"),
        ("urdf: 'static/app.css'", "static/app.css: not XML"),
        ("urdf: 'robot/none.urdf'", "robot/none.urdf: 404"),
        ("urdf_joints: ['chin'], head: 'other'", 'no joint "chin"'),
    ):
        comes(page, "hello", f"{{...whole, {change}}}")
        page.until("document.getElementById('notice').textContent.includes(arguments[0])", notice)


def test_rates_stand_where_people_are_and_nowhere_for_a_listener_that_decides_nothing(own_page, run):
    page = own_page.open(run.url)
    stands = "document.querySelector('.rate input[aria-label=\"blinks\"]').value"
    page.until("document.querySelector('.rate')")
    assert float(page.ask(stands)) == pytest.approx(page.ask("page.hello.people_per_minute.blink"), abs=0.051)
    comes(page, "hello", "{...page.hello, people_per_minute: {}}")
    page.until("!document.querySelector('.rate')")


def test_phone(own_page, run):
    own_page.look(PHONE, dark=True)
    phone = own_page.open(run.url)
    assert phone.ask("document.documentElement.scrollWidth") <= PHONE[0]
    top, bottom, width = phone.ask(
        "(({top, bottom, width}) => [top, bottom, width])(document.getElementById('halt').getBoundingClientRect())"
    )
    assert 0 < top < bottom <= PHONE[1] and bottom - top >= 48 and width > 300
    assert phone.picture(HUMAN).std() > 20


def test_without_webgl_it_says_so_and_the_curves_go_on(own_page, run):
    with own_page.without_webgl():
        own_page.driver.get(run.url)
        own_page.until("page.newest && page.timeline.frames.length > 10")
    assert own_page.ask("document.getElementById('no-webgl').checkVisibility()")
    assert own_page.picture("timeline").std() > 5


@pytest.mark.parametrize("size", [WINDOW, PHONE])
def test_no_name_and_no_value_of_a_slider_is_cut_off(own_page, run, size):
    own_page.look(size)
    page = own_page.open(run.url)
    page.until("document.querySelector('[data-channel=mouthUpperUpRight]')")
    open_all(page)
    cut = "[...document.querySelectorAll('.slider :is(span, output)')].filter((e) => e.scrollWidth > e.clientWidth)"
    assert page.ask(f"{cut}.map((e) => e.textContent)") == []
    heights = page.ask("[...document.querySelectorAll('.rate output')].map((e) => e.clientHeight)")
    assert len(heights) > 4 and len(set(heights)) == 1  # "as people" takes no more lines than a number


def test_halt_stays_where_it_is_whatever_is_told_beside_it(page):
    place = "JSON.stringify(document.getElementById('halt').getBoundingClientRect())"
    before = page.ask(place)
    page.driver.execute_script(
        "page.still = true; document.getElementById('state-why').textContent = 'left_eyebrow_outer, '.repeat(40)"
    )
    try:
        assert page.ask(place) == before and page.ask("document.documentElement.scrollWidth") <= WINDOW[0]
    finally:
        page.ask("(page.still = false, 1)")


def test_a_fault_is_told_beside_its_joint_in_the_table_of_servos(page):
    page.until("document.querySelectorAll('tbody tr').length === page.hello.joints.length")
    told = page.ask(
        "(() => { page.panels.servos.show({...page.status, faults: {head_pan: 'no answer'}});"
        " const name = document.querySelector('tbody tr.bad').cells[0];"
        " return [name.firstChild.textContent, name.querySelector('small').textContent]; })()"
    )
    assert told == ["head_pan", "no answer"]


@pytest.mark.parametrize("size", [WINDOW, PHONE])
def test_resume_does_not_come_up_under_the_hand_that_halts(own_page, run, size):
    own_page.look(size)
    page = own_page.open(run.url)
    middle = "(({x, y, width, height}) => [x + width / 2, y + height / 2])(find.getBoundingClientRect())"
    x, y = page.ask(middle.replace("find", "document.getElementById('halt')"))
    page.driver.execute_script("page.still = true; document.getElementById('resume').hidden = false")
    assert page.ask("document.elementFromPoint(arguments[0], arguments[1]).closest('button').id", x, y) == "halt"


def test_there_is_something_to_download_once_it_was_recorded(own_page, run):
    page = own_page.open(run.url)
    download = "document.querySelector('[data-name=recording] a')"
    page.until(download)
    assert page.ask(f"{download}.hidden")
    page.press("Record")
    page.until(
        "[...document.querySelectorAll('#controls button')].some((each) => each.textContent === 'Stop recording')"
    )
    assert page.ask(f"{download}.hidden")
    page.press("Stop recording")
    page.until(f"!{download}.hidden")


@pytest.mark.parametrize("late", [False, True])
def test_torque_that_the_end_of_a_run_could_not_confirm_off_is_named(own_page, run, late):
    page = own_page.open(run.url)
    page.driver.execute_script("page.still = true")
    comes(page, "hello", "{...page.hello, over: %s}" % ("true, torque_unconfirmed: ['head_pan']" if late else "false"))
    if not late:
        comes(page, "over", "{report: {torque_unconfirmed: ['head_pan']}}")
    page.until("document.getElementById('notice').textContent.startsWith('Torque is NOT confirmed off: head_pan.')")
    page.until("document.getElementById('faults').textContent === 'head_pan: not confirmed off'")


def test_a_run_that_has_ended_stays_as_its_replay(tmp_path):
    with ServedRun("run", "--port", "sim", "--head", "op3_head", "--seed", "1") as run:
        with Page(tmp_path, size=WINDOW) as page:
            page.open(run.url)
            slowly = "(...what) => new Promise((go) => setTimeout(go, 2000)).then(() => quick(...what))"
            page.driver.execute_script(f"const quick = fetch; globalThis.fetch = {slowly}")
            run.process.send_signal(signal.SIGINT)
            page.until("page.ended && page.replay")
            run.process.wait()
            page.until("!page.connection.open")
            assert page.ask("document.getElementById('state-name').textContent") == "ended"
            assert page.ask("document.getElementById('notice').textContent") == "The run has ended. This is its replay."
            page.until("document.body.classList.contains('gone')")  # its program too
            assert not page.ask("document.getElementById('controls').checkVisibility()")
