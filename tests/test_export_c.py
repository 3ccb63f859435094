"""Exported C and CasADi functions equal the torch model; the C passes address and undefined-behaviour sanitizers."""

import re
import shutil
import subprocess
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from exported_runs import COUPLED, MOTORS, arm_of, moved_model, run_folder
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.emission.build import build
from spelgen.errors import RunError
from spelgen.exporting import model_expressions
from spelgen.exporting.c_export import c_files, called_by_c, compile_library
from spelgen.exporting.c_source import c_functions, write_c
from spelgen.exporting.casadi_export import export_casadi
from spelgen.exporting.describe import Trained, identifier
from spelgen.exporting.export import export
from spelgen.exporting.parity import ENTRY_POINTS, check_parity, random_inputs, require_parity

ONE_JOINT = """<robot name="one"><link name="base"/>
<link name="arm"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint></robot>"""
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
NAMES = tuple(name for name in ENTRY_POINTS if name != "servo_torque")
ENTRIES = {name: ENTRY_POINTS[name] for name in NAMES}
BOTH = [("two_link", "closed-form"), ("rpr", "hybrid")]


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Return, per robot and preset, the exported model, the folder of its C files, and the compiled library."""
    found = {}
    for robot, preset in BOTH:
        trained = Trained(moved_model(robot, preset), arm_of(robot))
        folder = tmp_path_factory.mktemp(f"{robot}_{preset}")
        files, told = c_files(trained)
        for name, content in files.items():
            (folder / name).write_bytes(content)
        found[robot, preset] = trained, folder, told
    return found


@needs_gcc
@pytest.mark.parametrize("flags", [(), ("float",)], ids=["double", "float"])
@pytest.mark.parametrize("program", ["gcc", "clang"])
@pytest.mark.parametrize("case", BOTH, ids=lambda each: "-".join(each))
def test_c_equals_the_model(case, program, flags, compiled):
    if shutil.which(program) is None:
        pytest.skip(f"no {program} on this machine")
    trained, folder, _ = compiled[case]
    model = trained.described
    options = [f"-D{model.name.upper()}_FLOAT"] if flags else []
    source = folder / f"{model.name}.c"
    library = compile_library(source, program, *options)
    # each library has its own name, as ctypes caches libraries by name
    library = library.rename(folder / f"{program}{len(flags)}.so")
    kind, tolerance = (np.float32, 1e-5) if flags else (np.float64, 1e-12)
    called = called_by_c(library, c_functions(model, trained.entry_points), kind)
    found = check_parity(called, trained, NAMES, tolerance, dtype=kind)
    assert set(found.differences) == set(NAMES)


@needs_gcc
def test_the_header_states_operations_and_the_readme_the_check(compiled):
    _, folder, told = compiled["rpr", "hybrid"]
    header = (folder / "rpr.h").read_text()
    assert re.search(r"At most \d\d+ operations, in forward_dynamics", header)
    assert "from the torch module" in told
    assert max(map(len, header.splitlines())) < 130


@pytest.mark.parametrize("preset", ["closed-form", "hybrid"])
@pytest.mark.parametrize("robot", ["rpr", "scara"])
def test_casadi_equals_the_model(robot, preset):
    found = export_casadi(Trained(moved_model(robot, preset), arm_of(robot)))
    assert len(found.files) == len(NAMES) + 1  # with a README
    assert len(found.files["README.md"].decode().splitlines()) == 5


@pytest.mark.parametrize("preset", ["closed-form", "hybrid"])
def test_followers_motors_and_passive_joints_go_along(preset, tmp_path):
    """Exports have mimic joints, coupled motors and passive joints, and no text of the URDF becomes code."""
    urdf = tmp_path / "coupled.urdf"
    urdf.write_text(COUPLED)
    urdf.with_suffix(".yaml").write_text(MOTORS)
    arm = load_arm(urdf)
    model = build(arm, preset)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1
        model.raw_friction_compensation += 0.3
    trained = Trained(model, arm)
    assert export_casadi(trained).summary
    assert trained.described.name == "arm_2_fast_int_main"
    if shutil.which("gcc"):
        files, told = c_files(trained)
        assert "from the torch module" in told
        assert b"fast;" not in files["arm_2_fast_int_main.c"]


def test_a_matrix_of_one_joint_is_a_scalar(tmp_path):
    urdf = tmp_path / "one.urdf"
    urdf.write_text(ONE_JOINT)
    arm = load_arm(urdf)
    trained = Trained(build(arm, "closed-form"), arm)
    assert export_casadi(trained).summary
    if shutil.which("gcc"):
        assert c_files(trained)


def test_names_for_code():
    assert identifier("UR10e") == "ur10e"
    assert identifier("7 axes") == "arm_7_axes"
    assert identifier("für */") == "f_r"
    assert identifier("*/") == "arm"
    assert identifier("while") == "arm_while"


@needs_gcc
def test_the_longest_name_is_a_name(tmp_path):
    """C of a robot with the longest name (40 characters) compiles; its function heads exceed the line length."""
    described = Trained(moved_model("two_link", "closed-form"), arm_of("two_link")).described
    model = replace(described, name=identifier("gen3" * 20))
    assert len(model.name) == 40
    functions = c_functions(model, ENTRIES)
    assert compile_library(write_c(model, functions, tmp_path), "gcc").exists()


def test_a_wrong_export_is_refused():
    trained = Trained(moved_model("two_link", "closed-form"), arm_of("two_link"))
    still = lambda name, inputs: {"tau": np.zeros_like(inputs["q"])}  # noqa: E731
    with pytest.raises(RunError, match=r"inverse_dynamics differs from the model by 1\.0e"):
        check_parity(still, trained, ["inverse_dynamics"], 1e-12)
    nothing = lambda name, inputs: {"tau": np.full_like(inputs["q"], np.nan)}  # noqa: E731
    with pytest.raises(RunError, match="differs from the model by nan"):
        check_parity(nothing, trained, ["inverse_dynamics"], 1e-12)


def test_parity_names_the_worst_entry_point():
    found = require_parity({"bias": 5e-13, "tip_pose": 1e-14}, 1e-12, 9)
    assert found.differences["tip_pose"] == 1e-14
    assert "at most 5.0e-13 (bias)" in found.summary and "; 1e-12 is allowed" in found.summary
    for wrong in (2e-12, float("nan")):
        with pytest.raises(RunError, match="tip_pose differs"):
            require_parity({"bias": 0.0, "tip_pose": wrong}, 1e-12, 9)


DRIVER = r"""
#include "{name}.h"
#include <math.h>
#include <stdio.h>
#define R {name}_real
int main(void)
{{
    static const R size[] = {{0, 1, 1e3, 1e30, 1e300, -1e300, INFINITY, NAN}};
    int k, i;
    for (k = 0; k < 8; k++) {{
        R q[{n}], qd[{n}], x[{n}], z[{memory} + 1] = {{0}}, out[{memory} + 16];
        R more[{square}];
        for (i = 0; i < {n}; i++) q[i] = size[k] * (i + 1), qd[i] = size[7 - k], x[i] = -size[k];
{calls}
        if (k == 7) printf("%d\n", isnan(out[0]));
    }}
    return 0;
}}
"""


@needs_gcc
@pytest.mark.parametrize("case", BOTH, ids=lambda each: "-".join(each))
def test_c_is_sound_for_all_inputs(case, compiled):
    """C has no undefined behaviour for zero, large, overflowing and infinite states; NaN in gives NaN out.

    Checked under address and undefined-behaviour sanitizers.
    """
    trained, folder, _ = compiled[case]
    name, n = trained.described.name, trained.described.n
    calls = []
    for entry in ENTRIES.values():
        given = [{"q": "q", "qd": "qd", "z": "z"}.get(each, "x") for each in entry.inputs]
        output = "more" if entry.name in ("tip_jacobian", "mass_matrix", "tip_pose") else "out"
        calls.append(f"        {name}_{entry.name}({', '.join([*given, output])});")
    calls.append(f"        {name}_forward_dynamics(q, qd, x, z, out);")
    text = DRIVER.format(
        name=name, n=n, memory=trained.described.memory, square=max(n * n, 6 * n, 16), calls="\n".join(calls)
    )
    driver = folder / "driver.c"
    driver.write_text(text)
    program = folder / "driver"
    flags = ["-std=c99", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    built = subprocess.run(
        ["gcc", *flags, str(driver), str(folder / f"{name}.c"), "-o", str(program), "-lm"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "cannot find -lasan" in built.stderr:
        pytest.skip("no address sanitizer on this machine")
    assert not built.returncode, built.stderr
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    assert done.stdout == "1\n"


REACH = np.array([[0.01, 0.1], [0.02, 0.3]])
FRACTIONS = np.array([[0.3, 0.7], [0.4, 0.6]])


def test_bristles_follow_their_law_along_a_displacement():
    """The bristle step of the exports equals dz/dt = qd, limited to |z| <= reach, integrated in small steps."""
    z, dq = ca.SX.sym("z", 4), ca.SX.sym("dq", 2)
    step = ca.Function("step", [z, dq], [model_expressions.bristle_step(REACH, z, dq)])
    found, small, steps, reach = np.zeros(4), np.zeros(4), 4000, REACH.ravel()
    for moved in (np.array([0.05, -0.02]), np.array([-0.01, 0.03]), np.zeros(2)):
        found = step(found, moved).full()[:, 0]
        d = np.repeat(moved / steps, 2)
        for _ in range(steps):
            small = small + np.where(np.abs(small + d) <= reach, d, 0.0)
    np.testing.assert_allclose(found, small, atol=2e-5)
    assert (np.abs(found) <= reach).all()


@needs_gcc
def test_c_carries_frictions_memory(tmp_path):
    """C adds the torque of bristles, two per joint with deflection z: dry friction * sum(fraction * z / break-away).

    At steady sliding, z is the break-away displacement times tanh(qd / smoothing velocity). The macro NZ is the number
    of bristles.
    """
    model = Trained(moved_model("two_link", "closed-form"), arm_of("two_link")).described
    model = replace(model, breakaway=REACH, friction=model.friction._replace(bristle_fractions=FRACTIONS))
    functions = c_functions(model, ENTRIES)
    source = write_c(model, functions, tmp_path)
    assert "#define TWO_LINK_NZ 4" in source.with_suffix(".h").read_text()
    called = called_by_c(compile_library(source, "gcc"), functions)
    given = random_inputs(model.arm.coordinates, 5, 4)
    law, qd = model.friction, given["qd"]
    relative = np.abs(qd) / law.stribeck_velocity
    rounding = law.stribeck_rounding
    dry = law.coulomb + law.stribeck / (1 + (1 + rounding) * relative**2 / (relative + rounding) / 8) ** 8
    dry += law.load_dependence * np.hypot(called("gravity", given)["gravity"], law.min_load)
    straight = called("friction", given | {"z": np.zeros((5, 4))})["friction"]
    bent = (FRACTIONS / REACH * given["z"].reshape(5, 2, 2)).sum(axis=-1)
    np.testing.assert_allclose(called("friction", given)["friction"], straight + dry * bent)
    slid = called("friction_memory", given)["z_start"].reshape(5, 2, 2)
    direction = np.tanh(qd / law.coulomb_smoothing_velocity)
    np.testing.assert_allclose(slid, REACH * direction[..., None])


@needs_gcc
def test_in_single_precision_a_joint_that_creeps_moves_its_bristles(tmp_path):
    """In single precision, a joint that creeps by 1e-9 rad per step still moves its bristles.

    Near its break-away displacement of 0.1 rad, a bristle in float would not move, or move by seven times as much.
    """
    model = Trained(moved_model("two_link", "closed-form"), arm_of("two_link")).described
    functions = c_functions(model, ENTRIES)
    library = compile_library(write_c(model, functions, tmp_path), "gcc", f"-D{model.name.upper()}_FLOAT")
    called = called_by_c(library, functions, np.float32)
    assert model.memory
    z = start = 0.6 * model.breakaway.reshape(1, -1)
    given = {"q": np.zeros((1, 2)), "dq": np.full((1, 2), 1e-9)}
    for _ in range(200):
        z = called("friction_step", given | {"z": z})["z_next"]
    np.testing.assert_allclose(z - start, 200e-9, rtol=0.01)


def test_export_needs_only_the_run_folder(tmp_path):
    run = run_folder("two_link", "closed-form", tmp_path)
    told = CliRunner().invoke(app, ["export", str(run.path), "--to", "casadi", "-o", str(tmp_path / "out")])
    assert told.exit_code == 0, told.output
    forward = ca.Function.load(str(tmp_path / "out" / "forward_dynamics.casadi"))
    assert forward.size1_out(0) == 2
    assert "from the torch module" in told.output
    again = CliRunner().invoke(app, ["export", str(run.path), "--to", "casadi", "-o", str(tmp_path / "out")])
    assert again.exit_code == 1
    assert "this output exists already" in again.output


def test_functions_are_chosen():
    model, arm = moved_model("two_link", "closed-form"), arm_of("two_link")
    files = export(model, "casadi", arm=arm).files
    assert "forward_dynamics.casadi" in files
    assert set(export(model, "casadi", arm=arm, entries=["bias"]).files) == {"bias.casadi", "README.md"}
    with pytest.raises(RunError, match="the function 'inverse', expected one of inverse_dynamics, forward"):
        export(model, "c", arm=arm, entries=["inverse"])
    with pytest.raises(RunError, match="functions for --to urdf, expected --to c, casadi, onnx and torch"):
        export(model, "urdf", arm=arm, entries=["gravity"])


@pytest.mark.parametrize(
    ("to", "name", "told"),
    [
        (
            "c",
            "arm.urdf",
            "got the name 'arm.urdf' for --to c, expected a folder, named without an extension; --to urdf",
        ),
        ("urdf", "arm.xml", "got the name 'arm.xml' for --to urdf, expected FILE.urdf"),
        ("urdf", "arm", "got the name 'arm' for --to urdf, expected FILE.urdf"),
    ],
)
def test_a_name_that_contradicts_the_format_is_refused(to, name, told, tmp_path):
    run = run_folder("two_link", "closed-form", tmp_path)
    found = CliRunner().invoke(app, ["export", str(run.path), "--to", to, "-o", str(tmp_path / name)])
    assert found.exit_code == 1
    assert told in found.output
    assert not (tmp_path / name).exists()


def test_presets_without_such_a_form_are_refused():
    for preset, to in (("spel", "casadi"), ("phnode", "c")):
        told = f"the preset {preset}, which is not of rigid bodies, expected closed-form"
        with pytest.raises(RunError, match=told):
            export(moved_model("two_link", preset), to, arm=arm_of("two_link"))
    with pytest.raises(
        RunError, match=r"the format 'matlab', expected one of urdf, mjcf, c, casadi, onnx, torch, ros2"
    ):
        export(moved_model("two_link", "closed-form"), "matlab", arm=arm_of("two_link"))
