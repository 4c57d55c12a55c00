# SPDX-License-Identifier: Apache-2.0
"""The description of the gripper says what its parameters say, and its files name what exists."""

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import xacro
import yaml

from piezo_control.gripper import GripperParameters, check_goal, reach
from piezo_control.nodes.gripper import GripperNodeParameters

FOLDER = Path(__file__).resolve().parents[1] / "description"
DEFAULTS = GripperNodeParameters()
JOINTS = [DEFAULTS.joint, *DEFAULTS.finger_joints]


def described(**arguments):
    """Return the root of the URDF that xacro makes."""
    file = FOLDER / "piezo_gripper.urdf.xacro"
    text = xacro.process_file(str(file), mappings=arguments).toxml()
    return ElementTree.fromstring(text)


def joint(root, name):
    return root.find(f"joint[@name='{name}']")


def numbers(element, *names):
    return [float(element.get(name)) for name in names]


def place(root, link, positions):
    """Return y (m) of a link when joints have these positions, others what they mimic."""
    y = 0.0
    while (j := root.find(f"joint/child[@link='{link}']/..")) is not None:
        y += float(j.find("origin").get("xyz").split()[1]) if j.find("origin") is not None else 0.0
        if j.get("type") == "prismatic":
            y += float(j.find("axis").get("xyz").split()[1]) * position(root, j, positions)
        link = j.find("parent").get("link")
    return y


def position(root, j, positions):
    if j.get("name") in positions:
        return positions[j.get("name")]
    mimic = j.find("mimic")
    source = position(root, joint(root, mimic.get("joint")), positions)
    return float(mimic.get("multiplier")) * source + float(mimic.get("offset", 0.0))


def test_joints_have_the_names_and_limits_of_the_parameters():
    root = described()
    limits = numbers(
        joint(root, DEFAULTS.joint).find("limit"), "lower", "upper", "velocity", "effort"
    )
    assert limits == pytest.approx([*reach(DEFAULTS), DEFAULTS.speed_limit, DEFAULTS.force_limit])
    for name in DEFAULTS.finger_joints:
        limit = joint(root, name).find("limit")
        assert numbers(limit, "lower", "upper", "velocity", "effort") == pytest.approx(
            [
                DEFAULTS.deflection_low,
                DEFAULTS.deflection_high,
                DEFAULTS.speed_limit / 2.0,
                DEFAULTS.force_limit,
            ]
        )
    hardware = root.find("ros2_control")
    assert [j.get("name") for j in hardware.findall("joint")] == [DEFAULTS.joint]
    bounds = [float(p.text) for p in hardware.findall("joint/command_interface/param")]
    assert bounds == pytest.approx(list(reach(DEFAULTS)))
    start = hardware.find("joint/state_interface/param[@name='initial_value']")
    assert float(start.text) == DEFAULTS.rest_opening


def test_arguments_are_the_parameters():
    root = described(
        joint="j", left_finger_joint="l", right_finger_joint="r", rest_opening="100e-6",
        deflection_low="-30e-6", deflection_high="10e-6",
    )  # fmt: skip
    assert numbers(joint(root, "j").find("limit"), "lower", "upper") == pytest.approx([8e-5, 16e-5])
    assert numbers(joint(root, "l").find("limit"), "lower", "upper") == pytest.approx([-3e-5, 1e-5])
    assert joint(root, "r").find("mimic").get("joint") == "j"


@pytest.mark.parametrize(
    "rest_um, low_um, high_um", [(60, -30, 20), (70, -17.5, 0.3), (40, -20, 20)]
)
def test_limits_of_the_joint_are_openings_that_the_node_takes(rest_um, low_um, high_um):
    values = {"rest_opening": rest_um, "deflection_low": low_um, "deflection_high": high_um}
    root = described(**{name: f"{um}e-6" for name, um in values.items()})
    parameters = GripperParameters(**{name: float(f"{um}e-6") for name, um in values.items()})
    ends = numbers(joint(root, DEFAULTS.joint).find("limit"), "lower", "upper")
    assert ends == list(reach(parameters))
    for end in ends:
        assert check_goal(parameters, end, 0.0, 0.0).opening == end


def test_tips_that_would_cross_are_refused():
    with pytest.raises(
        xacro.XacroException, match="deflection_high is 1.5e-05 m: the tips would cross"
    ):
        described(rest_opening="20e-6", deflection_high="15e-6")


@pytest.mark.parametrize("opening", [0.0, 40e-6, 70e-6])
def test_tips_are_as_far_apart_as_the_opening_and_drawn_at_scale(opening):
    root = described(visual_scale="20")
    state = {DEFAULTS.joint: opening}
    left, right = (place(root, f"{side}_finger", state) for side in ("left", "right"))
    assert left - right == pytest.approx(opening, abs=1e-15)
    assert place(root, "gripper_opening", state) == pytest.approx(right, abs=1e-15)
    left, right = (place(root, f"{side}_finger_drawn", state) for side in ("left", "right"))
    assert left - right == pytest.approx(20 * opening, abs=1e-15)


def test_cantilevers_have_the_size_and_mass_of_the_papers():
    """15 x 2 x 0.3 mm, of which 0.2 mm are PZT (7800 kg/m³) and 0.1 mm copper (8960 kg/m³)."""
    for link in described().findall("link/inertial/.."):
        sizes = [list(map(float, b.get("size").split())) for b in link.findall("collision/*/box")]
        assert sizes[0] == pytest.approx([15e-3, 0.3e-3, 2e-3])
        mass = float(link.find("inertial/mass").get("value"))
        assert mass == pytest.approx(15e-3 * 2e-3 * (0.2e-3 * 7800 + 0.1e-3 * 8960))


def test_a_robot_that_has_a_flange_gets_no_world_and_no_hardware_if_it_wants_none():
    root = described(parent="flange", ros2_control="false")
    assert root.find("link[@name='world']") is None
    assert root.find("ros2_control") is None
    assert root.find("joint[@name='gripper_mount']/parent").get("link") == "flange"


def test_moveit_files_name_joints_and_links_that_exist():
    root = described()
    semantic = ElementTree.parse(FOLDER / "piezo_gripper.srdf").getroot()
    known = {e.get("name") for e in root}
    named = {
        value
        for e in semantic.iter()
        for key, value in e.attrib.items()
        if key in ("link1", "link2") or (key == "name" and e.tag in ("joint", "passive_joint"))
    }
    assert named and named <= known
    states = {s.get("name"): float(s[0].get("value")) for s in semantic.findall("group_state")}
    narrowest, widest = reach(DEFAULTS)
    assert states == {"closed": narrowest, "home": DEFAULTS.rest_opening, "open": widest}
    file = yaml.safe_load((FOLDER / "config" / "moveit_controllers.yaml").read_text())
    manager = file["moveit_simple_controller_manager"]
    (name,) = manager["controller_names"]
    # What MoveIt's moveit_simple_controller_manager reads of such a controller; of more it takes no notice.
    assert set(manager[name]) <= {
        "type", "action_ns", "default", "joints", "command_joint", "max_effort", "max_velocity",
    }  # fmt: skip
    assert manager[name]["type"] == DEFAULTS.control_action
    assert manager[name]["joints"] == [DEFAULTS.joint]
    assert manager[name]["max_effort"] <= DEFAULTS.force_limit
    assert manager[name]["max_velocity"] <= DEFAULTS.speed_limit


def test_moveit_plans_on_the_scale_of_this_gripper():
    """MoveIt's time parameterization loses pieces of less than 1 µm, `Path::create`; interpolating makes equal ones."""
    files = {
        name: yaml.safe_load((FOLDER / "config" / f"{name}.yaml").read_text())
        for name in ("joint_limits", "ompl_planning", "moveit_controllers")
    }
    limits = files["joint_limits"]["joint_limits"][DEFAULTS.joint]
    lower, upper, velocity = numbers(
        joint(described(), DEFAULTS.joint).find("limit"), "lower", "upper", "velocity"
    )
    # Wider than a measured opening can be off at an end, and no more than the start of a plan may be off.
    allowed = files["moveit_controllers"]["trajectory_execution"]
    start = allowed["allowed_start_tolerance"]
    for margin in (lower - limits["min_position"], limits["max_position"] - upper):
        assert DEFAULTS.tolerance < margin <= start * (1.0 + 1e-9)
    controller = files["moveit_controllers"]["moveit_simple_controller_manager"]["gripper"]
    assert limits["has_velocity_limits"] and limits["has_acceleration_limits"]
    assert limits["max_velocity"] == controller["max_velocity"] <= velocity
    planning = files["ompl_planning"]
    assert 0.0 < planning["totg"]["min_angle_change"] < DEFAULTS.tolerance
    (group,) = ElementTree.parse(FOLDER / "piezo_gripper.srdf").getroot().findall("group")
    fraction = planning[group.get("name")]["longest_valid_segment_fraction"]
    longest = fraction * (limits["max_position"] - limits["min_position"])
    shortest_of_several = longest / 2
    assert shortest_of_several > 1e-6
    way = upper - lower
    scaling = files["joint_limits"]["default_velocity_scaling_factor"]
    planned = way / (scaling * limits["max_velocity"])
    patience = planned * allowed["allowed_execution_duration_scaling"]
    assert patience + allowed["allowed_goal_duration_margin"] > 2 * way / controller["max_velocity"]


def test_controllers_have_tolerances_of_this_gripper():
    file = yaml.safe_load((FOLDER / "config" / "controllers.yaml").read_text())
    command = file["gripper_controller"]["ros__parameters"]
    assert command["joint"] == DEFAULTS.joint
    narrowest, widest = reach(DEFAULTS)
    # What the gripper takes for reached is reached, and is still no more than a hundredth of the way.
    assert DEFAULTS.tolerance < command["goal_tolerance"] < (widest - narrowest) / 100
    # A motion at the speed of a goal that names none is no stall.
    assert command["stall_velocity_threshold"] < command["max_velocity"] / 10
    assert command["max_velocity"] <= DEFAULTS.speed_limit
    assert command["max_effort"] <= DEFAULTS.force_limit
    follow = file["gripper_trajectory_controller"]["ros__parameters"]
    assert follow["joints"] == [DEFAULTS.joint]
    assert DEFAULTS.tolerance < follow["constraints"][DEFAULTS.joint]["goal"]
    rate = file["controller_manager"]["ros__parameters"]["update_rate"]
    assert rate == DEFAULTS.joint_state_rate


def test_layouts_show_frames_and_topics_that_exist():
    root = described()
    rviz = yaml.safe_load((FOLDER / "config" / "gripper.rviz").read_text())["Visualization Manager"]
    frames = {rviz["Global Options"]["Fixed Frame"], rviz["Views"]["Current"]["Target Frame"]}
    for display in rviz["Displays"]:
        frames |= set(display.get("Frames", {})) - {"All Enabled"}
    assert frames <= {link.get("name") for link in root.findall("link")}
    panels = json.loads((FOLDER / "config" / "foxglove.json").read_text())["configById"]
    paths = {path["value"] for panel in panels.values() for path in panel.get("paths", [])}
    quantities = {"position", "velocity", "effort"}
    for path in paths:
        topic, _, field = path.rpartition(".")
        assert topic in ("/joint_states", "/left/state", "/right/state")
        assert field.partition("[")[0] in quantities | {"temperature"}
