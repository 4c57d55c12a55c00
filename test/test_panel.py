# SPDX-License-Identifier: Apache-2.0
"""The page of a panel: what it keeps and draws, and all of it in a real browser in front of a running gripper."""

import asyncio
import http.client
import math
import os
import re
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ament_index_python.packages import get_package_prefix

pytest.importorskip("bokeh")

from bokeh.events import ButtonClick
from bokeh.util.token import generate_jwt_token, generate_session_id
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from piezo_control.nodes import panel as panel_node
from piezo_control.nodes.client import ClientError, connect
from piezo_control.nodes.qos import SAMPLE
from piezo_control.panel.cards import Card, Gauge, Message, render
from piezo_control.panel.controls import Controls, number
from piezo_control.panel.history import History
from piezo_control.panel.traces import LOOKS, MOST, SIGNALS, Traces, known
from piezo_control.recording.reader import open_bag
from piezo_control.recording.recording import SAMPLE_TYPE
from piezo_control.waveform import SHAPES
from piezo_gripper_msgs.msg import FingerState, Sample

EXECUTABLES = Path(get_package_prefix("piezo_gripper")) / "lib" / "piezo_gripper"
TIMEOUT = 180.0  # s, generous: the tests wait on conditions


# --- without a browser --------------------------------------------------------------------------------


def filled(count, **signals):
    """Return a history of `count` looks, in which signals have the values that are functions of the time."""
    history = History(SIGNALS, 600 * LOOKS)
    for index in range(count):
        clock = index / LOOKS
        values = {"clock": clock} | {name: signal(clock) for name, signal in signals.items()}
        history.append([values.get(signal, math.nan) for signal in SIGNALS])
    return history


def test_command_line():
    for words, code, said in (
        (["--host", "192.0.2.1"], 1, "panel: no page on 192.0.2.1:5006: [Errno 99] Cannot assign"),
        (["-f", "a", "-f", "b", "-f", "c"], 2, "3 fingers are named, a page shows 2"),
        (["-f", "bad name"], 2, "panel: error: 'bad name' cannot be: namespace must not contain"),
    ):
        done = subprocess.run(
            [EXECUTABLES / "panel", *words], capture_output=True, text=True, timeout=TIMEOUT
        )
        assert done.returncode == code
        assert said in done.stderr and "Traceback" not in done.stderr


def test_history_keeps_the_newest_rows_and_leaves_out_the_same_ones_however_it_is_asked():
    history = History(("clock", "number"), 100)
    for index in range(250):
        history.append((0.02 * index, 7.0 * index))
    np.testing.assert_array_equal(history.since(0)["number"], 7.0 * np.arange(150, 250))
    whole = history.since(0, step=4)["number"]
    parts = [history.since(first, 4)["number"] for first in (150, 203)]
    np.testing.assert_array_equal(whole, 7.0 * np.arange(152, 250, 4))
    np.testing.assert_array_equal(parts[1], whole[whole >= 7.0 * 203])
    assert history.rate("number", "clock", 50) == pytest.approx(350.0)
    assert math.isnan(history.rate("number", "clock", 100))


def test_rate_is_unknown_over_a_restart():
    history = filled(60, number=lambda t: (1000.0 * t) % 900.0)
    assert math.isnan(history.rate("number", "clock", 20))
    assert history.rate("number", "clock", 5) == pytest.approx(1000.0)


@pytest.mark.parametrize("text", ["", "abc", "1,5", "nan", "inf", "1e999"])
def test_a_field_that_holds_no_number_says_what_is_in_it_and_what_must_be(text):
    with pytest.raises(ValueError) as refusal:
        number(text, "the amplitude", "µm")
    assert str(refusal.value) == (f"the amplitude is '{text}', must be a number in µm, such as 2.5")


def test_gauge():
    gauge = Gauge("Voltage", "V", 20.0, -40.0, 40.0)
    assert gauge.share == 0.75 and not gauge.is_at_limit
    assert Gauge("Voltage", "V", 40.1, -40.0, 40.0).is_at_limit
    assert not Gauge("Voltage", "V", math.nan, -40.0, 40.0).is_at_limit


def test_words_of_nodes_are_text_on_the_page():
    card = Card("/finger", "#000", "bad", "<img src=x>", "", [Gauge("Voltage", "V", 1.0)], [])
    assert "<img" not in render("cards", cards=[card])
    assert "<img" not in render("messages", messages=[Message("1", "2", "<img src=x>", True)])
    assert "<img" not in render("complaints", complaints=["<img src=x>"])


def test_traces_go_on_where_they_were_and_are_thinned_to_what_a_screen_shows():
    history = filled(1200, deflection=lambda t: 1e-6 * t)
    assert known([history]) == ["position"]
    traces = Traces({"/finger": history})
    (source,) = {line.data_source for line in traces.figures["position"].renderers[:1]}
    assert len(source.data["clock"]) == 10 * LOOKS
    np.testing.assert_allclose(source.data["deflection"], np.arange(700, 1200) / LOOKS)
    traces.show("10 min")
    np.testing.assert_allclose(source.data["deflection"], np.arange(0, 1200, 20) / LOOKS)
    traces.is_frozen = True
    history.append([24.0, *[math.nan] * (len(SIGNALS) - 1)])
    traces.go_on()
    assert len(source.data["clock"]) == 60
    traces.is_frozen = False
    traces.go_on()
    assert len(source.data["clock"]) == 61
    assert 600 * LOOKS / 20 == MOST


class Recorded:
    """A bench whose fingers and gripper take down what they are asked for."""

    def __init__(self):
        self.asked, self.refused = [], []
        self.fingers = {
            name: SimpleNamespace(
                namespace=name,
                **{what: self._taker(name, what) for what in ("set", "wave", "home", "control")},
            )
            for name in ("/left", "/right")
        }

    def _taker(self, *who):
        return lambda *values: self.asked.append((*who, *values))

    def reach(self):
        return -20e-6, 22e-6

    def ask(self, what, act):
        act()

    def refuse(self, what, why):
        self.refused.append((what, why))

    def stop(self):
        self.asked.append("stop")


@pytest.fixture
def recorded():
    bench = Recorded()
    controls = Controls(bench)
    bench.widgets = {widget.name: widget for widget in controls.widgets}

    def press(name):
        button = bench.widgets[name]
        button._trigger_event(ButtonClick(button))

    bench.controls, bench.press = controls, press
    return bench


@pytest.mark.parametrize("shape", SHAPES)
def test_every_waveform_can_be_asked_for_with_its_fields_as_they_are(recorded, shape):
    recorded.widgets["shape"].value = shape
    recorded.widgets["amplitude"].value_input = "4"
    recorded.widgets["offset"].value_input = "-2.5"
    recorded.widgets["choice"].active = 2
    recorded.press("wave")
    assert recorded.refused == []
    (left, _, wave), (right, _, same) = recorded.asked
    assert (left, right) == ("/left", "/right") and wave == same
    assert (wave.shape, wave.amplitude, wave.offset) == (
        shape,
        *map(pytest.approx, (4e-6, -2.5e-6)),
    )
    # The longest that a shape without an end of its own goes on is given by its field.
    assert wave.duration == (10.0 if shape in ("sweep", "decaying_sine") else 0.0)
    assert recorded.widgets["end_frequency"].visible == (shape == "sweep")


def test_steps_go_on_from_what_is_in_the_field(recorded):
    recorded.widgets["set_point"].value_input = "3"
    recorded.press("step3")
    recorded.press("step1")
    assert [value for _, _, value in recorded.asked] == pytest.approx([4e-6, 3.9e-6])
    recorded.widgets["set_point"].value_input = "three"
    recorded.press("step3")
    assert recorded.refused == [
        ("+1", "the set-point is 'three', must be a number in µm, such as 2.5")
    ]


def test_steps_go_on_from_the_reference_of_each_finger_whatever_the_field_holds(recorded):
    for finger, um in zip(recorded.fingers.values(), (10.0, -5.0)):
        finger.newest = lambda um=um: SimpleNamespace(reference=um * 1e-6)
    recorded.controls.follow()
    assert recorded.widgets["set_point"].value_input == "10"
    assert recorded.widgets["slider"].value == pytest.approx(10.0)
    recorded.widgets["set_point"].value_input = "0"  # typed, and forgotten
    recorded.press("step2")
    recorded.press("step2")  # sooner than a finger can have answered
    recorded.widgets["choice"].active = 2
    recorded.press("step2")
    assert [(name, um * 1e6) for name, _, um in recorded.asked] == [
        (name, pytest.approx(um))
        for name, um in (("/left", 10.1), ("/left", 10.2), ("/left", 10.3), ("/right", -4.9))
    ]


def test_field_and_slider_follow_the_reference_unless_somebody_is_at_them(recorded, monkeypatch):
    monkeypatch.setattr("piezo_control.panel.controls.ANSWER_TIME", 0.0)
    field, slider = recorded.widgets["set_point"], recorded.widgets["slider"]
    um = 12.345

    def newest():
        return SimpleNamespace(reference=um * 1e-6)

    recorded.fingers["/left"].newest = recorded.fingers["/right"].newest = newest
    recorded.controls.follow()
    assert (field.value, field.value_input) == ("12.345", "12.345")
    recorded.press("go")  # what is shown is where the finger is
    assert recorded.asked[-1][2] == pytest.approx(um * 1e-6, abs=1e-15)
    field.value_input = "3"  # typed, and not yet sent
    um = 4.0
    recorded.controls.follow()
    assert (field.value_input, slider.value) == ("3", pytest.approx(4.0))
    recorded.press("zero")
    slider.value = 7.0  # on the way, not yet let go of
    recorded.controls.follow()
    assert (field.value_input, slider.value) == ("4", 7.0)
    um = math.nan  # nobody has told one
    recorded.controls.follow()
    assert (field.value_input, slider.value) == ("4", 7.0)


def test_what_a_panel_does_again_and_again_goes_on_after_something_went_wrong(caplog, monkeypatch):
    monkeypatch.setattr(panel_node, "REVIEW_PERIOD", 0.0)
    done = []

    async def act():
        done.append(len(done))
        if len(done) == 1:
            raise RuntimeError("once")
        if len(done) == 3:
            raise asyncio.CancelledError

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(panel_node.repeat(act))
    assert done == [0, 1, 2]
    assert "RuntimeError: once" in caplog.text


def test_a_page_that_is_closed_after_it_was_given_up_is_no_error(caplog, monkeypatch):
    """Bokeh gives up a page whose connection is dead when it looks after all of them, before it hears of its end."""
    monkeypatch.setattr(panel_node, "build", lambda document, bench: None)

    async def come_and_go():
        server = panel_node.serve(None, "localhost", 0, IOLoop.current())
        server.start()
        token = generate_jwt_token(generate_session_id())
        where = f"ws://localhost:{server.port}/ws"
        page = await websocket_connect(where, subprotocols=["bokeh", token])
        await page.read_message()  # it is open
        (connection,) = server._tornado._clients
        handler = connection._socket
        server._tornado.client_lost(connection)
        page.close()
        while not handler._on_close_called:
            await asyncio.sleep(0.01)
        server.stop()

    asyncio.run(asyncio.wait_for(come_and_go(), TIMEOUT))
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


# --- in a browser -------------------------------------------------------------------------------------


class Page:
    """A page of a panel in a browser, by the names of its parts."""

    def __init__(self, context, address):
        self.errors, self.elsewhere = [], []
        self.page = context.new_page()
        self.page.set_default_timeout(1e3 * TIMEOUT)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", self._request)
        self.address = address
        self.page.goto(address)

    def _request(self, request):
        if not request.url.startswith((self.address, "data:", self.address.replace("http", "ws"))):
            self.elsewhere.append(request.url)

    def press(self, name):
        self.page.locator(f".{name} button").click()

    def fill(self, name, text):
        self.page.locator(f".{name} input").fill(text)

    def choose(self, name):
        self.page.locator(".choice button", has_text=name).click()

    def shows(self, text, where="body"):
        """Wait until a part of the page shows a text."""
        self.page.locator(where).filter(has_text=text).first.wait_for()

    def again(self, look):
        """Return what `look()` finds on the page, once it finds something.

        The page is opened anew whenever the panel has found more to show, and is then looked at again.
        """
        from playwright.sync_api import Error

        end = time.monotonic() + TIMEOUT
        while time.monotonic() < end:
            try:
                if found := look():
                    return found
            except Error as error:
                if "navigation" not in str(error):
                    raise
            self.page.wait_for_timeout(100)
        raise AssertionError("nothing was found on the page")

    def ask(self, question):
        """Return what a function in the browser returns, once a page is there and that is true."""
        is_there = "window.Bokeh?.documents[0]?.get_model_by_name('cards')"
        return self.again(lambda: self.page.evaluate(f"() => {is_there} && ({question})()"))

    def trace(self, finger):
        """Return what is drawn of a finger's signals, in their units, and the times in s."""
        columns = self.ask(
            f"""() => Object.entries(Bokeh.documents[0].get_model_by_name("source{finger}")?.data ?? {{}})
                .map(([name, values]) => [name, Array.from(values)])"""
        )
        drawn = {name: np.array(values, dtype=float) for name, values in columns}
        return drawn | {"clock": drawn["clock"] * 1e-3}


class Panel:
    """A panel in a process of its own; what it says is in `log`."""

    def __init__(self, folder, *arguments):
        self.log = folder / "panel.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [EXECUTABLES / "panel", "--port", "0", "--timeout", "20", *arguments],
                stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True,
            )  # fmt: skip
        self.address = self.process.stdout.readline().split()[1]

    def end(self):
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(TIMEOUT) == 0
        # Bokeh itself may complain of a page that was closed while it was opened.
        assert "piezo_control" not in self.log.read_text()


@pytest.fixture(scope="module")
def panel(browser, tmp_path_factory):
    """A gripper, a panel of it with controls, and a page."""
    folder = tmp_path_factory.mktemp("panel")
    with (folder / "stack.log").open("wb") as log:
        # Simulated fingers take all there is; the page comes first.
        stack = subprocess.Popen(
            ["nice", "-n", "5", EXECUTABLES / "gripper_stack", "--controller", "robust"],
            cwd=folder, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
    running = Panel(folder, "--control")
    try:
        running.page = Page(browser.new_context(), running.address)
        for part in ("/left", "/right", "closed loop, robust"):
            running.page.shows(part, ".cards")
        running.page.shows("Gripper", "fieldset")
        running.folder = folder
        yield running
        assert running.page.errors == []
        assert running.page.elsewhere == []
    finally:
        os.killpg(stack.pid, signal.SIGTERM)
        stack.wait(TIMEOUT)
        running.end()


@pytest.fixture(scope="module")
def ros(panel):
    with connect(TIMEOUT) as connection:
        yield connection


@pytest.fixture
def left(ros):
    finger = ros.finger("left")
    finger.wait_for(lambda: finger.state and finger.state.phase == FingerState.RUNNING)
    finger.wait_for(lambda: math.isfinite(finger.newest().number))
    yield finger
    finger.zero()
    finger.wait_for(near(finger, 0.0))


@pytest.fixture
def page(panel):
    panel.page.choose("/left")
    return panel.page


def near(finger, target):
    return lambda: abs(finger.newest().deflection - target) < 0.1e-6


def test_set_point_moves_the_finger_and_its_trace(page, left):
    page.fill("set_point", "6.5")
    page.press("go")
    left.wait_for(near(left, 6.5e-6))
    page.shows("/left: set-point 6.5 µm: done", ".messages")
    page.ask(
        """() => Math.abs(
            Bokeh.documents[0].get_model_by_name("source/left")?.data.deflection.at(-1) - 6.5) < 0.1"""
    )
    page.press("zero")
    left.wait_for(near(left, 0.0))


def test_a_step_on_a_new_page_begins_where_the_finger_is(panel, browser, left):
    left.set(6e-6)
    context = browser.new_context()
    page = Page(context, panel.address)
    page.choose("/left")
    page.press("step2")
    page.shows("/left: set-point 6.1 µm: done", ".messages")
    left.wait_for(lambda: abs(left.newest().reference - 6.1e-6) < 1e-12)
    context.close()


@pytest.mark.parametrize(
    "field, text, button, words",
    [
        ("set_point", "six", "go", "the set-point is 'six', must be a number in µm"),
        ("set_point", "20000", "go", "deflection is 0.02 m, must be within ±0.001 m"),
        ("frequency", "0", "wave", "frequency is 0, must be in (0, 100000] Hz"),
        ("opening", "500", "move", "must be in"),
        ("bag", "/dev/null/bag", "record", "refuses to activate"),
    ],
)
def test_what_cannot_be_is_said_in_words(page, left, field, text, button, words):
    kept = page.page.locator(f".{field} input").input_value()
    before = left.newest().deflection
    page.fill(field, text)
    page.press(button)
    page.shows(words, ".messages .refused")
    page.fill(field, kept)
    assert left.newest().deflection == pytest.approx(before, abs=0.1e-6)


def test_loop_opens_and_another_controller_closes_it(page, left):
    page.press("open_loop")
    page.shows("open loop", ".cards .loop")
    assert not left.setup().is_closed
    page.page.locator(".controller select").select_option("fast")
    page.press("close_loop")
    page.shows("closed loop, fast", ".cards .loop")
    page.page.locator(".controller select").select_option("robust")
    page.press("close_loop")
    page.shows("closed loop, robust", ".cards .loop")


def test_stop_brings_both_fingers_to_rest_and_start_lets_them_run(page, ros, left):
    page.press("stop")
    page.shows("idle", ".cards")
    right = ros.finger("right")
    for finger in (left, right):
        finger.wait_for(
            lambda f=finger: (
                f.state and f.state.phase == FingerState.IDLE and f.state.voltage == 0.0
            )
        )
    page.choose("both")
    page.press("start")
    for finger in (left, right):
        finger.wait_for(lambda f=finger: f.state.phase == FingerState.RUNNING)
    page.shows("start: done", ".messages")


def test_a_recording_begins_and_ends_where_it_is_told(page, panel, left):
    page.choose("/left")
    kept = page.page.locator(".bag input").input_value()
    page.fill("bag", str(panel.folder / "bag"))
    page.press("record")
    page.shows(f"into {panel.folder}/bag", ".messages")
    before = left.newest().number
    left.wait_for(lambda: left.newest().number > before + 100)
    page.press("end_record")
    page.shows("end of the recording: done", ".messages")
    page.fill("bag", kept)
    recorded = open_bag(panel.folder / "bag").messages("/left/deflection", SAMPLE_TYPE)
    assert len(recorded) > 100


def test_the_gripper_goes_where_it_is_told(page, ros):
    gripper = ros.gripper()
    page.fill("opening", "35")
    page.press("move")
    # Where it ended it says; how near that is on a busy machine is another test's.
    page.shows(re.compile(r"opening 35 µm: .+ opening 3[45]\.\d+ µm, force"), ".messages")
    page.press("gripper_home")
    page.shows("gripper: home: ", ".messages")
    assert gripper.law.rest_opening > 0.0
    # Fingers that hold a position feel no force, and the gripper says so.
    page.press("grasp")
    page.shows("goal refused: finger 'left' feels no force", ".messages .refused")


def test_a_fault_is_shown_and_left_by_the_button(page, ros, left):
    """Two answers per sample are a fault that is latched; see the safety page."""
    stranger = ros.node.create_publisher(Sample, "/left/command", SAMPLE)
    ros.wait(lambda: stranger.get_subscription_count() > 0, lambda: "nobody hears '/left/command'")
    left.wait_for(lambda: left.state.phase == FingerState.FAULT)
    page.shows("fault", ".cards")
    ros.node.destroy_publisher(stranger)
    page.choose("/left")
    # It is a fault again as long as the stranger is still known.
    while left.state.phase != FingerState.RUNNING:
        page.press("reset")
        page.shows("/left: reset: ", ".messages")
        with suppress(ClientError):
            left.wait_for(lambda: left.state.phase == FingerState.RUNNING)
    page.shows("running", ".cards")


def test_traces_are_drawn_twenty_times_a_second_where_the_machine_allows_it(page):
    """What the panel takes down is looked at by its times; how often a browser draws is its machine's affair."""
    page.shows("running", ".cards")
    clock = page.trace("/left")["clock"]
    assert 1.0 / np.median(np.diff(clock)) >= 20.0


@pytest.fixture(scope="module")
def onlooker(panel, browser, tmp_path_factory):
    running = Panel(tmp_path_factory.mktemp("onlooker"))
    yield running
    running.end()


def test_without_control_there_is_nothing_to_drive_with(onlooker, browser, left):
    page = Page(browser.new_context(), onlooker.address)
    page.shows("read-only")
    page.shows("/left", ".cards")
    buttons = page.again(page.page.get_by_role("button").all_inner_texts)
    assert set(buttons) <= {"10 s", "1 min", "10 min", "Freeze"}
    # Nor is there anything in the server that a page made by hand could speak to.
    names = page.ask(
        "() => Array.from(Bokeh.documents[0]._all_models.values()).map(model => model.name)"
    )
    assert {"set_point", "stop", "go", "wave"} & set(names) == set()
    later = page.trace("/left")["clock"][-1] + 1.0
    page.ask(
        f"""() => Bokeh.documents[0].get_model_by_name("source/left")?.data.clock.at(-1) > {1e3 * later}"""
    )
    assert page.errors == []


def test_pages_of_others_are_not_listened_to(panel):
    host, _, port = panel.address.removeprefix("http://").strip("/").partition(":")
    status = {}
    for origin in (f"http://{host}:{port}", "http://example.com"):
        connection = http.client.HTTPConnection(host, int(port), timeout=TIMEOUT)
        connection.request(
            "GET", "/ws",
            headers={
                "Upgrade": "websocket", "Connection": "Upgrade", "Origin": origin,
                "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "c2l4dGVlbiBieXRlcyEhIQ==",
            },
        )  # fmt: skip
        status[origin] = connection.getresponse().status
        connection.close()
    assert status["http://example.com"] == 403
    assert status[f"http://{host}:{port}"] != 403


@pytest.mark.parametrize("width, height", [(1400, 900), (390, 844)], ids=["desktop", "phone"])
@pytest.mark.parametrize("scheme, dark", [("light", False), ("dark", True)], ids=["light", "dark"])
def test_page_fits_the_screen_in_light_and_dark(panel, browser, width, height, scheme, dark):
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    page = Page(context, panel.address)
    page.shows("closed loop", ".cards")
    assert page.page.evaluate("document.documentElement.scrollWidth") == width
    page.page.evaluate("window.scrollTo(0, document.body.scrollHeight)")
    box = page.page.locator(".stop button").bounding_box()
    assert 0 <= box["y"] < height - box["height"] and box["x"] + box["width"] <= width
    paper = page.page.evaluate("getComputedStyle(document.body).backgroundColor")
    brightness = np.mean([int(part) for part in paper[4:-1].split(",")])
    assert (brightness < 128) == dark
    context.close()
