# SPDX-License-Identifier: Apache-2.0
"""The servo on cards that refuse, hang, die, take their time or were elsewhere, and on fingers with two masters."""

import argparse
import ctypes
import math
import socket
import struct
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from test_servo import PATIENT, TIMEOUT, H, wait

from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.nodes import servo as servo_node
from piezo_control.nodes.qos import LATCHED
from piezo_control.nodes.servo import ServoNode
from piezo_control.parameters import ParameterError, dump
from piezo_control.profile import Profile
from piezo_control.safety import (
    FAULT,
    HOLDING,
    NORMAL,
    RAMPING,
    SafetyParameters,
    VoltageParameters,
)
from piezo_control.servo import commission, law
from piezo_control.servo.clock import Clock, clock_of, now
from piezo_control.servo.driver import (
    FAILED,
    FRESH,
    NONE_IN_TIME,
    DriverError,
    SharedLibrary,
    applied,
    library,
)
from piezo_control.servo.law import judge_write, laws_of, servo_step, settings_of, watch_at_rest
from piezo_control.servo.loop import Samples, Servo
from piezo_control.servo.parameters import ServoParameters
from piezo_gripper_msgs.msg import FingerState
from piezo_sim.plant.amplifier import AmplifierParameters
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.udp_finger import UdpFinger

SLOW = 1e-3  # s
OPEN_LOOP = FeedbackParameters(sample_time=SLOW, command_low=-40e-6, command_high=40e-6)
GAIN = 0.55e-6  # m/V
STRAIGHT = FeedforwardParameters(
    compensator="static_gain", static_gain=GAIN, slew_limit=1e3
)  # 1 V per sample
TAKEN = 1 << 16  # voltages that are kept


class Board(NamedTuple):
    """A card; arrays of one number change in place."""

    clock: Clock
    output: np.ndarray  # in the card's unit
    answer: np.ndarray  # what `write` returns; only where it is FRESH the output moves
    takes: np.ndarray  # ns that every other write takes before the output moves
    hangs: np.ndarray  # 1: `read` does not come back
    silent: np.ndarray  # so many times `read` has no reading
    count: np.ndarray
    outputs: np.ndarray
    instants: np.ndarray  # ns
    reading: np.ndarray


def read(board, _):
    while board.hangs[0] != 0:
        now(board.clock)
    if board.silent[0] > 0:
        board.silent[0] -= 1
        return NONE_IN_TIME
    board.reading[0] = GAIN * board.output[0] + 1e-12 * (board.count[0] % 2)
    return FRESH


def write(board, voltage, _):
    end = now(board.clock) + board.takes[0] * (board.count[0] % 2)
    while now(board.clock) < end:
        pass
    if board.answer[0] == FRESH:
        row = board.count[0] % len(board.outputs)
        board.instants[row] = now(board.clock)
        board.outputs[row] = voltage
        board.output[0] = voltage
        board.count[0] += 1
    return board.answer[0]


class Card:
    """Driver of a board that puts out `output`, and says so where `says`."""

    def __init__(self, output=0.0, says=True):
        whole = [np.zeros(1, dtype=np.int64) for _ in range(5)]
        self.device = Board(
            clock_of(SLOW, 0.0), np.full(1, output), *whole, np.zeros(TAKEN),
            np.zeros(TAKEN, dtype=np.int64), np.zeros(2),
        )  # fmt: skip
        self.read, self.write = read, write
        self.closed = 0
        if says:
            self.applied = lambda: float(self.device.output[0])

    def error(self):
        return "bus error"

    def close(self):
        self.closed += 1

    @property
    def voltages(self):
        return self.device.outputs[: self.device.count[0]]

    def assert_slew(self, limit=STRAIGHT.slew_limit):
        """The output moved by no more than `limit` (V/s) in the time from one voltage to the next."""
        instants = self.device.instants[: self.device.count[0]]
        steps = np.abs(np.diff(self.voltages))
        assert (steps <= limit * 1e-9 * np.diff(instants) + 1e-9).all()


def servo_on(card, feedforward=STRAIGHT, **parameters):
    wide = {"model_tolerance": 1e-3, "sensor_low": -1e-3, "sensor_high": 1e-3, **parameters}
    return Servo(card, PATIENT.__class__(**(vars(PATIENT) | wide)), OPEN_LOOP, feedforward)


@pytest.fixture(params=["immediately", "next_edge"])
def at_20_volts(request):
    """A servo whose card puts out 20 V, and the card."""
    card = Card()
    servo = servo_on(card, write=request.param)
    servo.start()
    servo.refer(Profile([0.0], [20.0 * GAIN]))
    wait(lambda: card.device.output[0] == pytest.approx(20.0))
    yield servo, card
    card.device.hangs[0] = card.device.answer[0] = 0
    servo.stop()
    card.assert_slew()


# --- voltages that are not taken -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "answer, cause",
    [
        (NONE_IN_TIME, "the device took no voltage for 0.1 s: bus error"),
        (FAILED, "the device failed; its voltage may not be at rest: bus error"),
        (-1, "the device failed; its voltage may not be at rest: bus error"),
    ],
)
def test_a_voltage_that_the_card_does_not_take_is_told_and_leaves_no_leap(
    at_20_volts, answer, cause
):
    servo, card = at_20_volts
    card.device.answer[0] = answer
    servo.refer(Profile([0.0], [-20.0 * GAIN]))
    wait(lambda: servo.phase == RAMPING)
    assert servo.cause == cause
    number = servo.number
    wait(lambda: servo.number > number + 50)
    # Not at rest, and not said to be.
    assert servo.phase == RAMPING
    assert card.device.output[0] == pytest.approx(20.0)
    assert servo.voltage == pytest.approx(20.0, abs=1.0 + 1e-9)  # the next one may be on its way
    card.device.answer[0] = FRESH
    wait(lambda: servo.phase == FAULT)
    assert card.device.output[0] == 0.0


@pytest.mark.parametrize("answer", [NONE_IN_TIME, FAILED])
def test_a_card_that_comes_back_is_led_to_rest_from_where_it_went_meanwhile(at_20_volts, answer):
    """To rest by itself, as hardware has to; the first voltage that it took again was 19 V."""
    servo, card = at_20_volts
    before = int(card.device.count[0])
    card.device.answer[0] = answer
    wait(lambda: servo.phase == RAMPING)
    card.device.output[0] = 0.0
    number = servo.number
    wait(lambda: servo.number > number + 2.0 * servo.parameters.hold_time / SLOW)
    card.device.answer[0] = FRESH
    wait(lambda: servo.phase == FAULT)
    assert (card.voltages[before + 1 :] == 0.0).all()  # one may have been on its way


def test_a_voltage_that_is_not_taken_once_is_bridged():
    settings = settings_of(PATIENT, STRAIGHT, SLOW)
    laws, watch = laws_of(OPEN_LOOP, Feedforward(STRAIGHT, SLOW)), watch_at_rest()

    def step(status):
        before = laws.feedforward_state.hysteresis.voltage[0]
        sensor = GAIN * before
        voltage = servo_step(settings, laws, watch, 0, FRESH, sensor, 0.0, 20 * GAIN, 1.0)
        judge_write(settings, laws, watch, status, before)
        return voltage, int(watch.phase[0])

    for volts in (1.0, 2.0, 3.0):
        assert step(FRESH) == (pytest.approx(volts), NORMAL)
    assert step(NONE_IN_TIME) == (pytest.approx(4.0), HOLDING)
    assert step(FRESH)[0] == pytest.approx(3.0)  # held, and taken again
    assert step(FRESH) == (pytest.approx(4.0), NORMAL)


def test_the_loss_of_the_device_is_told_whatever_came_before():
    watch = watch_at_rest()
    law.trip(watch, law.STOPPED, 0.0)
    law.trip(watch, law.MODEL, 1.0)
    assert (watch.cause[0], watch.phase[0]) == (law.STOPPED, RAMPING)
    law.trip(watch, law.DEVICE, 0.0)
    assert (watch.cause[0], watch.phase[0]) == (law.DEVICE, RAMPING)


def test_a_device_that_dies_on_the_way_to_rest_is_told_by_stop(at_20_volts):
    servo, card = at_20_volts
    card.device.answer[0] = FAILED
    said = servo.stop()
    assert said == (
        "the device failed; its voltage may not be at rest: bus error: left at 20 V, rest is 0 V"
    )
    assert (servo.is_running, card.closed) == (False, 1)
    assert card.device.output[0] == pytest.approx(20.0)


def test_a_stop_at_rest_says_nothing(at_20_volts):
    servo, card = at_20_volts
    assert servo.stop() == ""
    assert (card.closed, card.device.output[0]) == (1, 0.0)


# --- a driver that does not come back ------------------------------------------------------------------


def test_a_driver_that_does_not_come_back_is_told_and_keeps_its_device(at_20_volts):
    servo, card = at_20_volts
    card.device.hangs[0] = 1
    asked = time.monotonic()
    wait(lambda: time.monotonic() > asked + 0.5)
    assert servo.stuck == ""  # nobody looked meanwhile, as of a process that stood still as a whole
    wait(lambda: servo.stuck)
    assert servo.stuck == (
        "the loop does not go on: the driver has not come back for more than 0.2 s; the voltage stays where it is, "
        "at 20 V"
    )
    assert servo.stop() == servo.stuck
    assert servo.is_running and not card.closed
    card.device.hangs[0] = 0
    wait(lambda: not servo.is_running)
    assert servo.stop() == ""
    assert card.closed and card.device.output[0] == 0.0


# --- time and place ------------------------------------------------------------------------------------


@pytest.mark.parametrize("milliseconds", [0.45, 0.9, 1.3])
def test_the_slew_limit_holds_at_an_output_that_moves_late_in_every_other_write(
    at_20_volts, milliseconds
):
    """The fixture compares every step with its time; two whole steps came within a microsecond before."""
    servo, card = at_20_volts
    card.device.takes[0] = round(milliseconds * 1e6)
    servo.refer(Profile([0.0], [-20.0 * GAIN]))
    wait(lambda: card.device.output[0] == pytest.approx(-20.0))
    assert servo.stop() == ""
    assert card.device.output[0] == 0.0


@pytest.mark.parametrize("mode", ["immediately", "next_edge"])
def test_the_loop_begins_where_the_card_is_and_goes_to_rest(mode):
    stack = FeedforwardParameters(
        compensator="static_gain", static_gain=GAIN, voltage_low=0.0, voltage_high=150.0,
        rest_voltage=60.0, slew_limit=1e3,
    )  # fmt: skip
    card = Card(2048.0 + 10.0)  # 20 V
    servo = servo_on(
        card, stack, write=mode, ramp=500.0, amplifier_gain=2.0, amplifier_zero=2048.0, sensor_scale=2.0,
        sensor_zero=2048.0 * GAIN,
    )  # fmt: skip
    assert servo.begins_at == 20.0
    servo.refer(Profile([0.0], [60.0 * GAIN]))
    servo.start()
    try:
        wait(lambda: servo.phase == NORMAL)
        assert servo.cause == ""
        assert abs(card.voltages[0] - 2058.0) <= 0.25 + 1e-9
        assert card.voltages[-1] == pytest.approx(2048.0 + 30.0)
        card.assert_slew(limit=500.0 / 2.0)
    finally:
        assert servo.stop() == ""
    card.assert_slew(limit=1e3 / 2.0)


def test_a_card_that_does_not_say_where_it_is_has_to_be_at_rest():
    stack = FeedforwardParameters(voltage_low=0.0, voltage_high=150.0, rest_voltage=75.0)
    card = Card(says=False)
    assert math.isnan(applied(card, 1.0, 0.0))
    assert servo_on(card, stack).voltage == 75.0
    assert applied(card, 2.0, 10.0, otherwise=40.0) == 60.0


def test_a_finger_says_what_it_puts_out_until_it_rests():
    plant = CantileverParameters(amplifier=AmplifierParameters(rest_voltage=5.0))
    finger = UdpFinger(plant, safety=SafetyParameters(hold_time=2.0))
    udp = SharedLibrary("udp", f"127.0.0.1:{finger.port}", SLOW)
    assert math.isnan(applied(udp, 1.0, 0.0))  # nobody answers yet, or does not know the question
    finger.start()
    card = ctypes.CDLL(str(library("udp")))
    try:
        assert applied(udp, 2.0, -1.0) == 12.0
        card.piezo_write(ctypes.c_void_p(udp.device.device), ctypes.c_double(30.0))
        wait(lambda: applied(udp, 1.0, 0.0) == 30.0)
        wait(lambda: applied(udp, 1.0, 0.0) == 5.0)  # asking keeps no finger from its rest
    finally:
        udp.close()
        report = finger.stop()
    assert (report.own_ramps, report.samples, report.refused_datagrams) == (1, 1, 0)


def test_a_finger_makes_no_step_of_datagrams_that_were_lost():
    """1e3 V/s, samples of 0.1 ms; the voltage that arrives after a gap is 20 V away."""
    plant = CantileverParameters(amplifier=AmplifierParameters(slew_limit=1e3))
    finger = UdpFinger(plant, safety=SafetyParameters(hold_time=10.0))
    finger.start()
    udp = SharedLibrary("udp", f"127.0.0.1:{finger.port}", SLOW)
    try:
        ctypes.CDLL(str(library("udp"))).piezo_write(
            ctypes.c_void_p(udp.device.device), ctypes.c_double(20.0)
        )
        wait(lambda: applied(udp, 1.0, 0.0) == 20.0)
    finally:
        udp.close()
        report = finger.stop()
    assert report.largest_step == 20.0
    assert report.largest_output_step == pytest.approx(0.1)


def test_a_servo_of_another_rest_than_the_finger_leads_it_there():
    finger = UdpFinger(CantileverParameters())
    finger.start()
    driver = SharedLibrary("udp", f"127.0.0.1:{finger.port}", SLOW)
    stack = replace(STRAIGHT, rest_voltage=30.0)
    servo = servo_on(driver, stack)
    try:
        servo.start()
        wait(lambda: servo.phase == NORMAL)
    finally:
        left = servo.stop()
        report = finger.stop()
    assert left == "" and report.highest_voltage == 30.0
    if not report.lost_datagrams:
        assert report.largest_step <= 1.0 + 1e-9  # 1e3 V/s, 1 ms; it was 30 V


def test_a_loop_that_stood_still_goes_on_from_where_the_card_went_meanwhile(at_20_volts):
    """To rest by itself, as hardware has to; it leaped back to 20 V."""
    servo, card = at_20_volts
    card.device.hangs[0] = 1
    asked = time.monotonic()
    wait(lambda: time.monotonic() > asked + 2.0 * servo.parameters.hold_time)
    before = int(card.device.count[0])
    card.device.output[0] = 0.0
    card.device.hangs[0] = 0
    wait(
        lambda: card.device.output[0] == pytest.approx(20.0)
    )  # missed periods are no fault of this servo
    assert abs(card.voltages[before]) <= 1.0 + 1e-9  # 1e3 V/s, 1 ms
    assert np.abs(np.diff(card.voltages[before:])).max() <= 1.0 + 1e-9
    assert servo.missed >= 199


@pytest.mark.parametrize("said", [math.inf, 1001.0])
def test_a_card_that_says_nonsense_is_refused(said):
    with pytest.raises(DriverError, match=r"which is (inf|1001) V, must be within ±1000 V"):
        servo_on(Card(said))


def test_a_library_is_closed_once(tmp_path):
    source, sink = tmp_path / "in", tmp_path / "out"
    source.write_text("0\n")
    sink.write_text("12\n")
    driver = SharedLibrary("iio", f"{source} {sink}", SLOW)
    assert driver.applied() == 12.0
    driver.close()
    driver.close()
    assert driver.error() == ""


# --- two masters ---------------------------------------------------------------------------------------


def test_a_second_servo_does_not_get_the_converter_of_the_first(tmp_path):
    source, sink = tmp_path / "in", tmp_path / "out"
    source.write_text("0\n")
    sink.write_text("\n")
    first = SharedLibrary("iio", f"{source} {sink}", SLOW)
    assert math.isnan(first.applied())  # an output that says nothing
    with pytest.raises(DriverError, match=f"{sink}: another servo writes to it, only one may"):
        SharedLibrary("iio", f"{source} {sink}", SLOW)
    first.close()
    SharedLibrary("iio", f"{source} {sink}", SLOW).close()


def test_a_finger_follows_one_servo_and_its_rising_numbers():
    finger = UdpFinger(CantileverParameters(), safety=SafetyParameters(hold_time=30.0))

    def peer():
        line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        line.connect(("127.0.0.1", finger.port))
        line.settimeout(TIMEOUT)
        return line

    def send(line, number, voltage):
        line.send(struct.pack("<8sQd", b"PZG1\0\0\0\0", number, voltage))

    def answer(line):
        return struct.unpack("<8sQd", line.recv(100))[1]

    finger.start()
    first, second = peer(), peer()
    try:
        send(first, 1, 2.0)
        assert answer(first) == 1
        send(second, 1, -30.0)
        assert answer(second) == 0  # somebody else leads it
        assert finger.stray == f"127.0.0.1:{second.getsockname()[1]}"
        send(second, 0, -30.0)  # and nobody else lets go for it
        send(first, 1, -30.0)
        send(first, 2, 3.0)
        assert answer(first) == 2
        send(first, 0, 3.0)
        send(second, 1, 4.0)
        assert answer(second) == 1
        # A servo on a socket that has let go begins anew.
        send(second, 0, 4.0)
        send(first, 1, 5.0)
        assert answer(first) == 1
    finally:
        report = finger.stop()
        first.close()
        second.close()
    assert (report.samples, report.lost_datagrams, report.refused_datagrams) == (4, 0, 2)
    assert (report.lowest_voltage, report.highest_voltage, report.last_voltage) == (0.0, 5.0, 5.0)


def test_a_servo_hears_that_another_one_leads_the_finger():
    finger = UdpFinger(CantileverParameters(), safety=SafetyParameters(hold_time=30.0))
    finger.start()
    drivers = [SharedLibrary("udp", f"127.0.0.1:{finger.port}", H) for _ in range(2)]
    servos = [
        Servo(driver, PATIENT, FeedbackParameters(), FeedforwardParameters()) for driver in drivers
    ]
    try:
        servos[0].start()
        wait(lambda: np.isfinite(servos[0].samples().deflection).any())
        servos[1].start()
        wait(lambda: servos[1].phase == FAULT)
        assert servos[1].cause.endswith("somebody else leads this finger")
    finally:
        for servo in servos:
            servo.stop()
        report = finger.stop()
    assert report.refused_datagrams > 0 and report.last_voltage == 0.0


# --- commissioning -------------------------------------------------------------------------------------


@pytest.mark.parametrize("home", [0.0, 14.0, 28.0, 56.0, 75.0])
def test_the_gain_is_found_at_every_voltage(home):
    """What the loop puts out has been a deflection on its way, so 3.9 V are not 3.9 V to the last digit."""
    volt = commission.VOLT
    limits = VoltageParameters(voltage_high=200.0, rest_voltage=home)
    for voltage in 0.1 * np.arange(1, 201):
        put_out = np.repeat([home, (volt * (home + voltage)) / volt, home], 100)
        samples = [put_out if name == "voltage" else GAIN * (put_out - home) for name in NAMES]
        bench = SimpleNamespace(limits=limits, move=lambda *_, got=samples: Samples(*got))
        found = commission.gain(bench, commission.Rest(0.0, 1e-12), voltage)
        assert found == pytest.approx(GAIN)


NAMES = tuple(Samples.__dataclass_fields__)


def test_a_step_without_a_reading_is_told():
    limits = VoltageParameters()
    nothing = [np.full(10, math.nan) for _ in NAMES]
    bench = SimpleNamespace(limits=limits, move=lambda *_: Samples(*nothing))
    with pytest.raises(commission.NoAnswer, match=r"no reading came while 3.9 V were on"):
        commission.gain(bench, commission.Rest(0.0, 1e-12), 3.9)


def bench_on(card, monkeypatch, **limits):
    monkeypatch.setattr(commission, "open_driver", lambda *_: card)
    arguments = argparse.Namespace(
        sample_time=SLOW, write="immediately", amplifier_gain=1.0, amplifier_zero=0.0, card_low=0.0, card_high=0.0,
        driver="board", driver_options="", priority=0, share=0.1,
    )  # fmt: skip
    return commission.Bench(arguments, VoltageParameters(**limits), 1.0)


@pytest.mark.parametrize(
    "says, told",
    [(True, "from 12 V"), (False, "the driver does not say what the card puts out")],
)
def test_commission_asks_before_anything_moves(monkeypatch, says, told):
    card, asked = Card(12.0, says), []
    bench = bench_on(card, monkeypatch, voltage_low=0.0, voltage_high=150.0, rest_voltage=75.0)
    assert commission.commission(bench, None, asked.append) is None
    span = "0 to 150 V, 75 V at rest; the card puts out 0 to 150, 75 at rest, of an unknown range"
    assert asked == [f"within {span}; to rest at 75 V ({told})?"]
    assert card.closed and not len(card.voltages)


def test_commission_measures_at_rest_and_leads_there_slowly(monkeypatch):
    limits = {"voltage_low": 0.0, "voltage_high": 150.0, "rest_voltage": 75.0, "slew_limit": 100.0}
    card = Card(12.0)
    bench = bench_on(card, monkeypatch, **limits)
    rest = commission.at_rest(bench)
    assert rest.mean == pytest.approx(75.0 * GAIN)
    assert rest.noise < 1e-11
    card.assert_slew(limit=100.0)


def test_commission_tries_again_where_a_busy_machine_gave_no_reading(monkeypatch):
    card = Card()
    bench = bench_on(card, monkeypatch)
    card.device.silent[0] = 150  # 0.15 s, the hold time being 0.1 s
    assert commission.at_rest(bench).noise < 1e-11
    card.device.silent[0] = 10**6  # one that is unplugged
    with pytest.raises(commission.NoAnswer, match="no reading of the sensor for 0.1 s"):
        commission.at_rest(bench)
    assert card.device.output[0] == 0.0


def test_commission_says_what_was_not_left_at_rest(monkeypatch):
    card = Card()
    bench = bench_on(card, monkeypatch)
    card.device.answer[0] = FAILED
    card.device.output[0] = 5.0
    with pytest.raises(commission.NoAnswer, match="left at 5 V, rest is 0 V"):
        bench.move(Profile([0.0], [0.0]), 0.1)
    assert card.closed


# --- the node ------------------------------------------------------------------------------------------


@pytest.fixture
def node(monkeypatch):
    """The node, in this process, configured; its driver is a card that puts out 5 V."""
    rclpy.init()
    node = ServoNode()
    node.card = Card(5.0)
    monkeypatch.setattr(servo_node, "open_driver", lambda *_: node.card)
    monkeypatch.setattr(ServoNode, "_controller", lambda *_: OPEN_LOOP)
    node.set_parameters(
        [
            rclpy.parameter.Parameter(name, value=value)
            for name, value in (
                ("missed_limit", 10**6), ("late_share", 1.0), ("model_tolerance", 1e-3), ("priority", 0),
            )
        ]
    )  # fmt: skip
    node.heard = []
    listener = rclpy.create_node("listener")
    listener.create_subscription(FingerState, "state", node.heard.append, LATCHED)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(listener)

    def until(done):
        end = time.monotonic() + TIMEOUT
        while not (node.heard and done(node.heard[-1])):
            assert time.monotonic() < end, node.heard[-1:]
            executor.spin_once(timeout_sec=0.02)

    node.until = until
    node.trigger_configure()
    try:
        yield node
    finally:
        node.card.device.hangs[0] = 0
        node.trigger_shutdown()
        executor.shutdown()
        listener.destroy_node()
        node.destroy_node()
        rclpy.shutdown()


def test_what_the_card_is_going_to_put_out_is_said_in_its_unit():
    stack = VoltageParameters(voltage_low=0.0, voltage_high=150.0, rest_voltage=75.0)
    millivolts = ServoParameters(amplifier_gain=0.05, amplifier_zero=2048.0)
    assert millivolts.span(stack) == (
        "0 to 150 V, 75 V at rest; the card puts out 2048 to 5048, 3548 at rest, of an unknown range"
    )


@pytest.mark.parametrize(
    "gain, zero, is_right",
    [(20.0, 0.0, True), (-20.0, 0.0, True), (0.02, 0.0, False), (20.0, 2048.0, False)],
)
def test_a_scale_that_asks_more_of_the_card_than_it_has_is_refused(
    monkeypatch, gain, zero, is_right
):
    """A card of ±10 V before an amplifier of 20 V per V; ±40 V at the finger are ±2 V there."""
    scales = {"amplifier_gain": gain, "amplifier_zero": zero, "card_low": -10.0, "card_high": 10.0}
    card = Card()
    bench = bench_on(card, monkeypatch)
    vars(bench.arguments).update(scales)
    if is_right:
        assert servo_on(card, **scales).voltage == 0.0
        assert commission.commission(bench, None, lambda _: False) is None
        return
    text = "must be within 'card_low' and 'card_high': is 'amplifier_gain'"
    with pytest.raises(ParameterError, match=text):
        servo_on(card, **scales)
    with pytest.raises(ParameterError, match="of -10 to 10, " + text):
        commission.commission(bench, None, lambda _: pytest.fail("nobody is asked"))
    assert not len(card.voltages)


def test_limits_that_nobody_gave_are_warned_of(node, capfd):
    node.set_parameters([rclpy.parameter.Parameter("driver", value="board")])
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    said = capfd.readouterr().err
    assert "the finger gets -40 to 40 V, 0 V at rest; the card puts out -40 to 40" in said
    assert "what yours stands belongs into a 'feedforward_file'" in said


def test_no_state_tells_a_fault_that_was_reset(node):
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    node.servo.give_up_without_temperature()
    node.until(lambda state: state.phase == FingerState.FAULT)
    node.servo.reset()
    wait(lambda: node.servo.phase == NORMAL)
    heard = len(node.heard)
    node._tell()
    node.until(lambda _: len(node.heard) > heard)
    assert {state.phase for state in node.heard[heard:]} == {FingerState.RUNNING}


@pytest.mark.parametrize("error", [ValueError, RuntimeError])
def test_an_activation_that_fails_leaves_no_loop_and_no_open_card(node, monkeypatch, error):
    def fail(*_):
        wait(lambda: node.servo.number > 10)
        raise error("gone meanwhile")

    with monkeypatch.context() as patched:
        patched.setattr(ServoNode, "_follow_phase", fail)
        assert node.trigger_activate() != TransitionCallbackReturn.SUCCESS
    assert (node.servo, node.active, node.card.closed) == (None, False, 1)
    assert node.card.device.output[0] == 0.0


def test_a_file_that_is_gone_ends_nothing_that_runs(node, tmp_path):
    node.comes_from("feedforward", tmp_path / "gone.yaml")
    assert "cannot be read" in node._origins["feedforward"]


def test_a_loop_that_does_not_go_on_is_said_and_keeps_its_card_alone(node):
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    node.until(lambda state: state.phase == FingerState.RUNNING and state.on_target)
    node.card.device.hangs[0] = 1
    node.until(lambda state: state.phase == FingerState.HOLDING)
    assert not node.heard[-1].on_target
    assert "the driver has not come back for more than 0.2 s" in node.heard[-1].text
    assert node.report()[0] == node.heard[-1].text
    # It cannot be stopped, says so, and nobody else gets the card meanwhile.
    node.trigger_deactivate()
    node.until(lambda state: state.phase == FingerState.IDLE)
    assert "the driver has not come back" in node.heard[-1].text
    assert node.trigger_activate() == TransitionCallbackReturn.FAILURE
    assert not node.card.closed
    node.card.device.hangs[0] = 0
    node.until(lambda state: state.phase == FingerState.IDLE and not state.text)
    assert node.card.closed and node.card.device.output[0] == 0.0
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS


@pytest.mark.parametrize(
    "change, begins, rests",
    [({"rest": 20.0}, 10.0, 20.0), ({"amplifier_gain": -1.0}, -10.0, -10.0), ({"amplifier_zero": 5.0}, 5.0, 15.0)],
)  # fmt: skip
def test_what_changes_between_two_loops_is_no_leap_at_a_card_that_does_not_say(
    node, tmp_path, change, begins, rests
):
    """The card is where the loop before has left it, whatever that is called now; it leaped by up to 20 V."""

    def use(rest=10.0, **parameters):
        limits = {"rest_voltage": rest, "slew_limit": STRAIGHT.slew_limit}
        dump(tmp_path / f"{rest}.yaml", "feedforward", limits)
        parameters["feedforward_file"] = str(tmp_path / f"{rest}.yaml")
        answers = node.set_parameters(
            [rclpy.parameter.Parameter(name, value=value) for name, value in parameters.items()]
        )
        assert all(answer.successful for answer in answers)

    def run():
        assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
        begin = node.servo.begins_at
        node.until(lambda state: state.phase == FingerState.RUNNING)
        node.trigger_deactivate()
        return begin

    node.card = Card(10.0, says=False)
    use()
    assert math.isnan(run())
    use(**change)
    assert run() == begins
    assert np.abs(np.diff(node.card.voltages)).max() <= 1.0 + 1e-9  # 1e3 V/s, 1 ms
    assert node.card.device.output[0] == pytest.approx(rests)
    # Nobody knows where another card is.
    use(driver_options="another")
    assert math.isnan(run())


def fail_above_rest(node):
    """Let the device fail when the finger is up, and the node be deactivated then."""
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    node.servo.refer(Profile([0.0], [5e-6]))
    node.until(lambda state: state.voltage > 1.0)
    node.card.device.answer[0] = FAILED
    node.trigger_deactivate()
    node.until(lambda state: state.phase == FingerState.IDLE)


def test_a_device_that_dies_is_told_by_a_node_that_is_not_active(node):
    fail_above_rest(node)
    assert (
        "the device failed; its voltage may not be at rest: bus error: left at"
        in node.heard[-1].text
    )
    assert node.heard[-1].voltage == pytest.approx(node.card.device.output[0], abs=1e-9)
    assert node.report()[0] == node.heard[-1].text


@pytest.mark.parametrize("says", [True, False])
def test_a_finger_that_was_left_somewhere_is_not_taken_to_be_at_rest(node, says):
    """Whether its hardware went to rest by itself only the driver or somebody who looks can tell; it leaped by 20 V."""
    node.card = Card(0.0, says)
    fail_above_rest(node)
    left = float(node.card.device.output[0])
    node.card.device.answer[0] = FRESH
    if says:
        assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
        assert node.servo.begins_at == pytest.approx(left)
        return
    assert node.trigger_activate() == TransitionCallbackReturn.FAILURE
    assert node.card.closed == 2 and node.card.device.output[0] == left
    assert "left at" in node.report()[0]
    node.card.device.output[0] = 0.0
    node.reset()
    assert node.report()[0] == ""
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
