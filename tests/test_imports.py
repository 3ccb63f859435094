"""Imports run downward only; what derives knows no torch, what fits knows no symbolic algebra."""

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "spelgen"

# What an emitted module carries with it: these files know torch, a little of the standard library and one another.
RUNTIME = [
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for path in sorted((PACKAGE / "runtime").rglob("*.py"))
    if path.stem != "__init__"
]
CARRIED = {"__future__", "collections", "functools", "math", "torch", "typing"}

# A file may import only from files above it, or to its left.
ROWS = f"""
errors addresses files labels listing templates
settings: values yaml_document starter
logs: mapping
fitting: config
settings: joint simulation training comparison messages settings
design spec
urdf: robot xacro_child xacro_input document values elements lint read
arm: rational angle_rounding placement chain lump_links arm actuation axes
structure: recursion field sampling spans basis expansion symbolic structure nominal
structure: base_parameters pseudo_inertia
dynamics: bristles
{" ".join(RUNTIME)}
dynamics: protocol runge_kutta residuals prepared servo_rollout
emission: bodies plan source docstring tailored bundle emit loading
dynamics: arrays constraint pinocchio_dynamics pinocchio_arm pinocchio_urdf
dynamics: regressor rigid_bodies regressor_dynamics tip servo_rank
logs: arm_mapping trajectory coverage bags lerobot tables npz readers values log_files suggest read checks filtering
logs: preprocessing windows chunks epoch_windows commands smoothing
excitation: trajectory
simulation: friction integration simulated_logs random_inputs servo_motions paths tracking
identification: samples friction base_parameters least_squares method prior identification
excitation: criterion excitation
fitting: run_schema address_lock run_folder run_lock
fitting: gaussian_prior adaptive rollout calibration dataset streaming workers torque_samples body_steps torque_jacobian
fitting: optimizers residual_fit torque_fit torque_report
fitting: torque_networks urdf_regularizer stages compiled process progress validation loop
fitting: run_record fitted servo_windows servo_start servo_weights servo_problem servo_descent servo_intervals
fitting: servo_laws servo_fit servo_report linear_servo servo_run
fitting: fit train
evaluation: names replay disturbance stiff baselines along_time extrapolation trust forecast torque rollout
evaluation: invariants examples
evaluation: tables verdict results horizons torque_traces traces csv_file subject evaluate
verify: agreement urdf_cross_check numeric_samples verify
explain: reasons facts
formulas: terms printing angles shortening formulas text files
inspection loaded_arm pipeline trust building
simulation: simulate
excitation: design
identification: identify drive_samples drive_hints
exporting: description tip_chain describe_residuals describe trained parity exported readme rigid_body_projection
exporting: urdf_file urdf_export mjcf_file mjcf_export torch_programs torch_export
identification: position_actuators baseline
exporting: onnx_graph onnx_rigid onnx_joint_functions onnx_residuals onnx_model onnx_export
exporting: rigid_expressions friction_expressions residual_expressions solved_expressions model_expressions
exporting: tip_expressions entry_points
exporting: c_statements c_tables c_networks c_joint_functions c_residual_calls c_code c_library c_export ros2_export
exporting: casadi_residuals casadi_export export
render: charts plots picture page learned parameters reproduction shapes scene still arm_section
render: run_facts curves report_page runs_page inspection_page identification_page
logs: statistics gravity report following servo_report check_servo_logs check_logs
fleet: ray_engine engine
comparison: truth metrics known_urdf study runs formatting
fleet: schema prepare jobs search units fleet ranking progress
render: logs_page comparison_page fleet_page
cli: command console options formats model_commands train_start train_command log_commands simulate_command
cli: identify_command evaluate_command compare_command fleet_command export_command main
__init__ __main__
"""


def _names(row: str) -> list[str]:
    package, colon, files = row.rpartition(":")
    return [f"{package}.{name}" if colon else name for name in files.split()]


LAYERS = [name for row in ROWS.strip().splitlines() for name in _names(row)]
OURS = {f"spelgen.{name}" for name in LAYERS}

# What a file may not import, neither itself nor through others.
SYMBOLIC = {"sympy", "flint", "spelgen.arm", "spelgen.structure"}
PLAIN = {"spelgen.arm.actuation"}  # G by the files, without the exact arithmetic of its room
ROOMS_THAT_DERIVE = ("urdf.", "arm.", "structure.", "emission.", "verify.", "explain.", "formulas.")
DERIVES = [x for x in LAYERS if x.startswith(ROOMS_THAT_DERIVE) and x != "emission.loading"]
# logs held against an arm's own facts
BESIDE_A_ROBOT = {
    "logs.gravity",
    "logs.report",
    "logs.servo_report",
    "logs.check_servo_logs",
    "logs.check_logs",
}
OF_A_RUN = {f"render.{name}" for name in ("charts", "plots", "picture", "page", "learned", "scene")}
FITS = [x for x in LAYERS if x.startswith(("logs.", "fitting.", "evaluation.")) and x not in BESIDE_A_ROBOT]
NEVER = {
    "spec": {"sympy", "flint", "torch"},
    "pipeline": {"torch"},
    **{name: {"torch"} for name in DERIVES},
    **{name: SYMBOLIC for name in [*FITS, *sorted(OF_A_RUN)]},
}


def test_every_file_has_a_layer():
    files = [".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.rglob("*.py")]
    assert sorted(x for x in files if not x.endswith(".__init__")) == sorted(LAYERS)


def test_runtime_needs_torch_alone():
    allowed = {"spelgen.runtime", *(f"spelgen.{name}" for name in RUNTIME)}
    for name in RUNTIME:
        assert not {x for x in imported(name) - allowed if x.split(".")[0] not in CARRIED}, name


@pytest.mark.parametrize("name", [x for x in LAYERS if x not in RUNTIME])
def test_imports_only_from_files_above(name):
    own = {module.removeprefix("spelgen.") for module in imported(name) if module.startswith("spelgen.")}
    assert own <= set(LAYERS[: LAYERS.index(name)])


@pytest.mark.parametrize("name", NEVER)
def test_never_imports(name):
    modules = reached(name) - PLAIN
    forbidden = {m for m in modules for banned in NEVER[name] if m == banned or m.startswith(f"{banned}.")}
    assert not forbidden


@cache
def imported(name: str) -> frozenset[str]:
    """Every module that a file names in an import, those inside functions included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(_file(name).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name}: relative import; name the module in full"
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= members & OURS or ({str(node.module)} - {"spelgen"})
    return frozenset(found)


def reached(name: str) -> set[str]:
    """What `imported` gives for the file and for every file of the package that it reaches."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        new = imported(waiting.pop()) - found
        found |= new
        waiting += [module.removeprefix("spelgen.") for module in new if module.startswith("spelgen.")]
    return found


def _file(name: str) -> Path:
    return PACKAGE.joinpath(*name.split(".")).with_suffix(".py")
