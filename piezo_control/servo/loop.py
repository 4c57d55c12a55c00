# SPDX-License-Identifier: Apache-2.0
"""The servo: the laws of a finger between a sensor and an amplifier, in a thread of its own, in real time.

The compiled loop shares arrays with the rest of the process and nothing else: it reads references and orders,
and writes what it measured into a ring. It never waits for anybody.
"""

from __future__ import annotations

import atexit
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from piezo_control.compiled import compiled
from piezo_control.design.preview import asked
from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.parameters import ParameterError
from piezo_control.profile import Profile, Signal
from piezo_control.safety import FAULT, NORMAL, RAMPING
from piezo_control.servo.card import read_card as read
from piezo_control.servo.card import write_card as write
from piezo_control.servo.clock import Clock, become_real_time, begin, clock_of, now, wait_for_edge
from piezo_control.servo.driver import FRESH, Driver, DriverError, applied
from piezo_control.servo.law import (
    CAUSES,
    DEVICE,
    NO_CAUSE,
    NOT_WRITTEN,
    SENSOR_SILENT,
    STOPPED,
    TEMPERATURE,
    Feeling,
    Laws,
    Settings,
    Watch,
    empty_controller,
    follow,
    judge_time,
    judge_write,
    laws_of,
    put_controller,
    rearm,
    servo_step,
    settings_of,
    trip,
    watch_at_rest,
)
from piezo_control.servo.parameters import ServoParameters
from piezo_control.touch import push_of

AHEAD = 1.0  # s: how far references are laid out in advance
MARGIN = 5  # samples that a new reference leaves to the loop, which is about to read them
KEPT = 5.0  # s of samples that wait for a reader
WAIT = 0.1  # s, and the hold time: a driver that needs longer for one sample does not come back


class Orders(NamedTuple):
    """What the loop is asked for; arrays of one integer."""

    stop: np.ndarray
    reset: np.ndarray  # counts the resets asked for
    controller: np.ndarray  # which one to use
    fault: np.ndarray  # cause of a fault that is not the loop's to see; NO_CAUSE: none


class References(NamedTuple):
    """A ring by sample number of references (m) and of what the controller is asked for them, ahead of its lag.

    `until` is the first number not laid out.
    """

    values: np.ndarray
    asked: np.ndarray
    until: np.ndarray


class Log(NamedTuple):
    """A ring of what was measured and done; `count` rows were written since the start."""

    count: np.ndarray
    number: np.ndarray
    instant: np.ndarray  # ns of the monotonic clock, of the edge
    late: np.ndarray  # ns after the edge
    reference: np.ndarray
    deflection: np.ndarray
    command: np.ndarray
    voltage: np.ndarray
    push: np.ndarray


class Loop(NamedTuple):
    """Everything that the compiled loop works on."""

    settings: Settings
    laws: Laws
    watch: Watch
    clock: Clock
    orders: Orders
    references: References
    log: Log
    amplifier_gain: float
    amplifier_zero: float
    at_next_edge: bool


def run(loop: Loop, device: Any) -> bool:
    """Run the loop on a device until it is asked to stop and the voltage is at rest.

    A device that takes no voltage ends it too, after the hold time. `read` and `write` are those of a card; :func:`loop_with` puts those of another driver in their place.

    Returns True where no voltage went out for the hold time and a period, as on a machine that stops the whole process
    or of a card that takes none: the hardware's own watchdog may have acted, and the voltage that is due does not go out
    before somebody has looked where the finger is.
    """
    clock = loop.clock
    resets = loop.orders.reset[0]
    voltage = before = loop.laws.feedforward_state.hysteresis.voltage[0]
    if clock.edge[0] == 0:
        begin(clock)
    put_out = now(clock)
    hold = round((loop.settings.hold_samples + 1.0) * clock.period)  # ns
    while loop.orders.stop[0] == 0 or (
        loop.watch.phase[0] != FAULT and loop.watch.unwritten[0] <= loop.settings.hold_samples
    ):
        missed = clock.missed[0]
        late = wait_for_edge(clock)
        if loop.orders.reset[0] != resets:
            resets = loop.orders.reset[0]
            # Of a finger that runs there is nothing to leave, and one that feels would take the push of now for none.
            if loop.watch.cause[0] != NO_CAUSE:
                rearm(loop.watch)
        if loop.watch.cause[0] == NO_CAUSE:
            if loop.orders.stop[0] != 0:
                trip(loop.watch, STOPPED, 0.0)
            elif loop.orders.fault[0] != NO_CAUSE:
                trip(loop.watch, loop.orders.fault[0], 0.0)
        judge_time(loop.settings, loop.watch, late * 1e-9, float(clock.missed[0] - missed))
        if loop.at_next_edge:
            if now(clock) - put_out > hold:
                follow(loop.laws, before)
                return True
            out = loop.amplifier_zero + voltage / loop.amplifier_gain
            written = write(device, out, clock.edge[0])
            if written == FRESH:
                put_out = now(clock)
            judge_write(loop.settings, loop.laws, loop.watch, written, before)
        status = read(device, clock.edge[0])
        # The output moves somewhere between call and return of `write`. The next one is called no sooner than this.
        soonest = now(clock)
        if loop.at_next_edge:
            soonest = max(soonest, clock.edge[0] + clock.period)
        share = min(1.0, (soonest - put_out) / clock.period)
        before = loop.laws.feedforward_state.hysteresis.voltage[0]
        voltage = sample(loop, status, device.reading, share, late)
        if not loop.at_next_edge:
            if now(clock) - put_out > hold:
                follow(loop.laws, before)
                return True
            out = loop.amplifier_zero + voltage / loop.amplifier_gain
            written = write(device, out, clock.edge[0])
            if written == FRESH:
                put_out = now(clock)
            judge_write(loop.settings, loop.laws, loop.watch, written, before)
    if loop.at_next_edge:
        follow(loop.laws, before)  # what was to go out next never does
    return False


def sample(loop: Loop, status: int, reading: np.ndarray, share: float, late: int) -> float:
    """Return the voltage (V) that answers a reading, and take everything down."""
    number = loop.clock.number[0]
    references, log = loop.references, loop.log
    place = min(number, references.until[0] - 1) % len(references.values)
    voltage = servo_step(
        loop.settings,
        loop.laws,
        loop.watch,
        loop.orders.controller[0],
        status,
        reading[0],
        reading[1],
        references.asked[place],
        share,
    )
    row = log.count[0] % len(log.number)
    log.number[row] = number
    log.instant[row] = loop.clock.edge[0]
    log.late[row] = late
    log.reference[row] = references.values[place]
    log.deflection[row] = math.nan
    if status == FRESH:
        c = loop.settings
        log.deflection[row] = c.sensor_scale * (reading[0] - c.sensor_zero)
    log.command[row] = loop.watch.command[0]
    log.voltage[row] = voltage
    feeling = loop.laws.feeling
    log.push[row] = push_of(feeling.touch, feeling.touch_state)
    log.count[0] += 1
    return voltage


def loop_with(driver: Driver) -> Callable[[Loop, Any], bool]:
    """Return :func:`run` with the names `read` and `write` bound to those of a driver, compiled."""
    names = {**run.__globals__, "read": driver.read, "write": driver.write}
    return compiled(FunctionType(run.__code__, names, run.__name__))


@dataclass(frozen=True)
class Samples:
    """Consecutive samples of the loop; `instant` and `late` in s (monotonic clock), m, V and N.

    A deflection that did not come in time is NaN; a number that is left out was missed. `push` is of a servo that feels.
    """

    number: np.ndarray
    instant: np.ndarray
    late: np.ndarray
    reference: np.ndarray
    deflection: np.ndarray
    command: np.ndarray
    voltage: np.ndarray
    push: np.ndarray

    def __len__(self) -> int:
        return len(self.number)


class Servo:
    """A finger's loop on a device, from the outside; nothing of it waits for the loop but `stop`.

    Parameters
    ----------
    driver : Driver
        An open device; closed by `stop`.
    parameters, feedback, feedforward
        The loop runs at the sample time of the controller `feedback`.
    priority, cpu, spin
        Of the loop's thread: of SCHED_FIFO (0: ordinary), the CPU to stay on (-1: any), and how long
        before an edge it stops sleeping (s).
    feeling : Feeling, optional
        With it the loop follows its reference no further than the force limit lets it, in place of the controller.
    stands_at : float, optional
        What a card whose driver does not say it puts out, in its unit, as far as the caller knows; NaN: nobody does.

    Raises ParameterError for a controller that does not fit or voltages that the card cannot put out, DriverError for a card that puts out what it cannot.

    Attributes
    ----------
    begins_at : float
        What the card puts out before the first voltage (V), from where the loop leads it to rest. NaN: nobody
        says, so it has to be at rest.
    """

    def __init__(
        self,
        driver: Driver,
        parameters: ServoParameters,
        feedback: FeedbackParameters,
        feedforward: FeedforwardParameters,
        priority: int = 0,
        cpu: int = -1,
        spin: float = 5e-5,
        feeling: Feeling | None = None,
        stands_at: float = math.nan,
    ) -> None:
        parameters.check_output(feedforward)
        self.driver = driver
        self.parameters = parameters
        self.feedback = feedback
        self.sample_time = h = feedback.sample_time
        self._thread_options = (priority, cpu)
        self.complaint = ""
        law = Feedforward(feedforward, h)
        self._scale = parameters.amplifier_gain, parameters.amplifier_zero
        self.begins_at = applied(driver, *self._scale, stands_at)
        if not math.isnan(self.begins_at):
            law.follow(self.begins_at)
        ahead, kept = (1 << math.ceil(math.log2(max(span / h, 64))) for span in (2 * AHEAD, KEPT))
        self._loop = Loop(
            settings=settings_of(parameters, feedforward, h, feels=feeling is not None),
            laws=laws_of(feedback, law, feeling),
            watch=watch_at_rest(),
            clock=clock_of(h, min(spin, 0.8 * h)),
            orders=Orders(*(np.zeros(1, dtype=np.int64) for _ in Orders._fields)),
            references=References(np.zeros(ahead), np.zeros(ahead), np.zeros(1, dtype=np.int64)),
            log=Log(
                np.zeros(1, dtype=np.int64),
                *(np.full(kept, 0, dtype=np.int64) for _ in range(3)),
                *(np.full(kept, 0.0) for _ in range(5)),
            ),
            amplifier_gain=parameters.amplifier_gain,
            amplifier_zero=parameters.amplifier_zero,
            at_next_edge=parameters.write == "next_edge",
        )
        self._force_limit = float(self._loop.laws.feeling.max_force[0])
        self._run = loop_with(driver)
        self._taken = 0
        self._seen_at = (-1, 0.0)  # the edge that the loop was last found at, and since when
        self.lost = 0
        # The end of the program, whatever ends it, ends the loop with the voltage at rest.
        self._thread = threading.Thread(target=self._work, name="servo", daemon=True)
        self.refer(Profile([0.0], [0.0]))

    def start(self) -> None:
        """Compile the loop, if that was not done before, and start it."""
        self._loop.orders.stop[0] = 1
        self._loop.watch.phase[0] = FAULT
        self._run(self._loop, self.driver.device)  # returns at once: told to stop, and at rest
        self._loop.orders.stop[0] = 0
        self._loop.clock.edge[0] = 0  # it begins when it runs
        self._look_where_it_is()  # compiling took its time
        if self.phase == FAULT and self.cause_code == NO_CAUSE:
            self._loop.watch.phase[0] = NORMAL
        self._thread.start()
        atexit.register(self.stop)

    def _work(self) -> None:
        self.complaint = become_real_time(*self._thread_options)
        while self._run(self._loop, self.driver.device):
            self._look_where_it_is()

    def _look_where_it_is(self) -> None:
        """Let the models go where the card says that it is; a finger that was at rest is led there from elsewhere."""
        watch = self._loop.watch
        try:
            voltage = applied(self.driver, *self._scale)
        except DriverError:
            trip(watch, DEVICE, 0.0)
            return
        if not math.isnan(voltage):
            follow(self._loop.laws, voltage)
        if self.phase == FAULT and self.voltage != self.rest:
            watch.phase[0] = RAMPING

    @property
    def is_running(self) -> bool:
        """Whether the loop runs; until it is stopped it does, at rest after a fault."""
        return self._thread.is_alive()

    @property
    def stuck(self) -> str:
        """Say that the loop does not go on, because its driver does not come back; empty: it does.

        The time counts from the first look at this that found the loop where it is. A machine that stops the whole
        process stops who looks, too, and is not taken for a driver that does not come back.
        """
        span = self.parameters.hold_time + WAIT
        now = time.monotonic()
        edge = int(self._loop.clock.edge[0])
        if edge != self._seen_at[0]:
            self._seen_at = edge, now
        silence = now - self._seen_at[1]
        if not self.is_running or self.number < 0 or silence <= span + self.sample_time:
            return ""
        return (
            f"the loop does not go on: the driver has not come back for more than {span:g} s; the voltage stays where "
            f"it is, at {self.voltage:g} V"
        )

    def stop(self) -> str:
        """Bring the voltage to rest, end the loop and close the device; interrupted, the program's end goes on with it.

        Returns why the finger was not left at rest, empty if it was. A loop that its driver does not let go on keeps the
        device; it ends at rest once the driver comes back, and another call of this closes it.
        """
        self._loop.orders.stop[0] = 1
        waits = 0  # counted, not timed: a process that stands still does not wait
        while self.is_running:
            edge = self._loop.clock.edge[0]
            self._thread.join(max(WAIT, self.sample_time))
            waits = waits + 1 if edge == self._loop.clock.edge[0] else 0
            if waits >= 10 and (stuck := self.stuck):
                return stuck
        atexit.unregister(self.stop)
        left = ""
        if self._thread.ident is not None and (
            self.voltage != self.rest or self.cause_code == DEVICE
        ):
            left = f"{self.cause}: left at {self.voltage:g} V, rest is {self.rest:g} V"
        self.driver.close()
        return left

    def feel(self, temperature_degc: float) -> None:
        """Tell the models the temperature; NaN is one that is missing: the body keeps the one it has."""
        self._loop.laws.feeling.temperature[0] = temperature_degc

    def give_up_without_temperature(self) -> None:
        """End at rest, because the temperature cannot be believed."""
        self._loop.orders.fault[0] = TEMPERATURE

    def reset(self) -> None:
        """Leave a latched fault; the controller takes over from where the voltage is.

        Raises ParameterError for a finger that feels and is not at rest yet: it may still push.
        """
        if self._loop.settings.feels and self.phase == RAMPING and self.cause_code != NO_CAUSE:
            raise ParameterError(
                "the voltage is on its way to rest, and the tip may push: reset it there"
            )
        self._loop.orders.fault[0] = NO_CAUSE
        self._loop.orders.reset[0] += 1

    def _room_for(self, feedback: FeedbackParameters) -> int:
        """Return which of the two controllers can be replaced; ParameterError: none, or not by this one."""
        if feedback.sample_time != self.sample_time:
            raise ParameterError(
                f"controller '{feedback.name}' was made for {feedback.sample_time:g} s, the loop runs at "
                f"{self.sample_time:g} s"
            )
        watch = self._loop.watch
        other = 1 - int(self._loop.orders.controller[0])
        # No controller is in use by a finger at rest, or on its way there: the one that is asked for takes over then.
        if self.is_running and watch.phase[0] < RAMPING and watch.in_use[0] == other:
            raise ParameterError("the last change of the controller is not through yet: try again")
        return other

    def check_controller(self, feedback: FeedbackParameters) -> None:
        """Raise ParameterError if :meth:`change_controller` would."""
        self._room_for(feedback)
        put_controller(empty_controller(), feedback)

    def change_controller(self, feedback: FeedbackParameters) -> None:
        """Let another controller take over between two samples, with the command where it is.

        Raises ParameterError when it was made for another sample time, or cannot be taken.
        """
        other, orders = self._room_for(feedback), self._loop.orders
        put_controller(self._loop.laws.controllers[other], feedback)
        self.feedback = feedback
        orders.controller[0] = other
        self._ask()

    @property
    def number(self) -> int:
        """Number of the last sample, -1 before the first."""
        return int(self._loop.clock.number[0])

    def refer(self, signal: Signal, max_force: float = math.inf) -> None:
        """Follow a reference (m over s since sample 0) from a few samples ahead of the present one on.

        A servo that feels pushes with `max_force` (N) at most, and with no more than its own limit.
        """
        self._signal = signal
        self._loop.laws.feeling.max_force[0] = min(max_force, self._force_limit)
        self._ask()

    def _ask(self) -> None:
        """Lay out anew what the controller is asked."""
        feels = self._loop.settings.feels
        self._asked = self._signal if feels else asked(self._signal, self.feedback)
        self._lay_out(self.number + MARGIN if self.is_running else 0)

    def look_ahead(self) -> None:
        """Lay out the references of the next second; to be called several times in each."""
        self._lay_out(int(self._loop.references.until[0]))

    def _lay_out(self, first: int) -> None:
        ring = self._loop.references
        last = self.number + round(AHEAD / self.sample_time)
        if last <= first:
            return
        numbers = np.arange(max(first, last - len(ring.values) // 2), last)
        places, times = numbers % len(ring.values), numbers * self.sample_time
        ring.values[places] = self._signal.at(times)
        is_asked = self._asked is self._signal
        ring.asked[places] = ring.values[places] if is_asked else self._asked.at(times)
        ring.until[0] = last

    def samples(self) -> Samples:
        """Return what the loop has written since this was asked last; what was not kept is counted as lost."""
        log = self._loop.log
        count = int(log.count[0])
        kept = len(log.number) - 64  # rows that are written meanwhile are not among the newest
        first = max(self._taken, count - kept)
        self.lost += first - self._taken
        rows = np.arange(first, count) % len(log.number)
        self._taken = count
        number, instant, late, *signals = (ring[rows] for ring in log[1:])
        return Samples(number, instant * 1e-9, late * 1e-9, *signals)

    @property
    def phase(self) -> int:
        """NORMAL, HOLDING, RAMPING or FAULT of :mod:`piezo_control.safety`."""
        return int(self._loop.watch.phase[0])

    @property
    def cause_code(self) -> int:
        """What latched the fault: NO_CAUSE or another one of `CAUSES`."""
        return int(self._loop.watch.cause[0])

    @property
    def cause(self) -> str:
        """What latched the fault, in words; empty if nothing did."""
        code = self.cause_code
        if code == NO_CAUSE:
            return ""
        text = CAUSES[code](float(self._loop.watch.cause_value[0]), self.parameters)
        said = self.driver.error() if code in (DEVICE, SENSOR_SILENT, NOT_WRITTEN) else ""
        return f"{text}: {said}" if said else text

    @property
    def voltage(self) -> float:
        """The last voltage (V) that the device took."""
        return float(self._loop.laws.feedforward_state.hysteresis.voltage[0])

    @property
    def rest(self) -> float:
        """The voltage (V) at which the finger is left alone."""
        return self._loop.settings.voltage.rest

    @property
    def clipped(self) -> int:
        """Number of samples at which the voltage or slew limit acted."""
        return int(self._loop.laws.feedforward_state.clipped[0])

    @property
    def push(self) -> float:
        """Force (N) that pushes the tip back, as estimated by a servo that feels."""
        feeling = self._loop.laws.feeling
        return float(push_of(feeling.touch, feeling.touch_state))

    @property
    def faults(self) -> int:
        """Number of times that something was wrong since the last reset."""
        return int(self._loop.watch.times[0])

    @property
    def missed(self) -> int:
        """Number of periods that were missed."""
        return int(self._loop.clock.missed[0])

    @property
    def lateness(self) -> np.ndarray:
        """How often a period began so many microseconds late (:mod:`piezo_control.servo.clock`)."""
        return self._loop.clock.lateness.copy()
