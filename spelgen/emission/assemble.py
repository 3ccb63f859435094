"""Assembly of a model in memory from a ``ModelSpec``, with the classes of ``spelgen.runtime``."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, cast

import torch
from torch import Tensor

import spelgen.runtime as runtime
from spelgen.dynamics.parameters import parameter_count
from spelgen.emission.parts import Call, Code, Sums, base_class, entry_sums, model_parts
from spelgen.errors import ModuleError
from spelgen.labels import printable
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.spec import ModelSpec

if TYPE_CHECKING:
    from spelgen.dynamics.prepared import PreparedModel
    from spelgen.dynamics.tip import TipKinematics


class ArmModel(PortHamiltonian):
    """Base class of models that are made in memory, without a module file, from the specification ``spec``.

    Each model has a second base class, from ``spelgen.runtime``, with its dynamics.
    """

    spec: ModelSpec

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    def prepared(self, tip: TipKinematics | None = None) -> PreparedModel:
        """Return a copy in double precision with constant parameters for many calls, as in control loops.

        tip: kinematics of the tip, for its pose and Jacobian.
        """
        from spelgen.dynamics.prepared import PreparedModel

        return PreparedModel(self, tip)

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        # pickle cannot find the model's class by name, because a function makes it: the function is called again.
        return (_without_state, (base_class(self.spec),), *super().__reduce_ex__(protocol)[2:])

    def __repr__(self) -> str:
        sizes = f"{self.n} joints, {parameter_count(self)} parameters"
        return f"<Model of {printable(self.spec.robot)!r} ({self.spec.options.preset}): {sizes}>"

    def _repr_html_(self) -> str:
        from spelgen.emission.text import header

        return f"<pre>{escape(header(self.spec))}</pre>"


def assemble(spec: ModelSpec, seed: int = 0) -> ArmModel:
    """Return the model that ``spec`` describes; seed: seed of the random initial weights of networks.

    Raises ModuleError if the specification has values that no model can have, such as a mass that is not positive.
    """
    assembly = model_parts(spec)
    names: dict[str, object] = {"generator": torch.Generator().manual_seed(seed)}
    # The source of a module defines the function `mass_entries`. In memory, `_mass_entries` replaces it, with the same
    # operations in the same order, so that rounding errors are equal.
    names["mass_entries"] = partial(_mass_entries, entry_sums(spec))
    try:
        # The tables of joints, links and functions are evaluated before the arguments of the model, which refer to the
        # tables by name.
        for name, rows in assembly.rows.items():
            names[name] = tuple(_value(row, names) for row in rows)
        arguments = {str(name): _value(item, names) for name, item in assembly.model.arguments}
        model = _model_class(base_class(spec))(**arguments)
    except (RuntimeError, ValueError, ArithmeticError, LookupError, TypeError) as problem:
        # A user may have edited the specification: a failure of a constructor is reported as an invalid specification.
        reason = " ".join(str(problem).split())[:200]
        raise ModuleError(f"a specification of no model ({reason})", do="build it again") from problem
    model.spec = spec
    return model


def load_module(module: str | Path, *, seed: int = 0) -> ArmModel:
    """Return the model of a module that `spelgen build` wrote; seed: seed of the initial weights of networks.

    module: path of the module, or its text. Raises ModuleError if the module was edited, or is not from `spelgen
    build`.
    """
    from spelgen.emission.text import read_source, require_unedited

    if isinstance(module, str) and "\n" in module:
        return assemble(require_unedited(module), seed)
    file = Path(module)
    return assemble(require_unedited(read_source(file), file), seed)


def spec_of(model: object) -> ModelSpec | None:
    """Return the specification of a model from `assemble`; None for any other object, for example a user's model."""
    return model.spec if isinstance(model, ArmModel) else None


def _mass_entries(rows: list[list[Sums]], *terms: Tensor) -> Tensor:
    """Return the mass matrix M, (..., n, n), from its functions of q and its constants (the terms).

    The function ``mass_entries`` of an emitted module computes the same matrix.

    Args:
        rows: for each row of the lower triangle of M, a list of the entries as linear combinations of the terms.
        terms: values of the functions of q, then of the constants, (...,) each.
    """
    return runtime.symmetric(*([_sum(sums, terms) for sums in row] for row in rows))


def _sum(sums: Sums, terms: tuple[Tensor, ...]) -> Tensor | float:
    """Return a linear combination of terms, (...,) each, computed as in the source text of the emitted module.

    The order of operations is the same, so that rounding errors are equal. sums: pairs (factor, index of a term).
    """
    # Negative terms are subtracted, as in the module's source, so that rounding errors are equal.
    total: Tensor | float = 0
    for position, (factor, index) in enumerate(sums):
        term = terms[index] if abs(factor) == 1 else abs(factor) * terms[index]
        if position == 0:
            total = -term if factor < 0 else term
        else:
            total = total - term if factor < 0 else total + term
    return total


@cache
def _model_class(base: str) -> Callable[..., ArmModel]:
    """Return a class ``Model`` that derives from ``ArmModel`` and from ``base``, a class of ``spelgen.runtime``."""
    # `_model_class` is cached, so that all models with the same base class have the same type.
    return cast("Callable[..., ArmModel]", type("Model", (ArmModel, vars(runtime)[base]), {}))


def _without_state(base: str) -> ArmModel:
    """Return a new model without attributes; pickle calls this function, and then sets the attributes.

    base: name of the class of ``spelgen.runtime`` from which the model is derived.
    """
    model_class = cast("type[ArmModel]", _model_class(base))
    return model_class.__new__(model_class)


def _value(item: object, names: dict[str, object]) -> object:
    """Return the value of an argument of a ``Call``: calls are evaluated, names are replaced by objects in `names`."""
    if isinstance(item, Code):
        return names[item.text]
    if isinstance(item, tuple):
        return tuple(_value(x, names) for x in item)
    if not isinstance(item, Call):
        return item
    positional = [_value(value, names) for name, value in item.arguments if name is None]
    keywords = {name: _value(value, names) for name, value in item.arguments if name is not None}
    return vars(runtime)[item.callee](*positional, **keywords)
