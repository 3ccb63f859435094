"""`spelgen compare`: all presets have the same data, losses are as in Wang et al. (2025), killed runs are resumed."""

import json
import math
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
import yaml
from html_page import Page
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.comparison import jobs
from spelgen.comparison.arms import ComparedArm, Comparison, arm_inputs, load_comparison
from spelgen.comparison.figures import spread_windows
from spelgen.comparison.study import prepare_study, run_study
from spelgen.comparison.tables import arm_results, arm_sections, comparison_sentence
from spelgen.errors import RunError, SettingsError, SpelgenError
from spelgen.evaluation.rollout import mass_error, true_mass
from spelgen.fitting.fitted import load_run
from spelgen.fitting.rollout import roll_out
from spelgen.listing import duration
from spelgen.logs.read import Trajectory, read_logs, write_logs
from spelgen.logs.windows import cut_windows, joined
from spelgen.render.comparison_page import write_comparison
from spelgen.simulation.simulate import simulate
from spelgen.urdf.read import read_urdf

PRESETS = ("phnode", "hybrid")
JOINTS = ("joint1", "joint2")
QUICK = {"presets": ["spel"], "width": 4, "depth": 1, "training": {"epochs": 2, "momentum_steps": 0}}


def silent(text):
    """Print nothing: the output of comparisons is not tested."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory, robots):
    """Write the URDF of two_link with settings for 8 trajectories and 25 training steps; return its path."""
    folder = tmp_path_factory.mktemp("robot")
    urdf = folder / "two_link.urdf"
    urdf.write_bytes((robots / "two_link.urdf").read_bytes())
    settings = yaml.safe_load((robots / "two_link.yaml").read_text())
    settings["simulation"]["trajectories"] = 8
    settings["comparison"] |= {"first": 0.25, "steps": 20, "momentum_steps": 5, "seeds": 1, "width": 8}
    # these settings apply if logs are recorded; fits to simulated logs use the section `comparison`
    settings["training"] |= {"epochs": 2, "momentum_steps": 0}
    urdf.with_suffix(".yaml").write_text(yaml.safe_dump(settings))
    return urdf


def simulated(robot, **changes):
    """Return a comparison of PRESETS on one robot with simulated logs; changes: other fields of `Comparison`."""
    return Comparison(arms={"arm": ComparedArm(urdf=robot)}, **{"presets": PRESETS, **changes})


@pytest.fixture(scope="module")
def notes():
    return []


@pytest.fixture(scope="module")
def study(robot, notes, tmp_path_factory):
    prepared = prepare_study(simulated(robot), tmp_path_factory.mktemp("study"))
    notes.append(prepared.announcement(1))
    return run_study(prepared, notes.append)


@pytest.fixture
def results(study):
    return {result.preset: result for result in study.results.values()}


def losses_of(result):
    """Return {name: value} of the losses in the result of one run, such as "prediction loss, 1 s".

    The run is of a simulated arm: there are errors of the model, but of no other predictor.
    """
    assert all(set(errors) == {"model"} for errors in result.errors.values())
    return {label: errors["model"] for label, errors in result.errors.items()}


def cells(tables):
    """Return {label of a row: {column: text}} of tables; the stars that mark cells are removed."""
    rows = {}
    for table in tables:
        names = [name.strip() for name in table.head[1:]]
        for label, *texts in table.rows:
            rows[label] = dict(zip(names, (text.rstrip(" *") for text in texts), strict=True))
    return rows


def trained(job):
    """Return the model of a job with its trained parameters."""
    model = job.build()
    model.load_state_dict(torch.load(job.folder / "model.pt"))
    return model


def test_models_of_simulated_arms_know_only_the_kinematics(study):
    for job in study.jobs:
        known = read_urdf(job.inputs.urdf)
        assert set(JOINTS) <= {joint.name for joint in known.joints}
        assert all(link.inertial is None for link in known.links)
        assert "joints" not in yaml.safe_load(job.inputs.urdf.with_suffix(".yaml").read_text())


def test_training_logs_are_the_first_seconds_of_other_motions_than_the_test_logs(study):
    training, testing = study.jobs[0].inputs.split(0, 1)
    assert {len(x.t) for x in training} == {5}
    assert {len(x.t) for x in testing} == {21}
    assert not {x.name for x in training} & {x.name for x in testing}


def test_the_number_of_runs_and_the_time_are_stated_before_each_run_is_reported(study, notes):
    assert len(notes) == 3
    assert notes[0].startswith("2 runs (1 arm, 2 presets, 1 seed, 1 split); estimated time ")
    assert notes[1].startswith("1/2 arm, phnode, seed 0: prediction loss, 1 s ") and notes[1].endswith(
        " left"
    )
    assert notes[2].startswith("2/2 arm, hybrid, seed 0: ")


def test_an_estimate_uses_the_time_of_finished_runs_of_the_same_preset(study, robot):
    more = prepare_study(simulated(robot, seeds=3), study.folder)
    assert len(more.jobs) == 6 and len(more.results) == 2
    first, later = (next(x for x in more.jobs if (x.preset, x.seed) == ("phnode", seed)) for seed in (0, 2))
    assert more.estimates[later.name] == pytest.approx(more.results[first.name].seconds + 1)
    left = sum(more.estimates[x.name] for x in more.jobs if x.seed)
    assert more.announcement(2).endswith(f", 2 finished before; estimated time {duration(left / 2)}")


def test_figures_of_a_run_agree_with_one_another(results):
    assert set(results) == set(PRESETS)
    for result in results.values():
        losses = losses_of(result)
        assert next(iter(losses)) == "prediction loss, 1 s", "the first loss ranks the models"
        assert losses["prediction loss, 1 s"] == pytest.approx(
            losses["position, 1 s"] + losses["velocity, 1 s"]
        )
    labels = [f"outputs of {matrix}" for matrix in "MDGV"]
    assert [results["hybrid"].sizes[label] for label in labels] == [1, 2, 0, 1]
    # phnode has the numbers of outputs and inputs of its paper
    sizes = results["phnode"].sizes
    assert [sizes[label] for label in labels] == [21, 21, 6, 1]
    assert sizes["inputs of M"] == 4


def test_losses_are_the_mean_squared_errors_of_rollouts_from_the_logs(study, results):
    """Losses are squared errors of rollouts (position + velocity), sums over joints, means over samples and windows."""
    job = next(job for job in study.jobs if job.preset == "hybrid")
    model, losses = trained(job), losses_of(results["hybrid"])
    for key, role, samples in (
        ("training loss", "train", 5), ("test loss", "test", 5), ("prediction loss, 1 s", "test", 21),
    ):  # fmt: skip
        cut = [
            log[start : start + samples]
            for log in read_logs(job.inputs.data, JOINTS, role=role)
            for start in range(len(log.t) - samples + 1)
        ]
        windows = joined([cut_windows([each], samples, measured=False) for each in cut])
        substeps = load_run(job.folder).checkpoint.substeps
        with torch.no_grad():
            predicted = [x.numpy() for x in roll_out(model, windows, substeps)]
        q, qd = (np.stack([getattr(each, name)[1:] for each in cut]) for name in ("q", "qd"))
        difference = (predicted[0] - q + np.pi) % (2 * np.pi) - np.pi
        position, velocity = (x.sum(axis=-1).mean() for x in (difference**2, (predicted[1] - qd) ** 2))
        assert losses[key] == pytest.approx(position + velocity, rel=1e-9), key
    assert losses["position, 1 s"] == pytest.approx(position, rel=1e-9)
    assert losses["velocity, 1 s"] == pytest.approx(velocity, rel=1e-9)
    assert losses["training loss"] != losses["test loss"]


def test_only_the_run_without_a_result_is_run_again_and_gives_the_same_figures(study, robot):
    lost, kept = (job.folder / "result.json" for job in study.jobs)
    before = lost.read_text(), kept.stat().st_mtime_ns
    lost.unlink()
    again = prepare_study(simulated(robot), study.folder)
    assert list(again.results) == [study.jobs[1].name]
    run_study(again, silent)
    assert kept.stat().st_mtime_ns == before[1]
    first, second = (json.loads(x) for x in (before[0], lost.read_text()))
    for result in (first, second):
        del result["sizes"]["training step [ms]"]
    assert (first["errors"], first["sizes"]) == (second["errors"], second["sizes"])


def test_runs_with_other_steps_are_other_runs(study, robot):
    assert not prepare_study(simulated(robot, steps=40), study.folder).results


def test_each_run_has_its_own_seed(robot, monkeypatch, tmp_path):
    seeds = []

    def fit(model, logs, config=None, **options):
        seeds.append(options["seed"])
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs, "fit", fit)
    prepared = prepare_study(simulated(robot, seeds=3, presets=("hybrid",)), tmp_path)
    for job in prepared.jobs:
        with pytest.raises(KeyboardInterrupt):
            jobs.run_job(job)
    assert seeds == [0, 1, 2]
    first, other, same = (prepared.jobs[k].build().state_dict() for k in (0, 1, 0))
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_tables_have_published_figures(study, results):
    (section,) = arm_sections(study)
    rows = {label: list(row.values()) for label, row in cells(section.tables).items()}
    assert rows["outputs of M"] == ["21", "1"]
    assert rows["parameters"] == [f"{result.sizes['parameters']:,}" for result in results.values()]
    assert rows["published: prediction loss"] == ["0.194", ""]
    lines = [line for table in section.tables for line in table.text().splitlines()]
    assert all(line == line.rstrip() and len(line) <= 80 for line in lines)


def test_the_sentence_has_the_best_model_and_the_ratios_of_the_others(study, results):
    base, ours = (losses_of(result)["prediction loss, 1 s"] for result in results.values())
    ratio = f"{base / ours:.3g} times smaller than with phnode" if ours < base else "than with hybrid"
    (section,) = arm_sections(study)
    assert section.sentence.startswith(
        "hybrid has the smallest prediction loss, 1 s: " if ours < base else "phnode"
    )
    assert ratio in section.sentence
    assert comparison_sentence([section]) == section.sentence
    assert comparison_sentence([section, section]).endswith(" on 2 arms.")
    better = {"prediction loss, 1 s": {"model": 0.2, "URDF": 0.1}}
    known = [replace(result, errors=better) for result in results.values()]
    assert arm_results("arm", known, {}).sentence == (
        "phnode and hybrid have the smallest prediction loss, 1 s: 0.2; "
        "but these baselines have a smaller one: URDF (0.1)."
    )


def test_the_true_mass_matrix_is_pinocchios_with_the_rotors(robots):
    """M of the simulated arm equals Pinocchio's M of the URDF plus, per joint, rotor inertia times gear squared."""
    urdf = robots / "ur10e.urdf"
    model = pin.buildModelFromUrdf(str(urdf))
    q = torch.from_numpy(np.random.default_rng(0).uniform(-3, 3, (5, 6)))
    rotors = [1.0e-4, 1.0e-4, 6.0e-5, 2.0e-5, 2.0e-5, 2.0e-5]
    for at, found in zip(q.numpy(), true_mass(urdf, q).numpy(), strict=True):
        upper = np.triu(pin.crba(model, model.createData(), at))
        expected = upper + np.triu(upper, 1).T + np.diag(rotors) * 101**2
        np.testing.assert_allclose(found, expected, atol=1e-10)


def test_the_error_of_m_has_no_units():
    """An error of 10 % in all entries of M gives the same figure in any units of the joints."""
    scale = torch.diag(torch.tensor([1.0, 100.0, 0.01], dtype=torch.float64))
    true = (scale @ (torch.eye(3, dtype=torch.float64) + 0.2) @ scale).expand(4, 3, 3)
    assert mass_error(1.1 * true, true) == pytest.approx(0.1 / math.sqrt(3))
    assert mass_error(true, true) == 0.0


def test_the_page_opens_with_the_sentence_and_the_table(study):
    (section,) = arm_sections(study)
    text = " ".join(Page(write_comparison(study, [section]).read_text()).text)
    start = text[text.index("presets compared", text.index("Skip to the content")) :]
    sentence = start.index(section.sentence.split(":")[0])
    assert sentence < start.index("published: prediction loss") < start.index("outputs of M")
    assert "64 + " not in text and "5 + 20 steps" in " ".join(text.split())


def test_a_run_that_is_not_finite_counts_as_infinitely_bad(results):
    result = results["hybrid"]
    broken = replace(result, seed=1, errors={label: {"model": None} for label in result.errors})
    section = arm_results("arm", [result, broken, broken], {})
    assert cells(section.tables)["prediction loss, 1 s"]["hybrid"] == "-"
    assert section.sentence == "No model has a finite prediction loss, 1 s."


def test_decimated_windows_start_at_a_multiple_of_the_decimation():
    """Windows with decimation 4 start at a multiple of 4 samples.

    If a controller changes its torque every 4 samples, each torque of a decimated window is the input of its interval.
    """
    count = 200
    # positions are the numbers of the samples
    q = torch.arange(count, dtype=torch.float64).unsqueeze(-1).numpy()
    log = Trajectory(0.002 * q[:, 0], q, q, np.floor(q / 4), "a")
    windows = spread_windows([log], 5, 4)
    assert not (windows.q % 4).any()
    assert torch.equal(windows.tau, windows.q[:, :-1] / 4)


@pytest.fixture(scope="module")
def logs(robots, tmp_path_factory):
    """Write logs of two_link, four trajectories for training and four for testing; return their folder."""
    folder = tmp_path_factory.mktemp("two_link")
    arm = load_arm(robots / "two_link.urdf")
    found = simulate(arm, trajectories=8)
    write_logs(folder / "train.parquet", found.train, JOINTS)
    write_logs(folder / "test.parquet", found.test, JOINTS)
    return folder


@pytest.fixture
def listed_arms(robots, logs, tmp_path, short_epochs):
    """Return a function that writes arms.yaml with arms that all have these logs, and loads it."""

    def loaded(arms="ab", **changes):
        arm = {"urdf": str(robots / "two_link.urdf"), "data": [str(logs)]}
        path = tmp_path / "arms.yaml"
        path.write_text(json.dumps({"arms": dict.fromkeys(arms, arm), **QUICK, **changes}))
        return load_comparison(path)

    return loaded


def compared(comparison, folder, jobs=1):
    return run_study(prepare_study(comparison, folder), silent, jobs)


def kill_two(folder: Path, killed: list[int]) -> None:
    """Kill the worker that trains arm a and terminate the worker of arm b, each after its first checkpoint.

    killed: receives the process ids.
    """
    waiting = {"a": signal.SIGKILL, "b": signal.SIGTERM}
    # wait up to some minutes, as workers start slowly on a loaded machine
    for _ in range(30_000):
        for lock in folder.glob("runs/*/*/.lock"):
            try:
                text, arm = lock.read_text(), lock.parts[-3]
            except FileNotFoundError:
                # the run ended, and its lock file disappeared, after the files were listed
                continue
            if arm in waiting and text.startswith("process") and (lock.parent / "config.json").exists():
                killed.append(int(text.split()[1]))
                os.kill(killed[-1], waiting.pop(arm))
        if not waiting:
            return
        time.sleep(0.01)


def test_runs_of_killed_workers_are_resumed_and_end_with_the_same_weights(listed_arms, tmp_path):
    pytest.importorskip("ray")
    folder, killed = tmp_path / "out", []
    comparison = listed_arms(training={"epochs": 5, "momentum_steps": 0})
    killer = threading.Thread(target=kill_two, args=(folder, killed))
    killer.start()
    study = compared(comparison, folder, jobs=2)
    killer.join()
    assert len(set(killed)) == 2
    assert sorted(result.arm for result in study.results.values()) == ["a", "b"]
    assert not study.failures
    assert len(list(folder.glob("runs/*/*/result.json"))) == 2
    # a second comparison, whose workers are killed at different times, gives equal weights
    a, b = (torch.load(next((folder / "runs" / x).glob("*/model.pt"))) for x in "ab")
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_finished_runs_are_kept_and_changed_runs_are_run_again(listed_arms, tmp_path):
    folder = tmp_path / "out"
    first = compared(listed_arms("a"), folder)
    files = {x: x.stat().st_mtime_ns for x in folder.glob("runs/*/*/result.json")}
    again = compared(listed_arms("a"), folder)
    assert again.results == first.results
    stored = json.loads((folder / "comparison.json").read_text())["results"]
    assert [x["parameters"] for x in stored] == [x.parameters for x in first.results.values()]
    assert files == {x: x.stat().st_mtime_ns for x in folder.glob("runs/*/*/result.json")}
    more = compared(listed_arms("a", seeds=2), folder)
    assert [x.seed for x in more.results.values()] == [0, 1]
    assert all(files[x] == x.stat().st_mtime_ns for x in files)
    other = compared(listed_arms("a", width=5), folder)
    assert {x.parameters for x in other.results.values()} != {x.parameters for x in first.results.values()}


def test_models_on_logs_are_ranked_with_the_baselines(listed_arms, tmp_path):
    study = compared(listed_arms("ab"), tmp_path / "out")
    sections = arm_sections(study)
    assert [section.name for section in sections] == ["a", "b"]
    rows = cells(sections[0].tables)
    assert next(iter(rows)) == "relative RMS, 1 s"
    errors = rows["relative RMS, 1 s"]
    assert {"spel", "URDF", "URDF and drives", "velocity stays constant"} <= set(errors)
    assert list(errors.values()) == sorted(errors.values(), key=float)
    page = write_comparison(study, sections).read_text()
    assert "The preset with the smallest error is spel on 2 arms." in page


def test_an_arm_that_fails_is_reported_and_the_others_are_run(listed_arms, tmp_path):
    comparison = listed_arms("a")
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot")
    arms = {"broken": ComparedArm(urdf=broken), **comparison.arms}
    study = compared(comparison.model_copy(update={"arms": arms}), tmp_path / "out")
    assert [result.arm for result in study.results.values()] == ["a"]
    assert str(broken) in study.failures["broken"]
    assert "unexpected" not in study.failures["broken"]
    assert str(broken) in write_comparison(study, arm_sections(study)).read_text()
    broken_arms = {"broken": arms["broken"], "again": arms["broken"]}
    with pytest.raises(RunError, match="no arm that can be compared"):
        prepare_study(comparison.model_copy(update={"arms": broken_arms}), tmp_path / "none")


def test_each_trajectory_is_in_the_test_logs_of_one_fold(listed_arms, tmp_path):
    comparison = listed_arms("a", splits=4)
    inputs = arm_inputs(comparison.arms["a"], tmp_path, 4)
    tested = []
    for number in range(4):
        training, testing = ({x.q.tobytes() for x in logs} for logs in inputs.split(number, 4))
        assert len(training) == 6 and len(testing) == 2 and not training & testing
        tested += testing
    assert len(set(tested)) == 8
    with pytest.raises(SpelgenError, match="9 or more, for as many splits"):
        prepare_study(listed_arms("a", splits=9), tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("presets: [spel]\n", "arms.yaml:1: arms: got nothing, expected a value"),
        (
            "arms:\n  a: {urdf: none.urdf}\npresets: [spell]\n",
            "arms.yaml:3: presets.0: unknown preset 'spell'; did you mean 'spel'?\n"
            "arms.yaml:2: arms.a.urdf: no such file: none.urdf; check the path",
        ),
        (
            "arms:\n  ../a: {urdf: .}\n",
            "arms.yaml:2: arms.../a: got '../a', expected a name of letters, digits, '.', '_' and '-'",
        ),
    ],
)
def test_errors_in_the_list_of_arms_have_file_and_line(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("arms.yaml").write_text(text)
    with pytest.raises(SettingsError if "\n" not in message else SpelgenError) as error:
        load_comparison(Path("arms.yaml"))
    assert str(error.value) == message


def test_the_command_compares_logs_of_one_arm(robot, logs, tmp_path, short_epochs):
    options = ["--presets", "minimal", "--jobs", "1", "-o", str(tmp_path / "out")]
    command = ["compare", str(robot), "--data", str(logs), *options]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert result.stderr.startswith("1 run (1 arm, 1 preset, 1 seed, 1 split); estimated time ")
    assert "two_link: minimal has the smallest relative RMS, 1 s: " in result.stdout
    assert (tmp_path / "out" / "comparison.html").exists()
    again = CliRunner().invoke(app, command)
    assert again.stderr == "1 run (1 arm, 1 preset, 1 seed, 1 split), 1 finished before\n"
    assert again.stdout == result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["two_link.urdf", "--presets", "spell"], "the preset 'spell'"),
        (["arms.yaml", "--data", "."], "in a YAML file each arm has its own"),
        (["servo.urdf"], "give logs of the arm with --data"),
    ],
)
def test_wrong_options_are_one_error(arguments, message, robots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("two_link", "servo"):
        Path(f"{name}.urdf").write_bytes((robots / "two_link.urdf").read_bytes())
    Path("servo.yaml").write_text("input: position\n")
    Path("arms.yaml").write_text("arms:\n  a: {urdf: two_link.urdf}\n")
    result = CliRunner().invoke(app, ["compare", *arguments, "--jobs", "1"])
    assert result.exit_code and message in " ".join(result.output.replace("│", " ").split())
    assert "Traceback" not in result.output
