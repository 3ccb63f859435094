"""What was learned, as a URDF and settings again: exactly for closed-form models, nearest for others."""

import json

import numpy as np
import pytest
import torch
from emitted import ROBOTS
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.fitting.run_folder import RunFolder, load_model, write_state
from spelgen.pipeline import build, load

pytest.importorskip("pinocchio")


def run_of(robot, folder, preset, change=lambda model: None):
    """A run folder as `spelgen train` leaves it, of a model whose weights ``change`` has moved."""
    module = folder / f"{robot}_spel.py"
    module.write_text(build(ROBOTS / f"{robot}.urdf", preset=preset))
    run = RunFolder(folder / "run")
    run.start(module, ROBOTS / f"{robot}.urdf", force=False)
    run.config.write_text(json.dumps({}))
    model = load_model(run.module)
    with torch.no_grad():
        change(model)
    write_state(run.weights, model.state_dict())
    return run, model


def exported(run, path):
    told = CliRunner().invoke(app, ["export", str(run.path), "--to", "urdf", "-o", str(path)])
    assert told.exit_code == 0, told.output
    return load(path), told.output


def heavier(model):
    random = torch.Generator().manual_seed(0)
    for parameter in (model.bodies, model.rotor):
        parameter += 0.2 * torch.randn(parameter.shape, dtype=torch.float64, generator=random)
    model.friction.coulomb += 0.5


def differences(model, loaded):
    """Largest difference of M and of the gravity torque to Pinocchio's from the exported files."""
    engine = arm_dynamics(loaded.arm, loaded.settings)
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
    assert "bodies: the model's own" in told
    assert not [x for x in loaded.robot.diagnostics if x.severity == "warning"]


def test_friction_goes_back_as_the_urdf_can_say_it(tmp_path):
    run, model = run_of("rpr", tmp_path, "closed-form", heavier)
    loaded, _ = exported(run, tmp_path / "learned.urdf")
    for index, name in enumerate(model.joint_names):
        joint = loaded.settings.joint(loaded.arm.coordinates[index].name)
        urdf = loaded.arm.coordinates[index]
        assert joint.viscous >= 0
        assert joint.coulomb[0] > 0 > joint.coulomb[1], name
        assert urdf.friction == pytest.approx((joint.coulomb[0] - joint.coulomb[1]) / 2)
        assert urdf.damping == pytest.approx(joint.viscous)


def test_other_models_go_back_as_the_nearest_bodies(tmp_path):
    """An untrained minimal model is the URDF's arm: its twin must be that arm again."""
    run, model = run_of("two_link", tmp_path, "minimal")
    loaded, told = exported(run, tmp_path / "learned.urdf")
    mass, load_torque = differences(model, loaded)
    assert mass < 1e-3
    assert load_torque < 1e-3
    assert "M differs by 0.0%, gravity by 0.0%" in told


def test_what_lies_there_stays_unless_forced(tmp_path):
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
