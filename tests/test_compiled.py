"""Training with a compiled right-hand side: the same numbers as without, and one clear error where it cannot be."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from spelgen.data.windows import cut_windows
from spelgen.training.compiled import compiled
from spelgen.training.rollout import loss_scales, rollout_loss
from spelgen.training.runs import load_model
from tests.test_training import JOINTS, STAND_IN, motions

has_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ to compile with")


@has_compiler
def test_a_compiled_model_gives_the_same_loss_and_gradient(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    plain, other = load_model(STAND_IN), load_model(STAND_IN)
    windows = cut_windows(motions(), 5, measured=False)
    scales = loss_scales(windows, plain.joint_types)
    ready = compiled(other, windows, scales)
    assert all(x.grad is None for x in other.parameters())
    assert ready.joint_types == plain.joint_types
    for model in (plain, ready):
        rollout_loss(model, windows, scales, 2).backward()
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] >= 1
    for one, two in zip(plain.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(one.grad, two.grad, rtol=1e-9, atol=1e-12)


def test_without_a_compiler_one_error_says_what_to_do_and_nothing_is_written(tmp_path):
    from spelgen.data.logs import write_logs

    write_logs(tmp_path / "train.parquet", motions(), JOINTS)
    done = subprocess.run(
        [sys.executable, "-m", "spelgen", "train", str(STAND_IN), "--data", "train.parquet", "-o", "run",
         "--compile", "--epochs", "1", "--momentum-steps", "0", "--quiet"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "CXX": "no-such-compiler",
             "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache")},
    )  # fmt: skip
    assert done.returncode == 1
    (told,) = done.stderr.splitlines()
    assert told.startswith("a right-hand side that torch cannot compile (")
    assert "no-such-compiler" in told
    assert told.endswith("; install a C++ compiler (g++), or train without --compile")
    assert not (tmp_path / "run").exists()
