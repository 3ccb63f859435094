"""A fit in memory equals `train` with files, is saved and loaded unchanged, and has the torque error that it states."""

import json

import numpy as np
import pytest
import torch
from emitted import FOLLOWED, random_model
from planar_model import JOINTS, Model, true_model, write_module

import spelgen
from spelgen.errors import LogError, RunError
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.rollout import SOLVER, loss_scales, roll_out, rollout_loss
from spelgen.fitting.train import train
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.fits import MomentumFit, Rollout, TorqueFit
from tests.test_training import (
    QUICK,
    Oscillator,
    lines,
    motions,
    quick,
    random_windows,
)


def same(first: torch.nn.Module, second: torch.nn.Module) -> bool:
    pairs = zip(first.state_dict().items(), second.state_dict().items(), strict=True)
    return all(a == b and torch.equal(x, y) for (a, x), (b, y) in pairs)


@pytest.mark.usefixtures("short_epochs")
def test_a_fit_in_memory_is_that_of_files(tmp_path):
    write_logs(tmp_path / "train.parquet", motions(), JOINTS)
    module = write_module(tmp_path)
    filed = train(module, [tmp_path / "train.parquet"], tmp_path / "filed", QUICK)
    model = spelgen.load_module(module)
    found = spelgen.fit(model, motions(), QUICK)
    assert found.model is model
    assert (found.status, found.epochs, found.best_validation) == ("finished", 6, filed.best_validation)
    assert same(model, filed.model)
    found.save(tmp_path / "saved")
    names = {path.name for path in (tmp_path / "saved").iterdir()}
    assert names == {path.name for path in (tmp_path / "filed").iterdir()}
    assert lines(tmp_path / "saved") == lines(tmp_path / "filed")
    for name in ("config.json", "spec.json"):
        assert (tmp_path / "saved" / name).read_bytes() == (tmp_path / "filed" / name).read_bytes()
    again = train(
        module,
        [tmp_path / "train.parquet"],
        tmp_path / "saved",
        quick(epochs=7),
        options=RunOptions(resume=True),
    )
    assert again.epochs == 7


def test_the_seed_orders_batches():
    """The seed determines the order of batches: the same seed gives equal weights, another seed other weights.

    The validation logs are given explicitly. Otherwise the seed might also change the split of the logs.
    """
    logs, held = motions(), motions(2, seed=1)
    weights = []
    for seed in (0, 0, 1):
        model = Model()
        spelgen.fit(model, logs, quick(epochs=2), seed=seed, validation=held)
        weights.append(torch.cat([x.detach().flatten() for x in model.parameters()]))
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_saved_fit_is_loaded_as_it_was(tmp_path):
    found = spelgen.fit(spelgen.load_module(write_module(tmp_path)), motions(), quick(epochs=2), seed=3)
    folder = found.save(tmp_path / "run")
    loaded = spelgen.load_run(folder)
    assert same(loaded.model, found.model)
    assert (loaded.config, loaded.preprocessing, loaded.record) == (
        found.config,
        found.preprocessing,
        found.record,
    )
    assert (loaded.history, loaded.checkpoint.best_epoch, loaded.checkpoint.substeps) == (
        found.history,
        found.checkpoint.best_epoch,
        found.checkpoint.substeps,
    )
    assert (loaded.status, loaded.folder, found.folder) == (None, folder, None)
    with pytest.raises(RunError, match="there is a run in this folder"):
        found.save(folder)
    again = loaded.save(tmp_path / "again")
    assert (again / "config.json").read_bytes() == (folder / "config.json").read_bytes()
    loaded.save(folder, force=True)
    assert same(spelgen.load_run(folder).model, found.model)


def test_the_record_has_the_used_options_only(tmp_path):
    found = spelgen.fit(Model(), motions(), Rollout(epochs=1, momentum_steps=0))
    assert found.record.objective == "rollout"
    assert found.record.options == {
        "window": 5, "stride": 1, "momentum_steps": 0, "optimizer": "lbfgs", "weight_decay": 2e-5,
        "urdf_weight": 1.0, "epochs": 1, "patience": 60, "solver": "rk4",
    }  # fmt: skip
    assert found.record.preprocessing == Preprocessing(decimation=1, torque_delay=0.0)
    json.dumps(found.record.to_dict())


def test_validation_may_be_given():
    logs = motions()
    found = spelgen.fit(Model(), logs[:4], quick(epochs=1), validation=logs[4:])
    assert found.record.training == [x.name for x in logs[:4]]
    assert found.record.validation == [x.name for x in logs[4:]]
    assert found.record.validation_fraction is None


def test_one_trajectory_is_enough():
    (log,) = motions(count=1, samples=60)
    found = spelgen.fit(Model(), log, quick(epochs=1))
    assert found.record.training == ["motion_0"]


def test_logs_that_cannot_be_fitted_are_reported():
    model = Model()
    with pytest.raises(LogError, match="got no trajectory, expected at least one"):
        spelgen.fit(model, [])
    (log,) = motions(count=1)
    with pytest.raises(LogError, match="motion_0"):
        spelgen.fit(model, Trajectory(log.t, log.q[:, :1], log.qd[:, :1], log.tau[:, :1], log.name))


def swings(seed: int, rate=200.0) -> Trajectory:
    """Return a log of a smooth motion with the torques of the true arm."""
    random = np.random.default_rng(seed)
    t = np.arange(0, 6, 1 / rate)[:, None]
    speed, phase = random.uniform(2, 5, 2), random.uniform(0, 6, 2)
    q, qd, qdd = (
        np.sin(speed * t + phase),
        speed * np.cos(speed * t + phase),
        -(speed**2) * np.sin(speed * t + phase),
    )
    with torch.no_grad():
        tau = true_model().inverse_dynamics(*(torch.from_numpy(x) for x in (q, qd, qdd))).numpy()
    return Trajectory(t[:, 0], q, qd, tau, f"swing_{seed}")


def test_torques_are_fitted_predicted_and_scored():
    model, test = Model(), swings(9)
    found = spelgen.fit(model, [swings(seed) for seed in range(3)], TorqueFit(weight_decay=0.0))
    assert (found.epochs, found.history, found.config.objective) == (0, [], "torque")
    assert [note.code for note in found.diagnostics].count("torque-fit") == 1
    assert found.score(test) > 0.9999
    tau = found.predict(test)
    assert tau.shape == test.tau.shape
    inner = slice(100, -100)  # the ends of the log are omitted, at which the filter has transients
    assert np.abs(tau - test.tau)[inner].max() < 0.02 * test.tau.std()
    result = spelgen.evaluate(found, [test])
    assert result.torque["model"].mean_nmse == pytest.approx(1 - found.score([test]), rel=1e-6)
    constant = Trajectory(test.t, test.q, test.qd, np.ones_like(test.tau), "constant")
    assert found.predict(constant).shape == test.tau.shape
    with pytest.raises(LogError, match="no motion for an evaluation of torques"):
        found.score(motions())


def test_the_filter_reaches_torques():
    logs = [swings(seed) for seed in range(2)]
    fits = [
        spelgen.fit(Model(), logs, TorqueFit(evaluations=20), preprocessing=each)
        for each in (Preprocessing(), Preprocessing(cutoff=3.0), Preprocessing(cutoff=0.0))
    ]
    assert [x.preprocessing.cutoff for x in fits] == [8.0, 3.0, 0.0]
    scores = [x.score(logs) for x in fits]
    assert len({round(x, 9) for x in scores}) == 3


def test_predictions_at_gaps_are_not_numbers():
    log = swings(0)
    t = log.t.copy()
    t[1:] += 1.0  # the log has a gap after its first sample, which is then a segment of its own
    found = spelgen.fit(Model(), [swings(1), swings(2)], TorqueFit(evaluations=20))
    tau = found.predict(Trajectory(t, log.q, log.qd, log.tau, "gap"))
    assert np.isnan(tau[0]).all() and np.isfinite(tau[1:]).all()


def test_representation_of_a_fit():
    found = spelgen.fit(Model(), motions(), MomentumFit(momentum_steps=20))
    told = f"<Fit of 'Model' to momentum: finished, validation loss {found.best_validation:.3g}>"
    assert repr(found) == told
    assert "momentum steps" in found._repr_html_()


def test_a_torque_fit_states_its_error(tmp_path):
    log = swings(1)
    found = spelgen.fit(spelgen.load_module(write_module(tmp_path)), log, TorqueFit(evaluations=20))
    nmse = found.torque_nmse
    assert list(nmse) == list(found.model.joint_names)
    judged = spelgen.evaluate(found, log, steps=(1,), seconds=()).torque["model"]
    assert list(nmse.values()) == pytest.approx(judged.joint_nmse)
    assert found.result.startswith(f"torque nMSE {judged.mean_nmse:.3g}, at worst {judged.worst_nmse:.3g} (")
    found.save(tmp_path / "run")
    assert found.result in repr(spelgen.load_run(tmp_path / "run"))


@pytest.mark.parametrize("samples, preset", [(4, "spel"), (4, "closed-form"), (22, "phnode")])
def test_both_solvers_agree(tmp_path, samples, preset, monkeypatch):
    """Predictions and gradients of the rk4 and the dopri5 solver agree."""
    # tighter tolerances than the default: gradients near the onset of sliding are sensitive to integration errors
    monkeypatch.setitem(SOLVER, "rtol", 1e-9)
    monkeypatch.setitem(SOLVER, "atol", 1e-11)
    model = random_model("two_link", tmp_path, seed=0, preset=preset)
    torch.manual_seed(0)
    q, qd, tau = torch.rand(3, 5, samples, model.n, dtype=torch.float64)
    windows = Windows(0.01 + 0.01 * torch.rand(5, samples - 1).double(), q, qd, tau[:, 1:])
    scales, losses, gradients = loss_scales(windows, model.joint_types), [], []
    for solver, substeps in (("rk4", 8), ("dopri5", 1)):
        model.zero_grad()
        loss = rollout_loss(model, windows, scales, substeps, solver)
        loss.backward()
        losses.append(loss.item())
        found = [torch.zeros_like(x) if x.grad is None else x.grad for x in model.parameters()]
        gradients.append(torch.cat([x.flatten() for x in found]))
    assert losses[1] == pytest.approx(losses[0], rel=1e-5)
    torch.testing.assert_close(
        gradients[1], gradients[0], rtol=1e-3, atol=1e-5 * gradients[0].abs().max().item()
    )


def test_dopri5_is_the_exact_solution():
    windows = random_windows()
    pairs = zip(roll_out(Oscillator(), windows, solver="dopri5"), Oscillator().solve(windows), strict=True)
    assert max((got - exact).abs().max().item() for got, exact in pairs) < 1e-6


@pytest.mark.usefixtures("short_epochs")
def test_windows_are_fitted_by_dopri5():
    config = Rollout(epochs=2, momentum_steps=0, solver="dopri5", optimizer="lbfgs")
    found = spelgen.fit(Model(), motions(), config)
    plain = spelgen.fit(Model(), motions(), Rollout(epochs=2, momentum_steps=0, substeps=8))
    assert found.record.config.solver == "dopri5"
    assert found.best_validation == pytest.approx(plain.best_validation, rel=0.05)
    windows = cut_windows(motions(), 5, measured=False)
    scales = loss_scales(windows, ("revolute", "revolute"))
    assert rollout_loss(true_model(), windows, scales, 1, "dopri5") < 1e-12


@pytest.mark.usefixtures("short_epochs")
def test_the_tour_on_an_arm_with_a_joint_that_follows(tmp_path):
    """For an arm with a mimic joint, load, simulate, build, fit, evaluate and save work.

    Networks and rigid bodies are fitted, with the regularizer towards the URDF.
    """
    (tmp_path / "followed.urdf").write_text(FOLLOWED)
    arm = spelgen.load_arm(tmp_path / "followed.urdf")
    logs = spelgen.simulate(arm, trajectories=3, duration=1.0)
    for preset, config in (
        ("hybrid", Rollout(epochs=1, momentum_steps=20)),
        ("closed-form", Rollout(epochs=1, momentum_steps=0)),
    ):
        model = spelgen.build(arm, preset, width=8)
        found = spelgen.fit(model, logs, config, arm=arm)
        assert "no-regularizer" not in {note.code for note in found.diagnostics}
        folder = found.save(tmp_path / preset)
        assert (folder / "robot.urdf").read_text() == FOLLOWED
        loaded = spelgen.load_run(folder)
        assert loaded.urdf == folder / "robot.urdf"
        assert same(loaded.model, model)
