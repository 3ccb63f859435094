"""Each objective accepts its own options; the error about any other option names the option's objective."""

from pathlib import Path

import numpy as np
import pytest
from planar_model import JOINTS, write_module
from pydantic import ValidationError
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.emission.build import build
from spelgen.emission.specify import generate
from spelgen.errors import OptionError, SettingsError
from spelgen.fitting.fit import FitOptions, choose_config, fit
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import CONFIGS, OWNERS, MomentumFit, Rollout, TorqueFit, fit_config
from spelgen.settings.settings import load_settings
from spelgen.settings.training import TrainingSettings
from tests.test_training import motions

VALUES = {
    "prior": {"bodies": 1.0}, "adapt": "friction", "evaluations": 40, "weight_decay": 0.1, "urdf_weight": 0.5,
    "window": 7, "stride": 2, "momentum_steps": 10, "optimizer": "adamw", "batch": 16, "learning_rate": 0.01,
    "max_minutes": 2.0, "torque_first": True, "epochs": 3, "patience": 2, "solver": "rk4", "substeps": 2,
}  # fmt: skip
OF_CLOSED_FORM = {"torque": {"prior"}, "rollout": {"torque_first"}}
OF_NETWORKS = {"torque": {"evaluations", "weight_decay", "urdf_weight"}}


def test_every_option_has_a_value_here_and_a_place_in_the_settings():
    assert OWNERS.keys() == VALUES.keys()
    in_a_file = OWNERS.keys() - {"adapt"}  # `adapt` belongs to one run, not to a robot, and is no setting
    assert in_a_file <= TrainingSettings.model_fields.keys()
    beside = {"objective", "cutoff", "decimation", "gap", "torque_delay", "validation_fraction", "seed"}
    assert TrainingSettings.model_fields.keys() == in_a_file | beside


@pytest.mark.parametrize("rigid_bodies", [False, True])
@pytest.mark.parametrize("objective", ["torque", "momentum", "rollout"])
@pytest.mark.parametrize("option", VALUES)
def test_an_option_applies_or_the_error_names_its_objective(option, objective, rigid_bodies):
    make = lambda: fit_config(objective, rigid_bodies=rigid_bodies, options={option: VALUES[option]})  # noqa: E731
    owners = [x for x in ("torque", "momentum", "rollout") if option in CONFIGS[x].model_fields]
    if objective not in owners:
        several = "objectives" if len(owners) > 1 else "objective"
        told = f"{option}: belongs to the {several} {' and '.join(owners)}, this fits {objective}"
    elif rigid_bodies and objective == "momentum":
        told = "objective: momentum is for models that consist of networks; this model has rigid bodies"
    elif option in (OF_NETWORKS if rigid_bodies else OF_CLOSED_FORM).get(objective, ()):
        kind = "models that consist of networks" if rigid_bodies else "models of rigid bodies"
        told = f"{option}: with the objective {objective} belongs to {kind}"
    else:
        config = make()
        assert config.record(rigid_bodies=rigid_bodies)[option]
        return
    with pytest.raises(OptionError) as caught:
        make()
    assert str(caught.value) == told


def test_options_of_another_option():
    for option in ("batch", "learning_rate"):
        with pytest.raises(OptionError, match=f"{option}: belongs to the optimizer adamw, this is lbfgs"):
            MomentumFit(optimizer="lbfgs", **{option: VALUES[option]})
    with pytest.raises(OptionError, match="substeps: belongs to the solver rk4, this is dopri5"):
        Rollout(solver="dopri5", substeps=2)


def test_from_python_too():
    with pytest.raises(
        OptionError, match="window: belongs to the objectives momentum and rollout, this fits torq"
    ):
        TorqueFit(window=7)
    with pytest.raises(SettingsError, match=r"unknown option 'windw'; did you mean 'window'\?"):
        Rollout(windw=7)
    with pytest.raises(ValidationError, match="greater than or equal to 2"):
        Rollout(window=1)
    with pytest.raises(ValidationError, match="frozen"):
        Rollout().window = 3
    with pytest.raises(SettingsError) as caught:
        fit_config("rollout", rigid_bodies=False, options={"learning_rate": 0.0})
    assert str(caught.value) == "learning_rate: got 0.0, expected greater than 0"
    for wrong in ({"cutoff": -1.0}, {"decimation": 0}, {"gap": 1.0}):
        with pytest.raises(SettingsError, match=next(iter(wrong))):
            Preprocessing(**wrong)


def test_settings_of_another_objective_are_omitted():
    settled = {"window": 9, "batch": 8, "substeps": 4, "weight_decay": 0.3, "prior": {"bodies": 1.0}}
    make = lambda objective, **chosen: fit_config(  # noqa: E731
        objective, rigid_bodies=False, options=chosen, defaults=settled
    ).record(rigid_bodies=False)
    assert make("torque") == {"evaluations": 2000, "weight_decay": 0.3, "urdf_weight": 1.0}
    found = make("rollout", solver="dopri5", optimizer="lbfgs")
    assert (found["window"], "batch" in found, "substeps" in found) == (9, False, False)
    assert make("momentum", batch=4)["batch"] == 4


@pytest.fixture
def sidecar(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def write(text: str) -> Path:
        Path("arm.yaml").write_text(text)
        return Path("arm.urdf")

    return write


def test_a_sidecar_names_its_line(sidecar):
    path = sidecar("training:\n  objective: torque\n  weight_decay: 0.1\n  window: 7\n")
    with pytest.raises(SettingsError) as caught:
        assert load_settings(path).training.options
    assert str(caught.value) == (
        "arm.yaml:4: training.window: got 7, expected no value with 'objective: torque': "
        "this belongs to momentum and rollout"
    )
    path = sidecar("training:\n  window: 7\n  weight_decay: 0.1\n  cutoff: 5\n  decimation: 2\n")
    settings = load_settings(path).training
    assert settings.options == {"window": 7, "weight_decay": 0.1}
    assert Preprocessing(**settings.preprocessing) == Preprocessing(5.0, 2)


def refused(*command: object) -> str:
    done = CliRunner().invoke(app, ["train", *map(str, command)])
    assert done.exit_code == 2, done.output
    return done.output.strip().splitlines()[-1]


def test_the_command_line_names_the_flag(robots, tmp_path):
    logs, module = tmp_path / "train.parquet", tmp_path / "rpr.py"
    write_logs(logs, motions(), JOINTS)
    module.write_text(generate(robots / "rpr.urdf", preset="closed-form"))
    data = ("--data", logs, "-o", tmp_path / "run", "--set", "progress=false")
    told = refused(module, *data, "--objective", "torque", "--set", "learning_rate=0.1")
    assert (
        told == "Error: --set learning_rate: belongs to the objectives momentum and rollout, this fits torque"
    )
    told = refused(module, *data, "--objective", "torque", "--set", "urdf_weight=0")
    assert (
        told
        == "Error: --set urdf_weight: with the objective torque belongs to models that consist of networks"
    )
    told = refused(module, *data, "--objective", "momentum")
    assert (
        told
        == "Error: --objective: momentum is for models that consist of networks; this model has rigid bodies"
    )
    networks = write_module(tmp_path, "networks.py")
    told = refused(networks, *data, "--set", "evaluations=40")
    assert told == "Error: --set evaluations: belongs to the objective torque, this fits rollout"
    told = refused(networks, *data, "--set", "torque_first=false")
    assert told == "Error: --set torque_first: with the objective rollout belongs to models of rigid bodies"
    told = refused(networks, *data, "--set", "optimizer=lbfgs", "--set", "batch=4")
    assert told == "Error: --set batch: belongs to the optimizer adamw, this is lbfgs"
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_keeps_its_options(tmp_path):
    logs, run = tmp_path / "train.parquet", tmp_path / "run"
    write_logs(logs, motions(), JOINTS)
    train = [
        "train",
        str(write_module(tmp_path)),
        "--data",
        str(logs),
        "-o",
        str(run),
        "--set",
        "progress=false",
    ]
    first = ["--set", "momentum_steps=20", "--set", "epochs=1", "--set", "window=6"]
    assert CliRunner().invoke(app, [*train, *first]).exit_code == 0
    again = [*train, "--resume"]
    assert CliRunner().invoke(app, [*again, "--set", "epochs=2"]).output.startswith("finished after 2 epochs")
    assert refused(*again[1:], "--set", "evaluations=40").startswith("Error: --set evaluations: belongs to")
    done = CliRunner().invoke(app, [*again, "--set", "window=7"])
    assert done.exit_code == 1
    assert "got window 7 instead of 6, expected the settings the run was started with" in done.stderr
    done = CliRunner().invoke(app, [*again, "--objective", "momentum"])
    assert done.exit_code == 1
    assert "objective momentum instead of rollout" in done.stderr


def test_a_name_in_place_of_a_configuration_is_reported(robots):
    model = build(robots / "two_link.urdf", "closed-form")
    with pytest.raises(
        SettingsError, match=r"got 'torque' as the configuration of a fit, expected spelgen\.Torq"
    ):
        fit(model, Trajectory(np.arange(3), *np.zeros((3, 3, 2))), "torque")


def test_logs_are_read_for_the_choice_of_an_objective_only_if_it_depends_on_them(robots):
    """Logs, which may take long to read, are read only if the choice of the objective depends on their sample rates.

    They are not read if the model or the options determine the objective. An option that belongs to another objective
    is an error, which is raised without reading the logs.
    """

    def unread():
        raise AssertionError("the logs were read")

    bodies, networks = (
        build(robots / "two_link.urdf", preset, width=4) for preset in ("closed-form", "spel")
    )
    assert choose_config(networks, None, unread).objective == "rollout"
    assert choose_config(bodies, FitOptions("torque"), unread).objective == "torque"
    with pytest.raises(OptionError, match="belongs to the objective rollout, this fits torque"):
        choose_config(bodies, FitOptions("torque", {"epochs": 3}), unread)
    assert choose_config(bodies, None, lambda: [10.0, 100.0]).objective == "torque"
    slow = choose_config(bodies, None, lambda: [10.0])
    assert (slow.objective, slow.urdf_weight) == ("rollout", 0.0)
    regularized = FitOptions(defaults={"urdf_weight": 2.0, "substeps": 3})
    assert choose_config(bodies, regularized, lambda: [10.0]).urdf_weight == 2.0
