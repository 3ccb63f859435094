"""Torque fits state no more certainty than their samples support: noise, prior widths, residual terms, few data."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from motions import smooth_motion
from scipy.signal import lfilter

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.bristles import bristle_reach
from spelgen.emission.build import build
from spelgen.fitting.torque.covariance import jackknife
from spelgen.fitting.torque.fit import TorqueSolution, fit_torque
from spelgen.fitting.torque.jacobian import ResidualSamples, TorqueJacobian
from spelgen.fitting.torque.linearization import RigidProjection
from spelgen.fitting.torque.parameters import ParameterPrior, ParameterVector, update_widths
from spelgen.fitting.torque.problem import TorqueProblem
from spelgen.fitting.torque.report import torque_notes
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import max_torques, select_functions
from spelgen.fitting.torque.stages import initial_fit
from spelgen.fitting.torque.tuning import TUNING
from spelgen.identification.least_squares import correlation_time
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.read import read_logs
from spelgen.settings.fits import GaussianPrior


class Unabsorbed:
    """Stub for the projection of joint torques: `orthogonalize` returns an added torque unchanged.

    A real projection subtracts the part of the torque that the rigid-body and friction parameters would absorb.
    """

    @staticmethod
    def orthogonalize(joint, torque):
        return torque


def recording(model, name: str, seconds: float, seed: int, correlation: float = 0.0) -> DynamicsSamples:
    """Return samples of a smooth motion with a model's torque and 2 % noise.

    correlation: coefficient of the autoregressive noise; 0: white.
    """
    rng = np.random.default_rng(seed)
    q, qd, qdd = smooth_motion(model.n, seconds, rng)
    with torch.no_grad():
        tau = model.inverse_dynamics(*(torch.from_numpy(x) for x in (q, qd, qdd))).numpy()
    noise = lfilter([1.0], [1.0, -correlation], rng.normal(size=tau.shape), axis=0)
    return DynamicsSamples(name, q, qd, qdd, tau + 0.02 * tau.std(0) * noise / noise.std(0))


@pytest.mark.parametrize("coefficient", [0.0, 0.8])
def test_the_correlation_of_the_noise_is_restored(coefficient):
    """`RigidProjection.errors` restores the correlation time of the noise from the residual of a fit.

    The residual of a fit of 60 parameters is itself smaller and less correlated than the noise.
    """
    rng, count, joints = np.random.default_rng(0), 1000, 8
    noise = lfilter([1.0], [1.0, -coefficient], rng.normal(size=(count, joints)), axis=0)
    # regressor columns that vary slowly, like an arm's
    smooth = [lfilter([1.0], [1.0, -0.97], rng.normal(size=(count, 60)), axis=0) for _ in range(joints)]
    jacobian = tuple(map(torch.from_numpy, smooth))
    gain = tuple(torch.linalg.inv(x.mT @ x) for x in jacobian)
    target = torch.from_numpy(noise)
    fitted = [x @ (g @ (x.mT @ target[:, k])) for k, (x, g) in enumerate(zip(jacobian, gain, strict=True))]
    residual = target - torch.stack(fitted, dim=1)
    errors = RigidProjection(jacobian, gain).errors(residual, 50)
    expected = (1 + coefficient) / (1 - coefficient)
    found = correlation_time(list(errors.numpy())).mean()
    naive = correlation_time(list(residual.unflatten(0, (-1, 50)).numpy())).mean()
    assert abs(found - expected) < 0.35 * expected
    if coefficient:
        assert naive < 0.9 * found
    else:
        assert float(errors.var()) == pytest.approx(noise.var(), rel=0.05)
        assert float(residual.var()) < 0.95 * noise.var()


def test_the_fit_finds_whether_errors_are_correlated(robots):
    """A fit distinguishes white noise at 100 Hz from noise with an integrated correlation time of 0.4 s."""
    found = {}
    for coefficient in (0.0, 0.95):
        model = build(robots / "two_link.urdf", "closed-form")
        logs = [recording(model, str(seed), 20.0, seed, coefficient) for seed in range(3)]
        found[coefficient] = fit_torque(model, logs).correlation_time
    assert (found[0.0] < 0.1).all()
    assert (found[0.95] > 0.25).all() and (found[0.95] < 0.6).all()


def test_estimated_prior_widths_are_bounded(robots):
    """If bodies differ from the prior mean by a factor of e^40 (torques in a wrong unit), prior widths are bounded."""
    rigid = ParameterVector(build(robots / "two_link.urdf", "closed-form"))
    widths = GaussianPrior()
    prior = ParameterPrior.of(rigid, widths)
    x = prior.mean + 40.0 * rigid.mask("bodies", "offset")
    found = update_widths(prior, x, torch.zeros(len(x), len(x)).double()).widths
    assert found.bodies == found.offset == TUNING.max_width
    assert found.armature < widths.armature


def test_masses_beyond_the_bound_are_a_warning(robots):
    model = build(robots / "two_link.urdf", "closed-form")
    samples = TorqueSamples.of([recording(model, "x", 5.0, 0)])
    solution = fit_torque(model, samples)
    for bodies, severity in ((0.5, "info"), (2.0, "warning"), (TUNING.max_width, "warning")):
        widths = solution.prior.model_copy(update={"bodies": bodies})
        (note,) = [
            x for x in torque_notes(model, samples, replace(solution, prior=widths)) if x.code == "urdf-prior"
        ]
        assert note.severity == severity
        assert ("upper bound" in note.message) == (bodies == TUNING.max_width)


def residual_of(torque: torch.Tensor, q: torch.Tensor) -> ResidualSamples:
    still = torch.zeros_like(q)
    return ResidualSamples(q, still, still, torque, still)


@pytest.fixture
def hybrid(robots):
    """Return a hybrid model of two links whose residual terms are functions of single joints."""
    model = build(robots / "two_link.urdf", "hybrid", width=8)
    model.residuals.potential = model.residuals.mass = None
    return model


@pytest.mark.parametrize("other, selected", [(1.0, True), (-0.2, False)])
def test_a_term_has_to_hold_in_the_recording_that_is_held_out(hybrid, other, selected):
    """A residual term is selected only if it also lowers the error in a second, held-out recording.

    Both halves of the first recording support the term. In the second recording, the torque residual is the same
    function of q times `other`: 1 supports the term, -0.2 does not.
    """
    t = torch.linspace(0, 200, 4000).double()
    q = torch.stack([torch.sin(t), torch.zeros_like(t)], dim=1)
    torque = torch.stack([torch.sin(2 * q[:, 0]), torch.zeros_like(t)], dim=1)
    recordings = (torch.arange(4000) >= 2000).long()
    torque[recordings == 1] *= other
    std, lengths = torch.full((2,), 10.0).double(), torch.full((2,), 5.0)
    found = select_functions(hybrid, residual_of(torque, q), Unabsorbed(), [], lengths, recordings, std)
    assert bool(found) == selected


def test_one_recording_supports_only_a_part_of_the_torque(hybrid):
    """From one recording a residual term may explain only a limited fraction of a joint's torque; from three, any."""
    t = torch.linspace(0, 200, 4000).double()
    q = torch.stack([torch.sin(t), torch.zeros_like(t)], dim=1)
    samples = residual_of(torch.stack([torch.sin(2 * q[:, 0]), torch.zeros_like(t)], dim=1), q)
    lengths, one, three = torch.full((2,), 5.0), torch.zeros(4000).long(), torch.arange(4000) * 3 // 4000
    spread = float(samples.torque_residual[:, 0].std())
    for recordings, ratio, selected in ((one, 5.0, True), (one, 1.2, False), (three, 1.2, True)):
        std = torch.full((2,), ratio * spread).double()
        found = select_functions(hybrid, samples, Unabsorbed(), [], lengths, recordings, std)
        assert bool(found) == selected


def test_no_spring_from_one_recording_at_a_joint_without_load(robots):
    """From one recording, no spring is selected at a joint without gravity load: here a vertical first axis."""
    model = build(robots / "six_dof.urdf", "hybrid", width=8)
    q = torch.from_numpy(smooth_motion(6, 10.0, np.random.default_rng(0))[0])
    with torch.no_grad():
        gravity = model.gravity(q).std(dim=0)
    limits = max_torques(model, q, gravity.clamp(min=0.1 * float(gravity.max())))
    assert limits["raw_torque_splines"][0] == 0 and limits["raw_torque_ripple"][0] > 0
    assert (limits["raw_torque_splines"][gravity > 0.5 * gravity.max()] > 0).all()


def test_ripple_has_frequencies_of_which_the_samples_contain_two_periods(hybrid):
    """Candidates of torque ripple have at least two periods in the range of the samples.

    A range of 2 rad contains two periods of 7 per revolution (1.8 rad), but not of 6 (2.1 rad).
    """
    from spelgen.fitting.torque.joint_functions import RIPPLE, joint_functions

    q = torch.stack([torch.linspace(-1, 1, 500).double(), torch.zeros(500).double()], dim=1)
    candidates = joint_functions(hybrid, residual_of(q.sin(), q), Unabsorbed(), {(RIPPLE, 0)})
    (candidate,) = candidates
    cosines, sines = candidate.columns.chunk(2, dim=1)
    for waves in (cosines, sines):
        assert not waves[:, :6].any() and (waves[:, 6:].abs().amax(dim=0) > 0.1).all()


def test_spring_extrapolates_to_positions_without_samples(hybrid):
    """A linear spring with zero torque at -0.3 rad, fitted from -0.5 to 0.5 rad, extrapolates to -1.5 and 1.5 rad."""
    from spelgen.fitting.torque.joint_functions import TORQUE, joint_functions

    q = torch.stack([torch.linspace(-0.5, 0.5, 500).double(), torch.zeros(500).double()], dim=1)
    (candidate,) = joint_functions(hybrid, residual_of(q, q), Unabsorbed(), {(TORQUE, 0)})
    candidate.write(hybrid.residuals, candidate.fit(3 * (q[:, 0] + 0.3), 1.0).coef)
    beyond = torch.tensor([[-1.5, 0.0], [-0.8, 0.0], [0.8, 0.0], [1.5, 0.0]]).double()
    with torch.no_grad():
        torque = hybrid.residuals.at(beyond, hybrid.residuals.prepare(torch.eye(2).double())).torque[:, 0]
        hybrid.residuals.raw_torque_splines.zero_()
    torch.testing.assert_close(torque, 3 * (beyond[:, 0] + 0.3), rtol=0.02, atol=0.02)


def test_slow_passes_are_few_errors(hybrid):
    """If a joint moves through its range once, its samples count as only 1 + range / spacing independent errors.

    spacing: distance of the knots of the position-dependent functions of the joint [rad], here for a range of 2 rad.
    """
    from spelgen.fitting.torque.joint_functions import joint_functions

    lengths = []
    for passes in (1, 40):
        t = torch.linspace(0, 1, 4000).double()
        q = torch.stack([torch.cos(torch.pi * passes * t), torch.zeros_like(t)], dim=1)
        candidate = next(joint_functions(hybrid, residual_of(q.sin(), q), Unabsorbed()))
        lengths.append(candidate.visit_length)
    spacing = float(hybrid.residuals.spacing[0])
    assert lengths[0] == pytest.approx(4000 / (1 + 2 / spacing), rel=1e-3)
    assert lengths[0] > 5 * lengths[1]


def test_held_out_errors_are_those_of_fits_without_the_block(robots):
    """The jackknife's error of each half second equals the error of a refit to all other samples.

    The refits solve the linearized problem.
    """
    model = build(robots / "two_link.urdf", "closed-form")
    samples = TorqueSamples.of([recording(model, "x", 4.0, 0)], 2)
    estimate = initial_fit(TorqueProblem.of(TorqueJacobian(model, samples), GaussianPrior()))
    estimate.problem.jacobian.rigid.write(estimate.state.x)
    found = jackknife(estimate).held_out
    jacobian, x, noise = estimate.problem.jacobian, estimate.state.x, estimate.problem.noise
    change, free = jacobian.theta_jacobian(x), estimate.problem.free
    rows = torch.zeros(2, samples.count, len(x)).double()
    for joint, columns, block, _ in jacobian.joint_rows(x):
        rows[joint, :, columns] = block
    rows = (rows @ change)[..., free]
    residual = jacobian.residual_samples(x).torque_residual.mT
    offset = (x - estimate.problem.prior.mean)[free]
    precision = estimate.problem.prior.precision[free][:, free]
    expected = []
    for block in np.array_split(np.arange(samples.count), samples.count // 25):
        kept = torch.ones(samples.count, dtype=torch.bool)
        kept[block] = False
        weighted = rows[:, kept] / noise[:, None, None] ** 2
        curvature = torch.einsum("jtk,jtl->kl", weighted, rows[:, kept]) + precision
        gradient = torch.einsum("jtk,jt->k", weighted, residual[:, kept]) - precision @ offset
        # the gradient of the whole problem is not exactly zero (solver tolerance) and is subtracted
        whole = torch.einsum("jtk,jt->k", rows / noise[:, None, None] ** 2, residual) - precision @ offset
        step = torch.linalg.solve(curvature, gradient - whole)
        expected.append((residual[:, ~kept] - rows[:, ~kept] @ step).square().sum(dim=1))
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-6, atol=1e-12)


ARMS = {
    "ur10e": ("ur10e/ur10e.urdf", "ur10e/20_02_10_30sec_12harm.parquet"),
    "panda": ("../arms/panda_erd.urdf", "panda/exciting_traj1.parquet"),
    "xmate3": ("xmate3/xmate3.urdf", "xmate3/excit.parquet"),
    "ar5": ("ar5/ar5.urdf", "ar5/real.parquet"),
    "tx40": ("tx40/tx40.urdf", "tx40/identification.parquet"),
    "shanghai": ("shanghai/shanghai.urdf", "shanghai/traj1.parquet"),
    "airbot": ("airbot/airbot.urdf", "airbot/ps_N7T25QR-5.parquet"),
}


def first_seconds(folder: Path, arm: str, seconds: float) -> tuple[TorqueSolution, set[str], list[str]]:
    """Fit `closed-form` to the first seconds of a recording.

    Returns the fit, the codes of its notes, and the messages about too few data.
    """
    urdf, log = (folder / x for x in ARMS[arm])
    model = build(urdf, "closed-form")
    (whole,) = read_logs([log], load_arm(urdf))
    part = whole[: int(np.searchsorted(whole.t, whole.t[0] + seconds))]
    samples = TorqueSamples.of(dynamics_samples([part], reach=bristle_reach(model)), TUNING.decimation)
    solution = fit_torque(model, samples)
    notes = list(torque_notes(model, samples, solution))
    return solution, {x.code for x in notes}, [x.message for x in notes if x.code == "few-data"]


@pytest.mark.parametrize("arm", ARMS)
def test_a_second_of_motion_supports_no_fit(shared, arm):
    """A fit to 1.5 s of motion warns of too few data, and states how many seconds to record.

    The warning names the URDF's values and ridge regression as methods that may be as good as the fit.
    """
    _, codes, messages = first_seconds(shared / "logs", arm, 1.5)
    assert "few-data" in codes
    assert "URDF" in messages[0] and "ridge" in messages[0] and " s in which all joints move" in messages[0]


@pytest.mark.parametrize(
    ("seconds", "advice"), [(5.0, "record about 23 s"), (70.0, "a longer log would not help")]
)
def test_a_longer_recording_is_advised_only_if_the_recording_is_short(robots, seconds, advice):
    """A fit that the logs do not support advises a longer recording, unless the logs have more than a minute.

    The held-out nMSE is set to 2, four times the largest value at which a fit counts as supported by its logs.
    """
    model = build(robots / "two_link.urdf", "closed-form")
    samples = TorqueSamples.of([recording(model, "x", seconds, 0)], TUNING.decimation)
    solution = replace(fit_torque(model, samples), held_out_nmse=np.full(2, 2.0))
    (message,) = [x.message for x in torque_notes(model, samples, solution) if x.code == "few-data"]
    assert advice in message
    assert ("record about" in message) == (seconds < 60)


def test_twelve_seconds_of_an_exciting_motion_support_a_fit(shared):
    solution, codes, _ = first_seconds(shared / "logs", "panda", 12.0)
    assert "few-data" not in codes
    assert (solution.held_out_nmse < 0.05).all()
