"""Logs above the memory limit: evenly spread segments of all files are kept, and fitted like any other logs."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import torch

from spelgen.emission.specify import generate
from spelgen.errors import LogError, RunError, SpelgenErrors
from spelgen.fitting.fit import RunOptions, fit
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.train import load_module, train
from spelgen.logs import read, segments
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_bounded_logs, read_logs, write_logs
from spelgen.logs.trajectory import QUANTITIES, Trajectory, split_at_gaps
from spelgen.settings.fits import Rollout

JOINTS = ("shoulder", "elbow")
MOTORS = ("joint1", "joint2")
ROW = 8 * 7  # [bytes] size of a row: t, and q, qd, tau of two joints
SEGMENT = 50


def recordings(count=8, samples=400, rate=100.0) -> list[Trajectory]:
    """Return logs of smooth motions at jittered sample times."""
    random = np.random.default_rng(0)
    found = []
    for number in range(count):
        t = np.cumsum((1 + 0.2 * random.uniform(-1, 1, samples)) / rate)
        speed = random.uniform(2, 5, 2)
        phase = t[:, None] * speed + random.uniform(0, 6, 2)
        found.append(Trajectory(t, np.sin(phase), speed * np.cos(phase), 3 * np.cos(phase), f"r{number}"))
    return found


def same(first: Trajectory, second: Trajectory) -> bool:
    return all(np.array_equal(getattr(first, x), getattr(second, x)) for x in ("t", *QUANTITIES))


@pytest.fixture
def bound(monkeypatch):
    """Return a function that sets the memory limit of kept samples, `TUNING.kept_bytes`, to a number of rows."""

    def set_bound(rows: int) -> None:
        tuning = replace(segments.TUNING, kept_bytes=ROW * rows, segment_samples=SEGMENT)
        for module in (read, segments):
            monkeypatch.setattr(module, "TUNING", tuning)

    return set_bound


@pytest.mark.parametrize("format", ["parquet", "csv"])
def test_logs_within_the_bound_are_read_whole(tmp_path, bound, format):
    write_logs(tmp_path / f"a.{format}", recordings(), JOINTS)
    bound(8 * 400)
    found, notes = read_bounded_logs([tmp_path], JOINTS)
    assert notes == []
    for expected, kept in zip(read_logs([tmp_path], JOINTS), found, strict=True):
        assert same(expected, kept) and expected.name == kept.name


@pytest.mark.parametrize("files", [1, 4])
@pytest.mark.parametrize("rows", [100, 700, 1599, 3199])
def test_kept_segments_are_evenly_spread_over_all_files(tmp_path, bound, files, rows):
    """Every k-th segment of consecutive rows of all files is kept, with the k for which they fit the memory limit.

    k is the smallest power of two that suffices.
    """
    logs = recordings()
    for number in range(files):
        share = len(logs) // files
        write_logs(tmp_path / f"f{number}.parquet", logs[number * share : (number + 1) * share], JOINTS)
    bound(rows)
    found, (note,) = read_bounded_logs([tmp_path], JOINTS)
    every = 2 ** int(np.ceil(np.log2(8 * 400 / rows)))
    assert (note.code, note.severity) == ("subsampled", "info")
    assert f"one of {every} segments" in note.message
    starts = []
    for kept in found:
        (number,) = (k for k, log in enumerate(logs) if log.name == kept.name)
        whole = logs[number]
        for piece in split_at_gaps(kept):
            first = int(np.searchsorted(whole.t, piece.t[0]))
            assert same(piece, whole[first : first + len(piece)])
            starts += range(400 * number + first, 400 * number + first + len(piece), SEGMENT)
    assert starts == list(range(0, 8 * 400, every * SEGMENT))
    assert sum(map(len, found)) == len(starts) * SEGMENT <= rows


def test_short_recordings_are_kept_whole_or_not_at_all(tmp_path, bound):
    logs = recordings(40, samples=30)
    write_logs(tmp_path / "a.parquet", logs, JOINTS)
    bound(400)
    found, _ = read_bounded_logs([tmp_path], JOINTS)
    assert [x.name for x in found] == [f"r{k}" for k in range(0, 40, 4)]
    assert all(same(kept, logs[4 * k]) for k, kept in enumerate(found))


def test_rows_of_recordings_need_not_lie_together(tmp_path, bound):
    write_logs(tmp_path / "plain.parquet", recordings(2), JOINTS)
    table = pa.parquet.read_table(tmp_path / "plain.parquet")
    order = np.arange(800).reshape(2, 400).T.ravel()
    pa.parquet.write_table(table.take(order), tmp_path / "mixed.parquet")
    bound(400)
    plain, mixed = (read_bounded_logs([tmp_path / f"{x}.parquet"], JOINTS) for x in ("plain", "mixed"))
    assert all(map(same, plain.trajectories, mixed.trajectories))
    assert sum(map(len, mixed.trajectories)) == 400


BROKEN = {
    "hole": (812, "qd_elbow", np.nan, r"row 813, column qd_elbow: got no finite number"),
    "back": (810, "t", 9.0, r"row 812, column t: got t = 0\.1\d* s after 9 s"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_errors_name_the_row_of_the_file(tmp_path, bound, case):
    row, column, value, message = BROKEN[case]
    write_logs(tmp_path / "a.parquet", recordings(), JOINTS)
    table = pa.parquet.read_table(tmp_path / "a.parquet")
    values = table[column].to_numpy().copy()
    values[row] = value
    table = table.set_column(table.column_names.index(column), column, pa.array(values))
    for name in ("b", "c"):
        pa.parquet.write_table(table, tmp_path / f"{name}.parquet")
    bound(1600)
    with pytest.raises(SpelgenErrors) as caught:
        read_bounded_logs([tmp_path / "b.parquet", tmp_path / "c.parquet"], JOINTS)
    assert len(caught.value.errors) == 2
    with pytest.raises(LogError, match=message):
        read_bounded_logs([tmp_path / "b.parquet"], JOINTS)


def test_windows_of_reduced_logs_cross_no_gap(tmp_path, bound):
    write_logs(tmp_path / "a.parquet", recordings(), JOINTS)
    bound(800)
    logs, _ = read_bounded_logs([tmp_path], JOINTS)
    pieces = Preprocessing(decimation=1).resolved([100.0]).pieces(logs, shortest=5)
    assert [len(x) for x in pieces] == [SEGMENT] * 16
    assert all(np.diff(x.t).max() < 0.013 for x in pieces)


def test_a_fit_of_reduced_logs_is_one_of_its_samples(robots, tmp_path, bound):
    """A fit to logs that exceed the memory bound (here 1600 rows) equals a fit to the kept samples in memory.

    Equal are the weights, the digest of the data and the split into training and validation. A resumed run uses the
    same samples, and refuses changed logs.
    """
    module = tmp_path / "arm.py"
    module.write_text(generate(robots / "two_link.urdf", preset="spel", width=4))
    write_logs(tmp_path / "train.parquet", recordings(), MOTORS)
    bound(1600)
    config = Rollout(epochs=2, momentum_steps=20, optimizer="adamw", batch=32, learning_rate=1e-2)
    found = train(module, [tmp_path / "train.parquet"], tmp_path / "run", config)
    logs, _ = read_bounded_logs([tmp_path / "train.parquet"], MOTORS)
    expected = fit(load_module(module), logs, config, folder=tmp_path / "other")
    assert "subsampled" in {note.code for note in found.diagnostics}
    first, second = (RunFolder(tmp_path / name).read_record() for name in ("run", "other"))
    assert first.data_digest == second.data_digest
    assert (first.training, first.validation) == (second.training, second.validation)
    for name, value in expected.model.state_dict().items():
        assert torch.equal(found.model.state_dict()[name], value), name
    resumed = train(module, [tmp_path / "train.parquet"], tmp_path / "run", options=RunOptions(resume=True))
    assert resumed.status == found.status
    write_logs(tmp_path / "train.parquet", recordings(9), MOTORS)
    with pytest.raises(RunError, match="data"):
        train(module, [tmp_path / "train.parquet"], tmp_path / "run", options=RunOptions(resume=True))


CHILD = """
import sys
from dataclasses import replace
from spelgen.logs import read, segments

def peak():  # [bytes] of this process: `ru_maxrss` counts the parent's, too
    lines = open("/proc/self/status").read().splitlines()
    return 1024 * next(int(x.split()[1]) for x in lines if x.startswith("VmHWM"))

folder, format, kept, function = sys.argv[1:]
segments.TUNING = read.TUNING = replace(read.TUNING, kept_bytes=int(kept))
joints = [f"j{k}" for k in range(7)]
read.read_bounded_logs([f"{folder}/small.{format}"], joints)  # what is loaded once
before = peak()
logs = getattr(read, function)([f"{folder}/{k}.{format}" for k in range(6)], joints)
print(peak() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
@pytest.mark.parametrize(("format", "rows", "files"), [("parquet", 120_000, 6), ("csv", 40_000, 6)])
def test_memory_is_bounded_by_the_largest_file_and_the_kept_samples(tmp_path, format, rows, files):
    """Peak memory is below three times the largest file plus four times the kept samples."""
    random, kept, joints = np.random.default_rng(0), 4_000_000, [f"j{k}" for k in range(7)]
    for number in range(files):
        log = Trajectory(np.arange(rows) / 1000.0, *random.standard_normal((3, rows, 7)))
        write_logs(tmp_path / f"{number}.{format}", [log], joints)
    small = Trajectory(np.arange(100) / 1000.0, *random.standard_normal((3, 100, 7)))
    write_logs(tmp_path / f"small.{format}", [small], joints)
    peaks = {}
    for function in ("read_bounded_logs", "read_logs"):
        command = [sys.executable, "-c", CHILD, str(tmp_path), format, str(kept), function]
        peaks[function] = int(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    largest = (tmp_path / f"0.{format}").stat().st_size
    assert peaks["read_bounded_logs"] < 3 * largest + 4 * kept
    # `read_logs` has no memory limit: its measured peak contains all samples
    assert peaks["read_logs"] > 8 * 22 * rows * files
