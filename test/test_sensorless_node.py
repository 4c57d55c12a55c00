# SPDX-License-Identifier: Apache-2.0
"""The feedforward node without a sensor: temperatures on the grid, missing and frozen ones, the hand-over."""

import time

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger
from test_nodes import neighbour

from piezo_control.adaptation import AdaptationParameters
from piezo_control.nodes.profile_input import waveform_message
from piezo_control.nodes.qos import SAMPLE
from piezo_control.parameters import dump
from piezo_control.sensorless import Sensorless, SensorlessParameters
from piezo_control.waveform import Waveform
from piezo_gripper_msgs.msg import Sample
from piezo_gripper_msgs.msg import Waveform as WaveformMessage
from piezo_sim.experiment.on_nodes.processes import NodeProcesses

__all__ = ["neighbour"]  # a fixture of another module
H = 1e-4
TIMEOUT = 60.0  # s, generous: the tests wait on conditions


class Loop:
    """What stands around the node: it sends commands and temperatures, and listens."""

    def __init__(self):
        self.node = rclpy.create_node("neighbour")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.command = self.node.create_publisher(Sample, "command", SAMPLE)
        self.deflection = self.node.create_publisher(Sample, "deflection", SAMPLE)
        self.temperature = self.node.create_publisher(Temperature, "temperature", SAMPLE)
        self.voltages = {}
        self.said = {}
        self.node.create_subscription(Sample, "voltage", self._on_voltage, SAMPLE)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def wait(self, done):
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, f"nothing came; it says {self.said}"
            self.executor.spin_once(timeout_sec=0.02)

    def warm(self, number, degc):
        stamp = round(number * H * 1e9)
        message = Temperature(temperature=degc)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        self.temperature.publish(message)

    def ask(self, number, value, by_controller=False):
        """Send a command again and again until its voltage is there; return that."""
        asked = Sample(number=number, value=value, by_controller=by_controller)
        over = False  # a timer that is due when it is destroyed is served still, now and then
        send = self.node.create_timer(0.05, lambda: over or self.command.publish(asked))
        self.command.publish(asked)
        self.wait(lambda: number in self.voltages)
        over = True
        self.node.destroy_timer(send)
        return self.voltages[number]

    def reset(self):
        """Ask the node to leave its fault; return its answer."""
        client = self.node.create_client(Trigger, "feedforward/reset")
        self.wait(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.wait(future.done)
        return future.result()

    def _on_voltage(self, message):
        self.voltages[message.number] = message

    def _on_diagnostics(self, message):
        (status,) = message.status
        self.said = {"": status.message, **{v.key: v.value for v in status.values}}


@pytest.fixture
def start(tmp_path):
    """A function that starts the node with parameters and returns what stands around it."""
    rclpy.init()
    loop = Loop()
    started = []

    def begin(**parameters):
        file = tmp_path / "mine.yaml"
        dump(file, "feedforward", {"compensator": "sensorless", **parameters})
        words = ["--ros-args", "--params-file", str(file)]
        started.append(NodeProcesses({"feedforward": words}, tmp_path).__enter__())
        # The node's half of each topic is there before anything is sent.
        loop.wait(lambda: loop.temperature.get_subscription_count() > 0)
        loop.wait(lambda: loop.command.get_subscription_count() > 0)
        return loop

    yield begin
    for processes in started:
        processes.stop()
    loop.executor.shutdown()
    loop.node.destroy_node()
    rclpy.shutdown()


def test_each_sample_waits_for_its_temperature_and_a_sensor_may_go_in_mid_run(start, tmp_path):
    law = Sensorless(SensorlessParameters(), H, 30.0)
    loop = start(temperature_lockstep=True, temperature_period=H)
    temperatures = [30.0, 31.0, 45.0, 45.0]  # they travel ahead
    for number, degc in enumerate(temperatures):
        loop.warm(number, degc)
    expected = [law.lead(6e-6, degc) for degc in temperatures]
    got = [loop.ask(number, 6e-6, by_controller=True).value for number in range(4)]
    # The sensor is taken away: the reference itself comes, and waits for its temperature.
    loop.command.publish(Sample(number=4, value=5e-6))
    loop.wait(lambda: loop.said.get("") == "sample 4 waits for its temperature")
    loop.warm(4, 40.0)
    loop.wait(lambda: 4 in loop.voltages)
    assert [*got, loop.voltages[4].value] == [*expected, law.step(5e-6, 40.0)]
    assert got[-1] > 10.0
    assert abs(loop.voltages[4].value - got[-1]) < 5e-3  # no bump: heat and creep of 0.1 ms
    assert float(loop.said["body temperature"]) > 30.0


def test_models_adapt_to_the_deflection_that_each_command_answers(start):
    parameters = AdaptationParameters(time_constant=0.01)
    law = Sensorless(SensorlessParameters(adaptation=parameters), H, 22.0)
    loop = start(**{"adaptation.time_constant": 0.01})
    loop.wait(lambda: loop.deflection.get_subscription_count() > 0)
    readings = [0.0, 1e-6, 4e-6, 7e-6]
    loop.command.publish(Sample(number=0, value=6e-6, by_controller=True))
    loop.wait(lambda: loop.said.get("") == "sample 0 waits for its deflection")
    for number, reading in enumerate(readings):
        loop.deflection.publish(Sample(number=number, value=reading))
        voltage = loop.ask(number, 6e-6, by_controller=True).value
        assert voltage == law.lead(6e-6, 22.0, deflection=reading)
    # The sensor is taken away: the reference itself comes, with no deflection to wait for.
    assert loop.ask(4, 6e-6).value == law.step(6e-6, 22.0)
    assert law.state.adapted.gain[0] != 1.0


@pytest.mark.parametrize("fallback", ["hold", "fault"])
def test_a_missing_temperature_is_named_and_the_last_one_goes_on_or_the_finger_rests(
    start, tmp_path, fallback
):
    loop = start(**{"thermometer.timeout": 0.3, "thermometer.fallback": fallback})

    def is_warm():
        loop.warm(0, 25.0)
        return loop.said.get("temperature") == "25.0"

    loop.wait(is_warm)  # on a busy machine a temperature is missing before the first one comes, too
    if fallback == "fault":
        number = 0
        while not loop.voltages or "missing" not in loop.said.get("", ""):
            loop.command.publish(Sample(number=number, value=10e-6))
            loop.executor.spin_once(timeout_sec=0.02)
            number = max(loop.voltages, default=-1) + 1
        loop.wait(lambda: loop.voltages[max(loop.voltages)].value == 0.0)
        assert loop.said[""] == "temperature missing: none for 0.3 s"
        refused = loop.reset()
        assert not refused.success
        assert refused.message == f"{loop.said['']}, and 'thermometer.fallback' is 'fault'"
        loop.warm(0, 26.0)
        loop.wait(lambda: loop.reset().success)
        return
    loop.wait(lambda: loop.ask(max(loop.voltages, default=-1) + 1, 10e-6).without_temperature)
    log = (tmp_path / "feedforward.log").read_text()
    assert "temperature missing: none for 0.3 s; the models go on with 25 °C" in log
    loop.warm(0, 26.0)
    loop.wait(lambda: not loop.ask(max(loop.voltages) + 1, 10e-6).without_temperature)
    loop.wait(lambda: loop.said[""] == "active")


def test_models_without_an_inverse_are_refused_at_start(tmp_path):
    file = tmp_path / "mine.yaml"
    dump(file, "feedforward", {"compensator": "sensorless", "temperature_high": 150.0,
                               "thermal.lag_per_degc": 0.02})  # fmt: skip
    with NodeProcesses({"feedforward": ["--ros-args", "--params-file", str(file)]}, tmp_path) as p:
        assert p.running["feedforward"].wait(TIMEOUT) == 2
    assert "leave no inverse at 150 °C" in (tmp_path / "feedforward.log").read_text()


def test_the_sensor_of_a_finger_that_moves_goes_in_mid_run_without_a_bump(neighbour, tmp_path):
    """All nodes, 15 µm at 2 Hz: 34 mV a sample at most; the shaper is late by 0.75 ms, 1 % of the amplitude."""
    wave = Waveform("sine", 15e-6, frequency=2.0)
    sensorless = ["-p", "compensator:=sensorless", "-p", "adaptation.time_constant:=1.0"]
    arguments = {
        "feedforward": ["--ros-args", *sensorless, "-p", "subscribers:=2"],
        "feedback": ["--ros-args", "-p", "subscribers:=2"],
        "cantilever": ["--ros-args", "-p", "subscribers:=3"],
    }
    with NodeProcesses(arguments, tmp_path):
        waves = neighbour.node.create_publisher(WaveformMessage, "reference_waveform", SAMPLE)
        deflections, commands, voltages = (
            neighbour.listen(Sample, topic) for topic in ("deflection", "command", "voltage")
        )
        neighbour.wait(lambda: waves.get_subscription_count())
        waves.publish(waveform_message(wave))
        neighbour.wait(lambda: voltages and voltages[-1].number > 3000)
        assert neighbour.set("feedback", controller="none").successful
        until = voltages[-1].number + 4000
        neighbour.wait(
            lambda: all(samples[-1].number > until for samples in (voltages, commands, deflections))
        )
    voltage = {v.number: v.value for v in voltages}
    command = {c.number: c for c in commands}
    alone = min(n for n, c in command.items() if n > 3000 and not c.by_controller)
    around = [voltage[n] for n in range(alone - 20, alone + 20)]
    assert np.max(np.abs(np.diff(around))) < 0.1
    wanted = {n: c.value for n, c in command.items() if n >= alone}
    late = 8  # samples: of the shaper
    errors = [
        d.value - wanted[d.number - late]
        for d in deflections
        if d.number - late in wanted and d.number > alone + 100
    ]
    assert len(errors) > 1000
    assert np.max(np.abs(errors)) < 0.03 * 15e-6
