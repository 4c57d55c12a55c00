# SPDX-License-Identifier: Apache-2.0
"""The loop over topics: real node processes, real bags."""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.progress import Progress
from rosbags.highlevel import AnyReader

from piezo_control.nodes.client import connect
from piezo_control.parameters import ParameterError
from piezo_control.profile import Profile
from piezo_control.recording.recording import read
from piezo_sim.experiment import cli
from piezo_sim.experiment.cases import NODES, Case
from piezo_sim.experiment.on_engine import run_on_engine
from piezo_sim.experiment.on_nodes import grasp, servo
from piezo_sim.experiment.on_nodes.conductor import alone
from piezo_sim.experiment.on_nodes.processes import NodeDied, NodeProcesses
from piezo_sim.experiment.on_nodes.runner import run_cases

SAMPLES = 600
LOOP = ("deflection", "command", "voltage")
WARM_UP = {"profile": "ramp", "base_degc": 22.0, "amplitude_degc": 10.0, "duration": 0.05}


def closed_loop(name: str, samples: int = SAMPLES) -> Case:
    """A case that uses everything: feedback, a moving reference, warm-up and a tip force."""
    return Case(
        name=name,
        mode="feedback",
        controller="paper",
        plant="prandtl_ishlinskii",
        sample_time=1e-4,
        duration=samples * 1e-4,
        reference=Profile([0.0, 0.02, 0.04], [5e-6, 20e-6, -10e-6], linear=True),
        tip_force=Profile([0.0, 0.03], [0.0, 1e-3]),
        temperature=WARM_UP,
    )


def previewed_sine(hertz: int) -> Case:
    """A sine of ±20 µm that travels ahead, under 'robust', at 22 °C; the last 20 ms are still."""
    time = np.arange(0.0, 0.25, 1e-4)
    return Case(
        name=f"{hertz} Hz",
        mode="feedback",
        controller="robust",
        plant="prandtl_ishlinskii",
        sample_time=1e-4,
        duration=0.25,
        reference=Profile(time, 20e-6 * np.sin(2.0 * np.pi * hertz * time), linear=True),
        tip_force=Profile([0.0], [0.0]),
        temperature={"profile": "constant", "base_degc": 22.0},
        preview_band=150.0,
    )


def children() -> dict[str, int]:
    """Executable name to process id of this process' children."""
    found = {}
    for process in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        for pid in process.read_text().split():
            try:
                words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            except FileNotFoundError:
                continue
            found.update({Path(word).name: int(pid) for word in words if Path(word).name in NODES})
    return found


@pytest.fixture(scope="module")
def twin_runs(tmp_path_factory):
    """The same case twice on the same nodes, and its bags."""
    out = tmp_path_factory.mktemp("twins")
    with Progress(disable=True) as progress:
        cases = [closed_loop("first"), closed_loop("second")]
        cases.append(replace(cases[0], name="sensorless", mode="sensorless", controller="none"))
        cases += [previewed_sine(hertz) for hertz in (10, 100)]
        return list(run_cases(cases, out, "twins", progress))


def serialized(bag: Path, name: str) -> list[tuple[int, bytes]]:
    with AnyReader([bag]) as reader:
        return [(t, d) for c, t, d in reader.messages() if c.topic.endswith(f"/{name}")]


def test_two_runs_of_one_seed_are_byte_equal(twin_runs):
    first, second, *_ = (run.bag for run in twin_runs)
    end = serialized(first, "deflection")[-1][0]

    def of_the_run(bag, topic):
        # Temperatures travel ahead; how many of those after the end a recorder still hears is chance.
        return [(instant, data) for instant, data in serialized(bag, topic) if instant <= end]

    for topic in (*LOOP, "temperature"):
        samples = of_the_run(first, topic)
        assert samples == of_the_run(second, topic)
    assert len(samples) >= 60  # the temperature's grid is 1 ms, the run lasts 60 ms


def test_bag_has_every_sample_once_for_another_mcap_reader(twin_runs):
    bag = twin_runs[0].bag
    numbers: dict[str, list[int]] = {topic: [] for topic in LOOP}
    with (bag / f"{bag.name}.mcap").open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages():
            topic = channel.topic.split("/")[-1]
            if topic in LOOP:
                # CDR: 4 bytes of encapsulation, stamp, empty frame_id (length 1 and NUL), padding to 8.
                numbers[topic].append(int.from_bytes(message.data[20:28], "little"))
                assert schema.name == "piezo_gripper_msgs/msg/Sample"
                assert b"uint64 number" in schema.data
    for topic in LOOP:
        assert numbers[topic] == list(range(SAMPLES)), topic


def test_nodes_over_topics_give_the_samples_of_the_engine(twin_runs, tmp_path):
    for run in (twin_runs[0], *twin_runs[2:]):
        with Progress(disable=True) as progress:
            expected = read(run_on_engine(run.case, tmp_path, "finger", progress).bag)
        got = read(run.bag)
        np.testing.assert_allclose(got.time, expected.time, rtol=0, atol=1e-9)
        for signal_name in ("reference", "deflection", "command", "voltage", "temperature"):
            np.testing.assert_allclose(
                getattr(got, signal_name), getattr(expected, signal_name), rtol=0, atol=1e-12,
                err_msg=f"{run.case.name}: {signal_name}",
            )  # fmt: skip


@pytest.mark.parametrize("index, percent", [(3, 1.0), (4, 5.0)])
def test_a_profile_that_travels_ahead_is_followed(twin_runs, index, percent):
    """10 Hz within 1 %, 100 Hz within 5 % of ±20 µm, once settled; a reading is a sample late."""
    got = read(twin_runs[index].bag)
    error = got.deflection[1:] - got.reference[:-1]
    assert np.max(np.abs(error[1200:2300])) <= percent / 100.0 * 20e-6


@pytest.mark.parametrize("victim", list(NODES))
def test_killed_node_ends_the_experiment_by_name(victim, tmp_path):
    endless = closed_loop("endless", samples=10**6)
    with Progress(disable=True) as progress:

        def kill_when_running():
            deadline = time.monotonic() + 30
            while time.monotonic() < deadline:
                if progress.tasks and progress.tasks[0].completed > 50:
                    os.kill(children()[victim], signal.SIGKILL)
                    return
                time.sleep(0.01)

        killer = threading.Thread(target=kill_when_running)
        killer.start()
        with pytest.raises(NodeDied, match=f"'{victim}' was killed by SIGKILL"):
            list(run_cases([endless], tmp_path, "victims", progress))
        killer.join()
    assert children() == {}


TWO_FINGERS = """
import sys
from pathlib import Path
from rich.progress import Progress
from test_loop import closed_loop
from piezo_sim.experiment.on_nodes.runner import run_cases
with Progress(disable=True) as progress:
    list(run_cases([closed_loop("run", 300)], Path(sys.argv[2]), sys.argv[1], progress))
"""


def test_two_fingers_live_side_by_side(tmp_path, twin_runs):
    folder = Path(__file__).parent
    fingers = {
        side: subprocess.Popen(
            [sys.executable, "-c", TWO_FINGERS, side, tmp_path / side], cwd=folder
        )
        for side in ("left", "right")
    }
    assert {side: finger.wait(60) for side, finger in fingers.items()} == {"left": 0, "right": 0}
    alone = read(twin_runs[0].bag).deflection[:300]
    for side in fingers:
        recording = read(tmp_path / side / "bags" / "run", side)
        np.testing.assert_array_equal(recording.deflection, alone)


def test_refused_parameters_are_named(tmp_path):
    bad = replace(closed_loop("bad"), temperature={"base_degc": 500.0})
    with pytest.raises(ValueError, match=r"case 'bad': temperature: 'base_degc' is 500.0, .*150"):
        bad.parameters()


@pytest.mark.parametrize(
    "main, words, namespace",
    [(cli.main, ["step"], "/finger"), (grasp.main, [], "/left"), (servo.main, [], "/")],
    ids=["experiment", "grasp", "servo"],
)
def test_nodes_that_run_are_left_alone(main, words, namespace, tmp_path, monkeypatch, capsys):
    commands = {"feedforward": ["--ros-args", "-r", f"__ns:={namespace}", "-p", "autostart:=false"]}
    with NodeProcesses(commands, tmp_path / "log") as nodes:
        with connect(30.0) as ros:
            ros.wait(lambda: bool(ros.nodes()), lambda: "no node")
            before = ros.nodes()
        monkeypatch.setattr(sys, "argv", ["main", *words, "--out", str(tmp_path / "out")])
        assert main() == 2
        said = capsys.readouterr().err
        assert f"{namespace} has nodes already: feedforward; end them, or name another" in said
        nodes.check()
        with connect(30.0) as ros:
            ros.wait(lambda: ros.nodes() == before, lambda: f"{ros.nodes()}, not {before}")
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


def test_two_experiments_that_start_together_do_not_share_a_finger():
    """Neither has nodes that the other could see; one that is killed is in nobody's way."""
    hold = (
        "from piezo_sim.experiment.on_nodes.conductor import alone\n"
        "with alone('/finger'): print('here', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as first:
        try:
            assert first.stdout.readline() == b"here\n"
            refused = (
                r"another experiment runs in /finger of ROS domain \d+; .* another --namespace"
            )
            with pytest.raises(ParameterError, match=refused):
                with alone("/finger", instead="--namespace"):
                    pass
            with alone("/other"):
                pass
        finally:
            first.kill()
    with alone("/finger"):
        pass
