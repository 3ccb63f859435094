"""The networks of a model as C: tables of weights, and loops over them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.exporting.c_tables import Table, integer_table, table
from spelgen.exporting.description import Encoding, Network, TrainedModel
from spelgen.exporting.residual_expressions import entry_places
from spelgen.templates import render


@dataclass(frozen=True)
class _CNetwork:
    """A network's name and the fields of its layers."""

    name: str
    layers: tuple[str, ...]


def network_source(model: TrainedModel) -> str:
    """The C text of all networks; empty where there are none."""
    residuals, n, places = model.residuals, model.n, entry_places(model)
    chosen: list[tuple[str, Network, Sequence[int]]] = []
    if residuals.mass is not None:
        chosen.append(("mass", residuals.mass, [row * n + column for row, column in places]))
    if residuals.potential is not None:
        chosen.append(("potential", residuals.potential, [0]))
    if not chosen:
        return ""
    tables: list[Table] = list(_scaling(residuals.encoding))
    networks: list[_CNetwork] = []
    for name, network, rows in chosen:
        weights, biases = list(network.weights), list(network.biases)
        weights[-1], biases[-1] = weights[-1][rows], biases[-1][rows]
        layers = []
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            prefix = f"{name}_{index + 1}"
            tables += _layer_tables(prefix, weight, bias)
            fields = ", ".join(f"{prefix}_{field}" for field in ("bias", "weight", "first", "last"))
            layers.append(f"{weight.shape[1]}, {weight.shape[0]}, {fields}")
        networks.append(_CNetwork(name, tuple(layers)))
    encoded = (3 if residuals.encoding.prismatic else 2) * n
    sizes = [weight.shape[0] for _, network, _ in chosen for weight in network.weights[:-1]]
    return render(
        "networks.c.jinja",
        n=n,
        hidden=max(len(network.weights) - 1 for _, network, _ in chosen),
        width=max([*sizes, len(places), encoded]),
        encoded=encoded,
        lanes=1 + n + n * (n + 1) // 2,
        scaled=residuals.encoding.prismatic,
        tables=tables,
        networks=networks,
        entries=len(places),
        places=", ".join(f"{{{row}, {column}}}" for row, column in places),
        potential=residuals.potential is not None,
    ).rstrip()


def _scaling(encoding: Encoding) -> Iterator[Table]:
    if encoding.prismatic:
        yield table("center", encoding.center)
        yield table("reach", encoding.reach)


def _layer_tables(prefix: str, weight: np.ndarray, bias: np.ndarray) -> Iterator[Table]:
    """bias, weight by input from first to last, first and last."""
    first, last, packed = [], [], []
    for column in weight.T:
        reached = np.flatnonzero(column)
        start, stop = (int(reached[0]), int(reached[-1]) + 1) if len(reached) else (0, 0)
        first.append(start)
        last.append(stop)
        packed.append(column[start:stop])
    yield table(f"{prefix}_bias", bias)
    yield table(f"{prefix}_weight", np.concatenate(packed))
    yield integer_table(f"{prefix}_first", first)
    yield integer_table(f"{prefix}_last", last)
