# SPDX-License-Identifier: Apache-2.0
"""A page to look at one or two fingers and, with --control, to drive them and their gripper, in any browser.

Prints the address of the page when it is there; Ctrl-C ends it and leaves the fingers as they are. All that the page
needs comes from this program, so it works where there is no internet.

Exit code: 0 ended by a signal, 1 the page cannot be served, 2 unusable arguments.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import math
import sys
import time
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.server.connection import ServerConnection
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.netutil import bind_sockets

from piezo_control.nodes.client import (
    ClientError,
    Finger,
    Gripper,
    Ros,
    Setup,
    connect,
    full_namespace,
)
from piezo_control.nodes.overview import ROWS, complaints, ended, figure, in_order
from piezo_control.options import port, positive
from piezo_control.panel.cards import Card, Gauge, Message
from piezo_control.panel.history import History
from piezo_control.panel.page import build
from piezo_control.panel.traces import COLORS, LOOKS, SIGNALS, SPANS, known
from piezo_control.start import stop_at_signals
from piezo_gripper_msgs.action import Grip
from piezo_gripper_msgs.msg import FingerState

MOST_FINGERS = 2
REVIEW_PERIOD = 2.0  # s
END_PERIOD = 100  # ms: how soon a signal is seen
MESSAGES = 12
WORKERS = 8
ELSEWHERE = ("does", "deflection [µm]", "voltage [V]", "rate [Hz]")  # of ROWS, on the card
LOCAL = ("localhost", "127.0.0.1")
USUAL_REACH = 20e-6  # m, of the slider as long as no finger has told its own


class Bench:
    """The fingers and the gripper of a panel: what is known of them, and what was asked of them.

    It belongs to the thread of the event loop; whatever waits for an answer does so in others.
    """

    def __init__(self, ros: Ros, names: list[str], control: bool) -> None:
        self._ros = ros
        self._names = names
        self.control = control
        """Whether it lets itself be driven."""
        self.fingers: dict[str, Finger] = {}
        self.gripper: Gripper | None = None
        self.histories: dict[str, History] = {}
        self.messages: deque[Message] = deque(maxlen=MESSAGES)
        """The newest first."""
        self._setups: dict[str, Setup | None] = {}
        self._workers = ThreadPoolExecutor(WORKERS, "command")
        self._reviewers = ThreadPoolExecutor(1, "review")
        self._stoppers = ThreadPoolExecutor(WORKERS, "stop")  # a stop waits for no other command

    def close(self) -> None:
        """Wait for nothing any more."""
        self._ros.closing.set()
        for workers in (self._workers, self._reviewers, self._stoppers):
            workers.shutdown(cancel_futures=True)

    # --- what is known ----------------------------------------------------------------------------------

    def look(self) -> None:
        """Take note of the newest sample of each finger."""
        clock = time.time()
        for name, finger in self.fingers.items():
            history = self.histories[name]
            row = dict.fromkeys(SIGNALS, math.nan)
            if finger.state and not finger.is_silent:
                row |= finger.newest()._asdict()
                row["rate"] = history.rate("number", "clock", LOOKS)
                row["jitter"] = finger.state.jitter or math.nan
            row["clock"] = clock
            history.append([row[signal] for signal in SIGNALS])

    async def find_fingers(self) -> None:
        """Take in the fingers that are new."""
        for name in self._names or self._ros.fingers():
            if name not in self.fingers and len(self.fingers) < MOST_FINGERS:
                self.histories[name] = History(SIGNALS, max(SPANS.values()) * LOOKS)
                self.fingers[name] = self._ros.finger(name)

    async def find_gripper(self) -> None:
        """Take in a gripper, if there is one."""
        if self.gripper is None and (found := self._ros.grippers()):
            self.gripper = await self._answer(partial(self._ros.gripper, found[0]), None)

    async def learn(self) -> None:
        """Ask every finger what it is set to."""
        await asyncio.gather(*(self._learn(name, f) for name, f in self.fingers.items()))

    async def _learn(self, name: str, finger: Finger) -> None:
        if finger.state and not finger.is_silent:
            self._setups[name] = await self._answer(finger.setup, self._setups.get(name))

    async def _answer(self, ask: Callable[[], Any], otherwise: Any) -> Any:
        """Return what somebody answers in time, or `otherwise`: it will be asked again."""
        try:
            return await in_thread(self._reviewers, ask)
        except (ClientError, ValueError):
            return otherwise

    def parts(self) -> tuple[Any, ...]:
        """Return what a page is made for: it is opened anew when that has changed."""
        driven = (self.gripper is not None, self.reach()) if self.control else ()
        return tuple(self.fingers), known(self.histories.values()), driven

    def reach(self) -> tuple[float, float]:
        """Return the lowest and highest command (m) that every finger follows."""
        setups = self._known_setups()
        low = max((setup.command_low for setup in setups), default=-USUAL_REACH)
        return low, min((setup.command_high for setup in setups), default=USUAL_REACH)

    def limits(self) -> dict[str, tuple[float, float]]:
        """Return the limits to draw, by figure: those that hold for every finger."""
        setups = self._known_setups()
        if not setups:
            return {}
        low, high = self.reach()
        voltage_low = max(setup.voltage_low for setup in setups)
        voltage_high = min(setup.voltage_high for setup in setups)
        return {"position": (low * 1e6, high * 1e6), "voltage": (voltage_low, voltage_high)}

    def _known_setups(self) -> list[Setup]:
        return [setup for setup in self._setups.values() if setup]

    def cards(self) -> list[Card]:
        """Return what every finger does."""
        return [self._card(*one) for one in zip(self.fingers, self.fingers.values(), COLORS)]

    def _card(self, name: str, finger: Finger, color: str) -> Card:
        reading, setup = finger.newest(), self._setups.get(name)
        deflection = Gauge("Deflection", "µm", reading.deflection * 1e6)
        voltage = Gauge("Voltage", "V", reading.voltage)
        rate = self.histories[name].rate("number", "clock", LOOKS)
        figures = [(t, cell(finger, reading)) for t, cell in ROWS.items() if t not in ELSEWHERE]
        loop, limits = "", []
        if setup:
            deflection = replace(
                deflection, low=setup.command_low * 1e6, high=setup.command_high * 1e6
            )
            voltage = replace(voltage, low=setup.voltage_low, high=setup.voltage_high)
            loop = f"closed loop, {setup.controller}" if setup.is_closed else "open loop"
            limits = [
                ("slew rate", f"{setup.slew_limit * 1e-3:g} V/ms"),
                ("force", "not felt" if math.isnan(setup.force_limit) else f"{setup.force_limit * 1e3:g} mN"),
            ]  # fmt: skip
        return Card(
            name=name,
            color=color,
            tone=tone(finger),
            words=finger.words(),
            loop=loop,
            gauges=[deflection, voltage],
            figures=[*figures, ("rate [samples/s]", figure(rate, 1.0, 0))],
            limits=limits,
        )

    def complaints(self) -> list[str]:
        """Return what is wrong with any node, in its own words."""
        return complaints(self._ros)

    # --- what is asked ----------------------------------------------------------------------------------

    def ask(self, what: str, act: Callable[[], Any]) -> None:
        """Let `act` do `what` in its own time; what it returns, or why it was refused, becomes a message."""
        self._ask(what, act, self._workers)

    def grip(self, what: str, act: Callable[[Gripper], Any]) -> None:
        """Let the gripper do something."""
        if self.gripper is None:
            self.refuse(f"gripper: {what}", "no gripper is running in this ROS domain")
        else:
            self.ask(f"gripper: {what}", partial(act, self.gripper))

    def stop(self) -> None:
        """Bring every finger to rest, whatever else is being waited for."""
        for name, finger in self.fingers.items():
            self._ask(f"{name}: stop", finger.stop, self._stoppers)

    def refuse(self, what: str, why: str) -> None:
        """Say that something cannot be done."""
        self.messages.appendleft(Message(time.strftime("%H:%M:%S"), what, why, is_refused=True))

    def _ask(self, what: str, act: Callable[[], Any], workers: Executor) -> None:
        message = Message(time.strftime("%H:%M:%S"), what)
        self.messages.appendleft(message)
        IOLoop.current().add_callback(self._carry_out, message, act, workers)

    async def _carry_out(self, message: Message, act: Callable[[], Any], workers: Executor) -> None:
        message.outcome, message.is_refused = "failed, the log of panel says why", True
        try:
            result = await in_thread(workers, act)
        except (ClientError, ValueError) as error:
            message.outcome = str(error)
        else:
            message.outcome = ended(result) if isinstance(result, Grip.Result) else result or "done"
            message.is_refused = False


async def in_thread(workers: Executor, act: Callable[[], Any]) -> Any:
    """Return what `act` returns in one of the threads."""
    return await asyncio.get_running_loop().run_in_executor(workers, act)


async def repeat(act: Callable[[], Awaitable[None]]) -> None:
    """Do the same again and again; what goes wrong is logged, and tried again."""
    while True:
        try:
            await act()
        except Exception:  # whatever it was, a page that learns nothing more would look as ever
            logging.getLogger("panel").exception("the panel goes on after")
        await asyncio.sleep(REVIEW_PERIOD)


def tone(finger: Finger) -> str:
    """Return how a finger is, in the words of `Card.tone`."""
    if finger.state is None or finger.is_silent:
        return "gone"
    if finger.state.phase == FingerState.FAULT:
        return "bad"
    return "good" if in_order(finger) else "busy"


def main() -> int:
    """Serve the page until a signal comes, and return the exit code."""
    arguments = parse(sys.argv[1:])
    logging.getLogger("bokeh").setLevel(logging.ERROR)  # a browser that is closed is no warning
    stop = stop_at_signals()
    loop = IOLoop.current()
    with connect(arguments.timeout, stop) as ros:
        bench = Bench(ros, arguments.finger, arguments.control)
        try:
            server = serve(bench, arguments.host, arguments.port, loop)
        except (OSError, UnicodeError) as error:
            print(f"panel: no page on {arguments.host}:{arguments.port}: {error}", file=sys.stderr)
            return 1
        mode = "with controls" if arguments.control else "read-only; --control lets it drive"
        print(f"panel: http://{arguments.host}:{server.port}/ ({mode})", flush=True)
        PeriodicCallback(bench.look, 1000 / LOOKS).start()
        PeriodicCallback(lambda: loop.stop() if stop.is_set() else None, END_PERIOD).start()
        for act in (bench.find_fingers, bench.find_gripper, bench.learn):
            loop.add_callback(repeat, act)
        server.start()
        loop.start()
        server.stop()
        bench.close()
    return 0


class Pages(BokehTornado):
    """Bokeh's server of pages, which asks one that it has given up for its session when the browser closes it."""

    def client_lost(self, connection: ServerConnection) -> None:
        super().client_lost(connection)
        connection._socket.connection = None  # what it is told of its end from now on is no news


def serve(bench: Bench, host: str, port: int, loop: IOLoop) -> BaseServer:
    """Return a server of the page of `bench`; it listens only to pages that it has sent itself.

    Raises OSError where the address is not this machine's or the port is taken.
    """
    sockets = bind_sockets(port, host)
    names = {host, "localhost", "127.0.0.1"} if host in LOCAL else {host}
    port = sockets[0].getsockname()[1]
    page = Application(FunctionHandler(partial(build, bench=bench)))
    application = Pages({"/": page}, extra_websocket_origins=[f"{n}:{port}" for n in names])
    http = HTTPServer(application)
    http.add_sockets(sockets)
    return BaseServer(loop, application, http)


def parse(words: list[str]) -> argparse.Namespace:
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--control", action="store_true", help="let the page drive, not only show")
    parser.add_argument(
        "-f", "--finger", action="append", default=[], metavar="NAMESPACE",
        help=f"of the finger; {MOST_FINGERS} at most. Without it, those that are there",
    )  # fmt: skip
    parser.add_argument(
        "--host", default="localhost", metavar="NAME",
        help="of this machine, as browsers shall call it (localhost: for this machine alone)",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=port, default=5006, metavar="N", help="0: any that is free (5006)"
    )  # fmt: skip
    parser.add_argument(
        "--timeout", type=positive, default=5.0, metavar="S", help="for every answer (5)"
    )
    arguments = parser.parse_args(words)
    if len(arguments.finger) > MOST_FINGERS:
        parser.error(f"{len(arguments.finger)} fingers are named, a page shows {MOST_FINGERS}")
    try:
        arguments.finger = [full_namespace(name) for name in arguments.finger]
    except ValueError as error:
        parser.error(str(error))
    return arguments


if __name__ == "__main__":
    sys.exit(main())
