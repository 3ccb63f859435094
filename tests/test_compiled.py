"""Training with a compiled right-hand side: the same numbers as without, and one clear error where it cannot be."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from spelgen.data.logs import write_logs
from spelgen.training.train import train
from tests.test_training import JOINTS, QUICK, STAND_IN, motions

has_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ to compile with")


@has_compiler
def test_a_compiled_run_says_so_and_repeats_the_plain_one(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    write_logs(tmp_path / "train.parquet", motions(), JOINTS)
    losses = {}
    for compile in (False, True):
        config = replace(QUICK, epochs=2, momentum_steps=0, compile=compile)
        result = train(
            STAND_IN, [tmp_path / "train.parquet"], tmp_path / f"{compile}", config, progress=False
        )
        metrics = (result.folder / "metrics.jsonl").read_text().splitlines()
        losses[compile] = [json.loads(line)["validation"] for line in metrics]
        assert compile == any(note.code == "compiled" for note in result.diagnostics)
    assert losses[True] == pytest.approx(losses[False], rel=1e-6)
    assert any((tmp_path / "cache").rglob("*.so"))


def test_without_a_compiler_one_error_says_what_to_do_and_nothing_is_written(tmp_path):
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
