# SPDX-License-Identifier: Apache-2.0
"""The actions of control_msgs, with its own message classes, in front of two simulated fingers."""

import math

import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState
from test_gripper import DEFAULTS, started

actions = pytest.importorskip(
    "control_msgs.action", reason="control_msgs is not installed; build its interfaces beside"
)
KINDS = ("ParallelGripperCommand", "GripperCommand")


class Client:
    """One of the two actions, behind which a gripper node of its own has the same fingers."""

    def __init__(self, bench, kind, node):
        self.bench, self.kind, self.node = bench, kind, node
        self.type = getattr(actions, kind)
        self.server = ActionClient(bench.node, self.type, f"{node}/gripper_cmd")
        bench.wait(self.server.server_is_ready)

    def goal(self, opening, force=0.0):
        goal = self.type.Goal()
        if self.kind == "GripperCommand":
            goal.command.position, goal.command.max_effort = opening, force
        else:
            effort = [force] if force else []
            goal.command = JointState(
                name=["gripper_joint"], position=[opening], velocity=[100e-6], effort=effort
            )
        return goal

    def send(self, goal, feedback=None):
        return self.bench.result_of(self.server.send_goal_async(goal, feedback_callback=feedback))

    def result(self, *goal, feedback=None):
        handle = self.send(self.goal(*goal), feedback)
        assert handle.accepted, self.bench.log.read_text()
        return self.bench.result_of(handle.get_result_async())

    def figures(self, message):
        """Return opening and force of a feedback or a result."""
        if self.kind == "GripperCommand":
            return message.position, message.effort
        assert list(message.state.name) == ["gripper_joint"]
        return message.state.position[0], message.state.effort[0]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    with started(tmp_path_factory.mktemp("gripper"), state_timeout=60.0, speed=1e-4) as bench:
        yield bench


@pytest.fixture(scope="module", params=KINDS)
def client(request, bench, tmp_path_factory):
    if request.param == "ParallelGripperCommand":
        return Client(bench, request.param, "gripper")
    bench._start(
        "second", "gripper", tmp_path_factory.mktemp("second"), [],
        "-r", "__node:=second", "-r", "grip:=second/grip", "-p", "control_action:=GripperCommand",
        "-p", "speed:=1e-4", "-p", "state_timeout:=60.0", "-p", "allow_stalling:=false",
    )  # fmt: skip
    client = Client(bench, request.param, "second")
    bench.wait(lambda: client.send(client.goal(40e-6)).accepted)  # it has met the fingers
    return client


def test_a_goal_ends_at_its_opening_with_feedback_on_the_way(client):
    told = []
    answer = client.result(34e-6, feedback=lambda message: told.append(message.feedback))
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (answer.result.reached_goal, answer.result.stalled) == (True, False)
    assert client.figures(answer.result)[0] == pytest.approx(34e-6, abs=DEFAULTS.tolerance)
    assert told
    assert all(33e-6 < client.figures(message)[0] < 41e-6 for message in told)


def test_a_goal_that_ends_by_its_force_has_stalled_and_succeeds_if_that_is_allowed(client):
    answer = client.result(24e-6, 0.2e-3)
    allowed = client.kind == "ParallelGripperCommand"  # by default; the second gripper forbids it
    assert answer.status == (GoalStatus.STATUS_SUCCEEDED if allowed else GoalStatus.STATUS_ABORTED)
    assert (answer.result.reached_goal, answer.result.stalled) == (False, True)
    opening, force = client.figures(answer.result)
    assert opening < 30.5e-6  # the object is at 30 µm
    assert force >= 0.9 * 0.2e-3 or math.isnan(force)
    assert client.result(40e-6).status == GoalStatus.STATUS_SUCCEEDED


def test_goals_out_of_reach_or_for_other_joints_are_rejected(client):
    assert not client.send(client.goal(81e-6)).accepted
    assert not client.send(client.goal(30e-6, -1.0)).accepted
    assert not client.send(client.goal(math.nan)).accepted
    if client.kind == "ParallelGripperCommand":
        goal = client.goal(30e-6)
        goal.command.name = ["arm"]
        assert not client.send(goal).accepted
        goal.command = JointState(name=["gripper_joint", "arm"], position=[30e-6, 0.0])
        assert not client.send(goal).accepted


def test_a_goal_can_be_canceled_and_the_next_takes_over(client):
    handle = client.send(client.goal(60e-6))
    assert client.bench.result_of(handle.cancel_goal_async()).goals_canceling
    answer = client.bench.result_of(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_CANCELED
    old = client.send(client.goal(60e-6))
    assert client.result(40e-6).status == GoalStatus.STATUS_SUCCEEDED
    assert client.bench.result_of(old.get_result_async()).status == GoalStatus.STATUS_ABORTED
