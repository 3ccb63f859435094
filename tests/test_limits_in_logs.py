"""Clipped torques and positions at a stop are named; flat signals that the motion explains are accepted."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_log_geometry import RATE, arm, excitation, pick_and_place, recorded  # noqa: F401  (a fixture)

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.errors import LogError
from spelgen.log_checks.check_logs import check_logs, require_sound_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping


def clipped_joints(arm, log) -> dict[str, list[float]]:  # noqa: F811
    """Return, per joint, the limits [Nm, N] that the errors about clipped torques state.

    An error of the log that is not about clipped torques makes the test fail.
    """
    found = {}
    for error in check_logs([log], arm).errors:
        joint, limits = re.match(r"joint '(.*)', tau: got torques that stop at (.*?) N", str(error)).groups()
        found[joint] = [float(x) for x in limits.split(" and ")]
    return found


@pytest.mark.parametrize("motion", [excitation, pick_and_place])
@pytest.mark.parametrize("seed", range(2))
def test_the_joints_with_clipped_torques_are_named_with_their_limits(arm, motion, seed):  # noqa: F811
    """Joints with clipped torques are named with their torque limits.

    First all joints are clipped at 60 % of their largest torque, then one joint, with different limits per direction.
    """
    log = recorded(arm, seed, motion)
    names, rng = arm.chain.joint_names, np.random.default_rng(seed)
    limit = 0.6 * np.abs(log.tau).max(axis=0)
    found = clipped_joints(arm, replace(log, tau=np.clip(log.tau, -limit, limit)))
    share = (np.abs(log.tau) > limit).mean(axis=0)
    # joints at the limit in more than 40 % of the samples may be missing: too few other samples remain
    assert {names[k] for k in np.flatnonzero((share > 0.05) & (share < 0.4))} <= found.keys()
    assert found
    assert all(
        abs(x) == pytest.approx(limit[names.index(joint)], rel=1e-3) for joint in found for x in found[joint]
    )
    k = int(rng.integers(len(names)))
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    low[k], high[k] = np.quantile(log.tau[:, k], [0.15, 0.9])
    found = clipped_joints(arm, replace(log, tau=np.clip(log.tau, low, high)))
    assert found.keys() == {names[k]}
    assert set(found[names[k]]) <= {float(f"{low[k]:.4g}"), float(f"{high[k]:.4g}")}


def test_clipped_torques_are_refused_and_slower_motion_mends_them(arm):  # noqa: F811
    """Clipped torques are refused with the advice of slower motion; at a third of the speed nothing is clipped."""
    log = recorded(arm, 3)
    slow = recorded(arm, 3, lambda arm, rng: (excitation(arm, rng)[0] * 3, excitation(arm, rng)[1]))
    k = int((np.abs(log.tau).max(axis=0) / np.abs(slow.tau).max(axis=0)).argmax())
    limit = np.full(len(arm.chain.joint_names), np.inf)
    limit[k] = 1.05 * np.abs(slow.tau[:, k]).max()
    wrong = replace(log, tau=np.clip(log.tau, -limit, limit))
    with pytest.raises(
        LogError, match=r"torques that stop at .* record slower motion; --accept torque-clipped"
    ):
        require_sound_logs([wrong], arm)
    require_sound_logs([wrong], arm, LogMapping.model_validate({"accept": ["torque-clipped"]}))
    require_sound_logs([replace(slow, tau=np.clip(slow.tau, -limit, limit))], arm)


def test_torques_of_uniform_acceleration_are_flat_and_right(robots):
    """Constant torques of a joint with a vertical axis, in uniform acceleration, are not reported as clipped."""
    arm = load_arm(robots / "scara.urdf")  # noqa: F811
    t = np.arange(0.0, 20.0, 1 / RATE)
    n = len(arm.chain.coordinates)
    qdd = np.zeros((len(t), n))
    qdd[:, 0] = np.where(np.sin(np.pi * t) > 0, 1.0, -1.0) * (t > 0.5)
    qd = np.cumsum(qdd, axis=0) / RATE
    q = np.cumsum(qd, axis=0) / RATE
    tau = regressor(arm.chain, q, qd, qdd) @ urdf_parameters(arm.chain)
    assert not check_logs([Trajectory(t, q, qd, tau + 0.1 * np.sign(qd), "uniform")], arm).errors


def test_a_joint_at_a_mechanical_stop_is_named(arm):  # noqa: F811
    log = recorded(arm, 5)
    k = int(log.tau.std(axis=0).argmax())
    stop = np.quantile(log.q[:, k], 0.8)
    is_held = log.q[:, k] > stop
    q, qd, tau = log.q.copy(), log.qd.copy(), log.tau.copy()
    q[is_held, k], qd[is_held, k] = stop, 0.0
    tau[is_held, k] += 3 * tau[:, k].std()
    found = [
        x for x in check_logs([replace(log, q=q, qd=qd, tau=tau)], arm).findings if "a stop" in x.message
    ]
    assert [(x.code, x.where) for x in found] == [("at-a-stop", f"joint {arm.chain.joint_names[k]!r}")]
    assert f"q stays at {stop:.4g}" in found[0].message
