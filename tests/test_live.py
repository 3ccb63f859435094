"""The live estimator finds a payload, contacts and friction changes that were added to torques; its equations hold."""

import copy
import dataclasses
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from compiled_estimator import nominal_levels
from emitted import ROBOTS
from exported_runs import COUPLED, MOTORS, arm_of, moved_model, saved_run
from lxml import etree
from motions import smooth_motion
from scipy.optimize import minimize
from typer.testing import CliRunner

import spelgen
from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.dynamics import tip_frame
from spelgen.dynamics.body_regressor import chain_regressor, load_body, pseudo_inertia
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.emission.build import build
from spelgen.errors import LogError, RunError
from spelgen.fitting.fitted import load_run
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.labels import torque_units, torques_text
from spelgen.live import levels as live_levels
from spelgen.live.contact import tip_force
from spelgen.live.estimator import Estimator
from spelgen.live.filters import Block, LoadFilter
from spelgen.live.intake import Intake
from spelgen.live.levels import block_noise, held_out_tail
from spelgen.live.momentum import balance, load_terms
from spelgen.live.noise import BlockNoise, NoiseLevels
from spelgen.live.payload import find_payload
from spelgen.live.replay import load_changes, payload_sentence, replay
from spelgen.live.tuning import TUNING
from spelgen.logs.read import write_logs
from spelgen.logs.trajectory import Trajectory

EFFORT = np.array([150.0, 150.0, 100.0, 30.0, 30.0, 30.0])
PAYLOAD = np.array([2.0, 0.1, -0.06, 0.2, 0.03, 0.002, -0.01, 0.035, 0.004, 0.02])
RATE = 200.0


def numbers(*arrays):
    return [torch.from_numpy(np.ascontiguousarray(x)) for x in arrays]


@pytest.fixture(scope="module")
def arm():
    """Return a model with hysteretic friction, a log of 12 s at 200 Hz with its torques, and the accelerations."""
    model = moved_model("six_dof", "closed-form", 0.1).double()
    t = np.arange(0.0, 12.0, 1 / RATE)
    coarse = np.arange(0.0, 13.0, 0.01)
    fine = [
        np.stack([np.interp(t, coarse, column) for column in x.T], axis=1)
        for x in smooth_motion(model.n, 13.0, np.random.default_rng(3))
    ]
    q, qd, qdd = fine
    z = bristles_along(q, bristle_reach(model))
    with torch.no_grad():
        tau = model.inverse_dynamics(*numbers(q, qd, qdd, z)).numpy()
    noise = 1e-3 * EFFORT * np.random.default_rng(0).standard_normal(q.shape)
    return model, Trajectory(t, q, qd, tau + noise), qdd


@pytest.fixture(scope="module")
def levels(arm):
    model, log, _ = arm
    return nominal_levels(EFFORT, np.abs(log.qd).max(axis=0), model.coulomb.detach().numpy())


@pytest.fixture(scope="module")
def run(arm, levels, tmp_path_factory):
    """Return the path of a run folder with the model and the noise levels `levels`, from half a minute of logs."""
    folder = saved_run(arm[0], ROBOTS / "six_dof.urdf", tmp_path_factory.mktemp("live"))
    folder.estimator.write_text(json.dumps(levels.model_dump(mode="json") | {"minutes": 0.5}))
    config = json.loads(folder.config.read_text())
    folder.config.write_text(json.dumps(config | {"joints": list(arm[0].joint_names)}))
    return folder.path


def loaded(model, log, qdd, theta):
    """Return the torques of a log plus the torques of a payload theta (10,) at the last body, (T, n) [Nm]."""
    rows = chain_regressor(model.chain, log.q, log.qd, qdd)[:, :, -10:]
    return log.tau + rows @ theta


def estimates(run, levels, log, tau):
    estimator = Estimator(load_run(run), levels=levels)
    assert repr(estimator) == f"<Estimator of {estimator.model.n} joints, alarms_per_minute=1>"
    return estimator, estimator.replay(dataclasses.replace(log, tau=tau))


def coupled(folder):
    (folder / "arm.urdf").write_text(COUPLED)
    (folder / "arm.yaml").write_text(MOTORS)
    return folder / "arm.urdf"


@pytest.mark.parametrize("robot", ["six_dof", "rpr", "coupled"])
def test_momentum_balance_is_the_inverse_dynamics(robot, tmp_path):
    """Along any motion, `balance` satisfies dp/dt = torque - friction at all driven joints, with p = M qd.

    Its `torque` is G tau + dL/dq of the Lagrangian L, and so includes gravity and velocity-dependent terms. The arms
    have mimic joints, prismatic joints and coupled motors as well.
    """
    urdf = coupled(tmp_path) if robot == "coupled" else ROBOTS / f"{robot}.urdf"
    model = build(urdf, "hybrid").double()
    random = np.random.default_rng(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.from_numpy(random.standard_normal(parameter.shape))
    model.requires_grad_(False)
    q, qd, qdd = random.standard_normal((3, 5, model.n))
    z = np.zeros((5, model.n, model.elements))
    tau = model.inverse_dynamics(*numbers(q, qd, qdd, z)).numpy()
    step = 1e-5
    states = [(q + s * qd + s * s / 2 * qdd, qd + s * qdd) for s in (-step, 0.0, step)]
    before, at, after = (balance(model, np.zeros(3), (*state, tau), (z, z)) for state in states)
    rate = (after.momentum - before.momentum) / (2 * step)
    passive = ~model.actuated.numpy().astype(bool)
    error = rate - (at.torque - at.friction)
    assert np.abs(error[:, ~passive]).max() < 1e-6 * np.abs(rate).max()
    columns = slice(10 * load_body(model.chain), 10 * load_body(model.chain) + 10)
    regressor = chain_regressor(model.chain, q, qd, qdd)[:, :, columns]
    by_momentum = (after.load_momentum - before.load_momentum) / (2 * step) - at.load_torque
    np.testing.assert_allclose(by_momentum, regressor, atol=1e-6 * np.abs(regressor).max())


def test_the_jacobian_is_the_velocity_of_the_tip(arm):
    """The Jacobian of the tip that the estimator computes equals the Jacobian by `TipKinematics`."""
    from spelgen.dynamics.tip import tip_kinematics
    from spelgen.dynamics.tip_frame import tip_frame

    model, log, _ = arm
    robot = arm_of("six_dof")
    tip = tip_frame(robot)
    assert tip.carrier == len(robot.chain.bodies) - 1
    q, qd = numbers(log.q[::400], log.qd[::400])
    jacobian = load_terms(model.chain, q, qd, torch.from_numpy(tip.pose[:3, 3].copy()))[2]
    expected = tip_kinematics(robot).jacobian(q)[:, :3]
    assert (jacobian - expected).abs().max() < 1e-5


def test_no_payload_is_reported_without_one(arm, levels, run):
    _model, log, _ = arm
    estimator, states = estimates(run, levels, log, log.tau)
    assert {state.payload.status for state in states} <= {"not yet", "no payload"}
    assert states[-1].payload.status == "no payload"
    assert 0 < states[-1].payload.limit < 0.3
    assert estimator.refused == {}
    assert not any(state.load_changed for state in states)


def test_a_payload_is_found_with_its_intervals(arm, levels, run):
    model, log, qdd = arm
    _, states = estimates(run, levels, log, loaded(model, log, qdd, PAYLOAD))
    first = next(state.t for state in states if state.payload.status == "payload")
    assert first < 5.0
    payload = states[-1].payload
    assert payload.mass_interval[0] < 2.0 < payload.mass_interval[1]
    assert abs(payload.mass - 2.0) < 0.05
    np.testing.assert_allclose(payload.center, PAYLOAD[1:4] / 2.0, atol=0.01)
    inside = (payload.center_interval[:, 0] < PAYLOAD[1:4] / 2) & (
        PAYLOAD[1:4] / 2 < payload.center_interval[:, 1]
    )
    assert inside.sum() >= 2
    # the estimated payload is physically consistent
    assert np.linalg.eigvalsh(pseudo_inertia(torch.from_numpy(payload.parameters)).numpy())[0] > 0


def test_reports_for_users_describe_the_payload_in_the_frame_of_the_tip_link(arm, levels, run, tmp_path):
    """The frame of the last body is not a frame of the URDF if the axis of the last joint is not z."""
    model, log, qdd = arm
    fit = load_run(run)
    root = etree.parse(fit.urdf)
    joint = next(joint for joint in root.iter("joint") if joint.get("name") == model.joint_names[-1])
    # The tip link is turned against the link of the last joint, and 0.1 m from it.
    etree.SubElement(root.getroot(), "link", name="tool")
    mount = etree.SubElement(root.getroot(), "joint", name="mount", type="fixed")
    etree.SubElement(mount, "parent", link=joint.find("child").get("link"))
    etree.SubElement(mount, "child", link="tool")
    etree.SubElement(mount, "origin", xyz="0 0 0.1", rpy="1.5707963267948966 0 0")
    root.write(tmp_path / "tool.urdf")
    fit = dataclasses.replace(fit, urdf=tmp_path / "tool.urdf")
    (result,) = replay(fit, [dataclasses.replace(log, tau=loaded(model, log, qdd, PAYLOAD))])
    here, there = result.states[-1].payload, result.payload
    x, y, z = here.center
    np.testing.assert_allclose(there.center, [x, z - 0.1, -y], atol=1e-9)
    np.testing.assert_allclose(
        there.center_interval[[0, 2], 0], [here.center_interval[0, 0], -here.center_interval[1, 1]]
    )
    xx, xy, xz, yy, yz, zz = here.inertia
    np.testing.assert_allclose(there.inertia, [xx, xz, -xy, zz, -yz, yy], atol=1e-9)
    assert there.mass_interval == pytest.approx(here.mass_interval)
    assert " in the frame of tool" in payload_sentence(there)
    assert result.to_dict()["payload"]["frame"] == "tool"


def test_a_tip_on_the_axis_of_the_only_joint_has_no_force():
    """The tip link of an arm of one joint has its origin on the axis, so no force at the tip explains the torque."""
    np.testing.assert_array_equal(tip_force(np.zeros((3, 1)), np.array([2.0]), np.array([0.5])), np.zeros(3))


def test_a_payload_is_carried_by_the_last_joint_and_not_by_a_counterweight(tmp_path):
    """Mimic joints on other branches, such as the cylinder of a counterweight, have bodies after the last joint's."""
    root = etree.parse(ROBOTS / "six_dof.urdf")
    link = copy.deepcopy(next(link for link in root.iter("link") if link.find("inertial") is not None))
    link.set("name", "cylinder")
    root.getroot().append(link)
    joint = etree.SubElement(root.getroot(), "joint", name="cylinder_joint", type="revolute")
    for tag, values in (
        ("parent", {"link": "link1"}),
        ("child", {"link": "cylinder"}),
        ("axis", {"xyz": "0 1 0"}),
        ("limit", {"lower": "-2", "upper": "2", "effort": "1", "velocity": "9"}),
        ("mimic", {"joint": "joint2", "multiplier": "-1"}),
    ):
        etree.SubElement(joint, tag, values)
    root.write(tmp_path / "arm.urdf")
    robot = load_arm(tmp_path / "arm.urdf")
    model = build(robot, "closed-form").double()
    assert robot.chain.bodies[-1].name == "cylinder_joint"
    assert load_body(model.chain) == robot.chain.load_body == tip_frame.tip_frame(robot).carrier == 5
    # a fit that adapts the model to a load changes the parameters of this body alone
    parameters = ParameterVector(model)
    free = parameters.unflatten(parameters.free_mask("load", torch.zeros(6)))[parameters.bodies]
    assert free.flatten(1).any(dim=1).nonzero().tolist() == [[5]]
    q, qd = numbers(*np.random.default_rng(0).standard_normal((2, 3, 6)))
    weights = -load_terms(model.chain, q, 0 * qd, torch.zeros(3).double())[1][..., 0]
    plain = build(ROBOTS / "six_dof.urdf", "closed-form").double()
    expected = -load_terms(plain.chain, q, 0 * qd, torch.zeros(3).double())[1][..., 0]
    np.testing.assert_allclose(weights, expected, atol=1e-9)


def test_each_torque_of_a_text_has_its_unit():
    """An arm with prismatic and revolute joints has forces and torques in one sentence."""
    units = torque_units(["lift", "elbow", "wrist"], ["prismatic", "revolute", "revolute"])
    assert (
        torques_text({"lift": "14", "elbow": "0.2", "wrist": "0.1"}, units)
        == "lift 14 N, elbow 0.2, wrist 0.1 Nm"
    )


def test_the_torque_of_the_estimator_carries_the_payload(arm, levels, run):
    model, log, qdd = arm
    tau = loaded(model, log, qdd, PAYLOAD)
    estimator, _ = estimates(run, levels, log, tau)
    k = len(log) - 1
    expected = tau[k]
    found = estimator.torque(log.q[k], log.qd[k], qdd[k])
    bare = model.inverse_dynamics(*numbers(log.q[k], log.qd[k], qdd[k])).numpy()
    assert np.abs(found - expected).max() < 0.25 * np.abs(bare - expected).max()
    # predictions of more than 0.3 s ahead do not include the estimated disturbance torque
    later = estimator.torque(log.q[k], log.qd[k], qdd[k], ahead=1.0)
    np.testing.assert_allclose(found - later, estimator.drift.x[:, 1], atol=1e-9)
    # The first payload report comes after these 180 samples, so the predicted torque does not include the payload yet.
    # With `compensate_external`, it includes the estimated external torque, and thereby the weight of the payload.
    part, k = dataclasses.replace(log, tau=tau)[:180], 179
    for compensated in (False, True):
        early = Estimator(load_run(run), levels=levels, compensate_external=compensated)
        assert early.replay(part)[-1].payload.status == "not yet"
        error = np.abs(early.torque(log.q[k], log.qd[k], qdd[k]) - tau[k]).max()
        weight = np.abs(tau[k] - log.tau[k]).max()
        assert error < 0.2 * weight if compensated else error > 0.8 * weight


def test_a_changed_load_is_found_and_a_contact_is_none(arm, levels, run):
    model, log, qdd = arm
    with_load = loaded(model, log, qdd, PAYLOAD)
    picked = np.where(log.t[:, None] < 6.0, log.tau, with_load)
    _, states = estimates(run, levels, log, picked)
    (change,) = [state.t for state in states if state.load_changed]
    assert 6.0 < change < 9.0
    assert abs(states[-1].payload.mass - 2.0) < 0.2
    touched = log.tau + np.outer((log.t > 6.0) & (log.t < 8.0), 0.1 * EFFORT * (np.arange(6) == 1))
    _, states = estimates(run, levels, log, touched)
    assert not any(state.load_changed or state.payload.status == "payload" for state in states)
    # payload and contact at the same time: the payload is found after the end of the contact
    _, states = estimates(run, levels, log, picked + touched - log.tau)
    assert abs(states[-1].payload.mass - 2.0) < 0.2


def test_a_heavy_load_with_errors_of_its_own_is_reported(arm, levels, run):
    """A payload is reported although errors proportional to its torque exceed the noise of logs without a payload."""
    model, log, qdd = arm
    load = loaded(model, log, qdd, 10 * PAYLOAD) - log.tau
    noise = BlockNoise.model_validate(
        levels.load.model_dump() | {"white": 0.1 * levels.load.white, "disturbance": 0 * EFFORT}
    )
    small = levels.model_copy(update={"load": noise})
    errors = 1 + 0.02 * np.sin(np.outer(log.t, np.linspace(10.0, 14.0, model.n)))
    _, states = estimates(run, small, log, log.tau + load * errors)
    assert states[-1].payload.status == "payload"
    low, high = states[-1].payload.mass_interval
    assert low < 20.0 < high < 21.0


def test_a_push_is_no_load_for_an_arm_without_disturbance(arm, levels, run):
    """A push of two seconds at the tip is no load, also for an arm whose logs have white noise only."""
    model, log, _ = arm
    quiet = {"disturbance": np.zeros(model.n)}
    noises = {"load": levels.load.model_copy(update=quiet), "drift": levels.drift.model_copy(update=quiet)}
    white = levels.model_copy(update=noises)
    jacobian = load_terms(model.chain, *numbers(log.q, log.qd, levels.point))[2].numpy()
    for force in 5.0 * np.random.default_rng(2).standard_normal((8, 3))[4:6]:
        torque = np.einsum("tij,i->tj", jacobian, force) * ((log.t >= 6) & (log.t < 8))[:, None]
        _, states = estimates(run, white, log, log.tau - torque)
        assert not any(state.load_changed or state.payload.status == "payload" for state in states)


@pytest.mark.parametrize(
    ("reports", "changes"),
    [
        (["not yet", "no payload"], []),
        (["no payload", "no payload"], []),
        (["no payload", "payload"], [3]),
        (["payload", "payload"], [3]),
        (["payload", "no payload"], [3]),
        (["no payload", "not yet"], [3]),
        (["no payload", "no payload", "payload"], [6]),
    ],
)
def test_a_change_between_two_states_without_payload_is_not_listed(reports, changes):
    """A change between two loads that are both reported as no payload is not in the list of changes."""
    states = [
        SimpleNamespace(load_changed=k % 3 == 0 and k > 0, payload=SimpleNamespace(status=report))
        for k, report in enumerate(report for report in reports for _ in range(3))
    ]
    assert load_changes(states) == changes


def test_contacts_are_found_at_their_joint_with_their_force(arm, levels, run):
    """A force of 40 N at the tip for half a second is detected within 60 ms, with its joint torques and force."""
    model, log, _ = arm
    jacobian = load_terms(model.chain, *numbers(log.q, log.qd, levels.point))[2].numpy()
    force = np.array([0.0, 30.0, -27.0])
    torque = np.einsum("tij,i->tj", jacobian, force)
    begin, end = 7.0, 7.5
    acts = ((log.t >= begin) & (log.t < end))[:, None]
    # an external torque reduces the torque that the motors need
    _, states = estimates(run, levels, log, log.tau - acts * torque)
    touched = np.array([state.t for state in states if state.contact.touched.any()])
    assert begin < touched[0] < begin + 0.06
    assert ((touched >= begin) & (touched < end + 0.3)).all()
    at = np.searchsorted(log.t, end) - 2
    np.testing.assert_allclose(states[at].contact.external_torque, torque[at], atol=0.02 * EFFORT.max())
    assert np.linalg.norm(states[at].contact.force - force) < 0.25 * np.linalg.norm(force)


def test_a_contact_is_reported_until_it_ends(arm, levels, run):
    """A contact of two seconds is reported until it ends, although the disturbance estimate adapts to it."""
    _model, log, _ = arm
    acts, torque = (log.t >= 7.0) & (log.t < 9.0), 0.1 * EFFORT[1]
    _, states = estimates(run, levels, log, log.tau - np.outer(acts, torque * (np.arange(6) == 1)))
    touched = np.array([state.contact.touched for state in states])
    assert touched[(log.t > 7.1) & acts, 1].all()
    assert not touched[(log.t < 7.0) | (log.t > 9.3)].any()
    found = np.array([state.contact.external_torque[1] for state in states])
    np.testing.assert_allclose(found[(log.t > 7.3) & acts], torque, atol=0.2 * torque)


def test_a_log_that_begins_in_motion_begins_without_a_contact(arm, levels, run):
    model, log, qdd = arm
    start = 300 + int(np.abs(qdd[300:1200]).sum(axis=1).argmax())
    part = log[start : start + 200]
    inertial = model.inverse_dynamics(*numbers(part.q[0], 0 * part.qd[0], qdd[start]))
    still = model.inverse_dynamics(*numbers(part.q[0], 0 * part.qd[0], 0 * qdd[start]))
    _, states = estimates(run, levels, part, part.tau)
    assert ((inertial - still).abs().numpy() > states[50].contact.threshold).any()
    assert not any(state.contact.touched.any() for state in states)


def test_delayed_torques_are_compared_with_the_motion_of_their_time():
    """If torques are logged 15 ms late, the fit finds the delay, and external torques are estimated with it.

    Without the delay, the estimated external torques would be at least twice as large, although there is no contact.
    """
    urdf, late = ROBOTS / "two_link.urdf", 3
    model = moved_model("two_link", "closed-form", 0.03).double()
    random = np.random.default_rng(4)
    q, qd, qdd = smooth_motion(model.n, 60.0, random)
    t, qd, qdd = 0.005 * np.arange(len(q)), 2 * qd, 4 * qdd
    z = bristles_along(q, bristle_reach(model))
    with torch.no_grad():
        tau = model.inverse_dynamics(*numbers(q, qd, qdd, z)).numpy()
    tau += 1e-3 * np.abs(tau).max(axis=0) * random.standard_normal(tau.shape)
    log = Trajectory(t[late:], q[late:], qd[late:], tau[:-late])
    fit = spelgen.fit(build(urdf, "closed-form"), [log[:3500]], arm=urdf)
    levels = Estimator(fit).levels
    assert abs(levels.delay - 0.005 * late) < 0.002

    def external_torques(delay):
        states = Estimator(fit, levels=levels.model_copy(update={"delay": delay})).replay(log[3500:])
        # Three seconds are omitted, since the friction state is unknown at the start.
        torques = [x.contact.external_torque / levels.observer for x in states[600:]]
        return np.sqrt(np.mean(np.square(torques), axis=0))

    assert (external_torques(levels.delay) < 0.5 * external_torques(0.0)).all()


def test_friction_drift_is_found(arm, levels, run):
    """Friction that is 4 % larger or smaller than in the model is estimated; the prior standard deviation is 3 %."""
    model, log, _ = arm
    z = bristles_along(log.q, bristle_reach(model))
    friction = model.friction_torque(*numbers(log.q, log.qd, z)).numpy()
    visible = np.abs(friction).mean(axis=0) > 5 * levels.drift.white
    assert visible.sum() >= 2
    for drift in (0.04, -0.04):
        _, states = estimates(run, levels, log, log.tau + drift * friction)
        found = states[-1].friction_scale[visible] - 1
        assert (found / drift > 0.4).all() and (found / drift < 1.3).all()


def test_samples_that_cannot_be_used_are_refused_and_counted(arm, levels, run):
    _model, log, _ = arm
    estimator = Estimator(load_run(run), levels=levels)

    def step(k, t=None, q=None, tau=None):
        sample = (
            log.t[k] if t is None else t,
            log.q[k] if q is None else q,
            log.qd[k],
            log.tau[k] if tau is None else tau,
        )
        return estimator.step(*sample).refusal

    assert step(0) == "used"
    assert step(1, q=np.full(6, np.nan)) == "not finite"
    assert step(1, t=np.inf) == "not finite"
    assert step(1, t=log.t[0]) == "repeated"
    assert step(1, t=log.t[0] - 1) == "reversed"
    assert step(1, q=log.q[1] + 3.0) == "jump"
    assert step(1, tau=2 * EFFORT) == "saturated"
    assert step(2) == "used"
    assert step(1, q=log.q[1].tolist()) == "reversed"
    assert step(100) == "gap"
    assert estimator.refused == {
        "not finite": 2, "repeated": 1, "reversed": 2, "jump": 1, "saturated": 1, "gap": 1,
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"got q, qd and tau \(1, 5\), .*, expected \(1, 6\): 6 joints"):
        step(101, q=log.q[101, :5])
    # a clock that stays set back is accepted after some samples
    for k in range(TUNING.restart - 1):
        assert step(101 + k, t=0.001 * k) == "reversed"
    assert step(110, t=0.1) == "gap"
    assert step(111, t=0.1 + 1 / RATE) == "used"


@pytest.mark.parametrize(
    ("effort", "expected"), [(np.inf, "used"), (1.0, "saturated"), (0.6, "used"), (200.0, "used")]
)
def test_torques_are_saturated_only_at_a_known_limit(arm, effort, expected):
    """Samples with torques beyond the effort limit of the URDF are refused as saturated if the limit is plausible.

    A limit that logged torques exceed is wrong, and a very large one is a placeholder: both are unknown, as without a
    limit. Then four times the largest logged torque is used; only more than ten times this torque is refused. effort:
    limit of the URDF, divided by the largest logged torque. expected: result for four times the largest logged torque.
    """
    model, log, _ = arm
    largest = np.abs(log.tau).max(axis=0)
    folds = [(model, [log[:1200]]), (model, [log[1200:]])]
    levels = live_levels.find_levels(folds, effort * largest, np.zeros(3), 0.0)
    for factor, refusal in ((1.0, "used"), (4.0, expected), (30.0, "saturated")):
        intake = Intake(levels, bristle_reach(model))
        intake.accept(log.t[0], log.q[0], log.qd[0], log.tau[0])
        assert intake.accept(log.t[1], log.q[1], log.qd[1], factor * largest) == refusal
    stored = levels.model_dump(mode="json")
    assert len(stored.pop("saturation")) == model.n
    # runs of earlier versions have no entry `saturation`: it is 1, so that torques are saturated at the torque limit
    assert NoiseLevels.model_validate(stored).saturation.tolist() == [1.0]


def test_hostile_samples_give_finite_estimates(arm, levels, run):
    """Estimates stay finite if one in three samples has NaN, jumps, a zero or negative step, or saturated torques."""
    _model, log, _ = arm
    random = np.random.default_rng(5)
    t, q, qd, tau = (x.copy() for x in (log.t, log.q, log.qd, log.tau))
    kinds = random.integers(0, 15, len(t))
    q[kinds == 0, 2] = np.nan
    tau[kinds == 1] = np.inf
    q[kinds == 2] += random.standard_normal((int((kinds == 2).sum()), 6)) * 1e3
    t[kinds == 3] -= 0.1
    t[1:][kinds[1:] == 4] = t[:-1][kinds[1:] == 4]
    tau[kinds == 5] = 1e9
    estimator = Estimator(load_run(run), levels=levels)
    states = list(estimator.steps(t, q, qd, tau))
    for state in states:
        numbers = (*state.contact, state.friction_scale, state.disturbance, state.payload.parameters)
        assert all(np.isfinite(x).all() for x in numbers)
    counts = estimator.refused
    assert counts["not finite"] == ((kinds == 0) | (kinds == 1)).sum()
    assert min(counts[reason] for reason in ("repeated", "reversed", "jump", "saturated")) > 50


def test_one_log_has_one_result(arm, levels, run):
    """Two replays of a log give bitwise equal estimates; samples one at a time give them up to rounding errors."""
    _model, log, _ = arm
    short = log[:600]
    _, states = estimates(run, levels, short, short.tau)
    _, again = estimates(run, levels, short, short.tau)
    estimator = Estimator(load_run(run), levels=levels)
    for k in range(0, len(short)):
        single = estimator.step(short.t[k], short.q[k], short.qd[k], short.tau[k])
    assert states[-1].contact.external_torque.tobytes() == again[-1].contact.external_torque.tobytes()
    np.testing.assert_allclose(single.disturbance, states[-1].disturbance, rtol=1e-9)
    np.testing.assert_allclose(single.contact.external_torque, states[-1].contact.external_torque, atol=1e-9)
    # Exactly symmetric: otherwise rounding errors would grow until they affect the odds of a payload.
    covariance = estimator.estimate.filters[0].P
    np.testing.assert_array_equal(covariance, covariance.T)


@pytest.mark.parametrize("offset", [0.0, 0.5], ids=["consistent", "outside of the cone"])
def test_the_payload_is_the_map_estimate(offset):
    """The payload estimate has the smallest cost that a general solver finds.

    This also holds if the likelihood is largest far outside of the cone of consistent inertias.
    """
    random = np.random.default_rng(2)
    root = random.standard_normal((10, 10)) * np.array(TUNING.load_prior) * 2e-3
    covariance = np.linalg.inv(np.linalg.inv(root @ root.T) + np.diag(1 / np.square(TUNING.load_prior)))
    mean = PAYLOAD.copy()
    mean[[4, 7, 9]] -= offset
    payload = find_payload(mean, covariance, 1.0, 2.0)
    assert payload.status == "payload"
    precision = np.linalg.inv(covariance)
    linear, precision = precision @ mean, precision - np.diag(1 / np.square(TUNING.load_prior))

    def cost(factor):
        """Return the negative log posterior of the payload with the pseudo-inertia L L^T.

        L is lower triangular with the entries `factor` (10,): each such payload is physically consistent. The mean mass
        of the prior is 2 kg.
        """
        triangle = np.zeros((4, 4))
        triangle[np.tril_indices(4)] = factor
        inertia = triangle @ triangle.T + 1e-12 * np.eye(4)
        half = np.trace(inertia[:3, :3])
        moments = half * np.eye(3) - inertia[:3, :3]
        theta = np.array([inertia[3, 3], *inertia[:3, 3], *moments[np.triu_indices(3)]])
        width = 2.0 * np.diag([0.2**2 / 5, 0.2**2 / 5, 0.2**2 / 5 + 0.05**2, 1.0])
        width[2, 3] = width[3, 2] = 2.0 * 0.05
        prior = 3 * np.trace(np.linalg.solve(width, inertia)) - 0.5 * np.linalg.slogdet(inertia)[1]
        return 0.5 * theta @ precision @ theta - linear @ theta + prior

    from spelgen.live.payload import _at_scale

    theta, _, _ = _at_scale(precision, linear, 2.0, None)
    ours = cost(np.linalg.cholesky(pseudo_inertia(torch.from_numpy(theta)).numpy())[np.tril_indices(4)])
    best = min(
        minimize(cost, 0.3 * random.standard_normal(10), method="BFGS", options={"maxiter": 2000}).fun
        for _ in range(3)
    )
    assert ours < best + 1e-4 * abs(best)


@pytest.mark.parametrize(("moment", "status"), [(0.12, "payload"), (0.0, "not yet")])
def test_a_mass_that_no_motion_determines_has_a_wide_interval(moment, status):
    """An arm of one joint determines the first moments of its payload across the axis, but not the mass."""
    covariance = np.diag(np.square(TUNING.load_prior))
    covariance[[1, 2], [1, 2]] = 1e-6
    payload = find_payload(np.array([0, moment, *(0.0,) * 8]), covariance, 1.0, 2.0)
    assert payload.status == status
    assert payload.limit > 10
    if status == "payload":
        low, high = payload.mass_interval
        assert low < 0.2 and high > 10


def test_an_indefinite_covariance_is_no_payload_and_no_error():
    covariance = np.diag(np.square(TUNING.load_prior))
    covariance[0, 0] = -1e-9
    assert find_payload(PAYLOAD, covariance, 1.5, 2.0).status == "not yet"


def test_noise_levels_are_those_of_the_residuals():
    """Estimated noise levels are the true ones of white noise and of an Ornstein-Uhlenbeck disturbance.

    Friction drifts, and there is a torque offset.
    """
    random = np.random.default_rng(0)
    white, disturbance, constant = np.array([0.3, 1.0]), np.array([0.6, 1e-9]), 0.8
    decay = np.exp(-0.1 / constant)
    state, blocks = disturbance * random.standard_normal(2), []
    for k in range(3000):
        state = decay * state + np.sqrt(1 - decay**2) * disturbance * random.standard_normal(2)
        friction = 5 * np.sin(0.3 * k * np.ones(2))
        y = 0.05 * friction + 0.2 + state + white * random.standard_normal(2)
        blocks.append(Block(0.1, y, np.zeros((2, 10)), friction, np.zeros(2), np.ones(2, dtype=bool)))
    found = block_noise([blocks])
    np.testing.assert_allclose(found.white, white, rtol=0.15)
    assert abs(found.disturbance[0] - 0.6) < 0.12
    assert found.disturbance[1] < 0.3
    assert 0.4 <= found.time_constant[0] <= 1.6


def test_errors_that_recur_with_the_motion_do_not_become_a_payload(levels):
    """Torque errors that recur in each repetition of a motion of ten seconds give no payload after seven minutes."""
    random, load, ones = np.random.default_rng(0), LoadFilter(levels.load, levels.effort), np.ones(6)
    blocks = []
    for _ in range(50):
        errors, regressor = levels.load.white * random.standard_normal(6), random.standard_normal((6, 10))
        blocks.append(Block(0.2, errors, regressor, 0 * ones, 0 * ones, ones > 0))
    for block in 40 * blocks:
        load.predict(block.duration)
        for joint in range(load.n):
            load.update(block, joint)
    assert load.x[:10] @ np.linalg.solve(load.P[:10, :10], load.x[:10]) / 10 < 3.0
    np.testing.assert_array_equal(load.P, load.P.T)


@pytest.mark.parametrize("minutes", [0.2, 2.0])
def test_thresholds_keep_the_rate_of_alarms_after_short_logs(levels, minutes):
    """Thresholds from one short log of each of 300 arms give less than one false alarm per minute, on average.

    The logs consist of exponentially distributed random peaks, for which the expected rate of alarms is known.
    """
    random, windows = np.random.default_rng(0), round(60 * minutes / TUNING.window)
    alarms = []
    for _ in range(300):
        third = np.array_split(random.exponential(size=(windows, 6)), 3)
        tail = held_out_tail([1.0 + peaks for peaks in third], levels)
        thresholds = levels.model_copy(update=tail).thresholds(1.0)
        # expected alarms per minute: probability that a peak exceeds its threshold, times peaks per minute
        alarms.append(60 / TUNING.window * np.exp(-(thresholds - 1.0)).sum())
    assert np.mean(alarms) < 1.0
    # The thresholds of the last arm are not arbitrarily high. Peaks exceed x with probability exp(1 - x). Six joints
    # have 720 peaks per minute, of which one may exceed its threshold: the ideal threshold is log(720) + 1 = 7.6.
    # Thresholds from short logs have a margin, since the distribution of the peaks is only estimated.
    assert np.median(thresholds) < 25.0


def test_scales_of_peaks_are_shrunk_by_their_error(levels):
    """The peak scales of the joints are shrunk towards their mean, strongly if their standard errors are large.

    A scale is the parameter of the exponential distribution of the peaks of a joint's residual. Estimates of equal true
    scales become nearly equal; different true scales with small standard errors, from many peaks, remain different.
    """
    random, n = np.random.default_rng(2), len(EFFORT)

    def scales(windows, true):
        peaks = [1.0 + true * random.exponential(size=(windows, n)) for _ in range(3)]
        tail = held_out_tail(peaks, levels)
        pooled = np.concatenate(peaks)
        single = np.maximum(pooled - np.quantile(pooled, 0.8, axis=0), 0).sum(axis=0)
        return tail["peak_scale"] / tail["peak_scale"].mean(), single / single.mean(), tail["peak_count"]

    shrunk, single, count = scales(40, np.ones(n))
    assert np.std(shrunk) < 0.5 * np.std(single) and 24 < count < n * 24 + 1
    true = np.linspace(1.0, 6.0, n)
    shrunk, single, count = scales(1000, true)
    np.testing.assert_allclose(shrunk, true / true.mean(), rtol=0.1)
    assert 600 < count < 610
    # thresholds are finite for one joint, and for joints without any residual
    for joints in (1, 3):
        tail = held_out_tail([np.zeros((20, joints))] * 3, nominal_levels(*np.ones((3, joints))))
        assert all(np.isfinite(value).all() for value in tail.values())


def test_thresholds_hold_in_a_log_that_differs(levels):
    """Thresholds from three logs give at most one alarm in a log of doubled residuals if one of the three is doubled.

    If the residuals of the three logs are equally large, the thresholds give more than three alarms in the doubled log.
    """
    random = np.random.default_rng(1)
    logs = [1.0 + random.exponential(size=(100, 6)) for _ in range(4)]
    found = levels.model_copy(update=held_out_tail([logs[0], logs[1], 2 * logs[2]], levels))
    # 100 windows are 50 s, in which the thresholds for one alarm per minute may cause one alarm
    assert ((2 * logs[3] > found.thresholds(1.0)).any(axis=1)).sum() <= 1
    alike = levels.model_copy(update=held_out_tail(logs[:3], levels))
    assert ((2 * logs[3] > alike.thresholds(1.0)).any(axis=1)).sum() > 3


def test_noise_levels_are_found_with_one_thread(arm, run, monkeypatch):
    """The fits that estimate the noise levels use one thread of torch, like the fit of the run.

    Reason: if the number of threads is raised from one to two after the fit, torch 2.13 does not end the factorisation
    of a batch of matrices of order 150, and `train` of a 6-joint arm hangs.
    """
    threads = []

    def fitted_to(fit, logs):
        threads.append(torch.get_num_threads())
        raise LogError("too little motion")

    monkeypatch.setattr(live_levels, "fitted_to", fitted_to)
    previous = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(LogError):
            live_levels.cross_validated_levels(dataclasses.replace(load_run(run), logs=[arm[1]]))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(previous)
    assert threads == [1]


def test_models_that_it_cannot_use_are_refused(arm, levels, tmp_path):
    with pytest.raises(RunError, match=r"got <Model of .*, expected a fit: spelgen.fit"):
        Estimator(arm[0])
    networks = saved_run(build(ROBOTS / "two_link.urdf", "spel").double(), ROBOTS / "two_link.urdf", tmp_path)
    with pytest.raises(RunError, match=r"without rigid bodies.*closed-form or hybrid"):
        Estimator(load_run(networks.path))
    plain = saved_run(arm[0], ROBOTS / "six_dof.urdf", tmp_path / "plain")
    with pytest.raises(RunError, match=r"no noise levels.*estimator\.json.*train"):
        Estimator(load_run(plain.path))
    plain.estimator.write_text('{"minutes": "many"}')
    with pytest.raises(RunError, match=r"estimator\.json"):
        Estimator(load_run(plain.path))


def test_logs_with_errors_are_refused_as_by_evaluate(arm, run):
    log = arm[1]
    degrees = dataclasses.replace(log, q=np.degrees(log.q), qd=np.degrees(log.qd))
    with pytest.raises(LogError, match="q in deg"):
        replay(load_run(run), [degrees])


def test_training_from_a_run_prints_the_load(arm, run, tmp_path):
    model, log, qdd = arm
    lifted = dataclasses.replace(log, tau=loaded(model, log, qdd, PAYLOAD), name="lifted")
    write_logs(tmp_path / "logs.parquet", [lifted], model.joint_names)
    arguments = [
        "train",
        "--from",
        str(run),
        "--data",
        str(tmp_path / "logs.parquet"),
        "-o",
        str(tmp_path / "run"),
    ]
    result = CliRunner().invoke(app, [*arguments, "--format", "json"])
    assert result.exit_code == 0, result.output
    payload = json.loads(result.stdout)["payload"]
    assert payload["status"] == "payload"
    assert payload["mass_interval"][0] < 2.0 < payload["mass_interval"][1]
    assert "load changes" not in result.stderr
    # `train --from` copies the noise levels (estimator.json) of the source run into the new run. A live estimator
    # of the new model, the arm with its load, needs them.
    assert (tmp_path / "run" / "estimator.json").exists()


def test_training_from_a_run_warns_of_a_load_that_changes(arm, run, tmp_path):
    """One load is fitted to all logs, so a log in which the load changes is named in a warning."""
    model, log, qdd = arm
    tau = np.where(log.t[:, None] < 6, log.tau, loaded(model, log, qdd, PAYLOAD))
    logs = [log, dataclasses.replace(log, tau=tau, name="picked")]
    write_logs(tmp_path / "logs.parquet", logs, model.joint_names)
    arguments = ["train", "--from", run, "--data", tmp_path / "logs.parquet", "-o", tmp_path / "run"]
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output
    assert "the load changes in picked, and one load is fitted" in " ".join(result.stderr.split())


def test_the_command_prints_payload_contacts_and_drift(arm, levels, run, tmp_path):
    model, log, qdd = arm
    tau = loaded(model, log, qdd, PAYLOAD)
    tau[(log.t > 9) & (log.t < 9.5), 1] += 25.0
    write_logs(
        tmp_path / "logs.parquet", [dataclasses.replace(log, tau=tau, name="lifted")], model.joint_names
    )
    arguments = [
        "estimate",
        str(run),
        "--data",
        str(tmp_path / "logs.parquet"),
        "-o",
        str(tmp_path / "page.html"),
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    text = result.output
    assert "payload of 2.0" in text
    assert "contact at 9.0" in text
    assert "friction at the end" in result.output
    assert "contact thresholds in motion; at rest: joint1" in result.output
    assert "(training logs support >= 2): the training logs are too short" in " ".join(result.output.split())
    page = (tmp_path / "page.html").read_text()
    assert "Mass of the payload" in page
    result = CliRunner().invoke(app, [*arguments, "--format", "json"])
    (content,) = json.loads(result.stdout)["logs"]
    moving, rest = json.loads(result.stdout)["contact_thresholds"]["joint2"]
    assert 0 < moving < rest
    assert content["payload"]["status"] == "payload"
    assert content["payload"]["mass_interval"][0] < 2.0 < content["payload"]["mass_interval"][1]
    assert any(abs(contact["begin"] - 9.0) < 0.1 for contact in content["contacts"])
    assert set(content["friction_drift_percent"]) == set(model.joint_names)
    # The load before its report is marked in the text, on the page and in JSON. It is not a contact.
    for contact in content["contacts"]:
        assert contact["is_load"] == (contact["begin"] < content["payload_since"])
    count = sum(contact["is_load"] for contact in content["contacts"])
    assert count == text.count("load before its report at") == page.count(": load before its report") > 0
    assert "A payload was reported first at" in page


def test_torques_at_their_limit_are_named(arm, levels, run):
    """Samples with a torque at its limit are not used; the text states the joint, its largest torque and the limit."""
    _, log, _ = arm
    tau = log.tau.copy()
    tau[1:201, 2] = 140.0
    (result,) = replay(load_run(run), [dataclasses.replace(log, tau=tau)])
    text = " ".join(result.text().split())
    assert "200 torque at its limit" in text
    named = "largest torques: joint3 140 (limit 100) Nm; if limits of the URDF are wrong"
    assert named in text
    tau[:, 2] = 140.0
    with pytest.raises(LogError, match=re.escape(named)):
        replay(load_run(run), [dataclasses.replace(log, tau=tau)])


def test_a_contact_in_the_first_second_is_no_payload(arm, levels, run):
    """A contact that acts while no payload is known is not reported as a payload: a payload would not explain it."""
    _model, log, _ = arm
    for begin in (0.0, 0.3):
        acts = (log.t >= begin) & (log.t < begin + 1.0)
        tau = log.tau + np.outer(acts, 0.1 * EFFORT * (np.arange(6) == 3))
        _, states = estimates(run, levels, log[:900], tau[:900])
        assert not any(state.payload.status == "payload" for state in states)
        assert any(state.contact.touched[3] for state in states)


def test_thresholds_rise_while_the_arm_vibrates_and_not_by_a_contact(arm, levels, run):
    """Thresholds of a vibrating joint rise by at most a factor of two; a contact does not raise them within 0.1 s."""
    _model, log, _ = arm
    vibrates = (log.t > 4.0) & (log.t < 7.0)
    noise = levels.observer[0]
    vibration = 12 * noise * np.sin(2 * np.pi * 6.0 * log.t) * vibrates
    _, states = estimates(run, levels, log, log.tau + np.outer(vibration, np.arange(6) == 0))
    _, calm = estimates(run, levels, log, log.tau)
    ratio = np.array([a.contact.threshold / b.contact.threshold for a, b in zip(states, calm, strict=True)])[
        :, 0
    ]
    assert np.median(ratio[(log.t > 5.0) & vibrates]) > 1.3
    assert ratio.max() < 2.05
    np.testing.assert_allclose(ratio[(log.t > 0.5) & (log.t < 4.0)], 1.0, rtol=1e-6)
    begin = 9.0
    pushed = np.outer(log.t >= begin, 0.1 * EFFORT * (np.arange(6) == 0))
    _, states = estimates(run, levels, log, log.tau + pushed)
    early = (log.t >= begin) & (log.t < begin + 0.1)
    found, expected = (np.array([x.contact.threshold[0] for x in rows])[early] for rows in (states, calm))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_logs_that_the_estimator_cannot_use_are_refused_or_marked(arm, levels, run):
    """Torques in another unit are an error; external torques in most of a log give a remark, a load does not."""
    model, log, qdd = arm
    fit = load_run(run)
    with pytest.raises(LogError, match=r"2399 of 2400 samples .*2399 saturated.*torques in Nm"):
        replay(fit, [dataclasses.replace(log, tau=1000 * log.tau)])
    (reversed_sense,) = replay(fit, [dataclasses.replace(log, tau=-log.tau)])
    assert "check that it is a log of this arm" in " ".join(reversed_sense.text().split())
    (lifted,) = replay(fit, [dataclasses.replace(log, tau=loaded(model, log, qdd, PAYLOAD))])
    assert "load before its report at 0" in lifted.text() and "  contact at 0." not in lifted.text()
    assert "check that" not in lifted.text()
