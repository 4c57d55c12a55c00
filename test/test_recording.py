# SPDX-License-Identifier: Apache-2.0
"""Reading of runs from bags: whole, damaged, foreign, from a wall clock."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from piezo_control.profile import Profile
from piezo_control.recording.recording import SAMPLE_TYPE, BagError, Recording, read
from piezo_control.recording.writer import LITTLE_ENDIAN, SAMPLE_CDR, BagWriter, write_recording

H = 1e-4
COUNT = 20_000  # more than one chunk of the MCAP file
REFERENCE = Profile([0.0, 0.5, 1.0], [0.0, 2e-5, -1e-5], linear=True)
FORCE = Profile([0.0, 1.0], [0.0, 1e-3])


def run_of(count: int = COUNT) -> Recording:
    number = np.arange(count)
    rng = np.random.Generator(np.random.PCG64(3))
    signals = {n: rng.standard_normal(count) for n in ("deflection", "command", "voltage")}
    time = number * H
    return Recording(
        number=number,
        time=time,
        limited=(signals["voltage"] > 1.0).astype(float),
        reference=REFERENCE.at(time),
        temperature=np.where(time < 0.7, 22.0, 32.0),
        tip_force=FORCE.at(time),
        **signals,
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags") / "run"
    made = run_of()
    write_recording(folder, "left", made, REFERENCE, FORCE)
    return folder, made


def assert_same(got: Recording, made: Recording, count: int) -> None:
    for name in ("number", "time", "reference", "deflection", "command", "voltage", "limited", "temperature",
                 "tip_force"):  # fmt: skip
        np.testing.assert_allclose(
            getattr(got, name), getattr(made, name)[:count], rtol=0, atol=1e-12, err_msg=name
        )


def test_what_was_written_is_read(written):
    folder, made = written
    assert_same(read(folder), made, COUNT)
    assert_same(read(folder, finger="left"), made, COUNT)
    assert read(folder).sample_time == H


def test_storage_file_alone_is_read(written):
    folder, made = written
    assert_same(read(folder / "run.mcap"), made, COUNT)


@pytest.mark.parametrize("has_metadata", [True, False])
@pytest.mark.parametrize("part", [0.4, 0.62, 0.85])
def test_cut_file_is_refused_and_then_read_as_far_as_it_goes(written, tmp_path, part, has_metadata):
    folder, made = written
    cut = tmp_path / "cut"
    shutil.copytree(folder, cut)
    content = (folder / "run.mcap").read_bytes()
    (cut / "run.mcap").write_bytes(content[: int(part * len(content))])
    if not has_metadata:
        (cut / "metadata.yaml").unlink()
    with pytest.raises(BagError, match=r"cut: .*could be read: .*/left/deflection \(\d+ piezo"):
        read(cut)
    got = read(cut, partial=True)
    # A part of the file holds about that part of the samples; its index at the end takes a tenth.
    assert got.time.size == pytest.approx(min(1.0, part / 0.9) * COUNT, rel=0.1)
    assert_same(got, made, got.time.size)


def test_recorder_that_was_killed_leaves_a_readable_part(tmp_path):
    # Sample by sample, as the recorder writes; killed: neither close() nor metadata.yaml.
    bag = BagWriter(tmp_path / "killed")
    topics = [bag.add(f"/f/{n}", SAMPLE_TYPE) for n in ("deflection", "voltage")]
    for k in range(40_000):
        for topic in topics:
            bag.write(topic, k * 100_000, sample(k, k * 100_000, float(k)))
    bag._writer.storage.bio.flush()
    with pytest.raises(BagError, match="did not finish it: metadata.yaml is missing"):
        read(tmp_path / "killed")
    got = read(tmp_path / "killed", partial=True)
    assert got.time.size > 10_000  # every chunk of 1 MiB that was complete
    np.testing.assert_array_equal(got.deflection, got.number)
    np.testing.assert_array_equal(got.voltage, got.number)
    assert np.all(np.isnan(got.command))


def sample(number: int, stamp: int, value: float) -> bytes:
    return SAMPLE_CDR.pack(
        LITTLE_ENDIAN, *divmod(stamp, 10**9), 1, number, value, 1e-4, False, False, False
    )


def test_no_bag_at_all(tmp_path):
    with pytest.raises(BagError, match="nowhere: no such bag"):
        read(tmp_path / "nowhere")
    with pytest.raises(BagError, match="no .mcap or .db3 file"):
        read(tmp_path)
    (tmp_path / "text.mcap").write_text("hello, world")
    with pytest.raises(BagError, match="magic"):
        read(tmp_path / "text.mcap")


def foreign(path: Path, topic: str, plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float64"
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        data = store.serialize_cdr(store.types[kind](1.0), kind)
        for stamp in range(3):
            writer.write(connection, stamp, bytes(data))
    return path


def test_foreign_bags_are_refused_by_topic_and_type(tmp_path):
    with pytest.raises(BagError, match=r"/arm/position \(3 std_msgs/msg/Float64\)"):
        read(foreign(tmp_path / "a", "/arm/position"))
    with pytest.raises(
        BagError, match="'/arm/deflection' is of type std_msgs/msg/Float64, must be"
    ):
        read(foreign(tmp_path / "b", "/arm/deflection"))


WALL = 1_764_000_000 * 10**9  # ns


def hardware_bag(path: Path, plugin: StoragePlugin) -> None:
    """As `ros2 bag record` takes down a free-running finger: wall clock, jitter, repeats, set-points."""
    bag = BagWriter(path.with_name("types"))
    bag.add("/f/deflection", SAMPLE_TYPE)
    rng = np.random.Generator(np.random.PCG64(5))
    jitter = rng.integers(-20_000, 20_000, 1000)
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        add = {
            n: writer.add_connection(f"/f/{n}", SAMPLE_TYPE, typestore=bag.typestore)
            for n in ("deflection", "command", "voltage", "reference")
        }
        for k in range(300, 1000):
            stamp = WALL + k * 1_000_000 + int(jitter[k])
            if k == 500:  # a set-point as `ros2 topic pub` sends it: without a stamp
                writer.write(add["reference"], stamp - 100, sample(0, 0, 2e-5))
            for name, scale in (("deflection", 1.0), ("command", 2.0), ("voltage", 3.0)):
                if name == "command" and k == 400:
                    continue  # lost
                for _ in range(2 if k == 450 else 1):  # asked for again
                    writer.write(add[name], stamp + 10, sample(k, stamp, scale * k))


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_wall_clock_bag_of_a_free_running_finger(tmp_path, plugin):
    hardware_bag(tmp_path / "hw", plugin)
    got = read(tmp_path / "hw")
    np.testing.assert_array_equal(got.number, np.arange(300, 1000))
    np.testing.assert_array_equal(got.deflection, got.number)
    np.testing.assert_array_equal(got.voltage, 3.0 * got.number)
    assert np.flatnonzero(np.isnan(got.command)).tolist() == [100]
    assert got.time[0] == 0.0 and got.time[-1] == pytest.approx(0.699, abs=1e-4)
    assert np.isnan(got.reference[199]) and got.reference[200] == 2e-5
    assert np.all(np.isnan(got.temperature))


def test_sqlite_file_without_metadata(tmp_path):
    hardware_bag(tmp_path / "hw", StoragePlugin.SQLITE3)
    (tmp_path / "hw" / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="metadata.yaml is missing"):
        read(tmp_path / "hw")
    assert read(tmp_path / "hw", partial=True).time.size == 700
    (file,) = (tmp_path / "hw").glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE messages")
    with pytest.raises(BagError, match="no such table: messages|no topic"):
        read(tmp_path / "hw", partial=True)


def test_several_runs_and_fingers_have_to_be_named(tmp_path):
    bag = BagWriter(tmp_path / "many")
    left = bag.add("/left/deflection", SAMPLE_TYPE)
    right = bag.add("/right/deflection", SAMPLE_TYPE)
    for run in range(2):
        for k in range(5):
            bag.write(left, (10 * run + k) * 10**6, sample(k, k * 10**6, float(run)))
    bag.write(right, 0, sample(0, 0, 7.0))
    bag.close()
    with pytest.raises(BagError, match="several fingers"):
        read(tmp_path / "many")
    with pytest.raises(BagError, match="has 2 runs"):
        read(tmp_path / "many", "left")
    assert read(tmp_path / "many", "left", run=1).deflection.tolist() == [1.0] * 5
    with pytest.raises(BagError, match="has 2 runs"):
        read(tmp_path / "many", "left", run=2)
    assert read(tmp_path / "many", "/right").deflection.tolist() == [7.0]


def test_writer_refuses_an_existing_folder(tmp_path):
    with pytest.raises(ValueError, match="which exists"):
        BagWriter(tmp_path)
    with pytest.raises(ValueError, match="cannot be written"):
        BagWriter("/proc/no/bag").add("/f/state", "std_msgs/msg/String")
