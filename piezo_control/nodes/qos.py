# SPDX-License-Identifier: Apache-2.0
"""Quality of service by role (REP-2003)."""

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

# Numbered samples: reliable, and deep enough that a recorder may fall behind by seconds.
SAMPLE = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)

# Numbered samples of a loop that runs free: what is not taken in time is replaced by what is newer.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)

# Set-points: reliable, only the newest counts.
SETPOINT = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)

# What others draw, record or control by: as ros2_control's own broadcasters have it.
STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)

# Faults of the blocks of a loop, all on one topic: the newest of each is kept for those who join later.
FAULTS = QoSProfile(
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# What is followed, and from which sample on: every change counts, also for those who join later.
FOLLOWED = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# Profiles and states: the newest is kept for those who join later.
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

DELIVERY_TIMEOUT = Duration(seconds=0.5)
"""So long the end of a node waits for the readers of what it said last."""
