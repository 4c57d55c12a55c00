# SPDX-License-Identifier: Apache-2.0
"""A topic of numbered samples: each at once for the loop, and all of them in series for who takes them down.

A message costs more than what the loop computes for it. A recorder that read every sample by itself would take the
time that two fingers on two cores have for their loops; a series of hundreds costs it little more than one.
"""

from __future__ import annotations

from rclpy.duration import Duration

from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.qos import SAMPLE
from piezo_gripper_msgs.msg import Sample, SampleSeries

LONGEST = 250  # samples of a series
LATEST = 0.05  # s until a sample that waits for others is sent


def series_of(topic: str) -> str:
    """Return the topic on which the samples of `topic`, as resolved, come in series."""
    return f"{topic}_series"


def nanoseconds(message: Sample | SampleSeries) -> int:
    """Return the time stamp of a message in ns."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class SampleOutput:
    """Publishes `topic` for `node`."""

    def __init__(self, node: FingerNode, topic: str) -> None:
        self.name = node.resolve_topic_name(topic)
        # In this order, so that nobody who has found the samples takes their series for missing.
        self._series_publisher = node.create_publisher(SampleSeries, series_of(self.name), SAMPLE)
        self._publisher = node.create_publisher(Sample, topic, SAMPLE)
        self._series = SampleSeries()
        node.create_steady_timer(LATEST, self.flush)

    def readers(self) -> int:
        """Return how many subscribe, to single samples or to series."""
        publishers = (self._publisher, self._series_publisher)
        return sum(publisher.get_subscription_count() for publisher in publishers)

    def publish(self, sample: Sample) -> None:
        """Send a sample now, and once more with its neighbours."""
        self._publisher.publish(sample)
        series = self._series
        count = len(series.value)
        if count and (sample.number != series.number + count or sample.period != series.period):
            self.flush()
            count = 0
        if not count:
            series = self._series = SampleSeries(
                header=sample.header, number=sample.number, period=sample.period
            )
        series.later.append(nanoseconds(sample) - nanoseconds(series))
        series.value.append(sample.value)
        series.flags.append(
            sample.limited * SampleSeries.LIMITED
            + sample.by_controller * SampleSeries.BY_CONTROLLER
            + sample.without_temperature * SampleSeries.WITHOUT_TEMPERATURE
        )
        if count + 1 == LONGEST:
            self.flush()

    def flush(self) -> None:
        """Send the samples that wait for others."""
        if self._series.value:
            self._series_publisher.publish(self._series)
            self._series = SampleSeries()

    def finish(self, timeout: Duration) -> None:
        """Send what waits, and wait until those who are there have everything."""
        self.flush()
        self._publisher.wait_for_all_acked(timeout)
        self._series_publisher.wait_for_all_acked(timeout)
