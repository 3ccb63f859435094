"""Fits to arms under position servos recover parameters relative to kp; predictions from commands track the logs."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import torch
from emitted import import_source
from servo_arm import (
    COM,
    GRAVITY,
    INERTIA,
    LENGTH,
    MASS,
    STRIBECK_VELOCITY,
    Servos,
    servo_logs,
    write_servo_arm,
)
from typer.testing import CliRunner

import spelgen
from spelgen.cli.main import app
from spelgen.dynamics.servo_rollout import replayed
from spelgen.errors import LogError, OptionError, RunError, SettingsError
from spelgen.evaluation.evaluate import read_test_logs
from spelgen.files import write_json
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.servo import objective
from spelgen.fitting.servo.report import servo_summary
from spelgen.fitting.servo.rollouts import ServoRollouts
from spelgen.fitting.servo.windows import servo_windows
from spelgen.identification.intervals import QUANTILE, jackknife_covariance
from spelgen.labels import DELAYED_COMMAND, LINEAR_SERVOS, MODEL
from spelgen.listing import number
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, delayed_commands
from spelgen.render.report_page import render_report
from spelgen.structure.servo_rank import servo_rank

TRUTH = Servos(stribeck=(0.0, 0.08), dead_zone=(0.006, 0.0))
SLIDER = """<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{2}"/><axis xyz="{3}"/>
<limit lower="-1" upper="1" effort="6" velocity="5"/></joint>"""
LINK = """<link name="{0}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial></link>"""
SLIDERS = f"""<robot name="sliders"><link name="base"/>{LINK.format("a")}{LINK.format("b")}
{SLIDER.format("x", "base", "a", "1 0 0")}{SLIDER.format("y", "a", "b", "0 1 0")}</robot>"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return spelgen.load_arm(write_servo_arm(tmp_path_factory.mktemp("servo")))


@pytest.fixture(scope="module")
def logs():
    return servo_logs(6, 11.0, TRUTH)


@pytest.fixture(scope="module")
def fitted(arm, logs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    return spelgen.fit(spelgen.build(arm, "closed-form"), logs[:5], arm=arm, folder=folder)


@pytest.fixture(scope="module")
def results(fitted, logs):
    """Return the evaluation of the fitted model on the last log, which was not used for the fit."""
    return spelgen.evaluate(fitted, logs[5:])


def test_test_logs_of_a_servo_run_are_read_with_a_file_of_names_only(fitted, arm, logs, tmp_path):
    text = Path(spelgen.write_logs(tmp_path / "log.csv", logs[5:], arm)).read_text()
    (tmp_path / "other.csv").write_text(text.replace("elbow", "e"))
    (tmp_path / "map.yaml").write_text("joints: {elbow: {name: e}}\n")
    (read,) = read_test_logs(fitted.folder, [tmp_path / "other.csv"], tmp_path / "map.yaml")
    np.testing.assert_allclose(read.u, logs[5].u, atol=1e-9)


def test_ratios_to_kp_are_found(fitted):
    model, kp = fitted.model, np.array(TRUTH.kp)
    with torch.no_grad():
        fitted_kp = model.servo.kp()
        found = {
            name: (x / fitted_kp).numpy()
            for name, x in (("kd", model.servo.kd()), ("coulomb", model.coulomb))
        }
        pointing = torch.tensor([[0.0, np.pi / 2]]).double()
        weight = (model.gravity(pointing) / fitted_kp).numpy()[0, 1]
        inertia = (model.mass_matrix(pointing)[0].diagonal() / fitted_kp).numpy()
    assert found["kd"] == pytest.approx(np.array(TRUTH.kd) / kp, rel=0.05)
    assert abs(weight) == pytest.approx(GRAVITY * MASS[1] * COM[1] / kp[1], rel=0.03)
    assert inertia[1] == pytest.approx((6e-4 + MASS[1] * COM[1] ** 2 + TRUTH.armature[1]) / kp[1], rel=0.08)
    assert float(model.servo.delay) == pytest.approx(TRUTH.delay, abs=0.004)


def test_replay_of_another_motion_beats_the_baselines(fitted, logs, results):
    for replay in results.replays:
        errors = {name: each.mean for name, each in replay.errors.items()}
        assert errors["model"] < 0.4 * min(errors[LINEAR_SERVOS], errors[DELAYED_COMMAND])
    assert results.replays[0].errors["model"].mean < 3e-3
    assert "Commands replayed, whole log" in results.text()
    again = spelgen.evaluate(fitted.folder, logs[5:])
    assert again.to_dict() == results.to_dict()


def test_a_standalone_module_of_servos(arm, tmp_path):
    source = spelgen.generate(arm, "closed-form", standalone=True)
    assert "stores the energy 1/2 kp d(q - u)^2" in source
    model = import_source(source, tmp_path / "servo.py").Model()
    q, u = torch.tensor([[0.1, -0.2]]).double(), torch.tensor([[0.3, -0.2]]).double()
    with torch.no_grad():
        assert model.servo(u, q, torch.zeros_like(q)).tolist() == [[pytest.approx(0.2 * 12.0), 0.0]]
        assert float(model.servo.stored_energy(u, q)) == pytest.approx(0.5 * 12.0 * 0.04)
        far = model.servo(u + 9, q, torch.zeros_like(q))
    assert far.tolist() == [[6.0, 6.0]]  # far from the command, the torque is the effort limit of the URDF
    assert "in ratio to kp only" in " ".join(spelgen.inspect(arm).text().split())


def test_within_its_dead_zone_a_servo_has_no_torque(arm):
    servo = spelgen.build(arm, "closed-form").servo
    servo.dead_zone[:] = torch.tensor([0.02, 0.0])
    u, still = torch.tensor([[0.015, 0.1], [0.05, 0.1]]).double(), torch.zeros(2, 2).double()
    torque = servo(u, still, still).detach()
    assert torque[:, 0].tolist() == [0.0, pytest.approx(0.03 * 12.0)]
    assert float(servo.stored_energy(u, still)[1].detach()) == pytest.approx(0.5 * 12 * (0.03**2 + 0.1**2))


def test_joints_get_the_laws_that_they_have(fitted):
    shoulder, elbow = fitted.record.servo["joints"]
    assert shoulder["dead_zone"]["value"] == pytest.approx(TRUTH.dead_zone[0], rel=0.03)
    assert "dead_zone" not in elbow and not fitted.model.servo.dead_zone[1]
    with torch.no_grad():
        laws = fitted.model.friction.prepare()
    assert laws.stribeck[0] < 0.15 * TRUTH.coulomb[0]
    assert float(laws.stribeck[1]) == pytest.approx(TRUTH.stribeck[1], rel=0.3)
    # Friction is divided by kp, since the logs determine only this ratio. It is compared at four velocities and not by
    # its parameters, as model and simulator have different Stribeck formulas.
    speeds = torch.tensor([0.05, 0.1, 0.2, 0.4]).double()
    with torch.no_grad():
        dry = laws.dry(speeds[:, None].expand(-1, 2), torch.zeros(4, 2).double())
    falling = TRUTH.coulomb[1] + TRUTH.stribeck[1] * torch.exp(-((speeds / STRIBECK_VELOCITY) ** 2))
    torch.testing.assert_close(
        dry[:, 1] / fitted.model.servo.kp()[1].detach(), falling / TRUTH.kp[1], rtol=0.06, atol=0
    )


def test_intervals_count_correlated_errors_once():
    rng = torch.Generator().manual_seed(0)
    found, told = [], []
    for _ in range(300):
        slopes = torch.ones(20, 50, 1).double() + 0.3 * torch.randn(20, 50, 1, generator=rng).double()
        errors = torch.randn(20, 1, generator=rng).double().expand(20, 50)  # all errors of a window are equal
        curvature, descent = slopes.mT @ slopes, -(slopes.mT @ errors.unsqueeze(-1)).squeeze(-1)
        step = torch.linalg.solve(curvature.sum(dim=0), descent.sum(dim=0))
        left = (slopes.mT @ (errors.unsqueeze(-1) + slopes * step)).squeeze(-1)
        at_end = NormalEquations(curvature, -left)
        told.append(float(jackknife_covariance(*at_end, torch.zeros(1, 1).double())[1]))
        found.append(float(step))
    assert np.mean(told) == pytest.approx(
        np.var(found), rel=0.15
    )  # the jackknife variance `told` would be a fiftieth if the 50 equal errors of a window were independent


def test_blocks_of_intervals_are_whole_motions():
    logs, numbers = servo_logs(5, 16.0), {}
    for count in (1, 3, 4, 5):
        windows = servo_windows(logs[:count], Preprocessing())
        stretches = windows.blocks(4, 6).tolist()
        numbers[count] = len(set(stretches))
        by_log = {(log.name, stretch) for (log, _), stretch in zip(windows.rows, stretches, strict=True)}
        assert len(by_log) == numbers[count]  # no block contains parts of two logs
    # with three logs, each is cut in two, as three blocks are too few for a variance
    assert numbers == {1: 5, 3: 6, 4: 4, 5: 5}


def test_a_known_kp_stays(tmp_path, logs, monkeypatch):
    monkeypatch.setattr(objective, "TUNING", replace(objective.TUNING, steps=1))
    monkeypatch.setattr(objective, "OUTER_ITERATIONS", 1)
    settings = "input: position\njoints: {shoulder: {kp: 14.0}}\n"
    model = spelgen.build(write_servo_arm(tmp_path, settings), "closed-form")
    fit = spelgen.fit(model, [x[:100] for x in logs[:2]])
    assert float(model.servo.kp()[0].detach()) == pytest.approx(14.0)
    assert [x["kp"]["known"] for x in fit.record.servo["joints"]] == [True, False]


def test_commands_are_constant_between_samples_and_delayed():
    t = np.arange(5) * 0.02
    u = np.array([[0.0], [1.0], [2.0], [3.0], [4.0]])
    log = Trajectory(t, u, u, np.zeros((5, 0)), u=u)
    assert delayed_commands(log, slice(0, 5), 0.0, 2)[..., 0].tolist() == [
        [pytest.approx(x), pytest.approx(x)] for x in (0.0, 1.0, 2.0, 3.0)
    ]
    late = delayed_commands(log, slice(1, 4), 0.025, 2)[..., 0]
    assert late == pytest.approx(np.array([[0.0, 0.0], [0.5, 1.0]]), abs=1e-9)


def test_its_report_shows_servos_and_replays_and_no_torques(fitted, results):
    write_json(RunFolder(fitted.folder).evaluation, results.to_dict())
    page = render_report(fitted.folder)
    told = " ".join(page.split())
    assert "Typical log replayed: motion 5" in page and told.count('class="line hold"') >= 2
    kd = f"{number(TRUTH.kd[0] / TRUTH.kp[0])[:4]}"
    assert (
        '<h2 id="servos">Servos</h2>' in page
        and re.search(f"<td[^>]*>{kd}", page)
        and "dry/kp of elbow" in told
        and f"ratios to kp of {fitted.posterior.scale_joint}" in told
        and f"{fitted.posterior.drives['kp'][0].text} Nm/rad" in told
    )
    assert "<td>command [rad]</td>" in page
    for empty in ("to draw", "metrics.jsonl", 'id="torques"', "trained parameters"):
        assert empty not in page, empty


def test_commands_are_read_and_written(tmp_path, logs, arm):
    for suffix in (".csv", ".parquet"):
        path = spelgen.write_logs(tmp_path / f"logs{suffix}", logs[:2], arm)
        again = spelgen.read_logs(path, arm)
        assert [np.array_equal(x.u, y.u) for x, y in zip(again, logs, strict=False)] == [True, True]
        assert again[0].tau.shape == (len(logs[0]), 0)


def test_reported_intervals_cover_the_truth(fitted):
    told = fitted.record.servo["joints"]
    for k, joint in enumerate(told):
        for what, truth in (
            ("kd", TRUTH.kd[k] / TRUTH.kp[k]),
            ("lag", TRUTH.kd[k] / TRUTH.kp[k] + TRUTH.delay),
            ("armature", TRUTH.armature[k] / TRUTH.kp[k]),
            ("static_error", TRUTH.coulomb[k] / TRUTH.kp[k] + TRUTH.dead_zone[k]),
        ):
            assert joint[what]["determined"]
            # tolerance for the different Stribeck curves: only the simulator's falls as a Gaussian
            assert joint[what]["value"] == pytest.approx(truth, rel=0.03 if k == 0 else 0.04), what
            assert joint[what]["low"] < truth < joint[what]["high"], what
    # The dry friction of the shoulder (joint 0) is determined. The elbow carries a small gravity load, under which dry
    # friction and a dead zone cause the same position errors: only their sum, static_error, is determined there. The
    # summary names dry/kp of the elbow as not determined.
    assert told[0]["dry"]["determined"] and "dry/kp of elbow" in servo_summary(fitted.record.servo).text


def test_every_ratio_that_is_open_is_named():
    """`servo_summary` lists each quantity that the logs do not determine, such as a ratio to kp or a dead zone.

    Here it lists the half dead zone of the elbow, although the elbow's dry friction is determined.
    """
    sure = {"value": 0.1, "low": 0.09, "high": 0.11, "determined": True}
    joint = {"joint": "elbow", "kp": {"value": 20.0}, "dry": sure, "dead_zone": sure | {"determined": False}}
    text = servo_summary({"joints": [joint], "delay": {"value": 0.01, "half": 0.001}, "rms": [0.002]}).text
    assert "Not determined by these logs: half dead zone of elbow" in " ".join(text.split())


def servo_truth(servos, q):
    """Return the true gravity torque / kp at q (T, 2), and the elbow's true inertia / kp, of simulated servos."""
    first, second = (np.sin(q[:, 0]), np.sin(q[:, 0] + q[:, 1]))
    weight = GRAVITY * np.array([MASS[0] * COM[0] + MASS[1] * LENGTH, MASS[1] * COM[1]])
    gravity = np.stack([weight[0] * first + weight[1] * second, weight[1] * second], axis=1)
    kp, own = np.array(servos.kp), INERTIA + MASS * COM**2
    inertia = own[1] + np.array(servos.armature)[1]
    return np.concatenate([(gravity / kp).ravel(), [inertia / kp[1]]])


def servo_values(q):
    """Return a function of a model: gravity / kp at q (T, 2), and the elbow's inertia / kp."""

    def values(model):
        kp, position = model.servo.kp(), torch.from_numpy(q)
        mass = model.mass_matrix(position)[0, 1, 1]
        return torch.cat([(model.gravity(position) / kp).flatten(), mass[None] / kp[1]])

    return values


def test_the_posterior_of_a_servo_fit_contains_the_truth(fitted, arm):
    """At least 90 % of the 95 % intervals of servo fits contain the true values, also with wrong masses in the model.

    Two fits are tested. The first (`fitted`) starts from the true masses. The second starts from masses that are 20 %
    too large, and its logs are simulated with other servos.
    """
    other = Servos((10.0, 6.0), (0.5, 0.6), (0.02, 0.02), (0.08, 0.1), delay=0.015)
    heavy = spelgen.build(arm, "closed-form")
    with torch.no_grad():
        heavy.bodies.raw[:, -1] += np.log(1.2)
    held, q = [], np.random.default_rng(0).uniform(-1.5, 1.5, (4, 2))
    # Ten logs of 2 s instead of one of 20 s give short windows, since a window ends with its log. All windows are
    # simulated in one batch, so the time of a fit depends on the length of the windows, not on their number.
    second = spelgen.fit(heavy, servo_logs(10, 2.0, other, seed=4))
    for fit, servos in ((fitted, TRUTH), (second, other)):
        posterior, kp = fit.posterior, np.array(servos.kp)
        truths = {
            "kp": kp,
            "kd/kp": np.array(servos.kd) / kp,
            "lag": np.array(servos.kd) / kp + servos.delay,
            "armature/kp": np.array(servos.armature) / kp,
        }
        for name, truth in truths.items():
            stated = posterior.drives[name]
            held += [x.low <= y <= x.high for x, y in zip(stated, truth, strict=True)]
            assert all(x.determined == ("weak" if name == "kp" else "firm") for x in stated), name
        value, std = posterior.uncertain(servo_values(q))
        error = np.abs(value - servo_truth(servos, q))
        held += (error <= QUANTILE * std).tolist()
        assert np.median(std / np.abs(value)) < 0.05  # ratios of gravity and inertia to kp are determined
    assert len(held) == 34 and np.mean(held) >= 0.9, np.mean(held)


def test_the_posterior_of_a_servo_fit_names_what_is_open(fitted):
    posterior = fitted.posterior
    assert {"a common factor of kp and all masses", "coulomb/kp and dead zone of elbow"} <= {
        *posterior.unidentifiable
    }
    assert not any(x.startswith("kd/kp and delay") for x in posterior.unidentifiable)
    assert all(x.name.endswith("/kp") for x in posterior.base_parameters)
    assert next(x for x in posterior.base_parameters if x.name == "hx2/kp").determined == "firm"
    delay = fitted.record.servo["delay"]
    assert posterior.delay.value == delay["value"] and posterior.delay.half == pytest.approx(delay["half"])
    for k, joint in enumerate(fitted.record.servo["joints"]):
        for ratio, name in (("kd", "kd/kp"), ("lag", "lag"), ("armature", "armature/kp")):
            stated = posterior.drives[name][k]
            value, high = joint[ratio]["value"], joint[ratio]["high"]
            assert stated.value == pytest.approx(value)
            # The upper ends of the intervals in the posterior and in the record (config.json) differ: the interval in
            # the record is symmetric in the logarithm of the value. Both include a model error of 3 %. For the lag,
            # kd/kp + delay, this is 3 % of the lag in the record, and 3 % of kd/kp in the posterior.
            assert 0.5 < (stated.high - value) / (high - value) < 1.05
    with pytest.raises(RunError, match="got intervals of torques, expected a fit to logs with torques"):
        posterior.torque(*np.zeros((3, 1, 2)))
    again = spelgen.load_run(fitted.folder).posterior
    for one, other in zip(again.base_parameters, posterior.base_parameters, strict=True):
        assert one.name == other.name and one.high == pytest.approx(other.high, rel=1e-6, abs=1e-12)
    text = "".join(table.text() for table in posterior.listings)
    assert f"ratios to kp of {posterior.scale_joint}" in " ".join(text.split())
    assert "Delay of the commands" in text


@pytest.mark.parametrize(
    ("robot", "groups", "left"),
    [
        ("two_link", ((0, 1),), {("armature", 0)}),
        (
            "ur10e",
            (tuple(range(6)),),
            {("armature", 0), ("armature", 1)},
        ),  # as for motors in Khalil and Dombre, ch. 12: armature/kp of joints 0 and 1 is not identifiable
        ("sliders", ((0,), (1,)), {("armature", 0), ("armature", 1)}),
    ],
)
def test_identifiable_ratios_of_servo_logs(robots, tmp_path, robot, groups, left):
    path = tmp_path / "sliders.urdf" if robot == "sliders" else robots / f"{robot}.urdf"
    if robot == "sliders":  # the arm has two prismatic joints at right angles, whose motions do not interact
        path.write_text(SLIDERS)
    found = servo_rank(spelgen.load_arm(path).chain)
    assert found.groups == groups and {*found.open} == left


def test_simulated_commands_and_positions(tmp_path):
    arm = spelgen.load_arm(write_servo_arm(tmp_path, "input: position\nsimulation: {delay: 0.04}\n"))
    logs = spelgen.simulate(arm, trajectories=2, duration=4.0)
    assert len(logs.train) == 1 and logs[0].u.shape == (201, 2)
    again = spelgen.simulate(arm, trajectories=2, duration=4.0)
    assert np.array_equal(logs[0].q, again[0].q)
    late = np.abs(logs[0].q[3:] - logs[0].u[:-3]).mean()
    assert late < np.abs(logs[0].q - logs[0].u).mean() < 0.1


def test_exports_contain_the_servos(fitted, arm, tmp_path, monkeypatch):
    kp, kd = (x.detach().numpy() for x in fitted.model.servo.prepare()[:2])
    xml = spelgen.export(fitted, to="mjcf").files[".xml"].decode()
    found = re.findall(r'<position name="\w+" joint="\w+" kp="([^"]+)" kv="([^"]+)" forcerange="-6 6"', xml)
    assert np.array(found, dtype=float) == pytest.approx(np.stack([kp, kd], axis=1))
    monkeypatch.setattr(fitted.model.servo, "dead_zone", torch.tensor([0.01, 0.0]).double())
    assert "dead zones are left out" in spelgen.export(fitted, to="mjcf").files[".xml.README.md"].decode()
    files = spelgen.export(
        fitted, to="c"
    ).files  # the export compares the C with the model, if there is a compiler
    assert b"servo_arm_servo_torque(\n    const servo_arm_real u[SERVO_ARM_N]" in files["servo_arm.h"]


def dataset(folder, logs, motors):
    """Write a LeRobot 3 data set with an episode per log, in degrees."""
    (folder / "meta").mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [len(motors)], "names": motors}
    features = {"action": feature, "observation.state": feature}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    columns = {
        "observation.state": np.degrees(np.concatenate([x.q[:, ::-1] for x in logs])).tolist(),
        "action": np.degrees(np.concatenate([x.u[:, ::-1] for x in logs])).tolist(),
        "timestamp": np.concatenate([x.t for x in logs]),
        "episode_index": np.repeat(range(len(logs)), [len(x) for x in logs]),
    }
    pa.parquet.write_table(pa.table(columns), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


def test_a_data_set_of_lerobot_is_read_by_its_own_names(tmp_path, logs):
    arm = spelgen.load_arm(write_servo_arm(tmp_path, "input: position\nlogs: {units: {q: deg}}\n"))
    path = dataset(tmp_path / "set", logs[:2], ["elbow.pos", "shoulder.pos"])
    found = spelgen.read_logs(path, arm)
    assert [x.name for x in found] == ["0", "1"]
    for each, log in zip(found, logs, strict=False):
        assert each.q == pytest.approx(log.q) and each.u == pytest.approx(log.u)
    with pytest.raises(
        LogError, match=r"got the motors a, shoulder, expected elbow among them.*elbow: {name"
    ):
        spelgen.read_logs(dataset(tmp_path / "other", logs[:1], ["a", "shoulder.pos"]), arm)


@pytest.mark.parametrize("quantity", ["u", "q"])
def test_a_missing_column_is_named(tmp_path, logs, arm, quantity):
    path = spelgen.write_logs(tmp_path / "logs.csv", logs[:1], arm)
    path.write_text(path.read_text().replace(f"{quantity}_elbow", "nothing"))
    with pytest.raises(LogError, match=f"missing column {quantity}_elbow"):
        spelgen.read_logs(path, arm)


def test_incompatible_models_and_logs_are_reported(arm, logs, robots):
    with pytest.raises(SettingsError, match="preset with bristle friction"):
        spelgen.build(arm, "spel")
    with pytest.raises(OptionError, match="input: torque' in their settings, this has 'position'"):
        spelgen.fit(spelgen.build(arm, "closed-form"), logs, spelgen.TorqueFit())
    with pytest.raises(LogError, match="commanded positions and no torques"):
        spelgen.identify(arm, logs)
    t = np.arange(9) * 0.1
    nothing = Trajectory(t, np.zeros((9, 2)), np.zeros((9, 2)), np.zeros((9, 2)))
    with pytest.raises(LogError, match="no commanded positions"):
        spelgen.fit(spelgen.build(arm, "closed-form"), nothing)


def moved(model, seconds, count=1):
    """Simulate `count` logs of a model, in which the commands of both joints jump every 0.5 s at the same time.

    seconds: duration of a log [s]. The integration step is 2.5 ms; the logs have one sample per 20 ms.
    """
    with torch.no_grad():
        model.raw_armature.copy_((torch.tensor(TRUTH.armature) / model.armature).log())
        model.servo.delay.fill_(TRUTH.delay)
    t, every = np.arange(0.0, seconds, 0.0025), 8  # logs contain one of `every` integration steps
    u = np.random.default_rng(0).uniform(-0.4, 0.4, (count, int(2 * seconds), 2)).repeat(200, axis=1)
    nothing = np.zeros((len(t), 0))
    logs = [Trajectory(t, x, np.zeros_like(x), nothing, u=x) for x in u]
    commands = np.stack([delayed_commands(x, slice(None), TRUTH.delay, 2) for x in logs])
    start, dt = torch.from_numpy(u[:, 0]), torch.full((count, len(t) - 1), 0.0025).double()
    q = replayed(model, start, torch.zeros_like(start), torch.from_numpy(commands), dt).numpy()
    return [replace(x, q=np.concatenate([x.u[:1], y]))[::every] for x, y in zip(logs, q, strict=True)]


def test_presets_are_not_compared_under_servos(tmp_path):
    result = CliRunner().invoke(app, ["compare", str(write_servo_arm(tmp_path)), "-o", str(tmp_path / "out")])
    assert result.exit_code == 1 and not (tmp_path / "out").exists()
    assert "servo_arm.yaml: input: got position servos, expected torques" in " ".join(result.stderr.split())


def test_the_motion_of_single_joints_equals_the_motion_of_the_arm(arm):
    model = spelgen.build(arm, "closed-form")
    windows = replace(servo_windows(moved(model, 3.0), Preprocessing()), steps=24)
    rollouts = ServoRollouts.of(model, windows)
    x = rollouts.parameters.prior_mean
    # all friction effects are active, as in the simulated logs
    x = replace(x, active=torch.ones_like(x.active))
    for _ in range(2):
        rollouts = rollouts.linearized(x, rollouts.predicted_motion(x))
    errors = rollouts.residual(x).square().mean(dim=(0, 1)).sqrt()
    assert errors.max() < 6e-4


@pytest.mark.parametrize("effort", [1000, 0.2])
def test_a_placeholder_for_the_effort_limit_does_not_change_the_fit(tmp_path, logs, effort):
    path = write_servo_arm(tmp_path)
    path.write_text(path.read_text().replace('effort="6"', f'effort="{effort}"'))
    fit = spelgen.fit(spelgen.build(path, "closed-form"), logs[:2])
    (replay, *_) = spelgen.evaluate(fit, logs[5:], arm=path).replays
    assert max(replay.errors[MODEL].joints) < 4e-3
    warned = [x.code for x in fit.diagnostics if x.severity == "warning"]
    assert warned == (["beyond-effort-limit"] if effort < 1 else [])


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_joint_at_rest_gets_the_servo_of_the_other_joints(arm, logs):
    log = servo_logs(1, 20.0, held=0.4)[0]
    fit = spelgen.fit(spelgen.build(arm, "closed-form"), [log])
    model = fit.model
    for values in (model.friction.prepare().coulomb, model.servo.kd(), model.armature):
        ratios = (values / model.servo.kp()).tolist()
        assert 0.5 < ratios[1] / ratios[0] < 2
    lag = fit.posterior.uncertain(lambda model: model.servo.kd() / model.servo.kp())
    assert lag.std[0] < 0.1 * lag.value[0] and lag.std[1] > lag.value[1]
