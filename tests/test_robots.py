"""The robots of the repository are read without warnings, physically consistent and true to their sources."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from lxml import etree

from spelgen import inspect
from spelgen.arm.arm import make_arm
from spelgen.settings.settings import load_settings
from spelgen.urdf.read import read_urdf

ROBOTS = Path(__file__).parents[1] / "robots"
SIX = ("two_link", "rpr", "six_dof", "scara", "panda", "ur10e")
RIGHT = np.pi / 2

# Denavit-Hartenberg rows (a [m], alpha [rad], d [m], theta [rad], prismatic) from the sources in the settings files
STANDARD = {
    "two_link": [(1, 0, 0, 0, False), (1, 0, 0, 0, False)],
    "rpr": [(0, RIGHT, 0.154, 0, False), (0.0203, 0, 0, -RIGHT, True), (0, 0, 0, 0, False)],
    "scara": [
        (0.325, 0, 0.387, 0, False),
        (0.275, np.pi, 0, 0, False),
        (0, 0, 0, 0, True),
        (0, 0, 0, 0, False),
    ],
    "ur10e": [
        (0, RIGHT, 0.1807, 0, False),
        (-0.6127, 0, 0, 0, False),
        (-0.57155, 0, 0, 0, False),
        (0, RIGHT, 0.17415, 0, False),
        (0, -RIGHT, 0.11985, 0, False),
        (0, 0, 0.11655, 0, False),
    ],
}
MODIFIED = {
    "six_dof": [
        (0, 0, 0.1223, 0, False),
        (0, RIGHT, 0, 0, False),
        (-0.27, 0, 0, 0, False),
        (-0.253, 0, 0.1233, 0, False),
        (0, RIGHT, 0.1071, 0, False),
        (0, -RIGHT, 0.0991, 0, False),
    ],
    "panda": [
        (0, 0, 0.333, 0, False),
        (0, -RIGHT, 0, 0, False),
        (0, RIGHT, 0.316, 0, False),
        (0.0825, RIGHT, 0, 0, False),
        (-0.0825, -RIGHT, 0.384, 0, False),
        (0, RIGHT, 0, 0, False),
        (0.088, RIGHT, 0, 0, False),
    ],
}
# per link, in its DH frame: mass [kg], centre of mass [m], and inertia about it [kg m^2], (xx, yy, zz) or (xx, xy, xz,
# yy, yz, zz); from the sources in the settings files
INERTIALS = {
    "two_link": 2 * [(1, (-0.5, 0, 0), (0.6, 0.6, 1))],
    "rpr": [
        (5.01, (0, -1.05, 0), (0.108, 0.018, 0.1)),
        (4.25, (0, 0, -6.45), (2.51, 2.51, 0.006)),
        (1.08, (0, 0.092, -0.054), (0.002, 0.001, 0.001)),
    ],
    "ur10e": [
        (7.369, (0.021, 0, 0.027), (0.03408, 0.00002, -0.00425, 0.03529, 0.00008, 0.02156)),
        (13.051, (0.38, 0, 0.158), (0.02814, 0.00005, -0.01561, 0.77068, 0.00002, 0.76943)),
        (3.989, (0.24, 0, 0.068), (0.01014, 0.00008, 0.00916, 0.30928, 0, 0.30646)),
        (2.1, (0, 0.007, 0.018), (0.00296, -0.00001, 0, 0.00222, -0.00024, 0.00258)),
        (1.98, (0, 0.007, 0.018), (0.00296, -0.00001, 0, 0.00222, -0.00024, 0.00258)),
        (0.615, (0, 0, -0.026), (0.0004, 0.00041, 0.00034)),
    ],
}


@pytest.fixture(params=SIX)
def robot(request):
    return request.param


def test_reading_it_needs_no_remark(robot):
    path = ROBOTS / f"{robot}.urdf"
    read = read_urdf(path)
    arm = make_arm(read, gravity=load_settings(path).gravity)
    assert read.diagnostics + arm.diagnostics == ()
    assert read.name == robot
    assert arm.inertials_complete
    assert not arm.locked


def test_every_joint_has_limits_effort_and_velocity(robot):
    for joint in make_arm(read_urdf(ROBOTS / f"{robot}.urdf")).coordinates:
        assert joint.lower < joint.upper
        assert joint.effort > 0
        assert joint.velocity > 0


def test_every_inertial_is_one_of_a_real_body(robot):
    inertials = [link.inertial for link in read_urdf(ROBOTS / f"{robot}.urdf").links if link.inertial]
    for inertial in inertials:
        assert inertial.mass > 0
        smallest, middle, largest = np.linalg.eigvalsh(symmetric(inertial.tensor))
        assert smallest > 0
        assert largest <= smallest + middle + 1e-12  # equality holds for a flat body, such as link 3 of rpr


def test_the_sidecar_fits_and_names_its_sources(robot):
    path = ROBOTS / f"{robot}.urdf"
    joints = [joint.name for joint in make_arm(read_urdf(path)).coordinates]
    settings = load_settings(path, joints)
    assert settings.diagnostics == ()
    assert set(settings.joints) == set(joints)
    sources = ("Sci Rep 15:33179", "robotics toolbox", "RA-L", "Universal Robots")
    assert any(source in " ".join(settings.about.split()) for source in sources)


def test_no_file_but_the_urdf_is_needed(robot):
    tags = {element.tag for element in etree.parse(ROBOTS / f"{robot}.urdf").iter(etree.Element)}
    assert tags <= {
        *("robot", "link", "inertial", "mass", "inertia", "origin"),
        *("joint", "parent", "child", "axis", "limit"),
    }


def test_it_moves_according_to_its_dh_table(robot):
    """The URDF of a robot moves as the published DH table of the robot states.

    The last frame of the DH table has the same pose relative to the URDF's last joint frame (by Pinocchio) at all q.
    """
    model = pin.buildModelFromUrdf(str(ROBOTS / f"{robot}.urdf"))
    data = model.createData()
    tools = []
    for q in np.random.default_rng(0).uniform(-3, 3, (5, model.nq)):
        pin.forwardKinematics(model, data, q)
        tools.append(np.linalg.solve(data.oMi[model.nq].homogeneous, dh_frames(robot, q)[-1]))
    np.testing.assert_allclose(tools, np.broadcast_to(tools[0], (5, 4, 4)), atol=1e-14)


@pytest.mark.parametrize("robot", [*INERTIALS, "panda"])
def test_its_mass_matrix_is_that_of_the_dh_table(robot):
    model = pin.buildModelFromUrdf(str(ROBOTS / f"{robot}.urdf"))
    data = model.createData()
    for q in np.random.default_rng(1).uniform(-3, 3, (5, model.nq)):
        upper = np.triu(pin.crba(model, data, q))
        np.testing.assert_allclose(upper, np.triu(dh_mass_matrix(robot, q)), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("robot", "outputs", "constants", "zeros"),
    [("two_link", 1, 2, 0), ("rpr", 3, 2, 1), ("scara", 3, 4, 3), ("panda", 27, 1, 0)],
)
def test_its_structure_is_the_known_one(robot, outputs, constants, zeros):
    matrix = inspect(ROBOTS / f"{robot}.urdf").to_dict()["mass_matrix"]
    assert (matrix["outputs"], matrix["constants"]) == (outputs, constants)
    assert [entry["kind"] for entry in matrix["entries"]].count("zero") == zeros


def test_three_parallel_joints_save_outputs():
    for robot in ("six_dof", "ur10e"):
        matrix = inspect(ROBOTS / f"{robot}.urdf").to_dict()["mass_matrix"]
        first = make_arm(read_urdf(ROBOTS / f"{robot}.urdf")).coordinates[0].name
        assert matrix["outputs"] <= 18
        assert all(first not in joints for joints in matrix["output_joints"])


@pytest.mark.parametrize(("robot", "other"), [("panda", "panda_erd"), ("ur10e", "ur10e_official")])
def test_its_joints_are_where_the_manufacturers_file_has_them(robot, other, shared):
    """Each joint has the same pose relative to the preceding joint as in the manufacturer's URDF.

    The first joint is not compared, since the base link of the manufacturer's URDF is rotated.
    """
    ours = pin.buildModelFromUrdf(str(ROBOTS / f"{robot}.urdf"))
    theirs = pin.buildModelFromUrdf(str(shared / "arms" / f"{other}.urdf"))
    for joint in range(2, ours.njoints):
        assert ours.names[joint] == theirs.names[joint]
        np.testing.assert_allclose(
            ours.jointPlacements[joint].homogeneous, theirs.jointPlacements[joint].homogeneous, atol=1e-9
        )


def symmetric(entries):
    if len(entries) == 3:
        return np.diag(entries)
    xx, xy, xz, yy, yz, zz = entries
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def about(axis, angle):
    turn = np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[[i, j, i, j], [i, j, j, i]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return turn


def along(axis, distance):
    slide = np.eye(4)
    slide[axis, 3] = distance
    return slide


def dh_frames(robot, q):
    """Return the poses of base and links in the DH frames at q.

    In the standard convention a link's frame is at the next joint, in the modified convention at its own joint.
    """
    frames = [np.eye(4)]
    for (a, alpha, d, theta, prismatic), value in zip(STANDARD.get(robot) or MODIFIED[robot], q, strict=True):
        link = along(0, a) @ about(0, alpha)
        joint = about(2, theta + (0 if prismatic else value)) @ along(2, d + (value if prismatic else 0))
        frames.append(frames[-1] @ (joint @ link if robot in STANDARD else link @ joint))
    return frames


def dh_mass_matrix(robot, q):
    """Return M(q), (n, n): sum over links of m Jv^T Jv + Jw^T I Jw (Spong et al., Robot Modeling and Control, 7.2)."""
    frames = dh_frames(robot, q)
    table = STANDARD.get(robot) or MODIFIED[robot]
    total = np.zeros((len(q), len(q)))
    for link, (mass, com, tensor) in enumerate(INERTIALS.get(robot) or written_inertials(robot)):
        position = frames[link + 1] @ np.array([*com, 1.0])
        linear, angular = np.zeros((3, len(q))), np.zeros((3, len(q)))
        for joint in range(link + 1):
            base = frames[joint if robot in STANDARD else joint + 1]
            axis = base[:3, 2]
            if table[joint][4]:
                linear[:, joint] = axis
            else:
                linear[:, joint], angular[:, joint] = np.cross(axis, position[:3] - base[:3, 3]), axis
        rotation = frames[link + 1][:3, :3]
        inertia = rotation @ symmetric(tensor) @ rotation.T
        total += mass * linear.T @ linear + angular.T @ inertia @ angular
    return total


def written_inertials(robot):
    """Return mass, centre and tensor per link from a URDF whose link frames are modified DH frames."""
    links = read_urdf(ROBOTS / f"{robot}.urdf").links
    return [(each.inertial.mass, each.inertial.com, each.inertial.tensor) for each in links if each.inertial]
