"""Torque fits of closed-form models recover known arms, in blocks of samples or at once, and adapt to loads."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from delan_characters import TESTS, read_characters, write_arm
from emitted import closed_forms, import_source
from lxml import etree
from motions import smooth_motion
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_t
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.emission.assemble import load_module
from spelgen.emission.build import build
from spelgen.emission.specify import generate
from spelgen.errors import LogError
from spelgen.fitting.fit import default_objective, fit
from spelgen.fitting.torque import fit as torque_fit
from spelgen.fitting.torque import jacobian as torque_jacobian
from spelgen.fitting.torque.covariance import contiguous_blocks
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.jacobian import ResidualSamples, TorqueJacobian
from spelgen.fitting.torque.joint_functions import FRICTION
from spelgen.fitting.torque.linearization import RigidProjection
from spelgen.fitting.torque.networks import adapt_networks
from spelgen.fitting.torque.parameters import (
    NEGLIGIBLE,
    RIGID_GROUPS,
    ParameterPrior,
    ParameterVector,
    prior_covariance,
    step_in_inertial_parameters,
    update_widths,
)
from spelgen.fitting.torque.problem import NoiseEstimator, TorqueProblem
from spelgen.fitting.torque.regression import PENALTIES, best_regression
from spelgen.fitting.torque.report import terms_in_use, torque_notes
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import select_functions
from spelgen.fitting.torque.stages import find_compensation, initial_fit
from spelgen.fitting.torque.tuning import TorqueTuning
from spelgen.identification.identification import LeastSquares
from spelgen.identification.identify import least_squares
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import GaussianPrior, Rollout, TorqueFit
from tests.test_closed_form import drawn

ROBOTS = ("two_link", "rpr", "six_dof")
BODIES = "bodies.raw"


@pytest.fixture(scope="module")
def emitted(tmp_path_factory):
    return closed_forms(ROBOTS, tmp_path_factory.mktemp("rigid_bodies"))


def recorded(model, seconds, noise, seed=0):
    """Return samples at 100 Hz of a smooth random motion with the model's torque, to which noise is added.

    seconds: duration [s]. noise: standard deviation of the noise, relative to the standard deviation of each joint's
    torque. seed: of motion and noise.
    """
    rng = np.random.default_rng(seed)
    q, qd, qdd = smooth_motion(model.n, seconds, rng)
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


def test_without_noise_the_torque_residual_is_negligible(emitted):
    module = emitted["two_link"][0]
    true = drawn(module, seed=3, deviation=0.3)
    found = module.Model()
    fit_torque(found, [recorded(true, 20.0, 0.0)])
    assert nmse(found, recorded(true, 10.0, 0.0, seed=5)) < 1e-6


def test_only_the_named_bodies_move(emitted):
    module = emitted["six_dof"][0]
    true, found = module.Model(), module.Model()
    true.get_parameter(BODIES).data[5] = torch.tensor([0.3, 0.5, -0.2, 0.1, 0.4, 0.2, 0.6, -0.3, 0.2, 0.9])
    fit_torque(found, [recorded(true, 5.0, 0.01)], adapt="load")
    assert nmse(found, recorded(true, 5.0, 0.0, seed=4)) < 1e-4
    before = module.Model().state_dict()
    for name, value in found.state_dict().items():
        change = (value - before[name]).abs()
        if name == BODIES:
            assert change[5].max() > 0.1
            change[5] = 0
        assert change.max() == 0, name


def test_the_prior_shares_what_joints_share():
    kinds = {"rotors": "armature", "viscous": "sizes", "coulomb": "sizes"}
    weights = {name: torch.zeros(2) for name in kinds}
    prior = GaussianPrior(armature=0.5, shared_armature=2.0, sizes=0.3, shared_sizes=1.0, shared_friction=3.0)
    found = prior_covariance(prior, weights, kinds)
    assert found[0, 0] == 0.25 + 4.0
    assert found[0, 1] == 4.0
    assert found[2, 2] == pytest.approx(0.09 + 1.0 + 9.0)
    assert found[2, 3] == 1.0 + 9.0  # prior covariance between the same friction effect at two joints
    assert found[2, 4] == 9.0  # prior covariance between two different friction effects
    assert found[0, 2] == 0.0
    assert torch.linalg.eigvalsh(found)[0] > 0


def test_the_prior_shares_each_element_of_bristles():
    """The prior of bristle fractions is the sum of two Gaussian terms: one per joint, and one common to all joints.

    The fractions of bristle k at joints i and j have the covariance 2.0^2, plus 0.5^2 if i = j. Different bristles are
    independent.
    """
    prior = GaussianPrior(fractions=0.5, shared_fractions=2.0)
    found = prior_covariance(prior, {"fractions": torch.zeros(2, 3)}, {"fractions": "fractions"})
    expected = 0.25 * torch.eye(6) + 4.0 * torch.eye(3).repeat(2, 2)
    torch.testing.assert_close(found, expected.double())


def test_the_prior_has_a_group_for_every_parameter(emitted):
    """Each parameter of a model belongs to a group of the prior, with a positive variance.

    A fit would attribute the effect of a parameter without a group to others.
    """
    module = emitted["six_dof"][0]
    model = module.Model()
    rigid = ParameterVector(model)
    assert set(rigid.groups) == {*dict(model.named_parameters()), "raw_friction_compensation"}
    assert set(rigid.groups.values()) == set(RIGID_GROUPS) - {"gains"}
    assert prior_covariance(GaussianPrior(), rigid.initial, rigid.groups).diagonal().min() > 0


def test_prior_widths_maximize_the_marginal_likelihood():
    """Estimated prior standard deviations maximize the marginal likelihood, shown for a linear problem."""
    rng = np.random.default_rng(0)
    rows, noise = rng.normal(size=(40, 20)), 0.5
    y = rows @ (0.8 * rng.normal(size=20)) + noise * rng.normal(size=40)

    def minus_log_likelihood(log_deviation):
        total = noise**2 * np.eye(40) + np.exp(2 * log_deviation) * rows @ rows.T
        return float(np.linalg.slogdet(total)[1] + y @ np.linalg.solve(total, y)) / 2

    best = np.exp(minimize_scalar(minus_log_likelihood, bounds=(-4, 3), method="bounded").x)
    order = torch.arange(33)
    masks = {"armature": order < 3, "offset": (order >= 3) & (order < 23), "bodies": order >= 23}
    rigid = SimpleNamespace(mask=masks.get)

    def updated(widths, hyperprior, x, covariance):
        body_widths = torch.full((1,), widths.bodies).double()
        prior = ParameterPrior(rigid, widths, hyperprior, torch.zeros(33).double(), body_widths)
        return update_widths(prior, x, covariance).widths

    guess = prior = GaussianPrior(armature=0.1, bodies=0.1, offset=0.1, degrees_of_freedom=1e-9)
    for _ in range(200):
        posterior = np.linalg.inv(rows.T @ rows / noise**2 + np.eye(20) / prior.offset**2)
        away, covariance = torch.full((33,), 0.1).double(), torch.zeros(33, 33).double()
        away[3:23] = torch.from_numpy(posterior @ rows.T @ y / noise**2)
        covariance[3:23, 3:23] = torch.from_numpy(posterior)
        prior = updated(prior, guess, away, covariance)
    assert prior.offset == pytest.approx(best, rel=1e-4)
    # An offset from the prior mean that all armatures share does not widen the prior of single armatures: the prior has
    # a separate width for a common factor of all armatures.
    assert prior.armature < 1e-4
    away[:3] = torch.tensor([0.3, -0.3, 0.0])
    assert updated(prior, guess, away, covariance).armature == pytest.approx(0.3)
    certain = prior.model_copy(update={"degrees_of_freedom": 1e12})
    assert updated(certain, guess, away, covariance).offset == pytest.approx(guess.offset)


def test_the_widths_of_bodies_are_those_of_a_t_distribution(robots):
    """The prior of the bodies' inertial parameters is a Student-t distribution, scaled by maximum marginal likelihood.

    If the initial inertial parameters of one link have a large error, the prior becomes wider for this link, so that
    the link does not keep its initial values, but not for other links.
    """
    rigid, widths = ParameterVector(build(robots / "six_dof.urdf", "closed-form")), GaussianPrior()
    prior, bodies = ParameterPrior.of(rigid, widths), rigid.mask("bodies")
    offsets = 0.2 * np.random.default_rng(0).normal(size=(int(bodies.sum()) // 10, 10))
    offsets[2] *= 10.0
    x = prior.mean.clone().masked_scatter(bodies, torch.from_numpy(offsets))
    for _ in range(200):
        prior = update_widths(prior, x, torch.zeros(len(x), len(x)).double())

    def minus_log_density(log_scale):
        square, freedom = np.exp(2 * log_scale), widths.degrees_of_freedom
        density = multivariate_t.logpdf(offsets, shape=square * np.eye(10), df=freedom).sum()
        return freedom / 2 * (2 * log_scale + widths.bodies**2 / square) - density

    best = np.exp(minimize_scalar(minus_log_density, bounds=(-3, 2), method="bounded").x)
    assert prior.widths.bodies == pytest.approx(best, rel=1e-4)
    assert prior.body_widths[2] > 3 * prior.widths.bodies
    assert prior.body_widths[[0, 1, 3]].max() < 1.2 * prior.widths.bodies < 0.5


def test_the_prior_of_a_wrong_urdf_is_widened_with_a_note(emitted):
    module = emitted["six_dof"][0]
    true, fixed, found = drawn(module, seed=2, deviation=0.3), module.Model(), module.Model()
    true.get_parameter(BODIES).data[:, 9] += 3.2  # the mass of every body is 25 times larger
    few, test = [recorded(true, 3.0, 0.02, seed=1)], recorded(true, 10.0, 0.0, seed=9)
    certain = GaussianPrior(bodies=0.2, degrees_of_freedom=1e9)
    fit_torque(fixed, few, certain)
    wrong = fit_torque(found, few, certain.model_copy(update={"degrees_of_freedom": 8.0}))
    assert wrong.prior.bodies > 0.6
    assert nmse(found, test) < 0.5 * nmse(fixed, test)
    right = fit_torque(module.Model(), [recorded(module.Model(), 6.0, 0.02, seed=1)])
    assert right.prior.bodies < 0.35
    samples = TorqueSamples.of(few)
    told = [next(torque_notes(found, samples, each)).message for each in (wrong, right)]
    assert told == [
        f"prior standard deviation of URDF masses: factor {np.exp(each.prior.bodies):.2g}"
        for each in (wrong, right)
    ]


@pytest.mark.parametrize("seed", [0, 1])
def test_placeholder_bodies_are_replaced(emitted, robots, tmp_path, seed):
    """Placeholder inertials (1 kg and a small ball per link) are replaced by a fit to 20 s of motion."""
    true = emitted["rpr"][0].Model()
    tree = etree.parse(robots / "rpr.urdf")
    for inertial in tree.iterfind(".//link/inertial"):
        for child in list(inertial):
            inertial.remove(child)
        etree.SubElement(inertial, "mass", value="1")
        moments = dict.fromkeys(("ixx", "iyy", "izz"), "0.004") | dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        etree.SubElement(inertial, "inertia", **moments)
    tree.write(tmp_path / "rpr.urdf")
    found = build(tmp_path / "rpr.urdf", "closed-form")
    fit_torque(found, [recorded(true, 20.0, 0.02, seed)])
    assert nmse(found, recorded(true, 20.0, 0.0, seed=9)) < 1e-4


def with_unit_error(urdf, mass, center, path):
    """Write a URDF with masses and inertias multiplied by `mass`, and centres of mass by `center`."""
    tree = etree.parse(urdf)
    for inertial in tree.iterfind(".//link/inertial"):
        origin = inertial.find("origin")
        origin.set("xyz", " ".join(repr(center * float(x)) for x in origin.get("xyz").split()))
        inertial.find("mass").set("value", repr(mass * float(inertial.find("mass").get("value"))))
        for name, value in inertial.find("inertia").attrib.items():
            inertial.find("inertia").set(name, repr(mass * float(value)))
    tree.write(path)
    return path


@pytest.mark.parametrize(
    ("mass", "center", "replaced"),
    [(1.0, 1.0, False), (1e-6, 1.0, True), (1.0, 1000.0, False)],
    ids=["right", "masses in mg", "centres in mm"],
)
def test_a_fit_is_as_good_as_least_squares_for_any_urdf(emitted, robots, tmp_path, mass, center, replaced):
    """The test error of a fit is at most 2 % larger than the error of least squares, for any inertials of the URDF.

    A fit with a significantly larger error than ridge regression, here for masses in mg, is repeated with the result of
    the regression as initial values, and a note states this.
    """
    true = emitted["rpr"][0].Model()
    urdf = with_unit_error(robots / "rpr.urdf", mass, center, tmp_path / "rpr.urdf")
    logs, test = [recorded(true, 10.0, 0.02, seed=1)], recorded(true, 10.0, 0.0, seed=9)
    found = build(urdf, "closed-form")
    solution = fit_torque(found, logs)
    reference = least_squares(load_arm(urdf).chain, logs, LeastSquares("range"))
    error = reference.torque(test.q, test.qd, test.qdd) - test.tau
    assert nmse(found, test) < 1.02 * (np.square(error).mean(axis=0) / test.tau.var(axis=0)).mean()
    assert not solution.comparison.behind and (solution.comparison.replaced is not None) == replaced
    codes = {note.code for note in torque_notes(found, TorqueSamples.of(logs), solution)}
    assert ("fit-from-regression" in codes) == replaced and "behind-regression" not in codes


def test_torques_that_no_bodies_have_are_named(emitted, monkeypatch):
    """Torques that no physically consistent bodies can cause, here by a negative inertia at a joint, give a warning.

    Ridge regression has a smaller held-out error than the fit; the warning states this error. Before the warning, the
    fit is repeated twice, with the regression's held-out error as upper bound of the torque noise.
    """
    bounds, staged_fit = [], torque_fit._staged_fit

    def recorded_fit(*arguments, max_error=None):
        bounds.append(max_error)
        return staged_fit(*arguments, **({} if max_error is None else {"max_error": max_error}))

    monkeypatch.setattr(torque_fit, "_staged_fit", recorded_fit)
    model = emitted["rpr"][0].Model()
    log = recorded(emitted["rpr"][0].Model(), 10.0, 0.02, seed=1)
    tau = log.tau.copy()
    tau[:, 2] -= 2 * tau[:, 2].std() / log.qdd[:, 2].std() * log.qdd[:, 2]
    logs = [replace(log, tau=tau)]
    solution = fit_torque(model, logs)
    assert solution.comparison.behind
    notes = {note.code: note.message for note in torque_notes(model, TorqueSamples.of(logs), solution)}
    assert f"(nMSE {solution.comparison.regression:.2g})" in notes["behind-regression"]
    samples = TorqueSamples.of(logs, TorqueTuning.decimation)
    held_out = best_regression(model, contiguous_blocks(samples), tau.std(axis=0)).held_out
    assert bounds[0] is None and len(bounds) == 3
    for bound in bounds[1:]:
        expected = tau.std(axis=0) * np.sqrt(held_out.sum(axis=0) / samples.count)
        np.testing.assert_allclose(bound, expected, rtol=0.02)


def test_a_fit_that_the_logs_do_not_support_is_discarded(emitted):
    """A fit to 0.25 s of torques with 100 % noise is discarded: the model keeps the URDF's values, with a warning."""
    module = emitted["rpr"][0]
    found = drawn(module, seed=2, deviation=0.1)
    before = found.bodies.raw.detach().clone()
    logs = [recorded(module.Model(), 0.25, 1.0, seed=1)]
    solution = fit_torque(found, logs)
    assert solution.comparison.discarded > solution.comparison.fit
    assert solution.steps == 0 and torch.equal(found.bodies.raw, before)
    # the covariance is the prior's: an inertial parameter has the default standard deviation
    bodies = ParameterVector(found).mask("bodies")
    torch.testing.assert_close(
        solution.covariance[bodies][:, bodies], GaussianPrior().bodies ** 2 * torch.eye(30).double()
    )
    samples = TorqueSamples.of(logs, TorqueTuning.decimation)
    notes = {note.code: note.message for note in torque_notes(found, samples, solution)}
    assert f"(nMSE {solution.comparison.discarded:.2g})" in notes["fit-discarded"]


def test_held_out_errors_of_ridge_regression_are_those_of_refits(emitted, robots):
    """Held-out errors of ridge regression equal refits of the stacked equations, for each block and penalty."""
    model = emitted["rpr"][0].Model()
    log = recorded(model, 4.0, 0.1, seed=1)
    blocks = contiguous_blocks(TorqueSamples.of([log]))
    scale = log.tau.std(axis=0)
    found = best_regression(model, blocks, scale)
    columns = np.concatenate(
        [
            regressor(load_arm(robots / "rpr.urdf").chain, log.q, log.qd, log.qdd),
            FrictionModel().columns(log.qd, log.qdd),
        ],
        axis=2,
    )
    rows, target = columns / scale[:, None], log.tau / scale
    length = np.sqrt(np.square(rows).sum(axis=(0, 1)))
    rows = rows / np.where(length > 0, length, 1.0)
    of_penalties = []
    for penalty in PENALTIES:
        ridge, errors = np.sqrt(penalty) * np.eye(rows.shape[2]), []
        for block in np.array_split(np.arange(len(rows)), 10):
            kept = np.delete(np.arange(len(rows)), block)
            stacked = np.vstack([rows[kept].reshape(-1, rows.shape[2]), ridge])
            known = np.append(target[kept].ravel(), np.zeros(rows.shape[2]))
            parameters = np.linalg.lstsq(stacked, known, rcond=None)[0]
            errors.append(np.square(rows[block] @ parameters - target[block]).sum(axis=0))
        of_penalties.append(errors)
    expected = min(of_penalties, key=np.sum)
    np.testing.assert_allclose(found.held_out, expected, rtol=1e-4)


def test_steps_of_bodies_are_linear_in_their_parameters_and_stay_consistent(emitted):
    """A solver step of bodies is a straight line in their inertial parameters: twice the step is twice the change.

    Large steps are shortened, so that the bodies remain physically consistent.
    """
    bodies = drawn(emitted["rpr"][0], seed=1, deviation=0.3).bodies
    raw = bodies.raw.detach().clone()
    step = torch.randn(raw.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def pseudo_inertias(weights):
        root = torch.func.functional_call(bodies, {"raw": weights}, ())
        return root @ root.mT

    def parameters(size):
        return pseudo_inertias(step_in_inertial_parameters(raw, size * step))

    small = parameters(0.01) - parameters(0.0)
    torch.testing.assert_close(parameters(0.02) - parameters(0.0), 2 * small, rtol=1e-9, atol=1e-12)
    slope = torch.func.jvp(pseudo_inertias, (raw,), (0.01 * step,))[1]
    torch.testing.assert_close(small, slope, rtol=1e-9, atol=1e-12)
    assert (torch.linalg.eigvalsh(parameters(100.0)) > 0).all()


def test_friction_compensation_by_a_drive_is_found(emitted):
    module = emitted["six_dof"][0]
    true, found = drawn(module, seed=2, deviation=0.2), module.Model()
    true.raw_friction_compensation[4] = 40.0
    logs = [recorded(true, 6.0, 0.05, seed=1)]
    fit = fit_torque(found, logs)
    assert fit.compensated.tolist() == [False] * 4 + [True, False]
    value, known = (x.friction_compensation for x in (found, true))
    assert value[4].item() == pytest.approx(known[4].item(), rel=0.15)
    assert value[[0, 1, 2, 3, 5]].abs().max() == 0
    assert nmse(found, recorded(true, 10.0, 0.0, seed=9)) < 5e-3
    notes = {note.code: note for note in torque_notes(found, TorqueSamples.of(logs), fit)}
    assert f"{found.joint_names[4]} {value[4].item():.3g} Nm s/rad" in notes["friction-compensated"].message


def test_a_spring_in_a_motion_that_does_not_return_is_no_compensation(emitted):
    """A spring is not mistaken for friction compensation of a drive, although both give torques along the velocity.

    The joint moves once, in one direction, from -1 to 1 rad, and a spring pulls it to 1 rad. The measured torque of the
    spring is therefore negative during the whole motion, while the velocity is positive.
    """
    module = emitted["six_dof"][0]
    t = np.linspace(0.0, 12.0, 1200)
    motion = smooth_motion(6, 12.0, np.random.default_rng(1))
    for values, of_joint in zip(
        motion,
        (
            -np.cos(np.pi * t / 12),
            np.pi / 12 * np.sin(np.pi * t / 12),
            (np.pi / 12) ** 2 * np.cos(np.pi * t / 12),
        ),
        strict=True,
    ):
        values[:, 4] = of_joint
    with torch.no_grad():
        tau = module.Model().inverse_dynamics(*map(torch.from_numpy, motion)).numpy()
    tau[:, 4] += tau[:, 4].std() * (motion[0][:, 4] - 1.0)
    # only the initial fit is run, since it decides on friction compensation
    samples = TorqueSamples.of([DynamicsSamples("spring", *motion, tau)])
    problem = TorqueProblem.of(TorqueJacobian(module.Model(), samples), GaussianPrior())
    assert not find_compensation(
        problem, problem.jacobian.rigid.flatten(problem.jacobian.rigid.initial)
    ).any()
    assert not initial_fit(problem).problem.compensated.any()


def test_a_torque_that_falls_with_velocity_by_little_is_no_compensation(emitted):
    """A torque that decreases slightly with velocity is not reported as friction compensation of a drive.

    A shift of half a sample between torque and motion has an effect of this size, a hundredth of the torque.
    """
    module = emitted["six_dof"][0]
    true = module.Model()
    with torch.no_grad():
        true.friction.raw_coulomb -= 20.0
        true.friction.raw_viscous -= 20.0
    plain = recorded(true, 40.0, 0.0, seed=1)
    falling = 0.03 * plain.tau.std(axis=0) / plain.qd.std(axis=0) * plain.qd
    log = replace(plain, tau=plain.tau - falling)
    assert not fit_torque(module.Model(), [log]).compensated.any()


@pytest.mark.parametrize("shown", [True, False])
def test_friction_has_the_effects_that_samples_show(emitted, shown):
    """Stribeck effect, saturation and load dependence are selected if the samples show them, and none otherwise."""
    module = emitted["six_dof"][0]
    true, found = drawn(module, seed=2, deviation=0.3), module.Model()
    effects = ("raw_stribeck", "raw_saturation", "raw_load_dependence")
    for name in effects:
        getattr(true.friction, name).data += 1.0 if shown else NEGLIGIBLE
    fit_torque(found, [recorded(true, 20.0, 0.02)])
    sizes = torch.stack([getattr(found.friction, name).detach().exp() for name in effects])
    assert (sizes > 0.1).any(dim=0).all() if shown else (sizes < 1e-12).all()
    assert nmse(found, recorded(true, 10.0, 0.0, seed=9)) < 1e-3


@pytest.mark.parametrize(("joints", "used"), [(1, False), (6, True)])
def test_saturation_is_used_if_several_joints_show_it(emitted, joints, used):
    """Saturation of friction with speed is fitted if all six joints of an arm show it, and not if one joint does.

    At a single joint, saturation may explain another error of the model.
    """
    module = emitted["six_dof"][0]
    true, found = drawn(module, seed=2, deviation=0.3), module.Model()
    true.friction.raw_saturation.data[:joints] += 1.0
    true.friction.raw_saturation.data[joints:] = NEGLIGIBLE
    fit_torque(found, [recorded(true, 20.0, 0.02)])
    assert (found.friction.raw_saturation.exp() > 1e-12).any() == used


def test_compensation_belongs_to_the_input(emitted):
    """Friction compensation k qd of a drive is added to the input torque; `friction_torque` does not change.

    `inverse_dynamics` returns a torque that is smaller by k qd, and `forward_dynamics` and `port_hamiltonian_rhs` add
    k qd to the torque that they get.
    """
    model = drawn(emitted["six_dof"][0], seed=2)
    q, qd, qdd = (torch.rand(5, 6, dtype=torch.float64) for _ in range(3))
    tau, friction = model.inverse_dynamics(q, qd, qdd), model.friction_torque(q, qd)
    model.raw_friction_compensation += 3.0
    added = 3.0 * model.friction.nominal / model.friction.speed * qd
    torch.testing.assert_close(model.inverse_dynamics(q, qd, qdd), tau - added)
    torch.testing.assert_close(model.forward_dynamics(q, qd, tau - added), qdd)
    torch.testing.assert_close(model.friction_torque(q, qd), friction)
    p, prepared = model.momentum(q, qd), model.prepare()
    (_, driven), (_, free) = (model.port_hamiltonian_rhs(q, p, x, prepared) for x in (0 * tau, None))
    torch.testing.assert_close(driven - free, added - model.input_matrix(q) @ model.torque_offset)


def test_slow_logs_get_a_note_on_undetermined_inertia(emitted):
    module = emitted["six_dof"][0]
    true = drawn(module, seed=2, deviation=0.2)
    codes = {}
    for name, pace in (("quick", 1.0), ("slow", 0.02)):
        motion = smooth_motion(6, 8.0 / pace, np.random.default_rng(1))
        q, qd, qdd = (x[:: round(1 / pace)] * pace**order for order, x in enumerate(motion))
        with torch.no_grad():
            tau = true.inverse_dynamics(*(torch.from_numpy(x) for x in (q, qd, qdd))).numpy()
        tau = tau + 0.05 * tau.std(0) * np.random.default_rng(0).normal(size=tau.shape)
        samples, found = TorqueSamples.of([DynamicsSamples(name, q, qd, qdd, tau)]), module.Model()
        fit = fit_torque(found, samples)
        codes[name] = {note.code for note in torque_notes(found, samples, fit)}
    assert codes["quick"] == {"urdf-prior"}
    assert codes["slow"] == {"urdf-prior", "inertia-undetermined", "acceleration-unseen"}


@pytest.fixture(scope="module")
def at_once(emitted):
    """Return samples, the model that was fitted to all of them at once, and the result of the fit."""
    module = emitted["rpr"][0]
    samples = [recorded(drawn(module, seed=2, deviation=0.3), 3.0, 0.05, seed=seed) for seed in range(3)]
    whole = module.Model()
    return samples, whole, fit_torque(whole, samples)


def test_a_fit_in_blocks_of_samples_equals_a_fit_at_once(emitted, at_once, monkeypatch):
    """A fit in blocks of samples, the last of which is smaller, equals the fit to all samples at once."""
    (samples, whole, expected), parts = at_once, emitted["rpr"][0].Model()
    monkeypatch.setattr(torque_jacobian, "TUNING", TorqueTuning(block=64))
    table = TorqueSamples.of(iter(samples), 2)
    assert (table.count, table.original_count, len(list(table.blocks(64)))) == (450, 900, 8)
    found = fit_torque(parts, table)
    assert found.steps == expected.steps
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    np.testing.assert_allclose(found.rms_residual, expected.rms_residual, rtol=1e-9)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(parts.state_dict()[name], value, rtol=1e-6, atol=1e-8)


def test_joints_that_follow_others_are_fitted(emitted):
    module = emitted["followed"][0]
    true, found = drawn(module, seed=2, deviation=0.3), module.Model()
    start = nmse(found, recorded(true, 10.0, 0.0, seed=9))
    fit_torque(found, [recorded(true, 6.0, 0.02, seed=1)])
    assert nmse(found, recorded(true, 10.0, 0.0, seed=9)) < min(2e-3, 0.02 * start)


def write(path, samples, arm):
    """Write samples at 100 Hz as a log of an arm."""
    names = [coordinate.name for coordinate in arm.coordinates]
    written = [
        Trajectory(0.01 * np.arange(len(x.q)), x.q, x.qd, x.tau, f"known {k}") for k, x in enumerate(samples)
    ]
    write_logs(path, written, names)


@pytest.fixture(scope="module")
def run(emitted, robots, tmp_path_factory):
    """Return the folder of a `spelgen train` run, the model of its logs, and the arguments of the command.

    The run is in the subfolder `run`. It has a closed-form module of two_link, fitted to two logs of 5 s whose torques
    are from a model with other parameters.
    """
    folder = tmp_path_factory.mktemp("closed_form_run")
    module, arm = emitted["two_link"]
    true = drawn(module, seed=4, deviation=0.2)
    logs = [recorded(true, 5.0, 0.01, seed=seed) for seed in range(2)]
    write(folder / "logs.parquet", logs, arm)
    robot = str(robots / "two_link.urdf")
    build_ = ["build", robot, "--preset", "closed-form", "-o", str(folder / "arm.py")]
    fitting = ["train", str(folder / "arm.py"), "--robot", robot, "--data", str(folder / "logs.parquet")]
    fitting += ["-o", str(folder / "run"), "--set", "progress=false"]
    for command in (build_, fitting):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
    return folder, true, fitting


def test_train_fits_torques_and_leaves_a_run(run, emitted):
    folder, true, _ = run
    model = emitted["two_link"][0].Model()
    model.load_state_dict(torch.load(folder / "run" / "model.pt", weights_only=True))
    fresh = recorded(true, 5.0, 0.0, seed=8)
    assert nmse(model, fresh) < 0.2 * nmse(
        emitted["two_link"][0].Model(), fresh
    )  # the residual is not zero, as filtered friction differs from friction of the filtered motion
    write(folder / "test.parquet", [recorded(true, 1.2, 0.01, seed=8)], emitted["two_link"][1])
    judging = ["evaluate", str(folder / "run"), "--data", str(folder / "test.parquet"), "--quick"]
    done = CliRunner().invoke(app, judging)
    assert done.exit_code == 0, done.output
    result = json.loads((folder / "run" / "evaluation.json").read_text(encoding="utf-8"))
    assert result["torque"]["model"]["mean_nmse"] < 5e-3
    assert CliRunner().invoke(app, ["report", str(folder / "run")]).exit_code == 0


def test_a_run_is_adapted_to_a_load(run, emitted, tmp_path):
    folder, true, _ = run
    module, arm = emitted["two_link"]
    loaded = module.Model()
    loaded.load_state_dict(true.state_dict())
    loaded.get_parameter(BODIES).data[-1, 9] += 1.0  # the load adds mass and first moment to the last body
    loaded.get_parameter(BODIES).data[-1, 6] += 0.5
    seen = recorded(loaded, 5.0, 0.01, seed=3)
    write(tmp_path / "loaded.parquet", [seen], arm)
    command = ["train", "--from", str(folder / "run"), "--data", str(tmp_path / "loaded.parquet")]
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "adapted"), "--set", "progress=false"])
    assert done.exit_code == 0, done.output
    before, after = (
        torch.load(x / "model.pt", weights_only=True) for x in (folder / "run", tmp_path / "adapted")
    )
    assert {name for name in before if not torch.equal(before[name], after[name])} == {BODIES}
    assert torch.equal(before[BODIES][:-1], after[BODIES][:-1])
    errors = []
    for state in (before, after):
        model = module.Model()
        model.load_state_dict(state)
        errors.append(nmse(model, recorded(loaded, 5.0, 0.0, seed=6)))
    assert errors[1] < 0.3 * errors[0]


def sparse(model):
    """Return logs of a model's motion at 20 Hz, a rate too low to compute accelerations."""
    samples = (recorded(model, 5.0, 0.0, seed=seed) for seed in range(2))
    return [
        Trajectory(0.05 * np.arange(100), *(getattr(x, k)[:500:5] for k in ("q", "qd", "tau")))
        for x in samples
    ]


def test_logs_too_slow_for_accelerations_are_fitted_by_windows(emitted, robots):
    model = load_module(generate(robots / "rpr.urdf", preset="closed-form"))
    logs = sparse(drawn(emitted["rpr"][0], seed=0))
    found = fit(model, logs, Rollout(epochs=1, momentum_steps=0, urdf_weight=0.0))
    assert [note.code for note in found.diagnostics].count("no-torque-fit") == 1
    assert default_objective(model, lambda: [20.0]) == "rollout"
    assert default_objective(model, lambda: [20.0, 100.0]) == "torque"
    for adapt, what in ((None, "to fit torques to"), ("load", "to adapt to")):
        with pytest.raises(LogError, match=f"no motion {what}, expected samples at 24 Hz or more that move"):
            fit(model, logs, TorqueFit(adapt=adapt))


@pytest.mark.parametrize("adapt", ["friction", "unit"])
def test_a_run_is_adapted_to_another_day_or_unit(run, emitted, tmp_path, adapt):
    """A run is adapted to logs of another day (friction and offsets), or of another unit of the robot (bodies, too).

    Adaptation to another day keeps the bodies.
    """
    folder, true, _ = run
    module, arm = emitted["two_link"]
    other = module.Model()
    other.load_state_dict(true.state_dict())
    other.get_parameter("friction.raw_coulomb").data += 0.4
    other.get_parameter("friction.raw_viscous").data -= 0.3
    other.get_parameter("raw_offset").data += torch.tensor([0.2, -0.1]).double()
    if adapt == "unit":
        other.get_parameter(BODIES).data[:, 9] += 0.1
    write(tmp_path / "other.parquet", [recorded(other, 15.0, 0.01, seed=3)], arm)
    command = [
        "train",
        "--from",
        str(folder / "run"),
        "--data",
        str(tmp_path / "other.parquet"),
        "--set",
        f"adapt={adapt}",
    ]
    done = CliRunner().invoke(app, [*command, "-o", str(tmp_path / "adapted"), "--set", "progress=false"])
    assert done.exit_code == 0, done.output
    before, after = (
        torch.load(x / "model.pt", weights_only=True) for x in (folder / "run", tmp_path / "adapted")
    )
    moved = {name for name in before if not torch.equal(before[name], after[name])}
    of_friction = ("friction.", "raw_offset")
    assert moved and (adapt == "unit" or all(name.startswith(of_friction) for name in moved))
    assert (BODIES in moved) == (adapt == "unit")
    errors = []
    for state in (before, after):
        model = module.Model()
        model.load_state_dict(state)
        errors.append(nmse(model, recorded(other, 5.0, 0.0, seed=6)))
    assert errors[1] < 0.1 * errors[0]


def test_a_part_of_a_model_of_networks_is_adapted(robots, run, emitted):
    _, true, _ = run
    samples = [recorded(true, 2.0, 0.01, seed=3)]
    for adapt, part in (
        ("friction", "friction."),
        ("load", ("mass.", "potential.")),
    ):
        model = build(robots / "two_link.urdf", "spel", width=8)
        before = {name: x.clone() for name, x in model.state_dict().items()}
        missed = nmse(model, samples[0])
        adapt_networks(model, TorqueSamples.of(samples), adapt, evaluations=40)
        moved = {name for name, x in model.state_dict().items() if not torch.equal(x, before[name])}
        assert moved and all(name.startswith(part) for name in moved)
        assert nmse(model, samples[0]) < missed
        assert all(x.requires_grad for x in model.parameters())


def test_adapt_belongs_to_a_run_and_to_torques(run, tmp_path):
    folder, _, fitting = run
    for command, message in (
        ([*fitting, "--set", "adapt=unit"], "--set adapt: belongs to --from"),
        (
            [
                "train",
                "--from",
                str(folder / "run"),
                *fitting[2:4],
                "--set",
                "adapt=unit",
                "--objective",
                "rollout",
            ],
            "--set adapt: belongs to the objective torque, this fits rollout",
        ),
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 2
        assert message in done.output


def test_the_same_logs_give_the_same_weights(run, tmp_path):
    folder, _, fitting = run
    again = [*fitting[:-4], "-o", str(tmp_path / "again"), "--set", "progress=false"]
    assert CliRunner().invoke(app, again).exit_code == 0
    first, second = (
        torch.load(x / "model.pt", weights_only=True) for x in (folder / "run", tmp_path / "again")
    )
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_characters(shared, tmp_path):
    source = generate(write_arm(tmp_path), preset="closed-form")
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
    source = generate(folder / "ur10e.urdf", preset="closed-form")
    model = import_source(source, tmp_path / "ur10e_closed_form.py").Model()
    names = [coordinate.name for coordinate in load_arm(folder / "ur10e.urdf").chain.coordinates]
    (long,) = read_logs([folder / "20_02_10_30sec_12harm.parquet"], names)
    fit_torque(model, dynamics_samples([long[: int(np.searchsorted(long.t, long.t[0] + 2.0))]]))
    tests = ("19_12_23_free", "20_02_06_20sec_5harm")
    samples = dynamics_samples([read_logs([folder / f"{x}.parquet"], names)[0] for x in tests], pauses=True)
    # For comparison: with the best of several simpler priors in place of the prior of `fit_torque`, the mean nMSE over
    # nine test recordings was 0.057.
    assert np.mean([nmse(model, sample) for sample in samples]) < 0.03


def test_a_subset_of_many_samples_is_fitted_first(emitted, monkeypatch):
    """A fit that begins with a subset of many samples ends at the result of a fit to all samples throughout."""
    module = emitted["six_dof"][0]
    samples = [recorded(drawn(module, seed=2, deviation=0.3), 6.0, 0.05, seed=seed) for seed in range(3)]
    plain, quick = module.Model(), module.Model()
    expected = fit_torque(plain, samples)
    monkeypatch.setattr(torque_fit, "TUNING", TorqueTuning(initial_samples=200))
    found = fit_torque(quick, samples)
    assert found.steps != expected.steps
    # the costs differ because noise and correlation time are estimated separately in both fits
    np.testing.assert_allclose(found.correlation_time, expected.correlation_time, rtol=0.1)
    assert found.cost == pytest.approx(expected.cost, rel=0.03)
    np.testing.assert_allclose(found.rms_residual, expected.rms_residual, rtol=1e-3)
    few = TorqueSamples.of(samples, 2).subsampled(300)
    assert (few.count, len(next(few.blocks(1000))[0])) == (300, 300)


def test_negligible_friction_does_not_vary_with_position(robots):
    """Friction that varies with position is selected only if friction itself is not negligible.

    A position-dependent residual of 0.3 Nm is selected with friction of 1 Nm, and not with friction of 1e-9 Nm.
    """
    t = torch.linspace(0, 60, 1200).double()[:, None] * torch.tensor([1.1, 1.7])
    noise = 0.01 * torch.randn(t.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q, qd = t.sin(), t.cos()
    missing = 0.3 * (3 * q).sin() * qd.sign() + noise
    for friction, gain in ((1.0, 0.9), (1e-9, None)):
        model = build(robots / "two_link.urdf", "hybrid")
        samples = ResidualSamples(q, qd, 0 * q, missing, friction * qd.sign())
        still = (torch.zeros(0, 0).double(),) * 2
        bodies = RigidProjection((torch.zeros(len(q), 0).double(),) * 2, still)
        lengths, recordings, std = torch.full((2,), 5.0), torch.zeros(len(q)).long(), torch.full((2,), 1.0)
        found = select_functions(model, samples, bodies, [], lengths, recordings, std)
        varied = [x.error_reduction for x in found if x.name == FRICTION]
        assert varied == [] if gain is None else min(varied) > gain and len(varied) == 2


def test_a_spring_that_bodies_could_absorb_is_found(emitted, robots):
    """A spring is found although rigid bodies can explain much of the spring's torque in few logs.

    In the test log, the bodies fitted without a spring do not predict this torque.
    """
    true, joint = drawn(emitted["six_dof"][0], seed=3, deviation=0.3), 4
    stiffness = 2 * recorded(true, 3.0, 0.0).tau[:, joint].std()

    def sprung(seconds, seed):
        sample = recorded(true, seconds, 0.01, seed)
        tau = sample.tau.copy()
        tau[:, joint] += stiffness * sample.q[:, joint]
        return replace(sample, tau=tau)

    logs, test = [sprung(3.0, seed=0), sprung(3.0, seed=1)], sprung(10.0, seed=9)
    bodies = build(robots / "six_dof.urdf", "closed-form")
    fit_torque(bodies, logs)
    model = build(robots / "six_dof.urdf", "hybrid", width=8)
    model.residuals.potential = model.residuals.mass = None
    solution = fit_torque(model, logs)
    assert {residual.joint for residual in solution.selected_terms} == {joint}
    assert nmse(model, test) < 1e-3
    assert nmse(bodies, test) > 0.05


def test_bodies_absorb_no_more_than_a_torque(emitted):
    """No eigenvalue of the projection of a joint's torque onto the rigid-body parameters is larger than 1.

    The projection uses the posterior covariance for the current noise. The covariance for a larger noise would be too
    large, and the rigid bodies would absorb more than the torque.
    """
    model = emitted["two_link"][0].Model()
    samples = TorqueSamples.of([recorded(model, 6.0, 0.05)])
    jacobian = TorqueJacobian(model, samples)
    estimate = initial_fit(TorqueProblem.of(jacobian, GaussianPrior()))
    noise = NoiseEstimator.of(jacobian, estimate.problem.correlation_time).estimate(
        0.5 * estimate.state.residual
    )
    estimate = replace(estimate, problem=replace(estimate.problem, noise=noise)).with_current_covariance()
    _, projection = estimate.linearize()
    for joint, slope in enumerate(projection.jacobian):
        followed = torch.linalg.eigvals(projection.posterior_gain[joint] @ slope.mT @ slope)
        assert 0.9 < followed.real.max() < 1 + 1e-9


def test_a_spring_as_strong_as_gravity_does_not_drive_bodies_away(emitted, robots):
    """A spring as strong as gravity does not leave the bodies at wrong values.

    The initial fit has no spring, and explains its torque by wrong masses. Later fits must correct the masses.
    """
    true = drawn(emitted["two_link"][0], seed=4, deviation=0.3)
    stiffness = recorded(true, 5.0, 0.0).tau[:, 0].std()

    def sprung(noise, seed):
        sample = recorded(true, 10.0, noise, seed)
        return replace(sample, tau=sample.tau + stiffness * (sample.q[:, :1] + 0.3) * [1, 0])

    model = build(robots / "two_link.urdf", "hybrid", width=8)
    model.residuals.potential = model.residuals.mass = None
    solution = fit_torque(model, [sprung(0.01, seed=0), sprung(0.01, seed=1)])
    assert {residual.joint for residual in solution.selected_terms} == {0}
    assert nmse(model, sprung(0.0, seed=9)) < 1e-4


def test_nominal_friction_is_limited_to_the_torque(emitted, robots):
    """Nominal friction is limited to the measured torque, if the effort limits of the URDF are much too large.

    Here they are placeholders, a million times the torques of the arm.
    """
    true = drawn(emitted["two_link"][0], seed=3, deviation=0.3)
    model = build(robots / "two_link.urdf", "closed-form")
    model.friction.nominal *= 1e6
    fit_torque(model, [recorded(true, 20.0, 0.02)])
    assert nmse(model, recorded(true, 20.0, 0.0, seed=9)) < 1e-4


def test_a_joint_that_stands_still_keeps_its_friction(robots):
    """A joint that rests in all samples keeps its nominal friction, which is right here.

    `limit_friction` limits the nominal friction of moving joints to the standard deviation of their torque. At rest the
    torque varies only by noise, which has no information on friction.
    """
    true, model = (build(robots / "scara.urdf", "closed-form") for _ in range(2))
    sample = recorded(true, 10.0, 0.0)
    q, qd, qdd = (column * [1.0, 1.0, 0.0, 1.0] for column in (sample.q, sample.qd, sample.qdd))
    with torch.no_grad():
        tau = true.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd))).numpy()
    tau += 0.01 * np.random.default_rng(0).normal(size=tau.shape)
    fit_torque(model, [DynamicsSamples("held", q, qd, qdd, tau)])
    assert nmse(model, recorded(true, 10.0, 0.0, seed=9)) < 1e-3


def test_a_model_states_its_residual_terms(robots):
    assert terms_in_use(build(robots / "rpr.urdf", "closed-form")) == []
    model = build(robots / "rpr.urdf", "hybrid", width=8)
    assert terms_in_use(model) == []
    with torch.no_grad():
        model.residuals.raw_torque_splines[1, 3] = 1.0
        model.residuals.raw_constants += 0.1
    assert terms_in_use(model) == ["a torque by position (spring, cable) at joint2", "networks in M"]


def test_functions_of_a_joint_and_bodies_are_fitted_together(emitted, robots):
    """Rigid bodies are accurate although friction depends on position, torques ripple, and a spring resembles gravity.

    Bodies and residual terms are fitted together. Fitted one after the other, each would absorb torque of the others.
    """
    true = drawn(emitted["six_dof"][0], seed=3, deviation=0.3)
    scale = recorded(true, 20.0, 0.0).tau.std(axis=0)

    def moved(noise, seed):
        sample = recorded(true, 10.0, noise, seed)
        q, qd = torch.from_numpy(sample.q), torch.from_numpy(sample.qd)
        with torch.no_grad():
            friction = true.friction_torque(q, qd).numpy()
        tau = sample.tau + 0.5 * np.sin(sample.q + 0.7) * friction + 0.1 * scale * np.sin(30 * sample.q)
        tau[:, 1] += scale[1] * np.sin(sample.q[:, 1] - 0.4)
        return replace(sample, tau=tau)

    model = build(robots / "six_dof.urdf", "hybrid", width=8)
    model.residuals.potential = model.residuals.mass = None
    fit_torque(model, [moved(0.02, seed=0), moved(0.02, seed=1)])
    test = moved(0.0, seed=9)
    assert nmse(model, test) < 1e-3
    q = torch.from_numpy(test.q)
    with torch.no_grad():
        expected, found = true.mass_matrix(q), model.mass_matrix(q)
    assert (found - expected).norm() < 0.01 * expected.norm()
