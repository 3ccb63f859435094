"""A module's source -> an instance of its ``Model``. Loading runs the source: load what you would run."""

from __future__ import annotations

import ast
import hashlib
import linecache
import sys
from functools import lru_cache
from html import escape
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any, cast

import torch

from spelgen.dynamics.parameters import parameter_count
from spelgen.dynamics.prepared import PreparedModel
from spelgen.errors import ModuleError
from spelgen.labels import printable
from spelgen.spec import Facts, parse_facts, read_source

METHODS = (
    "mass_matrix", "potential_energy", "gravity", "nonlinear_effects", "friction_torque", "dissipation",
    "input_matrix", "momentum", "velocity", "hamiltonian", "forward_dynamics", "inverse_dynamics", "forward",
    "prepare", "port_hamiltonian_rhs",
)  # fmt: skip
_EXPECTED = "a module written by this version of `spelgen build`"

if TYPE_CHECKING:
    from spelgen.dynamics.tip import TipKinematics
    from spelgen.runtime.port_hamiltonian import PortHamiltonian

    class EmittedModel(PortHamiltonian):
        """The class ``Model`` of an emitted module, whose own docstrings hold shapes and units."""

        source: str
        """The module's text, as it was loaded."""
        facts: Facts

        def __getattr__(self, name: str) -> Any: ...  # what a preset has beside this
        def prepared(
            self, tip: TipKinematics | None = None, *, dtype: torch.dtype = torch.float64
        ) -> PreparedModel: ...


def load_module(module: str | Path, *, seed: int = 0) -> EmittedModel:
    """An instance of the class ``Model`` of an emitted module, with its ``source`` and ``facts``.

    ``module`` is the file, or the source text itself. ``seed``: of the weights that it starts with. Raises
    ModuleError for what is no emitted module, or one of another version.
    """
    in_memory = isinstance(module, str) and "\n" in module
    file = None if in_memory else Path(module)
    source = str(module) if file is None else read_source(file)
    facts = parse_facts(source, file)
    name = _private_name(source)
    code = sys.modules[name] = ModuleType(name)  # torch.compile looks for it there
    path = f"<{name}>" if file is None else str(file)
    linecache.cache[path] = (len(source), None, source.splitlines(keepends=True), path)  # for tracebacks
    try:
        exec(_compiled(source, path), vars(code))
        model = code.Model(seed=seed)
    except Exception as error:
        problem = f"import fails ({type(error).__name__}: {error})"
        raise ModuleError(problem, file=file, do="build it again") from error
    missing = [name for name in ("n", "joint_names", "joint_types", *METHODS) if not hasattr(model, name)]
    if missing or not isinstance(model, torch.nn.Module):
        raise ModuleError(f"a class Model without {', '.join(missing)}", file=file, expected=_EXPECTED)
    # neither how a notebook shows it nor its deployment is a matter of the module, which stands alone
    code.Model.__repr__, code.Model._repr_html_, code.Model.prepared = _summary, _page, _prepared
    emitted = cast("EmittedModel", model)
    emitted.source, emitted.facts = source, facts
    return emitted


@lru_cache(maxsize=8)  # a run loads one module again and again
def _compiled(source: str, path: str) -> CodeType:
    return compile(source, path, "exec")


def has_run(source: str) -> bool:
    """Whether this very text was loaded in this process before."""
    return _private_name(source) in sys.modules


def _private_name(source: str) -> str:
    """Made from the content, so that two modules never meet."""
    return f"_spelgen_module_{hashlib.sha256(source.encode()).hexdigest()}"


def _summary(model: EmittedModel) -> str:
    sizes = f"{model.n} joints, {parameter_count(model)} parameters"
    return f"<Model of {printable(model.facts.robot)!r} ({model.facts.options.preset}): {sizes}>"


def _page(model: EmittedModel) -> str:
    """The module's docstring: what M is made of, and the joints."""
    return f"<pre>{escape(ast.get_docstring(ast.parse(model.source)) or '')}</pre>"


def _prepared(
    model: EmittedModel, tip: TipKinematics | None = None, *, dtype: torch.dtype = torch.float64
) -> PreparedModel:
    """The model as it is now, ready for many calls; see ``PreparedModel``."""
    return PreparedModel(model, tip, dtype=dtype)
