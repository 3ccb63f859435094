"""MuJoCo loads the exported MJCF and computes the same M, bias forces and forward dynamics."""

import io
import re
import shutil

import casadi
import mujoco
import numpy as np
import pytest
import torch
import trimesh
from emitted import ROBOTS
from exported_runs import COUPLED, MOTORS, arm_of, moved_model, run_folder
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.dynamics.tip import tip_kinematics
from spelgen.emission.build import build
from spelgen.errors import RunError
from spelgen.exporting.export import export
from spelgen.exporting.mjcf_export import check_mjcf
from spelgen.exporting.rigid_body_projection import rigid_body_projection


@pytest.mark.parametrize("robot", ["rpr", "scara", "panda"])
def test_closed_form_bodies_go_to_mujoco_exactly(robot):
    """M, tip position, armature and lower limits in MuJoCo equal the values of the exported closed-form model.

    The test evaluates MuJoCo at one position. The export's own check compares the dynamics at 200 random states.
    """
    model, arm = moved_model(robot, "closed-form"), arm_of(robot)
    found = export(model, "mjcf", arm=arm)
    simulated = mujoco.MjModel.from_xml_string(found.files[".xml"].decode())
    data = mujoco.MjData(simulated)
    q = 0.3 * torch.ones(model.n, dtype=torch.float64)
    data.qpos[:] = q.numpy()
    mujoco.mj_forward(simulated, data)
    full = np.zeros((model.n, model.n))
    mujoco.mj_fullM(simulated, data, full)
    np.testing.assert_allclose(full, model.mass_matrix(q).numpy(), rtol=1e-9, atol=1e-12)
    tip = tip_kinematics(arm)
    np.testing.assert_allclose(data.site(tip.link).xpos, tip.position(q).numpy(), atol=1e-12)
    np.testing.assert_allclose(simulated.dof_armature, model.armature.numpy())
    lower = [each.lower for each in arm.chain.coordinates if not each.continuous]
    np.testing.assert_allclose(simulated.jnt_range[simulated.jnt_limited == 1][:, 0], lower)
    assert simulated.nu == model.n
    assert (simulated.dof_damping > 0).all()
    assert (simulated.dof_frictionloss > 0).all()


def test_a_joint_that_friction_holds_does_not_creep():
    """A joint under half of its friction torque is at rest after 1 s; with MuJoCo's default solimp it would creep."""
    found = export(moved_model("rpr", "closed-form"), "mjcf", arm=arm_of("rpr"))
    text = found.files[".xml"].decode()
    assert 'solimpfriction="0.9999 0.9999 0.001 0.5 2"' in text
    speeds = []
    for each in (text, re.sub(' solimpfriction="[^"]*"', "", text)):
        simulated = mujoco.MjModel.from_xml_string(each)
        simulated.opt.gravity[:] = 0
        data = mujoco.MjData(simulated)
        data.qpos[:] = simulated.jnt_range.mean(axis=1)
        while data.time < 1.0:
            data.qfrc_applied[:] = simulated.dof_frictionloss / 2
            mujoco.mj_step(simulated, data)
        speeds.append(np.abs(data.qvel))
    assert (speeds[0] < 0.02 * speeds[1]).all()
    assert speeds[1].max() > 1e-3


@pytest.mark.parametrize(
    ("preset", "which"),
    [
        ("hybrid", "those of the model without its residual terms"),
        ("spel", "the rigid bodies nearest to the model"),
    ],
)
def test_terms_that_mujoco_lacks_are_reported(preset, which, tmp_path):
    run = run_folder("two_link", preset, tmp_path)
    told = CliRunner().invoke(app, ["export", str(run.path), "--to", "mjcf", "-o", str(tmp_path / "arm.xml")])
    assert told.exit_code == 0, told.output
    assert f"bodies are {which}; M differs by" in told.output.replace("\n", " ")
    assert "by MuJoCo" in told.output
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml")).nv == 2
    assert len((tmp_path / "arm.xml.README.md").read_text().splitlines()) == 5


def test_followers_motors_and_passive_joints_go_along(tmp_path):
    urdf = tmp_path / "coupled.urdf"
    urdf.write_text(COUPLED)
    urdf.with_suffix(".yaml").write_text(MOTORS)
    arm = load_arm(urdf)
    model = build(arm, "closed-form")
    found = export(model, "mjcf", arm=arm)
    simulated = mujoco.MjModel.from_xml_string(found.files[".xml"].decode())
    assert (simulated.nv, simulated.nu, simulated.neq) == (4, 2, 1)
    assert simulated.actuator("shoulder").gear[0] == 50


@pytest.mark.parametrize("torque", ["motor", "joint"])
def test_coupled_motors_turn_by_several_joints(torque, tmp_path):
    """Off-diagonal rotor inertia of coupled motors is exported: as tendon armature (MJCF), as couplings (URDF)."""
    urdf = tmp_path / "wrist.urdf"
    shutil.copy(ROBOTS / "six_dof.urdf", urdf)
    names = [each.name for each in load_arm(urdf).chain.coordinates]
    gears = ", ".join(f"{name}: {{gear: 100}}" for name in names[:4]) if torque == "motor" else ""
    coupling = f"couplings: [{{joints: {names[4:]}, matrix: [[80, 60], [0, 50]]}}]"
    urdf.with_suffix(".yaml").write_text(f"torque: {torque}\njoints: {{{gears}}}\n{coupling}\n")
    arm = load_arm(urdf)
    model = build(arm, "closed-form")
    with torch.no_grad():
        model.raw_armature += 0.5
    found = export(model, "mjcf", arm=arm)  # the export compares M with the model, and fails if it differs
    simulated = mujoco.MjModel.from_xml_string(found.files[".xml"].decode())
    assert simulated.nu == 6
    np.testing.assert_allclose(simulated.tendon_armature.max(), model.armature.detach()[5])
    for suffix, content in export(model, "urdf", arm=arm).files.items():
        (tmp_path / f"learned{suffix}").write_bytes(content)
    again = build(load_arm(tmp_path / "learned.urdf"), "closed-form")
    q = 0.3 * torch.ones(6, dtype=torch.float64)
    mass = model.mass_matrix(q)
    assert mass[4, 5].abs() > 0.5 * mass[5, 5]
    torch.testing.assert_close(again.mass_matrix(q), mass, rtol=2e-3, atol=1e-3)
    torch.testing.assert_close(again.input_matrix(q), model.input_matrix(q))


def test_other_bodies_are_noticed():
    arm = arm_of("two_link")
    model = moved_model("two_link", "closed-form")
    text = export(model, "mjcf", arm=arm).files[".xml"]
    other = rigid_body_projection(build(arm, "closed-form"), arm)
    with pytest.raises(RunError, match="mass_matrix differs from the model"):
        check_mjcf(text, other)


ROUNDED = """<robot name="rounded"><link name="base"/>
<link name="upper">{0}<inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0.01" ixz="0" iyz="0"/></inertial></link>
<link name="lower">{1}<inertial><origin xyz="0 0.1 0.1"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0" ixz="0" iyz="0.001"/></inertial></link><link name="tool">{2}</link>
<joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.3" rpy="1.5708 0 0"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="7" velocity="2"/></joint>
<joint name="j2" type="revolute"><parent link="upper"/><child link="lower"/>
<origin xyz="0.4 0.1 0" rpy="0 0.7854 3.1416"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="5" velocity="2"/></joint>
<joint name="fixed" type="fixed"><parent link="lower"/><child link="tool"/>
<origin xyz="0.1 0.2 0.3" rpy="0 -1.571 0.2"/>
</joint></robot>"""


def test_all_targets_agree_on_the_tip(tmp_path):
    """Each export places the tip where Pinocchio places it for the same URDF, within 1e-12.

    The URDF has rounded angles such as 1.5708. The dynamics of the model use pi/2 instead, but the pose of the tip
    uses the angles of the URDF, as Pinocchio does.
    """
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "arm.urdf").write_text(ROUNDED.format("", "", ""))
    arm = load_arm(tmp_path / "arm.urdf")
    model, q = build(arm, "closed-form").requires_grad_(False), np.array([0.3, -0.9])
    tip = tip_kinematics(arm)
    poses = {"torch": tip.pose(torch.from_numpy(q)).numpy()}
    export(model, "urdf", tmp_path / "learned.urdf", arm=arm)
    for file in ("arm.urdf", "learned.urdf"):
        read = pin.buildModelFromUrdf(str(tmp_path / file))
        data = read.createData()
        pin.framesForwardKinematics(read, data, q)
        poses[file] = data.oMf[read.getFrameId("tool")].homogeneous
    export(model, "casadi", tmp_path / "casadi", arm=arm, entries=["tip_pose"])
    poses["casadi"] = casadi.Function.load(str(tmp_path / "casadi" / "tip_pose.casadi"))(q).full()
    programs = export(model, "torch", arm=arm, entries=["tip_pose"]).files
    program = torch.export.load(io.BytesIO(programs["tip_pose.pt2"])).module()
    poses["program"] = program(torch.from_numpy(q).repeat(3, 1))[0].numpy()
    simulated = mujoco.MjModel.from_xml_string(export(model, "mjcf", arm=arm).files[".xml"].decode())
    data = mujoco.MjData(simulated)
    data.qpos[:] = q
    mujoco.mj_forward(simulated, data)
    site = np.eye(4)
    site[:3, :3], site[:3, 3] = data.site("tool").xmat.reshape(3, 3), data.site("tool").xpos
    poses["mujoco"] = site
    for name, pose in poses.items():
        np.testing.assert_allclose(pose, poses["arm.urdf"], atol=1e-12, err_msg=name)
    assert tip.link == "tool" and "the tip is the link tool;" in programs["README.md"].decode()


def test_shapes_and_effort_limits_go_along(tmp_path):
    """Exported shapes are at the URDF's places, without mass; missing meshes are named; motors have effort limits."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    ball.apply_translation([0.2, 0.1, 0.0])
    ball.export(tmp_path / "ball.stl")
    shapes = (
        '<visual><origin xyz="0.1 0 0" rpy="0 0 0.5"/><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
        '<collision><origin xyz="0 0.1 0"/><geometry><cylinder radius="0.05" length="0.3"/></geometry></collision>',
        '<visual><geometry><mesh filename="ball.stl" scale="1 2 1"/></geometry></visual>',
        '<visual><geometry><mesh filename="gone.stl"/></geometry></visual>'
        '<collision><geometry><sphere radius="0.04"/></geometry></collision>'
        '<visual><geometry><box size="0 0 0"/></geometry></visual>',
    )
    (tmp_path / "arm.urdf").write_text(ROUNDED.format(*shapes))
    arm = load_arm(tmp_path / "arm.urdf")
    model, q = build(arm, "closed-form").requires_grad_(False), np.array([0.3, -0.9])
    found = export(model, "mjcf", arm=arm)
    assert "shapes omitted, since they cannot be read or are flat: tool" in found.summary
    # The model has rounded angles, the MJCF file the unrounded ones: the comparison names its reference.
    assert "from the model's rigid bodies with the URDF's unrounded angles" in found.summary[-1]
    simulated = mujoco.MjModel.from_xml_string(found.files[".xml"].decode())
    data = mujoco.MjData(simulated)
    data.qpos[:], data.ctrl[:] = q, [1e3, -1e3]
    mujoco.mj_forward(simulated, data)
    np.testing.assert_allclose(data.qfrc_actuator, [7, -5])
    assert simulated.body_mass.sum() == pytest.approx(3)
    links = {name: tip_kinematics(arm, name).pose(torch.from_numpy(q)).numpy() for name in ("lower", "tool")}
    links["upper"] = np.eye(4)
    links["upper"][:3, :3] = (
        Rotation.from_euler("x", 1.5708).as_matrix() @ Rotation.from_euler("y", 0.3).as_matrix()
    )
    links["upper"][:3, 3] = [0, 0, 0.3]
    expected = [  # type of the shape, link, centre in the link, half sizes, contact type (0: touches nothing)
        (mujoco.mjtGeom.mjGEOM_BOX, "upper", [0.1, 0, 0], [0.05, 0.1, 0.15], 0),
        (mujoco.mjtGeom.mjGEOM_MESH, "lower", [0.2, 0.2, 0.0], None, 0),
        (mujoco.mjtGeom.mjGEOM_CYLINDER, "upper", [0, 0.1, 0], [0.05, 0.15, 0], 1),
        (mujoco.mjtGeom.mjGEOM_SPHERE, "tool", [0, 0, 0], [0.04, 0, 0], 1),
    ]
    assert simulated.ngeom == len(expected)
    for kind, link, centre, size, contact in expected:
        (index,) = np.flatnonzero(simulated.geom_type == kind)
        pose = links[link]
        np.testing.assert_allclose(data.geom_xpos[index], pose[:3, :3] @ centre + pose[:3, 3], atol=1e-6)
        assert size is None or simulated.geom_size[index].tolist() == size
        assert (simulated.geom_contype[index], simulated.geom_conaffinity[index]) == (contact, 0)
