"""An interrupted and resumed servo fit writes the same model and baselines as an uninterrupted fit, byte for byte.

A run of other logs or of another model is not resumed. Only interruptions by the user are tested here;
test_run_folder.py tests a process that is killed at any of its writes.
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from servo_arm import servo_logs, write_servo_arm
from typer.testing import CliRunner

import spelgen
from spelgen.cli.main import app
from spelgen.errors import RunError
from spelgen.fitting.dataset import digest
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.servo import laws, objective
from spelgen.fitting.train import train


@pytest.fixture(scope="module", autouse=True)
def few_steps():
    """Limit each minimization in a fit to two Levenberg-Marquardt steps, to save time.

    A resumed fit equals an uninterrupted fit for any number of steps.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module in (objective, laws):
            patch.setattr(module, "TUNING", replace(module.TUNING, steps=2, joint_steps=2))
        yield


@pytest.fixture(scope="module")
def start(tmp_path_factory) -> Path:
    """Return a folder with a module, its URDF, and logs of two short windows."""
    folder = tmp_path_factory.mktemp("start")
    urdf = write_servo_arm(folder)
    (folder / "module.py").write_text(spelgen.generate(urdf, "closed-form"))
    spelgen.write_logs(folder / "train.parquet", servo_logs(2, 1.0), ("shoulder", "elbow"))
    return folder


def trained(start: Path, folder: Path, **options) -> Path:
    urdf = None if "options" in options else start / "servo_arm.urdf"
    train(start / "module.py", [start / "train.parquet"], folder, urdf=urdf, **options)
    return folder


@pytest.fixture(scope="module")
def whole(start, tmp_path_factory) -> Path:
    """Return the folder of a run that was not interrupted."""
    return trained(start, tmp_path_factory.mktemp("whole") / "run")


def test_an_interrupted_fit_is_usable_and_resumes_to_the_same_bytes(start, whole, tmp_path, monkeypatch):
    run, shown = tmp_path / "run", TrainingProgress.round

    def interrupt(progress, number, rounds, steps, rms):
        shown(progress, number, rounds, steps, rms)
        if number == 3:
            raise KeyboardInterrupt

    command = ["train", start / "module.py", "--data", start, "-o", run]
    with monkeypatch.context() as patch:
        patch.setattr(TrainingProgress, "round", interrupt)
        told = CliRunner().invoke(app, list(map(str, command)))
    assert told.exit_code == 130, told.stderr
    assert "the best model so far is in the run folder; resume it by --resume" in told.stderr
    assert "servo" not in json.loads((run / "config.json").read_text())
    assert spelgen.evaluate(run, servo_logs(1, 1.0)).replays[0].errors["model"].mean < 0.1
    told = CliRunner().invoke(app, [*map(str, command), "--resume"])
    assert told.exit_code == 0, told.stderr
    for name in ("model.pt", "least_squares.json"):
        assert (run / name).read_bytes() == (whole / name).read_bytes()


def test_only_the_same_logs_and_model_are_resumed(start, whole, tmp_path):
    with pytest.raises(RunError, match="there is a run in this folder"):
        trained(start, whole)
    spelgen.write_logs(tmp_path / "train.parquet", servo_logs(2, 1.0, seed=1), ("shoulder", "elbow"))
    with pytest.raises(RunError, match="other logs than the run was started with"):
        train("", [tmp_path / "train.parquet"], whole, options=RunOptions(resume=True))
    others = [replace(log, u=log.u + 0.01) for log in servo_logs(2, 1.0)]
    assert digest(others) != digest(servo_logs(2, 1.0))
    checkpoint, run = RunFolder(whole).load_checkpoint(), RunFolder(tmp_path / "run")
    with run.started(RunFolder(whole).read_spec(), start / "servo_arm.urdf", force=False):
        run.config.write_bytes((whole / "config.json").read_bytes())
    torch.save(checkpoint.content | {"servo": {}}, run.checkpoint)
    with pytest.raises(RunError, match="a checkpoint of another model"):
        trained(start, run.path, options=RunOptions(resume=True))
