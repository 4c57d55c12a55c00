# SPDX-License-Identifier: Apache-2.0
"""params/rosbag2_qos.yaml, as `ros2 bag record --qos-profile-overrides-path` reads it.

The fields are those that rosbag2 of Jazzy asks for (rosbag2_storage/src/rosbag2_storage/qos.cpp, decode) and that
its command line accepts (ros2bag/ros2bag/api/__init__.py, interpret_dict_as_qos_profile).
"""

import pytest
import rclpy.qos as qos
import yaml

from piezo_control.nodes.recorder import FINGER
from piezo_control.shared import shared_folder

POLICIES = {
    "history": qos.HistoryPolicy, "reliability": qos.ReliabilityPolicy,
    "durability": qos.DurabilityPolicy, "liveliness": qos.LivelinessPolicy,
}  # fmt: skip
TIMES = ("deadline", "lifespan", "liveliness_lease_duration")
OTHERS = ("depth", "avoid_ros_namespace_conventions")
OVERRIDES = yaml.safe_load((shared_folder() / "params" / "rosbag2_qos.yaml").read_text())


def test_every_topic_that_the_recorder_takes_is_there_in_every_namespace():
    fingers = ("finger", "left", "right")
    assert set(OVERRIDES) == {f"/{finger}/{topic}" for finger in fingers for topic in FINGER}


@pytest.mark.parametrize("launch", sorted((shared_folder() / "launch").glob("*.launch.py")))
def test_launch_files_say_how_to_record(launch):
    assert "--qos-profile-overrides-path" in launch.read_text()


@pytest.mark.parametrize("topic", OVERRIDES)
def test_every_field_is_there_and_nothing_is_lost(topic):
    fields = OVERRIDES[topic]
    assert set(fields) == {*POLICIES, *TIMES, *OTHERS}
    assert all(fields[name] == {"sec": 0, "nsec": 0} for name in TIMES)  # 0 is no limit
    assert fields["avoid_ros_namespace_conventions"] is False
    chosen = {name: policy.get_from_short_key(fields[name]) for name, policy in POLICIES.items()}
    subscription = qos.QoSProfile(depth=fields["depth"], **chosen)
    _, offered = FINGER[topic.split("/")[-1]]
    compatible, reason = qos.qos_check_compatible(offered, subscription)
    assert compatible == qos.QoSCompatibility.OK, reason
    assert subscription.depth >= offered.depth
