# SPDX-License-Identifier: Apache-2.0
"""The servo: its law against the engine, every guard on its cause, the loop in real time, the node."""

import argparse
import ctypes
import json
import math
import os
import signal
import subprocess
import sysconfig
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rclpy
from ament_index_python.packages import get_package_prefix
from hypothesis import given, settings
from hypothesis import strategies as st
from rcl_interfaces.srv import SetParameters
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

pytest.importorskip("numba")

from piezo_control.design.cli import read_problem
from piezo_control.feedback import FeedbackParameters, read_controller
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.nodes.client import LEAD_TIME, ClientError, connect
from piezo_control.nodes.parameters import ServoNodeParameters, read_feedforward
from piezo_control.nodes.profile_input import waveform_message
from piezo_control.nodes.qos import LATCHED, SAMPLE, SETPOINT
from piezo_control.parameters import ParameterError, dump, load
from piezo_control.profile import Profile
from piezo_control.safety import FAULT, HOLDING, NORMAL, RAMPING, VoltageParameters
from piezo_control.servo import commission, law
from piezo_control.servo.commission import PROBLEM, at_its_pace
from piezo_control.servo.driver import (
    FAILED,
    FRESH,
    NONE_IN_TIME,
    DriverError,
    SharedLibrary,
    library,
)
from piezo_control.servo.law import laws_of, put_controller, servo_step, settings_of, watch_at_rest
from piezo_control.servo.loop import Servo
from piezo_control.servo.parameters import ServoParameters
from piezo_control.start import ENDING, interrupt_at_signals
from piezo_control.waveform import Waveform
from piezo_gripper_msgs.msg import FingerState, Sample, SampleBlock
from piezo_gripper_msgs.msg import Waveform as WaveformMessage
from piezo_sim.driver import Simulation
from piezo_sim.engine import run
from piezo_sim.plant.amplifier import AmplifierParameters
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.temperature import TemperatureParameters

H = 1e-4
ROBUST = read_controller("robust")
PAPER = read_controller("paper")
STEP = Profile([0.0, 0.01], [0.0, 20e-6])
# The first loop is compiled, which takes 17 s of a core, on a machine that may be busy with much else.
TIMEOUT = 300.0  # s


class Bench:
    """The law of the servo, without its clock, on a cantilever."""

    def __init__(self, feedback=ROBUST, plant=None, feedforward=None, **parameters):
        self.parameters = ServoParameters(**parameters)
        self.feedforward = feedforward or FeedforwardParameters()
        self.settings = settings_of(self.parameters, self.feedforward, H)
        self.laws = laws_of(feedback, Feedforward(self.feedforward, H))
        self.watch = watch_at_rest()
        self.plant = Cantilever(plant or CantileverParameters())
        self.voltages = []
        self.wanted = 0

    def step(self, reference, status=FRESH, raw=None, age=0.0, share=1.0):
        reading = self.plant.measure() if raw is None else raw
        voltage = servo_step(
            self.settings,
            self.laws,
            self.watch,
            self.wanted,
            status,
            reading,
            age,
            reference,
            share,
        )
        self.plant.advance(voltage, 22.0)
        self.voltages.append(voltage)
        return voltage

    def run(self, samples, reference=20e-6, **more):
        for _ in range(samples):
            self.step(reference, **more)

    @property
    def cause(self):
        code = int(self.watch.cause[0])
        return law.CAUSES[code](float(self.watch.cause_value[0]), self.parameters) if code else ""

    def assert_at_rest(self, within):
        """The voltage went to rest within `within` seconds, by no more than ramp and slew limit allow."""
        self.run(round(within / H))
        assert self.watch.phase[0] == FAULT
        assert self.voltages[-1] == self.feedforward.rest
        assert np.abs(np.diff(self.voltages)).max() <= self.feedforward.slew_limit * H * (1 + 1e-9)
        assert np.abs(self.voltages).max() <= 40.0


def test_the_law_gives_the_samples_of_the_engine():
    samples = 600
    expected = run(
        CantileverParameters(),
        FeedforwardParameters(),
        ROBUST,
        TemperatureParameters(),
        STEP,
        samples,
    )
    bench = Bench()
    for k in range(samples):
        bench.step(STEP.at(k * H))
    # The engine is compiled with contractions of its own; the sensor's steps of 10 nm hide them.
    np.testing.assert_allclose(bench.voltages, expected.voltage, rtol=0, atol=1e-9)


@pytest.fixture
def running():
    """A bench that has settled at 20 µm."""
    bench = Bench()
    bench.run(200)
    assert bench.watch.phase[0] == NORMAL
    assert bench.plant.measure() == pytest.approx(20e-6, rel=0.05)
    return bench


def test_a_late_reading_is_bridged_and_a_silent_sensor_ends_at_rest(running):
    held = running.voltages[-1]
    running.run(500, status=NONE_IN_TIME)  # 50 ms, the hold time being 100 ms
    assert running.watch.phase[0] == HOLDING
    assert set(running.voltages[-500:]) == {held}
    running.run(1)
    assert running.watch.phase[0] == NORMAL
    running.run(1001, status=NONE_IN_TIME)
    assert running.watch.phase[0] == RAMPING
    assert running.cause == "no reading of the sensor for 0.1 s"
    running.assert_at_rest(0.01)  # 37 V at 1e4 V/s: 3.7 ms


@pytest.mark.parametrize(
    "more, cause",
    [
        ({"status": FAILED}, "the device failed"),
        ({"age": 0.02}, "readings are 0.02 s old, must be within [0, 0.01] s"),
        ({"age": math.nan}, "readings are nan s old, must be within"),
        ({"age": -5.0}, "readings are -5 s old, must be within"),
        ({"raw": 41e-6}, r"the sensor says 41 µm, must be within [-40, 40] µm"),
        ({"raw": math.nan}, "the sensor says nan µm"),
        ({"raw": 1.7e308}, "the sensor says"),
        ({"raw": -12e-6}, "µm from what the model says of the voltage, must be within 30 µm"),
    ],
)
def test_what_no_loop_can_use_ends_at_rest_at_once(running, more, cause):
    running.run(1, **more)
    assert running.watch.phase[0] == RAMPING
    assert cause in running.cause
    running.assert_at_rest(0.01)


def test_a_fault_stays_until_it_is_reset_and_then_the_loop_takes_over_from_rest(running):
    running.run(1, status=FAILED)
    running.assert_at_rest(0.5)
    running.run(1000)
    assert running.voltages[-1] == 0.0 and running.watch.times[0] == 1.0
    law.rearm(running.watch)
    running.run(1)
    assert abs(running.voltages[-1]) < 4.0  # one step of the slew limit
    running.run(300)
    assert running.plant.measure() == pytest.approx(20e-6, rel=0.05)
    assert np.abs(np.diff(running.voltages)).max() <= 4.0 + 1e-9


def test_a_finger_with_a_bias_begins_there_and_ends_there():
    limits = {"voltage_low": 0.0, "voltage_high": 40.0, "rest_voltage": 20.0}
    plant = CantileverParameters(amplifier=AmplifierParameters(**limits))
    bench = Bench(plant=plant, feedforward=FeedforwardParameters(**limits))
    # sum_i w_i max(20 V - r_i, 0) of the default weights and thresholds.
    home = 9.151e-6
    assert bench.plant.measure() == pytest.approx(home, abs=20e-9)
    bench.run(300, reference=home)
    assert np.abs(np.array(bench.voltages) - 20.0).max() < 0.2
    bench.run(300, reference=3e-6)
    assert bench.plant.measure() == pytest.approx(3e-6, abs=0.1e-6)
    bench.run(1, status=FAILED)
    bench.assert_at_rest(0.01)  # from below
    law.rearm(bench.watch)
    bench.run(300, reference=15e-6)
    assert bench.plant.measure() == pytest.approx(15e-6, abs=0.1e-6)
    bench.run(1, status=FAILED)
    bench.assert_at_rest(0.01)  # from above


def test_a_share_of_the_voltage_begins_at_rest_and_never_leaves_the_limits(tmp_path):
    def shared(**limits):
        dump(tmp_path / "stack.yaml", "feedforward", limits)
        used = ServoNodeParameters(feedforward_file=str(tmp_path / "stack.yaml"), voltage_share=0.1)
        found = read_feedforward(used)
        return found.voltage_low, found.rest, found.voltage_high

    assert shared() == pytest.approx((-4.0, 0.0, 4.0))
    assert shared(voltage_low=5.0, voltage_high=90.0) == pytest.approx((5.0, 5.0, 13.5))
    stack = {"voltage_low": 0.0, "voltage_high": 150.0, "rest_voltage": 75.0}
    assert shared(**stack) == pytest.approx((67.5, 75.0, 82.5))


def test_a_frozen_sensor_is_found_once_the_voltage_has_moved(running):
    frozen = running.plant.measure()
    for k in range(2000):
        running.step(20e-6 - 2e-8 * k, raw=frozen)
        if running.watch.phase[0] == RAMPING:
            break
    assert "stands still at" in running.cause
    running.assert_at_rest(0.02)


def test_a_reversed_sensor_is_found_within_20_ms():
    bench = Bench(sensor_scale=-1.0)
    bench.run(200)
    assert bench.cause.endswith("polarity, scale or wiring?") or "the sensor says" in bench.cause
    bench.assert_at_rest(0.02)


def test_polarity_zero_and_scale_of_sensor_are_undone():
    """A sensor of -5 V/mm with 1 V at zero, in the loop, gives the voltages of one in metres."""
    plain, scaled = Bench(), Bench(sensor_scale=-2e-4, sensor_zero=1.0)
    for _ in range(300):
        plain.step(20e-6)
        scaled.step(20e-6, raw=1.0 - scaled.plant.measure() / 2e-4)
    np.testing.assert_allclose(plain.voltages, scaled.voltages, rtol=0, atol=1e-6)


def test_a_loop_that_oscillates_ends_at_rest():
    """Three more samples of delay turn `fast`, whose delay margin is 0.26 ms, unstable."""
    plant = CantileverParameters()
    sensor = replace(plant.sensor, delay_samples=4)
    bench = Bench(
        read_controller("fast"),
        plant=replace(plant, sensor=sensor),
        model_tolerance=1e-3,
        sensor_high=1e-3,
        sensor_low=-1e-3,
    )
    for _ in range(6000):
        bench.step(5e-6)
        if bench.watch.phase[0] == RAMPING:
            break
    assert len(bench.voltages) <= 2500  # five windows of 20 ms, once the swing is beyond 5 µm
    assert "the loop oscillates by" in bench.cause
    bench.assert_at_rest(0.02)


def test_the_ringing_of_an_open_loop_step_and_a_fast_reference_are_no_oscillation():
    bench = Bench(FeedbackParameters())
    bench.run(3000)
    assert bench.watch.phase[0] == NORMAL
    for k in range(4000):
        bench.step(20e-6 * math.sin(2 * math.pi * 100 * k * H))
    assert bench.watch.phase[0] == NORMAL


def test_missed_and_late_periods_end_at_rest(running):
    law.judge_time(running.settings, running.watch, 0.0, 100.0)
    assert running.watch.phase[0] == NORMAL
    law.judge_time(running.settings, running.watch, 0.0, 101.0)
    assert running.cause == "101 periods missed in a row, must be at most 100"
    running.assert_at_rest(0.01)


def test_a_share_of_late_periods_is_judged_over_five_windows(running):
    for k in range(1000):  # five windows of 20 ms
        law.judge_time(running.settings, running.watch, 0.6e-4 if k % 4 == 0 else 0.0, 0.0)
    assert running.cause == "25.0% of the periods are late or missed, must be at most 20.0%"


@settings(max_examples=20)
@given(st.lists(st.floats(0.0, 1.0), min_size=20, max_size=60), st.integers(0, 2**32 - 1))
def test_limits_hold_in_time_whatever_the_reference_and_the_sensor_do(shares, seed):
    random = np.random.default_rng(seed)
    bench = Bench()
    last = 0.0
    for share in shares:
        status = random.choice(
            [FRESH, FRESH, FRESH, NONE_IN_TIME, FAILED], p=[0.3, 0.3, 0.3, 0.09, 0.01]
        )
        voltage = bench.step(random.uniform(-1e-3, 1e-3), status=status, share=share)
        assert abs(voltage - last) <= 4e4 * H * share + 1e-12
        assert abs(voltage) <= 40.0
        last = voltage


def test_another_controller_takes_over_with_the_command_where_it_is(running):
    put_controller(running.laws.controllers[1], PAPER)
    command = running.watch.command[0]
    running.wanted = 1
    running.step(20e-6)
    assert running.watch.command[0] == pytest.approx(command, abs=0.2e-6)
    running.run(500)
    # The paper's K leaves 0.68 % of static error (docs: control-reference).
    assert running.plant.measure() == pytest.approx(20e-6, rel=0.02)


def test_a_profile_that_travels_ahead_is_followed_without_lag():
    """±20 µm at 100 Hz within 5 %, as asked in test_preview of the law; without preview it is 106 %."""
    wave = Waveform("sine", 20e-6, frequency=100.0)
    servo = Servo(
        Simulation("", H),
        ServoParameters(),
        replace(ROBUST, preview_band=150.0),
        FeedforwardParameters(),
    )
    servo.refer(wave)
    numbers = np.arange(3000)
    ring = servo._loop.references
    np.testing.assert_array_equal(ring.values[numbers], wave.at(numbers * H))
    bench, errors = Bench(), []
    for number in numbers:
        errors.append(bench.plant.deflection - ring.values[number])
        bench.step(ring.asked[number])
    servo.driver.close()
    assert np.abs(errors[1500:]).max() < 0.05 * 20e-6
    # A controller without a preview is asked for the wave as it is.
    servo.change_controller(ROBUST)
    np.testing.assert_array_equal(ring.asked[numbers], wave.at(numbers * H))


@pytest.mark.parametrize("hertz, times", [(2000.0, 1.0), (666.6, 1.0), (200.0, 3.333)])
def test_a_slow_finger_is_asked_for_as_many_periods_as_the_paper_s(hertz, times):
    problem = read_problem(PROBLEM)
    model = replace(problem.finger, denominator=(1.0 / (2.0 * math.pi * hertz) ** 2, 1e-5, 1.0))
    asked = at_its_pace(replace(problem, finger=model)).specification
    assert asked.settling_time == pytest.approx(times * 6e-3, rel=1e-3)
    assert asked.force_settling_time == pytest.approx(times * 15e-3, rel=1e-3)


# --- the loop in real time, without ROS -------------------------------------------------------------

PATIENT = ServoParameters(missed_limit=10**6, late_share=1.0)  # other processes share this machine


def wait(done, what="the condition"):
    end = time.monotonic() + TIMEOUT
    while not done():
        assert time.monotonic() < end, what
        time.sleep(0.005)


def test_a_servo_in_this_process():
    servo = Servo(Simulation("", H), PATIENT, ROBUST, FeedforwardParameters())
    taken = []

    def collect():
        servo.look_ahead()
        taken.append(servo.samples())

    def settled(at):
        collect()
        return len(taken[-1]) and abs(taken[-1].deflection[-1] - at) < 0.2e-6

    servo.start()
    try:
        wait(lambda: servo.number > 100)
        servo.refer(Profile([0.0], [20e-6]))
        wait(lambda: settled(20e-6))
        servo.change_controller(PAPER)
        wait(lambda: collect() or servo._loop.watch.in_use[0] == 1)
        servo.refer(Profile([0.0], [-10e-6]))
        wait(lambda: settled(-10e-6))
    finally:
        servo.stop()
    collect()
    number = np.concatenate([s.number for s in taken])
    instant = np.concatenate([s.instant for s in taken])
    voltage = np.concatenate([s.voltage for s in taken])
    assert servo.lost == 0
    assert (np.diff(number) > 0).all()
    assert (
        number[-1] + 1 - len(number) == servo.missed
    )  # the numbers left out are those that were missed
    # Edges on one grid, however late they were served.
    np.testing.assert_allclose(instant, instant[0] + (number - number[0]) * H, rtol=0, atol=1e-6)
    assert np.abs(np.diff(voltage)).max() <= 4.0 + 1e-9
    assert (servo.phase, servo.cause, voltage[-1]) == (FAULT, "stopped", 0.0)


def test_a_signal_in_the_midst_of_commissioning_ends_at_rest(monkeypatch):
    """Beyond 15 V on the way up; the second signal, while the voltage is led to rest, changes nothing."""
    servos = []

    class Seen(Servo):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            servos.append(self)

    def interrupt():
        wait(
            lambda: servos and servos[0]._loop.watch.phase[0] == NORMAL and servos[0].voltage > 15.0
        )
        os.kill(os.getpid(), signal.SIGTERM)
        wait(lambda: servos[0]._loop.orders.stop[0] == 1)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(commission, "Servo", Seen)
    arguments = argparse.Namespace(
        sample_time=H, write="immediately", amplifier_gain=1.0, amplifier_zero=0.0, driver="simulated", driver_options="",
        priority=0, card_low=0.0, card_high=0.0,
    )  # fmt: skip
    bench = commission.Bench(arguments, VoltageParameters(), 1.0)
    before = {number: signal.getsignal(number) for number in ENDING}
    interrupt_at_signals()
    other = threading.Thread(target=interrupt)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            bench.move(Profile([0.0, 10.0], [0.0, 30.0], linear=True), 10.0)
    finally:
        other.join()
        for number, handler in before.items():
            signal.signal(number, handler)
    assert (servos[0].phase, servos[0].voltage) == (FAULT, 0.0)
    voltage = servos[0].samples().voltage
    assert voltage.max() > 15.0 and np.abs(np.diff(voltage)).max() <= 4.0 + 1e-9


def test_controllers_of_a_finger_at_rest_change_as_often_as_one_likes():
    servo = Servo(Simulation("", H), PATIENT, ROBUST, FeedforwardParameters())
    servo.start()
    try:
        wait(lambda: servo.number > 100)
        servo.give_up_without_temperature()
        wait(lambda: servo.phase == FAULT)
        for controller in (PAPER, ROBUST, PAPER):
            servo.check_controller(controller)
            servo.change_controller(controller)
        servo.reset()
        wait(lambda: servo._loop.watch.in_use[0] == servo._loop.orders.controller[0])
        in_use = servo._loop.laws.controllers[int(servo._loop.watch.in_use[0])]
        assert in_use.command_high[0] == PAPER.command_high and in_use.order[0] == PAPER.order
        large = replace(
            ROBUST,
            a=(0.0,) * 33**2,
            b=(0.0,) * 33,
            c=(0.0,) * 33,
            anti_windup=(0.0,) * 33,
            reference_b=(0.0,) * 33,
        )
        with pytest.raises(ParameterError, match="33 states, must have at most 32"):
            servo.check_controller(large)
    finally:
        servo.stop()


def test_a_device_that_is_not_there_is_named(tmp_path):
    with pytest.raises(
        ParameterError, match="must be 'simulated', one of the shipped iio, udp, or the path"
    ):
        SharedLibrary("nowhere", "", H)
    with pytest.raises(DriverError, match="options are 'nonsense', must be HOST:PORT"):
        SharedLibrary("udp", "nonsense", H)
    no_driver = tmp_path / "empty.so"
    no_driver.write_bytes(b"no library")
    with pytest.raises(ParameterError, match="'driver' is"):
        SharedLibrary(str(no_driver), "", H)


def test_converters_of_linux_are_read_and_written_by_their_files(tmp_path):
    """Ordinary files in place of those in sysfs."""
    source, sink = tmp_path / "in_voltage0_raw", tmp_path / "out_voltage0_raw"
    source.write_text("1234\n")
    sink.write_text("")
    driver = SharedLibrary("iio", f"{source} {sink}", H)
    functions, device = ctypes.CDLL(str(library("iio"))), ctypes.c_void_p(driver.device.device)
    reading = (ctypes.c_double * 2)()
    assert functions.piezo_read(device, reading) == FRESH and list(reading) == [1234.0, 0.0]
    source.write_text("-7\n")
    assert functions.piezo_read(device, reading) == FRESH and reading[0] == -7.0
    source.write_text("")
    assert functions.piezo_read(device, reading) == NONE_IN_TIME
    assert functions.piezo_write(device, ctypes.c_double(-2047.6)) == FRESH
    assert sink.read_text() == "-2048\n"
    driver.close()
    with pytest.raises(DriverError, match="no_file: No such file or directory"):
        SharedLibrary("iio", f"{tmp_path / 'no_file'} {sink}", H)
    with pytest.raises(DriverError, match="must be the files of input and output"):
        SharedLibrary("iio", str(source), H)


def test_the_drivers_compile_without_a_warning(tmp_path):
    compiler = sysconfig.get_config_var("CC").split()[0]
    sources = Path(__file__).parents[1] / "piezo_control" / "servo" / "drivers"
    for source in sources.glob("*.c"):
        subprocess.run(
            [compiler, "-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fPIC", "-shared",
             "-o", tmp_path / "driver.so", source],
            check=True, timeout=TIMEOUT,
        )  # fmt: skip


# --- the node, against a finger in another process --------------------------------------------------

EXECUTABLES = Path(get_package_prefix("piezo_gripper")) / "lib" / "piezo_gripper"


class Stand:
    """A UDP finger, commissioned, the servo, and what one needs to talk to it; every wait is for a condition."""

    def __init__(self, folder):
        self.folder = folder
        (folder / "finger.yaml").write_text(
            "/**/cantilever:\n  ros__parameters:\n    sensor: {delay_samples: 0}\n"
            "    amplifier: {rest_voltage: 10.0}\n"
        )
        self.port = 0
        self.finger = self.start_finger()
        self.node = rclpy.create_node("stand")
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)
        self.states, self.blocks = [], []
        self.node.create_subscription(FingerState, "state", self.states.append, LATCHED)
        self.node.create_subscription(SampleBlock, "samples", self.blocks.append, SAMPLE)
        self.reference = self.node.create_publisher(Sample, "reference", SETPOINT)
        self.waveform = self.node.create_publisher(WaveformMessage, "reference_waveform", SETPOINT)
        self.servo = None

    def start_commission(self):
        """Let the driver's sensor, which is reversed, be found out; return the process and its directory."""
        out = self.folder / "commissioned"
        commission = self.start(
            "commission", "--driver", "udp", "--driver-options", f"127.0.0.1:{self.port}",
            "--write", "next_edge", "--sensor-scale", "2e-5", "--rest-voltage", "10", "--yes",
            "--out", str(out),
        )  # fmt: skip
        return commission, out

    def commission(self):
        """Return the directory of parameters of a finger that was commissioned."""
        commission, out = self.start_commission()
        assert commission.wait(2 * TIMEOUT) == 0, self.log("commission")
        return out

    def start_servo(self, parameters):
        # Other processes share this machine, so nothing is said here about time.
        self.servo = self.start(
            "servo", "--ros-args", "--params-file", str(parameters / "servo.yaml"),
            "-p", "late_share:=1.0", "-p", "missed_limit:=1000000", "-p", "age_limit:=10.0",
            "-p", "hold_time:=2.0",
        )  # fmt: skip

    def start(self, name, *arguments):
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [EXECUTABLES / name, *arguments], stdout=log, stderr=log, start_new_session=True
            )

    def log(self, name):
        return (self.folder / f"{name}.log").read_text()

    def start_finger(self):
        before = self.log("udp_finger").count("answers") if self.port else 0
        finger = self.start(
            "udp_finger", "--port", str(self.port), "--cantilever", str(self.folder / "finger.yaml"),
            "--report", str(self.folder / "report.json"), "--scale=-5e4", "--zero", "1.0",
            "--priority", "70",
        )  # fmt: skip
        wait(lambda: self.log("udp_finger").count("answers") > before, "the finger answers")
        self.port = int(self.log("udp_finger").rsplit(":", 1)[1].split()[0])
        return finger

    def wait(self, done):
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, self.log("servo") + self.log("udp_finger")
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready)
        future = client.call_async(request)
        self.wait(future.done)
        return future.result()

    def is_at(self, deflection):
        last = self.blocks[-1] if self.blocks else None
        return last and np.nanmax(np.abs(np.array(last.deflection) - deflection)) < 0.2e-6

    @property
    def phase(self):
        return self.states[-1].phase if self.states else None


@pytest.fixture
def stand(tmp_path):
    rclpy.init()
    stand = Stand(tmp_path)
    try:
        yield stand
    finally:
        started = [process for process in (stand.servo, stand.finger) if process]
        for process in started:
            process.terminate()
        codes = [process.wait(TIMEOUT) for process in started]
        stand.executor.shutdown()
        stand.node.destroy_node()
        rclpy.shutdown()
    assert set(codes) == {0}


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_commission_leads_the_voltage_to_rest(stand, end):
    """As soon as it goes on to the sine over the whole range; `SIGINT` twice, as of one who is in a hurry."""
    commission, out = stand.start_commission()
    wait(lambda: "resonance" in stand.log("commission"))
    commission.send_signal(end)
    if end == signal.SIGINT:
        commission.send_signal(end)
    assert commission.wait(TIMEOUT) == 1
    assert "ended by a signal" in stand.log("commission")
    assert "Traceback" not in stand.log("commission")
    stand.finger.terminate()
    assert stand.finger.wait(TIMEOUT) == 0
    report = json.loads((stand.folder / "report.json").read_text())
    assert report["last_voltage"] == 10.0
    if not report["lost_datagrams"]:
        assert report["largest_step"] <= 4.0 + 1e-9
    assert not (out / "servo.yaml").exists()


def test_from_an_unknown_finger_to_a_loop_that_survives_its_death(stand):
    found = stand.commission()
    servo = load(found / "servo.yaml", "servo")
    # The finger of the paper with a bias, behind a sensor of -50 mV/µm with 1 V at zero, read at the next edge.
    assert servo["sensor_scale"] == -2e-5 and servo["delay_samples"] == 0
    # At rest it reads 0.81 V; what the bias does is known as well as the hysteresis, 0.5 % of 40 µm.
    assert servo["sensor_zero"] == pytest.approx(1.0, abs=1e-2)
    finger = load(found / "cantilever.yaml", "cantilever")
    np.testing.assert_allclose(finger["dynamics.denominator"], (5.7e-8, 8.1e-6, 1.0), rtol=0.05)
    assert finger["sensor.delay_samples"] == 1
    # The watchdogs are of its size: it reaches 44 µm or so with 80 V (control-reference).
    stroke = (servo["sensor_high"] - servo["sensor_low"]) / 1.5
    assert stroke == pytest.approx(44e-6, rel=0.1)
    assert servo["model_tolerance"] == pytest.approx(0.75 * stroke)
    assert servo["cycle_amplitude"] == pytest.approx(stroke / 8)
    assert servo["frozen_voltage"] == pytest.approx(4.0)
    stand.start_servo(found)
    stand.wait(lambda: stand.phase == FingerState.RUNNING)
    assert "the finger gets -40 to 40 V, 10 V at rest" in stand.log("servo")
    stand.reference.publish(Sample(value=20e-6))
    stand.wait(lambda: stand.is_at(20e-6))
    stand.wait(lambda: stand.states[-1].on_target)
    # Nobody says how warm it is, or how hard it pushes.
    assert math.isnan(stand.states[-1].temperature) and math.isnan(stand.states[-1].tip_force)
    # A waveform, evaluated at every sample.
    wave = Waveform("triangle", 5e-6, frequency=4.0, offset=15e-6)
    stand.waveform.publish(waveform_message(wave))

    def follows_the_wave():
        block = stand.blocks[-1]
        expected = wave.at((block.number + np.arange(len(block.reference))) * block.period)
        return np.allclose(block.reference, expected, rtol=0.0, atol=1e-12)

    stand.wait(follows_the_wave)
    stand.reference.publish(Sample(value=20e-6))
    # Another controller while it runs, and what cannot be taken is refused.
    for name, taken in (("paper", True), ("robsut", False)):
        change = Parameter("controller_file", value=name).to_parameter_msg()
        answer = stand.call(
            SetParameters, "servo/set_parameters", SetParameters.Request(parameters=[change])
        )
        assert answer.results[0].successful == taken
    assert "not one of the known" in answer.results[0].reason
    stand.wait(lambda: "controller 'paper' takes over" in stand.log("servo"))
    assert "controller 'paper' (paper): it is not certified" in stand.log("servo")
    # The finger dies: held, then at rest with a fault that names it, until a reset.
    stand.finger.kill()
    stand.finger.wait()
    stand.wait(lambda: stand.phase == FingerState.FAULT)
    expected = "no reading of the sensor for 2 s: nobody answers at this address"
    assert stand.states[-1].text == expected
    assert stand.states[-1].voltage == 10.0
    stand.finger = stand.start_finger()
    assert stand.call(Trigger, "servo/reset", Trigger.Request()).success
    stand.wait(lambda: stand.phase == FingerState.RUNNING and stand.is_at(20e-6))
    # Nothing of what was published breaks a limit, and the finger saw nothing else.
    voltage = np.concatenate([block.voltage for block in stand.blocks])
    assert np.abs(np.diff(voltage)).max() <= 4.0 + 1e-9
    stand.servo.send_signal(signal.SIGHUP)  # as of a terminal that is closed
    assert stand.servo.wait(TIMEOUT) == 0
    stand.finger.terminate()
    assert stand.finger.wait(TIMEOUT) == 0
    report = json.loads((stand.folder / "report.json").read_text())
    assert report["last_voltage"] == 10.0
    assert -40.0 <= report["lowest_voltage"] and report["highest_voltage"] <= 40.0
    if not report["lost_datagrams"]:
        assert report["largest_step"] <= 4.0 + 1e-9


@pytest.mark.parametrize(
    "arguments, text",
    [
        (["-p", "driver:=nowhere"], "'driver' is 'nowhere', must be 'simulated'"),
        (["-p", "controller_file:=robsut"], "not one of the known"),
        (["-p", "write:=next_edge"], "was designed for a delay of 1 samples, this loop has 2"),
        (["-p", "feedforward_file:=/none.yaml"], "/none.yaml: cannot be read"),
    ],
)
def test_what_cannot_start_says_why(tmp_path, arguments, text):
    log = tmp_path / "servo.log"
    with log.open("wb") as out:
        command = [EXECUTABLES / "servo", "--ros-args", *arguments]
        servo = subprocess.Popen(command, stdout=out, stderr=out)
    try:
        wait(lambda: text in log.read_text(), f"'{text}' in the log")
    finally:
        servo.terminate()
        assert servo.wait(TIMEOUT) == 0
    assert "Traceback" not in log.read_text()


def test_the_client_moves_a_servo_and_hears_what_it_follows(tmp_path):
    # Other processes share this machine, so nothing is said here about time.
    command = [EXECUTABLES / "servo", "--ros-args", "-r", "__ns:=/real"]
    for name, value in (
        ("driver", "simulated"), ("late_share", 1.0), ("missed_limit", 10**6), ("hold_time", 5.0),
    ):  # fmt: skip
        command += ["-p", f"{name}:={value}"]
    with (tmp_path / "servo.log").open("wb") as log:
        servo = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
    try:
        with connect(2 * TIMEOUT) as ros:
            finger = ros.finger("real")
            finger.wait_for(lambda: finger.state and finger.state.phase == FingerState.RUNNING)
            finger.wait_for(lambda: math.isfinite(finger.newest().number))
            finger.wave(Waveform("triangle", 5e-6, frequency=2.0, offset=10e-6))
            start = finger.newest().time + LEAD_TIME
            finger.wait_for(lambda: finger.newest().time > start)
            seen = [finger.newest().reference for _ in range(20)]
            assert all(5e-6 <= reference <= 15e-6 for reference in seen)
            finger.set(5e-6)
            finger.wait_for(lambda: finger.newest().reference == 5e-6)
            low, high = finger.reach()
            assert (low, high) == (ROBUST.command_low, ROBUST.command_high)
            with pytest.raises(ClientError, match=f"of {low * 1e6:g} to {high * 1e6:g} µm"):
                finger.set(high + 1e-6)
            before = finger.state.clipped
            beyond = ros.node.create_publisher(Sample, "/real/reference", SETPOINT)
            finger.wait_for(lambda: beyond.get_subscription_count() > 0)
            beyond.publish(Sample(value=high + 5e-6))
            finger.wait_for(lambda: finger.state.clipped > before + 1000)
    finally:
        servo.terminate()
        assert servo.wait(TIMEOUT) == 0, (tmp_path / "servo.log").read_text()
