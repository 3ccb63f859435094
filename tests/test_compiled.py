"""Training with a compiled right-hand side: the same numbers as without, and one clear error where it cannot be."""

import json
import shutil

import pytest
import torch
from emitted import random_model
from torch._dynamo.utils import counters
from typer.testing import CliRunner

from spelgen.cli.main import app
from spelgen.fitting.compiled import compiled
from spelgen.fitting.rollout import loss_scales, rollout_loss
from spelgen.fitting.train import train
from spelgen.logs.read import write_logs
from spelgen.logs.windows import Windows
from tests.test_training import JOINTS, STAND_IN, motions, quick

has_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ to compile with")


@has_compiler
@pytest.mark.usefixtures("short_epochs")
def test_a_compiled_run_says_so_and_repeats_the_plain_one(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    write_logs(tmp_path / "train.parquet", motions(), JOINTS)
    torch._dynamo.reset()
    counters.clear()
    losses = {}
    for compile in (False, True):
        config = quick(epochs=2, momentum_steps=0, compile=compile)
        result = train(STAND_IN, [tmp_path / "train.parquet"], tmp_path / f"{compile}", config)
        metrics = (result.folder / "metrics.jsonl").read_text().splitlines()
        losses[compile] = [json.loads(line)["validation"] for line in metrics]
        assert compile == any(note.code == "compiled" for note in result.diagnostics)
    assert losses[True] == pytest.approx(losses[False], rel=1e-6)
    assert any((tmp_path / "cache").rglob("*.so"))
    assert counters["stats"]["unique_graphs"] == 1  # for the first state, a measured one, as for all


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU to record graphs on")
@pytest.mark.parametrize("preset", ["phnode", "hybrid"])
def test_on_a_gpu_graphs_are_replayed_with_the_same_result(preset, tmp_path):
    counters.clear()
    _gradients_of_both(random_model("two_link", tmp_path, seed=0, preset=preset), "cuda")
    assert counters["inductor"]["cudagraph_skips"] == 0


def _gradients_of_both(model, device="cpu"):
    """Three training steps' gradients are the same with the right-hand side compiled as without."""
    q, qd, tau = torch.rand(3, 16, 4, model.n, dtype=torch.float64)
    windows = Windows(torch.full((16, 3), 0.05, dtype=torch.float64), q, qd, tau[:, 1:])
    scales = loss_scales(windows, model.joint_types).to(device)
    model, windows = model.to(device), windows.to(device)
    ready = compiled(model, windows, scales)
    for step in range(3):
        with torch.no_grad():
            for weights in model.parameters():
                weights += 0.01 * step
        found = []
        for stepped in (model, ready):
            model.zero_grad()
            rollout_loss(stepped, windows, scales, 1).backward()
            found.append(torch.cat([x.grad.flatten() for x in model.parameters() if x.grad is not None]))
        assert found[1].cpu().numpy() == pytest.approx(found[0].cpu().numpy(), rel=1e-6, abs=1e-9)


def test_without_a_compiler_one_error_says_what_to_do_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(
        "torch._inductor.config.cpp.cxx", (None, "no-such-compiler")
    )  # as CXX in the environment
    torch._dynamo.reset()
    write_logs(tmp_path / "train.parquet", motions(), JOINTS)
    done = CliRunner().invoke(
        app,
        ["train", str(STAND_IN), "--data", "train.parquet", "-o", "run",
         "--set", "compile=true", "--set", "epochs=1", "--set", "momentum_steps=0", "--quiet"],
    )  # fmt: skip
    assert done.exit_code == 1
    (told,) = done.stderr.splitlines()
    assert told.startswith("a right-hand side that torch cannot compile (")
    assert "no-such-compiler" in told
    assert told.endswith("; install a C++ compiler (g++), or train without compile=true")
    assert not (tmp_path / "run").exists()
