# SPDX-License-Identifier: Apache-2.0
"""Parameter files as people and `ros2 param dump` write them, and files that are none."""

import errno
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezo_control.feedforward import FeedforwardParameters
from piezo_control.parameters import ParameterError, build, dump, load, need_one_for, provenance


def written(tmp_path, text):
    path = tmp_path / "f.yaml"
    path.write_text(text)
    return path


def test_numbers_are_read_as_ros_reads_them(tmp_path):
    text = "/**/feedforward: {ros__parameters: {static_gain: 55e-8, slew_limit: 1E4, voltage_low: -4e+1}}"
    values = load(written(tmp_path, text), "feedforward")
    assert values == {"static_gain": 5.5e-7, "slew_limit": 1e4, "voltage_low": -40.0}
    assert build(FeedforwardParameters, values).slew_limit == 1e4


def test_a_dump_of_a_running_node_is_read(tmp_path):
    text = """
/finger/feedforward:
  ros__parameters:
    autostart: true
    qos_overrides: {/parameter_events: {publisher: {depth: 1000}}}
    start_type_description_service: true
    use_sim_time: false
    voltage_high: 35.0
"""
    assert load(written(tmp_path, text), "feedforward") == {"voltage_high": 35.0}
    with pytest.raises(ParameterError, match="nothing for node 'feedback'"):
        load(written(tmp_path, text), "feedback")


@pytest.mark.parametrize(
    "head, said",
    [
        ("", []),
        ("# Made by hand.\n# proven: by nobody\n", ["Made by hand."]),
        (
            "# hysteresis: from a.csv\n# hysteresis: 95 %\n# dynamics: from b.csv\n# The limits\n# are yours.\n",
            ["hysteresis: from a.csv", "dynamics: from b.csv"],
        ),
    ],
)
def test_a_head_says_where_values_come_from(tmp_path, head, said):
    """As `identify` writes them, block by block, and everybody else in a sentence."""
    assert provenance(written(tmp_path, f"{head}a: 1\n# inside\n")) == said


@pytest.mark.parametrize(
    ("name", "matches"),
    [
        ("/**", True),
        ("/**/feedback", True),
        ("/finger/feedback", True),
        ("/*/feedback", True),
        ("finger: {feedback", True),
        ("/feedback", False),  # without the namespace, ROS 2 passes over it
        ("/*", False),
        ("/finger/feedback_2", False),
    ],
)
def test_a_file_for_other_nodes_is_refused(tmp_path, name, matches):
    end = "}" if "{" in name else ""
    path = written(tmp_path, f"{name}: {{ros__parameters: {{voltage_high: 1.0}}}}{end}")
    if matches:
        need_one_for(path, ["/finger/feedforward", "/finger/feedback"])
    else:
        with pytest.raises(
            ParameterError, match="nothing for node '/finger/feedback'; it has .*NAME"
        ):
            need_one_for(path, ["/finger/feedback"])


def test_later_matches_win_and_wildcards_count(tmp_path):
    text = "/**: {ros__parameters: {a: 1, b: 2}}\nfeed*: {ros__parameters: {b: 3}}\n"
    assert load(written(tmp_path, text), "feedforward") == {"a": 1, "b": 3}


@pytest.mark.parametrize(
    "data, words",
    [
        (b"\xff\xfe\x00binary\x81", "cannot be read as YAML"),
        (b"[" * 5000, "cannot be read as YAML"),
        (b"- a list", "top level is no mapping"),
        (b"/**: 7", "has no 'ros__parameters' mapping"),
        (b"a: b: c", "cannot be read as YAML"),
    ],
)
def test_what_is_no_parameter_file_is_refused_by_name(tmp_path, data, words):
    path = tmp_path / "f.yaml"
    path.write_bytes(data)
    with pytest.raises(ParameterError, match=f"f.yaml: .*{words}"):
        load(path, "feedforward")


@given(st.binary(max_size=300) | st.text(max_size=300).map(str.encode))
def test_rubbish_never_ends_in_another_error(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("rubbish") / "f.yaml"
    path.write_bytes(data)
    with pytest.raises(ParameterError, match="f.yaml"):
        build(FeedforwardParameters, load(path, "feedforward"), str(path))


def test_whole_numbers_stand_for_floats_and_nothing_else_does():
    made = build(
        FeedforwardParameters,
        {"voltage_high": 20, "hysteresis.weights": [1], "hysteresis.thresholds": [0]},
    )
    assert type(made.voltage_high) is type(made.hysteresis.weights[0]) is float
    for value in (True, "20", None, [20.0]):
        with pytest.raises(ParameterError, match="'voltage_high' is .*, must be of type float"):
            build(FeedforwardParameters, {"voltage_high": value})


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("voltage_hihg", "voltage_high"),
        ("weights", "hysteresis.weights"),
        ("slew_limits", "slew_limit"),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest(written, meant):
    with pytest.raises(ParameterError, match=f"'{written}'; did you mean '{meant}'"):
        build(FeedforwardParameters, {written: 5.0})


def test_a_full_disk_leaves_the_file_of_before(tmp_path, monkeypatch):
    path, link = tmp_path / "mine.yaml", tmp_path / "link.yaml"
    link.symlink_to(path)
    dump(path, "feedback", {"sample_time": 1e-3})
    dump(link, "feedback", {"sample_time": 1e-4})
    assert link.is_symlink() and load(path, "feedback") == {"sample_time": 1e-4}
    before = path.read_text()
    written = Path.write_text

    def full(place, text):
        written(place, text[:9])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match=f"No space left on device: '{path}'"):
        dump(path, "feedback", {"sample_time": 1e-2})
    assert path.read_text() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link.yaml", "mine.yaml"]
