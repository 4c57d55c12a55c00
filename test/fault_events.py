# SPDX-License-Identifier: Apache-2.0
"""The kinds of things that go wrong around a finger, each a function that does it to a bench.

Where the logs must name the cause, whatever the draw, the function says with which words.
"""

from __future__ import annotations

import math
import signal
import time

from fault_bench import NODES, Bench
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from piezo_control.nodes.qos import LATCHED, SAMPLE, SETPOINT
from piezo_gripper_msgs.msg import Dynamics, FingerState, Profile, Sample, Waveform

NONSENSE = (math.nan, math.inf, -1e300, 1e6, 20.0, 5e-324)
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGKILL)
VALUES = (
    True, -1, 2**63 - 1, 1e308, math.nan, 5e-324, "", "lockstep", "/nowhere", "a\n\u0000b", [], [1.0], [1, 2], [math.inf],
    [-1.0] * 1000, ["a", "b"], [True], [b"\xff"],
)  # fmt: skip
PARAMETERS = (
    ("use_sim_time", True), ("voltage_high", 1e308), ("slew_limit", math.nan), ("ramp", 1e7),
    ("sample_time", 0.01), ("d", 1e6), ("a", [math.inf]), ("controller_file", "/nowhere"),
    ("mode", "free_running"), ("hysteresis.weights", [-1.0]), ("samples", -1), ("no", "such"),
)  # fmt: skip


def halt(bench: Bench) -> None:
    """A process stands still for a while."""
    name = bench.draw.choice([*bench.processes.running])
    process = bench.processes.running[name]
    bench.halts[name] = time.monotonic()
    process.send_signal(signal.SIGSTOP)
    bench.wait(bench.draw.choice((0.02, 0.3, 1.0)))
    process.send_signal(signal.SIGCONT)


def hurry(bench: Bench) -> None:
    """The feedforward stands still until the finger goes to rest, and somebody resets the finger on its way there."""
    client = bench.node.create_client(Trigger, "cantilever/reset")
    bench.wait(1.0, client.service_is_ready)
    bench.wait(2.0, lambda: bench.deflection > 5e-6)  # on its way to the target of the campaign
    process = bench.processes.running["feedforward"]
    process.send_signal(signal.SIGSTOP)
    bench.wait(1.0, lambda: bench.finger.phase == FingerState.RAMPING)
    bench.wait(bench.draw.choice((0.0, 0.2)))
    process.send_signal(signal.SIGCONT)
    bench.wait(bench.draw.choice((0.0, 0.01)))
    bench.wait(1.0, client.call_async(Trigger.Request()).done)
    bench.node.destroy_client(client)


def end(bench: Bench) -> None:
    """A process ends by a signal."""
    name = bench.draw.choice([*bench.processes.running])
    bench.ended.add(name)
    bench.end(name, bench.draw.choice(SIGNALS))


def restart(bench: Bench) -> None:
    """A process ends, and is started again while DDS may still believe in the first one."""
    name = bench.draw.choice(NODES)
    process = bench.processes.running[name]
    bench.end(name, bench.draw.choice(SIGNALS))
    if not bench.wait(10.0, lambda: process.poll() is not None):
        process.kill()  # nohup and shells let their children ignore some signals
        process.wait()
    bench.wait(bench.draw.choice((0.0, 0.5)))
    if name == "cantilever":
        bench.number = -1
    bench.processes.start(name)


def transition(bench: Bench) -> None:
    """Any transition of any node, most of them impossible; at times there and back."""
    name = bench.draw.choice(NODES)
    numbers = bench.draw.choice(
        (
            [bench.draw.choice((0, 1, 2, 3, 4, 7, 8, 10, 60, 99, 255))],
            [4, 3],
            [4, 2, 1, 3],
            [3] * 20,
        )
    )
    for number in numbers:
        bench.ended |= {name} if number in (2, 4, 7) else set()
        bench.call(ChangeState, f"{name}/change_state",
                   ChangeState.Request(transition=Transition(id=number)))  # fmt: skip
    if numbers == [3] * 20:
        bench.missing.append(("transition 3 is not possible",))


def parameter(bench: Bench) -> None:
    """A parameter that is refused, or taken, with a reason."""
    name, value = bench.draw.choice(
        (*PARAMETERS, (bench.draw.choice(PARAMETERS)[0], bench.draw.choice(VALUES)))
    )
    parameters = [Parameter(name, value=value).to_parameter_msg()]
    kind, service = bench.draw.choice(
        ((SetParameters, "set_parameters"), (SetParametersAtomically, "set_parameters_atomically"))
    )
    node = bench.draw.choice(NODES)
    answer = bench.call(kind, f"{node}/{service}", kind.Request(parameters=parameters))
    if answer:
        results = answer.results if kind is SetParameters else [answer.result]
        for result in results:
            if not (result.successful or result.reason):
                bench.broken(f"{node} refused {name} = {value!r} without a reason")


def ask(bench: Bench) -> None:
    """The other services, with names that do not exist and depths that make no sense, and resets."""
    node = bench.draw.choice(NODES)
    names = ["", "no.such", "a" * 10_000, "use_sim_time"]
    for kind, service, request in (
        (DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names)),
        (GetParameters, "get_parameters", GetParameters.Request(names=names)),
        (
            ListParameters,
            "list_parameters",
            ListParameters.Request(prefixes=names, depth=2**64 - 1),
        ),
        (Trigger, "reset", Trigger.Request()),
    ):
        bench.call(kind, f"{node}/{service}", request)


def intrude(bench: Bench) -> None:
    """A second publisher of a topic of the loop, with nonsense, stray numbers, or quick swings."""
    topic = bench.draw.choice(("voltage", "command", "deflection", "reference"))
    bench.foreign.add(topic)
    publisher = bench.node.create_publisher(Sample, topic, SAMPLE)
    for k in range(bench.draw.choice((1, 30))):
        value = bench.draw.choice((*NONSENSE, 39.0 * (-1) ** k, 2e-5 * (-1) ** k))
        number = bench.draw.choice((0, k, bench.number + 1, 2**64 - 1))
        publisher.publish(Sample(number=max(0, number), value=value))
        bench.wait(0.005)
    bench.node.destroy_publisher(publisher)
    if topic != "reference":
        # A node that was busy meanwhile learns only that there was one.
        bench.missing.append(("has 2 publishers: ", "came and went"))


def misfit(bench: Bench) -> None:
    """A publisher that readers cannot hear, and a reader that cannot hear the publisher."""
    topic = bench.draw.choice(("voltage", "command", "deflection"))
    publisher = bench.node.create_publisher(Sample, topic, qos_profile_sensor_data)
    reader = bench.node.create_subscription(Sample, topic, lambda _: None, LATCHED)
    for _ in range(20):
        publisher.publish(Sample(value=math.nan))
        bench.wait(0.01)
    bench.node.destroy_publisher(publisher)
    bench.node.destroy_subscription(reader)
    bench.missing.append(("is not heard: ",))


def refer(bench: Bench) -> None:
    """Set-points, most of them nonsense."""
    for value in (1.7e308, *(bench.draw.choice((*NONSENSE, -2e-5, 2e-5, 1e-5)) for _ in range(20))):
        bench.reference.publish(Sample(value=value))
        bench.wait(0.01)
    bench.missing.append(("'reference' ignored: ",))


def babble(bench: Bench) -> None:
    """Nonsense on the topics that are sent now and then, on which nobody minds a second publisher."""
    wild = bench.draw.choice(NONSENSE[:4])
    sent, qos, words = bench.draw.choice(
        (
            (Sample(value=wild), SETPOINT, "tip_force"),
            (Profile(time=[0.0, wild], value=[wild, 0.0]), LATCHED, "reference_profile"),
            (Profile(time=[0.0], value=[wild]), LATCHED, "tip_force_profile"),
            (Waveform(amplitude=wild, frequency=wild), SETPOINT, "reference_waveform"),
            (Temperature(temperature=wild), SAMPLE, "temperature"),
            (Dynamics(denominator=[wild], elastic_constant=wild), LATCHED, "dynamics"),
        )
    )
    publisher = bench.node.create_publisher(type(sent), words, qos)
    if bench.wait(2.0, lambda: publisher.get_subscription_count() > 0):
        bench.missing.append((f"'{words}' ignored: ", f"'{words}' is {wild}", f"/{words}: "))
    for _ in range(5):
        publisher.publish(sent)
        bench.wait(0.02)
    bench.node.destroy_publisher(publisher)


def flood(bench: Bench) -> None:
    """More set-points than anybody needs."""
    for k in range(5000):
        bench.reference.publish(Sample(value=1e-9 * (k % 1000)))
        if k % 100 == 0:
            bench.wait(0.001)


def disturb(bench: Bench) -> None:
    """Samples on their way are lost, delayed and overtaken for a while."""
    assert bench.link
    bench.link.disturb(*bench.draw.choice(((0.3, 0.0, 0.0), (0.0, 0.3, 0.3), (0.2, 0.2, 0.05))))
    bench.wait(bench.draw.uniform(0.5, 2.0))
    bench.link.disturb(0.0, 0.0, 0.0)


def cut(bench: Bench) -> None:
    """The link to the other network is cut, for a moment or for longer than anybody waits."""
    assert bench.processes.network
    bench.processes.network.set("down")
    bench.wait(bench.draw.choice((0.3, 1.0, 4.0)))
    bench.processes.network.set("up")


ALWAYS = (
    halt,
    hurry,
    end,
    restart,
    transition,
    parameter,
    ask,
    intrude,
    misfit,
    refer,
    babble,
    flood,
)
