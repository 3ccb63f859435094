"""Drives that move several joints: friction, its memory and rotor inertia belong to the motors' speeds."""

import shutil

import numpy as np
import pytest
import torch
from emitted import ROBOTS, import_source

from spelgen.arm.actuation import motor_speeds
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.fitting.torque_fit import fit_torque
from spelgen.fitting.torque_jacobian import TorqueJacobian
from spelgen.fitting.torque_samples import TorqueSamples
from spelgen.identification.identify import least_squares
from spelgen.identification.method import LeastSquares
from spelgen.identification.samples import DynamicsSamples
from spelgen.loaded_arm import load_arm
from spelgen.pipeline import generate
from spelgen.runtime.actuation import motor_speeds as runtime_motor_speeds

WRIST = np.array([[50.0, 50.0], [40.0, -40.0]])  # joint torques by motor torques of the last two joints
SPEEDS = np.array([[1.0, 0.8], [1.0, -0.8]])  # of its motors, as of the fifth joint


@pytest.fixture(scope="module")
def wrist(tmp_path_factory):
    """A six-joint arm whose last two joints hang on a differential: its module and what was loaded of it."""
    folder = tmp_path_factory.mktemp("wrist")
    names = [f"j{k}" for k in range(1, 7)]
    shutil.copy(ROBOTS / "six_dof.urdf", folder / "arm.urdf")
    arm = load_arm(folder / "arm.urdf")
    names = [x.name for x in arm.arm.coordinates]
    gears = "".join(f"  {name}: {{gear: 100}}\n" for name in names[:4])
    coupling = f"couplings:\n- {{joints: [{names[4]}, {names[5]}], matrix: {WRIST.tolist()}}}\n"
    (folder / "arm.yaml").write_text(f"torque: motor\njoints:\n{gears}{coupling}", encoding="utf-8")
    arm = load_arm(folder / "arm.urdf")
    return import_source(generate(arm, preset="closed-form"), folder / "wrist.py"), arm


def moved(model, seconds, seed=0):
    """Samples of a smooth motion with the torque of the URDF's bodies, and of friction and rotors on the motors."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 0.01)[:, None, None]
    speed, phase, size = (rng.uniform(*x, (4, 6)) for x in ((0.7, 4.0), (0.0, 6.3), (0.2, 0.5)))
    q, qd, qdd = ((size * speed**k * np.sin(speed * t + phase + k * np.pi / 2)).sum(axis=1) for k in range(3))
    return q, qd, qdd


def on_motors(q, qd, qdd, arm, strength, armature):
    """The motors' torques, (T, 6)."""
    speeds = np.eye(6)
    speeds[4:, 4:] = SPEEDS
    at_motors = strength * np.tanh(qd @ speeds.T / 0.01) + 0.3 * strength * (qd @ speeds.T)
    at_motors = at_motors + armature * (qdd @ speeds.T)
    joint = regressor(arm.arm, q, qd, qdd) @ urdf_parameters(arm.arm) + at_motors @ speeds
    return joint, np.linalg.solve(arm.actuation.matrix(), joint.T).T


def test_motor_speeds_are_of_the_joint_that_each_moves_most(wrist):
    _, arm = wrist
    found, gains = motor_speeds(arm.actuation.matrix()), arm.actuation.matrix()
    np.testing.assert_allclose(found[4:, 4:], SPEEDS)
    np.testing.assert_allclose(found[:4], np.eye(6)[:4])
    torch.testing.assert_close(runtime_motor_speeds(torch.from_numpy(gains)), torch.from_numpy(found))
    passive = motor_speeds(np.diag([-30.0, 0.0]))
    np.testing.assert_allclose(passive, np.eye(2))


def test_least_squares_finds_friction_and_rotors_of_coupled_motors(wrist):
    module, arm = wrist
    strength, armature = np.array([5.0, 5.0, 4.0, 3.0, 2.0, 1.0]), np.full(6, 0.2)
    errors = []
    for inputs in (arm.actuation.matrix(), None):
        motion = moved(module, 20.0)
        tau, _ = on_motors(*motion, arm, strength, armature)
        found = least_squares(arm.arm, [DynamicsSamples("x", *motion, tau)], LeastSquares("range"), inputs)
        fresh = moved(module, 10.0, seed=1)
        tau, measured = on_motors(*fresh, arm, strength, armature)
        errors.append(np.square(found.torque(*fresh) - tau).mean(axis=0) / tau.var(axis=0))
        if inputs is not None:
            np.testing.assert_allclose(found.dynamics.inverse_dynamics(*fresh), measured, atol=1e-6)
            qdd = found.dynamics.forward_dynamics(fresh[0][:20], fresh[1][:20], measured[:20])
            np.testing.assert_allclose(qdd, fresh[2][:20], atol=1e-5)
    assert errors[0].max() < 1e-10
    assert errors[1][4:].min() > 1e-2


def test_a_closed_form_model_is_fitted_to_a_coupled_wrist(wrist):
    module, arm = wrist
    strength, armature = np.array([5.0, 5.0, 4.0, 3.0, 2.0, 1.0]), np.full(6, 0.2)
    motion = moved(module, 20.0)
    _, tau = on_motors(*motion, arm, strength, armature)
    model = module.Model()
    fit_torque(model, [DynamicsSamples("x", *motion, tau)])
    fresh = moved(module, 10.0, seed=1)
    _, tau = on_motors(*fresh, arm, strength, armature)
    with torch.no_grad():
        found = model.inverse_dynamics(*(torch.from_numpy(x) for x in fresh)).numpy()
    assert (np.square(found - tau).mean(axis=0) / tau.var(axis=0)).max() < 2e-3


def test_the_fit_knows_that_a_motor_moves_both_joints(wrist):
    """Slopes by every weight against finite differences."""
    module, arm = wrist
    motion = [x[::40] for x in moved(module, 4.0)]
    _, tau = on_motors(*motion, arm, np.ones(6), np.ones(6))
    model = module.Model(seed=1)
    z = bristles_along(moved(module, 4.0)[0], bristle_reach(model))[::40]
    jacobian = TorqueJacobian(model, TorqueSamples.held([DynamicsSamples("x", *motion, tau, z)]))
    everything, noise = torch.ones_like(jacobian.start, dtype=torch.bool), torch.ones(6).double()
    x = jacobian.start + 0.1 * torch.randn(len(jacobian.start), generator=torch.Generator().manual_seed(0))
    _, slope = jacobian.normal_equations(x, noise, everything)
    for k in range(len(x)):
        step = torch.zeros_like(x)
        step[k] = 1e-5
        change = (jacobian.squares(x + step).sum() - jacobian.squares(x - step).sum()) / 2e-5
        assert change.item() == pytest.approx(
            -2 * slope[k].item(), rel=1e-4, abs=1e-4 * float(slope.abs().max())
        )


def test_energy_and_memory_are_those_of_the_motors(wrist):
    """Power of friction is that of D; bristles follow the motors, in the model as along logs; M has C^T A C."""
    module, _ = wrist
    model = module.Model()
    with torch.no_grad():
        q, qd, _ = (torch.from_numpy(x[:50]) for x in moved(module, 1.0))
        torque, dissipation = model.friction_torque(q, qd), model.dissipation(q, qd)
        torch.testing.assert_close((dissipation @ qd.unsqueeze(-1)).squeeze(-1), torque)
        assert torch.linalg.eigvalsh(dissipation).min() >= 0
        assert dissipation[:, 4, 5].abs().min() > 0
        before = model.mass_matrix(q)
        model.dynamics.armature.raw[5] += 1.0
        more = (model.mass_matrix(q) - before)[0] / (1 - np.exp(-1)) / model.armature[5]
        torch.testing.assert_close(more[4:, 4:], torch.from_numpy(np.outer(SPEEDS[1], SPEEDS[1])))
        assert more[:4].abs().max() < 1e-12
        z = torch.from_numpy(bristles_along(q.numpy(), bristle_reach(model)))
        torch.testing.assert_close(model.dynamics.memory_after(z[:-1], q.diff(dim=0)), z[1:])
