"""Commands with their defaults lead from a URDF to an evaluation, for robots/ and for published URDFs in ../shared."""

import json
import re
import shlex
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.fitting.run_folder import RunFolder

OWN = ("two_link", "rpr", "scara", "six_dof", "panda", "ur10e")
OTHERS = ("drm_2link", "interbotix_px100", "dobot_mg400")
pytestmark = pytest.mark.usefixtures("short_torque_fits")
SHORT = {"trajectories": 2, "duration": 2.4, "sample_rate": 50.0, "test_fraction": 0.5}
FEW_STEPS = {"epochs": 1, "momentum_steps": 5}


def spelgen(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.output


def run_workflow(urdf, folder, settings, monkeypatch, judged=True):
    """Run build, simulate, train and evaluate with default options, outside of the URDF's folder.

    judged: whether predictions are evaluated, too (without --quick).
    """
    elsewhere = folder / "robots of others"
    elsewhere.mkdir()
    copied = elsewhere / urdf.name
    copied.write_bytes(urdf.read_bytes())
    copied.with_suffix(".yaml").write_text(yaml.safe_dump(settings))
    work = folder / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    spelgen("build", copied, "--preset", "closed-form", "-o", "m.py")
    spelgen("simulate", copied, "-o", "logs")
    spelgen("train", "m.py", "--data", "logs", "-o", "run")
    quick = [] if judged else ["--quick"]
    spelgen("evaluate", "run", "--data", "logs", *quick)
    result = json.loads(Path("run/evaluation.json").read_text())
    assert bool(result["horizons"]) == judged
    assert result["torque"] or result["horizons"]


@pytest.mark.parametrize("name", OWN)
def test_every_command_works_for_the_robots_here(name, robots, tmp_path, monkeypatch):
    settings = yaml.safe_load((robots / f"{name}.yaml").read_text())
    # The simulation is shorter than in the robot's settings, and without a tracking controller. If the settings have
    # `inputs`, only the number of trajectories is reduced to two; otherwise `SHORT` replaces all simulation settings.
    settings.pop("tracking", None)
    driven = "inputs" in settings["simulation"]
    settings["simulation"] = settings["simulation"] | {"trajectories": 2} if driven else SHORT
    settings["training"] = FEW_STEPS
    run_workflow(robots / f"{name}.urdf", tmp_path, settings, monkeypatch, judged=driven)


@pytest.mark.parametrize("name", OTHERS)
def test_every_command_works_for_reference_arms(name, shared, tmp_path, monkeypatch):
    settings = {"simulation": SHORT, "training": FEW_STEPS}
    run_workflow(
        shared / "arms" / f"{name}.urdf", tmp_path, settings, monkeypatch, judged=name == "drm_2link"
    )


def test_a_tip_in_the_settings_applies_to_every_command(robots, tmp_path, monkeypatch):
    """`tip` in the settings file shortens the arm in every command: here to two joints instead of the default three."""
    settings = yaml.safe_load((robots / "rpr.yaml").read_text())
    settings |= {"tip": "link2", "training": FEW_STEPS}
    settings["simulation"]["trajectories"] = 2
    run_workflow(robots / "rpr.urdf", tmp_path, settings, monkeypatch)
    assert RunFolder("run").read_spec().joint_names == ("joint1", "joint2")


def test_the_commands_of_the_readme_work(robots, tmp_path, monkeypatch):
    """The block of commands in the README runs unchanged, with the user's files: arm.urdf and two folders of logs."""
    settings = yaml.safe_load((robots / "two_link.yaml").read_text())
    settings |= {"simulation": SHORT | {"duration": 10.0}, "training": FEW_STEPS}
    (tmp_path / "arm.urdf").write_bytes((robots / "two_link.urdf").read_bytes())
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(settings))
    monkeypatch.chdir(tmp_path)
    for folder, seed in (("LOGS", 1), ("TEST_LOGS", 2)):
        spelgen("simulate", "arm.urdf", "-o", folder, "--seed", seed)
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"^    spelgen ([^#\n]+)", readme, re.MULTILINE)
    assert [shlex.split(command)[0] for command in commands] == [
        *("excite", "logs", "build", "train", "evaluate", "report", "estimate", "export")
    ]
    for command in commands:
        spelgen(*shlex.split(command))
    assert {"motion.csv", "arm.py", "run", "arm_c"} <= {path.name for path in tmp_path.iterdir()}
    assert Path("run/report.html").exists()
