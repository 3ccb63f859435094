"""The calls by which a C entry point gets what it is given of a model's residuals."""

from __future__ import annotations

from collections.abc import Sequence

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.entry_points import RESIDUAL
from spelgen.exporting.residual_expressions import ResidualSymbols

_CALLS = (
    (("first", "second"), "mass_jets(q", ("mass", "first", "second")),
    (("rate", "kinetic"), "mass_rates(encoded, qd", ("mass", "rate", "kinetic")),
    (("mass",), "mass_values(encoded", ("mass",)),
    (("stiffness",), "potential_jets(q", ("gravity", "stiffness")),
    (("gravity",), "potential_gradient(encoded", ("gravity",)),
    (("energy",), "potential_value(encoded", ("energy",)),
    (("torque", "torque_slope"), "joint_torques(q", ("torque", "torque_slope")),
    (("torque_energy",), "joint_energies(q", ("torque_energy",)),
    (("factor", "factor_slope"), "friction_factors(q", ("factor", "factor_slope")),
)
"""What is asked for, the call that answers, and all that it writes; of what is left, by the first that knows."""


def residual_calls(model: TrainedModel, names: Sequence[str]) -> list[str]:
    """The statements that work out these ``ResidualSymbols`` as variables, of q, and of qd where they need it."""
    left, symbols = set(names), ResidualSymbols.of(model)
    calls: list[tuple[str, tuple[str, ...]]] = []
    for asked, call, written in _CALLS:
        if left & set(asked):
            calls.append((call, written))
            left -= set(written)
    if not calls:
        return []
    variables = [f"{RESIDUAL}{name}[{getattr(symbols, name).numel()}]" for _, each in calls for name in each]
    encoded = any("(encoded" in call for call, _ in calls)
    return [
        f"real {', '.join([*(['encoded[ENCODED]'] * encoded), *variables])};",
        *(["encode(q, encoded);"] * encoded),
        *(f"{call}, {', '.join(f'{RESIDUAL}{name}' for name in written)});" for call, written in calls),
    ]
