"""Recordings of benchmarks are made from clones of git repositories, at the commits that recordings.py states.

Pickled files of a repository cannot call functions.
"""

import io
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from benchmarks import recordings

ROOT = Path(__file__).parents[1]


def git(*arguments, folder):
    identity = ["-c", "user.name=test", "-c", "user.email=test@example.org"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_a_source_is_read_at_its_commit(tmp_path, monkeypatch, shared):
    """A source of recordings is read at its stated commit: a later commit in the clone has no effect.

    The URDF that is written for the recordings equals the URDF in the reference data, byte for byte.
    """
    source = recordings.SOURCES["xmate3"]
    clone = tmp_path / "clones" / source.repository.name
    data = clone / "filtering" / "data" / "excit"
    data.mkdir(parents=True)
    git("init", "-q", folder=clone)
    values = {name: np.arange(21.0).reshape(3, 7) + k for k, name in enumerate(("ang", "vel", "torque"))}
    for name, table in values.items():
        np.savetxt(data / f"excit_{name}_record.txt", table)
    git("add", "-A", folder=clone)
    git("commit", "-qm", "recordings", folder=clone)
    commit = git("rev-parse", "HEAD", folder=clone)
    (data / "excit_ang_record.txt").write_text("0 0 0 0 0 0 0\n")
    git("commit", "-qam", "later", folder=clone)
    at_commit = replace(source, repository=replace(source.repository, commit=commit))
    monkeypatch.setitem(recordings.SOURCES, "xmate3", at_commit)
    recordings.make("xmate3", tmp_path / "out", tmp_path / "clones")
    table = pq.read_table(tmp_path / "out" / "xmate3" / "excit.parquet")
    assert table.column_names[:3] == ["t", "q_joint1", "q_joint2"]
    np.testing.assert_array_equal(table["t"].to_numpy(), [0.0, 0.001, 0.002])
    for prefix, name in (("q", "ang"), ("qd", "vel"), ("tau", "torque")):
        read = np.stack([table[f"{prefix}_joint{k}"].to_numpy() for k in range(1, 8)], axis=1)
        np.testing.assert_array_equal(read, values[name])
    reference = shared / "logs" / "xmate3" / "xmate3.urdf"
    assert (tmp_path / "out" / "xmate3" / "xmate3.urdf").read_bytes() == reference.read_bytes()


def test_the_other_generated_urdf_is_the_reference(tmp_path, shared):
    recordings.write_urdf(tmp_path / "shanghai.urdf", recordings.SHANGHAI_LINKS)
    reference = shared / "logs" / "shanghai" / "shanghai.urdf"
    assert (tmp_path / "shanghai.urdf").read_bytes() == reference.read_bytes()


def test_a_pickle_names_no_function(tmp_path):
    arrays = {"labels": ["a"], "t": [np.arange(3.0)]}
    with pytest.raises(pickle.UnpicklingError, match=r"posix\.system in a file of arrays"):
        recordings.Arrays(io.BytesIO(b"cposix\nsystem\n(S'true'\ntR.")).load()
    plain = pickle.dumps(arrays["labels"])
    assert recordings.Arrays(io.BytesIO(plain)).load() == ["a"]


def test_the_page_has_the_table():
    """docs/real_logs.md lists each source of recordings with address, commit and licence."""
    page = (ROOT / "docs" / "real_logs.md").read_text(encoding="utf-8")
    rows = {line.split("`")[1]: line for line in page.splitlines() if line.startswith("| `")}
    for name, source in recordings.SOURCES.items():
        repository = source.repository
        address = repository.address.removeprefix("https://github.com/")
        assert f"| {address} | `{repository.commit[:8]}` | {repository.licence} |" in rows[name]


def test_a_benchmark_without_recordings_names_the_command(tmp_path):
    script = ROOT / "benchmarks" / "recordings.py"
    code = f"import sys; sys.path.insert(0, {str(script.parent)!r}); import recordings; recordings.folder_of('absent')"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert "python benchmarks/recordings.py FOLDER" in done.stderr
