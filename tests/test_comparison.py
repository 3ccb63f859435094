"""A comparison in small: same data for every preset, measures that can fail, tables beside published figures."""

import json
import math
import shutil
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
import torch
import yaml

from spelgen.baselines.constant_velocity import hold_velocity
from spelgen.baselines.predictor import Predictor
from spelgen.comparison import metrics, runs
from spelgen.comparison.formatting import comparison_tables
from spelgen.comparison.known_urdf import known_urdf
from spelgen.comparison.metrics import mass_error, true_mass
from spelgen.comparison.runs import predict_example, run_study, time_steps
from spelgen.comparison.study import VARIANTS, ablation_variants, prepare_study
from spelgen.design import load_design
from spelgen.emission.loading import load_module
from spelgen.errors import RunError
from spelgen.evaluation import invariants
from spelgen.evaluation.tuning import EvaluationTuning
from spelgen.fitting.rollout import roll_out
from spelgen.logs.read import Trajectory, read_logs
from spelgen.logs.windows import cut_windows, joined
from spelgen.render.comparison_page import write_comparison
from spelgen.tasks import run_here
from spelgen.urdf.read import read_urdf

CHOSEN = [variant for variant in VARIANTS if variant.name in ("phnode", "hybrid")]
JOINTS = ("joint1", "joint2")


@pytest.fixture(scope="module")
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(invariants, "TUNING", EvaluationTuning(sampled_positions=100, free_steps=50))
        yield


@pytest.fixture(scope="module")
def robot(tmp_path_factory, robots):
    """two_link with few trajectories, to be trained for a moment."""
    folder = tmp_path_factory.mktemp("robot")
    urdf = folder / "two_link.urdf"
    urdf.write_bytes((robots / "two_link.urdf").read_bytes())
    settings = yaml.safe_load((robots / "two_link.yaml").read_text())
    settings["simulation"]["trajectories"] = 8
    settings["comparison"] |= {"first": 0.25, "steps": 20, "momentum_steps": 5, "seeds": 1, "width": 8}
    urdf.with_suffix(".yaml").write_text(yaml.safe_dump(settings))
    return urdf


@pytest.fixture(scope="module")
def notes():
    return []


@pytest.fixture(scope="module")
def study(robot, quick, notes, tmp_path_factory):
    found = prepare_study(robot, tmp_path_factory.mktemp("study"), variants=CHOSEN)
    run_study(found, run_here, note=notes.append)
    return found


def test_models_know_the_kinematics_alone(study):
    known = read_urdf(study.urdf)
    assert set(JOINTS) <= {joint.name for joint in known.joints}
    assert all(link.inertial is None for link in known.links)
    assert "joints" not in yaml.safe_load(study.urdf.with_suffix(".yaml").read_text())


def test_inertials_that_are_wrong_are_possible_ones(robot, tmp_path):
    """Each body's own, by about the error that is asked; friction and drives are not told."""
    true = {x.name: x.inertial for x in read_urdf(robot).links if x.inertial}
    for error in (0.0, 0.3, 1.0):
        path = tmp_path / f"wrong_{error}.urdf"
        path.write_bytes(known_urdf(robot, error))
        found = {x.name: x.inertial for x in read_urdf(path).links if x.inertial}
        away = [abs(np.log(float(found[x].mass) / float(true[x].mass))) for x in true]
        assert found.keys() == true.keys()
        assert (max(away) == 0) if error == 0 else (0.1 * error < np.mean(away) < 3 * error)
        for inertial in found.values():
            ixx, ixy, ixz, iyy, iyz, izz = inertial.tensor
            moments = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
            assert moments[0] > 0 and moments[2] <= moments[0] + moments[1] + 1e-9
    assert b"<dynamics" not in path.read_bytes()


def test_with_a_wrong_urdf_models_are_trained_by_defaults(robot, quick, tmp_path):
    found = prepare_study(robot, tmp_path, variants=CHOSEN[1:], urdf_error=0.3)
    assert found.urdf.read_bytes() == known_urdf(robot, 0.3)
    with pytest.MonkeyPatch.context() as patch:
        seen = []

        def train(*arguments, **options):
            seen.append(arguments[3])
            raise KeyboardInterrupt

        patch.setattr(runs, "train", train)
        with pytest.raises(KeyboardInterrupt):
            run_study(found, run_here, note=print)
    assert seen == [None]
    with pytest.raises(RunError, match="a comparison with other settings"):
        prepare_study(robot, tmp_path, variants=CHOSEN[1:], urdf_error=1.0)


def test_the_ablation_changes_one_thing_at_a_time():
    designs = [load_design(x.preset) for x in ablation_variants()]
    changes = [
        {key for key, value in asdict(a).items() if value != asdict(b)[key]} for a, b in pairwise(designs)
    ]
    assert changes[:3] == [{"dissipation"}, {"input"}, {"mass"}]
    assert changes[3] == {"potential", "encoding"}
    assert designs[-1] == load_design("hybrid")


def test_training_sees_the_beginning_only(study):
    names = load_module(study.module(CHOSEN[0])).joint_names
    training, testing = (read_logs([study.logs], names, role=role) for role in ("train", "test"))
    assert {len(x.t) for x in training} == {5}
    assert {len(x.t) for x in testing} == {21}
    assert not {x.name for x in training} & {x.name for x in testing}


def test_every_run_is_noted_and_measured(study, notes):
    assert len(notes) == 2
    results = {result.variant: result for result in study.results()}
    assert set(results) == {"phnode", "hybrid"}
    for result in results.values():
        parts = result.prediction
        assert parts.loss == pytest.approx(parts.position + parts.velocity)
        assert result.invariants.least_eigenvalue > 0
    assert results["hybrid"].sizes.outputs == (1, 2, 0, 1)
    assert results["phnode"].sizes.outputs == (21, 21, 6, 1)  # as in the paper
    assert results["phnode"].sizes.inputs == 4


def test_losses_are_of_the_logs_that_they_are_named_after(study):
    """Worked out again from the logs of each role: sums over joints, means over samples and windows."""
    (result,) = (x for x in study.results() if x.variant == "hybrid")
    model = load_module(study.module(CHOSEN[1]))
    model.load_state_dict(torch.load(study.run(CHOSEN[1], 0) / "model.pt"))
    for key, role, samples in (("train", "train", 5), ("test", "test", 5), ("prediction", "test", 21)):
        cut = [
            log[start : start + samples]
            for log in read_logs([study.logs], model.joint_names, role=role)
            for start in range(len(log.t) - samples + 1)
        ]
        windows = joined([cut_windows([each], samples, measured=False) for each in cut])
        with torch.no_grad():
            predicted = [x.numpy() for x in roll_out(model, windows, result.substeps)]
        q, qd = (np.stack([getattr(each, name)[1:] for each in cut]) for name in ("q", "qd"))
        away = (predicted[0] - q + np.pi) % (2 * np.pi) - np.pi
        position, velocity = (x.sum(axis=-1).mean() for x in (away**2, (predicted[1] - qd) ** 2))
        assert getattr(result, key).position == pytest.approx(position, rel=1e-9), key
        assert getattr(result, key).velocity == pytest.approx(velocity, rel=1e-9), key
    assert result.train != result.test


def test_a_comparison_goes_on_where_it_stopped(study, robot, quick):
    lost, kept = study.result(CHOSEN[0], 0), study.result(CHOSEN[1], 0)
    before = lost.read_text(), kept.stat().st_mtime_ns
    lost.unlink()
    notes = []
    again = prepare_study(robot, study.folder, variants=CHOSEN)
    run_study(again, run_here, note=notes.append)
    assert notes[0] == "1 of 2 runs are done already"
    assert kept.stat().st_mtime_ns == before[1]
    first, second = (json.loads(x) for x in (before[0], lost.read_text()))
    assert first["prediction"] == second["prediction"]


def test_a_comparison_with_a_module_of_somebody_else_is_refused(study, robot):
    module = study.module(CHOSEN[0])
    own = module.read_text()
    module.write_text(own + "print('anything')\n")
    with pytest.raises(RunError, match="a module that spelgen cannot verify"):
        prepare_study(robot, study.folder, variants=CHOSEN)
    module.write_text(own)


def test_another_comparison_in_the_folder_is_refused(study, robot):
    with pytest.raises(RunError, match="a comparison with other settings"):
        prepare_study(robot, study.folder, variants=CHOSEN, steps=40)


def test_seeds_may_be_added(study, robot):
    more = prepare_study(robot, study.folder, variants=CHOSEN, seeds=2)
    assert len(list(more.results())) == 2  # those of the first seed, which is not run again


def test_begun_anew_nothing_of_the_old_runs_goes_on(study, robot, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(study.folder, folder)
    again = prepare_study(robot, folder, variants=CHOSEN, force=True)
    assert not list(again.results())
    assert not list(folder.rglob("checkpoint.pt"))


def test_tables_stand_beside_published_figures(study):
    results = list(study.results())
    tables = comparison_tables(results, time_steps(study), study.settings.published)
    rows = {row.label: list(map(row.text, table.columns)) for table in tables for row in table.rows}
    assert rows["outputs of M"] == ["21", "1"]
    assert rows["parameters"] == [f"{result.sizes.parameters:,}" for result in results]
    assert rows["published: prediction loss"] == ["0.194", ""]
    base, ours = (result.prediction.loss for result in results)
    assert rows["phnode's prediction loss / this"] == ["1", f"{base / ours:.3g}"]
    assert all(line == line.rstrip() and len(line) <= 80 for x in tables for line in x.text().splitlines())


def test_the_true_mass_matrix_is_pinocchios_with_the_rotors(robots):
    """Pinocchio's own reading of the file, and rotor inertia times gear squared on the diagonal."""
    urdf = robots / "ur10e.urdf"
    model = pin.buildModelFromUrdf(str(urdf))
    q = torch.from_numpy(np.random.default_rng(0).uniform(-3, 3, (5, 6)))
    rotors = [1.0e-4, 1.0e-4, 6.0e-5, 2.0e-5, 2.0e-5, 2.0e-5]
    for at, found in zip(q.numpy(), true_mass(urdf, q).numpy(), strict=True):
        upper = np.triu(pin.crba(model, model.createData(), at))
        expected = upper + np.triu(upper, 1).T + np.diag(rotors) * 101**2
        np.testing.assert_allclose(found, expected, atol=1e-10)


def test_the_error_of_m_has_no_units():
    """A tenth too large everywhere is an error of 0.1 on the diagonal of the identity, in any units of the joints."""
    scale = torch.diag(torch.tensor([1.0, 100.0, 0.01], dtype=torch.float64))
    true = (scale @ (torch.eye(3, dtype=torch.float64) + 0.2) @ scale).expand(4, 3, 3)
    assert mass_error(1.1 * true, true) == pytest.approx(0.1 / math.sqrt(3))
    assert mass_error(true, true) == 0.0


def test_the_page_shows_predictions_and_m_beside_the_truth(study):
    page = write_comparison(study, []).read_text()
    learned = page[page.index("The mass matrix along this trajectory") :]
    assert learned.count('<svg class="chart"') == 3
    for name in ("M11", "M21", "M22"):
        assert f'aria-label="{name}"' in learned
    assert learned.count("<title>true</title>") == 3
    (result,) = (x for x in study.results() if x.variant == "hybrid")
    q = torch.tensor(result.example.q, dtype=torch.float64)
    model = load_module(study.module(CHOSEN[1]))
    model.load_state_dict(torch.load(study.run(CHOSEN[1], 0) / "model.pt"))
    np.testing.assert_allclose(result.mass, model.mass_matrix(q).detach(), rtol=1e-12)


def test_a_run_that_is_not_finite_counts_as_worst(study):
    (result,) = (x for x in study.results() if x.variant == "hybrid")
    broken = replace(result, seed=1, prediction=metrics.Prediction(None, None, None))
    table = comparison_tables([result, broken, broken], {"hybrid": 1.0}, {})[1]
    assert {row.label: row.text("hybrid") for row in table.rows}["prediction loss, 1 s"] == "-"


def test_windows_and_examples_of_every_fourth_sample_begin_with_a_fourth_one():
    """Where a controller holds its torque for four samples, a window's input is then exactly what acted."""
    count = 200
    q = torch.arange(count, dtype=torch.float64).unsqueeze(-1).numpy()  # a sample's number
    log = Trajectory(0.002 * q[:, 0], q, q, np.floor(q / 4), "a")
    windows = metrics.thinned([log], 5, 4)
    assert not (windows.q % 4).any()
    assert torch.equal(windows.tau, windows.q[:, :-1] / 4)
    example = predict_example(Predictor("", hold_velocity), [log], 10, 4)
    assert [x % 4 for (x,) in example.q] == [0] * 11
    np.testing.assert_allclose(example.t, 0.008 * np.arange(11), atol=1e-12)


def test_invariants_notice_what_breaks_them(study, quick):
    model = load_module(study.module(CHOSEN[1]))
    testing = read_logs([study.logs], model.joint_names, role="test")
    still = metrics.thinned(testing, 21, 1)
    windows = replace(still, qd=0.5 + still.qd)
    low, high = (torch.full((2,), bound, dtype=torch.float64) for bound in (-math.pi, math.pi))
    kept = invariants.invariants(model, windows, low, high)
    assert kept.energy_rise <= 1e-12 < kept.least_eigenvalue
    model.friction_torque = lambda pose, qd, *state: -5.0 * qd  # drives instead of braking
    assert invariants.invariants(model, windows, low, high).energy_rise > 1e-3
    model.mass_matrix = lambda q: torch.diag_embed(torch.cat([q.cos()[..., :1], 1 + 0 * q[..., :1]], dim=-1))
    assert invariants.invariants(model, windows, low, high).least_eigenvalue < -1
