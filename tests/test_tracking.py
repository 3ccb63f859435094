"""Simulated logs of a controlled arm have the specified tracking error, encoder steps and torques."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from spelgen.arm.actuation import Drives
from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.errors import SettingsError, SpelgenErrors
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import TrackingSettings
from spelgen.simulation import tracking
from spelgen.simulation.protocol import initial_range, make_friction, paths, sines
from spelgen.simulation.simulate import simulate
from spelgen.simulation.tracking import measured, record, track
from tests.hand_built import arm, body, coordinate, point, slider

N = 6


@pytest.fixture(scope="module")
def loaded(robots):
    return load_arm(robots / "six_dof.urdf")


def changed(settings, tracking=None, **protocol):
    update = {"simulation": settings.simulation.model_copy(update=protocol)}
    return settings.model_copy(
        update=update | {"tracking": settings.tracking.model_copy(update=tracking or {})}
    )


@pytest.fixture(scope="module")
def recordings(loaded):
    """Return settings, motions and logs of an arm that tracks sines under the softest and the hardest controller.

    The motions are a list of (desired path, recording with the true states), the softest controller first, over one
    period of the sines (8 s). The logs are the result of `track`, divided into training and test. loaded: the arm.
    """
    ends = min(loaded.settings.tracking.bandwidths), max(loaded.settings.tracking.bandwidths)
    settings = changed(loaded.settings, {"bandwidths": ends}, trajectories=2)
    kept, inner = [], tracking.record
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            tracking, "record", lambda *given: kept.append((given[3], inner(*given))) or kept[-1][1]
        )
        logs = track(loaded.chain, settings)
    return settings, kept, logs


def test_the_protocol_is_the_papers(loaded):
    """The settings state the simulation of Wang, Chen and Ding (Sci Rep 15:33179, 2025).

    Six PID controllers at 125 Hz track sines of 30 degrees at 1/8 Hz. There are 24,000 samples at 500 Hz, 70 % of them
    for training.
    """
    protocol, motion = loaded.settings.simulation, loaded.settings.tracking
    assert (protocol.sample_rate, motion.control_rate, motion.frequency) == (500, 125, 1 / 8)
    assert motion.amplitude == pytest.approx(np.radians(30))
    assert protocol.trajectories == len(motion.bandwidths) == 6
    assert protocol.trajectories * protocol.duration * protocol.sample_rate == 24_000
    assert protocol.test_fraction == 0.3


def test_the_arm_follows_its_sines_to_a_few_degrees(recordings):
    _, kept, _ = recordings
    worst = []
    for path, recording in kept:
        worst.append(np.degrees(np.abs(recording.states[::4, :N] - path.q).max()))
        assert np.ptp(recording.states[:, :N], axis=0) == pytest.approx(np.radians(60), rel=0.15)
    assert worst[0] < 5
    assert worst[1] < worst[0] / 2, "a harder controller follows better"


@pytest.mark.parametrize("choice", ["same", "own"])
def test_trajectories_follow_one_path_or_each_its_own(loaded, choice):
    """With paths "same", trajectories start at different times of one path and overlap; otherwise each has its own."""
    settings = changed(loaded.settings, {"paths": choice})
    period = 1 / settings.tracking.frequency
    begun = paths(loaded.chain, settings, np.array([0.0, 2 / 6 * period]))
    assert (np.abs(begun[2].q[0] - begun[0].q[1]).max() < 1e-12) == (choice == "same")
    assert len({tuple(path.q[0]) for path in begun}) == 6


def test_paths_of_excitation_go_from_rest_to_rest_within_range_and_speed(loaded):
    settings = Settings.model_validate(
        {"simulation": {"trajectories": 3}, "tracking": {"paths": "excitation"}}
    )
    t = np.linspace(0, 8, 1001)
    for path in paths(loaded.chain, settings, t):
        assert np.abs(path.qd[[0, -1]]).max() < 1e-12
        np.testing.assert_allclose(np.gradient(path.q, t, axis=0)[1:-1], path.qd[1:-1], atol=1e-3)
        low, high = initial_range(loaded.chain, settings)
        assert (np.abs(path.q - (low + high) / 2) <= 0.35 * (high - low) + 1e-12).all()
        assert 0.3 < np.abs(path.qd).max() <= 1


def test_options_of_sines_are_refused_for_excitation():
    with pytest.raises(ValueError, match="amplitude and frequency of sines, with paths: excitation"):
        TrackingSettings(paths="excitation", amplitude=0.2, frequency=0.5)


def test_sines_have_the_stated_frequency():
    t, h = 2.2, 1e-5
    path = sines(np.array([0.5]), 0.3, 0.125, np.array([1.0]), np.array([t - h, t, t + h, t + 8.0]))
    np.testing.assert_allclose(path.qd[1], (path.q[2] - path.q[0]) / (2 * h), rtol=1e-8)
    np.testing.assert_allclose(path.qdd[1], (path.qd[2] - path.qd[0]) / (2 * h), rtol=1e-8)
    np.testing.assert_allclose(path.q[3], path.q[1], atol=1e-12)


def test_positions_are_whole_encoder_steps_within_half_a_step(recordings):
    settings, kept, _ = recordings
    step = settings.tracking.resolution
    for _, recording in kept:
        np.testing.assert_allclose(np.round(recording.encoders / step), recording.encoders / step, atol=1e-6)
        missed = np.abs(recording.encoders - recording.states[:, :N])
        assert 0.49 * step < missed.max() <= 0.5000001 * step


def test_logs_approximate_the_true_motion(recordings):
    settings, kept, _ = recordings
    away = []
    for _, recording in kept:
        log = measured(recording, settings.tracking, "x")
        away.append(log.qd - recording.states[:, N:])
        assert np.sqrt(np.mean((log.q - recording.states[:, :N]) ** 2)) < 0.3 * settings.tracking.resolution
    raw = np.gradient(kept[0][1].encoders, kept[0][1].t, axis=0) - kept[0][1].states[:, N:]
    speed = np.sqrt(np.mean(kept[0][1].states[:, N:] ** 2))
    assert np.sqrt(np.mean(np.square(away))) < 0.01 * speed
    assert np.sqrt(np.mean(np.square(away[0][250:-250]))) < 0.25 * np.sqrt(np.mean(raw**2))


def test_the_filter_does_not_delay(recordings):
    """The filter of logged velocities has no delay: their error does not correlate with the acceleration.

    A delay d would add d times the acceleration.
    """
    settings, kept, _ = recordings
    _, recording = kept[0]
    log = measured(recording, settings.tracking, "x")
    inside = slice(500, -500)
    error = (log.qd - recording.states[:, N:])[inside]
    rate = np.gradient(recording.states[:, N:], recording.t, axis=0)[inside]
    delay = -np.sum(error * rate) / np.sum(rate**2)
    assert abs(delay) < 2e-4


def test_torques_are_held_between_ticks_and_explain_the_motion(recordings, loaded):
    """Logged torques are constant between control ticks, and explain the motion.

    Another integrator, from the true state at a tick under the logged torque, gives the state at the next tick.
    """
    settings, kept, logs = recordings
    _, recording = kept[1]
    np.testing.assert_array_equal(np.concatenate([logs.train[1].tau, logs.test[1].tau]), recording.tau)
    assert (recording.tau.reshape(-1, 4, N) == recording.tau[::4, None]).all()
    engine, friction = arm_dynamics(loaded.chain, settings), make_friction(loaded.chain, settings)
    start = 4 * 300

    def derivative(_, state):
        qd = state[N:]
        force = recording.tau[start] - friction(qd)
        return np.concatenate([qd, engine.forward_dynamics(state[:N], qd, force)])

    end = solve_ivp(derivative, (0, 0.008), recording.states[start], rtol=1e-11, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(recording.states[start + 4], end, atol=1e-9)


def test_the_first_seventy_percent_train_and_the_rest_tests(recordings):
    _, _, logs = recordings
    assert [len(x.t) for x in logs.train] == [2800, 2800]
    assert [len(x.t) for x in logs.test] == [1200, 1200]
    assert [x.name for x in logs.train + logs.test] == ["traj_00", "traj_01", "traj_00_end", "traj_01_end"]
    for first, last in zip(logs.train, logs.test, strict=True):
        assert last.t[0] - first.t[-1] == pytest.approx(0.002)


def test_the_seed_decides_everything(loaded):
    def logs(**protocol):
        return track(loaded.chain, changed(loaded.settings, trajectories=1, duration=0.2, **protocol))

    first, again, other = logs(), logs(), logs(seed=1)
    for quantity in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(first.train[0], quantity), getattr(again.train[0], quantity))
    assert not np.array_equal(first.train[0].q, other.train[0].q)


def test_motors_behind_gears_get_their_share_and_a_passive_joint_none():
    """With G = diag(20, 0) the logged torque is a twentieth of the torque at joint 1; passive joint 2 swings freely."""
    joints = [coordinate(), coordinate("b", continuous=True, passive=True)]
    bodies = [body(name, parent=k - 1, coordinate=k, inertia=point(1, 0.1)) for k, name in enumerate("ab")]
    two = arm(joints, bodies, gravity=(0, -9.81, 0))
    settings = changed(Settings(), trajectories=1, duration=0.4, sample_rate=500.0, test_fraction=0.0)
    plain, geared = (
        track(two, settings, Drives(np.diag([gear, 0.0]), np.eye(2))).train[0] for gear in (1.0, 20.0)
    )
    np.testing.assert_allclose(geared.tau, plain.tau / 20, atol=1e-9)
    np.testing.assert_allclose(geared.q, plain.q, atol=1e-9)
    assert not plain.tau[:, 1].any()
    assert plain.tau[:, 0].any()


def test_the_arm_is_held_against_its_weight_from_the_start(loaded):
    """The controller's initial torque balances gravity: without feedback, an arm at its desired position stays at rest.

    The amplitude of the desired sines and the feedback gains are zero.
    """
    friction = make_friction(loaded.chain, loaded.settings)
    engine = arm_dynamics(loaded.chain, loaded.settings, friction)
    still = sines(np.full(N, 0.4), 0.0, 0.125, np.zeros(N), np.arange(50) / 125)
    settings = changed(loaded.settings, duration=0.4)
    held = record(engine, friction, np.eye(N), still, settings, np.zeros(N), 0.0)
    np.testing.assert_allclose(held.states[:, :N], 0.4, atol=1e-12)
    assert np.abs(held.tau).max() > 1


@pytest.mark.parametrize(
    ("tracking", "message"),
    [
        (
            {"control_rate": 150.0},
            "tracking.control_rate: got 150 Hz with samples at 500 Hz, expected a rate of which "
            "simulation.sample_rate is a multiple",
        ),
        (
            {"amplitude": 1.5},
            "tracking.amplitude: got 1.5 beside the range -1 to 1 of 'a', expected sines within the range; "
            "make it smaller or give the joint wider simulation.positions",
        ),
    ],
)
def test_infeasible_motions_are_refused(tracking, message):
    with pytest.raises(SettingsError) as error:
        track(slider(), changed(Settings(), tracking, sample_rate=500.0))
    assert str(error.value) == message


def test_every_joint_whose_range_is_too_small_is_reported():
    joints = [coordinate(upper=-0.5), coordinate("b", upper=-0.4)]
    bodies = [body(name, parent=k - 1, coordinate=k, inertia=point(1, 0.1)) for k, name in enumerate("ab")]
    with pytest.raises(SpelgenErrors, match=r"of 'a'.*\n.*of 'b'"):
        track(arm(joints, bodies), changed(Settings(), {"amplitude": 0.5}, sample_rate=500.0))


def test_by_default_an_arm_is_controlled(shared):
    """By default, simulated arms move under a controller.

    Without a controller, one of the two arms (no friction) would fall within a second; friction would stop the other.
    """
    for name in ("kinova_gen3_7dof_2f85", "kuka_iiwa14_lbrstack"):
        loaded = load_arm(shared / "arms" / f"{name}.urdf")
        logs = simulate(loaded, trajectories=1, duration=1.0)
        low, high = initial_range(loaded.chain, loaded.settings)
        middle, reach = (low + high) / 2, 0.35 * (high - low)
        for log in logs:
            assert (np.abs(log.q - middle) < 1.02 * reach + 0.005).all()
        assert max(np.ptp(log.q, axis=0).max() for log in logs) > 0.05


def test_specified_inputs_or_a_protocol_are_used(robots):
    loaded = load_arm(robots / "two_link.urdf")
    assert len(np.unique(simulate(loaded, trajectories=2, duration=0.5)[0].tau)) <= 5
    bare = replace(loaded, settings=Settings())
    assert simulate(bare, trajectories=1, duration=0.2).train[0].sample_rate == pytest.approx(125.0)
    chosen = Settings.model_validate({"simulation": {"protocol": "random-inputs", "duration": 0.2}})
    assert simulate(replace(loaded, settings=chosen), trajectories=2)[0].sample_rate == pytest.approx(20.0)
