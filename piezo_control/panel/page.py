# SPDX-License-Identifier: Apache-2.0
"""The page: cards, figures and, where a bench lets itself be driven, controls."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from bokeh.document import Document
from bokeh.models import CustomJS, Div, RadioButtonGroup, Toggle
from bokeh.themes import Theme

from piezo_control.panel.cards import TEMPLATES, render
from piezo_control.panel.controls import Controls
from piezo_control.panel.traces import COLORS, DASHES, SPANS, Traces, known

if TYPE_CHECKING:
    from piezo_control.nodes.panel import Bench

DRAW_PERIOD = 40  # ms
WORDS_PERIOD = 250  # ms
LONGEST_WAIT = 2.0  # s for a browser that has lost what it was sent
TITLES = {
    "position": "Position [µm]",
    "voltage": "Voltage [V]",
    "temperature": "Temperature [°C]",
    "force": "Tip force [mN]",
    "rate": "Rate [samples/s on the wall]",
    "jitter": "Jitter of the period [µs]",
}


class Pace:
    """Sends no more traces than a browser can draw: the next only when it says that it has drawn the last."""

    def __init__(self) -> None:
        self.sent = 0
        self._heard = True
        self._last = -math.inf
        self.beat = Div(name="beat", visible=False)
        echo = "requestAnimationFrame(() => { beat.tags = [beat.text] })"
        self.beat.js_on_change("text", CustomJS(args={"beat": self.beat}, code=echo))
        self.beat.on_change("tags", self._hear)

    def lets_go_on(self) -> bool:
        """Say whether it is time for the next, which then counts as sent."""
        now = time.monotonic()
        if not self._heard and now < self._last + LONGEST_WAIT:
            return False
        self._heard, self._last = False, now
        self.sent += 1
        self.beat.text = str(self.sent)
        return True

    def _hear(self, name: str, old: object, new: object) -> None:
        self._heard = True


def build(document: Document, bench: Bench) -> None:
    """Fill the page that a browser has just opened."""
    shown = bench.parts()
    traces = Traces(bench.histories, known(bench.histories.values()))
    cards, messages, complaints = (Div(name=name) for name in ("cards", "messages", "complaints"))
    span = RadioButtonGroup(name="span", labels=list(SPANS), active=0)
    span.on_change("active", lambda _, __, index: traces.show(span.labels[index]))
    freeze = Toggle(name="freeze", label="Freeze")

    def switch(_: str, __: bool, is_frozen: bool) -> None:
        traces.is_frozen = is_frozen
        traces.show(span.labels[span.active])

    freeze.on_change("active", switch)
    controls = Controls(bench) if bench.control and bench.fingers else None
    others = Div(name="others", visible=False)
    others.js_on_change("text", CustomJS(code="location.reload()"))
    for root in [cards, complaints, others, span, freeze, *traces.figures.values()]:
        document.add_root(root)
    for root in [messages, *controls.widgets] if controls else []:
        document.add_root(root)

    def tell() -> None:
        if controls:
            controls.follow()
        cards.text = render("cards", cards=bench.cards())
        messages.text = render("messages", messages=bench.messages)
        wrong = bench.complaints()
        complaints.update(text=render("complaints", complaints=wrong), visible=bool(wrong))
        for figure, limits in bench.limits().items():
            if figure in traces.figures:
                traces.limit(figure, *limits)
        if bench.parts() != shown:
            others.text += (
                "."  # until it is heard: a page that is still being opened misses the first
            )

    pace = Pace()

    def go_on() -> None:
        if pace.lets_go_on():
            traces.go_on()

    tell()
    document.add_root(pace.beat)
    document.add_periodic_callback(go_on, DRAW_PERIOD)
    document.add_periodic_callback(tell, WORDS_PERIOD)
    document.title = "piezo_gripper panel"
    style = TEMPLATES.get_template("widgets.css").render()
    attributes = {
        "UIElement": {"stylesheets": [style]},
        "Widget": {"sizing_mode": "stretch_width", "margin": 0},
    }
    document.theme = Theme(json={"attrs": attributes})
    document.template = TEMPLATES.get_template("page.html.j2")
    document.template_variables.update(
        fingers=list(bench.fingers), gripper=bench.gripper, controls=controls,
        titles={name: TITLES[name] for name in traces.figures}, dashes=DASHES,
        colors=dict(zip(bench.fingers, COLORS, strict=False)),
    )  # fmt: skip
