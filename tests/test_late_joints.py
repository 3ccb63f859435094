"""Errors about delays of single joints and about wrong units advise the settings line that corrects the log."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_log_geometry import arm, excitation, mended, recorded, told  # noqa: F401  (a fixture)

from spelgen.arm.configured_arm import load_arm
from spelgen.identification.time_faults import _delayed_signals
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.read import read_logs, write_logs
from spelgen.settings.log_mapping import LogMapping


def delayed(log, k, delay, motion, torque):
    def late(values):
        values = values.copy()
        values[:, k] = np.interp(log.t - delay, log.t, values[:, k])
        return values

    q, qd = (late(log.q), late(log.qd)) if motion else (log.q, log.qd)
    return replace(log, q=q, qd=qd, tau=late(log.tau) if torque else log.tau)


@pytest.mark.parametrize(("motion", "torque"), [(True, False), (False, True), (True, True)])
def test_the_delay_of_one_joint_is_named_and_mended(arm, motion, torque, tmp_path):  # noqa: F811
    rng = np.random.default_rng(len(arm.chain.name) + 2 * motion + torque)
    # the delayed joint is joint 1 or 2, as the delay of a light link may have no visible effect
    k, delay = int(rng.integers(2)), float(rng.uniform(0.06, 0.14) * rng.choice([1, -1]))
    log = recorded(arm, int(rng.integers(1000)), excitation, noise=0.01)
    wrong = delayed(log, k, delay, motion, torque)
    error = told(arm, wrong)
    assert "--accept joint-delay" in error and f"joint {arm.chain.joint_names[k]!r}" in error
    assert ("later" if delay > 0 else "earlier") in error
    write_logs(tmp_path / "log.csv", [wrong], arm.chain.joint_names)
    again, (read,) = mended(arm, error, tmp_path / "log.csv")
    inner = (read.t > 0.2) & (read.t < log.t[-1] - 0.2)
    for name in ("q", "qd"):
        expected = np.stack([np.interp(read.t, log.t, x) for x in getattr(log, name).T], axis=1)
        # the corrected log differs by at most the motion within 15 ms
        bound = 0.015 * np.abs(np.gradient(expected, read.t, axis=0)).max(axis=0) + 1e-6
        assert (np.abs(getattr(read, name) - expected)[inner].max(axis=0) <= bound).all()
    assert check_logs([read], again).errors == ()


def test_motion_and_torque_of_an_only_joint_have_no_common_delay():
    """A common delay of all signals is no fault. In the log of a pendulum, 0.227 s of it were advised."""
    assert [mask.tolist() for mask in _delayed_signals(1)] == [[[0.0], [1.0]]]
    assert len(_delayed_signals(2)) == 7


def test_torques_of_all_joints_that_are_late_have_one_line(arm):  # noqa: F811
    log = recorded(arm, 12)
    late = np.stack([np.interp(log.t - 0.09, log.t, x) for x in log.tau.T], axis=1)
    error = told(arm, replace(log, tau=late))
    assert "'torque_delay: 0.0" in error and "all joints" in error and "delay: {" not in error


@pytest.mark.parametrize("delay", [0.3, 0.45, -0.25])
def test_torques_of_all_joints_that_are_late_by_several_tenths_of_a_second_have_no_wrong_clock(arm, delay):  # noqa: F811
    log = recorded(arm, 12, noise=0.01)
    late = np.stack([np.interp(log.t - delay, log.t, x) for x in log.tau.T], axis=1)
    error = told(arm, replace(log, tau=late)[50:-50])
    assert float(re.search(r"'torque_delay: (-?[\d.]+)' under", error)[1]) == pytest.approx(delay, abs=0.015)


@pytest.mark.parametrize("joints", [slice(None), [1]])
@pytest.mark.parametrize("cutoff", [1.0, 2.0])
def test_torques_after_a_low_pass_filter_are_not_called_late(arm, cutoff, joints):  # noqa: F811
    log = recorded(arm, 12, noise=0.01)
    keep, tau = np.exp(-2 * np.pi * cutoff * np.diff(log.t[:2])[0]), log.tau.copy()
    tau[:, joints] = lfilter([1 - keep], [1, -keep], tau[:, joints], axis=0, zi=keep * tau[:1, joints])[0]
    error = told(arm, replace(log, tau=tau))
    named = re.search(r"after a low-pass filter of about ([\d.]+) Hz", error)
    assert float(named[1]) == pytest.approx(cutoff, rel=0.2)
    assert "write" not in error and "log the torques without this filter" in error


@pytest.mark.parametrize(("rate", "torque"), [(1.015, True), (0.985, True), (1.006, False)])
def test_the_clock_of_one_joint_that_runs_fast_or_slow_is_named(arm, rate, torque):  # noqa: F811
    """A joint whose clock runs fast or slow is named; no setting corrects it, and no constant delay is advised."""
    k, log = len(arm.chain.joint_names) // 2 - 1, recorded(arm, 21, excitation, noise=0.01)

    def stamped(values):
        values = values.copy()
        values[:, k] = np.interp(log.t / rate, log.t, values[:, k])
        return values

    tau = stamped(log.tau) if torque else log.tau
    # the log ends earlier, since the joint with the slow clock has no values at the end
    wrong = replace(log, q=stamped(log.q), qd=stamped(log.qd), tau=tau)[: int(0.97 * len(log))]
    error = told(arm, wrong)
    assert f"joint {arm.chain.joint_names[k]!r}: got" in error and "--accept joint-clock" in error
    signals = "positions, velocities and torques" if torque else "positions and velocities"
    percent, order = re.search(rf"{signals} of a clock that runs ([\d.]+)% (fast|slow)", error).groups()
    assert float(percent) == pytest.approx(100 * abs(rate - 1), abs=0.15)
    assert order == ("fast" if rate > 1 else "slow") and "write" not in error


@pytest.mark.parametrize("arm", ["six_dof", "ur10e"], indirect=True)
@pytest.mark.parametrize("units", [{"q": "deg"}, {"q": "deg", "qd": "rad/s"}])
def test_a_unit_of_positions_that_contradicts_the_velocities_is_named(arm, units):  # noqa: F811
    """If velocities are right and contradict the stated unit of positions, the message names the unit of positions."""
    mapping = LogMapping.model_validate({"units": units})
    log = recorded(arm, 13)
    error = told(arm, replace(log, q=np.deg2rad(log.q), mapping=mapping), mapping)
    assert "q in rad" in error and "write 'units: {q: rad}' under 'logs'" in error


@pytest.mark.parametrize(
    ("arm", "sign", "line"),
    [
        ("rpr", 1, "'units: {tau: Nm}'"), ("six_dof", 1, "'units: {tau: Nm}'"),
        ("six_dof", -1, "joint1: {units: {tau: Nm}, gain: -1}"),
    ],
    indirect=["arm"],
)  # fmt: skip
def test_a_unit_of_torques_that_the_mapping_states_wrongly_is_named(arm, sign, line):  # noqa: F811
    """If the stated unit of torques is wrong, the message advises the right unit, and no gain such as 1000 for mNm."""
    mapping = LogMapping.model_validate({"units": {"tau": "mNm"}})
    log = recorded(arm, 13)
    error = told(arm, replace(log, tau=sign * 1e-3 * log.tau, mapping=mapping), mapping)
    assert "--accept torque-unit" in error and line in error and "gain: 1000" not in error


def test_a_copied_torque_is_an_error(arm):  # noqa: F811
    rng = np.random.default_rng(len(arm.chain.name))
    k, other = rng.choice(len(arm.chain.joint_names), 2, replace=False)
    log = recorded(arm, 11)
    tau = log.tau.copy()
    tau[:, k] = 1.7 * log.tau[:, other]
    error = told(arm, replace(log, tau=tau))
    assert "--accept torque-copied" in error
    assert repr(arm.chain.joint_names[k]) in error and repr(arm.chain.joint_names[other]) in error


@pytest.mark.parametrize(
    ("stated", "logged"), [("deg", "rad"), ("turns", "rad"), ("turns", "deg"), ("rad", "deg")]
)
def test_a_unit_that_the_mapping_states_wrongly_is_named(arm, stated, logged):  # noqa: F811
    sizes = {"rad": 1.0, "deg": np.pi / 180, "turns": 2 * np.pi}
    factor = np.where(np.array(arm.chain.joint_types) == "revolute", sizes[stated] / sizes[logged], 1.0)
    entries = {}
    for name, joint_type in zip(arm.chain.joint_names, arm.chain.joint_types, strict=True):
        if joint_type == "revolute":
            entries[name] = {"units": {"q": stated, "qd": f"{stated}/s"}}
    mapping = LogMapping.model_validate({"joints": entries})
    log = replace(recorded(arm, 13), mapping=mapping)
    error = told(arm, replace(log, q=log.q * factor, qd=log.qd * factor), mapping)
    assert "--accept joint-unit" in error and f"q: {logged}, qd: {logged}/s" in error


def test_torques_in_ticks_are_named_although_inertia_dominates(robots):
    """Torques logged in register counts of 0.03 Nm get the right gain, although most of the torque is inertial.

    The gain [Nm per count] is the ratio of the URDF's gravity torque to the gravity torque fitted to the log. It is
    right within a factor of 1.6, as the masses in the URDF differ from the true masses.
    """
    small = load_arm(robots / "two_link.urdf")
    log = recorded(small, 1, noise=0.01)
    error = told(small, replace(log, tau=log.tau * 1000 / 30))
    gains = list(map(float, re.findall(r"gain: ([\d.e-]+)", error)))
    np.testing.assert_allclose(np.log(gains), np.log(0.03), atol=np.log(1.6))


@pytest.mark.parametrize("late", ["q", "qd"])
def test_velocities_that_are_later_or_earlier_than_positions_are_named(arm, late):  # noqa: F811
    log, k = recorded(arm, 14), 1
    values = getattr(log, late).copy()
    values[:, k] = np.interp(log.t - 0.07, log.t, values[:, k])
    error = told(arm, replace(log, **{late: values}))
    size, order = re.search(r"qd that is ([\d.]+) ms (later|earlier) than dq/dt", error).groups()
    assert abs(float(size) - 70) < 10 and order == ("later" if late == "qd" else "earlier")
    assert "write 'velocity: differentiated'" in error and repr(arm.chain.joint_names[k]) in error


@pytest.mark.parametrize(("stated", "logged"), [("mm", "m"), ("m", "mm")])
def test_a_wrong_unit_of_a_prismatic_joint_is_named(robots, stated, logged):
    rpr = load_arm(robots / "rpr.urdf")
    log, size = recorded(rpr, 3, noise=0.01), {"m": 1.0, "mm": 1e-3}
    factor = np.array([1.0, size[stated] / size[logged], 1.0])
    mapping = LogMapping.model_validate({"joints": {"joint2": {"units": {"q": stated, "qd": f"{stated}/s"}}}})
    error = told(rpr, replace(log, q=log.q * factor, qd=log.qd * factor, mapping=mapping), mapping)
    assert f"'joints: {{joint2: {{units: {{q: {logged}, qd: {logged}/s}}}}}}'" in error


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
@pytest.mark.parametrize(("ratio", "is_motor_torque"), [(50.0, False), (-101.0, True)])
def test_positions_of_one_motor_get_the_ratio_of_its_gear(arm, ratio, is_motor_torque, tmp_path):  # noqa: F811
    """If the motion of one joint is logged at its motor, the advised line states the gear ratio, not another unit."""
    log = recorded(arm, 15, noise=0.01)
    factors = np.where(np.arange(log.q.shape[1]) == 1, ratio, 1.0)
    tau = log.tau / (factors if is_motor_torque else 1.0)
    wrong = replace(log, q=log.q * factors, qd=log.qd * factors, tau=tau)
    error = told(arm, wrong)
    assert "--accept joint-unit" in error and "deg" not in error.partition("write")[2]
    write_logs(tmp_path / "log.csv", [wrong], arm.chain.joint_names)
    again, (read,) = mended(arm, error, tmp_path / "log.csv")
    assert np.abs(read.q - log.q).max() < 0.02 * np.ptp(log.q[:, 1])
    assert np.allclose(read.tau, log.tau, rtol=0.02)
    assert check_logs([read], again).errors == ()


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
@pytest.mark.parametrize(("third", "is_motor_torque"), [(-121.0, False), (121.0, True)])
def test_positions_of_all_motors_are_no_degrees(arm, third, is_motor_torque, tmp_path):  # noqa: F811
    """Motor positions instead of joint positions are not mistaken for degrees: the error advises gear ratios.

    With the advised line, the log has the true joint positions. third: gear ratio of joint 3, negative if its motor
    turns the other way. is_motor_torque: torques, too, are logged at the motors.
    """
    log, gears = recorded(arm, 17, noise=0.01), np.array([101.0, 50.0, third, 80.0])
    tau = log.tau / (gears if is_motor_torque else 1.0)
    wrong = replace(log, q=log.q * gears, qd=log.qd * gears, tau=tau)
    error = told(arm, wrong)
    assert "--accept joint-unit" in error
    write_logs(tmp_path / "log.csv", [wrong], arm.chain.joint_names)
    again, (read,) = mended(arm, error, tmp_path / "log.csv")
    assert (np.abs(read.q - log.q).max(axis=0) < 0.02 * np.ptp(log.q, axis=0)).all()
    assert check_logs([read], again).errors == ()


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_gear_ratios_near_the_factor_of_degrees_are_found(arm):  # noqa: F811
    """Degrees are not advised for motor positions with gear ratios near 57.3, although they explain most torques."""
    log, gears = recorded(arm, 17, noise=0.01), np.array([52.0, 63.0, 60.0, 54.0])
    error = told(arm, replace(log, q=log.q * gears, qd=log.qd * gears))
    assert "positions in deg" not in error and "--accept joint-unit" in error


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_gear_ratios_that_the_torques_do_not_show_are_not_advised(arm):  # noqa: F811
    """If positions are logged at the motors and torques are of another motion, the gear ratios cannot be found.

    Here the torques are reversed in time and their columns exchanged. The error advises no unit such as degrees, but
    the setting counts_per_turn = 2 pi times the gear ratio of each joint, which the user knows.
    """
    log, gears = recorded(arm, 17, noise=0.01), np.array([101.0, 50.0, 121.0, 80.0])
    wrong = replace(log, q=log.q * gears, qd=log.qd * gears, tau=log.tau[::-1, [2, 0, 3, 1]])
    error = told(arm, wrong)
    assert "'units: {" not in error and "counts_per_turn', 2 pi times the gear ratio" in error


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
@pytest.mark.parametrize("motion", ["degrees", "motors"])
def test_the_unit_of_positions_is_named_together_with_the_order_of_the_torques(arm, motion, tmp_path):  # noqa: F811
    """If positions have a wrong unit and torque columns are exchanged, one error advises a correction of both.

    motion: positions in degrees, which need a unit, or positions at the motors, which need gear ratios.
    """
    log, order = recorded(arm, 17, noise=0.01), [2, 0, 3, 1]
    factors = np.full(4, 180 / np.pi) if motion == "degrees" else np.array([101.0, 50.0, 121.0, 80.0])
    wrong = replace(log, q=log.q * factors, qd=log.qd * factors, tau=log.tau[:, order])
    error = told(arm, wrong)
    assert (
        "--accept torque-order --accept joint-unit" in error
        or "--accept joint-unit --accept torque-order" in error
    )
    write_logs(tmp_path / "log.csv", [wrong], arm.chain.joint_names)
    _, (read,) = mended(arm, error, tmp_path / "log.csv")
    assert (np.abs(read.q - log.q).max(axis=0) < 0.03 * np.ptp(log.q, axis=0)).all()
    np.testing.assert_allclose(read.tau, log.tau, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_the_unit_of_positions_is_stated_before_errors_that_it_causes(arm):  # noqa: F811
    """Positions in degrees that are read in rad may seem to jump: the error about the unit is then the first."""
    logs = [recorded(arm, seed, noise=0.01) for seed in (18, 19)]
    logs = [replace(x, q=np.degrees(x.q), qd=np.degrees(x.qd), name=f"{k}") for k, x in enumerate(logs)]
    logs[1].q[500:508, 1] += 12.0
    unit, jump = check_logs(logs, arm).errors
    assert "units: {q: deg, qd: deg/s}" in str(unit) and "got q that jumps" in str(jump)


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
@pytest.mark.parametrize("reversed_joint", [None, 1])
def test_degrees_are_advised_also_if_a_joint_has_another_fault(arm, reversed_joint):  # noqa: F811
    log = recorded(arm, 18, noise=0.01)
    sign = np.where(np.arange(log.q.shape[1]) == reversed_joint, -1.0, 1.0)
    degrees = 180 / np.pi
    error = told(arm, replace(log, q=degrees * log.q, qd=degrees * log.qd, tau=log.tau * sign))
    assert "units: {q: deg, qd: deg/s}" in error and "counts" not in error.partition("write")[2]
    assert (reversed_joint is None) == ("--accept torque-sense" not in error)


@pytest.mark.parametrize(("arm", "seed"), [("six_dof", 18), ("ur10e", 21)], indirect=["arm"])
def test_degrees_of_a_mirrored_joint_are_no_gears(arm, seed):  # noqa: F811
    log = recorded(arm, seed, noise=0.002)
    factors = np.where(np.arange(log.q.shape[1]) == 1, -1.0, 1.0) * 180 / np.pi
    error = told(arm, replace(log, q=factors * log.q, qd=factors * log.qd))
    assert "sign: -1, units: {q: deg, qd: deg/s}" in error and "counts" not in error


@pytest.mark.parametrize("arm", ["scara"], indirect=True)
@pytest.mark.parametrize("seed", [0, 1])
def test_millimetres_of_a_lift_are_named_and_no_other_fault(arm, seed):  # noqa: F811
    """Torques of a vertical prismatic joint do not show its unit: its gravity is constant, its mass uncertain."""
    log = recorded(arm, seed)
    factors = np.where(np.array(arm.chain.joint_types) == "prismatic", 1000.0, 1.0)
    error = told(arm, replace(log, q=factors * log.q, qd=factors * log.qd))
    assert "units: {q: mm, qd: mm/s}" in error and "clock" not in error


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
@pytest.mark.parametrize("seed", [31, 32, 38])
def test_torques_in_mnm_are_named_although_another_zero_hides_their_gravity(arm, seed):  # noqa: F811
    """The arm has no effort limits: only the size of the torques shows their unit before the zero is corrected."""
    log = recorded(arm, seed, noise=0.002)
    shift = np.where(np.arange(log.q.shape[1]) == 2, np.pi / 2, 0.0)
    error = told(arm, replace(log, q=log.q + shift, tau=1000 * log.tau))
    assert set(re.findall(r"gain: ([\d.e-]+)", error)) == {"0.001"} and "offset: -1.5708" in error


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_torques_in_percent_of_each_rated_torque_get_a_gain_per_joint(arm):  # noqa: F811
    """Torques in percent of each joint's rated torque get one gain per joint; their ratios are right to about 30 %."""
    log, gains = recorded(arm, 16, noise=0.01), np.array([1.3, 0.02, 0.4, 0.006])
    error = told(arm, replace(log, tau=log.tau / gains))
    assert "--accept torque-unit" in error
    found = np.array([float(x) for x in re.findall(r"gain: ([\d.e-]+)", error)])
    assert np.ptp(np.log(found / gains)) < 0.3


@pytest.mark.parametrize("arm", ["six_dof", "ur10e"], indirect=True)
def test_gains_per_joint_are_found_although_the_last_one_is_far_smaller(arm):  # noqa: F811
    """The gain of the last joint is a 500th of the others', and yet the ratios of all gains are right to 30 %."""
    log, gains = recorded(arm, 16, noise=0.01), np.array([0.27, 1.9, 0.49, 0.2, 0.09, 4e-4])
    error = told(arm, replace(log, tau=log.tau / gains))
    assert "--accept torque-unit" in error
    found = np.array([float(x) for x in re.findall(r"gain: ([\d.e-]+)", error)])
    assert np.ptp(np.log(found / gains)) < 0.3


def test_a_short_delay_of_all_torques_is_no_delay_of_one_joint(shared):
    """Positions that are 20 ms late explain the torques of one joint best, but no more than a delay of all torques."""
    panda = load_arm(shared / "arms" / "panda_erd.urdf")
    (log,) = read_logs([shared / "logs" / "panda"], panda)
    q, qd = (np.stack([np.interp(log.t - 0.02, log.t, x) for x in y.T], axis=1) for y in (log.q, log.qd))
    assert check_logs([replace(log, q=q, qd=qd)], panda).errors == ()


def test_the_unit_of_a_last_joint_that_nothing_determines_leaves_the_others_alone(shared):
    """If the URDF's masses are 30 % wrong and the last joint has another unit, no other joint gets a gain."""
    panda = load_arm(shared / "arms" / "panda_erd.urdf")
    (log,) = read_logs([shared / "logs" / "panda"], panda)
    (*errors,) = check_logs([replace(log, tau=log.tau * np.append(np.ones(6), 10.0))], panda).errors
    assert not any("panda_joint1" in str(error) for error in errors)
