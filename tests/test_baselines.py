"""Baselines are identified from the training logs, saved in the run folder, and integrated with accurate steps."""

import hashlib
import json
import math

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import spelgen
from spelgen.arm.configured_arm import load_arm
from spelgen.baselines.predictor import Solver, roll_out_stiff
from spelgen.baselines.registry import EvaluatedArm, urdf_values
from spelgen.cli.main import app
from spelgen.dynamics.bristles import moved_bristles
from spelgen.dynamics.regressor_dynamics import RegressorDynamics, regressor, urdf_parameters
from spelgen.emission.specify import generate
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.fitted import load_run
from spelgen.labels import URDF, URDF_WITH_DRIVES
from spelgen.logs.read import Trajectory, read_logs, write_logs
from spelgen.logs.windows import Windows

MOTION = (
    (np.sin, np.cos),
    (np.cos, lambda x: -2 * np.sin(x)),
    (lambda x: -np.sin(x), lambda x: -4 * np.cos(x)),
)
"""q, qd and qdd of two joints, of t and 2 t."""


class Slider:
    """A mass under a force, with viscous damping d: qdd = (tau - d qd) / m."""

    n = 1

    def __init__(self, mass, damping):
        self.mass, self.damping = mass, damping

    def mass_matrix(self, q):
        return torch.full((*q.shape, 1), self.mass, dtype=q.dtype)

    def friction_torque(self, q, qd):
        return self.damping * qd

    def forward_dynamics(self, q, qd, tau):
        return (tau - self.damping * qd) / self.mass


class Bristled(Slider):
    """A slider with hysteretic friction: a bristle of 2 N that breaks away at 1 mm, which is 2000 N/m at rest."""

    elements, reach, force = 1, torch.tensor([[1e-3]], dtype=torch.float64), 2.0

    def friction_torque(self, q, qd, z):
        return self.damping * qd + self.force * z[..., 0] / self.reach[:, 0]

    def forward_dynamics(self, q, qd, tau, z):
        return (tau - self.friction_torque(q, qd, z)) / self.mass

    def memory(self, qd):
        return qd.sign().unsqueeze(-1) * self.reach

    def memory_after(self, z, displacement):
        return moved_bristles(z, displacement.unsqueeze(-1), self.reach)


def pushed(steps=20, dt=0.05, push=2.0):
    shape = (3, steps + 1, 1)
    qd = torch.zeros(shape, dtype=torch.float64)
    qd[:, 0, 0] = torch.tensor([0.0, 1.0, -1.0])
    tau = torch.full((3, steps, 1), push, dtype=torch.float64)
    return Windows(torch.full((3, steps), dt, dtype=torch.float64), torch.zeros_like(qd), qd, tau)


def exact(slider, windows):
    t = windows.dt.cumsum(dim=1).unsqueeze(-1)
    rate, end = slider.damping / slider.mass, windows.tau[:, :1] / slider.damping
    return end + (windows.qd[:, :1] - end) * torch.exp(-rate * t)


def test_damping_far_beyond_an_explicit_step_is_integrated():
    # The damping rate is 5000 1/s: an explicit RK4 step of 0.05 s would multiply the velocity by 250^4 / 24 = 1.6e8.
    stiff, windows = Slider(1e-3, 5.0), pushed()
    qd = roll_out_stiff(stiff, windows, 1)[1]
    assert (qd[:, 2:] - exact(stiff, windows)[:, 2:]).abs().max() < 1e-2


def test_stiff_friction_with_a_state_is_integrated():
    # the force of 1 N is below the 2 N of friction, so that the slider does not slide
    stiff, windows = Bristled(1e-3, 5.0), pushed(push=1.0)
    q, qd = roll_out_stiff(stiff, windows, 8)
    held = 1e-3 / 2  # at rest the bristle holds 1 N of 2 N: z / reach = 1 / 2
    torch.testing.assert_close(q[0, -1], torch.tensor([held], dtype=torch.float64), atol=1e-7, rtol=0)
    assert qd[0, -1].abs() < 1e-5
    fast = pushed(push=6.0)  # steady velocity: (6 N of force - 2 N of friction) / (5 N s/m of damping)
    assert (roll_out_stiff(stiff, fast, 8)[1][:2, -1] - 0.8).abs().max() < 1e-6


def test_the_method_has_order_two():
    slider, windows = Slider(1.0, 1.5), pushed()
    errors = [
        (roll_out_stiff(slider, windows, steps)[1] - exact(slider, windows)).abs().max() for steps in (2, 4)
    ]
    assert 3.4 < errors[0] / errors[1] < 4.6


@pytest.mark.parametrize("damping, tolerance", [(0.01, 1e-6), (30.0, 1e-2), (3000.0, 1e-2)])
def test_method_and_steps_are_those_that_the_dynamics_need(damping, tolerance):
    slider, windows = Slider(1.0, damping), pushed()
    windows.qd[:, 1:] = exact(slider, windows)
    qd = Solver(slider, windows)(windows)[1]
    assert (qd - windows.qd[:, 1:]).abs().max() < tolerance


@pytest.mark.parametrize("robot", ["rpr", "panda"])
def test_torques_by_recursion_are_the_regressors(robots, robot):
    arm = load_arm(robots / f"{robot}.urdf").chain
    generator = np.random.default_rng(0)
    q, qd, qdd = generator.normal(size=(3, 20, len(arm.coordinates)))
    parameters = generator.normal(size=10 * len(arm.bodies))
    n = len(arm.coordinates)
    bodies = RegressorDynamics(arm, parameters, np.zeros(n), lambda qd, _: np.zeros_like(qd))
    torque = bodies.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd)))
    np.testing.assert_allclose(torque, regressor(arm, q, qd, qdd) @ parameters, rtol=1e-10, atol=1e-10)


def test_the_urdf_is_a_baseline_without_and_with_drives(robots):
    pytest.importorskip("pinocchio")
    arm = load_arm(robots / "rpr.urdf")
    names = [coordinate.name for coordinate in arm.chain.coordinates]
    q = torch.zeros(1, 4, 3, dtype=torch.float64)
    probe = Windows(torch.full((1, 3), 0.05, dtype=torch.float64), q, q, q[:, :3])
    predictors = urdf_values(EvaluatedArm(names, arm.robot.path, {}, None, probe, []))
    plain, driven = predictors.values()
    assert list(predictors) == [URDF, URDF_WITH_DRIVES]
    at = torch.full((1, 3), 0.3, dtype=torch.float64)
    rotors = [arm.settings.joint(name) for name in names]
    expected = [x.rotor_inertia * x.gear**2 for x in rotors]
    added = driven.dynamics.mass_matrix(at) - plain.dynamics.mass_matrix(at)
    np.testing.assert_allclose(added[0], np.diag(expected), atol=1e-12)
    fast = torch.full((1, 3), 5.0, dtype=torch.float64)
    lost = driven.dynamics.friction_torque(at, fast)[0].tolist()
    for found, joint in zip(lost, rotors, strict=True):
        assert found == pytest.approx(5 * joint.viscous + joint.coulomb[0])
    back = driven.dynamics.friction_torque(at, -fast)[0].tolist()
    for found, joint in zip(back, rotors, strict=True):
        assert found == pytest.approx(-5 * joint.viscous + joint.coulomb[1])
    assert not math.isnan(sum(lost))


def test_a_resumed_run_fits_baselines_only_if_they_are_missing(robots, tmp_path, monkeypatch):
    """A resumed run keeps its baselines, as its logs are the same, and fits only baselines that its folder lacks."""
    arm = load_arm(robots / "two_link.urdf")
    bodies = RegressorDynamics(arm.chain, urdf_parameters(arm.chain), np.zeros(2), lambda qd, _: 0.5 * qd)
    t = np.arange(300) / 100
    q, qd, qdd = (np.stack([f(t), g(2 * t)], axis=1) for f, g in MOTION)
    tau = noisy(bodies.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd))).numpy())
    logs = [Trajectory(t=t, q=q, qd=qd, tau=tau)]
    folder, resume = tmp_path / "run", RunOptions(resume=True)
    first = spelgen.fit(spelgen.build(arm, "closed-form"), logs, arm=arm, folder=folder)
    assert first.baselines["parameters"]
    kept = (folder / "least_squares.json").read_bytes()
    (folder / "least_squares.json").unlink()
    spelgen.fit(load_run(folder).model, logs, folder=folder, options=resume)
    assert (folder / "least_squares.json").read_bytes() == kept

    def refuse(*arguments):
        raise AssertionError("fitted again")

    monkeypatch.setattr("spelgen.fitting.fit.fit_baselines", refuse)
    again = spelgen.fit(load_run(folder).model, logs, folder=folder, options=resume)
    assert (folder / "least_squares.json").read_bytes() == kept
    assert again.baselines == json.loads(kept)


def noisy(tau):
    """Return torques (T, n) with noise of 0.2 %; without noise a fit would take many more iterations."""
    return tau + 0.002 * tau.std(axis=0) * np.random.default_rng(2).standard_normal(tau.shape)


def run_command(*words):
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    return done.stdout


def digests(folder):
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_least_squares_is_kept_with_a_run_and_evaluated(robots, tmp_path):
    """The least-squares model is stored with a run, and has a negligible torque error on a test log.

    The logs are simulated with the inertias of the URDF.
    """
    arm = load_arm(robots / "rpr.urdf")
    bodies = RegressorDynamics(arm.chain, urdf_parameters(arm.chain), np.full(3, 0.1), lambda qd, _: 0.5 * qd)
    names = [coordinate.name for coordinate in arm.chain.coordinates]
    t = np.arange(300) / 100
    for role, seed in (("train", 0), ("test", 1)):
        phases = np.random.default_rng(seed).uniform(0, 6, (3, 3, 1))
        waves = [(k + 1) * t + phases[k] for k in range(3)]
        q = sum(0.1 * np.sin(x) for x in waves).T + np.array([0, 0.3, 0])
        qd = sum(0.1 * (k + 1) * np.cos(x) for k, x in enumerate(waves)).T
        qdd = sum(-0.1 * (k + 1) ** 2 * np.sin(x) for k, x in enumerate(waves)).T
        tau = noisy(bodies.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd))).numpy())
        write_logs(tmp_path / "logs" / f"{role}.parquet", [Trajectory(t=t, q=q, qd=qd, tau=tau)], names)
    module, folder = tmp_path / "rpr.py", tmp_path / "run"
    module.write_text(generate(robots / "rpr.urdf", "closed-form"), encoding="utf-8")
    logs = ["--data", str(tmp_path / "logs")]
    # a time limit that the fit does not reach
    quick = ["--set", "progress=false", "--set", "max_minutes=5"]
    run_command("train", str(module), "--robot", str(robots / "rpr.urdf"), *logs, "-o", str(folder), *quick)
    trained = digests(folder)
    run_command("evaluate", str(folder), *logs, "--quick")
    text = run_command("evaluate", str(folder), *logs)
    after = digests(folder)
    assert after.pop("evaluation.json"), "the one file that evaluate writes"
    assert after == trained
    # The test recording has the name of the training recording, but other samples. It does not count as training data:
    # otherwise the assessment would begin with "Evaluated on training logs".
    assert text.startswith("Good enough for "), "the assessment comes first"
    run_command("report", str(folder))
    kept = json.loads((folder / "least_squares.json").read_text())
    assert load_run(folder).baselines == kept
    again = load_run(folder).save(tmp_path / "again")
    assert (again / "least_squares.json").read_bytes() == (folder / "least_squares.json").read_bytes()
    in_memory = spelgen.fit(
        spelgen.load_module(module), read_logs(tmp_path / "logs" / "train.parquet", arm), arm=arm
    )
    assert json.loads(json.dumps(in_memory.baselines)) == kept, "in Python as on the command line"
    found = json.loads((folder / "evaluation.json").read_text())
    evaluated = spelgen.evaluate(in_memory, read_logs(tmp_path / "logs" / "test.parquet", arm))
    assert json.loads(json.dumps(evaluated.to_dict())) == found
    assert {"model", "least squares"} <= set(found["torque"])
    assert found["torque"]["least squares"]["mean_nmse"] < 1e-3
    assert found["horizons"][-1]["errors"]["least squares"]["mean_relative_rms"] < 0.05
    (trace,) = found["traces"]["torques"]
    parts = sum(np.array(part) for part in trace["parts"].values())
    # the parts sum to the prediction, except the torque offset, which is not listed
    np.testing.assert_allclose(parts, trace["predicted"]["model"], atol=0.05)
    assert "nMSE over all test samples" in text
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Base parameters" in page and "without epochs" in page and "Masses, centres of mass" in page
