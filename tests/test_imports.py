"""Imports run downward only; what derives knows no torch, what trains knows no symbolic algebra."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "spelgen"

# A file may import only from files above it, or to its left.
ROWS = [
    "errors files labels rendering yaml_document settings",
    "robot xacro_child xacro_input urdf_document urdf_values urdf_elements lint urdf",
    "rational snapping placement chain walk arm",
    "recursion field sampling spans basis expansion symbolic structure nominal",
    "spec plan emit",
    "logs signals windows engine simulate",
    "runs rollout rivals prior progress training_data training_loop training",
    "tip torque examples evaluation",
    "charts plots tables picture learned report",
    "agreement axes meaning second_reading numeric_samples verification",
    "minimal",
    "inspection pipeline",
    "console options model_commands run_commands cli",
    "__init__ __main__",
]
LAYERS = " ".join(ROWS).split()

# What a file may not import, neither itself nor through others.
SYMBOLIC = {"sympy", "flint", "spelgen.arm", "spelgen.symbolic", "spelgen.structure"}
DERIVES = ["urdf", "arm", "symbolic", "structure", "nominal", "plan", "emit", "pipeline"]
TRAINS = ["logs", "training", "evaluation", "report"]
NEVER = {
    "spec": {"sympy", "flint", "torch"},
    **{name: {"torch"} for name in DERIVES},
    **{name: SYMBOLIC for name in TRAINS},
}


def test_every_file_has_a_layer():
    assert sorted(path.stem for path in PACKAGE.glob("*.py")) == sorted(LAYERS)


@pytest.mark.parametrize("name", LAYERS)
def test_imports_only_from_files_above(name):
    own = {module.split(".")[1] for module in imported(name) if module.startswith("spelgen.")}
    assert own <= set(LAYERS[: LAYERS.index(name)])


@pytest.mark.parametrize("name", NEVER)
def test_never_imports(name):
    modules = reached(name)
    forbidden = {m for m in modules for banned in NEVER[name] if m == banned or m.startswith(f"{banned}.")}
    assert not forbidden


def imported(name: str) -> set[str]:
    """Every module that a file names in an import, those inside functions included."""
    found = set()
    for node in ast.walk(ast.parse((PACKAGE / f"{name}.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name}.py: relative import; name the module in full"
            if node.module == "spelgen":
                found |= {
                    f"spelgen.{alias.name}" for alias in node.names if (PACKAGE / f"{alias.name}.py").exists()
                }
            else:
                found.add(str(node.module))
    return found


def reached(name: str) -> set[str]:
    """What `imported` gives for the file and for every file of the package that it reaches."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        new = imported(waiting.pop()) - found
        found |= new
        waiting += [module.split(".")[1] for module in new if module.startswith("spelgen.")]
    return found
