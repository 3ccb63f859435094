"""Simulated logs equal exact solutions and another integrator; inputs are held, seeds are deterministic."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj

from spelgen.arm.arm import make_arm
from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.errors import ArmError, RunError, SettingsError
from spelgen.settings.settings import JointSettings, Settings, load_settings
from spelgen.simulation import integration
from spelgen.simulation.integration import rollout
from spelgen.simulation.protocol import make_friction
from spelgen.simulation.simulate import random_inputs, simulate
from spelgen.urdf.read import read_urdf
from tests.hand_built import arm, body, coordinate, coupled_urdf, pendulum, point, slider


@pytest.fixture(scope="module")
def settings():
    """Return settings of a short simulation."""
    return Settings().model_copy(update={"simulation": protocol(Settings(), trajectories=6, duration=0.2)})


def protocol(settings, **changes):
    return settings.simulation.model_copy(update=changes)


def load(path):
    settings = load_settings(path)
    return make_arm(read_urdf(path), gravity=settings.gravity), settings


def run(arm, settings, start, t, tau):
    dynamics = arm_dynamics(arm, settings, make_friction(arm, settings))
    return rollout(dynamics, np.array(start), t, tau)


class TestMotion:
    def test_a_pendulum_swings_by_its_elliptic_function(self):
        """A pendulum released at angle A moves as the Jacobi elliptic function: angle = 2 asin(k cd(w t, k^2)).

        k = sin(A/2), w^2 = g / length; the angle is measured from the vertical.
        """
        amplitude, t = 2.0, np.linspace(0, 3, 31)
        k, w = np.sin(amplitude / 2), np.sqrt(9.81 / 0.7)
        _, cn, dn, _ = ellipj(w * t, k**2)
        states = run(pendulum(length=0.7), Settings(), [amplitude - np.pi / 2, 0], t, np.zeros((t.size, 1)))
        np.testing.assert_allclose(states[:, 0] + np.pi / 2, 2 * np.arcsin(k * cn / dn), atol=1e-11)

    def test_a_slider_under_held_forces_and_viscous_friction(self):
        """A slider under constant forces F and viscous friction b has the exact velocity in each interval.

        v = F/b + (v0 - F/b) exp(-b t/m), with v0 at the end of the interval before.
        """
        m, b, dt = 2.0, 0.5, 0.1
        force = np.array([[3.0], [-1.0], [0.0], [4.0], [100.0]])
        settings = Settings(joints={"a": JointSettings(viscous=b)})
        states = run(slider(mass=m), settings, [0.2, 0.7], dt * np.arange(5), force)
        x, v = 0.2, 0.7
        for k, (F,) in enumerate(force):
            np.testing.assert_allclose(states[k], [x, v], atol=1e-12)
            end, decay = F / b, np.exp(-b * dt / m)
            x, v = x + end * dt + (v - end) * m / b * (1 - decay), end + (v - end) * decay

    @pytest.mark.parametrize(("v", "force"), [(5.0, 0.8), (-5.0, -0.3)])
    def test_coulomb_friction_brakes_by_its_own_side(self, v, force):
        settings = Settings(joints={"a": JointSettings(coulomb=(0.8, -0.3))})
        t = np.array([0.0, 0.5, 1.0])
        states = run(slider(mass=2.0), settings, [0, v], t, np.zeros((3, 1)))
        np.testing.assert_allclose(states[:, 1], v - force / 2.0 * t, atol=1e-12)
        np.testing.assert_allclose(states[:, 0], v * t - force / 4.0 * t**2, atol=1e-12)

    def test_an_arm_without_losses_keeps_its_energy(self, robots):
        two_link, _ = load(robots / "two_link.urdf")
        geared = Settings(joints={"joint1": JointSettings(rotor_inertia=0.02, gear=5.0)})
        engine = arm_dynamics(two_link, geared)
        t = np.linspace(0, 2, 21)
        states = run(two_link, geared, [2.5, -1.0, 0.3, 0.2], t, np.zeros((t.size, 2)))
        data = engine.model.createData()
        energies = [
            0.5 * qd @ engine.mass_matrix(q) @ qd + pin.computePotentialEnergy(engine.model, data, q)
            for q, qd in np.split(states, 2, axis=1) and zip(states[:, :2], states[:, 2:], strict=True)
        ]
        np.testing.assert_allclose(energies, energies[0], atol=1e-10)

    def test_energy_balance_of_motors_and_friction(self, robots):
        """The change of energy is the work of motors minus friction: dE/dt = qd (tau - friction(qd)).

        The reference is integrated by another solver with other steps.
        """
        rpr, settings = load(robots / "rpr.urdf")
        engine, friction = arm_dynamics(rpr, settings), make_friction(rpr, settings)
        tau = np.array([2.0, -1.0, 1.0])
        start = np.array([0.3, 0.8, 1.0, 0.0, 0.2, -0.5, 0.0])  # initial q, qd and work

        def derivative(_, state):
            q, qd = state[:3], state[3:6]
            force = tau - friction(qd)
            return np.concatenate([qd, engine.forward_dynamics(q, qd, force), [qd @ force]])

        t = np.array([0.0, 0.5])
        end = rollout(arm_dynamics(rpr, settings, friction), start[:6], t, np.stack([tau, tau]))[-1]
        other = solve_ivp(derivative, t, start, method="Radau", rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(end, other[:6], atol=1e-8)
        data = engine.model.createData()
        energy = [
            0.5 * state[3:6] @ engine.mass_matrix(state[:3]) @ state[3:6]
            + pin.computePotentialEnergy(engine.model, data, state[:3])
            for state in (start, end)
        ]
        assert energy[1] - energy[0] == pytest.approx(other[6], abs=1e-8)


class TestFriction:
    def test_it_levels_off_at_each_side_and_vanishes_at_rest(self):
        joint = JointSettings(viscous=0.1, coulomb=(0.4, -0.9))
        friction = make_friction(slider(), Settings(joints={"a": joint}))
        qd = np.array([[10.0], [-10.0], [0.0]])
        np.testing.assert_allclose(friction(qd), [[1.0 + 0.4], [-1.0 - 0.9], [0.0]], atol=1e-14)

    def test_it_never_drives_and_has_no_kink(self):
        # no friction in the positive direction: the largest possible difference between directions
        joint = JointSettings(coulomb=(0.0, -1.0))
        friction = make_friction(slider(), Settings(joints={"a": joint}))
        qd = np.linspace(-0.5, 0.5, 100_001)[:, None]
        torque = friction(qd)
        assert (torque * qd >= 0).all()
        assert (np.diff(torque[:, 0]) >= -1e-15).all() or torque.max() <= 0.2
        assert np.abs(np.diff(torque[:, 0], 2)).max() < 1e-6

    def test_where_two_motors_move_two_joints_friction_is_that_of_the_motors(self):
        """The simulated friction of coupled motors is a function of motor velocities, not of joint velocities.

        The motors of this differential turn at the sum and at the difference of the two joint velocities.
        """
        joints = [coordinate(damping=0.3, friction=0.2), coordinate("b", damping=0.1, friction=0.4)]
        bodies = [
            body(name, parent=k - 1, coordinate=k, inertia=point(1, 0.1)) for k, name in enumerate("ab")
        ]
        friction = make_friction(arm(joints, bodies), Settings(), np.array([[1.0, 1.0], [1.0, -1.0]]))
        # friction torques of both motors, at 5 and -1 rad/s
        first, second = 0.3 * 5.0 + 0.2, 0.1 * -1.0 - 0.4
        np.testing.assert_allclose(
            friction(np.array([2.0, 3.0])), [first + second, first - second], rtol=1e-12
        )

    def test_a_joint_the_sidecar_does_not_list_has_the_friction_of_its_urdf(self):
        rail = slider(damping=0.3, friction=0.2)
        assert make_friction(rail, Settings())(np.array([10.0])) == pytest.approx([3.2])
        listed = Settings(joints={"a": JointSettings(viscous=0.1)})
        assert make_friction(rail, listed)(np.array([10.0])) == pytest.approx([1.0])


class TestProtocol:
    def test_logs_are_sampled_at_rest_within_limits_with_inputs_drawn_from_the_list(self, robots, settings):
        two_link, _ = load(robots / "two_link.urdf")
        logs = random_inputs(two_link, settings)
        assert len(logs.train) == len(logs.test) == 3
        assert sorted(each.name for each in logs.train + logs.test) == [f"traj_{k:02d}" for k in range(6)]
        for each in logs.train + logs.test:
            np.testing.assert_array_equal(each.t, [0, 0.05, 0.1, 0.15, 0.2])
            assert each.q.shape == each.qd.shape == each.tau.shape == (5, 2)
            assert not each.qd[0].any()
            assert (np.abs(each.q[0]) <= np.pi).all()
            assert set(each.tau.ravel()) <= {-2.0, -1.0, 0.0, 1.0, 2.0}
        assert {value for each in logs.train for value in each.tau.ravel()} == {-2.0, -1.0, 0.0, 1.0, 2.0}

    def test_logged_torques_are_held_to_the_next_sample(self, robots, settings):
        two_link, _ = load(robots / "two_link.urdf")
        log = random_inputs(two_link, settings).train[0]
        engine = arm_dynamics(two_link, settings)

        def derivative(_, state):
            return np.concatenate([state[2:], engine.forward_dynamics(state[:2], state[2:], log.tau[2])])

        start = np.concatenate([log.q[2], log.qd[2]])
        end = solve_ivp(derivative, (0, 0.05), start, method="RK45", rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(end, [*log.q[3], *log.qd[3]], atol=1e-9)

    def test_the_seed_decides_everything(self, robots, settings):
        two_link, _ = load(robots / "two_link.urdf")
        first, again = random_inputs(two_link, settings), random_inputs(two_link, settings)
        other = random_inputs(
            two_link, settings.model_copy(update={"simulation": protocol(settings, seed=1)})
        )
        for one, two in zip(first.train + first.test, again.train + again.test, strict=True):
            assert one.name == two.name
            for quantity in ("q", "qd", "tau"):
                np.testing.assert_array_equal(getattr(one, quantity), getattr(two, quantity))
        assert not np.array_equal(first.train[0].q[0], other.train[0].q[0])
        assert {each.name for each in first.test} != {each.name for each in other.test}

    def test_no_trajectory_depends_on_how_many_there_are(self, settings):
        def start(count):
            changed = settings.model_copy(update={"simulation": protocol(settings, trajectories=count)})
            logs = random_inputs(slider(), changed)
            return next(each.q[0] for each in logs.train + logs.test if each.name == "traj_01")

        assert start(2) == start(5)

    @pytest.mark.parametrize(
        ("trajectories", "fraction", "tested"), [(1, 0.5, 0), (3, 0.0, 0), (5, 0.4, 2), (4, 0.99, 3)]
    )
    def test_the_split_keeps_a_trajectory_for_training(self, settings, trajectories, fraction, tested):
        changes = {"trajectories": trajectories, "test_fraction": fraction, "duration": 0.05}
        logs = random_inputs(
            slider(), settings.model_copy(update={"simulation": protocol(settings, **changes)})
        )
        assert (len(logs.train), len(logs.test)) == (trajectories - tested, tested)

    def test_positions_inputs_and_passive_joints_of_the_sidecar_are_followed(self):
        joints = [coordinate(), coordinate("b"), coordinate("c", continuous=True, passive=True)]
        bodies = [
            body(name, parent=k - 1, coordinate=k, inertia=point(1, 0.1)) for k, name in enumerate("abc")
        ]
        settings = Settings.model_validate(
            {
                "joints": {"a": {"inputs": [7]}, "b": {"actuated": False}},
                "simulation": {"trajectories": 20, "duration": 0.05, "positions": {"a": [0.5, 0.6]}},
            }
        )
        logs = random_inputs(arm(joints, bodies), settings)
        starts = np.array([each.q[0] for each in logs.train + logs.test])
        assert ((starts[:, 0] >= 0.5) & (starts[:, 0] <= 0.6)).all()
        assert (np.abs(starts[:, 1]) <= 1).all()
        assert 1 < np.abs(starts[:, 2]).max() <= np.pi
        assert all((each.tau == [7, 0, 0]).all() for each in logs.train)

    def test_progress_is_reported_after_every_trajectory(self, settings):
        told = []
        random_inputs(slider(), settings, progress=lambda done, total: told.append((done, total)))
        assert told == [(done, 6) for done in range(1, 7)]

    def test_a_joint_without_limits_needs_positions(self, settings):
        with pytest.raises(ArmError) as error:
            random_inputs(slider(lower=None, upper=None), settings)
        assert str(error.value) == (
            "joint 'a': got no position limits, expected a range to move in; "
            "write 'simulation: {positions: {a: [LOWEST, HIGHEST]}}' into the robot's YAML"
        )

    def test_a_motion_without_finite_acceleration_ends_clearly(self, settings):
        with pytest.raises(RunError) as error:
            random_inputs(slider(mass=0.0), settings)
        assert str(error.value) == (
            "the motion cannot be integrated beyond t = 0 s: an acceleration is not finite; check the inertials; "
            "make simulation.duration smaller or simulation.coulomb_smoothing_velocity larger"
        )


class TestIntegration:
    @pytest.mark.parametrize("robot", ["two_link", "rpr", "scara", "ur10e"])
    def test_another_method_of_high_order_ends_at_the_same_states(self, robot, robots):
        chosen, settings = load(robots / f"{robot}.urdf")
        engine, friction = arm_dynamics(chosen, settings), make_friction(chosen, settings)
        n = len(chosen.coordinates)
        random = np.random.default_rng(0)
        start = np.concatenate([random.uniform(-1, 1, n), random.uniform(-0.5, 0.5, n)])
        t, tau = np.linspace(0.0, 0.25, 6), random.normal(size=(6, n))
        states = integration.rollout(arm_dynamics(chosen, settings, friction), start, t, tau)
        for k in range(len(t) - 1):

            def derivative(_, state, torque=tau[k]):
                qd = state[n:]
                return np.concatenate([qd, engine.forward_dynamics(state[:n], qd, torque - friction(qd))])

            end = solve_ivp(derivative, t[k : k + 2], states[k], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            np.testing.assert_allclose(states[k + 1], end, atol=1e-9)

    def test_no_reversal_goes_unseen_between_the_stages_of_a_step(self):
        """A reversal of velocity within one integration step is detected: the final velocity is right within 1e-4 m/s.

        The reversal is so fast that the slider crosses the jump of dry friction at zero velocity within one step. Dry
        friction is 1 N before and 3 N after the reversal, smoothed over 1e-3 m/s.
        """
        settings = Settings.model_validate(
            {
                "joints": {"a": {"coulomb": [1.0, -3.0]}},
                "simulation": {"coulomb_smoothing_velocity": 1e-3},
            }
        )
        t, force = np.array([0.0, 1.0]), np.full((2, 1), -50.0)
        states = run(slider(mass=1.0), settings, [0, 20.0], t, force)
        stops = 20.0 / 51.0
        np.testing.assert_allclose(states[1, 1], -47.0 * (1 - stops), atol=1e-3)
        assert states[1, 1] == pytest.approx(-47.0 * (1 - stops), abs=1e-4)


class TestInMemory:
    def test_an_arm_gives_its_logs(self, robots):
        logs = simulate(load_arm(robots / "two_link.urdf"), trajectories=4, duration=0.2, seed=3)
        assert len(logs) == len(logs.train) + len(logs.test) == 4
        assert [x.name for x in logs] == [x.name for x in (*logs.train, *logs.test)]
        assert repr(logs) == "<SimulatedLogs: 2 to train, 2 to test>"
        assert logs._repr_html_().count("<tr>") == 5
        again = simulate(load_arm(robots / "two_link.urdf"), trajectories=4, duration=0.2, seed=3)
        np.testing.assert_array_equal(logs[0].q, again[0].q)

    def test_invalid_settings_are_named(self, robots):
        with pytest.raises(SettingsError) as error:
            simulate(load_arm(robots / "two_link.urdf"), sample_rate=-1)
        assert str(error.value) == "simulate: sample_rate: got -1, expected greater than 0"

    def test_settings_of_other_steps_are_not_read(self, robots, tmp_path):
        (tmp_path / "arm.urdf").write_bytes((robots / "two_link.urdf").read_bytes())
        (tmp_path / "arm.yaml").write_text("training: {nonsense: 1}\nlogs: {units: {q: furlongs}}\n")
        assert len(simulate(load_arm(tmp_path / "arm.urdf"), trajectories=1, duration=0.1)) == 2

    def test_a_mimic_joint_moves_along(self, tmp_path):
        """The logged torque of an arm with a mimic joint is tau = K^T rnea(K q + offset, K qd, K qdd), by Pinocchio.

        K: (2, 1) velocities of both joints per velocity of the leader.
        """
        coupled = coupled_urdf(tmp_path / "coupled.urdf")
        coupled.with_suffix(".yaml").write_text("simulation: {protocol: random-inputs}")
        logs = simulate(load_arm(coupled), trajectories=2, duration=0.2, sample_rate=200.0)
        assert all(x.q.shape == (41, 1) for x in logs)
        model = pin.buildModelFromUrdf(str(coupled))
        data, jacobian = model.createData(), np.array([1.0, 0.5])
        log = logs[0]
        states = zip(log.q[:, 0], log.qd[:, 0], np.gradient(log.qd[:, 0], log.t), strict=True)
        needed = [
            jacobian @ pin.rnea(model, data, jacobian * q + [0, -0.1], jacobian * qd, jacobian * qdd)
            for q, qd, qdd in states
        ]
        # the difference quotient at a sample is the mean of both intervals, and so is the torque
        held = (log.tau[1:-2, 0] + log.tau[:-3, 0]) / 2
        np.testing.assert_allclose(needed[1:-2], held, atol=0.02)
