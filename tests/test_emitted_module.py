"""An emitted module equals Pinocchio for exact parameters and has the derived structure for all parameters."""

import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest
import torch
from emitted import (
    NETWORKS,
    ROBOTS,
    SIX,
    bounded,
    built,
    exact_model,
    frictionless,
    import_source,
    network_inputs,
    outputs_alone,
    random_model,
    randomise,
)
from fuzzing import MINUTES
from scipy.integrate import solve_ivp

from spelgen.design import PRESET_NAMES
from spelgen.settings.settings import load_settings
from tests.lie_group import from_group, to_group

STATES = 25
COUNT = 10_000 if MINUTES else 500


def states(n: int, count: int, seed: int = 0) -> list[torch.Tensor]:
    """Return random q, qd, qdd and tau, (count, n) each."""
    generator = torch.Generator().manual_seed(seed)
    return [2 * torch.randn(count, n, dtype=torch.float64, generator=generator) for _ in range(4)]


@pytest.mark.parametrize("robot", SIX)
def test_exact_parameters_reproduce_pinocchio(robot, tmp_path):
    """With exact functions in place of networks, M, gravity, forward and inverse dynamics equal Pinocchio's to 1e-10.

    Pinocchio reads the URDF itself.
    """
    model = exact_model(robot, tmp_path)
    reference = pin.buildModelFromUrdf(str(ROBOTS / f"{robot}.urdf"))
    reference.gravity.linear = np.array(load_settings(ROBOTS / f"{robot}.urdf").gravity)
    data = reference.createData()
    q, qd, qdd, tau = states(model.n, STATES)
    with torch.no_grad():
        ours = {
            "mass matrix": model.mass_matrix(q),
            "gravity": model.gravity(q),
            "forward dynamics": model.forward_dynamics(q, qd, tau),
            "inverse dynamics": model.inverse_dynamics(q, qd, qdd),
        }
    theirs = {name: [] for name in ours}
    for i in range(STATES):
        at = [x[i].numpy() for x in (q, qd, qdd, tau)]
        upper = np.triu(pin.crba(reference, data, at[0]))
        theirs["mass matrix"].append(upper + np.triu(upper, 1).T)
        theirs["gravity"].append(pin.computeGeneralizedGravity(reference, data, at[0]).copy())
        theirs["forward dynamics"].append(pin.aba(reference, data, at[0], at[1], at[3]).copy())
        theirs["inverse dynamics"].append(pin.rnea(reference, data, at[0], at[1], at[2]).copy())
    for name, value in ours.items():
        expected = np.array(theirs[name])
        assert np.abs(value.numpy() - expected).max() < 1e-10 * max(1.0, np.abs(expected).max()), name


@pytest.mark.parametrize("robot", SIX)
def test_mass_matrix_is_positive_definite_for_any_weights(robot, tmp_path):
    """M is positive definite for 100 random draws of all parameters (standard deviation 30), at COUNT random q each."""
    model = random_model(robot, tmp_path, seed=0, design=NETWORKS)
    generator = torch.Generator().manual_seed(0)
    needed = 0
    with torch.no_grad():
        for draw in range(100):
            randomise(model, seed=draw, deviation=30.0)
            q = 8 * torch.rand(COUNT, model.n, dtype=torch.float64, generator=generator) - 4
            pose = model.at(q)
            assert not torch.linalg.cholesky_ex(pose.mass).info.any()
            needed += (pose.intermediates[1] < 1).any().item()
    assert needed > 50, "the draws were to need the bound"


@pytest.mark.parametrize("robot", SIX)
def test_the_bound_keeps_zeros_and_relations_and_is_inactive_at_nominal_values(robot, tmp_path):
    model = random_model(robot, tmp_path, seed=1, deviation=3.0, design=NETWORKS)
    structure = built(robot)[1]
    q = states(model.n, 200)[0]
    part = model.mass
    part.nominal_armature.zero_()
    mass = model.mass_matrix(q).detach()
    for entry in structure.entries:
        if entry.kind == "zero":
            assert (mass[:, entry.row, entry.column] == 0).all()
    terms = len(part.function_mean) + len(part.raw_constants)
    basis = part.entries(*torch.eye(terms, dtype=torch.float64).unbind()).flatten(1)
    residual = mass.flatten(1) - mass.flatten(1) @ torch.linalg.pinv(basis) @ basis
    assert residual.abs().max() < 1e-9 * mass.abs().max()
    nominal = exact_model(robot, tmp_path)
    assert not bounded(nominal, q).any()


@pytest.mark.parametrize("robot", SIX)
def test_network_outputs_depend_only_on_their_own_joints(robot, tmp_path):
    """A network output depends on its own joints; it is bitwise unchanged if other joints move."""
    model = random_model(robot, tmp_path, seed=2)
    q = states(model.n, 50)[0]
    network = model.residuals.mass
    before = outputs_alone(network, network_inputs(model, q))
    for joint in range(model.n):
        moved = q.clone()
        moved[:, joint] += 0.7
        changed = (outputs_alone(network, network_inputs(model, moved)) != before).any(dim=0)
        expected = [joint in output.joints for output in built(robot)[1].outputs]
        assert changed.tolist() == expected


@pytest.mark.parametrize("robot", ["rpr", "ur10e"])
def test_energy_is_conserved_without_input_and_dissipation(robot, tmp_path):
    """Without input and dissipation, H drifts by less than 1e-8 in 2 s, by a method of order 8."""
    model = frictionless(random_model(robot, tmp_path, seed=0))
    for weight in model.residuals.parameters(recurse=False):
        # torque ripple of 66 periods per revolution is set to zero: the integrator would need shorter steps
        weight.data.zero_()
    at, qd, _, _ = (0.25 * x for x in states(model.n, 4))
    with torch.no_grad():
        prepared, first = model.prepare(), torch.stack([at, model.momentum(at, qd)])

        def rate(_, state):
            q, p = torch.from_numpy(state).view_as(first)
            return torch.stack(model.port_hamiltonian_rhs(q, p, None, prepared)).flatten()

        motion = solve_ivp(rate, (0, 2), first.flatten().numpy(), "DOP853", rtol=1e-10, atol=1e-10)
        q, p = torch.from_numpy(motion.y.T.copy()).view(-1, *first.shape).unbind(1)
        energies = model.hamiltonian(q, p)
    assert (energies / energies[0] - 1).abs().max() < 1e-8
    assert (q - at).abs().max() > 0.5, "the arm was to move"
    assert motion.success and len(motion.t) > 25


def test_group_view_round_trips_and_stays_orthogonal(tmp_path):
    model = random_model("rpr", tmp_path, seed=0)
    q = states(3, 100)[0]
    q[:, [0, 2]] = (q[:, [0, 2]] + torch.pi) % (2 * torch.pi) - torch.pi
    parts = to_group(model.joint_types, q)
    assert [tuple(part.shape[1:]) for part in parts] == [(3, 3), (3,), (3, 3)]
    for rotation in (parts[0], parts[2]):
        assert (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-15
    assert torch.allclose(from_group(model.joint_types, parts), q, atol=1e-14)


def test_the_input_is_added_to_the_rate_of_momentum(tmp_path):
    model = random_model("rpr", tmp_path, seed=0)
    q, p, tau, _ = states(3, 5)
    time = torch.zeros(())
    passive = model(time, torch.cat([q, p], -1))
    driven = model(time, torch.cat([q, p, tau], -1))
    assert torch.equal(driven[:, 6:], torch.zeros_like(tau))
    assert torch.allclose(driven[:, 3:6] - passive[:, 3:6], tau)


def test_arm_with_a_constant_mass_matrix(tmp_path):
    """For a turning and a sliding joint on one axis, M is constant, and inverse dynamics invert forward dynamics."""
    urdf = tmp_path / "rp.urdf"
    link = (
        '<link name="{}"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="9" velocity="1"/></joint>'
    )
    urdf.write_text(
        '<robot name="rp">'
        + "".join(link.format(name) for name in "abc")
        + joint.format("turn", "revolute", "a", "b")
        + joint.format("slide", "prismatic", "b", "c")
        + "</robot>"
    )
    from spelgen.emission.specify import generate

    model = import_source(generate(urdf), tmp_path / "rp_spel.py").Model()
    q, qd, _, tau = states(2, 20)
    mass = model.mass_matrix(q)
    assert torch.allclose(
        mass, torch.diag(torch.tensor([2.18, 1.18], dtype=torch.float64)).expand(20, 2, 2), rtol=1e-5
    )
    assert torch.allclose(model.gravity(q)[:, 0], torch.zeros(20, dtype=torch.float64))
    assert torch.allclose(model.inverse_dynamics(q, qd, model.forward_dynamics(q, qd, tau)), tau)


def test_a_standalone_module_imports_only_torch(tmp_path):
    """Standalone modules of all presets run in a process that can import torch, but no other package and no spelgen."""
    names = [preset.replace("-", "_") for preset in PRESET_NAMES]
    for name, preset in zip(names, PRESET_NAMES, strict=True):
        (tmp_path / f"panda_{name}.py").write_text(built("panda", preset=preset, standalone=True)[0])
    program = (
        "import importlib, sys\n"
        "for name in ('spelgen', 'numpy', 'scipy', 'sympy', 'flint', 'pinocchio', 'lxml', 'yaml', 'jinja2'):\n"
        "    sys.modules[name] = None\n"
        "import torch\n"
        "q = torch.ones(7, dtype=torch.float64)\n"
        "for name in sys.argv[1:]:\n"
        "    m = importlib.import_module(f'panda_{name}').Model()\n"
        "    print(*m.forward_dynamics(q, q, q).shape)\n"
    )
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, *names],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stdout.split() == ["7"] * len(names), run.stderr
