# SPDX-License-Identifier: Apache-2.0
"""Damaged bags: whatever bytes are lost or wrong, what is read is right or the bag is refused in words."""

import shutil
import sqlite3

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.progress import Progress
from test_bags import WALL, H, Session

from piezo_control.recording.reader import BagError
from piezo_control.recording.recording import read
from piezo_sim.experiment.cases import read_experiment
from piezo_sim.experiment.on_engine import run_on_engine


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    _, (case, *_) = read_experiment("step", {"duration": 0.02})
    bag = run_on_engine(
        case, tmp_path_factory.mktemp("whole"), "finger", Progress(disable=True)
    ).bag
    return bag, read(bag).deflection


damages = st.one_of(
    st.tuples(st.just("cut"), st.floats(0.0, 1.0), st.just(b"")),
    st.tuples(st.just("overwrite"), st.floats(0.0, 1.0), st.binary(min_size=1, max_size=40)),
    st.tuples(st.just("insert"), st.floats(0.0, 1.0), st.binary(min_size=1, max_size=40)),
)


def spoil(path, damage):
    kind, place, data = damage
    content = bytearray(path.read_bytes())
    at = int(place * len(content))
    if kind == "cut":
        del content[at:]
    elif kind == "insert":
        content[at:at] = data
    else:
        content[at : at + len(data)] = data
    path.write_bytes(content)


@settings(
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(storage=st.booleans(), metadata=st.sampled_from(["kept", "gone", "spoilt"]), damage=damages)
def test_no_damage_ends_in_another_error(whole, tmp_path_factory, storage, metadata, damage):
    bag = tmp_path_factory.mktemp("damaged") / "bag"
    undamaged, deflection = whole
    shutil.copytree(undamaged, bag)
    (mcap,) = bag.glob("*.mcap")
    if storage:
        spoil(mcap, damage)
    if metadata == "gone":
        (bag / "metadata.yaml").unlink()
    elif metadata == "spoilt":
        spoil(bag / "metadata.yaml", damage)
    try:
        recording = read(bag, partial=True)
    except BagError as error:
        assert str(bag) in str(error)
        return
    assert recording.deflection.size == recording.voltage.size > 0
    if not storage:
        np.testing.assert_array_equal(recording.deflection, deflection)


@given(data=st.binary(max_size=300), name=st.sampled_from(["a.mcap", "a.db3"]))
def test_files_that_are_no_bags_are_refused(tmp_path_factory, data, name):
    path = tmp_path_factory.mktemp("none") / name
    path.write_bytes(data)
    with pytest.raises(BagError, match=name):
        read(path, partial=True)


def test_a_database_of_something_else_is_refused(tmp_path):
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("create table messages (id integer)")
    with pytest.raises(BagError, match="a.db3"):
        read(path, partial=True)


def test_the_files_of_a_split_bag_are_read_in_the_order_they_were_written(tmp_path):
    for part in range(12):
        bag = Session(tmp_path / f"{part}")
        for number in range(10 * part, 10 * part + 10):
            stamp = WALL + round(number * H * 1e9)
            for signal in ("deflection", "command", "voltage"):
                bag.sample(signal, number, number, stamp)
        bag.bag.close()
        (tmp_path / "split").mkdir(exist_ok=True)
        (tmp_path / f"{part}" / f"{part}.mcap").rename(tmp_path / "split" / f"run_{part}.mcap")
    np.testing.assert_array_equal(
        read(tmp_path / "split", partial=True).deflection, np.arange(120.0)
    )
