"""The preset closed-form: rigid bodies against Pinocchio, derivatives against autograd, fits against known arms."""

import json
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
import torch
from characters import TESTS, read_characters, write_arm
from emitted import import_source
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.errors import LogError, RunError
from spelgen.fitting.dataset import TrainingConfig
from spelgen.fitting.gaussian_prior import SIZES, Belief
from spelgen.fitting.torque_fit import fit_torque
from spelgen.fitting.torque_start import start_from_torque
from spelgen.identification.samples import DynamicsSamples, dynamics_samples
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.pipeline import build, load
from spelgen.structure.pseudo_inertia import pseudo_inertia
from spelgen.structure.sampling import float_energies

ROBOTS = ("two_link", "rpr", "six_dof", "ur10e", "panda")

FOLLOWED = """<robot name="followed">
  <link name="base"/>
  <link name="a"><inertial><origin xyz="0.2 0 0.1"/><mass value="2"/>
    <inertia ixx="0.1" ixy="0.01" ixz="0" iyy="0.1" iyz="0.02" izz="0.15"/></inertial></link>
  <link name="b"><inertial><origin xyz="0.1 0.1 0"/><mass value="1"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="c"><inertial><origin xyz="0 0.1 0.1"/><mass value="1.5"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="2"/></joint>
  <joint name="follow" type="revolute"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
    <origin xyz="0.4 0 0"/><mimic joint="turn" multiplier="-2" offset="0.3"/>
    <limit lower="-2" upper="2" effort="10" velocity="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
    <origin xyz="0 0.2 0" rpy="0.4 0 0"/><limit lower="0" upper="0.5" effort="10" velocity="1"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def emitted(robots, tmp_path_factory):
    """Robot name -> (module, arm)."""
    folder = tmp_path_factory.mktemp("closed_form")
    (folder / "followed.urdf").write_text(FOLLOWED, encoding="utf-8")
    made = {}
    for name in (*ROBOTS, "followed"):
        urdf = (folder if name == "followed" else robots) / f"{name}.urdf"
        source = build(urdf, preset="closed-form")
        made[name] = import_source(source, folder / f"{name}_closed_form.py"), load(urdf).arm
    return made


def drawn(module, seed, deviation=0.5):
    """A model with random weights."""
    model = module.Model()
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.data = deviation * torch.randn(parameter.shape, dtype=parameter.dtype, generator=generator)
    return model


def rigid(module):
    """The untrained model without friction and rotors."""
    model = module.Model()
    model.rotor_size.zero_()
    model.friction.size.zero_()
    return model.requires_grad_(False)


def states(n, count=30, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(4, count, n, dtype=torch.float64, generator=generator)


def near(a, b, tolerance=1e-9):
    assert a.shape == b.shape
    assert (a - b).abs().max() <= tolerance * max(1.0, b.abs().max())


def moved(q, qd, matrix_of):
    """d/dt of matrix_of(q) along qd."""
    return torch.func.jvp(matrix_of, (q,), (qd,))[1]


@pytest.mark.parametrize("robot", [x for x in ROBOTS if x != "rpr"])  # whose bodies are no possible ones
def test_untrained_it_is_the_urdfs_rigid_arm(emitted, robots, robot):
    module, arm = emitted[robot]
    model = rigid(module)
    names = [coordinate.name for coordinate in arm.coordinates]
    whole = pin.buildModelFromUrdf(str(robots / f"{robot}.urdf"))
    locked = [i for i in range(1, whole.njoints) if whole.names[i] not in names]
    other = pin.buildReducedModel(whole, locked, pin.neutral(whole))
    other.gravity.linear = np.array([float(g) for g in arm.gravity])
    data = other.createData()
    q, qd, qdd, _ = states(model.n)
    each = list(zip(q.numpy(), qd.numpy(), qdd.numpy(), strict=True))
    tau = torch.from_numpy(np.array([pin.rnea(other, data, *x) for x in each]))
    near(model.inverse_dynamics(q, qd, qdd), tau, 1e-8)
    near(model.regressor(q, qd, qdd) @ model.inertial_parameters().flatten(), tau, 1e-8)
    height = torch.from_numpy(np.array([pin.computePotentialEnergy(other, data, x) for x in q.numpy()]))
    near(model.potential_energy(q) - model.potential_energy(q[:1]), height - height[0], 1e-8)


def test_joints_that_follow_and_joints_that_slide(emitted):
    module, arm = emitted["followed"]
    model = rigid(module)
    q, *_ = states(model.n)
    inertias = [[float(x) for x in body.inertia] for body in arm.bodies]
    mass, potential = float_energies(arm, q.numpy(), inertias)
    rows, columns = np.tril_indices(model.n)
    near(model.mass_matrix(q)[:, rows, columns], torch.from_numpy(mass), 1e-10)
    near(model.potential_energy(q), torch.from_numpy(potential), 1e-10)


def test_impossible_bodies_start_from_possible_ones(emitted):
    module, _ = emitted["rpr"]
    ten = module.Model().inertial_parameters().detach().numpy()
    assert (np.linalg.eigvalsh(pseudo_inertia(ten))[:, 0] > 0).all()


@pytest.mark.parametrize("robot", [*ROBOTS, "followed"])
def test_the_equations_are_those_of_its_hamiltonian(emitted, robot):
    model = drawn(emitted[robot][0], seed=1)
    q, qd, _, tau = states(model.n)
    q.requires_grad_()
    p = model.momentum(q, qd).detach()
    (slope,) = torch.autograd.grad(model.hamiltonian(q, p).sum(), q)
    (gravity,) = torch.autograd.grad(model.potential_energy(q).sum(), q)
    q = q.detach()
    near(model.gravity(q), gravity)
    rate, force = model.rates(q, p, tau, model.prepare())
    near(rate, qd)
    given = (model.input_matrix(q) @ (tau - model.torque_offset()).unsqueeze(-1)).squeeze(-1)
    near(force, given - slope - (model.dissipation(q, qd) @ qd.unsqueeze(-1)).squeeze(-1))
    qdd = model.forward_dynamics(q, qd, tau)
    near(model.inverse_dynamics(q, qd, qdd), tau, 1e-8)
    momentum_rate = moved(q, qd, lambda x: model.momentum(x, qd)) + model.momentum(q, qdd)
    near(momentum_rate, force, 1e-8)


@pytest.mark.parametrize("robot", ROBOTS)
def test_possible_bodies_and_resisting_friction_for_all_weights(emitted, robot):
    for seed in range(3):
        model = drawn(emitted[robot][0], seed=seed, deviation=1.5).requires_grad_(False)
        q, qd, _, _ = states(model.n, 300, seed)
        pseudo = pseudo_inertia(model.inertial_parameters().numpy())
        assert (np.linalg.eigvalsh(pseudo)[:, 0] > 0).all()
        assert torch.linalg.eigvalsh(model.mass_matrix(q))[:, 0].min() > 0
        assert model.dissipation(q, 1e-3 * qd).diagonal(dim1=-2, dim2=-1).min() > 0


@pytest.mark.parametrize("batch", [(), (1,), (0,), (2, 3), (2, 0)])
def test_any_batch_shape(emitted, batch):
    model = drawn(emitted["rpr"][0], seed=0)
    q, qd, tau = (torch.rand(*batch, 3, dtype=torch.float64) for _ in range(3))
    for value in (model.gravity(q), model.forward_dynamics(q, qd, tau), model.inverse_dynamics(q, qd, tau)):
        assert value.shape == (*batch, 3)
    for value in (model.mass_matrix(q), model.dissipation(q, qd), model.input_matrix(q)):
        assert value.shape == (*batch, 3, 3)
    assert model.regressor(q, qd, tau).shape == (*batch, 3, 30)
    assert model.potential_energy(q).shape == batch
    assert model(torch.zeros(()), torch.cat([q, qd, tau], dim=-1)).shape == (*batch, 9)


def test_backpropagation_reaches_every_weight(emitted):
    model = drawn(emitted["rpr"][0], seed=0, deviation=0.3)
    q, qd, _, tau = states(3)
    model.forward_dynamics(q, qd, tau).square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad.abs().max() > 0, name


def test_friction_at_a_standstill_has_its_slope(emitted):
    model = drawn(emitted["ur10e"][0], seed=0)
    q = states(6)[0]
    constants = model.friction.prepared()
    still = torch.zeros_like(q).requires_grad_()
    (slope,) = torch.autograd.grad(model.friction(still, model.gravity(q), constants).sum(), still)
    near(slope, model.dissipation(q, still).diagonal(dim1=-2, dim2=-1))
    away = torch.full_like(q, 1e-3)  # where the formula is another branch
    torque = model.friction(away, model.gravity(q), constants)
    dry = constants.coulomb + constants.load * model.gravity(q).abs()
    dry = dry + constants.stribeck * (-((away / constants.fading) ** 2)).exp()
    bend = constants.bend * (away / constants.bend_speed).tanh()
    near(torque, constants.viscous * away + bend + dry * (away / constants.jump).tanh())


def recorded(model, seconds, noise, seed=0):
    """Samples of a smooth random motion with the model's own torque."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)[:, None, None]
    n = model.n
    speed, phase = 2 * np.pi * rng.uniform(0.1, 0.7, (5, n)), rng.uniform(0, 2 * np.pi, (5, n))
    size = rng.uniform(0.2, 0.5, (5, n))
    angle = speed * t + phase
    q, qd = (size * np.sin(angle)).sum(1), (size * speed * np.cos(angle)).sum(1)
    qdd = -(size * speed**2 * np.sin(angle)).sum(1)
    with torch.no_grad():
        tau = model.inverse_dynamics(*(torch.from_numpy(x) for x in (q, qd, qdd))).numpy()
    tau = tau + noise * tau.std(0) * rng.normal(size=tau.shape)
    return DynamicsSamples("known", q, qd, qdd, tau)


def nmse(model, sample):
    with torch.no_grad():
        inputs = (torch.from_numpy(x) for x in (sample.q, sample.qd, sample.qdd))
        error = model.inverse_dynamics(*inputs).numpy() - sample.tau
    return float((np.square(error).mean(0) / sample.tau.var(0)).mean())


@pytest.mark.parametrize("robot", ["rpr", "six_dof"])
def test_a_known_arm_is_fitted_from_seconds_of_noisy_torque(emitted, robot):
    module = emitted[robot][0]
    true = drawn(module, seed=2, deviation=0.3)
    found = module.Model()
    start = nmse(found, recorded(true, 10.0, 0.0, seed=9))
    fit = fit_torque(found, [recorded(true, 6.0, 0.05, seed=1)])
    assert fit.steps > 2
    assert nmse(found, recorded(true, 10.0, 0.0, seed=9)) < min(2e-3, 0.02 * start)


def test_without_noise_the_torque_is_met_to_many_digits(emitted):
    module = emitted["two_link"][0]
    true = drawn(module, seed=3, deviation=0.3)
    found = module.Model()
    fit_torque(found, [recorded(true, 20.0, 0.0)])
    assert nmse(found, recorded(true, 10.0, 0.0, seed=5)) < 1e-6


def test_only_the_named_bodies_move(emitted):
    module = emitted["six_dof"][0]
    true, found = module.Model(), module.Model()
    true.bodies.data[5] = torch.tensor([0.3, 0.5, -0.2, 0.1, 0.4, 0.2, 0.6, -0.3, 0.2, 0.9])
    fit_torque(found, [recorded(true, 5.0, 0.01)], Belief(bodies=10.0), only_bodies=[5])
    assert nmse(found, recorded(true, 5.0, 0.0, seed=4)) < 1e-4
    before = module.Model().state_dict()
    for name, value in found.state_dict().items():
        change = (value - before[name]).abs()
        if name == "bodies":
            assert change[5].max() > 0.1
            change[5] = 0
        assert change.max() == 0, name


def test_belief_shares_what_joints_share():
    weights = {"rotor": torch.zeros(2), **{name: torch.zeros(2) for name in SIZES}}
    belief = Belief(rotor=0.5, shared_rotor=2.0, sizes=0.3, shared_sizes=1.0, shared_friction=3.0)
    covariance = belief.covariance(weights)
    assert covariance[0, 0] == 0.25 + 4.0
    assert covariance[0, 1] == 4.0
    assert covariance[2, 2] == pytest.approx(0.09 + 1.0 + 9.0)
    assert covariance[2, 3] == 1.0 + 9.0  # the same effect at another joint
    assert covariance[2, 4] == 9.0  # another effect
    assert covariance[0, 2] == 0.0
    assert torch.linalg.eigvalsh(covariance)[0] > 0


def write(path, samples, arm):
    """Samples at 100 Hz as a log."""
    names = [coordinate.name for coordinate in arm.coordinates]
    written = [
        Trajectory(f"known {k}", 0.01 * np.arange(len(x.q)), x.q, x.qd, x.tau) for k, x in enumerate(samples)
    ]
    write_logs(path, written, names)


@pytest.fixture(scope="module")
def run(emitted, robots, tmp_path_factory):
    """A run of `spelgen train` on a closed-form module, and the model whose torques its logs hold."""
    folder = tmp_path_factory.mktemp("closed_form_run")
    module, arm = emitted["six_dof"]
    true = drawn(module, seed=4, deviation=0.2)
    logs = [recorded(true, 5.0, 0.01, seed=seed) for seed in range(2)]
    write(folder / "logs.parquet", logs, arm)
    robot = str(robots / "six_dof.urdf")
    build_ = ["build", robot, "--preset", "closed-form", "-o", str(folder / "arm.py")]
    train = ["train", str(folder / "arm.py"), "--robot", robot, "--data", str(folder / "logs.parquet")]
    train += ["-o", str(folder / "run"), "--quiet"]
    for command in (build_, train):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
    return folder, true, train


def test_train_fits_torques_and_leaves_a_run(run, emitted):
    folder, true, _ = run
    model = emitted["six_dof"][0].Model()
    model.load_state_dict(torch.load(folder / "run" / "model.pt", weights_only=True))
    fresh = recorded(true, 5.0, 0.0, seed=8)
    assert nmse(model, fresh) < 0.2 * nmse(
        emitted["six_dof"][0].Model(), fresh
    )  # friction, filtered at 8 Hz, differs
    write(folder / "test.parquet", [recorded(true, 1.2, 0.01, seed=8)], emitted["six_dof"][1])
    done = CliRunner().invoke(app, ["evaluate", str(folder / "run"), "--data", str(folder / "test.parquet")])
    assert done.exit_code == 0, done.output
    result = json.loads((folder / "run" / "evaluation.json").read_text(encoding="utf-8"))
    assert result["torque"]["model"]["mean_nmse"] < 5e-3
    assert CliRunner().invoke(app, ["report", str(folder / "run")]).exit_code == 0


def test_a_run_is_adapted_to_a_load(run, emitted, tmp_path):
    folder, true, _ = run
    module, arm = emitted["six_dof"]
    loaded = module.Model()
    loaded.load_state_dict(true.state_dict())
    loaded.bodies.data[5, 9] += 1.0  # heavier
    loaded.bodies.data[5, 6] += 0.5
    seen = recorded(loaded, 5.0, 0.01, seed=3)
    write(tmp_path / "loaded.parquet", [seen], arm)
    command = ["train", "--from", str(folder / "run"), "--data", str(tmp_path / "loaded.parquet")]
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "adapted"), "--quiet"])
    assert done.exit_code == 0, done.output
    before, after = (
        torch.load(x / "model.pt", weights_only=True) for x in (folder / "run", tmp_path / "adapted")
    )
    assert {name for name in before if not torch.equal(before[name], after[name])} == {"bodies"}
    assert torch.equal(before["bodies"][:5], after["bodies"][:5])
    errors = []
    for state in (before, after):
        model = module.Model()
        model.load_state_dict(state)
        errors.append(nmse(model, recorded(loaded, 5.0, 0.0, seed=6)))
    assert errors[1] < 0.3 * errors[0]


def test_what_cannot_be_adapted_is_told(emitted):
    config, nothing = TrainingConfig(), SimpleNamespace(recordings=())
    with pytest.raises(RunError, match="a load for a model of networks"):
        start_from_torque(torch.nn.Linear(1, 1), nothing, config, fit=True, loaded=True)
    with pytest.raises(LogError, match="no motion to fit a load to"):
        start_from_torque(emitted["rpr"][0].Model(), nothing, config, fit=True, loaded=True)
    left, notes = start_from_torque(emitted["rpr"][0].Model(), nothing, config, fit=True)
    assert left == config  # windows are all there is
    assert notes[0].code == "no-torque-fit"


def test_it_has_no_network_to_choose(robots, tmp_path):
    command = ["build", str(robots / "rpr.urdf"), "--preset", "closed-form", "--net", "kan"]
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "arm.py")])
    assert done.exit_code == 2
    assert "closed-form has no networks" in done.output


def test_the_same_logs_give_the_same_weights(run, tmp_path):
    folder, _, train = run
    again = [*train[:-3], "-o", str(tmp_path / "again"), "--quiet"]
    assert CliRunner().invoke(app, again).exit_code == 0
    first, second = (
        torch.load(x / "model.pt", weights_only=True) for x in (folder / "run", tmp_path / "again")
    )
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_characters(shared, tmp_path):
    source = build(write_arm(tmp_path), preset="closed-form")
    model = import_source(source, tmp_path / "planar_closed_form.py").Model()
    samples, _ = read_characters(shared / "logs" / "delan_characters")
    fit_torque(model, [x for x in samples if x.name not in TESTS])
    test = [x for x in samples if x.name in TESTS]
    with torch.no_grad():
        inputs = [torch.from_numpy(np.concatenate([getattr(x, k) for x in test])) for k in ("q", "qd", "qdd")]
        error = model.inverse_dynamics(*inputs).numpy() - np.concatenate([x.tau for x in test])
    tau = np.concatenate([x.tau for x in test])
    assert np.square(error).sum() / np.square(tau - tau.mean(0)).sum() < 1e-8


def test_two_seconds_of_a_real_arm_beat_least_squares(shared, tmp_path):
    folder = shared / "logs" / "ur10e"
    source = build(folder / "ur10e.urdf", preset="closed-form")
    model = import_source(source, tmp_path / "ur10e_closed_form.py").Model()
    names = [coordinate.name for coordinate in load(folder / "ur10e.urdf").arm.coordinates]
    (long,) = read_logs([folder / "20_02_10_30sec_12harm.parquet"], names)
    fit_torque(model, dynamics_samples([long[: int(np.searchsorted(long.t, long.t[0] + 2.0))]]))
    tests = ("19_12_23_free", "20_02_06_20sec_5harm")
    samples = dynamics_samples([read_logs([folder / f"{x}.parquet"], names)[0] for x in tests], pauses=True)
    assert np.mean([nmse(model, sample) for sample in samples]) < 0.03  # the best quick prior: 0.057 of nine
