"""Untrusted logs and options give a result or one spelgen error, without NumPy warnings and in bounded time."""

import io
import os
import re
import resource
import struct
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import torch
from time_bounds import in_time

from spelgen.arm.configured_arm import load_arm
from spelgen.comparison.jobs import RunResult
from spelgen.emission.assemble import load_module
from spelgen.emission.build import build
from spelgen.emission.specify import generate
from spelgen.errors import LogError, RunError, SettingsError, SpelgenError
from spelgen.exporting.exported import with_readme
from spelgen.fitting.fit import fit
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs import bags
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import MomentumFit, Rollout
from spelgen.settings.yaml_document import validated

JOINTS = ("joint1", "joint2")
SAMPLES = 60


@pytest.fixture(scope="module")
def arm(robots):
    return load_arm(robots / "two_link.urdf")


def columns(t: object = None, scale: float = 1.0) -> dict[str, object]:
    steps = np.arange(SAMPLES) / 60.0
    found = {"t": steps if t is None else t}
    for shift, quantity in enumerate(("q", "qd", "tau")):
        for index, joint in enumerate(JOINTS):
            found[f"{quantity}_{joint}"] = scale * np.sin(3 * steps + shift + index)
    return found


def parquet(times: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        pa.parquet.write_table(pa.table(columns(times)), folder / "log.parquet")
        return folder / "log.parquet"

    return write


def npz(times: object, **more: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        np.savez(folder / "log.npz", **columns(times), **more)
        return folder / "log.npz"

    return write


def npz_that_says_1e12_samples(folder: Path) -> Path:
    buffer = io.BytesIO()
    np.save(buffer, np.arange(SAMPLES) / 60.0)
    head, _, body = buffer.getvalue().partition(b"\n")
    head = head[10:].replace(b"(60,)", b"(1000000000000,)").rstrip().ljust(117) + b"\n"
    path = npz(None)(folder)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["t.npy"] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + body
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def csv_of_a_long_name(folder: Path) -> Path:
    (folder / "log.csv").write_text(",".join(["x" * 400_000, *list(columns())[1:]]) + "\n")
    return folder / "log.csv"


COUNTS = np.arange(SAMPLES)
DATES = "column t: got dates beyond the range of nanosecond stamps"
LARGE = r"row \d+, column t: got 1e\+300 in SI units .* expected a number below 1e\+24"
VANISHING = r"t: got \S+ s after 0 s, expected increasing times"
REFUSED = {
    "stamps in a far year": (parquet(pa.array(2**62 + COUNTS, pa.timestamp("us"))), DATES),
    "days in a far year": (parquet(pa.array((2**31 - 100 + COUNTS).astype("i4"), pa.date32())), DATES),
    "times of 1e300": (npz(COUNTS * 1e300), LARGE),
    "one time of 1e300": (npz(np.append(COUNTS[:-1] / 60.0, 1e300)), LARGE),
    "times from -1.7e308 to 1.7e308": (npz(np.where(COUNTS, 1.7e308, -1.7e308)), "t: got"),
    "times of 1e-300": (npz(COUNTS * 1e-300), VANISHING),
    "denormal times": (npz(COUNTS * 5e-324), VANISHING),
    "a header of 1e12 samples": (npz_that_says_1e12_samples, r"array t\.npy is larger than the file says"),
    "a name of 400 kB": (csv_of_a_long_name, r"xxx\.\.\. \(\d+ characters\) \.\.\."),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", REFUSED)
def test_files_that_are_no_logs_are_spelgen_errors(tmp_path, arm, case):
    make, message = REFUSED[case]
    with pytest.raises(LogError, match=message) as caught:
        check_logs(read_logs(make(tmp_path), arm), arm)
    assert len(str(caught.value)) < 5000


@pytest.mark.filterwarnings("error")
def test_two_samples_are_too_few_to_judge(arm):
    q = np.array([[0.1, 0.2], [0.3, 0.5]])
    assert not check_logs([Trajectory(np.array([0.0, 0.1]), q, q, -q, "two")], arm).errors


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "broken JSON"), (b"\xff", "broken JSON"), (b"[" * 100_000, "broken JSON"), (b"[]", "list in JSON"),
        (b"{}", "not the values of a result"), (None, "no regular file"),
    ],
)  # fmt: skip
def test_results_of_a_comparison_that_are_none_are_refused(tmp_path, content, message):
    path = tmp_path / "result.json"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(RunError, match=message):
        RunResult.read(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scale", [0.0, 1e-150, 1e-320])
@pytest.mark.parametrize("config", [Rollout(epochs=1, momentum_steps=0), MomentumFit(momentum_steps=1)])
def test_windows_without_motion_are_not_fitted(robots, scale, config):
    t = COUNTS / 60.0
    motion = scale * np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    logs = [Trajectory(t, motion, motion, motion, name) for name in "ab"]
    model = build(robots / "two_link.urdf", "minimal", width=8, depth=1)
    with pytest.raises(SpelgenError):
        fit(model, logs, config)


def test_twenty_thousand_recordings_of_two_samples_take_seconds(tmp_path, arm):
    count = 20_000
    t = np.tile([0.0, 0.01], count)
    steps = np.arange(2 * count) / 100.0
    table = {"trajectory": np.repeat([f"motion{k}" for k in range(count)], 2), "t": t}
    for shift, quantity in enumerate(("q", "qd", "tau")):
        for index, joint in enumerate(JOINTS):
            table[f"{quantity}_{joint}"] = np.sin(3 * steps + shift + index)
    pa.parquet.write_table(pa.table(table), tmp_path / "log.parquet")
    begin = time.process_time()
    logs = read_logs(tmp_path / "log.parquet", arm)
    assert len(logs) == count
    check_logs(logs[: count // 4], arm)
    assert in_time(time.process_time() - begin, 10)


def test_a_name_of_a_megabyte_on_every_row_is_kept_once(tmp_path, arm):
    table = columns() | {"trajectory": pa.array(["x" * 10**6] * SAMPLES)}
    pa.parquet.write_table(pa.table(table), tmp_path / "log.parquet")
    (log,) = read_logs(tmp_path / "log.parquet", arm)
    assert len(log) == SAMPLES


def test_a_line_break_in_a_name_is_shown_as_one():
    arm = SimpleNamespace(chain=SimpleNamespace(name="a\nb", joint_names=["j\r1", "j\u20282"]), tip="t\n3")
    trained = SimpleNamespace(arm=arm, intervals=())
    exported = with_readme(trained, "casadi", {}, use="use\nit", about="as it is", summary=["checked"])
    ((_, content),) = exported.files.items()
    title, use, joints, units, _ = content.decode().splitlines()
    assert title.startswith(r"# Dynamics of a\nb") and use == r"use\nit"
    assert joints == r"Joints, in this order: j\r1, j\u20282." and r"link t\n3" in units


def test_an_invalid_learning_rate_is_reported_in_plain_words():
    with pytest.raises(SettingsError) as caught:
        validated(Rollout, {"learning_rate": 1e30})
    assert str(caught.value) == "learning_rate: got 1e+30, expected a number within +-1e+12"


@pytest.mark.parametrize("preset", ["spel", "minimal", "hybrid", "phnode"])
@pytest.mark.parametrize("robot", ["two_link", "rpr"])
def test_an_arm_of_1e_12_kg_gives_numbers(robots, tmp_path, preset, robot):
    text = re.sub(r'<mass value="[^"]*"', '<mass value="1e-12"', (robots / f"{robot}.urdf").read_text())
    text = re.sub(r'(i[xyz]{2})="([^"]*)"', lambda x: f'{x[1]}="{float(x[2]) * 1e-12:.3g}"', text)
    (tmp_path / "arm.urdf").write_text(text)
    model = build(tmp_path / "arm.urdf", preset, width=8, depth=1)
    q = torch.linspace(-1, 1, 5 * model.n, dtype=torch.float64).view(5, model.n)
    with torch.no_grad():
        assert (torch.linalg.eigvalsh(model.mass_matrix(q)) > 0).all()
        assert model.forward_dynamics(q, q, q).isfinite().all()


# per preset: largest standard deviation of parameters at which M is positive definite, in double and single precision
DEFINITE = {
    "spel": (100.0, 30.0),
    "minimal": (100.0, 30.0),
    "spel-kan": (100.0, 10.0),
    "hybrid": (5.0, 2.0),
    "closed-form": (6.0, 3.0),
    "phnode": (0.3, 0.3),
}


@pytest.mark.parametrize("robot", ["two_link", "rpr", "six_dof"])
@pytest.mark.parametrize("preset", DEFINITE)
def test_the_mass_matrix_is_positive_definite_as_far_as_the_docs_say(robots, preset, robot):
    source = generate(robots / f"{robot}.urdf", preset, width=16, depth=1)
    for dtype, deviation in zip((torch.float64, torch.float32), DEFINITE[preset], strict=True):
        generator = torch.Generator().manual_seed(0)
        for _ in range(8):
            model = load_module(source)
            with torch.no_grad():
                for weights in model.parameters():
                    weights.copy_(
                        deviation * torch.randn(weights.shape, generator=generator, dtype=torch.float64)
                    )
                model.to(dtype)
                q = 4 * torch.rand(300, model.n, generator=generator).to(dtype) - 2
                mass = model.mass_matrix(q)
                assert mass.isfinite().all()
                assert not torch.linalg.cholesky_ex(mass).info.any()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux alone")
def test_a_bag_that_unpacks_to_no_end_is_refused(tmp_path, monkeypatch):
    """A compressed chunk of a bag that would exceed the memory is refused.

    It has 400 MB of zeros, which zstd compresses to 40 kB; the process may take 200 MB more.
    """
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    writer = rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/joint_states", bags.MESSAGE, msgdef="float64 x\n", rihs01="x")
        writer.write(topic, 1, bytes(400_000_000))
    assert sum(path.stat().st_size for path in (tmp_path / "bag").iterdir()) < 1_000_000
    limits = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setattr(bags, "MEMORY", 200_000_000)
    with pytest.raises(LogError, match="an unreadable ROS bag"):
        read_logs(tmp_path / "bag", JOINTS)
    assert resource.getrlimit(resource.RLIMIT_AS) == limits
