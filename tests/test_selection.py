"""Selection of residual terms and friction effects, noise estimates and errors in reports.

Each test fails without the criterion or the formula that it names.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from spelgen.arm.configured_arm import load_arm
from spelgen.emission.build import build
from spelgen.evaluation.horizons import end_errors
from spelgen.exporting.mjcf_export import mjcf_text
from spelgen.exporting.rigid_body_projection import rigid_body_projection
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.momentum_objective import MomentumObjective
from spelgen.fitting.servo import laws
from spelgen.fitting.servo.parameters import ServoParameters
from spelgen.fitting.torque import jacobian as torque_jacobian
from spelgen.fitting.torque import joint_functions, networks, selection, stages
from spelgen.fitting.torque import objective as torque_objective
from spelgen.fitting.torque import problem as torque_problem
from spelgen.fitting.torque.jacobian import ResidualSamples
from spelgen.fitting.torque.linearization import append_target, bayesian_ridge
from spelgen.fitting.torque.objective import fit_torques
from spelgen.fitting.torque.selection import select_functions
from spelgen.fitting.urdf_regularizer import UrdfRegularizer
from spelgen.identification.least_squares import deviations
from spelgen.logs.windows import Windows
from spelgen.settings.fits import Rollout, TorqueFit


class Alone:
    """Projection of a model whose rigid bodies and friction can absorb no added torque."""

    @staticmethod
    def orthogonalize(joint, torque):
        return torque


ALONE = Alone()


@pytest.fixture
def hybrid(robots):
    """Return a hybrid model with functions of single joints and without networks, which would take longer to fit."""
    model = build(robots / "two_link.urdf", "hybrid", width=8)
    model.residuals.potential = model.residuals.mass = None
    return model


def samples(missing: torch.Tensor, q: torch.Tensor) -> ResidualSamples:
    still = torch.zeros_like(q)
    return ResidualSamples(q, still, still, missing, torch.ones_like(q))


def data(correlation_length: float, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return correlation lengths (2,), recording numbers (count,) and torque standard deviations (2,) for two joints.

    The correlation length [samples] and the standard deviation, 4 Nm, are equal for both joints. All samples are of
    recording 0.
    """
    return torch.full((2,), correlation_length), torch.zeros(count).long(), torch.full((2,), 4.0).double()


def test_a_function_is_selected_by_held_out_blocks(hybrid):
    """A function of q is selected only if it lowers the torque residual in blocks that were held out of its fit.

    The residual here is a random constant in each of ten blocks. Joint 1 moves through its range once, so each block
    has its own q: a function of q explains the residual of the fitted blocks, but not of others. None is selected.
    """
    levels = torch.randn(10, 1, generator=torch.Generator().manual_seed(3)).double()
    missing = levels.repeat_interleave(200, dim=0) * torch.tensor([[1.0, 0.0]]).double()
    q = torch.stack([torch.linspace(-2, 2, 2000), torch.zeros(2000)], dim=1).double()
    # a function of q explains nearly all of the residual where it is fitted, and nothing in held-out blocks
    assert select_functions(hybrid, samples(missing, q), ALONE, [], *data(1.0, len(q))) == []


def test_samples_next_to_a_held_out_block_are_not_fitted(hybrid):
    """Held-out blocks have gaps on both sides: a residual that is constant across their borders selects no function.

    Otherwise the half of a constant segment on one side of a border would predict the half on the other side.
    """
    levels = torch.randn(11, 1, generator=torch.Generator().manual_seed(3)).double()
    missing = levels.repeat_interleave(200, dim=0)[100:2100] * torch.tensor([[1.0, 0.0]]).double()
    q = torch.stack([torch.linspace(-2, 2, 2000), torch.zeros(2000)], dim=1).double()
    missed = samples(missing, q)
    spline = next(joint_functions.joint_functions(hybrid, missed, ALONE))
    errors, _ = selection._cross_validate(spline, missing[:, 0], 40.0, torch.zeros(2000).long())
    assert errors.square().sum() > missing.square().sum()
    assert select_functions(hybrid, missed, ALONE, [], *data(40.0, len(q))) == []


def test_a_function_must_lower_the_error_of_the_last_half(hybrid):
    """A function that is fitted to the first half must also lower the error in the last half.

    The residual torque of joint 1 is sin(q) in the first half. In the last half it has another amplitude a: a * sin(q).
    The fitted function, sin(q), changes the relative squared error of the last half from a^2 to (1 - a)^2. This is
    larger for a = 0.45 (not selected) and smaller for a = 0.75 (selected).
    """
    t = torch.linspace(0, 200, 4000).double()
    q = torch.stack([torch.sin(t), torch.zeros_like(t)], dim=1)
    missing = torch.stack([torch.sin(q[:, 0]), torch.zeros_like(t)], dim=1)
    for later, selected in ((0.45, 0), (0.75, 1)):
        missing[2000:] = later * torch.sin(q[2000:])
        found = select_functions(hybrid, samples(missing, q), ALONE, [], *data(1.0, len(q)))
        assert len(found) == selected


def test_the_last_half_counts_only_within_the_range_of_the_first(hybrid):
    """A function that is fitted to the first half is not evaluated at positions that only the last half has.

    Splines extrapolate badly there, which is no evidence against the function.
    """
    t = torch.linspace(0, 100, 4000).double()
    early, late = 1.0 + 0.7 * torch.sin(t[:2000]), -0.7 + 1.2 * torch.sin(t[2000:])
    q = torch.stack([torch.cat([early, late]), torch.zeros_like(t)], dim=1)
    torque = torch.stack([q[:, 0].square(), torch.zeros_like(t)], dim=1)
    noise = 0.02 * torch.randn(4000, 2, generator=torch.Generator().manual_seed(0)).double()
    missed = samples(torque + noise, q)
    spline = next(joint_functions.joint_functions(hybrid, missed, ALONE))
    first, last = selection.split_halves(4000, 1.0)
    weights = spline.fit(missed.torque_residual[:, 0], 1.0, first).coef
    error = missed.torque_residual[last, 0] - spline.torque(weights, last)
    assert error.square().sum() > missed.torque_residual[last, 0].square().sum()
    selected = select_functions(hybrid, missed, ALONE, [], *data(1.0, len(q)))
    assert [(residual.name, residual.joint) for residual in selected] == [("raw_torque_splines", 0)]


def test_an_error_reduction_in_one_of_ten_blocks_is_not_significant(hybrid):
    t = torch.linspace(0, 200, 4000).double()
    q = torch.stack([torch.sin(t), torch.zeros_like(t)], dim=1)
    everywhere = torch.stack([torch.sin(q[:, 0]), torch.zeros_like(t)], dim=1)
    noise = torch.randn(4000, 2, generator=torch.Generator().manual_seed(0)).double()
    noise[:, 1] = 0.0
    found = select_functions(hybrid, samples(everywhere + 0.1 * noise, q), ALONE, [], *data(1.0, len(q)))
    # joint 1: only the best of several functions is selected; joint 2 has no residual and gets no function
    assert [(residual.name, residual.joint) for residual in found] == [("raw_torque_splines", 0)]
    # the same torque in only one of ten blocks is not selected: it lowers the held-out error of one block at most
    once = everywhere * (torch.arange(4000) < 400).unsqueeze(-1)
    assert select_functions(hybrid, samples(0.3 * once + noise, q), ALONE, [], *data(1.0, len(q))) == []


def test_a_block_without_torque_does_not_prevent_selection():
    """A block at rest without torque does not prevent the selection of a function.

    The function has a small error in this block, where the error without the function is zero.
    """
    squares, missed = torch.full((10,), 100.0), torch.full((10,), 10.0)
    squares[3], missed[3] = 0.0, 1e-9
    # g = (before - after) / (before + after) is 90 / 110 in nine blocks and 0 in the block at rest; its mean, 0.74, is
    # equivalent to the error reduction 2 g / (1 + g) = 0.85 of all blocks
    assert selection.significant_reduction(squares, missed) == pytest.approx(0.85, abs=0.01)


def test_a_block_beyond_the_range_of_others_does_not_prevent_selection():
    """A block beyond the range of all others does not prevent the selection, although splines extrapolate badly."""
    squares, missed = torch.full((10,), 50.0), torch.full((10,), 1.0)
    squares[0], missed[0] = 400.0, 2e6
    assert selection.significant_reduction(squares, missed) > 0.8


def test_a_network_is_fitted_to_the_residual_of_functions_of_joints(robots, monkeypatch):
    """Networks are fitted to the residual after functions of single joints, not to the whole residual."""
    model = build(robots / "two_link.urdf", "hybrid", width=8)
    torch.nn.init.constant_(model.residuals.raw_torque_splines, 3.0)
    left = []

    def fitted(model, network, samples, *_):
        left.append(networks._remaining_residual(model, samples))
        return 0.5

    monkeypatch.setattr(networks, "_fit_network", fitted)
    q = torch.linspace(-1, 1, 2000).double().unsqueeze(-1).expand(-1, 2)
    assert len(list(networks.select_networks(model, samples(q.sin(), q), 1.0))) == 2
    for missing in left:
        torch.testing.assert_close(missing, q.sin())


def test_an_error_reduction_must_exceed_its_scatter():
    squares = torch.ones(10).double()
    steady = torch.full((10,), 0.9).double()
    assert selection.significant_reduction(squares, steady + 0.001 * torch.arange(10)) == pytest.approx(
        0.0955, rel=2e-3
    )
    # a reduction by 0.01 % is significant, but too small for any term
    assert selection.significant_reduction(squares, 0.9999 * squares) is None
    lucky = torch.tensor([0.1] + [1.0] * 9).double()
    assert selection.significant_reduction(squares, lucky) is None


def test_repeated_samples_count_once():
    """Repeated samples with equal errors are counted once by the Bayesian ridge regression.

    Twenty copies of each sample, with a correlation length of 20, give the estimate of one copy.
    """
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(300, 4, generator=draw).double()
    y = x @ torch.tensor([0.1, 0.0, -0.2, 0.3]).double() + torch.randn(300, generator=draw).double()
    groups = torch.zeros(4)

    def weights(times: int) -> torch.Tensor:
        rows = append_target(x, y).repeat_interleave(times, dim=0)
        return bayesian_ridge(rows.mT @ rows, len(rows), groups, float(times)).coef

    torch.testing.assert_close(weights(20), weights(1), rtol=1e-6, atol=1e-9)
    assert (
        weights(1) - torch.linalg.lstsq(x, y).solution
    ).abs().max() > 1e-3  # the prior shrinks the estimate, which is therefore not the least-squares solution


def test_bayesian_ridge_maximizes_the_marginal_likelihood():
    """Hyperparameters of the Bayesian ridge regression are a numerical maximum of the marginal likelihood.

    There are two groups of parameters, one of which has no effect.
    """
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2000, 12))
    y = x[:, :6] @ rng.normal(scale=0.3, size=6) + 0.5 * rng.normal(size=2000)
    groups = torch.tensor([0] * 6 + [1] * 6)
    rows = append_target(torch.from_numpy(x), torch.from_numpy(y))
    found = bayesian_ridge(rows.mT @ rows, len(rows), groups, 1.0)

    def minus_log_evidence(logarithms: np.ndarray) -> float:
        alpha, *precisions = np.exp(logarithms)
        prior = np.repeat(precisions, 6)
        hessian = alpha * x.T @ x + np.diag(prior)
        coef = alpha * np.linalg.solve(hessian, x.T @ y)
        energy = alpha * np.square(y - x @ coef).sum() + prior @ np.square(coef)
        likelihood = len(y) * np.log(alpha) + np.log(prior).sum() - np.linalg.slogdet(hessian)[1]
        return float(energy - likelihood) / 2

    best = minimize(minus_log_evidence, np.zeros(3), method="Nelder-Mead", options={"maxiter": 2000})
    assert found.converged and found.n_iter > 1
    assert found.alpha == pytest.approx(np.exp(best.x[0]), rel=0.01)
    assert float(found.lambda_[0]) == pytest.approx(np.exp(best.x[1]), rel=0.01)
    # for the group without effect only a lower bound of the precision is known, as its coefficients are near zero
    assert found.gamma[0] > 5.9 and found.gamma[1] < 2.0
    expected = np.linalg.solve(x.T @ x + np.diag(found.penalty.numpy()), x.T @ y)
    np.testing.assert_allclose(found.coef.numpy(), expected, rtol=1e-9)


def test_intervals_of_correlated_errors_are_wider():
    """Correlated errors count with a larger standard deviation: sqrt(10) times, if each error lasts ten samples."""
    white = np.random.default_rng(0).normal(size=(4000, 2))
    lasting = white.repeat(10, axis=0)
    np.testing.assert_allclose(deviations([white], 2), 1.0, rtol=0.15)
    np.testing.assert_allclose(deviations([lasting], 2), np.sqrt(10), rtol=0.15)


@pytest.mark.parametrize("correlation", [1.0, 5.0])
def test_the_first_noise_is_that_of_least_squares(correlation):
    """The initial noise of a joint is s, with s^2 = c RSS / (T - c p) of a least-squares fit to its torques.

    RSS: sum of squared residuals of T samples. p: number of parameters that affect the joint, 3 for joint 1 and 0 for
    joint 2. correlation: c, number of correlated samples that count as one independent error.
    """
    draw = torch.Generator().manual_seed(0)
    count, deviations = 400, torch.tensor([0.5, 0.01]).double()
    x = torch.randn(count, 3, generator=draw).double()
    measured = deviations * torch.randn(count, 2, generator=draw).double()
    # this part of the torque is a multiple of a regressor column, so it does not count as noise
    measured[:, 0] += 7.0 * x[:, 1]
    jacobian = object.__new__(torque_jacobian.TorqueJacobian)
    slopes = ((0, torch.arange(3), x, measured[:, 0]), (1, torch.arange(0), x[:, :0], measured[:, 1]))
    jacobian.joint_rows = lambda _: slopes
    jacobian.torque_std = torch.ones(2).double()
    jacobian.samples = SimpleNamespace(count=count, interval=0.02)
    jacobian.rigid = SimpleNamespace(free_mask=lambda *_: torch.ones(3, dtype=torch.bool))
    time = torch.full((2,), 0.02 * correlation).double()
    problem = torque_problem.TorqueProblem(jacobian, torch.ones(2), None, None, torch.zeros(2), time)
    problem = problem.with_least_squares_noise(torch.zeros(3).double())
    solution = torch.linalg.lstsq(x, measured[:, :1]).solution
    missed = [(measured[:, 0] - (x @ solution)[:, 0]).square().sum(), measured[:, 1].square().sum()]
    expected = torch.stack(missed) / (count - correlation * torch.tensor([3.0, 0.0]).double())
    torch.testing.assert_close(problem.noise, (correlation * expected).sqrt(), rtol=1e-6, atol=0)


def test_a_dead_zone_of_a_servo_must_be_significant(monkeypatch):
    """A dead zone is selected if it lowers the cost significantly: by 10, but not by 1, which happens by chance.

    The chance of a decrease by 1 is one in six.
    """
    without = ServoParameters(torch.ones(1, 1), torch.zeros(0), 0.0, torch.zeros(1, 1, dtype=torch.bool))
    problem = SimpleNamespace(parameters=SimpleNamespace(row=lambda name: 0), reweighted=lambda x: problem)
    with_zone = replace(without, joints=2 * torch.ones(1, 1))
    monkeypatch.setattr(laws, "with_dead_zones", lambda problem, x, fraction: with_zone)
    for gain, selected in ((1.0, False), (10.0, True)):
        costs = {without: torch.tensor([100.0]), with_zone: torch.tensor([100.0 - gain])}
        monkeypatch.setattr(laws, "_joint_minima", lambda problem, x, costs=costs: (x, costs[x]))
        assert bool(laws.select_dead_zones(problem, without).active.any()) == selected


def test_the_regularizer_towards_the_urdf_equals_its_definition(robots, monkeypatch):
    """The regularizer is `urdf_weight` times the sum of two mean squared differences between model and URDF.

    They are the differences of the variation M(q) - mean M, whitened with the URDF's mean M (here the identity), and of
    the gravity torque, divided by its RMS value (here 2 Nm). The URDF's variation and gravity torque are zero here.
    """
    draw = torch.Generator().manual_seed(0)
    mass = torch.randn(50, 2, 2, generator=draw).double()
    gravity = torch.randn(50, 2, generator=draw).double()
    regularizer = UrdfRegularizer(
        torch.zeros(50, 2), torch.eye(2).double(), torch.zeros(50, 2, 2).double(), torch.zeros(50, 2).double(),
        torch.full((2,), 2.0).double(),
    )  # fmt: skip
    model = SimpleNamespace(mass_matrix=lambda q: mass, gravity=lambda q: gravity)
    varied = (mass - mass.mean(dim=0)).numpy()
    expected = np.square(varied).sum() / 50 / 2 + np.square(gravity.numpy() / 2).mean()
    assert float(regularizer.loss(model)) == pytest.approx(expected)
    windows = SimpleNamespace(regularizer=regularizer, model=model, config=Rollout(urdf_weight=0.7))
    assert float(MomentumObjective.penalty(windows)) == pytest.approx(0.7 * expected)
    penalties = []

    def fit_networks(model, samples, decay, penalty, evaluations):
        penalties.append(float(penalty()))
        return 0

    monkeypatch.setattr(torque_objective, "fit_networks", fit_networks)
    networks = SimpleNamespace(mass_matrix=model.mass_matrix, gravity=model.gravity, named_modules=lambda: [])
    fit_torques(networks, SimpleNamespace(original_count=1, count=1), TorqueFit(urdf_weight=0.7), regularizer)
    assert penalties == [pytest.approx(0.7 * expected)]


def test_the_cost_of_a_torque_fit_has_the_prior_in_it():
    precision = torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double()
    prior = SimpleNamespace(mean=torch.tensor([1.0, 0.0]).double(), precision=precision)
    problem = SimpleNamespace(prior=prior, noise=torch.tensor([0.5, 2.0]).double())
    x, squares = torch.tensor([2.0, 3.0]).double(), torch.tensor([1.0, 8.0]).double()
    expected = (1.0 / 0.25 + 8.0 / 4.0 + (2.0 * 1 + 2 * 0.5 * 3 + 1.0 * 9)) / 2
    assert torque_problem.TorqueProblem.cost(problem, x, squares) == pytest.approx(expected)


def test_noise_is_at_most_the_largest_error():
    """The noise estimate limits the RMS residual of a joint to `max_error`, 2 Nm here.

    Joint 1 has 5 Nm, which becomes 2 Nm; joint 2 has 1 Nm. The results are then multiplied by sqrt(5), since 5
    correlated samples (the correlation length) count as one independent error.
    """
    columns = torch.tensor([[5.0, 5.0], [10.0, 10.0], [2.0, 2.0]]).double()
    estimator = torque_problem.NoiseEstimator(50, *columns)
    noise = estimator.estimate(50 * torch.tensor([25.0, 1.0]).double())
    torch.testing.assert_close(noise, 5**0.5 * torch.tensor([2.0, 1.0]).double())
    torch.testing.assert_close(estimator.upper_bound(), 5**0.5 * estimator.max_error)


def test_noise_is_estimated_per_joint():
    """The noise of a joint is proportional to the RMS residual of this joint, and independent of other joints."""
    estimator = torque_problem.NoiseEstimator(50, torch.full((2,), 5.0).double(), torch.ones(2).double())
    noise = [estimator.estimate(torch.tensor(x).double()) for x in ([2.0, 8.0], [20.0, 80.0])]
    torch.testing.assert_close(noise[0][1], 2 * noise[0][0])
    torch.testing.assert_close(noise[1], 10**0.5 * noise[0])


def test_noise_is_corrected_for_degrees_of_freedom():
    """The squared residual is divided by the degrees of freedom: independent errors minus parameters, at least 1.

    With 50 samples and a correlation length of 5 there are ten independent errors. The divisor is 10 without
    parameters, 6 for four parameters, and 1 for twenty parameters.
    """
    estimator, squares = (
        torque_problem.NoiseEstimator(50, torch.full((2,), 5.0).double(), torch.ones(2).double()),
        torch.tensor([2.0, 8.0]),
    )
    noise = [estimator.estimate(squares.double(), determined).square() for determined in (0.0, 4.0, 20.0)]
    torch.testing.assert_close(noise[1], noise[0] * 10 / 6)
    torch.testing.assert_close(noise[2], noise[0] * 10)


def test_no_step_of_a_servo_joint_raises_its_cost():
    """In a fit of servo parameters, a Levenberg-Marquardt step that raises the cost of a joint is rejected.

    The residual of each of two joints is arctan(10 x), with one parameter x per joint. From x = 0.3, a Gauss-Newton
    step goes far beyond the minimum x = 0.
    """
    seen = []

    def residual(x):
        seen.append(x.joints)
        return (10 * x.joints).atan()

    def normal_equations(x, errors):
        slope = 10 / (1 + (10 * x.joints).square()).flatten()
        return NormalEquations(torch.diag(slope.square()), -slope * errors.flatten())

    problem = SimpleNamespace(
        residual=residual,
        normal_equations=normal_equations,
        joint_costs=lambda x, errors: errors.square().sum(dim=0) / 2,
    )
    start = ServoParameters(
        torch.tensor([[0.3, 0.05]]).double(), torch.zeros(0), 0.0, torch.ones(1, 2, dtype=torch.bool)
    )
    found, costs = laws._joint_minima(problem, start)
    tried = (10 * torch.cat(seen)).atan().square() / 2
    assert (tried[1:] > tried[0]).any()  # steps that raise the cost were tried
    torch.testing.assert_close(costs, (10 * found.joints[0]).atan().square() / 2)
    assert (costs < 1e-3).all()


def test_friction_of_two_directions_is_their_mean_in_mujoco(robots):
    """MJCF has one friction loss per joint: the mean of the magnitudes in both directions.

    For friction of 1 Nm forward and 3 Nm backward, it is 2 Nm.
    """
    arm = load_arm(robots / "two_link.urdf")
    learned = rigid_body_projection(build(arm, "closed-form"), arm)
    friction = learned.friction._replace(forward=np.array([1.0, 0.5]), backward=np.array([-3.0, -0.5]))
    learned = replace(learned, friction=friction)
    text = mjcf_text(learned)[0].decode()
    assert re.findall(r'frictionloss="([^"]*)"', text) == ["2", "0.5"]


def test_the_tip_error_is_radius_times_angle_error():
    """The tip error of a joint angle error of 0.003 rad at a radius of 2 m is 6 mm."""
    q = torch.zeros(4, 3, 1).double()
    windows = Windows(torch.full((4, 2), 0.01).double(), q, q, torch.zeros(4, 2, 1).double())
    predicted = torch.full((4, 2, 1), 0.003).double()

    def tip(angle: torch.Tensor) -> torch.Tensor:
        return 2.0 * torch.cat([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)

    errors = end_errors((predicted, predicted), windows, ["revolute"], tip)
    assert errors.tip_mm == pytest.approx(6.0, rel=1e-5)


@pytest.mark.parametrize(
    ("evidence", "ratios", "rejected"),
    [
        ((-1.0, -20.0), (1.0, 1.0), [True, True]),
        ((-1.0, 20.0), (1.0, 0.3), [False, False]),
        ((9.0, -20.0), (0.3, 3.0), [False, True]),
        # Strong evidence without a significantly smaller residual is ignored.
        ((-30.0, 20.0), (1.0, 1.0), [True, True]),
        ((30.0, -20.0), (1.0, 1.0), [False, False]),
    ],
)
def test_weak_evidence_of_a_joint_yields_to_all_joints(evidence, ratios, rejected):
    """A friction model is rejected by the sum of the evidence, except at joints with strong evidence.

    ratios: squared residual of the model divided by the squared residual of the simpler model, per joint.
    """
    simple = torch.ones(1000, 2).double()
    residual = simple * torch.tensor(ratios).double().sqrt()
    assert stages._rejected(torch.tensor(evidence), residual, simple).tolist() == rejected


def test_a_friction_state_must_lower_the_residual_in_most_blocks():
    """A friction state must lower the squared residual in most blocks of a log.

    At joint 1 it lowers the squares to 1/3 in each block (accepted), at joint 2 to 1/100 in two of ten (refused).
    """
    other = torch.ones(1000, 2).double()
    residual = other.clone()
    residual[:, 0] /= 3**0.5
    residual[:200, 1] /= 10.0
    assert stages._smaller_in_most_blocks(residual, other).tolist() == [True, False]


def test_the_occam_factor_of_bristle_fractions():
    """-2 log(Occam factor) of a joint's bristle fractions is log det of prior minus log det of posterior covariance.

    Two joints have two fractions each. The posterior standard deviation of one fraction of joint 2 is a tenth of the
    prior's, so the result is 2 log(10) for joint 2; the other fractions have their prior's, so it is 0 for joint 1.
    """
    rigid = SimpleNamespace(
        names=lambda group: ["fractions"],
        unflatten=lambda x: {"sizes": x[:1], "fractions": x[1:].view(2, 2)},
    )
    covariance = torch.diag(torch.tensor([0.5, 4.0, 4.0, 4.0, 0.04])).double()
    problem = SimpleNamespace(
        jacobian=SimpleNamespace(rigid=rigid), prior=SimpleNamespace(precision=torch.eye(5).double() / 4.0)
    )
    estimate = SimpleNamespace(
        problem=problem, covariance=covariance, state=SimpleNamespace(x=torch.zeros(5))
    )
    narrowed = stages.fraction_occam_factor(estimate)
    torch.testing.assert_close(narrowed, torch.tensor([0.0, 2 * np.log(10)]).double())
