"""Export to URDF is exact for closed-form models; for others the exported rigid bodies are the nearest ones."""

import numpy as np
import pytest
import torch
from emitted import ROBOTS
from exported_runs import saved_run
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.emission.build import build
from spelgen.errors import RunError
from spelgen.exporting.export import export
from spelgen.exporting.rigid_body_projection import rigid_body_projection
from spelgen.structure.base_parameters import base_parameters

pytest.importorskip("pinocchio")


def run_of(robot, folder, preset, change=lambda model: None):
    """Build a model, modify its parameters by ``change``, write its run folder; return run folder and model."""
    urdf = ROBOTS / f"{robot}.urdf"
    model = build(urdf, preset)
    with torch.no_grad():
        change(model)
    return saved_run(model, urdf, folder), model


def exported(run, path):
    told = CliRunner().invoke(app, ["export", str(run.path), "--to", "urdf", "-o", str(path)])
    assert told.exit_code == 0, told.output
    return load_arm(path), told.output


def heavier(model):
    random = torch.Generator().manual_seed(0)
    for parameter in (model.bodies.raw, model.raw_armature):
        parameter += 0.2 * torch.randn(parameter.shape, dtype=torch.float64, generator=random)
    model.friction.raw_coulomb += 0.5


def differences(model, loaded):
    """Compare a model with Pinocchio on an exported arm: return the largest differences of M and of gravity torques."""
    engine = arm_dynamics(loaded.chain, loaded.settings)
    q = torch.randn(20, model.n, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        mass, load_torque = model.mass_matrix(q).numpy(), model.gravity(q).numpy()
    still = np.zeros(model.n)
    pairs = [(engine.mass_matrix(at), engine.nonlinear_effects(at, still)) for at in q.numpy()]
    true_mass, true_load = (np.array(column) for column in zip(*pairs, strict=True))
    return np.abs(mass - true_mass).max(), np.abs(load_torque - true_load).max()


@pytest.mark.parametrize("robot", ["rpr", "scara", "panda"])
def test_closed_form_bodies_go_back_exactly(robot, tmp_path):
    run, model = run_of(robot, tmp_path, "closed-form", heavier)
    loaded, told = exported(run, tmp_path / "learned.urdf")
    mass, load_torque = differences(model, loaded)
    assert mass < 1e-8 * 200
    assert load_torque < 1e-8 * 200
    assert "bodies are those of the model" in told
    assert not [x for x in loaded.robot.diagnostics if x.severity == "warning"]


def test_exported_friction_in_the_urdf(tmp_path):
    run, model = run_of("rpr", tmp_path, "closed-form", heavier)
    loaded, _ = exported(run, tmp_path / "learned.urdf")
    for index, name in enumerate(model.joint_names):
        joint = loaded.settings.joint(loaded.chain.coordinates[index].name)
        urdf = loaded.chain.coordinates[index]
        assert joint.viscous >= 0
        assert joint.coulomb[0] > 0 > joint.coulomb[1], name
        assert urdf.friction == pytest.approx((joint.coulomb[0] - joint.coulomb[1]) / 2)
        assert urdf.damping == pytest.approx(joint.viscous)


@pytest.mark.parametrize("chosen", [{"tip": "link4"}, {"joints": ("joint1", "joint2", "joint3")}])
def test_the_exported_urdf_has_the_joints_of_the_model(chosen, tmp_path):
    """The chain was chosen on the command line; the default chain of the URDF is longer."""
    model = build(load_arm(ROBOTS / "six_dof.urdf", **chosen), "closed-form")
    loaded, _ = exported(saved_run(model, ROBOTS / "six_dof.urdf", tmp_path), tmp_path / "learned.urdf")
    assert loaded.chain.joint_names == model.joint_names
    assert loaded.tip == chosen.get("tip")


def test_residual_terms_are_reported(tmp_path):
    """Bodies of a hybrid model are exported exactly, and the magnitude of the omitted residual terms is reported."""
    run, model = run_of("two_link", tmp_path, "hybrid", heavier)
    loaded, told = exported(run, tmp_path / "bodies.urdf")
    assert max(differences(model, loaded)) < 1e-8
    assert "bodies are those of the model" in told
    functions = model.residuals
    with torch.no_grad():
        model.residuals.raw_constants += 0.5
        functions.raw_torque_ripple[0, 5] = 3.0
        functions.raw_friction_splines += 0.3 * torch.linspace(-1, 1, 34)
    found = export(model, arm=load_arm(ROBOTS / "two_link.urdf"))
    assert "bodies are those of the model without its residual terms; M differs by" in repr(found)
    bodies = found.files[".urdf"].split(b"<dynamics")[0]
    assert bodies == (tmp_path / "bodies.urdf").read_bytes().split(b"<dynamics")[0]
    projection = rigid_body_projection(model, load_arm(ROBOTS / "two_link.urdf"))
    assert projection.mass_error > 1e-3
    assert projection.gravity_error > 1e-3
    assert (projection.friction.error > 0.05).all()


def test_networks_go_back_as_the_nearest_bodies(tmp_path):
    run, model = run_of("two_link", tmp_path, "spel")
    loaded, told = exported(run, tmp_path / "learned.urdf")
    mass, load_torque = differences(model, loaded)
    assert mass > 0.1  # M of an untrained spel is not the mass matrix of any rigid bodies
    assert load_torque < 1e-8
    assert "bodies are the rigid bodies nearest to the model; M differs by" in told


def test_the_readme_of_a_model_without_intervals_has_five_lines(tmp_path):
    run, _ = run_of("rpr", tmp_path, "closed-form", heavier)
    exported(run, tmp_path / "learned.urdf")
    assert len((tmp_path / "learned.urdf.README.md").read_text().splitlines()) == 5


def test_existing_files_are_kept_unless_forced(tmp_path):
    run, _ = run_of("two_link", tmp_path, "closed-form")
    path = tmp_path / "learned.urdf"
    exported(run, path)
    before = path.read_bytes()
    again = CliRunner().invoke(app, ["export", str(run.path), "-o", str(path)])
    assert again.exit_code == 1
    assert path.read_bytes() == before


def test_a_run_without_its_robot_is_refused(tmp_path):
    run, _ = run_of("two_link", tmp_path, "closed-form")
    run.urdf.unlink()
    told = CliRunner().invoke(app, ["export", str(run.path), "-o", str(tmp_path / "x.urdf")])
    assert told.exit_code == 1
    assert "no robot.urdf" in told.output
    assert not (tmp_path / "x.urdf").exists()


@pytest.mark.parametrize("robot", ["rpr", "panda"])
def test_exported_bodies_have_the_models_base_parameters(robot, tmp_path):
    """Exported bodies have the model's base parameters, although single inertial parameters may differ."""
    run, model = run_of(robot, tmp_path, "closed-form", heavier)
    export(run.path, "urdf", tmp_path / "learned.urdf")
    arm = load_arm(ROBOTS / f"{robot}.urdf")
    ten = model.inertial_parameters.detach().flatten().tolist()
    parameters, exported = (base_parameters(x.chain) for x in (arm, load_arm(tmp_path / "learned.urdf")))
    learned = {each.name: sum(float(weight) * ten[k] for k, weight in each.weights) for each in parameters}
    exact = {each.name: float(each.value) for each in exported}
    before = {each.name: float(each.value) for each in parameters}
    assert list(exact) == list(learned)
    np.testing.assert_allclose(list(exact.values()), list(learned.values()), rtol=1e-8, atol=1e-9)
    assert max(abs(exact[name] - before[name]) for name in exact) > 0.01


def test_a_model_in_memory_is_exported_with_its_arm(tmp_path):
    arm = load_arm(ROBOTS / "two_link.urdf")
    model = build(arm, "closed-form")
    found = export(model, arm=arm)
    assert found.files[".urdf"].startswith(b"<?xml")
    assert "bodies are those of the model" in repr(found)
    written = [x.name for x in found.write(tmp_path / "arm.urdf")]
    assert written == ["arm.urdf", "arm.yaml", "arm.urdf.README.md"]
    with pytest.raises(RunError, match="this output exists already"):
        found.write(tmp_path / "arm.urdf")
    with pytest.raises(RunError, match=r"no robot\.urdf"):
        export(model)


def test_a_bias_of_rounding_errors_equals_zero(tmp_path):
    """An arm of one joint with a vertical axis has no Coriolis or gravity torque, only rounding errors of zero."""
    (tmp_path / "arm.urdf").write_text(
        """<robot name="turntable"><link name="base"/><link name="table"><inertial><origin xyz="0.3 0.02 0"/>
        <mass value="1.2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="turn" type="revolute"><parent link="base"/><child link="table"/><origin xyz="0 0 1"/>
        <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="20" velocity="6"/></joint></robot>"""
    )
    model = build(tmp_path / "arm.urdf", "hybrid").double()
    with torch.no_grad():
        heavier(model)
    found = export(model.requires_grad_(False), "casadi", arm=load_arm(tmp_path / "arm.urdf"))
    assert "200 random states" in repr(found)
