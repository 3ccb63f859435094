"""Motions of `spelgen excite`: approach, ROS 2 message, and no contact of the arm with itself, the floor or boxes.

The arm has spheres on its links and moves in a plane, so that exact distances follow from sines and cosines.
"""

import json
import sys

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.errors import ArmError, SettingsError
from spelgen.excitation.bounds import Box, Surroundings, motion_bounds
from spelgen.excitation.collisions import Collisions
from spelgen.excitation.design import excite
from spelgen.excitation.trajectory import Motion, approach

LENGTH, RADIUS, BASE = 0.5, 0.06, 0.2
SPHERE = '<collision><origin xyz="0 0 {}"/><geometry><sphere radius="{}"/></geometry></collision>'
JOINT = (
    '<joint name="j{}" type="revolute"><parent link="{}"/><child link="{}"/><origin xyz="0 0 {}"/><axis xyz="0 1 0"/>'
    '<limit lower="-2.5" upper="2.5" effort="50" velocity="1.5"/></joint>'
)
ARM = (
    f'<robot name="arm"><link name="a">{SPHERE.format(0, BASE)}</link>'
    + "".join(f'<link name="{x}">{SPHERE.format(LENGTH, RADIUS)}</link>' for x in "bcd")
    + JOINT.format(1, "a", "b", 0)
    + JOINT.format(2, "b", "c", LENGTH)
    + JOINT.format(3, "c", "d", LENGTH)
    + "</robot>"
)
QUICK = {"duration": 6.0, "trials": 25, "sample_rate": 100.0}
FLOOR = -0.3
CELL = Surroundings(floor=FLOOR, boxes={"wall": Box(size=(0.2, 4, 4), xyz=(1.1, 0, 0))})


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def centres(q):
    """Return the centres of the spheres of links b, c and d at q (..., 3), (..., 3, 2) [m]: x and z."""
    angle = np.cumsum(q, axis=-1)
    return LENGTH * np.cumsum(np.stack([np.sin(angle), np.cos(angle)], axis=-1), axis=-2)


def clearances(q):
    """Return nine exact distances of the spheres of links a (base), b, c and d at q (..., 3) [rad], (..., 9) [m].

    They are a to c, a to d, b to d; then b, c and d to the floor; then b, c and d to the wall.
    """
    b, c, d = np.moveaxis(centres(q), -2, 0)
    own = [np.linalg.norm(x, axis=-1) - BASE - RADIUS for x in (c, d)]
    own.append(np.linalg.norm(d - b, axis=-1) - 2 * RADIUS)
    floor, wall = ([f(x) for x in (b, c, d)] for f in (to_floor, to_wall))
    return np.stack(own + floor + wall, axis=-1)


def to_floor(centre):
    return centre[..., 1] - RADIUS - FLOOR


def to_wall(centre):
    """Return the distance [m] of the surfaces of spheres from the front of the wall, the plane x = 1 m.

    centre: centres of the spheres in the vertical plane, (..., 2) [m]. The arm reaches no other side of the wall.
    """
    return 1.0 - centre[..., 0] - RADIUS


def collisions(urdf, surroundings=CELL):
    arm = load_arm(urdf)
    return Collisions(arm, surroundings, motion_bounds(arm.chain, 1.0, 1.0))


def test_distances_and_their_gradient_are_those_of_spheres(urdf):
    found, q = collisions(urdf), np.random.default_rng(0).uniform(-2.5, 2.5, (40, 3))
    # only configurations in front of the wall, where `to_wall` is exact
    free = clearances(q)[:, 6:].min(axis=1) > 0
    np.testing.assert_allclose([found.distances(x) for x in q[free]], clearances(q[free]), atol=2e-6)
    value, gradient = found.penalty(q)
    assert value > 1
    steps = 1e-6 * np.eye(3)
    for row, slope in zip(q, gradient, strict=True):
        differences = [found.penalty((row + e)[None])[0] - found.penalty((row - e)[None])[0] for e in steps]
        np.testing.assert_allclose(slope, np.array(differences) / 2e-6, rtol=1e-4, atol=1e-3)


def test_motion_and_approach_keep_the_clearance_at_all_times(urdf):
    """A motion that is planned with a floor and a wall never touches them, neither at samples nor between samples.

    A motion that is planned without them hits them.
    """
    blind = excite(load_arm(urdf), **QUICK, start=[0, 0.5, 0.5])
    assert clearances(blind.motion.q).min() < -0.05
    assert blind.collisions == "Checked: 3 pairs of links, approach included; all keep 10 mm."
    found = excite(load_arm(urdf), **QUICK, start=[0, 0.5, 0.5], surroundings=CELL)
    whole = found.approach.then(found.motion)
    fine = np.arange(0, whole.t[-1], 1e-3)
    q = np.stack([np.interp(fine, whole.t, column) for column in whole.q.T], axis=-1)
    assert clearances(q).min() > 0
    assert (
        "Checked: 9 pairs of links and surroundings, approach included; all keep 10 mm." in found.collisions
    )


@pytest.mark.parametrize("angle", [2.5, 2.0, 1.5])
def test_a_contact_between_two_samples_is_found(urdf, angle):
    """A contact between two samples of a motion is found, with its links, time and distance.

    In one step of the motion, link c swings through a box.
    """
    q = np.array([[0.0, -2.5, 0.0], [0.0, angle, 0.0]])
    motion = Motion(np.array([0.0, 2.0]), q, 0 * q, 0 * q)
    assert collisions(urdf, Surroundings()).contact(motion) is None
    wall = Surroundings(boxes={"post": Box(size=(0.05, 0.05, 0.05), xyz=(0, 0, 1.0))})
    contact = collisions(urdf, wall).contact(motion)
    assert contact is not None and {contact.first, contact.second} == {"c", "box 'post'"}
    # at the first contact, link c has not yet reached the position below the box
    reached = np.interp(contact.time, motion.t, q[:, 1])
    assert -0.3 < reached < 0 and 0 < contact.distance < 0.01


def test_the_approach_is_the_fastest_within_speed_and_acceleration():
    start, end = np.array([0.0, 1.0, -1.0]), np.array([2.0, 0.9, -1.0])
    for speed, acceleration, bound in ((0.5, 100.0, "qd"), (50.0, 0.7, "qdd")):
        motion = approach(start, end, np.full(3, speed), np.full(3, acceleration), 1000.0)
        np.testing.assert_allclose(motion.q[[0, -1]], [start, end], atol=1e-12)
        np.testing.assert_allclose([motion.qd[[0, -1]], motion.qdd[[0, -1]]], 0, atol=1e-12)
        np.testing.assert_allclose(np.gradient(motion.q, motion.t, axis=0), motion.qd, atol=2e-3)
        np.testing.assert_allclose(
            np.gradient(motion.qd, motion.t, axis=0)[1:-1], motion.qdd[1:-1], atol=2e-2
        )
        largest = {"qd": np.abs(motion.qd).max() / speed, "qdd": np.abs(motion.qdd).max() / acceleration}
        assert largest.pop(bound) == pytest.approx(1, abs=1e-4) and max(largest.values()) < 1
    assert approach(start, start, np.ones(3), np.ones(3), 100.0).t.tolist() == [0.0]


def test_accelerations_are_bounded_in_motion_and_approach(urdf):
    limits = np.array([0.5, 1.0, 2.0])
    found = excite(load_arm(urdf), **QUICK, acceleration=limits)
    whole = found.approach.then(found.motion)
    used = np.abs(whole.qdd).max(axis=0) / limits
    assert (used <= 1).all() and used[0] > 0.5


def test_the_message_is_a_joint_trajectory_of_ros_2(urdf):
    """An exported motion has the fields and types of a ROS 2 JointTrajectory; JSON and YAML readers agree on it."""
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    found = excite(load_arm(urdf), **QUICK, start=[0.1, 0.2, 0.3])
    text = found.joint_trajectory()
    content = json.loads(text)
    assert yaml.safe_load(text) == content

    def message(name, values):
        definition = store.types[name].__dataclass_fields__
        assert definition.keys() - {"__msgtype__"} == values.keys()
        return store.types[name](**values)

    points = []
    for point in content["points"]:
        point["time_from_start"] = message("builtin_interfaces/msg/Duration", point["time_from_start"])
        arrays = {key: np.array(x) for key, x in point.items() if key != "time_from_start"}
        points.append(message("trajectory_msgs/msg/JointTrajectoryPoint", point | arrays))
    content["header"]["stamp"] = message("builtin_interfaces/msg/Time", content["header"]["stamp"])
    content["header"] = message("std_msgs/msg/Header", content["header"])
    sent = message("trajectory_msgs/msg/JointTrajectory", content | {"points": points})
    name = "trajectory_msgs/msg/JointTrajectory"
    received = store.deserialize_cdr(store.serialize_cdr(sent, name), name)
    times = [x.time_from_start.sec + 1e-9 * x.time_from_start.nanosec for x in received.points]
    assert received.joint_names == ["j1", "j2", "j3"] and (np.diff(times) > 1e-3).all()
    np.testing.assert_allclose(received.points[0].positions, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        np.array([x.positions for x in received.points])[-601:], found.motion.q, atol=1e-9
    )
    # velocities and accelerations are the derivatives of positions, also across the end of the approach
    velocity = np.array([x.velocities for x in received.points])
    position = np.array([x.positions for x in received.points])
    np.testing.assert_allclose(np.gradient(position, times, axis=0)[1:-1], velocity[1:-1], atol=5e-3)


def test_pairs_and_links_that_cannot_be_checked_are_named(urdf, monkeypatch):
    arm = ARM.replace(
        SPHERE.format(LENGTH, RADIUS), SPHERE.format(LENGTH, 1.2), 1
    )  # the sphere of b is so large that it contains link d
    urdf.write_text(arm.replace("</link><link name=\"d\">", '<collision><geometry><mesh filename="c.stl"/></geometry>'
                                '</collision></link><link name="d">'))  # fmt: skip
    text = collisions(urdf, Surroundings()).statement
    assert "Not checked, since their shapes overlap in most positions: b and d." in text
    assert text.endswith("Not checked, since their shapes cannot be read: c (c.stl).")
    # only one link keeps its collision shape
    urdf.write_text(ARM.replace("collision", "visual", ARM.count("collision") - 2))
    assert collisions(urdf, Surroundings()).statement.startswith(
        "Not checked: collisions (there are no pairs of"
    )
    urdf.write_text(ARM.replace("collision", "visual"))
    found = excite(load_arm(urdf), **QUICK)
    assert found.collisions == "Not checked: collisions (the URDF has no collision geometry)."
    monkeypatch.setitem(sys.modules, "coal", None)
    monkeypatch.delitem(sys.modules, "spelgen.excitation.collisions")
    assert "pip install 'spelgen[simulate]'" in excite(load_arm(urdf), **QUICK).collisions


def test_an_arm_that_cannot_move_freely_gets_no_motion(urdf, monkeypatch):
    """An arm that is enclosed by boxes gets no motion: the error names links, times and remedies."""
    side = {"size": (0.1, 4, 4)}
    near = Surroundings(
        boxes={"left": Box(**side, xyz=(-0.15, 0, 2.3)), "right": Box(**side, xyz=(0.15, 0, 2.3))}
    )
    with pytest.raises(ArmError) as caught:
        excite(load_arm(urdf), **QUICK | {"trials": 1}, surroundings=near)
    message = str(caught.value)
    assert message.startswith("excite: no motion without a contact: ") and message.count(" mm)") == 5
    assert "box 'left'" in message and "s (" in message and "--reach" in message
    with pytest.raises(
        ArmError, match=r"excite: start: a contact at the start: .*; name a free position by --from"
    ):
        excite(load_arm(urdf), **QUICK, surroundings=near, start=[0.5, 0, 0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": [0, 0]}, "start: got [0, 0], expected one number per joint: j1, j2, j3"),
        ({"start": [0, 0, 9]}, "start of 'j3': got 9, expected -2.5 .. 2.5"),
        ({"acceleration": -1}, "acceleration: got -1, expected one positive number per joint: j1, j2, j3"),
    ],
)
def test_values_out_of_range_are_refused(urdf, changes, message):
    with pytest.raises(SettingsError) as caught:
        excite(load_arm(urdf), **QUICK | changes)
    assert str(caught.value) == f"excite: {message}"


def test_the_command_writes_trajectory_and_page(urdf, tmp_path):
    cell = tmp_path / "cell.yaml"
    cell.write_text("floor: -0.3\nboxes:\n  wall: {size: [0, 4, 4], xyz: [1.1, 0, 0]}\n")
    files = {option: str(tmp_path / f"m{option}") for option in ("-o", "--trajectory", "--html")}
    command = ["excite", str(urdf), "--duration", "5", "--trials", "5", "--surroundings", str(cell)]
    command += [part for pair in files.items() for part in pair]
    refused = CliRunner().invoke(app, command)
    assert refused.stderr == f"{cell}:3: boxes.wall.size.0: got 0, expected greater than 0\n"
    cell.write_text(cell.read_text().replace("[0,", "[0.2,"))
    shown = CliRunner().invoke(app, [*command, "--format", "json", "--from", "0,0.5,0.5"])
    assert shown.exit_code == 0, shown.stderr
    answer = json.loads(shown.stdout)
    assert answer["files"] == list(files.values()) and answer["start"] == [0, 0.5, 0.5]
    page = (tmp_path / "m--html").read_text()
    assert answer["collisions"] in page and page.count('data-motion="motion"') == 6
    drawn = json.loads(page.partition('id="scene">')[2].partition("</script>")[0])
    assert [motion["label"] for motion in drawn["motions"]] == ["approach and motion"]
    assert drawn["motions"][0]["q"][0] == [0, 0.5, 0.5]
    assert CliRunner().invoke(app, [*command, "--force", "--from", "0,a"]).exit_code == 2
