"""Imports follow the layers of the package; derivation imports no torch, and fits import no symbolic algebra."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "spelgen"

# Files that are copied into emitted modules: they import torch, parts of the standard library and one another.
RUNTIME = [
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for path in sorted((PACKAGE / "runtime").rglob("*.py"))
    if path.stem != "__init__"
]
CARRIED = {"__future__", "collections", "functools", "math", "torch", "typing"}

# A folder (or a file of the top level) may import only from itself and from folders before it in this list.
ROWS = """
version errors labels listing tasks templates runtime files
urdf settings arm design spec
structure dynamics emission
certificate logs
identification excitation simulation
log_checks baselines
fitting
live
exporting
evaluation
comparison
render
cli __init__ __main__
"""
FOLDERS = ROWS.split()

FILES = [".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in sorted(PACKAGE.rglob("*.py"))]
LAYERS = [name for name in FILES if not name.endswith(".__init__")]
OURS = {f"spelgen.{name}" for name in LAYERS}

# Exact arithmetic, which fits and pages of runs must not import, neither directly nor through other modules.
SYMBOLIC = {"sympy", "flint", "spelgen.arm", "spelgen.structure"}
# Exception to SYMBOLIC: every file may import this module of `arm`. It computes the input matrix G (joint torques per
# drive torque) from the URDF and the settings in floating point, without exact arithmetic.
PLAIN = {"spelgen.arm.actuation"}
DERIVING = ("urdf.", "arm.", "structure.", "emission.", "certificate.")
# Modules of `emission` that make models in memory, and therefore import torch.
MODELS = {f"emission.{name}" for name in ("assemble", "build")}
DERIVES = [x for x in LAYERS if x.startswith(DERIVING) and x not in MODELS]
OF_A_RUN = {f"render.{name}" for name in ("charts", "scene")}
# Fits must not import the exact arithmetic in SYMBOLIC. These two modules are exceptions: with each fit, they fit a
# least-squares baseline, which needs the exact base parameters.
LEAST_SQUARES = ("fitting.fit", "fitting.train")
FITS = [x for x in LAYERS if x.startswith(("logs.", "fitting.")) and x not in LEAST_SQUARES]
NEVER = {
    "spec": {"sympy", "flint", "torch"},
    **{name: {"torch"} for name in DERIVES},
    **{name: SYMBOLIC for name in [*FITS, *sorted(OF_A_RUN)]},
}


def folder(name: str) -> str:
    return name.split(".")[0]


def test_every_file_imports_only_from_its_layer_and_those_above():
    """Each file imports only from its own folder and from folders before it in FOLDERS.

    The runtime, which emitted modules contain, imports only itself, torch and the standard library (CARRIED).
    """
    assert {folder(name) for name in FILES} == set(FOLDERS)
    wrong = {}
    for name in LAYERS:
        allowed = set(FOLDERS[: FOLDERS.index(folder(name)) + 1])
        modules = {x for x in imported(name) if x.startswith("spelgen.")}
        wrong[name] = {x for x in modules if folder(x.removeprefix("spelgen.")) not in allowed}
    own = {"spelgen.runtime", *(f"spelgen.{name}" for name in RUNTIME)}
    for name in RUNTIME:
        wrong[name] = {x for x in imported(name) - own if x.split(".")[0] not in CARRIED}
    assert {name: found for name, found in wrong.items() if found} == {}


def test_no_file_imports_a_module_that_is_excluded_for_it():
    """No file imports a module that the table `NEVER` forbids for it, neither directly nor through other files.

    For example, the files of `arm` must not import torch.
    """
    wrong = {}
    for name, never in NEVER.items():
        modules = reached(name) - PLAIN
        wrong[name] = {m for m in modules for banned in never if m == banned or m.startswith(f"{banned}.")}
    assert {name: found for name, found in wrong.items() if found} == {}


@cache
def imported(name: str) -> frozenset[str]:
    """Return the modules that a file names in imports, those inside functions included."""
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
    """Return all modules that a file imports directly or through other files of the package."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        new = imported(waiting.pop()) - found
        found |= new
        waiting += [module.removeprefix("spelgen.") for module in new if module.startswith("spelgen.")]
    return found


def _file(name: str) -> Path:
    path = PACKAGE.joinpath(*name.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
