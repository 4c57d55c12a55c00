# SPDX-License-Identifier: Apache-2.0
"""The gripper: its law, and the action in front of two simulated fingers, with real processes."""

import math
import os
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from action_msgs.msg import GoalStatus
from ament_index_python.packages import get_package_prefix
from hypothesis import given
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from piezo_control.gripper import (
    REST_TIME,
    Goal,
    GripperParameters,
    Motion,
    Waypoint,
    check_goal,
    check_trajectory,
    force_of,
    opening_of,
    reach,
)
from piezo_control.nodes.qos import FOLLOWED, LATCHED, SETPOINT
from piezo_control.parameters import ParameterError, build
from piezo_gripper_msgs.action import Grip
from piezo_gripper_msgs.msg import FingerState, Sample
from piezo_gripper_msgs.msg import Profile as ProfileMessage

EXECUTABLES = Path(get_package_prefix("piezo_gripper")) / "lib" / "piezo_gripper"
TIMEOUT = 90.0  # s, generous: the tests wait on conditions
SIDES = ("left", "right")
DEFAULTS = GripperParameters()

# --- the law ----------------------------------------------------------------------------------------


@given(
    opening=st.floats(0.0, 80e-6),
    start=st.floats(-20e-6, 20e-6),
    speed=st.floats(1e-6, 1e-3),
    time=st.floats(0.0, 100.0),
)
def test_a_line_goes_from_the_reference_to_half_the_way_at_half_the_speed(
    opening, start, speed, time
):
    motion = Motion(DEFAULTS, Goal(opening, 1e-3, speed), [start, start])
    line = motion.depart(0, time, start)
    assert opening_of(DEFAULTS, 2 * [line.at(math.inf)]) == pytest.approx(opening, abs=1e-15)
    if line.time.size == 2:
        assert (line.time[0], line.value[0]) == (time, start)
        way, duration = abs(line.value[1] - start), line.time[1] - time
        assert way == pytest.approx(duration * speed / 2, abs=speed * 1e-13)  # 100 s have 53 bits


NO_PUSH = [0.0, 0.0]
NUMB = [math.nan, math.nan]


def test_force_is_the_larger_push_and_a_pull_is_none():
    assert force_of([2e-3, 1e-3]) == 2e-3
    assert force_of([-3e-3, 1e-3]) == 1e-3
    assert force_of([-3e-3, 0.0]) == 0.0
    assert math.isnan(force_of([math.nan, 1e-3]))


def closing(opening=20e-6, max_force=1e-3):
    """A motion from rest at 20 µm/s, departed at time 1 s: (40 - 20) µm last 1 s."""
    motion = Motion(DEFAULTS, Goal(opening, max_force, 20e-6), [0.0, 0.0])
    for finger in (0, 1):
        motion.depart(finger, 1.0, 0.0)
    return motion


def decided(motion, times, deflections, pushes):
    """Decide when the tips have been in place for the time of rest."""
    before = [time - 1.1 * REST_TIME for time in times]
    assert motion.decide(before, deflections, pushes) is None
    return motion.decide(times, deflections, pushes)


@pytest.mark.parametrize("pushes", [NO_PUSH, NUMB])
def test_opening_counts_as_reached_only_when_both_ramps_are_over(pushes):
    there = [10e-6, 10e-6]
    assert decided(closing(), [2.1, 1.9], there, pushes) is None
    outcome = decided(closing(), [2.1, 2.0], there, pushes)
    assert (outcome.success, outcome.reached_goal, outcome.stalled) == (True, True, False)


def test_a_success_is_of_fingers_at_rest():
    motion = closing()
    swinging = [(2.0 + 0.01 * n, 10e-6 + (-1) ** n * 0.09e-6) for n in range(20)]
    for instant, place in swinging:  # within the tolerance of the opening, never in place
        assert motion.decide([instant, instant], [place, 10e-6], NO_PUSH) is None


def test_motion_that_has_not_departed_is_not_over():
    motion = Motion(DEFAULTS, Goal(20e-6, 1e-3, 20e-6), [10e-6, 10e-6])
    motion.depart(0, 5.0, 10e-6)
    assert decided(motion, [9.0, 9.0], [10e-6, 10e-6], NO_PUSH) is None


def test_fingers_that_come_no_further_have_stalled_after_the_settling_time():
    short, pushes = [8e-6, 8e-6], [5e-4, 5e-4]
    assert decided(closing(), [2.5, 2.5], short, pushes) is None
    outcome = decided(closing(), [2.51, 2.51], short, pushes)
    assert (outcome.success, outcome.reached_goal, outcome.stalled) == (False, False, True)
    assert "+4.00 µm from the opening" in outcome.text


def test_fingers_that_are_there_when_a_busy_machine_looks_again_have_reached_it():
    motion, there = closing(), [10e-6, 10e-6]
    assert motion.decide([1.5, 1.5], [5e-6, 5e-6], NO_PUSH) is None  # and then nothing for 3 s
    outcome = decided(motion, [4.6, 4.6], there, NO_PUSH)
    assert (outcome.success, outcome.reached_goal, outcome.stalled) == (True, True, False)


def test_fingers_that_swing_about_the_opening_have_stalled_after_the_settling_time():
    motion = closing()
    swinging = [(2.0 + 0.01 * n, 10e-6 + (-1) ** n * 0.09e-6) for n in range(100)]
    ends = [motion.decide([instant] * 2, [place, 10e-6], NO_PUSH) for instant, place in swinging]
    (end, *_) = filter(None, ends)
    assert not end.success and end.stalled
    after = 0.01 * ends.index(end)
    assert DEFAULTS.settling_time < after <= DEFAULTS.settling_time + 2.0 * REST_TIME + 0.02


def test_force_ends_closing_when_both_fingers_are_there_and_does_not_hinder_opening():
    both, one = [1e-3, 0.95e-3], [0.0, 1e-3]
    outcome = decided(closing(), [1.5, 1.5], [5e-6, 5e-6], both)
    assert (outcome.success, outcome.reached_goal, outcome.stalled) == (True, False, True)
    assert decided(closing(), [1.5, 1.5], [5e-6, 5e-6], one) is None  # the other is on its way
    assert decided(closing(), [2.0, 1.5], [10e-6, 5e-6], one).stalled  # and now at its end
    motion = Motion(DEFAULTS, Goal(40e-6, 1e-3, 20e-6), [5e-6, 5e-6])
    assert decided(motion, [1.5, 1.5], [5e-6, 5e-6], both) is None


def test_a_force_above_the_limit_has_to_ease_first():
    """A stiff object hardly moves the tips meanwhile; 1/0.9 of the limit of 1 mN is as near as 0.9 of it."""
    motion, place = closing(), [5e-6, 5e-6]
    assert decided(motion, [1.5, 1.5], place, [1e-3, 1.12e-3]) is None
    assert motion.decide([1.6, 1.6], place, [1e-3, 1.11e-3]).stalled


@pytest.mark.parametrize("opening, closes", [(28.5e-6, True), (29.9e-6, False), (31e-6, False)])
def test_a_goal_short_of_references_that_hold_a_force_closes_if_the_tips_have_to(opening, closes):
    """Tips at 5 µm, so 30 µm apart, are within half the tolerance of 29.9 µm; their references are 1 µm ahead."""
    motion = Motion(DEFAULTS, Goal(opening, 0.2e-3, 20e-6), [5e-6, 5e-6])
    for finger in (0, 1):
        motion.depart(finger, 1.0, 6e-6)
    outcome = decided(motion, [1.5, 1.5], [5e-6, 5e-6], [0.2e-3, 0.2e-3])
    assert motion.closing is closes
    assert (outcome is not None and outcome.stalled) is closes


@pytest.mark.parametrize("period", [0.05, 0.1])
@pytest.mark.parametrize("speed", [0.2e-6, 0.5e-6, 0.9e-6, 1.9e-6])
@pytest.mark.parametrize("waypoints", [(), (Waypoint(20e-6, 0.0),)])
def test_a_tip_that_moves_with_its_line_does_not_rest(period, speed, waypoints):
    """Within the rest time it goes less than half a tolerance; both goals move a tip at `speed` (m/s)."""
    waypoints = tuple(Waypoint(20e-6 / speed, w.opening) for w in waypoints)
    goal_speed = DEFAULTS.speed_limit if waypoints else 2.0 * speed
    motion = Motion(DEFAULTS, Goal(0.0, 1e-3, goal_speed, waypoints), [0.0, 0.0])
    for finger in (0, 1):
        motion.depart(finger, 0.0, 0.0)
    for now in period * np.arange(1, 50):
        places = [speed * now] * 2
        assert motion.decide([now] * 2, places, [0.91e-3] * 2) is None
    for now in period * np.arange(50, 80):  # and now they stand
        outcome = motion.decide([now] * 2, places, [0.91e-3] * 2)
    assert outcome and outcome.stalled


def test_goal_takes_defaults_for_zero():
    assert check_goal(DEFAULTS, 0.0, 0.0, 0.0) == Goal(0.0, 5e-3, 20e-6)
    assert check_goal(DEFAULTS, 8e-5, 1e-3, 1e-4) == Goal(8e-5, 1e-3, 1e-4)


@pytest.mark.parametrize(
    "goal, message",
    [
        ((81e-6, 0.0, 0.0), r"opening is 8.1e-05, must be in \[0, 8e-05\] m"),
        ((-1e-6, 0.0, 0.0), "opening is -1e-06"),
        ((math.nan, 0.0, 0.0), "opening is nan"),
        ((20e-6, 6e-3, 0.0), r"max_force is 0.006, must be in \[5e-05, 0.005\] N"),
        ((20e-6, 4e-5, 0.0), "max_force is 4e-05"),
        ((20e-6, -1e-3, 0.0), "max_force is -0.001"),
        ((20e-6, 0.0, -1e-9), r"speed is -1e-09, must be in \[1e-09, 0.001\] m/s"),
        ((20e-6, 0.0, math.inf), "speed is inf"),
    ],
)
def test_goal_out_of_range_is_named(goal, message):
    with pytest.raises(ValueError, match=message):
        check_goal(DEFAULTS, *goal)


@pytest.mark.parametrize("off", [-0.9e-9, -1e-20, 1e-20, 0.9e-9])
def test_an_end_of_the_reach_that_was_rounded_is_that_end(off):
    for end in reach(DEFAULTS):
        opening = min(max(end + off, 0.0), 80e-6)
        assert check_goal(DEFAULTS, end + off, 0.0, 0.0).opening in (opening, end)
        way = check_trajectory(DEFAULTS, [Waypoint(1.0, end + off)], 40e-6)
        assert way.opening in (opening, end)
    with pytest.raises(ValueError, match="must be in"):
        check_goal(DEFAULTS, -1.1e-9, 0.0, 0.0)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"deflection_high": 21e-6}, r"'deflection_high' is 2.1e-05 m: .* \[0, 2e-05\] m"),
        ({"speed": 2e-3}, "'speed' is 0.002 m/s, must be at most 'speed_limit' 0.001"),
    ],
)
def test_parameters_that_contradict_each_other_are_refused(values, message):
    with pytest.raises(ParameterError, match=message):
        build(GripperParameters, values)


# --- the node, in front of two fingers --------------------------------------------------------------

STIFFNESS = 3000.0  # N/m, ten times a tip's
FREE_PLAY = 5e-6  # m, so tips touch the object at an opening of 30 µm


class Bench:
    """Two simulated fingers, the gripper, and a client; every wait is for a condition."""

    def __init__(self, folder, state_timeout, speed):
        file = folder / "finger.yaml"
        nodes = {
            "cantilever": {
                "contact": {"stiffness": STIFFNESS, "free_play": FREE_PLAY, "damping": 0.05}
            },
            "feedforward": {"compensator": "sensorless"},
            "feedback": {"force_control": True},
        }
        file.write_text(
            yaml.safe_dump({f"/**/{n}": {"ros__parameters": p} for n, p in nodes.items()})
        )
        files = [file]
        self.log = folder / "gripper.log"
        self.processes = {}
        for side in SIDES:
            self._start(side, "finger", folder, files, "-r", f"__ns:=/{side}")
        # A busy machine keeps a finger from talking for seconds.
        more = ("-p", f"state_timeout:={state_timeout}", "-p", f"speed:={speed}")
        self._start("gripper", "gripper", folder, [], *more)
        self.node = rclpy.create_node("client")
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)
        self.states, self.references = {}, {side: [] for side in SIDES}
        for side in SIDES:
            self.node.create_subscription(
                FingerState, f"{side}/state", lambda s, k=side: self.states.update({k: s}), LATCHED
            )
            self.node.create_subscription(
                ProfileMessage, f"{side}/reference_profile", self.references[side].append, FOLLOWED
            )
        self.client = ActionClient(self.node, Grip, "grip")

    def _start(self, name, executable, folder, files, *arguments):
        command = [EXECUTABLES / executable, "--ros-args", *arguments]
        for file in files:
            command += ["--params-file", file]
        with (folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )

    def close(self):
        for process in self.processes.values():
            process.terminate()
        codes = [process.wait(TIMEOUT) for process in self.processes.values()]
        self.executor.shutdown()
        self.client.destroy()
        self.node.destroy_node()
        return codes

    def wait(self, done):
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, self.log.read_text()
            self.executor.spin_once(timeout_sec=0.02)

    def result_of(self, future):
        self.wait(future.done)
        return future.result()

    def send(self, opening, max_force=0.0, speed=200e-6, feedback=None):
        goal = Grip.Goal(opening=opening, max_force=max_force, speed=speed)
        return self.result_of(self.client.send_goal_async(goal, feedback_callback=feedback))

    def grip(self, *goal, **more):
        handle = self.send(*goal, **more)
        assert handle.accepted, self.log.read_text()
        return self.result_of(handle.get_result_async())

    def is_open(self):
        """Say whether the gripper goes to the opening of a gripper at rest when it is asked to."""
        handle = self.send(40e-6)
        return handle.accepted and self.result_of(handle.get_result_async()).result.reached_goal

    def moving(self, handle):
        """Wait until a goal is on its way to an opening of 10 µm, 60 s away."""
        assert handle.accepted, self.log.read_text()
        self.wait(lambda: all(r and len(r[-1].time) == 2 for r in self.references.values()))

    def held(self):
        """Return the references as they stay, once they do."""
        self.wait(lambda: all(r and len(r[-1].time) == 1 for r in self.references.values()))
        return [r[-1].value[0] for r in self.references.values()]


@contextmanager
def started(folder, state_timeout=4.0, speed=DEFAULTS.speed):
    """Give a bench whose gripper has met its fingers, and see to it that all ends well."""
    rclpy.init()
    bench = Bench(folder, state_timeout, speed)
    try:
        bench.wait(lambda: len(bench.states) == 2 and bench.client.server_is_ready())
        bench.wait(lambda: all(s.phase == FingerState.RUNNING for s in bench.states.values()))
        # The gripper has to have met the fingers too, and felt them; until then it refuses or gives up.
        bench.wait(bench.is_open)
        bench.held()  # the end of that has come
        for sent in bench.references.values():
            sent.clear()
        yield bench
    finally:
        codes = bench.close()
        rclpy.shutdown()
    assert set(codes) <= {0, -signal.SIGKILL}


@pytest.fixture
def bench(tmp_path):
    with started(tmp_path) as bench:
        yield bench


SLOW = 0.5e-6  # m/s: any way lasts for the whole test


def test_grip_and_release_an_object(bench):
    limit = 0.2e-3  # N
    felt = []
    answer = bench.grip(20e-6, limit, 200e-6, feedback=lambda m: felt.append(m.feedback))
    result = answer.result
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (result.reached_goal, result.stalled) == (False, True)
    assert felt[0].force < 0.05 * limit and felt[0].opening == pytest.approx(40e-6, abs=0.3e-6)
    # Stalled from 90 % of the limit on. The sensors have a quantum of 10 nm and 5 nm of noise.
    assert 0.9 * limit <= result.force < 1.1 * limit
    touching = 40e-6 - 2 * FREE_PLAY
    assert result.opening == pytest.approx(touching - 2 * limit / STIFFNESS, abs=0.1e-6)
    # The force is held at the tips, 0.02 mN being what models of this plant are off by (docs/touch.md).
    later = {side: bench.states[side].samples + 2000 for side in SIDES}
    bench.wait(lambda: all(bench.states[side].samples > later[side] for side in SIDES))
    for side in SIDES:
        assert -bench.states[side].tip_force == pytest.approx(limit, abs=0.02e-3)
    held = bench.held()
    answer = bench.grip(36e-6)  # away from the object, although the force is at its limit
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (answer.result.reached_goal, answer.result.stalled) == (True, False)
    assert answer.result.force < 0.1 * limit
    assert answer.result.opening == pytest.approx(36e-6, abs=DEFAULTS.tolerance)
    # Without a bump: the line to 36 µm begins where the references were held.
    for side, reference in zip(SIDES, held):
        sent = bench.references[side]
        holds = [i for i, r in enumerate(sent) if len(r.time) == 1 and r.value[0] == reference]
        line = sent[holds[-1] + 1]
        assert line.value[0] == reference
        assert line.value[-1] == pytest.approx(2e-6, abs=1e-15)


def test_a_goal_with_less_force_lets_go_of_the_rest_in_whatever_direction(bench):
    held = bench.grip(20e-6, 0.4e-3, 200e-6).result
    answer = bench.grip(held.opening - 0.6e-6, 0.2e-3)  # between the tips and their references
    assert (answer.status, answer.result.stalled) == (GoalStatus.STATUS_SUCCEEDED, True)
    bench.wait(lambda: all(-s.tip_force < 1.1 * 0.2e-3 for s in bench.states.values()))
    for reference in bench.references.values():
        reference.clear()
    assert bench.grip(36e-6, 0.1e-3).result.reached_goal
    assert {r.max_force for sent in bench.references.values() for r in sent} == {0.1e-3}
    bench.grip(20e-6, 0.4e-3, 200e-6)
    for reference in bench.references.values():
        reference.clear()
    assert bench.grip(
        36e-6
    ).result.reached_goal  # the gripper's own limit is more: nobody asked for it
    assert {r.max_force for sent in bench.references.values() for r in sent} == {0.4e-3}


def test_an_object_stays_held_while_a_feedback_is_activated_again(bench):
    limit, felt = 0.2e-3, []
    assert bench.grip(20e-6, limit, 200e-6).result.stalled
    patient = bench.node.create_client(SetParameters, "left/cantilever/set_parameters")
    change = bench.node.create_client(ChangeState, "left/feedback/change_state")
    bench.wait(lambda: patient.service_is_ready() and change.service_is_ready())
    timeout = Parameter("reply_timeout", value=TIMEOUT).to_parameter_msg()  # on a busy machine
    bench.result_of(patient.call_async(SetParameters.Request(parameters=[timeout])))
    bench.node.create_subscription(
        FingerState, "left/state", lambda s: felt.append(-s.tip_force), LATCHED
    )
    bench.wait(felt.__len__)
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert bench.result_of(change.call_async(request)).success
    later = bench.states["left"].samples + 2000
    bench.wait(lambda: bench.states["left"].samples > later)
    # 0.02 mN is what models of this plant are off by (docs/touch.md).
    assert limit - 0.02e-3 < min(felt) <= max(felt) < limit + 0.02e-3
    assert bench.grip(36e-6).result.reached_goal


def test_ramp_passes_in_the_fingers_own_time(bench):
    heard = []
    bench.node.create_subscription(FingerState, "left/state", heard.append, LATCHED)
    answer = bench.grip(32e-6, 0.0, 10e-6)  # 8 µm at 10 µm/s: 0.8 s
    assert answer.result.reached_goal
    line = next(r for r in bench.references["left"] if len(r.time) == 2)  # the first piece of it
    assert line.interpolation == ProfileMessage.LINEAR
    slope = (line.value[1] - line.value[0]) / (line.time[1] - line.time[0])
    assert slope == pytest.approx(5e-6, rel=1e-9)
    # The loop answers a step within 50 ms, so on a ramp of 5 µm/s it is 0.25 µm late at most.
    points = [(s.samples * 1e-4, s.deflection) for s in heard]
    points = [(t, d) for t, d in points if line.time[0] + 0.05 < t < line.time[0] + 0.8]
    assert len(points) >= 2
    for instant, deflection in points:
        reference = line.value[0] + slope * (instant - line.time[0])
        assert reference - 0.25e-6 < deflection < reference + 0.05e-6

    assert not bench.send(0.2e-3).accepted
    bench.wait(lambda: "opening is 0.0002, must be in [0, 8e-05] m" in bench.log.read_text())


def test_canceled_goal_holds_on_the_way(bench):
    handle = bench.send(10e-6, 0.0, SLOW)
    bench.moving(handle)
    assert bench.result_of(handle.cancel_goal_async()).goals_canceling
    answer = bench.result_of(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert not answer.result.reached_goal
    assert all(-1e-6 < reference < 14e-6 for reference in bench.held())


def test_new_goal_takes_over_and_the_old_one_is_aborted(bench):
    old = bench.send(10e-6, 0.0, SLOW)
    bench.moving(old)
    new = bench.send(38e-6)
    assert bench.result_of(old.get_result_async()).status == GoalStatus.STATUS_ABORTED
    answer = bench.result_of(new.get_result_async())
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert "a new goal takes over" in bench.log.read_text()


@pytest.mark.parametrize("asks", ["grip", "stop"])
def test_motion_and_stop_begin_where_somebody_else_has_left_the_reference(bench, asks):
    place = -3e-6  # m, of the left finger alone; the gripper left it at 0
    set_points = bench.node.create_publisher(Sample, "left/reference", SETPOINT)
    bench.wait(lambda: set_points.get_subscription_count() > 0)
    set_points.publish(Sample(value=place))
    bench.wait(lambda: bench.states["left"].reference == place)
    bench.wait(lambda: abs(bench.states["left"].deflection - place) < 0.2e-6)
    # The gripper has heard a state as new as that.
    number = bench.states["left"].samples
    bench.wait(lambda: bench.states["left"].samples > number + 1000)
    bench.references["left"].clear()
    if asks == "grip":
        bench.moving(bench.send(36e-6, 0.0, SLOW))
    else:
        stop = bench.node.create_client(Trigger, "gripper/stop")
        bench.wait(stop.service_is_ready)
        bench.result_of(stop.call_async(Trigger.Request()))
    bench.wait(lambda: bench.references["left"])
    # Stopped, it is held no further ahead of its tip than it was.
    assert bench.references["left"][0].value[0] == pytest.approx(place, abs=0.2e-6)


@pytest.mark.shows("a gripper that is gone")
def test_a_killed_gripper_leaves_fingers_that_stop(bench):
    bench.send(10e-6, 0.0, 5e-6)  # 6 s to go
    bench.wait(lambda: all(s.deflection > 1e-6 for s in bench.states.values()))
    bench.processes["gripper"].kill()
    bench.processes["gripper"].wait()

    def is_over(side):
        return bench.states[side].samples * 1e-4 > bench.references[side][-1].time[-1] + 0.2

    bench.wait(lambda: all(map(is_over, SIDES)))
    stopped = {side: bench.states[side].deflection for side in SIDES}
    ends = {side: bench.states[side].samples + 5000 for side in SIDES}
    bench.wait(lambda: all(bench.states[side].samples > ends[side] for side in SIDES))
    for side in SIDES:
        assert bench.states[side].phase == FingerState.RUNNING
        # Sensor noise of 5 nm and a quantum of 10 nm.
        assert abs(bench.states[side].deflection - stopped[side]) < 0.1e-6
        assert stopped[side] < 14e-6  # of 15 µm


def test_finger_that_stops_aborts_the_goal_and_stays_at_rest(bench):
    handle = bench.send(10e-6, 0.0, SLOW)
    bench.moving(handle)
    change = bench.node.create_client(ChangeState, "right/feedforward/change_state")
    bench.wait(change.service_is_ready)
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    bench.result_of(change.call_async(request))
    answer = bench.result_of(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_ABORTED
    bench.wait(lambda: bench.states["right"].phase == FingerState.FAULT)
    assert "finger 'right' is FAULT (no answer to sample" in bench.log.read_text()
    left, right = bench.held()
    assert right == 0.0
    assert -1e-6 < left < 14e-6
    assert not bench.send(30e-6).accepted


def test_silent_finger_aborts_the_goal(bench):
    handle = bench.send(10e-6, 0.0, SLOW)
    bench.moving(handle)
    os.killpg(bench.processes["left"].pid, signal.SIGKILL)
    answer = bench.result_of(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert "finger 'left' is silent: nothing on '/left/state'" in bench.log.read_text()


@pytest.mark.parametrize("end", ["deactivation", "SIGINT", "SIGINT before the client asks"])
def test_stopped_gripper_holds_and_lets_the_client_know(bench, end):
    handle = bench.send(10e-6, 0.0, SLOW)
    bench.moving(handle)
    if end == "SIGINT before the client asks":
        bench.processes["gripper"].send_signal(signal.SIGINT)
        bench.wait(lambda: "the gripper is stopped" in bench.log.read_text())
        result = handle.get_result_async()
    elif end == "SIGINT":
        result = handle.get_result_async()
        bench.processes["gripper"].send_signal(signal.SIGINT)
    else:
        result = handle.get_result_async()
        change = bench.node.create_client(ChangeState, "gripper/change_state")
        bench.wait(change.service_is_ready)
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        assert bench.result_of(change.call_async(request)).success
    assert bench.result_of(result).status == GoalStatus.STATUS_ABORTED
    assert all(-1e-6 < reference < 14e-6 for reference in bench.held())
    if end == "deactivation":
        assert not bench.send(30e-6).accepted
        bench.wait(lambda: "the gripper is not active" in bench.log.read_text())
