# SPDX-License-Identifier: Apache-2.0
"""What others drive and watch the gripper by, in front of two simulated fingers that all tests share."""

import math
import time

import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from test_gripper import DEFAULTS, SIDES, started
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from piezo_control.gripper import Goal, Motion, Waypoint, check_trajectory
from piezo_control.nodes.faces.joint_commands import wanted
from piezo_control.nodes.qos import SETPOINT, STREAM
from piezo_gripper_msgs.msg import FingerState

JOINT = "gripper_joint"
FINGERS = ["left_finger_joint", "right_finger_joint"]

# --- the law of trajectories --------------------------------------------------------------------------


def test_a_trajectory_passes_its_waypoints_in_time_with_both_fingers():
    way = [Waypoint(0.0, 40e-6), Waypoint(1.0, 36e-6), Waypoint(3.0, 44e-6)]
    goal = check_trajectory(DEFAULTS, way, 40e-6)
    assert goal == Goal(44e-6, DEFAULTS.force_limit, DEFAULTS.speed_limit, tuple(way[1:]))
    motion = Motion(DEFAULTS, goal, [1e-6, -1e-6])  # the opening is 40 µm
    lines = [motion.depart(0, 5.0, 1e-6), motion.depart(1, 7.0, -1e-6)]
    # (40 - 36) / 2, half way to (40 - 44) / 2, and there
    for begin, line, start in zip((5.0, 7.0), lines, (1e-6, -1e-6)):
        at = line.at([begin, begin + 1.0, begin + 2.0, begin + 3.0])
        assert at == pytest.approx([start, 2e-6, 0.0, -2e-6], abs=1e-15)


@pytest.mark.parametrize(
    "way, message",
    [
        ([(1.0, 81e-6)], r"waypoint 0: opening is 8.1e-05, must be in \[0, 8e-05\] m"),
        ([(1.0, math.nan)], "waypoint 0: opening is nan"),
        ([(0.0, 40e-6)], "no waypoint after its start"),
        ([(0.0, 41e-6)], "waypoint 0 is at 0 s, must be 0.0001 s or more after 0 s"),
        ([(1.0, 30e-6), (1.0, 31e-6)], "waypoint 1 is at 1 s, must be 0.0001 s or more after 1 s"),
        ([(math.nan, 30e-6)], "waypoint 0 is at nan s"),
        ([(0.01, 20e-6)], "waypoint 0: speed is 0.002, must be at most 0.001 m/s"),
    ],
)
def test_a_trajectory_that_the_gripper_cannot_follow_is_refused(way, message):
    with pytest.raises(ValueError, match=message):
        check_trajectory(DEFAULTS, [Waypoint(*point) for point in way], 40e-6)


# --- joint commands as ros2_control sends them ---------------------------------------------------------


def test_a_command_has_effort_and_velocity_if_they_are_numbers():
    message = JointState(name=[JOINT], position=[2e-5], effort=[1e-3], velocity=[1e-4])
    assert wanted(message, JOINT) == (2e-5, 1e-3, 1e-4)
    message = JointState(name=[JOINT], position=[2e-5], effort=[math.nan], velocity=[])
    assert wanted(message, JOINT) == (2e-5, 0.0, 0.0)
    assert wanted(JointState(position=[3e-5]), JOINT) == (3e-5, 0.0, 0.0)


def test_a_command_may_name_joints_without_positions_and_other_joints():
    assert wanted(JointState(name=[JOINT, *FINGERS], position=[2e-5]), JOINT)[0] == 2e-5
    assert wanted(JointState(name=["arm", JOINT], position=[1.0, 2e-5]), JOINT)[0] == 2e-5
    with pytest.raises(ValueError, match="has no joint 'gripper_joint', only arm"):
        wanted(JointState(name=["arm"], position=[1.0]), JOINT)
    with pytest.raises(ValueError, match="has 1 positions, none for joint 'gripper_joint'"):
        wanted(JointState(name=["arm", JOINT], position=[1.0]), JOINT)


# --- the node -----------------------------------------------------------------------------------------


class Faces:
    """The bench's gripper by its standard topics and services."""

    def __init__(self, bench):
        self.bench, node = bench, bench.node
        self.heard = []
        self.diagnostics = {}
        node.create_subscription(JointState, "joint_states", self.heard.append, STREAM)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.commands = node.create_publisher(JointState, "gripper/joint_commands", SETPOINT)
        self.trajectories = node.create_publisher(
            JointTrajectory, "gripper/joint_trajectory", SETPOINT
        )
        bench.wait(self.heard.__len__)
        for publisher in (self.commands, self.trajectories):
            bench.wait(publisher.get_subscription_count)

    def _on_diagnostics(self, message):
        self.diagnostics.update({status.name: status for status in message.status})

    def call(self, service):
        client = self.bench.node.create_client(Trigger, service)
        self.bench.wait(client.service_is_ready)
        # A server that does not know its new client yet loses the answer, so it is asked again.
        asked = []

        def answered():
            if not asked or time.monotonic() > asked[-1][0] + 10.0:
                asked.append((time.monotonic(), client.call_async(Trigger.Request())))
            return any(future.done() for _, future in asked)

        self.bench.wait(answered)
        self.bench.node.destroy_client(client)
        return next(future.result() for _, future in asked if future.done())

    def arrives(self, opening, within=DEFAULTS.tolerance):
        """Wait until the joint is at an opening (m)."""
        self.bench.wait(lambda: abs(self.heard[-1].position[0] - opening) <= within)

    def command(self, opening, **more):
        self.commands.publish(JointState(name=[JOINT], position=[opening], **more))

    def log_has(self, text):
        self.bench.wait(lambda: text in self.bench.log.read_text())


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    with started(tmp_path_factory.mktemp("gripper"), state_timeout=60.0, speed=1e-4) as bench:
        yield bench


@pytest.fixture(scope="module")
def faces(bench):
    return Faces(bench)


@pytest.fixture(autouse=True)
def at_home(request):
    """Begin every test with the node at its opening at rest, and nothing moving."""
    if "faces" in request.fixturenames:
        faces = request.getfixturevalue("faces")
        assert faces.call("gripper/home").success
        faces.arrives(DEFAULTS.rest_opening)


def test_joint_states_have_opening_and_deflections(faces):
    faces.command(36e-6, velocity=[200e-6])
    faces.arrives(36e-6)
    state = faces.heard[-1]
    assert list(state.name) == [JOINT, *FINGERS]
    assert state.position[0] == pytest.approx(40e-6 - state.position[1] - state.position[2])
    # half the way each, within the tolerance and what the paper's controller leaves of a step (0.7 %)
    assert list(state.position[1:]) == pytest.approx([2e-6, 2e-6], abs=0.2e-6)
    assert len(state.velocity) == len(state.effort) == 3
    # nothing touches: less is felt than what a push is told apart from
    assert all(abs(effort) < DEFAULTS.touch_force for effort in state.effort)
    assert state.effort[0] == max(0.0, *state.effort[1:])
    assert state.header.stamp.sec > 1e9  # the wall's, as nodes want it that run beside


def test_joint_states_tell_the_speed(faces):
    speed = 20e-6
    faces.command(80e-6, velocity=[speed])  # 2 s
    # 0.1 s of samples with 10 nm of quantum and 5 nm of noise; each finger goes in its own time
    faces.bench.wait(lambda: all(abs(v + speed / 2) < 0.5e-6 for v in faces.heard[-1].velocity[1:]))
    state = faces.heard[-1]
    assert state.velocity[0] == pytest.approx(-sum(state.velocity[1:]))
    assert 40e-6 < state.position[0] < 80e-6


def test_a_command_out_of_reach_is_refused_with_the_reach(faces):
    faces.command(81e-6)
    faces.log_has("'/gripper/joint_commands' ignored: opening is 8.1e-05, must be in [0, 8e-05] m")
    faces.command(math.nan)  # what ros2_control sends before a controller is active
    faces.command(38e-6)
    faces.arrives(38e-6)
    assert "opening is nan" not in faces.bench.log.read_text()


def test_a_repeated_command_does_not_push_anew(faces):
    faces.command(20e-6, velocity=[20e-6], effort=[0.2e-3])
    faces.log_has("stopped by")
    faces.bench.held()  # the last references have come
    sent = {side: len(faces.bench.references[side]) for side in SIDES}
    stops = faces.bench.log.read_text().count("stopped by")
    for _ in range(5):
        faces.command(20e-6, velocity=[20e-6], effort=[0.2e-3])
    faces.trajectories.publish(
        JointTrajectory(joint_names=["arm"])
    )  # its answer comes after theirs
    faces.log_has("'/gripper/joint_trajectory' ignored: is for arm, must be for 'gripper_joint'")
    assert {side: len(faces.bench.references[side]) for side in SIDES} == sent
    assert faces.bench.log.read_text().count("stopped by") == stops


@pytest.mark.parametrize("between", ["home", "stop", "trajectory"])
def test_a_repeated_command_is_held_back_after_something_else_and_says_so_once(faces, between):
    bench, words = faces.bench, "'/gripper/joint_commands' repeats 37 µm, held back"
    for opening in (36e-6, 37e-6, 37e-6):
        faces.command(opening)
        faces.arrives(opening)
    if between == "trajectory":
        point = JointTrajectoryPoint(positions=[38e-6], time_from_start=Duration(sec=1))
        faces.trajectories.publish(JointTrajectory(joint_names=[JOINT], points=[point]))
        faces.arrives(38e-6)
    else:
        assert faces.call(f"gripper/{between}").success
    before = bench.log.read_text().count(words)
    for _ in range(3):
        faces.command(37e-6)
        bench.wait(lambda: bench.log.read_text().count(words) == before + 1)
    faces.command(36.5e-6)
    faces.arrives(36.5e-6)
    faces.command(37e-6)
    faces.arrives(37e-6)
    assert bench.log.read_text().count(words) == before + 1


def test_a_trajectory_is_followed_in_the_fingers_own_time(faces):
    for sent in faces.bench.references.values():
        sent.clear()
    points = [
        JointTrajectoryPoint(positions=[opening], time_from_start=Duration(nanosec=nanosec))
        for opening, nanosec in ((44e-6, 200_000_000), (42e-6, 400_000_000))
    ]
    faces.trajectories.publish(JointTrajectory(joint_names=[JOINT], points=points))
    faces.log_has("goal 42 µm: reached")
    for side in SIDES:
        # A piece that both waypoints are in: to (40 - 44) / 2 µm, and to (40 - 42) / 2 in 0.2 s more.
        piece = next(r for r in faces.bench.references[side] if len(r.time) == 4)
        assert piece.time[2] - piece.time[1] == pytest.approx(0.2)
        assert list(piece.value[1:3]) == pytest.approx([-2e-6, -1e-6], abs=1e-12)


def test_stop_holds_on_the_way_and_is_accepted_always(faces):
    faces.command(20e-6, velocity=[1e-6])
    faces.bench.wait(lambda: faces.heard[-1].position[0] < 39.5e-6)
    answer = faces.call("gripper/stop")
    assert (answer.success, answer.message) == (True, "stopped")
    assert all(0.0 < reference < 5e-6 for reference in faces.bench.held())
    answer = faces.call("gripper/stop")
    assert (answer.success, answer.message) == (True, "nothing was moving")


def test_an_empty_trajectory_stops(faces):
    faces.command(60e-6, velocity=[1e-6])
    faces.bench.wait(lambda: faces.heard[-1].position[0] > 40.5e-6)
    faces.trajectories.publish(JointTrajectory(joint_names=[JOINT]))
    assert all(-5e-6 < reference < 0.0 for reference in faces.bench.held())


def test_release_opens_wide(faces):
    answer = faces.call("gripper/release")
    assert (answer.success, answer.message) == (True, "on the way to 80 µm")
    faces.bench.wait(lambda: all(r[-1].value[-1] < -1e-6 for r in faces.bench.references.values()))


def test_zero_is_where_the_fingers_are_if_that_is_near(faces):
    faces.command(39e-6)
    faces.arrives(39e-6)
    faces.log_has("goal 39 µm: reached")
    assert faces.call("gripper/zero").success
    faces.arrives(40e-6)
    faces.command(38e-6)  # 1 µm more of each finger
    faces.arrives(38e-6)
    faces.bench.wait(lambda: faces.bench.states["left"].deflection > 1.3e-6)
    faces.command(30.5e-6)
    faces.arrives(30.5e-6)
    faces.log_has("goal 30.5 µm: reached")
    answer = faces.call("gripper/zero")
    assert not answer.success
    assert "must be within ±2 µm ('zero_limit')" in answer.message


def test_diagnostics_name_the_finger_that_stopped_and_reset_brings_it_back(faces):
    bench = faces.bench
    change = bench.node.create_client(ChangeState, "right/feedforward/change_state")
    bench.wait(change.service_is_ready)
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    bench.result_of(change.call_async(request))
    bench.wait(lambda: bench.states["right"].phase == FingerState.FAULT)
    bench.wait(lambda: "finger 'right' is FAULT" in faces.diagnostics["/gripper"].message)
    assert not faces.call("gripper/home").success
    request.transition.id = Transition.TRANSITION_ACTIVATE
    bench.result_of(change.call_async(request))
    assert faces.call("gripper/reset").success
    bench.wait(lambda: bench.states["right"].phase == FingerState.RUNNING)
    bench.wait(lambda: faces.diagnostics["/gripper"].level == b"\0")
    assert faces.call("gripper/home").success
