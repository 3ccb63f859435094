"""Any log, settings file, mesh or run folder gives a result, or errors of one line each."""

from __future__ import annotations

import contextlib
import json
import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from fuzzing import fuzz
from hypothesis import strategies as st
from test_fuzz_urdf import mutated

from spelgen.arm.configured_arm import load_arm
from spelgen.emission.build import build
from spelgen.errors import SpelgenError
from spelgen.evaluation.evaluate import evaluate
from spelgen.fitting.fit import fit
from spelgen.fitting.fitted import load_run
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.render.report_page import render_report
from spelgen.render.scene import scene
from spelgen.settings.fits import TorqueFit
from spelgen.settings.settings import OF_A_STEP
from spelgen.simulation.protocol import make_friction

JOINTS = ("joint1", "joint2")
NUMBERS = st.one_of(
    st.sampled_from([0, 1, -1, 1e300, -1e-320, 10**30, float("nan"), float("inf"), 0.5, 2.0, 1e9, 2**63]),
    st.floats(),
)
TEXTS = st.sampled_from(
    ["", "x", "joint1", "1,5", "nan", "é", "{joint}", "{trajectory}", "q[0]", "[1, 2]", "\x1b[2J"]
)
ODD = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=5,
)


def motion(samples: int = 60) -> Trajectory:
    t = np.arange(samples) / 60.0
    q = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    return Trajectory(t, q, np.gradient(q, t, axis=0), np.stack([np.cos(3 * t), t], axis=1), "motion")


def columns() -> dict:
    log = motion()
    found = {"t": log.t}
    for name in ("q", "qd", "tau"):
        found |= {f"{name}_{joint}": getattr(log, name)[:, k] for k, joint in enumerate(JOINTS)}
    return found


@pytest.fixture(scope="module")
def arm(robots):
    return load_arm(robots / "two_link.urdf")


def used(path: Path, arm, mapping=None) -> None:
    """Read and check a log, as the commands do."""
    check_logs(read_logs(path, arm, mapping), arm)


@st.composite
def changes(draw, content):
    """Return JSON-like content with one value removed or replaced by an anomalous one."""
    if isinstance(content, dict) and content and draw(st.integers(0, 4)):
        key = draw(st.sampled_from(sorted(content)))
        if not draw(st.integers(0, 3)):
            return {name: x for name, x in content.items() if name != key}
        return content | {key: draw(changes(content[key]))}
    if isinstance(content, list) and content and draw(st.integers(0, 2)):
        at = draw(st.integers(0, min(len(content), 4) - 1))
        return [*content[:at], draw(changes(content[at])), *content[at + 1 :]]
    return draw(ODD)


ARRAYS = st.one_of(
    st.sampled_from([
        np.zeros(60, complex), np.zeros(60, "V3"), np.zeros((60, 2)), np.zeros(0), np.array(1.0), np.zeros(59),
        np.array(["a"] * 60), np.array([b"a"] * 60), np.full(60, np.nan), np.zeros(60, ">f4"), np.zeros(60, bool),
        np.zeros(60, "M8[D]"), np.arange(60).astype("m8[us]"), np.zeros(60, [("a", "f8")]),
        np.full(60, 2**63, np.uint64),
        np.arange(60)[::-1].astype("f2"), np.zeros(60, np.longdouble), np.array([None] * 60), np.full(60, 1e300),
    ]),
    st.lists(st.floats(), min_size=60, max_size=60).map(np.array),
)  # fmt: skip
NAMES = st.sampled_from([*columns(), "trajectory", "q", "tau", "joints"])


def test_logs_of_arrays(tmp_path, arm):
    def use(drawn):
        kind, arrays = drawn
        path = tmp_path / f"log.{kind}"
        if kind == "npz":
            np.savez(path, **columns() | arrays)
        else:
            try:
                table = pa.table(
                    {k: x.tolist() if x.ndim > 1 else x for k, x in (columns() | arrays).items()}
                )
                pa.parquet.write_table(table, path)
            except (pa.ArrowException, TypeError, ValueError):
                return  # pyarrow cannot write the table, so there is no file to read
        used(path, arm)

    arrays = st.dictionaries(NAMES, ARRAYS, min_size=1, max_size=2)
    fuzz(st.tuples(st.sampled_from(["npz", "parquet"]), arrays), 150, use)


def test_logs_of_text(tmp_path, arm):
    rows = zip(*columns().values(), strict=True)
    text = "\n".join([",".join(columns()), *(",".join(f"{x:.5g}" for x in row) for row in rows)]).encode()

    def use(drawn):
        number, encoding, old, new = drawn
        content = (
            mutated(text, random.Random(number)) if number % 3 else text.replace(old, new, 1 + number % 9)
        )
        path = tmp_path / "log.csv"
        path.write_bytes(content.decode("latin-1").encode(encoding, "replace"))
        used(path, arm)

    pieces = st.sampled_from(
        [b",", b"\n", b"0", b".", b"q_", b"t", b"1e300", b"nan", b'"', b";", b"\t", b"\xe9", b"-"]
    )
    fuzz(
        st.tuples(st.integers(0, 10**9), st.sampled_from(["utf-8", "latin-1", "utf-16"]), pieces, pieces),
        250,
        use,
    )


def test_mappings(tmp_path, arm):
    path = tmp_path / "log.npz"
    np.savez(path, **columns())
    plain = {
        "topic": "x", "velocity": "logged", "units": {"t": "s", "q": "rad", "qd": "rad/s", "tau": "Nm"},
        "columns": {"t": "t", "trajectory": "trajectory", "q": "q_{joint}", "qd": "qd_{joint}", "tau": "tau_{joint}"},
        "joints": {"joint1": {"name": "joint1", "sign": 1, "gain": 2.0, "offset": 0.1, "columns": {"q": "q_joint1"}}},
    }  # fmt: skip
    fuzz(changes(plain).filter(lambda x: isinstance(x, dict)), 200, lambda mapping: used(path, arm, mapping))


def test_settings(tmp_path, robots):
    urdf = tmp_path / "arm.urdf"
    urdf.write_bytes((robots / "two_link.urdf").read_bytes())
    sources = [path.read_bytes() for path in sorted(robots.glob("*.yaml"))]
    plain = {
        "gravity": [0.0, 0.0, -9.81], "torque": "motor",
        "couplings": [{"joints": list(JOINTS), "matrix": [[1, 0], [1, 1]]}],
        "joints": {"joint1": {"gear": 2.0, "rotor_inertia": 1e-4, "coulomb": [1.0, -1.0], "viscous": 0.1}},
        "simulation": {"duration": 1.0, "inputs": [1.0], "positions": {"joint1": [0, 1]}}, "tracking": {"paths": "own"},
        "training": {"objective": "rollout", "window": 5, "substeps": 4, "cutoff": 8.0}, "comparison": {"seeds": 2},
        "logs": {"units": {"q": "deg"}},
    }  # fmt: skip

    def use(drawn):
        number, content = drawn
        draw = random.Random(number)
        text = mutated(draw.choice(sources), draw) if number % 2 else json.dumps(content).encode()
        (tmp_path / "arm.yaml").write_bytes(text)
        loaded = load_arm(urdf)
        for name in OF_A_STEP:
            getattr(loaded.settings, name).model_dump()
        make_friction(loaded.chain, loaded.settings)(np.ones(2))
        loaded.actuation.matrix()

    fuzz(st.tuples(st.integers(0, 10**9), changes(plain)), 250, use)


def test_meshes(tmp_path):
    """If bytes of a mesh file of any format are changed, the page shows the arm with or without this mesh."""
    ball = pytest.importorskip("trimesh").creation.icosphere(subdivisions=1)
    kinds = ("stl", "obj", "ply", "glb", "dae", "off")
    whole = {kind: ball.export(file_type=kind) for kind in kinds}
    text = (
        '<robot name="r"><link name="a"/><link name="b"><visual><geometry><mesh filename="m.KIND"/></geometry></visual>'
        '</link><joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>'
    )

    def use(drawn):
        kind, number = drawn
        content = whole[kind]
        content = content.encode() if isinstance(content, str) else content
        (tmp_path / f"m.{kind}").write_bytes(mutated(content, random.Random(number)))
        (tmp_path / "r.urdf").write_text(text.replace("KIND", kind))
        assert scene(tmp_path / "r.urdf", ["j"]).links

    fuzz(st.tuples(st.sampled_from(kinds), st.integers(0, 10**9)), 3, use)


@pytest.fixture(scope="module")
def run(robots, tmp_path_factory) -> Path:
    """Return a run folder that contains each kind of file."""
    model = build(robots / "two_link.urdf", "closed-form")
    found = fit(model, [motion(300)], TorqueFit(), arm=robots / "two_link.urdf")
    folder = found.save(tmp_path_factory.mktemp("run") / "run")
    line = {"epoch": 1, "step": 1, "loss": 0.5, "validation": 0.5, "best": 0.5, "seconds": 1.0}
    (folder / "metrics.jsonl").write_text(2 * (json.dumps(line) + "\n"))
    (folder / "evaluation.json").write_text(json.dumps(evaluate(load_run(folder), [motion(75)]).to_dict()))
    return folder


def test_run_folders(run, tmp_path):
    whole = {path.name: path.read_bytes() for path in run.iterdir()}
    texts = [name for name in whole if name.endswith((".json", ".jsonl"))]

    def use(drawn):
        name, number, how = drawn
        for each, content in whole.items():
            (tmp_path / each).write_bytes(content)
        if how is None:
            (tmp_path / name).write_bytes(mutated(whole[name], random.Random(number)))
        else:
            (tmp_path / name).write_text(json.dumps(how))
        try:
            load_run(tmp_path)
        finally:
            if name not in ("model.pt", "checkpoint.pt"):
                with contextlib.suppress(SpelgenError):
                    render_report(tmp_path)

    def odd(name):
        lines = whole[name].splitlines() if name.endswith("l") else [whole[name]]
        return st.tuples(st.just(name), st.just(0), changes(json.loads(lines[0])))

    of_json = st.sampled_from(texts).flatmap(odd)
    of_bytes = st.tuples(st.sampled_from(sorted(whole)), st.integers(0, 10**9), st.none())
    fuzz(st.one_of(of_json, of_bytes), 24, use)
