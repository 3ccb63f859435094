"""Elastic joints are named with the frequency of their resonance; logs of rigid joints are accepted.

The link moves as prescribed, torques are the URDF's, and the motor is ahead of the link by the torque divided by the
stiffness of the spring between them (Spong's model). The log has motor positions and motor torques.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_assessment import evaluation

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.errors import Diagnostic
from spelgen.evaluation.verdict import verdict
from spelgen.logs.checks import ELASTIC, check
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory

RATE, SECONDS = 200.0, 20.0


def chirped(arm, joint, resonance, seed, stiff=False) -> Trajectory:
    """Return a log of a joint's chirp up to 0.95 of its resonance [Hz], with friction and noise; stiff: rigid joint."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, SECONDS, 1 / RATE)
    n = len(arm.chain.coordinates)
    theta = np.zeros((len(t), n))
    for omega in 2 * np.pi * rng.uniform(0.05, 0.5, (4, n)):
        theta += rng.uniform(0.1, 0.3, n) * np.sin(omega * t[:, None] + rng.uniform(0, 6, n))
    sweep = 0.95 * resonance * t / SECONDS
    theta[:, joint] += 0.5 / (1 + sweep**2) * np.sin(np.pi * sweep * t)
    parameters = urdf_parameters(arm.chain)
    velocity = np.gradient(theta, t, axis=0)
    torque = regressor(arm.chain, theta, velocity, np.gradient(velocity, t, axis=0)) @ parameters
    if not stiff:
        still, unit = np.zeros((2, n)), np.zeros((2, n))
        unit[0, joint] = 1.0
        inertia = float(np.ptp(regressor(arm.chain, theta[[0, 0]], still, unit) @ parameters, axis=0)[joint])
        theta[:, joint] += torque[:, joint] / (inertia * (2 * np.pi * resonance) ** 2)
        velocity = np.gradient(theta, t, axis=0)
        acceleration = np.gradient(velocity, t, axis=0)
        torque[:, joint] += rng.uniform(0.5, 2.0) * inertia * acceleration[:, joint]
    size = torque.std(axis=0)
    torque += 0.05 * size * np.sign(velocity) + 0.01 * size * rng.standard_normal(torque.shape)
    return Trajectory(t, theta, velocity, torque, "chirp")


def elastic_notes(arm, log) -> list[Diagnostic]:
    notes = check([log], arm.chain.joint_names, arm.chain.joint_types)
    return [note for note in notes if note.code == ELASTIC]


@pytest.mark.parametrize("robot", ["two_link", "rpr", "six_dof", "ur10e"])
@pytest.mark.parametrize("seed", range(2))
def test_the_resonance_of_an_elastic_joint_is_named_and_a_stiff_one_is_not_doubted(robots, robot, seed):
    arm = load_arm(robots / f"{robot}.urdf")
    rng = np.random.default_rng(seed)
    joint, resonance = int(rng.integers(len(arm.chain.coordinates))), rng.uniform(5.0, 12.0)
    assert elastic_notes(arm, chirped(arm, joint, resonance, seed, stiff=True)) == []
    (note,) = elastic_notes(arm, chirped(arm, joint, resonance, seed))
    assert note.where.endswith(f"joint {arm.chain.joint_names[joint]!r}")
    found, valid = map(float, re.search(r"resonance at (\S+) Hz; .* below (\S+) Hz", note.message).groups())
    assert found == pytest.approx(resonance, rel=0.35) and valid < 0.6 * resonance


def test_no_recorded_arm_has_a_resonance(shared):
    for name, log in (("ur10e", "20_02_12_40sec_12harm"), ("tx40", "identification"), ("xmate3", "excit")):
        arm = load_arm(shared / "logs" / name / f"{name}.urdf")
        (trajectory,) = read_logs([shared / "logs" / name / f"{log}.parquet"], arm)
        assert elastic_notes(arm, trajectory) == []


def test_a_model_of_an_elastic_joint_is_not_called_good_without_its_band():
    note = Diagnostic("warning", ELASTIC, "joint 'b'", None, "a model of rigid bodies is valid below 3 Hz")
    assessment = verdict(replace(evaluation(), diagnostics=(note,)))
    assert assessment.sentence.startswith(
        "Not valid near the resonance of an elastic joint; below it, usable for "
    )
    assert assessment.because.startswith("joint 'b': a model of rigid bodies is valid below 3 Hz.")
