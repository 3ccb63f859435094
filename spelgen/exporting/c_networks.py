"""The networks of a model as C: tables of weights, loops over them, and the calls that an entry point needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from textwrap import wrap

import numpy as np

from spelgen.exporting.description import Encoding, Functions, TrainedModel
from spelgen.exporting.learned_expressions import entry_places, has_potential_network
from spelgen.templates import render

_WIDTH = 112


@dataclass(frozen=True)
class Table:
    """A constant array."""

    type: str
    name: str
    rows: str


@dataclass(frozen=True)
class Network:
    """A network's name and the fields of its layers."""

    name: str
    layers: tuple[str, ...]


def network_source(model: TrainedModel) -> str:
    """The C text of all networks; empty where there are none."""
    learned, n = model.learned, model.n
    places, potential = entry_places(model), has_potential_network(model)
    if learned is None or not (places or potential):
        return ""
    lower = [row * n + column for row, column in places]
    chosen: list[tuple[str, Functions, Sequence[int]]] = []
    if places:
        chosen.append(("mass", learned.mass, lower))
    if potential and learned.potential is not None:
        chosen.append(("potential", learned.potential, [0]))
    tables: list[Table] = list(_scaling(learned.encoding))
    networks: list[Network] = []
    for name, functions, rows in chosen:
        weights, biases = list(functions.weights), list(functions.biases)
        weights[-1], biases[-1] = weights[-1][rows], biases[-1][rows]
        layers = []
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            prefix = f"{name}_{index + 1}"
            tables += _layer_tables(prefix, weight, bias)
            fields = ", ".join(f"{prefix}_{field}" for field in ("bias", "weight", "first", "last"))
            layers.append(f"{weight.shape[1]}, {weight.shape[0]}, {fields}")
        networks.append(Network(f"{name}_network", tuple(layers)))
    encoded = (3 if learned.encoding.prismatic else 2) * n
    sizes = [weight.shape[0] for _, functions, _ in chosen for weight in functions.weights[:-1]]
    return render(
        "networks.c.jinja",
        n=n,
        depth=len(chosen[0][1].weights),
        width=max([*sizes, len(places), encoded]),
        encoded=encoded,
        lanes=1 + n + n * (n + 1) // 2,
        scaled=learned.encoding.prismatic,
        tables=tables,
        networks=networks,
        entries=len(places),
        places=", ".join(f"{{{row}, {column}}}" for row, column in places),
        potential=potential,
    ).rstrip()


def network_calls(model: TrainedModel, names: Sequence[str]) -> list[str]:
    """The statements that work out what an entry point is given of the networks, as variables of these names."""
    given = set(names)
    calls: list[tuple[str, tuple[str, ...]]] = []
    if given & {"first", "second"}:
        calls.append(("mass_jets(q", ("mass", "first", "second")))
    elif given & {"rate", "kinetic"}:
        calls.append(("mass_rates(encoded, qd", ("mass", "rate", "kinetic")))
    elif "mass" in given:
        calls.append(("mass_values(encoded", ("mass",)))
    if "stiffness" in given:
        calls.append(("potential_jets(q", ("gravity", "stiffness")))
    elif "gravity" in given:
        calls.append(("potential_gradient(encoded", ("gravity",)))
    if "energy" in given:
        calls.append(("potential_value(encoded", ("energy",)))
    if not calls:
        return []
    sizes = _sizes(model)
    variables = [f"network_{name}[{sizes[name]}]" for _, written in calls for name in written]
    encoded = any("(encoded" in call for call, _ in calls)
    return [
        f"real {', '.join([*(['encoded[ENCODED]'] * encoded), *variables])};",
        *(["encode(q, encoded);"] * encoded),
        *(f"{call}, {', '.join(f'network_{name}' for name in written)});" for call, written in calls),
    ]


def _sizes(model: TrainedModel) -> dict[str, int]:
    """Numbers of each thing that networks give."""
    n, entries = model.n, len(entry_places(model))
    pairs = n * (n + 1) // 2
    of_mass = {
        "mass": entries,
        "rate": entries,
        "kinetic": n,
        "first": entries * n,
        "second": entries * pairs,
    }
    return of_mass | {"gravity": n, "energy": 1, "stiffness": pairs}


def _scaling(encoding: Encoding) -> Iterator[Table]:
    if encoding.prismatic:
        yield Table("real", "center", _numbers(encoding.center))
        yield Table("real", "reach", _numbers(encoding.reach))


def _layer_tables(prefix: str, weight: np.ndarray, bias: np.ndarray) -> Iterator[Table]:
    """bias, weight by input from first to last, first and last."""
    first, last, packed = [], [], []
    for column in weight.T:
        reached = np.flatnonzero(column)
        start, stop = (int(reached[0]), int(reached[-1]) + 1) if len(reached) else (0, 0)
        first.append(start)
        last.append(stop)
        packed.append(column[start:stop])
    yield Table("real", f"{prefix}_bias", _numbers(bias))
    yield Table("real", f"{prefix}_weight", _numbers(np.concatenate(packed)))
    yield Table("short", f"{prefix}_first", _integers(first))
    yield Table("short", f"{prefix}_last", _integers(last))


def _numbers(values: np.ndarray) -> str:
    return "\n".join(
        wrap(
            ", ".join(repr(float(x)) for x in values), _WIDTH, initial_indent="    ", subsequent_indent="    "
        )
    )


def _integers(values: Sequence[int]) -> str:
    return "\n".join(
        wrap(", ".join(map(str, values)), _WIDTH, initial_indent="    ", subsequent_indent="    ")
    )
