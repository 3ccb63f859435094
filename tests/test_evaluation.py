"""Evaluation: the true model has no error, baselines equal dynamics derived by hand, and results are valid JSON."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
import typer
from planar_model import JOINTS, write_module
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.baselines.registry import hold_velocity
from spelgen.cli import evaluate_command
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.pinocchio_dynamics import urdf_dynamics
from spelgen.dynamics.tip import tip_kinematics
from spelgen.emission.assemble import load_module
from spelgen.emission.build import build
from spelgen.emission.specify import generate
from spelgen.errors import Diagnostic, LogError, RunError
from spelgen.evaluation.evaluate import evaluate, read_test_logs
from spelgen.evaluation.rollout import rollout
from spelgen.evaluation.tables import table
from spelgen.evaluation.torque import coarse_torques, torque_errors
from spelgen.fitting.fitted import load_run
from spelgen.fitting.train import train
from spelgen.identification.identification import Identification
from spelgen.identification.identify import identify
from spelgen.labels import observed
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import Trajectory, read_logs, write_logs
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.fits import Rollout

UR10E = [
    f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]

# a slider of 3 kg with a pendulum of 2 kg at 0.5 m, whose inertia about its centre is 0.1 kg m^2; both have damping
CART = """<robot name="cart">
  <link name="rail"/>
  <joint name="swing" type="continuous"><parent link="cart"/><child link="rod"/><axis xyz="0 -1 0"/>
    <dynamics damping="0.3" friction="0"/></joint>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="5"/><dynamics damping="0.7" friction="0"/></joint>
  <joint name="tip" type="fixed"><parent link="rod"/><child link="weight"/><origin xyz="0 0 -1"/></joint>
  <link name="cart"><inertial><mass value="3"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="weight"/>
</robot>"""


@pytest.fixture
def cart(tmp_path) -> Path:
    pytest.importorskip("pinocchio")
    path = tmp_path / "cart.urdf"
    path.write_text(CART)
    return path


def draw(*shape, seed=0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cart_torque(q, qd, qdd):
    """Return the inverse dynamics of the cart, derived by hand, (T, 2) [N, Nm]; joints: slide s and swing a.

    The pendulum's centre of mass is at x = s + 0.5 sin a, z = -0.5 cos a.
    """
    a, length, m, inertia, g = q[:, 1], 0.5, 2.0, 0.1, 9.81
    push, turn = m * length * a.cos(), m * length * a.sin()
    slide = (3 + m) * qdd[:, 0] + push * qdd[:, 1] - turn * qd[:, 1] ** 2 + 0.7 * qd[:, 0]
    swing = push * qdd[:, 0] + (inertia + m * length**2) * qdd[:, 1] + g * turn + 0.3 * qd[:, 1]
    return torch.stack([slide, swing], dim=-1)


def test_the_urdf_baseline_has_the_dynamics_of_the_urdf(cart):
    dynamics = urdf_dynamics(cart, ("slide", "swing"))
    q, qd, qdd = draw(20, 2), draw(20, 2, seed=1), draw(20, 2, seed=2)
    tau = cart_torque(q, qd, qdd)
    torch.testing.assert_close(dynamics.inverse_dynamics(q, qd, qdd), tau, atol=1e-12, rtol=0)
    torch.testing.assert_close(dynamics.forward_dynamics(q, qd, tau), qdd, atol=1e-11, rtol=0)


def test_the_urdf_baseline_reads_every_encoding(robots, tmp_path):
    text = (robots / "two_link.urdf").read_text()
    text = re.sub(r"<\?xml.*?\?>", "", text)
    path = tmp_path / "arm.urdf"
    path.write_bytes(text.encode("utf-16"))
    q = np.array([[0.3, -0.4]])
    names = load_arm(path).chain.joint_names
    expected = urdf_dynamics(robots / "two_link.urdf", names).mass_matrix(q)
    np.testing.assert_array_equal(urdf_dynamics(path, names).mass_matrix(q), expected)


def test_pinocchios_configurations_of_any_batch_are_those_of_each_state(cart):
    dynamics = urdf_dynamics(cart, ("slide", "swing"))
    q = draw(3, 4, 2).numpy()
    neutral = pin.neutral(dynamics.model)
    each = np.apply_along_axis(lambda moved: pin.integrate(dynamics.model, neutral, moved), -1, q)
    np.testing.assert_allclose(dynamics.configuration(q), each, atol=1e-15)
    np.testing.assert_allclose(dynamics.configuration(q[0, 0]), each[0, 0], atol=1e-15)
    assert dynamics.configuration(q[:0]).shape == (0, 4, 3)


def test_the_urdf_baseline_has_the_requested_order_of_joints(cart):
    q, qd, qdd = draw(20, 2), draw(20, 2, seed=1), draw(20, 2, seed=2)
    turned = urdf_dynamics(cart, ("swing", "slide"))
    tau = turned.inverse_dynamics(q.flip(-1), qd.flip(-1), qdd.flip(-1))
    torch.testing.assert_close(tau.flip(-1), cart_torque(q, qd, qdd), atol=1e-12, rtol=0)


def test_the_urdf_baseline_locks_other_joints(cart):
    dynamics = urdf_dynamics(cart, ("swing",))
    q, qd, qdd = draw(20, 1), draw(20, 1, seed=1), draw(20, 1, seed=2)
    whole = [torch.cat([torch.zeros(20, 1), x], dim=-1) for x in (q, qd, qdd)]
    torch.testing.assert_close(
        dynamics.inverse_dynamics(q, qd, qdd), cart_torque(*whole)[:, 1:], atol=1e-12, rtol=0
    )


def test_the_gravity_of_the_settings_counts(cart):
    cart.with_suffix(".yaml").write_text("gravity: [0, 0, 0]\n")
    still = torch.zeros(1, 2, dtype=torch.float64)
    tau = urdf_dynamics(cart, ("slide", "swing")).inverse_dynamics(still + 1, still, still)
    torch.testing.assert_close(tau, still, atol=1e-14, rtol=0)


def test_the_tip_is_the_end_of_the_fixed_links(cart):
    q = draw(4, 5, 2)
    x, z = q[..., 0] + q[..., 1].sin(), -q[..., 1].cos()
    expected = torch.stack([x, torch.zeros_like(x), z], dim=-1)
    for tip in (None, "weight"):
        position = tip_kinematics(cart, tip, joints=("slide", "swing")).position
        torch.testing.assert_close(position(q), expected, atol=1e-12, rtol=0)
    with pytest.raises(ValueError, match="the joints swing do not lead to cart"):
        tip_kinematics(cart, "cart", joints=("slide", "swing"))


def test_constant_velocity_is_exact_without_acceleration():
    dt = 0.1 + 0.05 * torch.rand(4, 3, dtype=torch.float64)
    qd = draw(4, 1, 2)
    t = torch.cat([torch.zeros(4, 1), dt.cumsum(dim=1)], dim=1)
    windows = Windows(dt, t.unsqueeze(-1) * qd, qd.expand(-1, 4, -1), draw(4, 3, 2))
    q, velocity = hold_velocity(windows)
    torch.testing.assert_close(q, windows.q[:, 1:])
    torch.testing.assert_close(velocity, windows.qd[:, 1:])


def motions(model, count=4, samples=25, rate=20.0, seed=0) -> list[Trajectory]:
    """Return trajectories of a model under random torques that are constant between samples."""
    random = torch.Generator().manual_seed(seed)
    start = 2 * torch.rand(count, model.n, generator=random, dtype=torch.float64) - 1
    tau = torch.randint(-2, 3, (count, samples, model.n), generator=random).double()
    with torch.no_grad():
        q, qd = rollout(
            model, start, torch.zeros_like(start), tau[:, :-1], 1 / rate, substeps=round(320 / rate)
        )
    t = np.arange(samples) / rate
    return [Trajectory(t, q[k], qd[k], tau[k], f"motion_{seed}{k}") for k in range(count)]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Return a run folder. Its model also made the logs, and a learning rate of 1e-12 hardly changes the model."""
    folder = tmp_path_factory.mktemp("run")
    module = write_module(folder)
    model = load_module(module)
    for role, seed in (("train", 0), ("test", 1)):
        write_logs(folder / "logs" / f"{role}.parquet", motions(model, seed=seed), JOINTS)
    config = Rollout(epochs=1, optimizer="adamw", batch=32, learning_rate=1e-12, momentum_steps=0)
    train(module, [folder / "logs"], folder / "run", config)
    return folder / "run"


def evaluated(run, logs, **options):
    return evaluate(run, read_test_logs(run, [logs]), **options)


def test_the_true_model_has_no_error_and_its_baseline_has(run):
    result = evaluated(run, run.parent / "logs")
    assert [(x.name, x.steps, x.windows) for x in result.horizons] == [
        # The four logs have 25 samples each. A window has two samples before the prediction, for predictors that use
        # earlier samples, and k + 1 samples for a prediction over k steps: 23 - k windows per log.
        ("1 step", 1, 4 * 22),
        ("10 steps", 10, 4 * 13),
        ("1 s", 20, 4 * 3),
    ]
    for horizon in result.horizons:
        assert horizon.seconds == pytest.approx(horizon.steps / 20)
        assert horizon.errors["model"].mean_relative_rms < 1e-4
        assert horizon.errors["velocity stays constant"].mean_relative_rms > 0.3
    assert result.parameters == sum(x.numel() for x in load_run(run).model.parameters())
    # torques are not evaluated at 20 Hz, at which accelerations cannot be computed
    assert result.torque == {}


def test_without_rollouts_logs_too_sparse_for_torques_are_an_error(run):
    with pytest.raises(LogError, match=r"torques need accelerations, .*24 Hz or faster.*; omit --quick"):
        evaluated(run, run.parent / "logs", steps=(), seconds=())


def test_errors_are_those_of_the_last_sample(run):
    told = []
    result = evaluated(
        run, run.parent / "logs", steps=(3,), seconds=(), progress=lambda *stage: told.append(stage)
    )
    assert told == [(0, 1, "predicting 3 steps ahead")]
    windows = cut_windows(read_logs([run.parent / "logs"], JOINTS, role="test"), 6, measured=False)
    # predictions start at the third sample, since the observer uses the first two
    error = windows.qd[:, 2] - windows.qd[:, 5]
    found = result.horizons[0].errors["velocity stays constant"]
    np.testing.assert_allclose(found.qd, error.square().mean(dim=0).sqrt(), rtol=1e-12)
    np.testing.assert_allclose(found.qd_relative_rms, [1.0, 1.0], rtol=1e-12)


def test_the_same_run_and_logs_give_the_same_file(run):
    app, files = typer.Typer(), []
    app.command()(evaluate_command.evaluate)
    for _ in range(2):
        shown = CliRunner().invoke(app, [str(run), "--data", str(run.parent / "logs")])
        assert shown.exit_code == 0, shown.output
        files.append((run / "evaluation.json").read_bytes())
    assert files[0] == files[1]
    assert "planar on 4 test trajectories; * marks the best of a row" in shown.stdout
    found = json.loads(files[0], parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert found["schema"] == 12
    shown = found["traces"]["trajectories"]
    assert [x["which"] for x in shown] == ["typical", "worst"]
    assert len(shown[0]["q"]) == len(shown[0]["t"]) == 21 and len(shown[0]["q"][0]) == 2
    np.testing.assert_allclose(shown[0]["predicted_qd"], shown[0]["qd"], atol=1e-3)
    assert shown[0]["error"] <= shown[1]["error"]


def test_predicted_windows_start_at_a_time_of_the_log(run):
    logs = read_logs([run.parent / "logs"], JOINTS, role="test")
    logs = [replace(log, t=log.t + 100.0) for log in logs]
    for shown in evaluate(run, logs).traces.trajectories:
        log = next(log for log in logs if log.name == shown.trajectory)
        np.testing.assert_allclose(shown.q[0], log.q[np.abs(log.t - shown.start).argmin()], atol=1e-4)
        assert shown.start >= 100.0


def test_parts_of_an_evaluation_that_are_omitted_are_stated(run):
    result = evaluated(run, run.parent / "logs" / "train.parquet", seconds=(5.0,))
    assert {x.code: x.message for x in result.diagnostics} == {
        "tested-on-training-data": "samples also used in training: motion_00, motion_01, motion_02, motion_03; "
        "errors on training data are not test errors",
        "horizon-too-long": "no prediction over 5 s: the longest trajectory has 24 steps",
        "low-rate": "20 Hz: too slow for fits to torques, which need 24 Hz; motion faster than 10 Hz, delays below "
        "50 ms and friction where a joint reverses are not visible at this rate (and in 3 more trajectories)",
        "no-urdf-baseline": "no comparison with the URDF: no arm is known",
    }


def test_a_diverging_model_has_errors_of_null(run, tmp_path):
    weights = torch.load(run / "model.pt", weights_only=True)
    copy = tmp_path / "run"
    copy.mkdir()
    for path in run.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    # the network of V gives gravity torques of about 1e12 Nm, so that the rollout diverges
    name = "potential.weights.1"
    torch.save(weights | {name: torch.full_like(weights[name], 1e12)}, copy / "model.pt")
    result = evaluated(copy, run.parent / "logs")
    last = result.horizons[-1]
    assert last.errors["model"].mean_relative_rms is None
    assert "NaN" not in json.dumps(result.to_dict())


def test_a_folder_that_is_no_run_is_refused(run, tmp_path):
    with pytest.raises(RunError) as caught:
        evaluate(tmp_path / "none", [])
    assert str(caught.value) == (
        f"{tmp_path}/none: got no such run, expected a folder with config.json; make one with `spelgen train`"
    )
    with pytest.raises(LogError, match="got no such file or folder, expected a log; check the path"):
        read_test_logs(run, [tmp_path / "none.parquet"])


@pytest.mark.usefixtures("short_epochs")
def test_a_urdf_run_is_compared_in_torque_and_at_the_tip(cart):
    """The logs are simulated with the URDF's dynamics, so the URDF baseline has no errors, in torque and at the tip."""
    module = cart.with_name("cart_model.py")
    module.write_text(generate(cart))
    names = load_module(module).joint_names
    dynamics = urdf_dynamics(cart, names)
    for role, seed in (("train", 0), ("test", 1)):
        logs = motions(dynamics, count=2, samples=130, rate=100.0, seed=seed)
        write_logs(cart.parent / "logs" / f"{role}.parquet", logs, names)
    config = Rollout(epochs=1, momentum_steps=0)
    logs = [cart.parent / "logs"]
    train(module, logs, cart.parent / "run", config, of_logs={"cutoff": 0.0})
    result = evaluated(cart.parent / "run", logs[0])
    for horizon in result.horizons:
        assert horizon.errors["URDF"].mean_relative_rms < 1e-4
        assert horizon.errors["URDF"].tip_mm < min(1e-3, horizon.errors["model"].tip_mm)
    assert result.torque["URDF"].mean_nmse < result.torque["model"].mean_nmse
    assert not [x for x in result.diagnostics if x.code.startswith("no-")]


def test_positions_beyond_two_turns_are_right_for_a_joint_without_limits(cart):
    """`spelgen logs` accepts such a log, and so do `identify` and `evaluate`."""
    arm = load_arm(cart)
    t = torch.arange(400.0, dtype=torch.float64) / 100
    q = torch.stack([0.3 * torch.sin(3 * t), 5 * t], dim=-1)
    qd = torch.stack([0.9 * torch.cos(3 * t), torch.full_like(t, 5)], dim=-1)
    qdd = torch.stack([-2.7 * torch.sin(3 * t), torch.zeros_like(t)], dim=-1)
    log = Trajectory(t.numpy(), q.numpy(), qd.numpy(), cart_torque(q, qd, qdd).numpy(), "turning")
    assert isinstance(identify(arm, log), Identification)
    result = evaluate(build(arm, preset="closed-form"), [log], arm=arm, steps=(1,), seconds=())
    assert result.torque["URDF"].mean_nmse < 1e-6


def test_a_model_in_memory_is_judged_beside_any_dynamics(cart):
    """`evaluate` compares a model in memory with other dynamics on logs in memory, without a run folder or files.

    The argument `preprocessing` sets the cutoff [Hz] of the low-pass filter. The filter also applies to torques: the
    cutoffs 0 (no filter) and 3 Hz give different torque errors.
    """
    arm = load_arm(cart)
    model, dynamics = build(arm, preset="closed-form"), urdf_dynamics(cart, ["slide", "swing"])
    logs = motions(dynamics, count=2, samples=130, rate=100.0)
    result = evaluate(
        model, logs, arm=arm, baselines={"truth": dynamics}, preprocessing=Preprocessing(cutoff=0.0)
    )
    for horizon in result.horizons:
        with_dynamics = {"model", "URDF", "truth"}
        assert set(horizon.errors) == with_dynamics | {"velocity stays constant"} | set(
            map(observed, with_dynamics)
        )
        assert horizon.errors["truth"] == horizon.errors["URDF"]
    assert repr(result).startswith("<Results of cart on 2 test trajectories, relative RMS ")
    assert "velocity stays constant" in result._repr_html_()
    short = {"steps": (1,), "seconds": ()}
    filtered = evaluate(model, logs, arm=arm, preprocessing=Preprocessing(cutoff=3.0), **short)
    assert filtered.cutoff == 3.0
    assert filtered.torque["model"] != result.torque["model"]
    assert "no-urdf-baseline" in {x.code for x in evaluate(model, logs, **short).diagnostics}


def test_mimic_joints_have_baselines_tips_and_predictions(cart):
    """An arm with a mimic joint has baselines, tip errors and predictions, also in single precision.

    The logs are simulated from its URDF, in which the joint of the pendulum mimics the slider.
    """
    mimic = '<axis xyz="0 -1 0"/><mimic joint="slide" multiplier="2" offset="0.1"/>'
    cart.write_text(CART.replace('<axis xyz="0 -1 0"/>', mimic))
    arm = load_arm(cart)
    (log,) = motions(urdf_dynamics(cart, ["slide"]), count=1, samples=130, rate=100.0)
    model = build(arm, preset="closed-form")
    result = evaluate(model, log, arm=arm, preprocessing=Preprocessing(cutoff=0.0))
    assert result.joints == ("slide",)
    assert not [x for x in result.diagnostics if x.code.startswith("no-")]
    for horizon in result.horizons:
        assert horizon.errors["URDF"].mean_relative_rms < 1e-3
        assert 0 <= horizon.errors["URDF"].tip_mm < horizon.errors["model"].tip_mm
    single = evaluate(
        model.float(), log, arm=arm, preprocessing=Preprocessing(cutoff=0.0), steps=(1,), seconds=()
    )
    assert single.horizons[0].errors["model"].mean_relative_rms == pytest.approx(
        result.horizons[0].errors["model"].mean_relative_rms, rel=1e-3
    )
    assert next(model.parameters()).dtype == torch.float32


def test_rollouts_have_any_batch_shape_and_solver(cart):
    dynamics = urdf_dynamics(cart, ("slide", "swing"))
    q, qd, tau = draw(3, 2), draw(3, 2, seed=1), draw(4, 3, 5, 2, seed=2)
    positions, velocities = rollout(dynamics, q, qd, tau, 0.01)
    assert positions.shape == velocities.shape == (4, 3, 6, 2)
    alone = rollout(dynamics, q[1], qd[1], tau[2, 1], torch.full((5,), 0.01, dtype=torch.float64))
    torch.testing.assert_close((positions[2, 1], velocities[2, 1]), alone)
    adaptive = rollout(dynamics, q, qd, tau, 0.01, solver="dopri5")
    torch.testing.assert_close(adaptive, (positions, velocities), atol=1e-6, rtol=0)


def moving(samples=600, rate=100.0, still=0) -> Trajectory:
    t = np.arange(samples) / rate
    phase = 2 * np.pi * np.maximum(t - still / rate, 0.0)
    q, qd = np.stack([1 - np.cos(phase)] * 2, 1), 2 * np.pi * np.stack([np.sin(phase)] * 2, 1)
    tau = (2 * np.pi) ** 2 * np.stack([np.cos(phase), 0 * phase], 1)
    return Trajectory(t, q, qd, tau, "moving")


class Torques:
    """Dynamics of which only inverse dynamics are known."""

    def __init__(self, inverse_dynamics):
        self.inverse_dynamics = inverse_dynamics


def test_torque_errors_by_the_protocol():
    (samples,) = dynamics_samples([moving()])
    exact = torque_errors(Torques(lambda q, qd, qdd: torch.stack([qdd[:, 0], 0 * qdd[:, 1]], -1)), [samples])
    # not exactly zero, because of errors of the filter at the ends of the log
    assert exact.joint_nmse[0] < 1e-3
    assert exact.joint_nmse[1] is None  # nMSE is undefined for a torque that never varies
    tau = torch.from_numpy(samples.tau)
    offset = torque_errors(Torques(lambda q, qd, qdd: tau + torch.tensor([1.0, 2.0])), [samples])
    np.testing.assert_allclose(offset.rmse, [1.0, 2.0], rtol=1e-12)
    np.testing.assert_allclose(offset.joint_nmse[0], 1 / samples.tau[:, 0].var(), rtol=1e-12)
    # the torque of joint 2 is constant up to rounding
    constant = np.where(samples.tau[:, :1] > 0, 0.1 + 0.2, 0.3)
    rounded = replace(samples, tau=np.concatenate([samples.tau[:, :1], constant], axis=1))
    assert torque_errors(Torques(lambda q, qd, qdd: tau), [rounded]).joint_nmse == (0.0, None)
    infinite = torque_errors(Torques(lambda q, qd, qdd: tau / 0), [samples])
    assert infinite.mean_nmse is None


def test_torque_errors_are_pooled_over_samples_with_pauses_and_without():
    """Torque errors are pooled over all samples of all logs, once with pauses and once without.

    A short log whose torque hardly varies has a large nMSE by itself, but its few samples change the total only little.
    """
    random = np.random.default_rng(0)
    samples = []
    for name, count, size in (("long", 400, 10.0), ("short", 50, 0.1)):
        motion = random.standard_normal((count, 2))
        motion[: count // 5] = 0.001  # the first fifth of each log is at rest
        tau = size * random.standard_normal((count, 2))
        samples.append(DynamicsSamples(name, motion, motion, motion, tau))
    found = torque_errors(Torques(lambda q, qd, qdd: torch.zeros_like(q) + 0.2), samples)
    tau = np.concatenate([x.tau for x in samples])
    moves = np.concatenate([np.abs(x.qd).max(axis=1) > 0.02 for x in samples])
    pooled = ((tau[moves] - 0.2) ** 2).mean(axis=0) / tau[moves].var(axis=0)
    np.testing.assert_allclose(found.joint_nmse, pooled, rtol=1e-12)
    assert found.mean_nmse == pytest.approx(pooled.mean())
    assert found.nmse_with_pauses == pytest.approx((((tau - 0.2) ** 2).mean(axis=0) / tau.var(axis=0)).mean())
    np.testing.assert_allclose(found.rmse, np.sqrt(((tau[moves] - 0.2) ** 2).mean(axis=0)))
    assert found.nmse["short"] > 4 and found.mean_nmse < 1.1


def test_steps_of_dry_friction_are_filtered_as_the_torque_is(robots):
    """Dry friction reverses in a step; the predicted step passes the same low-pass filter as the logged torque."""
    model = build(robots / "two_link.urdf", preset="closed-form")
    model.friction.memoryless.fill_(1.0)
    with torch.no_grad():
        model.friction.raw_coulomb += 1.0  # the steps of Coulomb friction at reversals dominate the torque
    t = np.arange(2000) / 200
    frequencies = 2 * np.pi * np.array([0.4, 0.7])
    phase = frequencies * t[:, None]
    q, qd, qdd = np.sin(phase), frequencies * np.cos(phase), -(frequencies**2) * np.sin(phase)
    with torch.no_grad():
        tau = model.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd))).numpy()
    samples = dynamics_samples([Trajectory(t, q, qd, tau)], reach=bristle_reach(model))
    error = torque_errors(model, samples).mean_nmse
    # The filtered sign of the velocity, `direction`, is computed at the times of the log (200 Hz): the error is 8e-7.
    # Computed at the 100 Hz of the samples, it would give 5e-6; without it (None), friction steps are not filtered.
    assert error < 2e-6
    unfiltered = [replace(x, direction=None) for x in samples]
    assert torque_errors(model, unfiltered).mean_nmse > 10 * error


def test_torques_in_steps_of_their_own_size_are_found():
    t, random = np.arange(2000) / 100, np.random.default_rng(1)
    tau = np.stack([np.sin(t), 2 * np.sin(3 * t)], axis=1) + 0.01 * random.standard_normal((2000, 2))
    log = Trajectory(t, tau, tau, np.stack([np.round(tau[:, 0] / 0.5) * 0.5, tau[:, 1]], axis=1), "coarse")
    notes: list[Diagnostic] = []
    assert coarse_torques([log], ["a", "b"], notes) == {"a": pytest.approx(0.5)}
    assert [(note.code, "torque of a" in note.message) for note in notes] == [("coarse-torque", True)]


def test_only_moving_samples_of_dense_logs_count():
    (samples,) = dynamics_samples([moving(still=200)])
    assert len(samples.q) == pytest.approx(400, abs=15)
    assert dynamics_samples([moving(rate=20.0)]) == []


def test_the_ur10e_urdf_has_its_known_torque_error(shared):
    """The mean nMSE of the UR10e's URDF over nine test trajectories is 0.67, as computed independently."""
    pytest.importorskip("pinocchio")
    folder = shared / "logs" / "ur10e"
    trained = ("20_02_10_30sec_12harm", "20_02_12_50sec_12harm", "20_02_05_20sec_8harm")
    others = ("ptp", "load_2600", "_load", "secLoad")
    paths = [
        x
        for x in folder.glob("*.parquet")
        if x.stem not in trained and not any(map(x.stem.__contains__, others))
    ]
    samples = dynamics_samples(read_logs(sorted(paths), UR10E))
    assert len(samples) == 9
    dynamics = urdf_dynamics(folder / "ur10e.urdf", UR10E)
    found = torque_errors(dynamics, samples)
    assert np.mean(list(found.nmse.values())) == pytest.approx(0.67, abs=0.005)


@pytest.mark.parametrize("samples", [2, 300])
def test_logs_without_motion_are_refused(robots, samples):
    t, noise = np.arange(samples) / 100, 1e-3 * np.random.default_rng(0).standard_normal((samples, 2))
    with pytest.raises(LogError, match="no motion: all joints stay within"):
        evaluate(build(robots / "two_link.urdf", "closed-form"), Trajectory(t, noise, noise, noise))


def test_a_diverged_predictor_keeps_its_column():
    text = table("Prediction loss", {"seed 0": {"phnode": None, "spel": 1.0}}).text()
    assert "phnode" in text and text.splitlines()[-1].split() == ["seed", "0", "-", "1", "*"]


def test_a_column_without_a_star_ends_with_its_digits():
    """In columns with a star, the mark of a row's smallest number, a blank replaces the star of the other numbers.

    The blank aligns the digits of the column. The column `URDF` has no star, and therefore no trailing blanks.
    """
    shown = table("errors", {"a": {"model": 1.0, "URDF": 2.0}, "b": {"model": 3.0, "URDF": 4.0}})
    assert shown.head == ("", "model  ", "URDF") and shown.rows == (("a", "1 *", "2"), ("b", "3 *", "4"))
