# SPDX-License-Identifier: Apache-2.0
"""Records a finger's topics into a rosbag2 folder (MCAP), message definitions included.

in:  the topics of `topics`: the finger's own, or any that somebody publishes
out: recorder_state (RecorderState)

A recording begins at activation and is finished, readable, at deactivation, shutdown, SIGINT and
SIGTERM. Numbered samples are written once each, whatever the transport repeats; numbers never seen are
counted as missing. A message's time in the bag is its own stamp, so a lock-step run replays at the
finger's speed; one without a stamp, as of `ros2 topic pub`, has that of the newest sample. A run that starts
again at sample 0 goes on in the same bag, behind the one before. Samples that their node sends in series as well
(:mod:`piezo_control.nodes.sample_output`) are taken from these, which leaves the loop its time.
"""

from __future__ import annotations

import importlib
import struct
import time
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rclpy._rclpy_pybind11 import RCLError
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Connection

from piezo_control.nodes import base as finger_node
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.parameters import RecorderParameters
from piezo_control.nodes.qos import FOLLOWED, LATCHED, SAMPLE
from piezo_control.nodes.sample_output import nanoseconds, series_of
from piezo_control.parameters import ParameterError
from piezo_control.recording.recording import (
    BLOCK_TYPE,
    PROFILE_TYPE,
    SAMPLE_TYPE,
    TEMPERATURE_TYPE,
    WAVEFORM_TYPE,
)
from piezo_control.recording.writer import BagWriter, sample_data
from piezo_control.sequence import REPEATED, STRAY, Sequence
from piezo_gripper_msgs.msg import RecorderState, Sample, SampleSeries

FINGER = {
    "reference": (SAMPLE_TYPE, SAMPLE),
    "reference_profile": (PROFILE_TYPE, LATCHED),
    "reference_waveform": (WAVEFORM_TYPE, SAMPLE),
    "reference_followed_profile": (PROFILE_TYPE, FOLLOWED),
    "reference_followed_waveform": (WAVEFORM_TYPE, FOLLOWED),
    "deflection": (SAMPLE_TYPE, SAMPLE),
    "command": (SAMPLE_TYPE, SAMPLE),
    "voltage": (SAMPLE_TYPE, SAMPLE),
    "samples": (BLOCK_TYPE, SAMPLE),
    "temperature": (TEMPERATURE_TYPE, SAMPLE),
    "push": (SAMPLE_TYPE, SAMPLE),
    "contact_force": (SAMPLE_TYPE, SAMPLE),
    "tip_force": (SAMPLE_TYPE, SAMPLE),
    "tip_force_profile": (PROFILE_TYPE, LATCHED),
    "tip_force_waveform": (WAVEFORM_TYPE, SAMPLE),
    "state": ("piezo_gripper_msgs/msg/FingerState", LATCHED),
}
SET_POINTS = ("reference", "tip_force")  # sent now and then, their numbers mean nothing
STATE_PERIOD = 0.05  # s
FLUSH_PERIOD = 0.5  # s
STAMPS_END = 2**31 * 10**9  # ns: as far as the seconds of a stamp go
BAG_END = 2**64  # ns: as far as a bag goes, in which each run comes after the one before
PAUSE = (
    10**9
)  # ns in the bag between two runs: what is on its way of the first comes before the second


class Track:
    """One recorded topic: its connection in the bag and the count of its samples."""

    def __init__(self, topic: str, connection: Connection, has_header: bool) -> None:
        self.connection = connection
        self.has_header = has_header
        self.is_numbered = is_numbered(topic, connection.msgtype)
        self.is_block = connection.msgtype == BLOCK_TYPE
        self.is_stamped = connection.msgtype == TEMPERATURE_TYPE
        self.sequence = Sequence(gaps=True)
        self.gap = range(0)  # numbers that were passed over last: their series may still come
        self.run = 0
        self.begin = 0  # ns in the bag, of that run
        self.last_stamp = -1
        self.recorded = 0
        self.duplicates = 0
        self.missing = 0


def is_numbered(topic: str, kind: str) -> bool:
    """Say whether a topic with messages of type `kind` brings numbered samples."""
    return kind == SAMPLE_TYPE and topic not in SET_POINTS


def sample_number(data: bytes) -> int:
    """Return the field `number` of a serialized Sample (little-endian CDR)."""
    (frame_id,) = struct.unpack_from("<I", data, 12)
    return struct.unpack_from("<Q", data, 4 + (12 + frame_id + 7) // 8 * 8)[0]


class RecorderNode(FingerNode):
    NAME = "recorder"
    PARAMETERS = RecorderParameters

    def __init__(self) -> None:
        super().__init__()
        self.states = self.create_publisher(RecorderState, "recorder_state", LATCHED)
        self.create_steady_timer(STATE_PERIOD, self._publish_state)
        self.create_steady_timer(FLUSH_PERIOD, self._flush)
        self.trouble = ""
        self.writer: BagWriter | None = None
        self.types: dict[str, tuple[str, QoSProfile]] = {}
        self.inputs: list[Any] = []
        self.single_samples: dict[
            str, Any
        ] = {}  # subscriptions, of topics that do not come in series
        self.latched: dict[str, bytes] = {}
        self.tracks: dict[str, Track] = {}

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe, so that every publisher knows the recorder before a run begins."""
        try:
            types = {topic: self._type(topic) for topic in self.parameters.topics}
            names = [self.resolve_topic_name(topic) for topic in self.parameters.topics]
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"'topics' has {', '.join(twice)} more than once")
        except ValueError as error:
            self.refuse(f"not configured: {error}")
            return TransitionCallbackReturn.FAILURE
        self.types = types
        for topic, (name, qos) in types.items():
            if is_numbered(topic, name):
                series = series_of(self.resolve_topic_name(topic))
                take = partial(self._write_series, topic)
                self.inputs.append(self.create_subscription(SampleSeries, series, take, SAMPLE))
                continue
            package, _, kind = name.split("/")
            message = getattr(importlib.import_module(f"{package}.msg"), kind)
            latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
            write = partial(self._keep if latched else self._write, topic)
            self.inputs.append(self.create_subscription(message, topic, write, qos, raw=True))
        self._look_for_single_samples()
        return super().on_configure(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        while self.inputs:
            self.destroy_subscription(self.inputs.pop())
        while self.single_samples:
            self.destroy_subscription(self.single_samples.popitem()[1])
        self.types = {}
        self.latched.clear()
        return super().on_cleanup(state)

    def _look_for_single_samples(self) -> None:
        """Hear sample by sample whom sends no series: a driver or a controller of somebody's own."""
        for topic, (name, qos) in self.types.items():
            if not is_numbered(topic, name):
                continue
            where = self.resolve_topic_name(topic)
            is_needed = self.count_publishers(where) > self.count_publishers(series_of(where))
            if is_needed and topic not in self.single_samples:
                self.single_samples[topic] = self.create_subscription(
                    Sample, topic, partial(self._write, topic), qos, raw=True
                )
            elif not is_needed and topic in self.single_samples:
                self.destroy_subscription(self.single_samples.pop(topic))

    def check(self, parameters: RecorderParameters) -> None:
        """Refuse other topics than those it has subscribed."""
        if self.types and parameters.topics != self.parameters.topics:
            raise ParameterError(
                "'topics' is fixed when 'recorder' is configured: clean it up first"
            )

    def start(self) -> None:
        whose = self.get_namespace().strip("/").replace("/", "_") or "finger"
        bag = Path(self.parameters.bag or f"{whose}_{time.strftime('%Y-%m-%d_%H-%M-%S')}")
        writer = BagWriter(bag)
        self.tracks = {}
        self.newest = 0
        self.has_blocks = False
        self.begin = 0  # ns in the bag, of the newest run
        self.run = 0
        self.unstamped: list[tuple[str, bytes]] = []
        for topic, (name, qos) in self.types.items():
            if name not in writer.typestore.types:
                package = name.split("/")[0]
                writer.learn(package, Path(get_package_share_directory(package)))
            latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
            connection = writer.add(self.resolve_topic_name(topic), name, latched)
            self.tracks[topic] = Track(topic, connection, writer.has_header(name))
        self.writer = writer
        self.trouble = ""
        self.say(f"records into {bag.resolve()}")
        for topic, data in self.latched.items():
            self._write(topic, data)

    def stop(self) -> None:
        writer, self.writer = self.writer, None
        if writer is None:
            return  # given up before
        self.writer = writer
        self._tell_time(self.newest or self.get_clock().now().nanoseconds)
        self.writer = None
        try:
            writer.close()
        except OSError as error:
            self._give_up(writer, error)
            return
        counts = ", ".join(f"{topic} {t.recorded}" for topic, t in self.tracks.items())
        self.get_logger().info(f"wrote {writer.path}: {counts}")

    def _type(self, topic: str) -> tuple[str, QoSProfile]:
        """Return message type and quality of service to subscribe `topic` with."""
        try:
            offers = self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
        except RCLError:
            raise ValueError(f"'topics' has '{topic}', which is no name of a topic") from None
        if topic in FINGER and not offers:
            return FINGER[topic]
        if not offers:
            raise ValueError(f"'topics' has '{topic}', which nobody publishes: type unknown")
        profiles = [offer.qos_profile for offer in offers]
        best_effort = any(p.reliability == ReliabilityPolicy.BEST_EFFORT for p in profiles)
        latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
        qos = QoSProfile(
            depth=SAMPLE.depth,
            reliability=ReliabilityPolicy.BEST_EFFORT
            if best_effort
            else ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        return offers[0].topic_type, qos

    def _keep(self, topic: str, data: bytes) -> None:
        """Write what is latched; what a profile said before the run began belongs to the run."""
        self.latched[topic] = data
        self._write(topic, data)

    def _write(self, topic: str, data: bytes) -> None:
        if self.writer is None:
            return
        track = self.tracks[topic]
        if track.has_header:
            seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
            stamp = seconds * 10**9 + nanoseconds
            if not self._is_time(topic, stamp):
                return
            if track.is_numbered and not self._is_new(track, sample_number(data), stamp):
                return
            if track.is_numbered:
                stamp += track.begin
            elif stamp or track.is_block or track.is_stamped:
                stamp += self.begin
            if track.is_numbered or track.is_block:
                self._tell_time(max(stamp, self.newest, 1))
            elif not stamp and not track.is_stamped:  # a temperature's 0 is the instant of sample 0
                if not self.newest:
                    self.unstamped.append((topic, data))  # until a sample says what time it is
                    return
                stamp = self.newest
        else:
            stamp = self.get_clock().now().nanoseconds
        if track.is_stamped and stamp <= track.last_stamp:
            track.duplicates += 1
            return
        if track.is_stamped:
            track.last_stamp = stamp
        self._put(track, stamp, data)
        self.has_blocks |= track.is_block

    def _write_series(self, topic: str, series: SampleSeries) -> None:
        """Write the samples of a series as if they had come one by one."""
        track = self.tracks.get(topic)
        first, period = nanoseconds(series), series.period
        number = series.number - 1
        for later, value, flags in zip(series.later, series.value, series.flags):
            if self.writer is None or track is None:
                return
            number += 1
            stamp = first + later
            if not self._is_time(topic, stamp):
                continue
            if track.run == self.run and number == track.sequence.next > 1:
                # Nearly all do go on, and what is saved here is left to the loop.
                track.sequence.count(number)
                track.last_stamp = stamp
            elif not self._is_new(track, number, stamp):
                continue
            data = sample_data(
                stamp, number, value, period,
                flags & SampleSeries.LIMITED != 0,
                flags & SampleSeries.BY_CONTROLLER != 0,
                flags & SampleSeries.WITHOUT_TEMPERATURE != 0,
            )  # fmt: skip
            stamp += track.begin
            if stamp >= self.newest or self.unstamped:
                self._tell_time(max(stamp, self.newest, 1))
            self._put(track, stamp, data)

    def _is_time(self, topic: str, stamp: int, end: int = STAMPS_END) -> bool:
        """Say whether a time stamp (ns) is in [0, end), and complain of one that is not."""
        if 0 <= stamp < end:
            return True
        self.get_logger().error(
            f"'{topic}' is stamped {stamp * 1e-9:g} s, must be in [0, {end * 1e-9:g}) s; not recorded",
            throttle_duration_sec=1.0,
        )
        return False

    def _put(self, track: Track, stamp: int, data: bytes) -> None:
        """Write a message at `stamp` (ns in the bag)."""
        assert self.writer is not None
        if not self._is_time(track.connection.topic, stamp, BAG_END):
            return
        try:
            self.writer.write(track.connection, stamp, data)
        except OSError as error:
            self._give_up(self.writer, error)
            return
        track.recorded += 1

    def _tell_time(self, newest: int) -> None:
        """Take note of the time (ns) of the newest sample; what waited for one is written."""
        self.newest = newest
        while self.unstamped:
            self._write(*self.unstamped.pop(0))

    def _is_new(self, track: Track, number: int, stamp: int) -> bool:
        """Count sample `number` of a topic and say whether it has not been written yet."""
        self._follow_run(track, number, stamp)
        kind = track.sequence.classify(number)
        if kind == STRAY and number >= track.sequence.next:
            self.get_logger().error(
                f"sample {number} after {track.sequence.next - 1} explains no loss; not recorded",
                throttle_duration_sec=1.0,
            )
            return False
        if number in track.gap and kind == STRAY:
            track.gap = track.gap[track.gap.index(number) + 1 :]
            track.missing -= not self.has_blocks
            return True
        if kind in (REPEATED, STRAY):
            track.duplicates += 1
            return False
        if not self.has_blocks:  # beside blocks, single samples are a selection
            track.missing += number - max(track.sequence.next, 0)
        if 0 <= track.sequence.next < number:
            track.gap = range(track.sequence.next, number)
        track.sequence.count(number)
        track.last_stamp = stamp
        return True

    def _follow_run(self, track: Track, number: int, stamp: int) -> None:
        """Begin a new run with a sample 0, and with the numbers that go back of the topics that are behind.

        The end of the run before may still be on its way, with numbers that go on. A finger that runs free has no
        sample 0 when it is activated again; its numbers go back while its stamps go on.
        """
        goes_back = number < track.sequence.next - 1 and stamp > track.last_stamp
        if track.run == self.run:
            # Sample 0 may be the one that has come already.
            if not goes_back and (number > 0 or track.sequence.next <= 1):
                return
            # In simulated time the new run begins at 0 again; in the bag it comes after the one before.
            self.begin = self.newest + PAUSE if stamp <= self.newest else 0
            self.run += 1
            self.leader = track
            for other in self.tracks.values():
                if other.is_stamped:
                    other.last_stamp = -1
        elif not goes_back and (
            0 <= track.sequence.next <= number or number >= self.leader.sequence.next
        ):
            return
        track.sequence, track.gap = Sequence(gaps=True), range(0)
        track.run, track.begin = self.run, self.begin

    def report(self) -> tuple[str, dict[str, Any]]:
        return self.trouble, {topic: track.recorded for topic, track in self.tracks.items()}

    def _flush(self) -> None:
        """Put on the disk what has come, so that a killed recorder loses no more than a second."""
        if self.writer:
            try:
                self.writer.flush()
            except OSError as error:
                self._give_up(self.writer, error)

    def _give_up(self, writer: BagWriter, error: OSError) -> None:
        """End a recording that the disk does not take; what was written before stays readable."""
        self.writer = None
        self.trouble = f"'bag' {writer.path}: {error.strerror or error}: recording ended"
        self.get_logger().error(
            f"{self.trouble}; `experiment recover {writer.path}` makes a bag of what was written"
        )
        self.publish_diagnostics()

    def _publish_state(self) -> None:
        self._look_for_single_samples()
        tracks = self.tracks
        state = RecorderState(topics=list(tracks))
        state.header.stamp = self.get_clock().now().to_msg()
        state.bag = str(self.writer.path) if self.writer else ""
        state.recorded = [t.recorded for t in tracks.values()]
        state.duplicates = [t.duplicates for t in tracks.values()]
        state.missing = [t.missing for t in tracks.values()]
        self.states.publish(state)


def main() -> int:
    return finger_node.run(RecorderNode)
