# SPDX-License-Identifier: Apache-2.0
"""A bare ring of processes: wait on one subscription, take the message, publish the next one.

`ring.py HOPS INDEX SECONDS`; process 0 sends the first message, counts the turns, and prints how many
there were per second. The wait set is rclpy's own binding, the least that a Python node can wait on.
"""

import os
import sys
import time

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation

from piezo_control.nodes.qos import SAMPLE
from piezo_gripper_msgs.msg import Sample

WARM_UP = 0.5  # s

os.environ["RMW_FASTRTPS_PUBLICATION_MODE"] = "SYNCHRONOUS"
hops, index, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
rclpy.init()
node = rclpy.create_node(f"ring_{index}")
publisher = node.create_publisher(Sample, f"ring_{(index + 1) % hops}", SAMPLE)
subscription = node.create_subscription(Sample, f"ring_{index}", lambda _: None, SAMPLE)
wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
if index == 0:
    while not (publisher.get_subscription_count() and subscription.get_publisher_count()):
        time.sleep(0.01)
    publisher.publish(Sample())
turns = 0
with subscription.handle:
    while True:
        wait_set.clear_entities()
        wait_set.add_subscription(subscription.handle)
        wait_set.wait(500_000_000)
        taken = subscription.handle.take_message(Sample, False)
        if taken is None:
            if index == 0 and turns == 0:
                publisher.publish(Sample())  # the ring was not closed yet
            continue
        message = taken[0]
        answer = Sample(header=message.header, number=message.number + 1)
        answer.value = message.value
        publisher.publish(answer)
        if index > 0:
            continue
        turns += 1
        now = time.monotonic()
        if turns == 1:
            start = now
        if now - start < WARM_UP:
            mark = now, turns
        elif now - start > WARM_UP + seconds:
            break
print((turns - mark[1]) / (now - mark[0]))
node.destroy_node()
rclpy.shutdown()
