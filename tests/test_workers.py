"""Processes that fit together are one: the same losses and weights, and one of them writes."""

import json
import os
import socket
from pathlib import Path

import pytest
import torch
import torch.multiprocessing as mp

from spelgen.building import build
from spelgen.emission.loading import load_module
from spelgen.fitting import loop, workers
from spelgen.fitting.fit import fit
from spelgen.loaded_arm import load_arm
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.windows import Windows
from spelgen.settings.fits import Rollout, TorqueFit
from spelgen.simulation.simulate import simulate

JOINTS = ("joint1", "joint2")
CONFIGS = {
    "networks": Rollout(
        optimizer="adamw", batch=32, stride=4, epochs=3, patience=3, momentum_steps=6, substeps=1
    ),
    "torque": TorqueFit(),
}


def fitted(folder: Path, name: str, run: str) -> None:
    """Fit a module to the logs beside it, into a run folder."""
    model = load_module(folder / f"{name}.py")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "EPOCH_STEPS", 6)
        fit(model, read_logs([folder / "logs.parquet"], JOINTS), CONFIGS[name], folder=folder / run)


def one_of_two(rank: int, folder: Path, port: int) -> None:
    """What torchrun starts."""
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "RANK": str(rank)}
    os.environ |= address
    torch.set_num_threads(1)
    with workers.group("cpu") as device:
        assert device == "cpu"
        for name in CONFIGS:
            fitted(folder, name, f"{name}-two")


@pytest.fixture(scope="module")
def folder(robots, tmp_path_factory):
    """Run folders of one process, and of two together."""
    found = tmp_path_factory.mktemp("workers")
    arm = load_arm(robots / "two_link.urdf")
    logs = simulate(arm, trajectories=6, sample_rate=100.0, test_fraction=0.0)
    write_logs(found / "logs.parquet", logs.train, JOINTS)
    for name, preset in {"networks": "phnode", "torque": "closed-form"}.items():
        (found / f"{name}.py").write_text(build(arm, preset, width=4, depth=1).source)
        fitted(found, name, f"{name}-one")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    mp.spawn(one_of_two, (found, port), nprocs=2)
    return found


def test_two_processes_take_the_steps_of_one(folder):
    one, two = (
        [json.loads(line) for line in (folder / run / "metrics.jsonl").read_text().splitlines()]
        for run in ("networks-one", "networks-two")
    )
    assert [x["step"] for x in one] == [x["step"] for x in two] == [6, 12, 18]
    for key in ("loss", "validation"):
        assert [x[key] for x in two] == pytest.approx([x[key] for x in one], abs=1e-12)


def test_two_processes_fit_torques_as_one(folder):
    one, two = (torch.load(folder / run / "model.pt") for run in ("torque-one", "torque-two"))
    for name in one:
        torch.testing.assert_close(two[name], one[name], rtol=0, atol=1e-10)


@pytest.mark.parametrize("counts", [(3, 3, 3, 3), (9, 1, 1, 1), (1, 1, 9), (5,), (2, 0, 7)])
def test_shards_hold_every_window_once(counts, monkeypatch):
    size = sum(counts)
    column = torch.arange(size, dtype=torch.float64)
    windows = Windows(column[:, None], *(column[:, None, None] for _ in range(3)))
    rows = torch.randperm(size, generator=torch.Generator().manual_seed(0))[: size - 1]
    kept, drawn, shares = [], [], 0.0
    monkeypatch.setattr(workers, "count", lambda: 2)
    for rank in range(2):
        monkeypatch.setattr(workers, "rank", lambda rank=rank: rank)
        own = workers.shard(windows, counts)
        assert len(own) == size
        kept += own.q.flatten().tolist() if own.share else []
        part = own[rows]
        drawn += part.q.flatten().tolist() if part.share else []
        shares += part.share
    assert sorted(kept) == column.tolist()
    assert sorted(drawn) == sorted(rows.tolist())
    assert shares == pytest.approx(1.0)
