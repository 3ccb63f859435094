"""Posterior intervals of torque fits contain the true parameters of simulated arms.

Posterior standard deviations, such as of M and of torques, equal the spread over models with parameters that are
sampled from the posterior.
"""

import json
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from emitted import FOLLOWED, GANTRY
from motions import smooth_motion
from scipy.signal import lfilter
from typer.testing import CliRunner

import spelgen
from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.dynamics.body_regressor import base_combinations
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.emission.build import build
from spelgen.errors import LogError, RunError
from spelgen.evaluation.evaluate import evaluate
from spelgen.exporting.export import export
from spelgen.fitting.fit import fit, load_run
from spelgen.fitting.posterior import Posterior
from spelgen.fitting.run_folder import RunFolder, write_state
from spelgen.fitting.torque import fit as torque_fit
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.identify import least_squares
from spelgen.identification.intervals import QUANTILE, Interval, larger_covariance
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.filtering import low_pass
from spelgen.logs.read import write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.render.report_page import render_report
from spelgen.settings.fits import TorqueFit
from tests.test_closed_form import drawn


@pytest.mark.parametrize("robot", ["two_link", "rpr", "six_dof", "followed", "gantry"])
def test_base_parameters_are_the_exact_ones(robots, tmp_path, robot):
    """Base parameters of fits are the same combinations, under the same names, as in `identify`.

    Reports compare the values of both by name.
    """
    urdf = robots / f"{robot}.urdf"
    if robot in ("followed", "gantry"):
        urdf = tmp_path / f"{robot}.urdf"
        urdf.write_text(FOLLOWED if robot == "followed" else GANTRY, encoding="utf-8")
    arm = load_arm(urdf)
    exact = base_parameters(arm.chain, FrictionModel(), arm.actuation.drives().speeds)
    count = 10 * len(arm.chain.bodies) + len(arm.chain.coordinates)
    # not compared: the base parameters of friction and offsets, which are the last
    common = exact.columns < count
    model = build(arm, "closed-form")
    names, combination = base_combinations(model.chain, motors_of(model))
    assert names == tuple(np.array(exact.names)[common])
    np.testing.assert_allclose(combination, exact.combination[common, :count], atol=1e-7)
    # a base parameter that is a single parameter has its name; names of combinations end with R
    single = [exact.identifiability().get(name) == "alone" for name in names]
    assert single == [not name.endswith("R") for name in names]


def test_base_parameters_are_equal_in_every_bit(robots):
    """The matrix of base parameters is bitwise equal in each call, so that reports are, too."""
    model = build(robots / "rpr.urdf", "closed-form")
    draw = torch.Generator().manual_seed(0)
    results = set()
    for size in range(1, 40):
        # allocate and free memory, so that its contents differ between calls
        torch.randint(-9, 9, (size, 50), generator=draw)
        results.add(base_combinations(model.chain, motors_of(model))[1].numpy().tobytes())
    assert len(results) == 1


def test_the_larger_covariance_bounds_both():
    draw = torch.Generator().manual_seed(0)
    scale = torch.logspace(-3, 3, 5).double()  # parameters of different magnitudes, as of different units
    roots = torch.randn(2, 5, 5, generator=draw).double() * scale.unsqueeze(-1)
    first, second = roots @ roots.mT
    both = larger_covariance(first, second)
    for smaller in (first, second):
        excess = (both - smaller) / scale.outer(scale)
        assert torch.linalg.eigvalsh(excess).min() > -1e-9
    torch.testing.assert_close(larger_covariance(1e-3 * second, second), second)
    torch.testing.assert_close(larger_covariance(7 * second, second), 7 * second)


def arm_like(robots, seed):
    """Return a model with the kinematics of rpr.urdf and random other parameters."""
    return drawn(SimpleNamespace(Model=lambda: build(robots / "rpr.urdf", "closed-form")), seed, 0.3)


def base_values(model):
    with torch.no_grad():
        constants = torch.cat([model.inertial_parameters.flatten(), model.armature])
    return (base_combinations(model.chain, motors_of(model))[1] @ constants).tolist()


def logged(model, seconds, seed, correlation=0.98, noise=0.05):
    """Return samples of a smooth motion with a model's torque and autocorrelated torque errors.

    correlation: of successive errors at 100 Hz. noise: standard deviation, relative to the torque's.
    """
    rng = np.random.default_rng(seed)
    motion = smooth_motion(model.n, seconds, rng)
    with torch.no_grad():
        tau = model.inverse_dynamics(*map(torch.from_numpy, motion)).numpy()
    errors = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], rng.normal(size=tau.shape), axis=0)
    return DynamicsSamples("known", *motion, tau + noise * tau.std(axis=0) * errors)


def test_intervals_contain_the_truth_if_errors_are_correlated_longer_than_the_fit_assumes(
    robots, monkeypatch
):
    """Reported intervals contain the truth even if torque errors are correlated longer than the fit assumes.

    With errors correlated over 0.5 s, intervals of the posterior covariance, which assumes 0.2 s, are too narrow.
    """
    # error / half width of the interval: of reported intervals, and of intervals from the posterior covariance
    estimates, ratios, ratios_by_posterior = [], [], []
    measured = torque_fit.jackknife

    def kept(estimate):
        estimates.append(estimate)
        return measured(estimate)

    monkeypatch.setattr(torque_fit, "jackknife", kept)
    for seed in range(12):
        true, model = arm_like(robots, seed), build(robots / "rpr.urdf", "closed-form")
        solution = fit_torque(model, [logged(true, 12.0, seed)])
        posterior = estimates[-1].with_current_covariance().covariance
        for covariance, result in ((solution.covariance, ratios), (posterior, ratios_by_posterior)):
            intervals = Posterior(model, covariance, solution.torque_std.numpy()).base_parameters
            for interval, value in zip(intervals, base_values(true), strict=True):
                result.append(abs(interval.value - value) / interval.half)
    print(np.quantile(ratios, (0.9, 0.95, 1)), np.quantile(ratios_by_posterior, (0.9, 0.95, 1)))
    # Reported intervals contain at least 95 % of the true values (ratio below 1) and are not much too wide (above 0.4).
    # All errors are below 1 / 0.9 half widths. At least one interval from the posterior covariance is too narrow.
    assert 0.4 < np.quantile(ratios, 0.95) < 1.0
    assert np.max(ratios_by_posterior) > 1.0 > 0.9 * np.max(ratios)


def test_least_squares_counts_friction_that_changes_during_a_log(robots):
    """Intervals of least squares include changes of friction during a log, here from 0.8 to 1.2 Nm in a minute.

    A jackknife over ten blocks gives the standard error of the mean: the standard deviation of the ten block means,
    divided by sqrt(10).
    """
    arm = load_arm(robots / "rpr.urdf").chain
    q, qd, qdd = smooth_motion(3, 60.0, np.random.default_rng(0))
    bodies, friction = urdf_parameters(arm), np.linspace(0.8, 1.2, len(q))[:, None]
    tau = regressor(arm, q, qd, qdd) @ bodies + np.tanh(qd / 0.01) * friction
    found = least_squares(arm, [DynamicsSamples("rising", q, qd, qdd, tau)])
    of_ten = (
        1.15 * np.linspace(0.82, 1.18, 10).std(ddof=1) / np.sqrt(10)
    )  # 1.15: 97.5 % quantile of Student's t (9 degrees of freedom) divided by the quantile of the normal distribution
    interval = next(x for x in found.intervals if x.name == "coulomb3")
    assert interval.low < 1.0 < interval.high
    assert interval.std == pytest.approx(
        of_ten, rel=0.4
    )  # 0.044 Nm; if friction were assumed to be constant, interval.std would be 0.018 Nm


@pytest.fixture(scope="module")
def fitted(robots):
    """Return a fit to two recordings of a known arm, and the arm."""
    true, logs = arm_like(robots, 3), []
    for seed in range(3):
        x = logged(true, 10.0, seed, correlation=0.5)
        logs.append(Trajectory(np.arange(len(x.q)) / 100, x.q, x.qd, x.tau, f"motion {seed}"))
    urdf = robots / "rpr.urdf"
    return fit(build(urdf, "closed-form"), logs[:2], TorqueFit(), arm=urdf), logs


def test_standard_deviations_agree_with_sampled_parameters(fitted):
    """The stated standard deviations of M, g, torques and armatures equal their spread over 300 sampled models.

    The parameters of these models are sampled from the posterior. Here its covariance is multiplied by 1e-6, so that
    all quantities are linear in the parameters, as the stated standard deviations assume.
    """
    result, _ = fitted
    posterior, shrink = result.posterior, 1e-3
    small = replace(posterior, covariance=shrink**2 * posterior.covariance, torque_std=np.zeros(3))
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-1, 1, (3, 4, 3))
    draws = []
    vector = ParameterVector(posterior.model)
    x = vector.flatten(vector.initial)
    for noise in torch.from_numpy(rng.normal(size=(300, len(x)))):
        values, vectors = torch.linalg.eigh(small.covariance)
        vector.write(x + vectors @ (values.clamp(min=0).sqrt() * noise))
        with torch.no_grad():
            model, states = posterior.model, list(map(torch.from_numpy, (q, qd, qdd)))
            drawn = model.mass_matrix(states[0]), model.gravity(states[0]), model.inverse_dynamics(*states)
            draws.append(torch.cat([y.flatten() for y in (*drawn, model.armature)]).numpy())
    vector.write(x)
    armature = np.array([interval.std for interval in small.drives["armature"]])
    stated = [small.mass_matrix(q).std, small.gravity(q).std, small.torque(q, qd, qdd).std, armature]
    np.testing.assert_allclose(
        np.std(draws, axis=0), np.concatenate([y.ravel() for y in stated]), rtol=0.2, atol=1e-9
    )


def test_wrong_arguments_are_named_and_a_fit_can_be_pickled(fitted):
    result, logs = fitted
    wide = Trajectory(*(np.zeros((9, 4)) if x else np.arange(9) for x in range(4)), name="wide")
    for call in (result.predict, result.score, lambda x: fit(result.model, x), lambda x: evaluate(result, x)):
        with pytest.raises(LogError, match="trajectory wide: got 4 joints, expected 3: joint1"):
            call(wide)
        with pytest.raises(LogError, match=r"got str 'run/logs', expected trajectories: spelgen.read_logs\("):
            call("run/logs")
    with pytest.raises(LogError, match="got no trajectory"):
        evaluate(result, [])
    with pytest.raises(LogError, match=r"q: got \[.*nan.*\] at sample 2, expected finite"):
        Trajectory(
            np.arange(9), np.ma.masked_array(wide.q, np.arange(36).reshape(9, 4) == 9), wide.qd, wide.tau
        )
    again = pickle.loads(pickle.dumps(result))
    assert isinstance(again.model, type(result.model))
    np.testing.assert_array_equal(again.predict(logs[2]), result.predict(logs[2]))
    q = logs[2].q[:5]
    expected = result.posterior.mass_matrix(q).std
    for form in (q.tolist(), torch.from_numpy(q).requires_grad_(), np.asfortranarray(q)):
        np.testing.assert_array_equal(again.posterior.mass_matrix(form).std, expected)
    with pytest.raises(ValueError, match=r"got q of shape \(3,\), expected \(T, 3\)"):
        result.posterior.gravity(q[0])


def test_torque_intervals_hold_the_torques_of_another_motion(fitted):
    result, logs = fitted
    tau, std = result.predict(logs[2], std=True)
    np.testing.assert_allclose(tau, result.predict(logs[2]), rtol=1e-9)
    # the ends are omitted: the low-pass filter of the measured torque has transients there
    inner = slice(100, -100)
    measured = low_pass(logs[2], result.preprocessing.acceleration_cutoff).tau[inner]
    held = np.abs(measured - tau[inner]) <= QUANTILE * std[inner]
    assert 0.9 < held.mean() < 0.995


def test_a_loaded_run_its_report_and_its_exports_state_the_same_intervals(fitted, tmp_path):
    result, _ = fitted
    folder = result.save(tmp_path / "run")
    stated = result.posterior.to_dict()
    read = json.loads(json.dumps(load_run(folder).posterior.to_dict()))
    for name in ("base_parameters", "bodies"):
        for one, other in zip(stated[name], read[name], strict=True):
            assert one["name"] == other["name"] and one["low"] == pytest.approx(
                other["low"], rel=1e-6, abs=1e-9
            )
    first = result.posterior.drives["armature"][0]
    page, readme = render_report(folder), export(load_run(folder), "urdf").files[".urdf.README.md"].decode()
    for text in (page, readme):
        assert f"{first.text} {first.unit}" in text
    determined = next(x for x in result.posterior.base_parameters if x.determined == "firm")
    assert determined.text in page
    assert f"{determined.half:.2g}" in readme


def test_a_foreign_or_absent_posterior_is_one_clear_error(fitted, tmp_path):
    result, _ = fitted
    folder = RunFolder(result.save(tmp_path / "run"))
    checkpoint = result.checkpoint.content
    nan = checkpoint["posterior"] | {"covariance": torch.full_like(result.posterior.covariance, torch.nan)}
    small = checkpoint["posterior"] | {"covariance": torch.eye(3).double()}
    for content in (nan, small, {}):
        write_state(folder.checkpoint, checkpoint | {"posterior": content})
        with pytest.raises(
            RunError, match=r"checkpoint\.pt: posterior: a posterior of another model; restore"
        ):
            load_run(folder.path).posterior  # noqa: B018
    del checkpoint["posterior"]
    write_state(folder.checkpoint, checkpoint)
    with pytest.raises(RunError, match="a fit without intervals, expected rigid bodies fitted to torques"):
        load_run(folder.path).posterior  # noqa: B018
    assert "model, 95 %" not in render_report(folder.path)


def test_train_states_the_intervals_of_the_fit(robots, fitted, tmp_path):
    _, logs = fitted
    module, urdf = tmp_path / "rpr.py", robots / "rpr.urdf"
    write_logs(tmp_path / "logs.parquet", logs[:2], ("joint1", "joint2", "joint3"))
    module.write_text(spelgen.generate(urdf, preset="closed-form"), encoding="utf-8")
    command = ["train", module, "--data", tmp_path / "logs.parquet", "--robot", urdf, "-o", tmp_path / "run"]
    command += ["--format", "json"]
    told = CliRunner().invoke(app, list(map(str, command)))
    assert told.exit_code == 0, told.output
    stated = json.loads(told.stdout)["posterior"]
    for one, other in zip(
        stated["base_parameters"], load_run(tmp_path / "run").posterior.base_parameters, strict=True
    ):
        assert one["name"] == other.name and one["high"] == pytest.approx(other.high, rel=1e-9)


def test_intervals_of_positive_quantities_have_no_negative_end():
    assert Interval("armature", 1.0, 2.0, positive=True).low == 0
    assert Interval("hx1", 1.0, 2.0).low == pytest.approx(-2.92)
    assert [Interval("m1", 1.0, std).determined for std in (0.05, 0.2, 1.0, 1.1)] == [
        "firm",
        "fair",
        "weak",
        "may be zero",
    ]
    assert Interval("m1", 1.0, np.inf).to_dict()["high"] is None
