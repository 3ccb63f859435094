"""The 3D scene of a page: link poses equal the poses of the kinematics, and shapes are closed."""

import json
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.tip import tip_kinematics
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.scene import joined, scene, tube
from spelgen.structure.structure import derive
from spelgen.templates import json_data


def frames(links, q):
    """Return the rotation (3, 3) and position (3,) [m] of each link at q (n,), in the frame of the root link.

    The JavaScript that draws the arm in HTML pages uses the same algorithm. links: links of the arm's `scene`.
    """
    placed = []
    for link in links:
        rotation, position = placed[link.parent] if link.parent >= 0 else (np.eye(3), np.zeros(3))
        position = position + rotation @ link.position
        rotation = rotation @ link.rotation
        value = link.offset + (link.ratio * q[link.joint] if link.joint >= 0 else 0.0)
        if link.slides:
            position = position + rotation @ link.axis * value
        else:
            rotation = rotation @ Rotation.from_rotvec(value * link.axis).as_matrix()
        placed.append((rotation, position))
    return placed


@pytest.mark.parametrize("robot", ["rpr", "scara", "panda", "ur10e"])
def test_link_poses_equal_the_poses_of_pytorch_kinematics(robots, robot):
    import torch

    arm = load_arm(robots / f"{robot}.urdf")
    names = [coordinate.name for coordinate in arm.chain.coordinates]
    drawn, tip = scene(arm.robot.path, names), tip_kinematics(arm)
    at = [link.name for link in drawn.links].index(tip.link)
    q = np.random.default_rng(1).uniform(-1, 1, (5, len(names)))
    for row in q:
        rotation, position = frames(drawn.links, row)[at]
        pose = tip.pose(torch.from_numpy(row)).numpy()
        np.testing.assert_allclose(position, pose[:3, 3], atol=1e-6)
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-6)


def test_the_shapes_of_the_file_are_drawn_where_all_are_there(tmp_path):
    box = "<visual><geometry><box size='0.1 0.2 0.3'/></geometry></visual>"
    mesh = "<visual><geometry><mesh filename='not_there.stl'/></geometry></visual>"
    text = f"""<robot name="r"><link name="a">{box}</link><link name="b">BOX</link>
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
      <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
    path = tmp_path / "r.urdf"
    path.write_text(text.replace("BOX", box))
    found = scene(path, ["j"])
    assert not found.tubes and [len(link.shape.faces) for link in found.links] == [12, 12]
    np.testing.assert_allclose(np.ptp(found.links[1].shape.vertices, axis=0), [0.1, 0.2, 0.3], atol=1e-3)
    path.write_text(text.replace("BOX", mesh))
    found = scene(path, ["j"])  # link b, without its mesh, is drawn as a tube, the other link as its box
    assert found.tubes == " Drawn as tubes, since meshes were not read: b (not_there.stl)."
    assert len(found.links[0].shape.faces) == 12 and len(found.links[1].shape.faces) > 12


def test_tubes_are_closed_and_look_outward():
    shape = joined(tube(np.zeros(3), np.array([0.0, 0.0, 2.0]), 0.5))
    volume = 0.0
    for face in shape.faces:
        first, *rest = shape.vertices[list(face)]
        volume += sum(first @ np.cross(a, b) / 6 for a, b in pairwise(rest))
    # the volume would be negative if the faces were inside out
    assert volume == pytest.approx(2 * 0.5**2 * np.pi, rel=0.1)


def test_every_cell_states_its_kind_and_the_reason(robots):
    arm = load_arm(robots / "rpr.urdf")
    cells = matrix(arm.chain, derive(arm.chain))
    assert (
        cells[1][1].explanation.startswith("M22 is constant.")
        and "the mass that it carries" in cells[1][1].explanation
    )
    assert cells[1][2].explanation.startswith("M32 is always zero.") and cells[1][2] == cells[2][1]
    assert cells[0][0].joints == (1, 2)


def test_data_cannot_end_its_element_and_is_the_same_every_time(robots):
    assert "<" not in json_data({"x": "</script><script>alert(1)</script>"})
    assert json.loads(json_data({"x": "</script>&"})) == {"x": "</script>&"}
    arm = load_arm(robots / "panda.urdf")
    first, again = (arm_section(arm.chain, arm.robot.path) for _ in range(2))
    assert first == again and len(first.data) < 200_000


def test_links_that_are_fixed_to_the_arm_are_part_of_the_picture(tmp_path):
    joint = '<joint name="{0}" type="{1}"><parent link="base"/><child link="{2}"/><axis xyz="0 0 1"/></joint>'
    links = "".join(f'<link name="{name}"/>' for name in ("base", "arm", "column", "wheel"))
    joints = joint.format("turn", "continuous", "arm") + joint.format("bolt", "fixed", "column")
    joints += joint.format("roll", "continuous", "wheel")
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r">{links}{joints}</robot>')
    assert [link.name for link in scene(path, ["turn"]).links] == ["base", "arm", "column"]
