# SPDX-License-Identifier: Apache-2.0
"""The servo that feels: its law against the engine's, a finger in real time, and a gripper of two servos."""

import io
import math
import signal
import subprocess
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
import yaml
from rich.console import Console

pytest.importorskip("numba")

from test_servo import EXECUTABLES, PATIENT, TIMEOUT, wait

from piezo_control.dynamics import DynamicsParameters
from piezo_control.feedback import FeedbackParameters, read_controller
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.gripper import AT_LIMIT, GripperParameters
from piezo_control.nodes import fingerctl
from piezo_control.nodes.client import ClientError, connect
from piezo_control.nodes.parameters import ServoNodeParameters, check_force, read_feedforward
from piezo_control.parameters import ParameterError
from piezo_control.profile import Profile
from piezo_control.safety import FAULT, NORMAL
from piezo_control.sensorless import SensorlessParameters
from piezo_control.servo import law
from piezo_control.servo.driver import FRESH
from piezo_control.servo.law import feeling_of, laws_of, servo_step, settings_of, watch_at_rest
from piezo_control.servo.loop import Servo
from piezo_control.servo.parameters import ServoParameters
from piezo_control.thermal import REFERENCE_DEGC
from piezo_control.touch import TouchParameters, push_of
from piezo_gripper_msgs.msg import FingerState
from piezo_sim.driver import Simulation
from piezo_sim.engine import run_touching
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.plant.contact import ContactParameters
from piezo_sim.plant.sensor import SensorParameters
from piezo_sim.temperature import TemperatureParameters

H = 1e-4  # s
OPEN_LOOP = FeedbackParameters(controller="none")  # gives sample time and range of the command
LIMIT = 0.5e-3  # N
WALL = ContactParameters(stiffness=3000.0, damping=0.05, free_play=5e-6)
DEFAULTS = TouchParameters()


def feeling(degc=REFERENCE_DEGC):
    return feeling_of(DEFAULTS, SensorlessParameters(), OPEN_LOOP, degc)


class Bench:
    """The law of a servo that feels, without its clock, on a cantilever."""

    def __init__(self, plant):
        feedforward = FeedforwardParameters()
        self.settings = settings_of(ServoParameters(), feedforward, H, feels=True)
        self.laws = laws_of(OPEN_LOOP, Feedforward(feedforward, H), feeling())
        self.watch = watch_at_rest()
        self.plant = Cantilever(plant)
        self.voltages, self.pushes = [], []

    def step(self, reference, max_force, degc=REFERENCE_DEGC):
        feels = self.laws.feeling
        feels.max_force[0] = max_force
        feels.temperature[0] = degc
        voltage = servo_step(
            self.settings,
            self.laws,
            self.watch,
            0,
            FRESH,
            self.plant.measure(),
            0.0,
            reference,
            1.0,
        )
        self.plant.advance(voltage, degc)
        self.voltages.append(voltage)
        self.pushes.append(push_of(feels.touch, feels.touch_state))


def test_the_law_gives_the_samples_of_the_engine():
    """From the first contact to the held force; the engine's feedforward is solved in another order."""
    plant = CantileverParameters(contact=WALL, sensor=SensorParameters(noise=0.0, resolution=0.0))
    reference = Profile([0.0, 0.05], [0.0, 10e-6], linear=True)
    samples = 1500
    expected, push = run_touching(
        plant, DEFAULTS, SensorlessParameters(), TemperatureParameters(), reference,
        Profile([0.0], [LIMIT]), samples,
    )  # fmt: skip
    bench = Bench(plant)
    for number in range(samples):
        bench.step(float(reference.at(number * H)), LIMIT)
    np.testing.assert_allclose(bench.voltages, expected.voltage, rtol=0, atol=1e-6)
    np.testing.assert_allclose(bench.pushes, push, rtol=0, atol=1e-9)
    assert bench.watch.phase[0] == NORMAL
    assert -bench.plant.tip_force == pytest.approx((1.0 - DEFAULTS.force_margin) * LIMIT, rel=0.03)


def test_after_a_fault_the_force_is_met_anew():
    bench = Bench(CantileverParameters(contact=WALL))
    for _ in range(1000):
        bench.step(10e-6, LIMIT)
    assert -bench.plant.tip_force == pytest.approx(LIMIT, rel=0.1)
    law.trip(bench.watch, law.STOPPED, 0.0)
    for _ in range(1000):
        bench.step(10e-6, LIMIT)
    assert bench.watch.phase[0] == FAULT and bench.voltages[-1] == 0.0
    law.rearm(bench.watch)
    strongest = 0.0
    for _ in range(2000):
        bench.step(10e-6, LIMIT)
        strongest = max(strongest, -bench.plant.tip_force)
    # The estimate on this plant is good to 0.05 mN (docs/touch.md).
    assert LIMIT - 0.05e-3 < strongest < LIMIT + 0.05e-3


def test_a_finger_in_real_time_stops_at_a_wall(tmp_path):
    """However late the loop is served: the sensor's quantum of 10 nm is 0.03 mN of a free tip."""
    file = tmp_path / "wall.yaml"
    contact = {"stiffness": 3000.0, "damping": 0.05, "free_play": 5e-6}
    file.write_text(yaml.safe_dump({"cantilever": {"ros__parameters": {"contact": contact}}}))
    servo = Servo(
        Simulation(str(file), H), PATIENT, read_controller("robust"), FeedforwardParameters(),
        feeling=feeling(),
    )  # fmt: skip
    pushes = []

    def presses():
        servo.look_ahead()
        pushes.extend(servo.samples().push)
        return len(pushes) > 5000 and min(pushes[-2000:]) > 0.9 * LIMIT

    servo.start()
    try:
        wait(lambda: servo.number > 100)
        servo.feel(REFERENCE_DEGC)
        servo.refer(Profile([0.0], [15e-6]), LIMIT)
        wait(presses, "the force")
        device = servo.driver.device
        assert -device.state.tip_force[0] == pytest.approx(LIMIT, abs=0.08e-3)
        assert max(pushes) < 1.3 * LIMIT
        # A reset of a finger that runs leaves nothing, least of all the knowledge of how hard it pushes.
        for _ in range(3):
            servo.reset()
            number = servo.number
            wait(lambda after=number + 200: servo.look_ahead() or servo.number > after)
        assert -device.state.tip_force[0] == pytest.approx(LIMIT, abs=0.08e-3)
        servo.give_up_without_temperature()
        wait(lambda: servo.phase == FAULT)
        assert servo.cause == "the temperature is missing or frozen"
        servo.reset()
        wait(lambda: servo.phase == NORMAL)
    finally:
        servo.stop()


def test_the_force_is_told_by_the_elastic_constant_of_the_feedforwards_file(tmp_path):
    """What `identify stiffness` writes; with the paper's one a finger of 1e-3 m/N pushes with 3.1 times the limit."""
    stiff = DynamicsParameters(elastic_constant=1e-3)
    felt = feeling_of(DEFAULTS, SensorlessParameters(dynamics=stiff), OPEN_LOOP, 22.0)
    assert felt.touch.elastic_constant == 1e-3
    run, push = run_touching(
        CantileverParameters(contact=WALL, dynamics=stiff),
        DEFAULTS,
        SensorlessParameters(dynamics=stiff),
        TemperatureParameters(),
        Profile([0.1, 0.3], [0.0, 15e-6], linear=True),
        Profile([0.0], [LIMIT]),
        8000,
    )
    assert np.max(-run.total_force) < 1.1 * LIMIT
    assert push[-1] == pytest.approx((1.0 - DEFAULTS.force_margin) * LIMIT, rel=0.02)


@pytest.mark.parametrize(
    "values, said",
    [
        ({"dynamics": {"denominator": [5.7e-8, 8.1e-6, 1.0]}}, "'dynamics.elastic_constant' is missing"),
        (
            {"dynamics": {"elastic_constant": 1e-3, "denominator": [2.5e-6, 5.4e-5, 1.0]}},
            r"swings up on a finger of 100\.7 Hz .* 'touch.position_rate' is 30.2",
        ),
    ],
)  # fmt: skip
def test_a_finger_whose_force_nobody_knows_or_that_swings_up_is_refused(values, said, tmp_path):
    file = tmp_path / "feedforward.yaml"
    file.write_text(yaml.safe_dump({"/**/feedforward": {"ros__parameters": values}}))
    parameters = ServoNodeParameters(force_control=True, feedforward_file=str(file))
    with pytest.raises(ParameterError, match=said):
        check_force(parameters, read_feedforward(parameters), H)


@contextmanager
def servo_node(folder, **parameters):
    words = [w for n, v in parameters.items() for w in ("-p", f"{n}:={v}")]
    with (folder / "servo.log").open("wb") as log:
        process = subprocess.Popen(
            [EXECUTABLES / "servo", "--ros-args", *words], stdout=log, stderr=log
        )
        try:
            with connect(TIMEOUT) as ros:
                yield ros.finger("")
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(TIMEOUT) == 0


def test_a_reset_without_a_temperature_moves_nothing(tmp_path):
    """The cause persists: the finger went up by half its way at each reset, until it was seen again."""
    feels = {"force_control": "true", "missed_limit": 10**6, "late_share": 1.0, "hold_time": 60.0}
    lost = {"thermometer.fallback": "fault", "thermometer.timeout": 0.01}
    with servo_node(tmp_path, **feels, **lost) as finger:
        finger.wait_for(lambda: finger.state and finger.state.phase == FingerState.FAULT)
        with pytest.raises(ClientError, match="temperature missing: none for 0.01 s"):
            finger.reset()
        assert finger.state.times == 1
    log = (tmp_path / "servo.log").read_text()
    assert "with force control" in log and "robust" not in log
    assert "none for 0.01 s; that ends at rest" in log and "models go on" not in log


@contextmanager
def gripper_of_servos(folder):
    """Start two servos that feel, each with a wall in front of its simulated finger, and the gripper."""
    contact = {"stiffness": 3000.0, "damping": 0.05, "free_play": 5e-6}
    plant = folder / "wall.yaml"
    plant.write_text(yaml.safe_dump({"cantilever": {"ros__parameters": {"contact": contact}}}))
    servo = {
        "driver_options": str(plant), "force_control": True, "missed_limit": 10**6, "late_share": 1.0,
        "state_period": 0.01, "hold_time": 60.0, "age_limit": 10.0,
    }  # fmt: skip
    nodes = {"servo": servo, "gripper": {"state_timeout": 20.0}}
    file = folder / "parameters.yaml"
    file.write_text(yaml.safe_dump({f"/**/{n}": {"ros__parameters": p} for n, p in nodes.items()}))
    words = ["--ros-args", "--params-file", file]
    commands = {side: ["servo", *words, "-r", f"__ns:=/{side}"] for side in ("left", "right")}
    commands["gripper"] = ["gripper", *words]
    processes = []
    with ExitStack() as stack:
        for name, (executable, *arguments) in commands.items():
            log = stack.enter_context((folder / f"{name}.log").open("wb"))
            processes.append(
                subprocess.Popen([EXECUTABLES / executable, *arguments], stdout=log, stderr=log)
            )
        try:
            yield stack.enter_context(connect(TIMEOUT))
        finally:
            for process in processes:
                process.send_signal(signal.SIGTERM)
            codes = [process.wait(TIMEOUT) for process in processes]
    assert codes == [0, 0, 0]


def test_a_gripper_of_two_servos_grasps_and_lets_go(tmp_path):
    with gripper_of_servos(tmp_path) as ros:
        gripper = ros.gripper()
        grasped = gripper.grasp(LIMIT, 200e-6)
        assert AT_LIMIT * LIMIT <= grasped.force < 1.3 * LIMIT
        opening = GripperParameters().rest_opening - 2 * (WALL.free_play + LIMIT / WALL.stiffness)
        assert grasped.opening == pytest.approx(opening, abs=0.15e-6)
        finger = ros.finger("left")
        finger.wait_for(lambda: finger.state and finger.state.phase == FingerState.RUNNING)
        setup = finger.setup()
        assert setup.controller == "force control"
        assert setup.force_limit == DEFAULTS.force_limit
        # Nobody publishes a temperature here, and that is said where people look.
        finger.wait_for(lambda: finger.state.text == "temperature missing: none for 5 s")
        assert math.isnan(finger.state.temperature)
        finger.wait_for(lambda: finger.state.tip_force >= AT_LIMIT * LIMIT)
        text = io.StringIO()
        arguments = fingerctl.parse(["-f", "left", "state"])
        assert fingerctl.carry_out(ros, arguments, Console(file=text, width=120)) == 0
        assert gripper.release(200e-6).reached_goal
    left = (tmp_path / "left.log").read_text()
    assert "temperature missing: none for 5 s; the models go on with" in left
    assert "Traceback" not in left
