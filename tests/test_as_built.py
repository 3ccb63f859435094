"""Simulated arms as built are physically consistent, differ from their URDF, and agree exactly with their own logs."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
import yaml
from typer.testing import CliRunner

import spelgen
from spelgen.cli.main import app
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.errors import LogError, SettingsError, SpelgenError, SpelgenErrors
from spelgen.evaluation.rollout import mass_error, true_mass
from spelgen.excitation.trajectory import Motion
from spelgen.settings.settings import JointSettings, Settings
from spelgen.simulation.as_built import perturbed_urdf
from spelgen.simulation.prescribed import friction_along, prescribed, read_motion
from spelgen.simulation.protocol import make_friction
from spelgen.urdf.read import read_urdf
from tests.hand_built import arm, body, coordinate, point, slider

ROOT = Path(__file__).parents[1]
ROBOTS = ("two_link", "rpr", "scara", "six_dof", "panda", "ur10e")


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_here_has_an_arm_as_built(name, robots, tmp_path):
    """Each robot of the repository has an as-built arm with other masses and with drives. The arm can be simulated.

    Its inertials are physically consistent. The RMS of log(mass / URDF's mass) is 0.05 to 0.8; its nominal value is
    0.3. Each drive has friction and armature.
    """
    given = spelgen.load_arm(robots / f"{name}.urdf")
    true = spelgen.as_built(given, 3, tmp_path / "as_built.urdf")
    assert true.chain.joint_names == given.chain.joint_names
    ratios = []
    for before, after in zip(given.chain.bodies, true.chain.bodies, strict=True):
        ratios.append(np.log(float(after.inertia[0] / before.inertia[0])))
        assert is_consistent(np.array(after.inertia, dtype=float))
    assert 0.05 < np.sqrt(np.mean(np.square(ratios))) < 0.8
    for joint in given.chain.joint_names:
        drive = true.settings.joint(joint)
        assert drive.viscous > 0 and drive.armature > 0 and drive.coulomb[0] > 0 > drive.coulomb[1]
    logs = spelgen.simulate(true, duration=2.0)
    assert (len(logs.train), len(logs.test)) == (1, 1)
    assert len(logs.train[0]) == 401


def is_consistent(inertia):
    """Return True if the pseudo-inertia matrix of ten inertial parameters about the joint is positive semidefinite."""
    m, hx, hy, hz, ixx, ixy, ixz, iyy, iyz, izz = inertia
    tensor = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    pseudo = np.zeros((4, 4))
    pseudo[:3, :3] = np.trace(tensor) / 2 * np.eye(3) - tensor
    pseudo[3, :3] = pseudo[:3, 3] = hx, hy, hz
    pseudo[3, 3] = m
    return np.linalg.eigvalsh(pseudo).min() > -1e-9 * np.trace(pseudo)


def test_the_seed_decides_everything(robots, tmp_path):
    given = spelgen.load_arm(robots / "rpr.urdf")
    files = {}
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        true = spelgen.as_built(given, seed, tmp_path / folder / "as_built.urdf")
        path = true.robot.path
        tau = spelgen.simulate(true, duration=1.0).train[0].tau
        files[folder] = (path.read_bytes(), path.with_suffix(".yaml").read_bytes(), tau.tobytes())
    assert files["a"] == files["b"]
    assert all(one != other for one, other in zip(files["a"], files["c"], strict=True))


def test_logs_are_the_inverse_dynamics_of_the_truth(robots, tmp_path):
    """Without noise, encoder steps and friction, logged torques are the inverse dynamics of the as-built URDF."""
    true = spelgen.as_built(spelgen.load_arm(robots / "scara.urdf"), 5, tmp_path / "as_built.urdf")
    sidecar = tmp_path / "as_built.yaml"
    settings = yaml.safe_load(sidecar.read_text())
    settings["simulation"] |= {"torque_noise": 0.0, "duration": 2.0}
    settings["tracking"] |= {"resolution": 1e-12, "cutoff": 90.0}
    for drive in settings["joints"].values():
        drive |= {"viscous": 0.0, "coulomb": [0.0, 0.0]}
    sidecar.write_text(yaml.safe_dump(settings))
    log = spelgen.simulate(spelgen.load_arm(tmp_path / "as_built.urdf")).train[0]
    model = pin.buildModelFromUrdf(str(tmp_path / "as_built.urdf"))
    model.armature = np.array([true.settings.joint(name).armature for name in true.chain.joint_names])
    data, qdd = model.createData(), np.gradient(log.qd, log.t, axis=0)
    # the ends of the log are omitted: the low-pass filter and differences are inaccurate there
    rows = range(50, len(log) - 50)
    tau = np.array([pin.rnea(model, data, log.q[k], log.qd[k], qdd[k]) for k in rows])
    np.testing.assert_allclose(log.tau[50:-50], tau, atol=2e-3 * np.abs(tau).max())


def test_an_impossible_inertia_becomes_a_possible_one(tmp_path):
    text = (
        '<robot name="r"><link name="a"/><link name="b"><inertial><mass value="2"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    path = tmp_path / "r.urdf"
    path.write_text(text)
    (tmp_path / "new.urdf").write_bytes(perturbed_urdf(path, 0.0, 0))
    tensor = [float(x) for x in read_urdf(tmp_path / "new.urdf").links[1].inertial.tensor]
    moments = [tensor[0], tensor[3], tensor[5]]
    assert max(moments) < sum(moments) - max(moments)
    assert float(read_urdf(tmp_path / "new.urdf").links[1].inertial.mass) == 2.0


def test_an_arm_without_inertials_is_refused_by_its_joint(tmp_path, robots):
    path = tmp_path / "bare.urdf"
    text = (robots / "two_link.urdf").read_text(encoding="utf-8")
    path.write_text(re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.DOTALL))
    with pytest.raises(SpelgenErrors, match=r"bare\.urdf: joint 'joint1'.*without <inertial>"):
        spelgen.simulate(spelgen.load_arm(path))
    with pytest.raises(SpelgenErrors, match=r"bare\.urdf: joint 'joint1'.*without <inertial>"):
        spelgen.as_built(spelgen.load_arm(path), 0, tmp_path / "as_built.urdf")
    assert not (tmp_path / "as_built.urdf").exists()


def test_the_arm_itself_is_never_replaced(robots, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes((robots / "rpr.urdf").read_bytes())
    with pytest.raises(SpelgenError, match="the URDF of the arm itself"):
        spelgen.as_built(spelgen.load_arm(path), 0, path)
    assert path.read_bytes() == (robots / "rpr.urdf").read_bytes()


def test_arms_that_no_path_moves_are_driven_by_their_own_settings(robots, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes((robots / "two_link.urdf").read_bytes())
    settings = (
        "joints: {joint2: {actuated: false}}\nsimulation: {inputs: [-1, 1], trajectories: 4, duration: 0.2}\n"
    )
    path.with_suffix(".yaml").write_text(settings)
    true = spelgen.as_built(spelgen.load_arm(path), 0, tmp_path / "as_built.urdf")
    logs = spelgen.simulate(true)
    assert len(logs) == 4
    assert not logs.train[0].tau[:, 1].any() and set(np.unique(logs.train[0].tau[:, 0])) <= {-1.0, 1.0}
    path.with_suffix(".yaml").write_text("input: position\nsimulation: {trajectories: 2, duration: 1}\n")
    servos = spelgen.simulate(spelgen.as_built(spelgen.load_arm(path), 0, tmp_path / "as_built.urdf"))
    assert len(servos) == 2 and servos.train[0].u is not None


class TestHysteresis:
    PRESLIDING = 0.03

    def torque(self, q, t):
        friction = make_friction(slider(), Settings(joints={"a": JointSettings(coulomb=(2.0, -1.0))}))
        motion = Motion(t, q[:, None], np.gradient(q, t)[:, None], np.zeros((len(t), 1)))
        return friction_along(friction, arm_of("revolute"), motion, self.PRESLIDING)[:, 0]

    def test_dry_friction_builds_up_over_the_presliding_displacement(self):
        t = np.linspace(0, 1, 2001)
        tau = self.torque(0.1 * t, t)
        assert tau[0] == 0.0 and (np.diff(tau) >= -1e-12).all()
        assert tau[t <= 0.9 * self.PRESLIDING / 0.1].max() < 2.0
        np.testing.assert_allclose(tau[0.1 * t > self.PRESLIDING], 2.0, atol=1e-12)

    def test_a_cycle_dissipates_and_closes(self):
        """Hysteretic friction dissipates energy in a closed cycle, the same energy from the second cycle on."""
        t = np.linspace(0, 3, 6001)
        q = 0.05 * np.sin(2 * np.pi * t)
        tau = self.torque(q, t)
        work = np.concatenate([[0.0], np.cumsum((tau[1:] + tau[:-1]) / 2 * np.diff(q))])
        second, third = work[4000] - work[2000], work[6000] - work[4000]
        assert second > 0
        assert third == pytest.approx(second, rel=1e-6)
        # at most the work of friction without presliding: 0.1 m up against 2 N and 0.1 m down against 1 N
        assert second < 0.1 * (2.0 + 1.0)

    def test_sliding_joints_build_up_over_a_tenth(self):
        friction = make_friction(slider(), Settings(joints={"a": JointSettings(coulomb=(2.0, -1.0))}))
        t = np.linspace(0, 1, 1001)
        motion = Motion(t, 0.01 * t[:, None], np.full((1001, 1), 0.01), np.zeros((1001, 1)))
        tau = friction_along(friction, arm_of("prismatic"), motion, self.PRESLIDING)[:, 0]
        np.testing.assert_allclose(tau[0.01 * t > 0.1 * self.PRESLIDING], 2.0, atol=1e-12)


def arm_of(kind):
    return arm([coordinate("a", kind=kind)], [body("a", kind=kind, inertia=point(1, 0.1))])


class TestPrescribed:
    def motion(self, n):
        t = np.arange(201) / 100
        q = np.sin(t)[:, None] * np.ones(n)
        return Motion(t, q, np.cos(t)[:, None] * np.ones(n), -q)

    def test_given_motions_are_performed_and_the_last_half_tests(self, robots):
        loaded = spelgen.load_arm(robots / "two_link.urdf")
        logs = spelgen.simulate(loaded, motions=[self.motion(2)] * 4)
        assert [len(logs.train), len(logs.test)] == [2, 2]
        np.testing.assert_allclose(logs.train[0].q[20:-20], self.motion(2).q[20:-20], atol=1e-3)
        tau = arm_dynamics(loaded.chain, loaded.settings).inverse_dynamics(
            self.motion(2).q, self.motion(2).qd, self.motion(2).qdd
        )
        friction = make_friction(loaded.chain, loaded.settings)(self.motion(2).qd)
        np.testing.assert_allclose(logs.train[0].tau, tau + friction, atol=1e-12)

    def test_noise_is_relative_to_the_torque(self, robots):
        loaded = spelgen.load_arm(robots / "two_link.urdf")
        simulation = loaded.settings.simulation.model_copy(update={"torque_noise": 0.1})
        noisy = loaded.settings.model_copy(update={"simulation": simulation})
        clean, seen = (
            prescribed(loaded.chain, settings, motions=[self.motion(2)])[0].tau
            for settings in (loaded.settings, noisy)
        )
        np.testing.assert_allclose((seen - clean).std(axis=0) / clean.std(axis=0), 0.1, rtol=0.2)

    def test_a_passive_joint_is_refused_by_its_name(self):
        passive = arm([coordinate("a", passive=True)], [body("a", inertia=point(1, 0.1))])
        with pytest.raises(SettingsError, match="the passive joint 'a'"):
            prescribed(passive, Settings(), motions=[self.motion(1)])


class TestMotionFile:
    def write(self, path, rows=30, head="t,q_a,qd_a,qdd_a", t=None):
        t = np.arange(rows) / 10 if t is None else t
        lines = [head, *(f"{x:g},0.5,0.5,0.5" for x in t)]
        path.write_text("\n".join(lines) + "\n")
        return path

    def test_files_of_excite_are_read_back(self, robots, tmp_path):
        found = spelgen.excite(spelgen.load_arm(robots / "two_link.urdf"), duration=2.0, trials=2)
        (tmp_path / "m.csv").write_text(found.csv())
        motion = read_motion(tmp_path / "m.csv", found.arm.joint_names)
        for name in ("t", "q", "qd", "qdd"):
            np.testing.assert_allclose(getattr(motion, name), getattr(found.motion, name), atol=1e-9)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"head": "t,q_a,qd_a,x"}, "no column qdd_a"),
            ({"rows": 5}, "5 rows"),
            ({"t": [*range(20), 30]}, ":22: t: got a step of 11 s after 19 s, expected equal steps"),
            ({"t": [*range(20), float("nan")]}, "no finite number"),
            ({"t": [*range(20), 19]}, "a step of 0 s"),
        ],
    )
    def test_files_that_are_no_motion_are_refused(self, change, message, tmp_path):
        path = self.write(tmp_path / "m.csv", **change)
        with pytest.raises(LogError, match=message) as caught:
            read_motion(path, ["a"])
        assert str(path) in str(caught.value)

    def test_files_that_are_no_table_are_refused(self, tmp_path):
        (tmp_path / "m.csv").write_bytes(b"t,q_a,qd_a,qdd_a\nx,y,z,w\n" * 30)
        with pytest.raises(LogError, match=r"unreadable|no finite"):
            read_motion(tmp_path / "m.csv", ["a"])
        with pytest.raises(LogError, match="no regular file"):
            read_motion(tmp_path / "absent.csv", ["a"])


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Run the commands of `make demo` as the Makefile states them; return their folder and output."""
    folder, output = tmp_path_factory.mktemp("demo"), {}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n\t", "")
    for line in re.findall(r"^\t\$\(BIN\)/spelgen (.*\$\(DEMO\).*|inspect .*)$", makefile, re.MULTILINE):
        command = line.split(" > ")[0].replace("$(DEMO)", str(folder)).replace("robots/", f"{ROOT}/robots/")
        name, *arguments = shlex.split(command)
        output[name] = run(name, *arguments)
    return folder, output


class TestDemo:
    def test_its_commands_come_in_order_and_warn_of_nothing(self, demo):
        _, output = demo
        order = ["inspect", "build", "excite", "simulate", "logs", "train", "evaluate", "report", "export"]
        assert list(output) == order
        assert not [name for name, text in output.items() if "warning" in text]
        assert max(len(line) for line in output["evaluate"].splitlines()) <= 80

    def test_evaluate_states_the_error_of_m(self, demo):
        """The reported error of M equals the error against M of the as-built URDF, which Pinocchio computes."""
        folder, _ = demo
        found = json.loads((folder / "run" / "evaluation.json").read_text())["mass_errors"]
        assert {"model", "URDF", "least squares"} <= found.keys()
        assert found["model"] < found["least squares"] / 2 < found["URDF"]
        truth = spelgen.load_arm(folder / "logs" / "as_built.urdf")
        model = pin.buildModelFromUrdf(str(truth.robot.path))
        model.armature = np.array([truth.settings.joint(name).armature for name in truth.chain.joint_names])
        q = spelgen.read_logs(folder / "logs" / "test.parquet", truth)[0].q
        data = model.createData()
        mass = np.array([pin.crba(model, data, x) for x in q])
        mass = np.triu(mass) + np.triu(mass, 1).swapaxes(1, 2)
        trained = spelgen.load_run(folder / "run").model.mass_matrix(torch.from_numpy(q)).detach()
        np.testing.assert_allclose(true_mass(truth, torch.from_numpy(q)).numpy(), mass, atol=1e-12)
        assert mass_error(trained, torch.from_numpy(mass)) == pytest.approx(found["model"], rel=0.1)

    def test_report_ends_with_a_table_and_the_path(self, demo):
        folder, output = demo
        lines = output["report"].splitlines()
        head, torque, mass = lines[1:4]
        assert head.split() == ["URDF", "least", "squares", "model"]
        assert torque.split()[:4] == ["torque", "that", "is", "unexplained"]
        assert mass.split()[:3] == ["error", "of", "M(q)"]
        for row, words in ((torque, 4), (mass, 3)):
            urdf, least_squares, model = (float(x) for x in row.replace("%", "").split()[words:])
            assert 5 * model < least_squares < urdf
        assert lines[-1].startswith(f"wrote {folder / 'run' / 'report.html'}")
        assert max(map(len, lines[:-1])) <= 80

    def test_files_are_replaced_only_with_force(self, demo, robots):
        folder, _ = demo
        arguments = ["simulate", str(robots / "rpr.urdf"), "--as-built", "1", "-o", str(folder / "logs")]
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 1 and "exists already" in done.output


def run(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.output
