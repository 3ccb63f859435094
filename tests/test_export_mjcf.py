"""MuJoCo loads the exported MJCF and computes the same M, bias forces and forward dynamics."""

import re
import shutil

import mujoco
import numpy as np
import pytest
import torch
from emitted import ROBOTS
from exported_runs import COUPLED, MOTORS, arm_of, moved_model, run_folder
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
    """The check at export time compares 200 states to 1e-9; here once more, by hand, and the tip."""
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
    """Under half of its friction, after a second [rad/s, m/s]; with MuJoCo's default it still moves."""
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
    """Their rotors couple M: armature of tendons in MuJoCo, couplings in the settings of a URDF."""
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
    found = export(model, "mjcf", arm=arm)  # compared with the model before it is given
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
