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

# A folder (or a file at the top) may import only from itself and from what stands above it.
ROWS = """
version errors labels listing tasks templates runtime files
urdf settings arm design spec
structure dynamics
certificate emission logs pipeline
identification excitation simulation
log_checks baselines
fitting
exporting
evaluation
comparison
render
cli __init__ __main__
"""
ROOMS = ROWS.split()

FILES = [".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in sorted(PACKAGE.rglob("*.py"))]
LAYERS = [name for name in FILES if not name.endswith(".__init__")]
OURS = {f"spelgen.{name}" for name in LAYERS}

# What a file may not import, neither itself nor through others.
SYMBOLIC = {"sympy", "flint", "spelgen.arm", "spelgen.structure"}
PLAIN = {"spelgen.arm.actuation"}  # G by the files, without the exact arithmetic of its room
ROOMS_THAT_DERIVE = ("urdf.", "arm.", "structure.", "emission.", "certificate.")
DERIVES = [x for x in LAYERS if x.startswith(ROOMS_THAT_DERIVE) and x != "emission.loading"]
OF_A_RUN = {f"render.{name}" for name in ("charts", "plots", "page", "scene")}
LEAST_SQUARES = ("fitting.fit", "fitting.train")  # fit least squares as well, whose base parameters are exact
FITS = [x for x in LAYERS if x.startswith(("logs.", "fitting.")) and x not in LEAST_SQUARES]
NEVER = {
    "spec": {"sympy", "flint", "torch"},
    "pipeline.generate": {"torch"},
    **{name: {"torch"} for name in DERIVES},
    **{name: SYMBOLIC for name in [*FITS, *sorted(OF_A_RUN)]},
}


def room(name: str) -> str:
    return name.split(".")[0]


def test_every_file_has_a_room():
    assert {room(name) for name in FILES} == set(ROOMS)


def test_runtime_needs_torch_alone():
    allowed = {"spelgen.runtime", *(f"spelgen.{name}" for name in RUNTIME)}
    for name in RUNTIME:
        assert not {x for x in imported(name) - allowed if x.split(".")[0] not in CARRIED}, name


@pytest.mark.parametrize("name", [x for x in LAYERS if x not in RUNTIME])
def test_imports_only_from_rooms_above(name):
    own = {
        room(module.removeprefix("spelgen.")) for module in imported(name) if module.startswith("spelgen.")
    }
    assert own <= set(ROOMS[: ROOMS.index(room(name)) + 1])


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
