# SPDX-License-Identifier: Apache-2.0
"""What moves fingers and a gripper from a page: fields, buttons, and what each of them asks for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from bokeh.events import ValueSubmit
from bokeh.models import Button, RadioButtonGroup, Select, Slider, TextInput

from piezo_control.feedback import known_controllers
from piezo_control.gripper import reach
from piezo_control.waveform import SHAPES, Waveform

if TYPE_CHECKING:
    from piezo_control.nodes.client import Finger
    from piezo_control.nodes.panel import Bench

Act = Callable[[], Any]
STEPS = {"−1": -1.0, "−0.1": -0.1, "+0.1": 0.1, "+1": 1.0}
"""Of the set-point, in µm."""
ANSWER_TIME = 0.5  # s in which a reference that was asked for is in force
BOTH = "both"
ENDING = ("sweep", "decaying_sine")
"""Shapes that need a duration."""


def number(text: str, what: str, unit: str) -> float:
    """Return the number in a field.

    Raises ValueError naming the field (`what`), the text that is in it and its unit.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{what} is '{text}', must be a number in {unit}, such as 2.5")
    return value


def text_of(um: float) -> str:
    """Return a length (µm) to the picometre, as a field holds it."""
    return f"{round(um, 6) + 0.0:.10g}"


class Controls:
    """The widgets of a page, and what they ask of the bench.

    What a field holds is looked at when its button is pressed, or Enter in it; what is wrong with it the bench says.
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._references: dict[str, float] = {}  # µm, in force, of the fingers that tell theirs
        self._shown = 0.0  # µm, in field and slider
        self._asked = -math.inf  # s, when a set-point was asked for last
        self.widgets: list[Any] = []
        """With the names that the page has for them."""
        names = list(bench.fingers)
        self._choice = self._add(
            RadioButtonGroup(name="choice", labels=names if len(names) == 1 else [*names, BOTH], active=0)
        )  # fmt: skip
        self._button("stop", "Stop", bench.stop, "danger")
        self._button("start", "Start", lambda: self._each("start", lambda f: f.start()))
        self._button("reset", "Reset faults", lambda: self._each("reset", reset))
        self._add_set_point()
        self._add_waveform()
        self._add_loop()
        self._add_recording()
        self._add_gripper()

    # --- set-point --------------------------------------------------------------------------------------

    def _add_set_point(self) -> None:
        self._set_point = self._field("set_point", "Set-point", "0", "µm", self._go)
        self._button("go", "Go", self._go, "primary")
        for index, (label, step) in enumerate(STEPS.items()):
            self._button(f"step{index}", label, partial(self._step, step))
        low, high = self._bench.reach()
        self._slider = self._add(
            Slider(name="slider", value=0.0, start=low * 1e6, end=high * 1e6, step=0.1, show_value=False)
        )  # fmt: skip
        self._slider.on_change("value_throttled", lambda _, __, um: self._guard("Slider", partial(self._set, um)))  # fmt: skip
        self._button("zero", "Zero", partial(self._set, 0.0))
        self._button("home", "Home", lambda: self._each("home", lambda f: f.home()))

    def follow(self) -> None:
        """Let field and slider show the reference in force, unless somebody is at them."""
        if time.monotonic() < self._asked + ANSWER_TIME:
            return
        told = {name: f.newest().reference * 1e6 for name, f in self._bench.fingers.items()}
        self._references = {name: um for name, um in told.items() if math.isfinite(um)}
        um = self._references.get(self._chosen()[0].namespace, self._shown)
        if self._set_point.value_input == text_of(self._shown):
            self._fill(um)
        if self._slider.value == self._shown:
            self._slider.value = um
        self._shown = um

    def _fill(self, um: float) -> None:
        self._set_point.update(value=text_of(um), value_input=text_of(um))

    def _typed(self) -> float:
        return number(self._set_point.value_input, "the set-point", "µm")

    def _go(self) -> None:
        self._set(self._typed())

    def _step(self, step: float) -> None:
        """Go on from each finger's own reference; from the field where a finger has told none."""
        names = [finger.namespace for finger in self._chosen()]
        told = self._references
        self._set_each(
            {name: (told[name] if name in told else self._typed()) + step for name in names}
        )

    def _set(self, um: float) -> None:
        self._set_each({finger.namespace: um for finger in self._chosen()})

    def _set_each(self, targets: Mapping[str, float]) -> None:
        """Let fingers go to deflections (µm)."""
        self._asked = time.monotonic()
        self._references |= {name: um for name, um in targets.items() if name in self._references}
        self._shown = um = next(iter(targets.values()))
        self._fill(um)
        self._slider.value = um
        for name, um in targets.items():
            self._bench.ask(
                f"{name}: set-point {um:g} µm", partial(self._bench.fingers[name].set, um * 1e-6)
            )

    # --- waveform ---------------------------------------------------------------------------------------

    def _add_waveform(self) -> None:
        self._shape = self._add(Select(name="shape", title="Shape", value="sine", options=list(SHAPES)))  # fmt: skip
        self._shape.on_change("value", lambda _, __, ___: self._suit_shape())
        self._amplitude = self._field("amplitude", "Amplitude", "5", "µm", self._wave)
        self._offset = self._field("offset", "Offset", "0", "µm", self._wave)
        self._frequency = self._field("frequency", "Frequency", "1", "Hz", self._wave)
        self._end_frequency = self._field("end_frequency", "End frequency", "50", "Hz", self._wave)
        self._duration = self._field("duration", "Duration", "0", "s", self._wave)
        self._duration.placeholder = "0: endless"
        self._suit_shape()
        self._button("wave", "Run", self._wave, "primary")
        self._button("end_wave", "End at the offset", self._end_wave)

    def _suit_shape(self) -> None:
        self._end_frequency.visible = self._shape.value == "sweep"
        if self._shape.value in ENDING and self._duration.value == "0":
            self._duration.update(value="10", value_input="10")

    def _wave(self) -> None:
        waveform = Waveform(
            shape=self._shape.value,
            amplitude=number(self._amplitude.value_input, "the amplitude", "µm") * 1e-6,
            frequency=number(self._frequency.value_input, "the frequency", "Hz"),
            offset=number(self._offset.value_input, "the offset", "µm") * 1e-6,
            end_frequency=number(self._end_frequency.value_input, "the end frequency", "Hz"),
            duration=number(self._duration.value_input, "the duration", "s"),
        )
        self._each(
            f"{waveform.shape} of {self._amplitude.value_input} µm, {waveform.frequency:g} Hz",
            lambda finger: finger.wave(waveform),
        )

    def _end_wave(self) -> None:
        self._set(number(self._offset.value_input, "the offset", "µm"))

    # --- loop and recorder ------------------------------------------------------------------------------

    def _add_loop(self) -> None:
        names = known_controllers()
        self._controller = self._add(Select(name="controller", title="Controller", value="robust", options=names))  # fmt: skip
        self._button("close_loop", "Close the loop", lambda: self._control(self._controller.value), "primary")  # fmt: skip
        self._button("open_loop", "Open loop", lambda: self._control("none"))

    def _control(self, controller: str) -> None:
        words = "open loop" if controller == "none" else f"controller {controller}"
        self._each(words, lambda finger: finger.control(controller))

    def _add_recording(self) -> None:
        self._bag = self._field("bag", "Folder, new", "", "", self._record)
        self._bag.placeholder = "named by the time"
        self._button("record", "Record", self._record, "primary")
        self._button("end_record", "End", lambda: self._each("end of the recording", lambda f: f.end_record()))  # fmt: skip

    def _record(self) -> None:
        bag, several = self._bag.value_input, len(self._chosen()) > 1

        def record(finger: Finger) -> str:
            side = finger.namespace.replace("/", "_") if bag and several else ""
            return f"into {finger.record(bag + side)}"

        self._each("recording", record)

    # --- gripper ----------------------------------------------------------------------------------------

    def _add_gripper(self) -> None:
        self._opening = self._field("opening", "Opening", "30", "µm", self._move)
        self._button("move", "Go", self._move, "primary")
        self._button("open", "Open", lambda: self._bench.grip("open", lambda g: g.release()))
        self._button("close", "Close", lambda: self._bench.grip("close", lambda g: g.move(reach(g.law)[0])))  # fmt: skip
        self._force = self._field("grasp_force", "Force", "0.5", "mN", self._grasp)
        self._button("grasp", "Grasp", self._grasp, "primary")
        self._button("gripper_home", "Home", lambda: self._bench.grip("home", lambda g: g.home()))
        self._button("hold", "Hold", lambda: self._bench.grip("hold", lambda g: g.stop()))

    def _move(self) -> None:
        um = number(self._opening.value_input, "the opening", "µm")
        self._bench.grip(f"opening {um:g} µm", lambda gripper: gripper.move(um * 1e-6))

    def _grasp(self) -> None:
        mn = number(self._force.value_input, "the force", "mN")
        self._bench.grip(f"grasp with {mn:g} mN", lambda gripper: gripper.grasp(mn * 1e-3))

    # --- what they have in common -----------------------------------------------------------------------

    def _add(self, widget: Any) -> Any:
        self.widgets.append(widget)
        return widget

    def _field(self, name: str, title: str, value: str, unit: str, act: Act) -> TextInput:
        field = TextInput(
            name=name, title=title, value=value, value_input=value, suffix=unit or None
        )
        field.on_event(ValueSubmit, lambda _: self._guard(title, act))
        return self._add(field)

    def _button(self, name: str, label: str, act: Act, kind: str = "default") -> None:
        button = self._add(Button(name=name, label=label, button_type=kind))
        button.on_click(lambda: self._guard(label, act))

    def _guard(self, what: str, act: Act) -> None:
        try:
            act()
        except ValueError as error:
            self._bench.refuse(what, str(error))

    def _chosen(self) -> list[Finger]:
        """Return the fingers that the next command is for."""
        name = self._choice.labels[self._choice.active]
        fingers = self._bench.fingers
        return list(fingers.values()) if name == BOTH else [fingers[name]]

    def _each(self, what: str, act: Callable[[Finger], Any]) -> None:
        for finger in self._chosen():
            self._bench.ask(f"{finger.namespace}: {what}", partial(act, finger))


def reset(finger: Finger) -> str:
    """Leave the latched faults of a finger and return what its nodes say."""
    return "; ".join(f"{name.rpartition('/')[2]}: {said}" for name, said in finger.reset().items())
