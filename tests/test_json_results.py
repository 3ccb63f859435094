"""With --format json a command prints one line of JSON; an error above its --limit has its own exit code."""

import json
from types import SimpleNamespace

import pytest
import yaml
from typer.testing import CliRunner

from spelgen.cli.evaluate_command import LIMIT_EXCEEDED
from spelgen.cli.main import app


def spelgen(*arguments, code=0):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.output
    return SimpleNamespace(out=done.stdout, err=done.stderr)


@pytest.fixture(scope="module")
def folder(robots, tmp_path_factory):
    """Return a folder with a built module and simulated logs of two trajectories of 3 s."""
    folder = tmp_path_factory.mktemp("json")
    (folder / "arm.urdf").write_bytes((robots / "two_link.urdf").read_bytes())
    settings = yaml.safe_load((robots / "two_link.yaml").read_text())
    settings["simulation"] = {"trajectories": 2, "duration": 3.0, "test_fraction": 0.5}
    for joint in settings["joints"].values():
        joint.pop("inputs", None)
    (folder / "arm.yaml").write_text(yaml.safe_dump(settings))
    spelgen("simulate", folder / "arm.urdf", "-o", folder / "logs")
    return folder


def test_every_step_answers_in_json(folder):
    module, run, data = folder / "m.py", folder / "run", ("--data", folder / "logs")
    as_json = ("--format", "json")
    built = json.loads(
        spelgen("build", folder / "arm.urdf", "--preset", "closed-form", "-o", module, *as_json).out
    )
    assert (built["module"], built["new"], built["robot"]) == (str(module), True, "two_link")
    trained = json.loads(spelgen("train", module, *data, "-o", run, *as_json).out)
    assert (trained["run"], trained["status"], trained["objective"]) == (str(run), "finished", "torque")
    exported = json.loads(spelgen("export", run, "-o", folder / "arm_learned.urdf", *as_json).out)
    assert str(folder / "arm_learned.urdf") in exported["files"]
    motion = ("-o", folder / "motion.csv", "--duration", "3", "--trials", "1")
    excited = json.loads(spelgen("excite", folder / "arm.urdf", *motion, *as_json).out)
    assert excited["condition"] > 1
    identified = json.loads(spelgen("identify", folder / "arm.urdf", *data, *as_json).out)
    assert identified
    evaluated = spelgen(
        "evaluate",
        run,
        *data,
        *as_json,
        "--limit",
        "torque.nmse=1e-9",
        "--limit",
        "joint.nmse=9",
        code=LIMIT_EXCEEDED,
    )
    figure = json.loads(evaluated.out)["torque"]["model"]["mean_nmse"]
    assert evaluated.err.splitlines()[-1] == (
        f"limit exceeded: torque.nmse is {figure:.4g}, expected at most 1e-09"
    )


def test_a_limit_that_is_none_is_a_usage_error(folder):
    told = spelgen("evaluate", folder / "run", "--data", folder / "logs", "--limit", "torque=1", code=2)
    assert "'torque=1' is not FIGURE=MAX with one of torque.nmse, joint.nmse, rollout.rms" in " ".join(
        told.err.split()
    )
