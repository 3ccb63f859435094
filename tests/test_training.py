"""Training reaches exact solutions, resumes exactly, recovers from divergence and handles interruptions."""

import io
import json
import math
import multiprocessing
import os
import re
import signal
import time
import types
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from planar_model import JOINTS, Model, true_model, write_module
from rich.console import Console

from spelgen.emission.assemble import load_module
from spelgen.emission.text import read_spec
from spelgen.errors import LogError, ModuleError, RunError
from spelgen.evaluation.evaluate import evaluate, read_test_logs
from spelgen.fitting.dataset import FitRequest, TrainingData, prepare_data
from spelgen.fitting.fit import RunOptions, fit
from spelgen.fitting.optimizers import LBFGS, MiniBatchAdamW
from spelgen.fitting.process import TrainingProgress
from spelgen.fitting.rollout import (
    choose_substeps,
    integration_error,
    loss_scales,
    momentum_loss,
    position_difference,
    probed,
    roll_out,
    rollout_loss,
)
from spelgen.fitting.rollout_objective import RolloutObjective
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.fitting.train import train
from spelgen.fitting.tuning import FittingTuning
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import Trajectory, read_logs, write_logs
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.fits import MomentumFit, Rollout
from spelgen.settings.log_mapping import LogMapping

ADAMW = {"optimizer": "adamw", "batch": 32, "learning_rate": 1e-2}
QUICK = Rollout(epochs=6, momentum_steps=20, **ADAMW)


def quick(**changed) -> Rollout:
    """Return the options `QUICK` with changes; batch and learning_rate are omitted for optimizers other than AdamW."""
    options = QUICK.model_dump(exclude_unset=True) | changed
    if options["optimizer"] != "adamw":
        options = {name: x for name, x in options.items() if name not in ("batch", "learning_rate")}
    return Rollout(**options)


def motions(count=6, samples=21, seed=0, rate=20.0) -> list[Trajectory]:
    """Return trajectories of the true arm under random piecewise constant torques, at jittered times."""
    return list(_motions(count, samples, seed, rate))


@cache
def _motions(count: int, samples: int, seed: int, rate: float) -> tuple[Trajectory, ...]:
    random = torch.Generator().manual_seed(seed)
    dt = (0.8 + 0.4 * torch.rand(count, samples - 1, generator=random, dtype=torch.float64)) / rate
    q = 4 * torch.rand(count, 1, 2, generator=random, dtype=torch.float64) - 2
    tau = torch.randint(-2, 3, (count, samples, 2), generator=random).double()
    start = Windows(dt, q.expand(-1, samples, -1), torch.zeros(count, samples, 2).double(), tau[:, :-1])
    predicted_q, predicted_qd = roll_out(true_model(), start, 16)
    t = torch.cat([torch.zeros(count, 1), dt.cumsum(dim=1)], dim=1)
    positions = torch.cat([q, predicted_q], dim=1)
    velocities = torch.cat([torch.zeros(count, 1, 2), predicted_qd], dim=1)
    rows = zip(t.numpy(), positions.numpy(), velocities.numpy(), tau.numpy(), strict=True)
    return tuple(Trajectory(*row, name=f"motion_{k}") for k, row in enumerate(rows))


@pytest.fixture(scope="module")
def module(tmp_path_factory) -> Path:
    """Write the module of the planar arm; return its path."""
    return write_module(tmp_path_factory.mktemp("module"))


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "train.parquet"
    write_logs(path, motions(), JOINTS)
    return path


def lines(folder: Path) -> list[dict]:
    """Return the lines of metrics.jsonl without durations."""
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in record.items() if key != "seconds"} for record in records]


class Oscillator:
    """n joints on springs, q'' = -w^2 q + tau, whose exact solution consists of sines and cosines."""

    joint_types = ("revolute", "prismatic")
    frequency = torch.tensor([2.0, 5.0], dtype=torch.float64)

    def at(self, q, prepared=None):
        return q

    def momentum(self, q, qd):
        return qd

    def velocity(self, q, p):
        return p

    def prepare(self):
        return None

    def port_hamiltonian_rhs(self, q, p, tau, prepared, z=None):
        return p, tau - self.frequency**2 * q

    def solve(self, windows: Windows):
        q, p, states = windows.q[:, 0], windows.qd[:, 0], []
        w = self.frequency
        for dt, tau in zip(windows.dt.unbind(1), windows.tau.unbind(1), strict=True):
            c, s, rest = torch.cos(w * dt[:, None]), torch.sin(w * dt[:, None]), tau / w**2
            q, p = rest + (q - rest) * c + p / w * s, p * c - w * (q - rest) * s
            states.append((q, p))
        return tuple(torch.stack(part, dim=1) for part in zip(*states, strict=True))


def random_windows(count=3, samples=6, seed=0) -> Windows:
    random = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=random, dtype=torch.float64)  # noqa: E731
    dt = 0.02 + 0.02 * torch.rand(count, samples - 1, generator=random, dtype=torch.float64)
    return Windows(dt, draw(count, samples, 2), draw(count, samples, 2), draw(count, samples - 1, 2))


def test_a_rollout_is_the_exact_solution_at_jittered_times():
    windows = random_windows()
    errors = []
    for substeps in (1, 2, 4):
        pairs = zip(roll_out(Oscillator(), windows, substeps), Oscillator().solve(windows), strict=True)
        errors.append(max((got - exact).abs().max().item() for got, exact in pairs))
    assert errors[2] < 1e-7
    # halving the step divides the error of rk4, of fourth order, by 16
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.3)


@pytest.mark.parametrize("angle", [0.0, 0.3, -3.0, 3.2, 2 * math.pi - 0.1, -20.0])
def test_the_geodesic_distance_is_that_of_the_rotation_matrices(angle):
    turned = torch.tensor([0.4 + angle, 0.4 + angle], dtype=torch.float64)
    distance = position_difference(turned, torch.full_like(turned, 0.4), ("revolute", "prismatic"))
    axis = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    matrix = torch.linalg.matrix_exp(angle * axis)
    assert distance[0].abs().item() == pytest.approx(math.acos((matrix.trace().item() - 1) / 2), abs=1e-7)
    assert distance[1].item() == pytest.approx(angle)


def test_the_true_model_has_no_loss():
    windows = cut_windows(motions(), 5, measured=False)
    scales = loss_scales(windows, ("revolute", "revolute"))
    assert rollout_loss(true_model(), windows, scales, 4) < 1e-12
    assert rollout_loss(Model(), windows, scales, 4) > 0.1


def test_the_weak_form_tends_to_zero_with_the_step():
    """The momentum loss of the true model decreases with the square of dt, the error of the trapezium rule."""
    losses = []
    for rate in (200.0, 100.0):
        windows = cut_windows(motions(rate=rate), 2, measured=False)
        scales = loss_scales(windows, ("revolute", "revolute"))
        losses.append(momentum_loss(true_model(), windows, scales).sqrt().item())
    assert losses[0] < 0.01
    assert losses[0] / losses[1] < 0.4


def test_a_prediction_of_no_motion_has_the_loss_one(monkeypatch):
    def still(model, windows, substeps, solver):
        return tuple(x[:, :1].expand_as(x[:, 1:]) for x in (windows.q, windows.qd))

    monkeypatch.setattr("spelgen.fitting.rollout.roll_out", still)
    model, windows = Model(), cut_windows(motions(), 5, measured=False)
    assert rollout_loss(model, windows, loss_scales(windows, model.joint_types), 1) == pytest.approx(1.0)


def test_stiff_friction_gets_more_substeps():
    model = true_model()
    windows = cut_windows(motions(), 5, measured=False)
    scales = loss_scales(windows, model.joint_types)
    gentle = choose_substeps(model, windows, scales)
    # friction with a time constant of a few milliseconds, for samples that are 50 ms apart
    model.friction.log += 5.0
    stiff = choose_substeps(model, windows, scales)
    assert gentle < stiff
    once, twice, fine, finer = (probed(model, windows, scales, k) for k in (1, 2, stiff, 2 * stiff))
    assert integration_error(fine, finer) < 0.03 <= integration_error(once, twice)


def test_training_finds_the_true_parameters():
    """Training finds the true parameters of a user's own model class, which no specification of spelgen describes."""
    model = Model()
    result = fit(model, motions(), quick(epochs=15, momentum_steps=200))
    assert result.status == "finished"
    assert result.best_validation < 1e-4
    for name, value in true_model().state_dict().items():
        torch.testing.assert_close(model.state_dict()[name], value, atol=0.05, rtol=0)


def test_the_run_folder_records_the_training(module, logs, tmp_path):
    result = train(module, [logs], tmp_path / "run", quick(epochs=2))
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {
        "spec.json",
        "config.json",
        "metrics.jsonl",
        "checkpoint.pt",
        "model.pt",
    }
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["joints"] == list(JOINTS)
    assert set(config["training"]).isdisjoint(config["validation"])
    assert len(config["training"]) + len(config["validation"]) == 6
    assert (
        [record["epoch"] for record in lines(tmp_path / "run")] == [1, 2] == list(range(1, result.epochs + 1))
    )
    weights = load_module(module).parameters()
    assert result.parameters == sum(weight.numel() for weight in weights)
    assert read_spec(module).to_json() == (tmp_path / "run" / "spec.json").read_text().strip()


class Interrupted(TrainingProgress):
    """Progress that raises KeyboardInterrupt after three epochs, as Ctrl-C does."""

    def epoch(self, record, epochs):
        if record["epoch"] == 3:
            raise KeyboardInterrupt


@pytest.mark.parametrize(("optimizer", "steps"), [("adamw", 8), ("lbfgs", 3)])
def test_a_resumed_training_equals_an_uninterrupted_one(
    module, logs, tmp_path, monkeypatch, optimizer, steps
):
    monkeypatch.setattr("spelgen.fitting.momentum_objective.TUNING", FittingTuning(epoch_steps=steps))
    config = quick(optimizer=optimizer, momentum_steps=20 if optimizer == "adamw" else 0)
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    train(module, [logs], straight, config)
    with monkeypatch.context() as patch:
        patch.setattr("spelgen.fitting.fit.TrainingProgress", Interrupted)
        assert train(module, [logs], broken, config).status == "interrupted"
    assert len(lines(broken)) == 3
    result = train(module, [logs], broken, config, options=RunOptions(resume=True))
    assert result.status == "finished"
    assert len(lines(straight)) > 3
    assert lines(broken) == lines(straight)
    for name in ("checkpoint.pt", "model.pt"):
        first, second = (torch.load(folder / name, weights_only=True) for folder in (straight, broken))
        first.pop("seconds", None), second.pop("seconds", None)
        assert equal(first, second)


def equal(first, second) -> bool:
    """Return True if two nested states are bitwise equal."""
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(first[key], second[key]) for key in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(equal, first, second))
    return first == second


@pytest.mark.usefixtures("short_epochs")
def test_resuming_drops_epochs_after_the_checkpoint(module, logs, tmp_path):
    train(module, [logs], tmp_path / "run", QUICK)
    with (tmp_path / "run" / "metrics.jsonl").open("a") as file:
        # the last line is incomplete, as of a process that was killed while writing
        file.write('{"epoch": 7, "step')
    train(module, [logs], tmp_path / "run", QUICK, options=RunOptions(resume=True))
    assert [record["epoch"] for record in lines(tmp_path / "run")] == [1, 2, 3, 4, 5, 6]


def test_a_diverging_training_is_rolled_back_at_half_the_rate(module, logs, tmp_path, monkeypatch):
    calls = []

    def blown_up_once(model, windows, scales, substeps, solver):
        loss = rollout_loss(model, windows, scales, substeps)
        calls.append(torch.is_grad_enabled())
        return loss * math.nan if sum(calls) == 25 and calls[-1] else loss

    monkeypatch.setattr("spelgen.fitting.rollout_objective.rollout_loss", blown_up_once)
    result = train(module, [logs], tmp_path / "run", QUICK)
    records = lines(tmp_path / "run")
    assert result.status == "finished"
    assert [record["rollbacks"] for record in records] == [0, 1, 1, 1, 1, 1]
    assert [record["step"] for record in records] == [20, 40, 60, 80, 100, 120]
    assert all(math.isfinite(record["loss"]) for record in records)


@pytest.mark.usefixtures("short_epochs")
@pytest.mark.parametrize("optimizer", ["adamw", "lbfgs"])
def test_a_training_that_never_recovers_ends(module, logs, tmp_path, monkeypatch, optimizer):
    def blown_up(model, windows, scales, substeps, solver):
        loss = rollout_loss(model, windows, scales, substeps)
        return loss * math.nan if torch.is_grad_enabled() else loss

    monkeypatch.setattr("spelgen.fitting.rollout_objective.rollout_loss", blown_up)
    with pytest.raises(RunError) as caught:
        train(module, [logs], tmp_path / "run", quick(optimizer=optimizer))
    assert str(caught.value) == (
        f"{tmp_path}/run: losses that are not finite, after 8 attempts at half the learning rate each; "
        "check units and signs of the logs; the best model so far is kept in model.pt"
    )


@pytest.mark.usefixtures("short_epochs")
def test_mapped_logs_train_as_plain_ones_do(module, logs, tmp_path):
    plain = train(module, [logs], tmp_path / "plain", QUICK)
    names = {"t": "ms", "trajectory": "run", "q": "pos {joint}", "qd": "vel {joint}", "tau": "cur {joint}"}
    text = {
        "columns": names,
        "units": {"t": "ms", "q": "turns", "tau": "A"},
        "joints": {"shoulder": {"name": "J1", "gain": 8.0, "sign": -1}, "elbow": {"gain": 0.5}},
    }
    columns = {"run": [x.name for x in motions() for _ in x.t]}
    columns["ms"] = np.concatenate([1000 * x.t for x in motions()])
    for k, (joint, sign, gain) in enumerate([("J1", -1, 8.0), ("elbow", 1, 0.5)]):
        for name, factor in (("q", sign / (2 * np.pi)), ("qd", sign), ("tau", sign / gain)):
            values = np.concatenate([getattr(x, name)[:, k] for x in motions()])
            columns[names[name].replace("{joint}", joint)] = factor * values
    np.savez(tmp_path / "train.npz", **columns)
    mapping = LogMapping.model_validate(text)
    mapped = train(
        module, [tmp_path / "train.npz"], tmp_path / "run", QUICK, options=RunOptions(mapping=mapping)
    )
    assert mapped.best_validation == pytest.approx(plain.best_validation, rel=1e-6)
    again = train(
        module,
        [tmp_path / "train.npz"],
        tmp_path / "run",
        quick(epochs=7),
        options=RunOptions(resume=True),
    )
    assert again.epochs == 7
    assert (
        evaluate(tmp_path / "run", read_test_logs(tmp_path / "run", [tmp_path / "train.npz"])).trajectories[0]
        == "motion_0"
    )


def test_early_stop_and_time_limit(module, logs, tmp_path):
    stuck = quick(learning_rate=1e-30, patience=2, momentum_steps=0)
    result = train(module, [logs], tmp_path / "stuck", stuck)
    assert (result.status, result.epochs) == ("stopped early", 2)
    for momentum_steps in (0, 1000):
        hurried = quick(max_minutes=1e-6, momentum_steps=momentum_steps)
        result = train(module, [logs], tmp_path / f"late{momentum_steps}", hurried)
        assert (result.status, result.epochs) == ("out of time", 0)


def until_a_signal(module: Path, logs: Path, folder: Path) -> None:
    """Train in a child process until a signal stops it; write the result's status, such as "interrupted", to a file.

    The file `told` is next to the run folder `folder`, and also gets the process's stderr. module: file of the emitted
    module. logs: file of the training logs.
    """
    # the tests may run with SIGINT ignored, which the process inherits
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with folder.with_name("told").open("w") as told:
        os.dup2(told.fileno(), 2)
        config = Rollout(epochs=100000, batch=32, patience=100000, momentum_steps=0, optimizer="adamw")
        told.write(train(module, [logs], folder, config).status)


@pytest.mark.usefixtures("short_epochs")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_is_usable_after_a_signal(module, logs, tmp_path, number):
    folder = tmp_path / "run"
    child = multiprocessing.get_context("fork").Process(target=until_a_signal, args=(module, logs, folder))
    child.start()
    deadline = time.monotonic() + 60
    while not (folder / "metrics.jsonl").exists() and child.is_alive() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(child.pid, number)
    child.join(timeout=30)
    told = (tmp_path / "told").read_text()
    assert child.exitcode == 0, told
    assert told.endswith("interrupted")
    assert "Traceback" not in told
    fitted_model(RunFolder(folder))
    epoch = torch.load(folder / "checkpoint.pt", weights_only=True)["epoch"]
    config = Rollout(epochs=epoch + 1, batch=32, patience=100000, momentum_steps=0, optimizer="adamw")
    assert train(module, [logs], folder, config, options=RunOptions(resume=True)).epochs == epoch + 1
    assert not list(folder.glob(".*"))  # no temporary file remains


def test_a_run_is_not_overwritten_unasked(module, logs, tmp_path):
    config = quick(epochs=1)
    train(module, [logs], tmp_path / "run", config)
    before = (tmp_path / "run" / "model.pt").read_bytes()
    with pytest.raises(RunError) as caught:
        train(module, [logs], tmp_path / "run", config)
    assert str(caught.value) == (
        f"{tmp_path}/run: there is a run in this folder; --resume it, --force to replace it, or -o another"
    )
    assert (tmp_path / "run" / "model.pt").read_bytes() == before
    train(module, [logs], tmp_path / "run", config, of_logs={"seed": 5}, options=RunOptions(force=True))
    assert json.loads((tmp_path / "run" / "config.json").read_text())["seed"] == 5


def test_a_run_is_resumed_only_as_it_was_started(module, logs, tmp_path):
    train(module, [logs], tmp_path / "run", quick(epochs=1))
    with pytest.raises(RunError) as caught:
        train(
            module,
            [logs],
            tmp_path / "run",
            quick(batch=16),
            of_logs={"seed": 1},
            options=RunOptions(resume=True),
        )
    assert str(caught.value) == (
        f"{tmp_path}/run: got batch 16 instead of 32, seed 1 instead of 0, "
        "expected the settings the run was started with; or start a new run"
    )
    write_logs(tmp_path / "other.parquet", motions(seed=1), JOINTS)
    with pytest.raises(RunError) as caught:
        train(module, [tmp_path / "other.parquet"], tmp_path / "run", QUICK, options=RunOptions(resume=True))
    assert str(caught.value) == (
        f"{tmp_path}/run: other logs than the run was started with; give the same --data or start a new run"
    )
    with pytest.raises(RunError) as caught:
        train(module, [logs], tmp_path / "none", QUICK, options=RunOptions(resume=True))
    assert str(caught.value) == (
        f"{tmp_path}/none: got no such run, expected a folder with config.json; make one with `spelgen train`"
    )


def test_nothing_is_written_when_the_logs_are_bad(module, tmp_path):
    (tmp_path / "bad.csv").write_text("t,q_shoulder\n0,0\n")
    with pytest.raises(LogError):
        train(module, [tmp_path / "bad.csv"], tmp_path / "run", QUICK)
    assert not (tmp_path / "run").exists()


def test_a_changed_urdf_stays_out_of_the_run(logs, tmp_path):
    module = write_module(tmp_path)
    (tmp_path / "planar.urdf").write_text("<robot/>")
    result = train(module, [logs], tmp_path / "run", quick(epochs=1))
    assert "changed-urdf" in [note.code for note in result.diagnostics]
    assert not (tmp_path / "run" / "robot.urdf").exists()
    with pytest.raises(
        ModuleError, match="another URDF than the module was built from; build the module again"
    ):
        train(module, [logs], tmp_path / "new", QUICK, urdf=tmp_path / "planar.urdf")
    assert not (tmp_path / "new").exists()


def prepared(logs: Path) -> TrainingData:
    return prepare_data(request_of(logs, QUICK), 5, 1)


def request_of(logs: Path, config: Rollout) -> FitRequest:
    return FitRequest(
        Model(), read_logs([logs], JOINTS), config, Preprocessing(), 0.25, 0, None, RunOptions(),
        time.monotonic(), None,
    )  # fmt: skip


def loop_of(logs: Path, config: Rollout) -> RolloutObjective:
    loop = RolloutObjective(request_of(logs, config))
    loop.prepare()
    loop.begin()
    loop._start_clock()
    return loop


def test_validation_windows_come_from_other_trajectories(logs):
    data = prepared(logs)
    seen = {tuple(row) for row in data.training.q.flatten(0, 1).tolist()}
    assert not any(tuple(row) in seen for row in data.validation.q.flatten(0, 1).tolist())
    assert len(data.training) + len(data.validation) == 6 * 17


def test_the_learning_rate_rises_and_falls(logs, tmp_path):
    loop = loop_of(logs, QUICK)
    rates = []
    for step in range(QUICK.epochs * loop.epoch_steps):
        loop.step = step
        rates.append(loop._rate())
    peak = int(np.argmax(rates))
    assert max(rates) == pytest.approx(QUICK.learning_rate, rel=0.01)
    assert peak < 0.05 * len(rates)
    assert rates[0] < 0.1 * max(rates)
    assert rates[-1] == pytest.approx(0.01 * QUICK.learning_rate, rel=0.1)


def test_few_windows_are_taken_all_at_once():
    """By default, L-BFGS trains on few windows as one batch, and AdamW on many windows.

    L-BFGS has a weight decay of its own.
    """
    config = Rollout(momentum_steps=0, epochs=6)
    assert config.resolved(100).record(rigid_bodies=False).keys() & {"batch", "learning_rate"} == set()
    assert (config.resolved(100).optimizer, config.resolved(100).weight_decay) == ("lbfgs", 2e-5)
    resolved = config.resolved(5000)
    assert (resolved.optimizer, resolved.batch, resolved.learning_rate) == ("adamw", 256, 1e-3)
    assert resolved.weight_decay == 0.2
    assert Rollout(weight_decay=0.5).resolved(100).weight_decay == 0.5
    losses = {}
    for optimizer in ("adamw", "lbfgs"):
        found = fit(Model(), motions(), quick(momentum_steps=0, optimizer=optimizer))
        losses[optimizer] = found.history[-1]["best"]
    assert losses["lbfgs"] < 0.5 * losses["adamw"]


def test_the_line_search_turns_back_from_numbers_that_blow_up():
    """L-BFGS shortens a step that ends where the loss is NaN, until the loss is finite.

    The loss is finite below x = 2, and the first step would reach x = 4.
    """
    model = torch.nn.Module()
    model.x = torch.nn.Parameter(torch.tensor([0.0], dtype=torch.float64))
    tried = []

    def loss(_):
        tried.append(model.x.item())
        value = (model.x - 1.9).square().sum()
        return value if model.x.item() < 2 else value * math.nan

    whole = LBFGS(model, 0.0)
    group = whole._optimizer.param_groups[0]
    group["lr"] = 4.0
    assert whole.run(loss, None, 30, lambda _: 1.0) < 1e-12
    assert max(tried) >= 2


def test_the_objective_momentum_predicts_no_windows():
    result, start = (fit(Model(), motions(), MomentumFit(momentum_steps=k, **ADAMW)) for k in (200, 1))
    assert (result.status, result.epochs, result.checkpoint.step) == ("finished", 0, 0)
    assert result.best_validation < 0.5 * start.best_validation


@pytest.mark.parametrize("show", [False, True])
def test_progress_without_a_terminal_is_a_line_for_each_stage(show, capsys):
    with TrainingProgress(show=show) as progress:
        for step in (10, 20):
            progress.momentum(step, 20, 0.7)
        progress.epoch(
            {"epoch": 1, "step": 20, "seconds": 1.0, "loss": 0.5, "validation": 0.4, "best": 0.4}, 2
        )
    printed = capsys.readouterr()
    told = (
        "momentum: 20 steps, loss 0.7\ntraining: 1 epoch, loss 0.5, validation 0.4, best 0.4, 20.0 steps/s\n"
    )
    assert (printed.out, printed.err) == ("", told if show else "")


def test_progress_on_a_terminal_is_one_line_of_80_columns(monkeypatch):
    screen = io.StringIO()
    console = Console(file=screen, width=80, force_terminal=True, legacy_windows=False)
    monkeypatch.setattr("spelgen.fitting.process.Console", lambda **options: console)
    with TrainingProgress(show=True) as progress:
        progress.momentum(1900, 2000, 1.234e-5)
        losses = {"loss": 1.234e-5, "validation": 1.234e-5, "best": 1.234e-5}
        progress.epoch({"epoch": 399, "step": 8000, "seconds": 1.0, **losses}, 400)
        progress._bar.refresh()
    shown = [
        line
        for line in re.split(r"[\r\n]+", re.sub(r"\x1b\[[^A-Za-z]*[A-Za-z]", "", screen.getvalue()))
        if line
    ]
    assert max(map(len, shown)) <= 80
    assert any(
        re.fullmatch(r"training .* 399/400 .* validation 1.23e-05, best 1.23e-05 *", line) for line in shown
    )


def test_the_allowed_time_is_kept_within_an_epoch(logs, monkeypatch):
    """The time limit of a training ends it within an epoch.

    By a clock that advances 20 ms per step, an epoch of a million steps would take hours.
    """
    now = [100.0]
    monkeypatch.setattr(
        "spelgen.fitting.momentum_objective.time", types.SimpleNamespace(monotonic=lambda: now[0])
    )
    run = MiniBatchAdamW.run

    def slow(self, loss, windows, steps, rate):
        now[0] += 0.02 * steps
        return run(self, loss, windows, min(steps, 2), rate)

    monkeypatch.setattr(MiniBatchAdamW, "run", slow)
    config = quick(epochs=10**6, patience=10**6, max_minutes=1.0, momentum_steps=0)
    loop = loop_of(logs, config)
    loop.seconds = 12.0
    loop.epoch_steps = 10**6
    with TrainingProgress(show=False) as progress:
        assert loop.run(progress, lambda: None) == "out of time"
    assert 0.95 * 60 < now[0] - 100.0 + 12.0 <= 1.05 * 60
    assert loop.epoch < 10
