"""A run stores the column mapping of its logs, and uses it again when the run is adapted or reproduced.

A torque gain in the mapping (joint torque per logged torque) may be trained; the run states its 95 % interval.
"""

import re
import shlex

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest
import torch
from motions import smooth_motion
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.emission.build import build
from spelgen.fitting.run_folder import RunFolder
from spelgen.render.run_facts import commands

GAINS = np.array([1.6, 0.7, 1.4])  # true joint torque per logged torque; joint 2 has none, 0.7 is not used
SIDECAR = """torque: motor
joints: {joint1: {gear: 1, gain: trained}, joint2: {gear: 1}, joint3: {gear: 1, gain: trained}}
"""
MAPPING = """columns: {q: "{joint} pos", qd: "{joint} vel", tau: "{joint} load"}
joints:
  joint1: {name: a, sign: -1, units: {q: deg, qd: deg/s, tau: Nm}}
  joint2: {name: b, units: {q: mm, qd: mm/s, tau: N}}
  joint3: {name: c, units: {q: deg, qd: deg/s, tau: Nm}, offset: 0.3}
"""


def invoke(*words):
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def folder(robots, tmp_path_factory):
    """Return a folder with an arm, a log whose columns need a mapping, and a run that was trained on it."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "rpr.urdf").write_bytes((robots / "rpr.urdf").read_bytes())
    (folder / "rpr.yaml").write_text(SIDECAR)
    (folder / "map.yaml").write_text(MAPPING)
    model = build(folder / "rpr.urdf", "closed-form")
    random = np.random.default_rng(0)
    q, qd, qdd = (0.4 * x for x in smooth_motion(3, 8.0, random))
    with torch.no_grad():
        force = model.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd))).numpy()
    # joint 2 has no trained gain: its logged torque is the joint torque
    tau = force / np.where([True, False, True], GAINS, 1.0)
    tau += 0.01 * tau.std(axis=0) * random.normal(size=tau.shape)
    unit = np.array([-180 / np.pi, 1e3, 180 / np.pi])
    logged = zip("abc", ((q - [0, 0, 0.3]) * unit).T, (qd * unit).T, (tau * [-1, 1, 1]).T, strict=True)
    table = {"t": np.arange(len(q)) / 100}
    for name, *columns in logged:
        table |= {f"{name} {word}": x for word, x in zip(("pos", "vel", "load"), columns, strict=True)}
    pa.csv.write_csv(pa.table(table), folder / "log.csv")
    log, mapping = str(folder / "log.csv"), str(folder / "map.yaml")
    invoke("build", str(folder / "rpr.urdf"), "--preset", "closed-form", "-o", str(folder / "module.py"))
    train = ["train", str(folder / "module.py"), "--data", log, "--mapping", mapping, "--objective", "torque"]
    (folder / "output.txt").write_text(invoke(*train, "-o", str(folder / "run")))
    return folder


def test_trained_gains_are_stated_with_intervals_by_training_and_report(folder):
    (message,) = (x for x in RunFolder(folder / "run").read_record().notes if "joint torque per logged" in x)
    found = re.findall(r"(joint\d) ([\d.]+) \(([\d.]+) to ([\d.]+)\)", message)
    assert [x[0] for x in found] == ["joint1", "joint3"]
    for (_, *numbers), gain in zip(found, GAINS[[0, 2]], strict=True):
        value, low, high = map(float, numbers)
        assert low < gain < high and low < value < high
    # the last joint's torque is inertia and friction only, both unknown, so that its gain is not determined
    assert message.endswith("; the gain of joint3 is not determined: friction and inertia scale with it")
    output = " ".join((folder / "output.txt").read_text().split())
    assert found[0][1] in output
    invoke("report", str(folder / "run"))
    assert message in (folder / "run" / "report.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("coarse_validation")
def test_a_run_is_adapted_with_the_mapping_that_it_was_trained_with(folder):
    data = ["--data", str(folder / "log.csv")]
    invoke("train", "--from", str(folder / "run"), *data, "-o", str(folder / "adapted"))
    assert (folder / "adapted" / "mapping.yaml").read_bytes() == (
        folder / "run" / "mapping.yaml"
    ).read_bytes()


@pytest.mark.usefixtures("coarse_validation")
def test_the_lines_that_reproduce_a_run_give_the_same_model(folder, monkeypatch):
    run = RunFolder(folder / "run")
    (work := folder / "again").mkdir()
    monkeypatch.chdir(work)
    # no horizons of whole seconds in the evaluation, to save time
    monkeypatch.setattr("spelgen.evaluation.evaluate.SECONDS", ())
    for line in commands(run, run.read_spec(), run.read_record()):
        program, *words = shlex.split(
            line.replace("RUN/", f"{run.path}/").replace("LOGS", str(folder / "log.csv"))
        )
        assert program == "spelgen"
        invoke(*words)
    before, after = (torch.load(x / "model.pt", weights_only=True) for x in (run.path, work / "RUN2"))
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert (work / "RUN2" / "report.html").exists()
