"""Sound logs of motions that users record get no finding about wrong columns, torques that change, or elastic joints.

One joint after the other moves, all joints follow sines of one frequency, or all move by 0.15 rad. Dry friction has a
hysteresis: it remains at the joint when the joint stops, and acts as a spring in small motions.
"""

import re
import sys

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

import spelgen
from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.trajectory import Trajectory

RATE = 100.0
FALSE = ("elastic-joint", "torque-scale", "torque-without-gravity", "urdf-inertials")


def one_after_the_other(n, rng):
    """Each of n joints moves forth and back by itself, and rests while the others move."""
    home, points = rng.uniform(-0.6, 0.6, n), []
    for k in range(n):
        for shift in (0.6, -0.6, 0.0):
            points.append(home + shift * np.eye(n)[k])
    s = np.clip(np.arange(round(2.5 * RATE)) / (2.0 * RATE), 0, 1)[:, None]
    rise = 10 * s**3 - 15 * s**4 + 6 * s**5
    return np.concatenate([a + (b - a) * rise for a, b in zip([home, *points[:-1]], points, strict=True)])


def synchronous(n, rng):
    """All joints follow a sine of 0.15 Hz, in phase or in antiphase."""
    t = np.arange(30 * RATE)[:, None] / RATE
    return rng.uniform(-0.6, 0.6, n) + rng.uniform(0.3, 0.8, n) * rng.choice([-1, 1], n) * np.sin(
        0.3 * np.pi * t
    )


def small(n, rng):
    """Each joint follows a sine of 0.3 to 1.2 Hz with an amplitude of 0.15 rad."""
    t = np.arange(30 * RATE)[:, None] / RATE
    frequency, phase = 2 * np.pi * rng.uniform(0.3, 1.2, n), rng.uniform(0, 6, n)
    return rng.uniform(-0.6, 0.6, n) + 0.15 * np.sin(frequency * t + phase)


def recorded(arm, motion, seed):
    """Return a log of an arm with inertials 30 % off, friction with hysteresis, and 1 % noise of the torques."""
    rng, n = np.random.default_rng(seed), len(arm.chain.coordinates)
    q = sosfiltfilt(butter(2, 8 / RATE, output="sos"), motion(n, rng), axis=0)
    t = np.arange(len(q)) / RATE
    qd = np.gradient(q, t, axis=0)
    parameters = urdf_parameters(arm.chain).reshape(-1, 10) * rng.uniform(
        0.7, 1.3, (len(arm.chain.bodies), 1)
    )
    tau = regressor(arm.chain, q, qd, np.gradient(qd, t, axis=0)) @ parameters.ravel()
    size = np.maximum(np.sqrt(np.square(tau).mean(axis=0)), 0.02 * np.sqrt(np.square(tau).mean(axis=0)).max())
    dry, breakaway = size * rng.uniform(0.1, 0.5, n), np.exp(rng.uniform(np.log(0.001), np.log(0.015), n))
    bristle = np.zeros_like(q)  # Dahl friction
    for k in range(1, len(q)):
        step = q[k] - q[k - 1]
        bristle[k] = np.clip(bristle[k - 1] + (step - np.abs(step) * bristle[k - 1]) / breakaway, -1, 1)
    tau += dry * bristle + size * rng.uniform(0.05, 0.3, n) * qd / np.abs(qd).max(axis=0)
    noise = 0.01 * size * rng.standard_normal(q.shape)
    return Trajectory(t, q, qd + 2e-3 * rng.standard_normal(q.shape), tau + noise, "motion")


@pytest.mark.parametrize(
    ("robot", "motion", "seed"),
    [
        ("six_dof", one_after_the_other, 1), ("six_dof", one_after_the_other, 2), ("six_dof", small, 12),
        ("ur10e", one_after_the_other, 3), ("scara", one_after_the_other, 1), ("scara", one_after_the_other, 3),
        ("scara", synchronous, 1), ("rpr", synchronous, 0),
    ],
)  # fmt: skip
def test_motions_of_users_give_no_false_finding(robots, robot, motion, seed):
    arm = load_arm(robots / f"{robot}.urdf")
    report = check_logs([recorded(arm, motion, seed)], arm)
    assert [str(error) for error in report.errors] == []
    assert [finding for finding in report.findings if finding.code in FALSE] == []


@pytest.mark.parametrize(
    ("robot", "motion", "seed"),
    [("six_dof", one_after_the_other, 2), ("ur10e", one_after_the_other, 3), ("ur10e", synchronous, 3)],
)
def test_motions_that_are_sampled_slowly_give_no_false_error(robots, monkeypatch, robot, motion, seed):
    """Filtered accelerations do not exist at 20 Hz: many hypotheses lower the larger residuals a little."""
    monkeypatch.setattr(sys.modules[__name__], "RATE", 20.0)
    arm = load_arm(robots / f"{robot}.urdf")
    assert check_logs([recorded(arm, motion, seed)], arm).errors == ()


def test_joints_in_phase_are_too_little_motion(robots):
    """If all positions are functions of one variable, exchanged joints or another gravity explain the torques."""
    arm = load_arm(robots / "six_dof.urdf")
    (finding,) = (
        x for x in check_logs([recorded(arm, synchronous, 2)], arm).findings if x.code == "small-motion"
    )
    assert finding.message.startswith("all joints move in phase")


def first_joint_at_rest(n, rng):
    """The first joint rests at 0.3 rad; the others move as in `small`."""
    q = small(n, rng)
    q[:, 0] = 0.3
    return q


def test_least_squares_takes_no_friction_from_the_noise_of_a_joint_at_rest(robots):
    """The friction of a joint at rest is 0, and a direction without excitation: it is not fitted to noise."""
    arm = load_arm(robots / "six_dof.urdf")
    log = recorded(arm, first_joint_at_rest, 1)
    for memory in (False, True):
        friction = spelgen.FrictionModel(memory=memory)
        result = spelgen.identify(arm, [log], spelgen.LeastSquares(friction=friction))
        drives = result.parameters[10 * len(arm.chain.bodies) :].reshape(-1, 6)
        rows = [k for k, effect in enumerate(friction.effects) if effect != "offset"]
        assert np.abs(drives[rows, 0]).max() < 1e-6 < np.abs(drives[rows, 1:]).max(axis=0).min()
        assert result.unseen > 0


def test_friction_of_a_joint_at_rest_does_not_come_from_a_placeholder_of_its_effort_limit(robots, tmp_path):
    path = tmp_path / "rpr.urdf"
    path.write_text(re.sub('effort="[^"]*"', 'effort="1000"', (robots / "rpr.urdf").read_text()))
    arm = load_arm(path)
    log = recorded(arm, first_joint_at_rest, 1)
    fit = spelgen.fit(spelgen.build(arm, "closed-form"), [log], arm=arm)
    assert fit.model.friction.prepare().coulomb[0] < log.tau[:, 0].std()
