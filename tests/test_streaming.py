"""Logs larger than memory: the same samples and windows as in memory, for torque fits alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from spelgen.errors import LogError
from spelgen.fitting.dataset import WindowChoice, prepare_data
from spelgen.fitting.streaming import LargeLogs, prepare_streamed
from spelgen.fitting.train import train
from spelgen.logs import chunks
from spelgen.logs.chunks import large_files, scan
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.tables import UNIT_CODES
from spelgen.logs.trajectory import QUANTITIES, Trajectory
from spelgen.settings.fits import Rollout
from spelgen.settings.log_mapping import LogMapping

STAND_IN = Path(__file__).with_name("planar_model.py")
JOINTS = ("shoulder", "elbow")
KINDS = ("revolute", "revolute")
EVERY_OTHER, AUTOMATIC = Preprocessing(decimation=2), Preprocessing()


def recordings(count=8, samples=400, rate=100.0) -> list[Trajectory]:
    """Smooth motion at jittered times, one with a gap."""
    random = np.random.default_rng(0)
    found = []
    for number in range(count):
        t = np.cumsum((1 + 0.2 * random.uniform(-1, 1, samples)) / rate)
        t[samples // 2 :] += 0.5 * (number == 3)
        speed = random.uniform(2, 5, 2)
        phase = t[:, None] * speed + random.uniform(0, 6, 2)
        found.append(Trajectory(t, np.sin(phase), speed * np.cos(phase), 3 * np.cos(phase), f"r{number}"))
    return found


def same(first: Trajectory, second: Trajectory) -> bool:
    return all(np.array_equal(getattr(first, x), getattr(second, x)) for x in ("t", *QUANTITIES))


@pytest.fixture(params=[37, 1000, 10_000])
def log(request, tmp_path, monkeypatch) -> Path:
    """A file of row groups of this size that is read as one larger than memory."""
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, in_memory=1000))
    write_logs(tmp_path / "log.parquet", recordings(), JOINTS)
    table = pa.parquet.read_table(tmp_path / "log.parquet")
    pa.parquet.write_table(table, tmp_path / "train.parquet", row_group_size=request.param)
    (tmp_path / "log.parquet").unlink()
    return tmp_path / "train.parquet"


def test_parts_hold_the_samples_of_the_recordings(log):
    found = list(scan([log], JOINTS, LogMapping()))
    assert [part.name for part, _ in found] == [f"r{k}" for k in range(8)]
    for expected, (part, scanned) in zip(read_logs([log], JOINTS), found, strict=True):
        loaded = part.load()
        assert same(scanned, expected) and same(loaded, expected)
        assert (loaded.name, loaded.file, loaded.accepted) == (part.name, log, UNIT_CODES)


def test_long_recordings_are_several_parts(log, monkeypatch):
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, chunk_samples=150))
    found = dict((part.name, part) for part, _ in scan([log], JOINTS, LogMapping()))
    assert list(found)[:4] == ["r0 [1]", "r0 [2]", "r0 [3]", "r1 [1]"]
    for whole in read_logs([log], JOINTS):
        for number, rows in enumerate((slice(0, 150), slice(150, 300), slice(300, 400)), start=1):
            assert same(found[f"{whole.name} [{number}]"].load(), whole[rows])


def test_a_mapping_holds_for_parts_too(tmp_path):
    clock = pa.array(1_700_000_000_000_000_000 + np.arange(300) * 10_000_000, pa.timestamp("ns"))
    phase = np.arange(300) / 100
    columns = {"clock": clock, "J_pos": np.rad2deg(np.sin(phase)), "J_torque": phase, "extra": phase}
    pa.parquet.write_table(pa.table(columns), tmp_path / "x.parquet", row_group_size=64)
    mapping = LogMapping.model_validate(
        {
            "columns": {"t": "clock", "q": "{joint}_pos", "tau": "{joint}_torque"},
            "units": {"q": "deg"},
            "velocity": "differentiated",
            "joints": {"a": {"name": "J", "sign": -1}},
        }
    )
    ((part, _),) = scan([tmp_path / "x.parquet"], ("a",), mapping)
    (expected,) = read_logs([tmp_path / "x.parquet"], ("a",), mapping=mapping)
    assert same(part.load(), expected)
    np.testing.assert_allclose(expected.q[:, 0], -np.sin(phase), rtol=1e-12)


def test_preparation_finds_what_it_finds_in_memory(log):
    plain = prepare_data(read_logs([log], JOINTS), JOINTS, KINDS, AUTOMATIC)
    found = prepare_streamed(LargeLogs((log,), JOINTS, KINDS), AUTOMATIC)
    assert (found.preprocessing, found.digest) == (plain.preprocessing, plain.digest)
    assert len(found.validation_names) == len(plain.validation_names)
    assert found.training.dt.mean().item() == pytest.approx(plain.training.dt.mean().item(), rel=0.01)
    assert set(found.training_names) | set(found.validation_names) == {f"r{k}" for k in range(8)}
    assert set(found.training_names).isdisjoint(found.validation_names)
    codes = {each.code for each in found.diagnostics}
    assert codes == {"gap", "filter", "streamed"}
    starts = {round(x, 12) for x in found.validation.q[:, 0, 0].tolist()}
    assert starts.isdisjoint(round(x, 12) for x in found.training.q[:, 0, 0].tolist())


def test_logs_of_jittered_rates_have_one_decimation(tmp_path, monkeypatch):
    """96 Hz is where every third sample does no longer suffice: a log on either side, in memory and streamed."""
    slower, faster = recordings(4, rate=95.0), recordings(8, rate=97.0)[4:]
    logs = [*slower, *faster]
    plain = prepare_data(logs, JOINTS, KINDS, AUTOMATIC)
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, in_memory=1000))
    file = write_logs(tmp_path / "train.parquet", logs, JOINTS)
    streamed = prepare_streamed(LargeLogs((file,), JOINTS, KINDS), AUTOMATIC)
    for data in (plain, streamed):
        assert data.preprocessing.decimation == 3
        for windows in (data.training, data.validation):
            steps = windows.dt.mean(dim=1)  # of a window; three samples with their jitter
            assert steps.min() > 2.5 / 96 and steps.max() < 3.5 / 96


def test_a_last_sample_alone_changes_nothing(log, monkeypatch):
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, chunk_samples=399))
    found = prepare_streamed(LargeLogs((log,), JOINTS, KINDS), AUTOMATIC)
    plain = prepare_data(read_logs([log], JOINTS), JOINTS, KINDS, AUTOMATIC)
    assert found.preprocessing.cutoff == plain.preprocessing.cutoff == 8.0
    assert found.training.dt.mean().item() == pytest.approx(plain.training.dt.mean().item(), rel=0.01)
    assert "validation on 2 chunks, 8 have no window" in found.diagnostics[-1].message


@pytest.mark.parametrize("log", [1000], indirect=True)
def test_windows_are_not_streamed(log, tmp_path):
    with pytest.raises(LogError) as caught:
        train(STAND_IN, [log], tmp_path / "run", Rollout(epochs=1))
    assert str(caught.value) == (
        "got logs larger than memory, expected fewer logs, for example every tenth file; "
        "or fit torques, which read them in chunks: the objective torque"
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("group", [4096, 800_000])
def test_a_log_is_never_in_memory_as_a_whole(tmp_path, monkeypatch, group):
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, chunk_samples=16384))
    random = np.random.default_rng(0)
    columns = {name: random.standard_normal(800_000) for name in ("q_a", "qd_a", "tau_a")}
    table = pa.table({"t": np.arange(800_000.0), **columns})
    pa.parquet.write_table(table, tmp_path / "x.parquet", row_group_size=group)
    size = table.nbytes
    del table
    usual = pa.default_memory_pool()
    pool = pa.proxy_memory_pool(usual)  # counts from 0
    pa.set_memory_pool(pool)
    try:
        for _ in scan([tmp_path / "x.parquet"], ("a",), LogMapping()):
            pass
    finally:
        pa.set_memory_pool(usual)
    assert 0 < pool.max_memory() < size / 4


def test_only_large_parquet_is_streamed(log, tmp_path, monkeypatch):
    assert large_files([log], JOINTS) == [log]
    (tmp_path / "more.csv").write_text("t\n0\n")
    with pytest.raises(
        LogError, match=r"more\.csv: got a log beside others too large for memory, expected Parq"
    ):
        large_files([log, tmp_path / "more.csv"], JOINTS)
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, in_memory=10**6))
    assert large_files([log, tmp_path / "more.csv"], JOINTS) == []


def broken(log: Path, row: int, column: str, value: float) -> Path:
    table = pa.parquet.read_table(log)
    values = table[column].to_numpy().copy()
    values[row] = value
    index = table.column_names.index(column)
    pa.parquet.write_table(table.set_column(index, column, pa.array(values)), log, row_group_size=64)
    return log


BROKEN = {
    "hole": (1234, "qd_elbow", np.nan, r"train\.parquet: row 1235, column qd_elbow: got no finite number"),
    "back": (450, "t", 0.0, r"train\.parquet: row 451, column t: got t = 0 s after 0\.5"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_errors_tell_the_row_of_the_file(log, monkeypatch, case):
    row, column, value, message = BROKEN[case]
    # row 450 begins a chunk: its time is compared with the last one's
    monkeypatch.setattr(chunks, "TUNING", replace(chunks.TUNING, chunk_samples=50))
    with pytest.raises(LogError, match=message):
        list(scan([broken(log, row, column, value)], JOINTS, LogMapping()))


def test_the_rows_of_a_recording_must_lie_together(log):
    table = pa.parquet.read_table(log)
    mixed = pa.concat_tables([table[:100], table[400:500], table[100:200]])
    pa.parquet.write_table(mixed, log)
    with pytest.raises(LogError) as caught:
        list(scan([log], JOINTS, LogMapping()))
    assert str(caught.value) == (
        f"{log}: row 201, column trajectory: got trajectory r0 once more, after others, "
        "expected its rows together, in a log too large for memory; sort the rows"
    )


def test_two_parts_are_needed(log):
    with pytest.raises(LogError, match="no two chunks with 799 samples without a gap"):
        prepare_streamed(LargeLogs((log,), JOINTS, KINDS), EVERY_OTHER, WindowChoice(window=400))
