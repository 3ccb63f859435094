"""Imports run downward only; what derives knows no torch, what trains knows no symbolic algebra."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "spelgen"

# A file may import only from files above it, or to its left.
ROWS = """
errors files labels listing rendering yaml_document setting_values log_mapping settings spec
urdf: robot xacro_child xacro_input document values elements lint read actuation
arm: rational snapping placement chain walk arm
structure: recursion field sampling spans basis expansion symbolic structure nominal waves minimal pseudo_inertia
emission: bodies plan source docstring emit
data: trajectory bags tables logs doubts signals windows parts stream
simulation: engine simulate tracking protocols
identification: samples friction regressor base least_squares prior identify told
excitation: fourier design told
training: runs belief torque_fit lie_group rollout compiled rivals prior progress
training: data streamed descent torque_networks torque_start loop train
evaluation: tip torque examples drift outcome evaluate
report: charts plots tables picture learned page
proof: agreement axes reasons meaning second_reading numeric_samples verification
formulas: expression notation angles harmonics factoring shortening grouping formulas layout text latex sympy_module
inspection inspection_page pipeline
export: twin urdf_file
survey: measures gravity survey tables page
comparison: paper truth measures study running tables page
cli: console options formats model_commands run_commands log_commands
cli: identify_command compare_command export_command main
__init__ __main__
"""


def _names(row: str) -> list[str]:
    package, colon, files = row.rpartition(":")
    return [f"{package}.{name}" if colon else name for name in files.split()]


LAYERS = [name for row in ROWS.strip().splitlines() for name in _names(row)]
OURS = {f"spelgen.{name}" for name in LAYERS}

# What a file may not import, neither itself nor through others.
SYMBOLIC = {"sympy", "flint", "spelgen.arm", "spelgen.structure"}
DERIVES = [x for x in LAYERS if x.startswith(("urdf.", "arm.", "structure.", "emission.", "proof."))]
TRAINS = [x for x in LAYERS if x.startswith(("data.", "training.", "evaluation.", "report."))]
NEVER = {
    "spec": {"sympy", "flint", "torch"},
    "pipeline": {"torch"},
    **{name: {"torch"} for name in DERIVES},
    **{name: SYMBOLIC for name in TRAINS},
}


def test_every_file_has_a_layer():
    files = [".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.rglob("*.py")]
    assert sorted(x for x in files if not x.endswith(".__init__")) == sorted(LAYERS)


@pytest.mark.parametrize("name", LAYERS)
def test_imports_only_from_files_above(name):
    own = {module.removeprefix("spelgen.") for module in imported(name) if module.startswith("spelgen.")}
    assert own <= set(LAYERS[: LAYERS.index(name)])


@pytest.mark.parametrize("name", NEVER)
def test_never_imports(name):
    modules = reached(name)
    forbidden = {m for m in modules for banned in NEVER[name] if m == banned or m.startswith(f"{banned}.")}
    assert not forbidden


def imported(name: str) -> set[str]:
    """Every module that a file names in an import, those inside functions included."""
    found = set()
    for node in ast.walk(ast.parse(_file(name).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name}: relative import; name the module in full"
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= members & OURS or ({str(node.module)} - {"spelgen"})
    return found


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
