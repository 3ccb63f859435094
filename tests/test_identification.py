"""The regressor equals Pinocchio's, and least squares recovers the known parameters of simulated arms.

For recorded logs of the UR10e and the Panda, it gives the published torque errors (shared/logs/README.md).
"""

import json

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.inspection import inspect
from spelgen.cli.main import app
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.errors import LogError, SettingsError
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.identification import LeastSquares
from spelgen.identification.identify import identify, least_squares
from spelgen.identification.intervals import Interval, interval_listing
from spelgen.identification.least_squares import correlation_time
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import Trajectory, read_logs, write_logs
from spelgen.structure.base_parameters import base_parameters as exact_base_parameters
from spelgen.structure.nominal import parameters_of, pseudo_inertia, reference_factor

ROBOTS = ("two_link", "rpr", "scara", "six_dof", "ur10e", "panda")


def pinocchio(path, arm):
    """Return Pinocchio's model of an arm's URDF, in which all joints that are not the arm's are locked."""
    names = [coordinate.name for coordinate in arm.coordinates]
    whole = pin.buildModelFromUrdf(str(path))
    locked = [i for i in range(1, whole.njoints) if whole.names[i] not in names]
    model = pin.buildReducedModel(whole, locked, pin.neutral(whole))
    assert list(model.names[1:]) == names
    model.gravity.linear = np.array([float(g) for g in arm.gravity])
    return model


@pytest.mark.parametrize("robot", ROBOTS)
def test_regressor_spans_what_pinocchios_does_and_gives_its_torque(robots, robot):
    path = robots / f"{robot}.urdf"
    arm = load_arm(path).chain
    model = pinocchio(path, arm)
    data = model.createData()
    states = np.random.default_rng(0).uniform(-2, 2, (3, 60, len(arm.coordinates)))
    ours = regressor(arm, *states)
    torque = np.array([pin.rnea(model, data, *state) for state in zip(*states, strict=True)])
    np.testing.assert_allclose(ours @ urdf_parameters(arm), torque, atol=1e-9 * np.abs(torque).max())
    theirs = np.concatenate(
        [pin.computeJointTorqueRegressor(model, data, *state).copy() for state in zip(*states, strict=True)]
    )
    ours = ours.reshape(len(theirs), -1)
    # columns of different body frames span the same space: each set is a linear combination of the other
    explained = ours @ np.linalg.lstsq(ours, theirs, rcond=1e-11)[0]
    np.testing.assert_allclose(explained, theirs, atol=1e-8 * np.abs(theirs).max())
    assert np.linalg.matrix_rank(ours, tol=1e-8) == np.linalg.matrix_rank(theirs, tol=1e-8)


@pytest.mark.parametrize("robot", ROBOTS)
def test_base_parameters_are_those_of_inspect(robots, robot):
    """The first base parameters are of the bodies and equal the base parameters of `inspect` in name, order and value.

    The base parameters of friction follow, without a parameter for the armature of joint 1.
    """
    path = robots / f"{robot}.urdf"
    arm = load_arm(path).chain
    exact = exact_base_parameters(arm)
    base = base_parameters(arm, FrictionModel())
    inertial = 10 * len(arm.bodies)
    assert base.bodies == len(exact) == inspect(path).to_dict()["base_parameters"]
    # A name ends with R if other parameters are regrouped into the base parameter. `base`, unlike `exact`, has rotor
    # inertias. The inertia of a symmetric last link includes its rotor inertia, so its name may differ by the R.
    names = [name.removesuffix("R") for name in base.names[: base.bodies]]
    assert names == [each.name.removesuffix("R") for each in exact]
    assert {each.name for each in inspect(path).closed_forms().base} == {each.name for each in exact}
    values = base.combination[: base.bodies, :inertial] @ urdf_parameters(arm)
    np.testing.assert_allclose(values, [float(each.value) for each in exact], rtol=1e-12, atol=1e-12)
    assert all(name.rstrip("R0123456789") in FrictionModel().effects for name in base.names[base.bodies :])
    # rotor inertia of joint 1 cannot be distinguished from the link's inertia about the joint axis
    assert "armature1" not in base.names
    assert base.identifiability()["armature1"] == "in combination"
    assert base.identifiability()["viscous1"] == "alone"


def columns(arm, friction, q, qd, qdd):
    """Return the regressor (T, n, K): columns of the bodies, then of friction and drives."""
    return np.concatenate([regressor(arm, q, qd, qdd), friction.columns(qd, qdd)], axis=2)


@pytest.mark.parametrize("robot", ROBOTS)
def test_base_parameters_make_the_torque(robots, robot):
    """The regressor Y of all parameters equals Y[..., base.columns] @ base.combination, and its rank is len(base)."""
    arm, friction = load_arm(robots / f"{robot}.urdf").chain, FrictionModel(stribeck=True)
    base = base_parameters(arm, friction)
    states = np.random.default_rng(5).uniform(-2, 2, (3, 60, len(arm.coordinates)))
    rows = columns(arm, friction, *states)
    np.testing.assert_allclose(
        rows[:, :, base.columns] @ base.combination, rows, atol=1e-7 * np.abs(rows).max()
    )
    assert np.linalg.matrix_rank(rows.reshape(-1, rows.shape[-1]), tol=1e-7) == len(base)


def excited(arm, seconds=20.0, seed=0, noise=0.0, friction=None):
    """Return samples of a smooth random motion with the torques of an arm, and the parameters of this arm.

    Its bodies are the URDF's; friction and rotor inertias are added. noise: standard deviation of the torques [Nm, N].
    """
    friction = friction or FrictionModel()
    n = len(arm.coordinates)
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)
    speed = 2 * np.pi * rng.uniform(0.1, 0.7, (5, n))
    phase, size = rng.uniform(0, 2 * np.pi, (5, n)), rng.uniform(0.2, 0.6, (5, n))
    angle = speed * t[:, None, None] + phase
    q, qd, qdd = (size * np.sin(angle)).sum(1), (size * speed * np.cos(angle)).sum(1), None
    qdd = -(size * speed**2 * np.sin(angle)).sum(1)
    drives = {"armature": 0.4, "viscous": 3.0, "coulomb": 2.0, "offset": 0.3, "stribeck": 1.0}
    added = np.concatenate([np.full(n, drives[effect]) for effect in friction.effects])
    x = np.concatenate([urdf_parameters(arm), added])
    tau = columns(arm, friction, q, qd, qdd) @ x
    # noise with a standard deviation per joint, from 0.2 to 2 times the given level
    scale = noise * tau.std(0) * np.linspace(0.2, 2.0, n)
    return DynamicsSamples("known", q, qd, qdd, tau + scale * rng.normal(size=tau.shape)), x


def test_a_known_arm_is_found_exactly(robots):
    arm = load_arm(robots / "six_dof.urdf").chain
    friction = FrictionModel(stribeck=True)
    samples, x = excited(arm, friction=friction)
    found = least_squares(arm, [samples], LeastSquares("range", friction=friction))
    np.testing.assert_allclose(found.values, found.base.combination @ x, atol=1e-6 * np.abs(x).max())
    assert found.unseen == 0
    assert found.condition < 1e4
    fresh, _ = excited(arm, seed=1, friction=friction)
    np.testing.assert_allclose(found.torque(fresh.q, fresh.qd, fresh.qdd), fresh.tau, atol=1e-4)


def test_negative_viscous_friction_is_a_warning(robots):
    """The warning about negative viscous friction names joint 2, and no other joint.

    The coefficient is -3 at joint 2 (-2.9 after the low-pass filter), and 3 at the other joints.
    """
    arm = load_arm(robots / "rpr.urdf")
    log, _ = excited(arm.chain, noise=0.01)
    tau = log.tau - 6.0 * log.qd * [0.0, 1.0, 0.0]
    found = identify(arm, Trajectory(0.01 * np.arange(len(tau)), log.q, log.qd, tau))
    (warning,) = [x.message for x in found.diagnostics if x.code == "friction-compensated"]
    names = arm.chain.joint_names
    assert (
        f"viscous friction {names[1]} -2.9" in warning and names[0] not in warning and names[2] not in warning
    )


def test_standard_deviations_are_those_of_repeated_experiments(robots):
    arm = load_arm(robots / "rpr.urdf").chain
    drawn, claimed = [], []
    for seed in range(40):
        samples, x = excited(arm, 4.0, seed=7, noise=0.0)
        rng = np.random.default_rng(seed)
        noisy = samples.tau + 0.05 * samples.tau.std(0) * rng.normal(size=samples.tau.shape)
        found = least_squares(
            arm, [DynamicsSamples("", samples.q, samples.qd, samples.qdd, noisy)], LeastSquares()
        )
        drawn.append(found.values - found.base.combination @ x)
        claimed.append(found.deviations)
    ratio = np.std(drawn, axis=0) / np.mean(claimed, axis=0)
    assert (ratio > 0.6).all()
    assert (ratio < 1.5).all()


def test_weights_by_noise_beat_equal_ones_where_joints_are_measured_unequally(robots):
    arm = load_arm(robots / "six_dof.urdf").chain
    errors = {}
    for weights in ("equal", "noise"):
        away = []
        for seed in range(5):
            samples, _ = excited(arm, 5.0, seed=seed, noise=0.2)
            found = least_squares(arm, [samples], LeastSquares(weights))
            fresh, _ = excited(arm, seed=100 + seed)
            error = found.torque(fresh.q, fresh.qd, fresh.qdd) - fresh.tau
            away.append((error.var(0) / fresh.tau.var(0)).mean())
        errors[weights] = np.mean(away)
    assert errors["noise"] < errors["equal"]


def test_correlated_errors_count_for_less():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(20000, 1))
    slow = np.empty_like(white)
    slow[0] = white[0]
    for k in range(1, len(white)):
        slow[k] = 0.8 * slow[k - 1] + white[k]
    assert correlation_time([white])[0] == pytest.approx(1.0, abs=0.15)
    assert correlation_time([slow])[0] == pytest.approx((1 + 0.8) / (1 - 0.8), rel=0.2)


def test_unobservable_parameters_are_reported(robots):
    arm = load_arm(robots / "six_dof.urdf").chain
    samples, _ = excited(arm)
    samples.qd[:, 3:], samples.qdd[:, 3:], samples.q[:, 3:] = 0.0, 0.0, 0.4
    found = least_squares(arm, [samples], LeastSquares("range"))
    assert found.unseen > 0
    assert "do not excite" in found.text()
    assert "may be zero" in found._repr_html_()
    assert found.to_dict()["condition"] is None


def test_errors_name_the_missing_data(robots):
    arm = load_arm(robots / "two_link.urdf").chain
    with pytest.raises(LogError, match="24 Hz"):
        least_squares(arm, [], LeastSquares())


def trajectory(arm, **options):
    samples, _ = excited(arm, **options)
    t = 0.01 * np.arange(len(samples.q))
    return Trajectory(t, samples.q, samples.qd, samples.tau, "known")


def test_command(robots, tmp_path):
    robot = robots / "six_dof.urdf"
    arm = load_arm(robot).chain
    write_logs(tmp_path / "logs.parquet", [trajectory(arm, noise=0.02)], [c.name for c in arm.coordinates])
    base = ["identify", str(robot), "--data", str(tmp_path / "logs.parquet")]
    shown = CliRunner().invoke(app, base)
    assert shown.exit_code == 0, shown.output
    assert max(map(len, shown.stdout.splitlines())) <= 80
    assert "Condition number" in shown.stdout
    again = CliRunner().invoke(app, [*base, "--format", "json"])
    data = json.loads(again.stdout)
    assert data["schema"] == 3
    viscous = [x for x in data["base_parameters"] if x["name"].startswith("viscous")]
    assert [x["value"] for x in viscous] == pytest.approx([3.0] * 6, rel=0.1)
    assert all(x["determined"] == "firm" for x in viscous)


@pytest.mark.parametrize("seed", range(3))
def test_pseudo_inertia_is_pinocchios(seed):
    root = np.random.default_rng(seed).normal(size=(4, 4))
    ten = parameters_of(root @ root.T)
    theirs = ten[[0, 1, 2, 3, 4, 5, 7, 6, 8, 9]]  # Pinocchio's order is Ixx, Ixy, Iyy, Ixz, Iyz, Izz
    matrix = pin.PseudoInertia.FromDynamicParameters(theirs).toMatrix()
    np.testing.assert_allclose(pseudo_inertia(ten), matrix, atol=1e-12)
    np.testing.assert_allclose(parameters_of(pseudo_inertia(ten)), ten, atol=1e-12)
    _, possible = reference_factor(ten)
    assert possible


def test_an_impossible_body_is_replaced_by_the_nearest_possible_one():
    # a tensor with Izz > Ixx + Iyy: not physically consistent
    factor, possible = reference_factor(np.array([1.0, 0, 0, 0, 0.1, 0, 0, 0.1, 0, 0.5]))
    assert not possible
    ten = parameters_of(factor @ factor.T)
    assert np.linalg.eigvalsh(pseudo_inertia(ten))[0] > 0
    assert ten[9] < ten[4] + ten[7]
    assert ten[0] == pytest.approx(1.0)


TRAINING = ("20_02_10_30sec_12harm", "20_02_12_50sec_12harm", "20_02_05_20sec_8harm")
BASELINE = {  # published nMSE of these recordings, from ../shared/logs/README.md
    "19_12_23_free": 0.0056, "20_01_31_unload": 0.0138, "20_02_05_20sec_12harm": 0.0092,
    "20_02_06_20sec_10harm": 0.0118, "20_02_06_20sec_5harm": 0.0080, "20_02_10_20sec_7harm": 0.0138,
    "20_02_12_40sec_12harm": 0.0039, "20_02_19_14harm50sec": 0.0092, "20_02_19_15harm50sec": 0.0079,
}  # fmt: skip


def nmse(found, sample):
    error = found.torque(sample.q, sample.qd, sample.qdd) - sample.tau
    return (np.square(error).mean(0) / sample.tau.var(0)).mean()


def read(folder, names, arm):
    joints = [coordinate.name for coordinate in arm.coordinates]
    return [read_logs([folder / f"{name}.parquet"], joints)[0] for name in names]


def test_ur10e_gives_the_published_figures(shared):
    folder = shared / "logs" / "ur10e"
    arm = load_arm(folder / "ur10e.urdf").chain
    training = dynamics_samples(read(folder, TRAINING, arm))
    found = least_squares(arm, training, LeastSquares("range"))
    tests = dynamics_samples(read(folder, BASELINE, arm), pauses=True)
    measured = {sample.name: nmse(found, sample) for sample in tests}
    assert np.mean(list(measured.values())) == pytest.approx(0.0092, rel=0.05)
    assert measured == pytest.approx(BASELINE, rel=0.05)
    more = least_squares(
        arm, training, LeastSquares("range", friction=FrictionModel(stribeck=True, polynomial=True))
    )
    assert np.mean([nmse(more, sample) for sample in tests]) == pytest.approx(0.0087, rel=0.05)


@pytest.mark.parametrize("cutoff", [1.0, 8.0, 45.0, 160.0])
def test_samples_omit_the_transients_of_the_filter(cutoff):
    """Samples within the transients of the low-pass filter, at both ends of a log, are omitted.

    Without a filter, for cutoffs above 50 Hz, no sample is omitted.
    """
    t = np.arange(0.0, 10.0, 1e-3)
    q = np.column_stack([1.5 * np.sin(t)])
    log = Trajectory(t, q, 1.5 * np.column_stack([np.cos(t)]), -q, "swing")
    (sample,) = dynamics_samples([log], preprocessing=Preprocessing(cutoff=cutoff))
    left_out = 1000 - len(sample.q)
    moving = np.abs(1.5 * np.cos(np.arange(0.0, 10.0, 0.01))) > 0.02
    assert left_out == pytest.approx((~moving).sum() + 2 * 75 / cutoff, abs=3)
    assert np.abs(sample.qdd + sample.q).max() < 0.1


@pytest.mark.parametrize(("rate", "least"), [(50.0, "50"), (400.0, "200")])
def test_a_filter_beyond_the_samples_is_refused(rate, least):
    t = np.arange(0.0, 5.0, 1 / rate)
    swing = np.sin(t)[:, None]
    log = Trajectory(t, swing, np.cos(t)[:, None], -swing, "swing")
    with pytest.raises(LogError, match=f"expected below {least} Hz"):
        dynamics_samples([log], preprocessing=Preprocessing(cutoff=200.0))


def test_panda_gives_the_published_figure(shared):
    arm = load_arm(shared / "arms" / "panda_erd.urdf").chain
    (whole,) = read(shared / "logs" / "panda", ["exciting_traj1"], arm)
    cut = int(np.searchsorted(whole.t, whole.t[0] + 12.0))
    training, test = dynamics_samples([whole[:cut]]), dynamics_samples([whole[cut:]])
    found = least_squares(
        arm, training, LeastSquares("range", friction=FrictionModel(coulomb_smoothing_velocity=0.02))
    )
    assert nmse(found, test[0]) == pytest.approx(0.0056, rel=0.05)


@pytest.mark.parametrize(("option", "value"), [("friction", "memory"), ("weights", "rms")])
def test_a_wrong_option_is_an_error_where_it_is_given(option, value):
    with pytest.raises(SettingsError, match=f"^{option}: got '{value}'"):
        LeastSquares(**{option: value})


def test_python_accepts_lists_and_a_single_trajectory(robots):
    arm = load_arm(robots / "two_link.urdf")
    samples, _ = excited(arm.chain, seconds=4.0)
    found = least_squares(arm.chain, [samples], LeastSquares("range"))
    motion = [x[:3] for x in (samples.q, samples.qd, samples.qdd)]
    expected = found.torque(*motion)
    np.testing.assert_array_equal(found.torque(*(x.tolist() for x in motion)), expected)
    single = trajectory(arm.chain, seconds=4.0)
    assert check_logs(single, arm).to_dict() == check_logs([single], arm).to_dict()


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [(-0.0004557, 0.15, "0 ± 0.29"), (1.23456, 0.03, "1.235 ± 0.059"), (1234.5, 70.0, "1230 ± 1.4e+02")],
)
def test_an_estimate_has_no_digits_below_its_interval(value, std, text):
    assert Interval("offset", value, std).text == text


def test_a_table_of_parameters_explains_r_and_has_the_digits_of_the_intervals():
    """A value is rounded to the same decimal place as the half width of its interval, in the table of parameters.

    If a name ends with R, as in m1R (a parameter that includes parameters of other links), the note below explains R.
    """
    plain, combined = Interval("hx2", -0.232561, 0.019), Interval("m1R", 2.426412, 0.018)
    assert interval_listing("", [plain], "note").rows == (("hx2", "-0.233", "0.037", "fair"),)
    assert interval_listing("", [plain], "note").note == "note"
    listing = interval_listing("", [plain, combined], "note")
    assert listing.rows[1] == ("m1R", "2.426", "0.035", "firm")
    assert listing.note == "R: includes parameters of other links that act only in this combination. note"
