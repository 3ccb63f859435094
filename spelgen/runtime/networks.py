"""Networks in which each output depends on specified joints only, and the encoding of q as their input."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.parts import Intermediates, Layers, Rows
from spelgen.runtime.rows import Joint, vector

GRID = 4  # number of Gaussians in the function of one edge of a Kolmogorov-Arnold network
SPACING = 2 / (GRID - 1)


class JointEncoding(nn.Module):
    """Encoding of joint positions as inputs of networks, (..., 2 n): cos q of all joints, then sin q.

    A prismatic joint has the scaled position (q - center) / half_range in place of cos q, and 0 in place of
    sin q, with ``center`` and ``half_range`` of its ``Joint``.
    """

    def __init__(self, joints: Sequence[Joint]) -> None:
        super().__init__()
        self.revolute = nn.Buffer(vector(joint.joint_type == "revolute" for joint in joints))
        self.center = nn.Buffer(vector(joint.center for joint in joints))
        # `slope`: derivative of the scaled position with respect to q, (n,); zero for revolute joints.
        self.slope = nn.Buffer((1 - self.revolute) / vector(joint.half_range for joint in joints))

    def forward(self, q: Tensor) -> Tensor:
        """Return the encoding of q, (..., n) [rad, m]: cos q, then sin q (see the class), (..., 2 n)."""
        scaled = self.slope * (q - self.center)
        return torch.cat([torch.addcmul(scaled, self.revolute, q.cos()), self.revolute * q.sin()], dim=-1)

    def jvp(self, encoded: Tensor, qd: Tensor) -> Tensor:
        """Return the time derivative of the encoding, (..., 2 n), at the velocity qd, (..., n).

        encoded: encoding of q, (..., 2 n).
        """
        first, second = encoded.chunk(2, dim=-1)
        return torch.cat([(self.slope - second) * qd, self.revolute * first * qd], dim=-1)

    def vjp(self, encoded: Tensor, cotangent: Tensor) -> Tensor:
        """Return the gradient of a scalar function of q with respect to q, (..., n), by the chain rule.

        Args:
            encoded: encoding of q, (..., 2 n): cos q, then sin q (for prismatic joints see the class).
            cotangent: gradient of the function with respect to the encoding, (..., 2 n).
        """
        first, second = encoded.chunk(2, dim=-1)
        by_first, by_second = cotangent.chunk(2, dim=-1)
        return by_first * (self.slope - second) + by_second * self.revolute * first


def hidden_units(outputs: Sequence[tuple[int, ...]], width: int, min_units: int) -> list[tuple[int, ...]]:
    """Return for each unit of a hidden layer the indices of the joints that the unit may depend on.

    Outputs of the network that depend on the same joints form a group. The units are divided among the groups
    in proportion to their numbers of outputs.

    Args:
        outputs: for each output of the network, the indices of the joints that it depends on.
        width: number of units of the layer.
        min_units: smallest number of units of a group; the layer is wider than ``width`` if necessary.
    """
    counts = Counter(outputs)
    groups = sorted(counts, key=lambda joints: (len(joints), joints))
    ideal = [width * counts[group] / len(outputs) for group in groups]
    units = [max(min_units, round(share)) for share in ideal]
    index = range(len(groups))
    # The sum of the rounded numbers of units of all groups may differ from `width`. The groups with the
    # largest rounding errors are corrected first.
    while sum(units) > width and max(units) > min_units:
        units[max(index, key=lambda k: units[k] - ideal[k] if units[k] > min_units else -width)] -= 1
    while sum(units) < width:
        units[max(index, key=lambda k: ideal[k] - units[k])] += 1
    return [group for group, count in zip(groups, units, strict=True) for _ in range(count)]


def joint_masks(
    joints: Sequence[Joint],
    scales: Rows,
    outputs: Sequence[Sequence[str]],
    width: int,
    depth: int,
    min_units: int,
) -> Iterator[Tensor]:
    """Yield a mask for each layer of a network, (units, inputs): the factors of the layer's weights.

    A factor is 0 if the input depends on a joint that the unit must not depend on, so that each output of the
    network depends on specified joints only. All other factors are 1 in hidden and output layers. In the
    first layer, they are the scales of the inputs, which make inputs with a small influence on the outputs
    small.

    Args:
        joints: joints of the arm.
        scales: scales of the network's inputs, (inputs per joint, n); the inputs of each joint are, for
            example, cos q and sin q.
        outputs: names of the joints that each output depends on.
        width: number of units of each hidden layer.
        depth: number of hidden layers.
        min_units: smallest number of hidden units per layer for all outputs that depend on the same
            joints.
    """
    number = {joint.name: index for index, joint in enumerate(joints)}
    numbers = [tuple(number[name] for name in names) for names in outputs]
    hidden = [hidden_units(numbers, width, min_units)] * depth
    below = [{joint} for row in scales for joint in range(len(row))]
    scale = torch.cat([vector(row) for row in scales])
    for layer in [*hidden, numbers]:
        units = [set(unit) for unit in layer]
        yield scale * torch.stack([vector(lower <= unit for lower in below) for unit in units])
        below, scale = units, torch.ones(len(units), dtype=torch.float64)


class MaskedNetwork(nn.Module):
    """Base class of networks in which each output depends on specified joints only.

    ``prepare`` returns the masked layers, ``forward`` evaluates them, ``vjp`` and ``jvp`` return explicit
    derivatives of the outputs with respect to the inputs.

    Args:
        generator: random generator of the initial weights; the weights of the last layer are zero.
        joints: joints of the arm.
        scales: factors of the inputs, (inputs per joint, n). The inputs of each joint are cos q or the
            scaled q (see ``JointEncoding``), sin q, and any others, such as qd.
        outputs: names of the joints that each output depends on; masks set the weights of all paths from
            other joints to zero.
        width, depth: number of units of a hidden layer, and number of hidden layers.
        min_units: smallest number of hidden units per layer for all outputs that depend on the same
            joints.
    """

    points = 0  # number of Gaussians in the function of an edge (input to unit); 0: the edge is one weight

    # ``forward`` returns the outputs, (..., rows), of the layers that ``prepare`` returned, and the
    # intermediate values that ``vjp`` and ``jvp`` need.
    forward: Callable[[Tensor, Layers], tuple[Tensor, Intermediates]]
    vjp: Callable[[Intermediates, Tensor], Tensor]  # returns cotangent^T J, with J = d outputs / d inputs
    jvp: Callable[[Intermediates, Tensor], Tensor]  # returns J tangent, with J = d outputs / d inputs

    def __init__(
        self,
        generator: torch.Generator,
        joints: Sequence[Joint],
        *,
        scales: Rows,
        outputs: Sequence[Sequence[str]],
        width: int = 64,
        depth: int = 2,
        min_units: int = 1,
    ) -> None:
        super().__init__()
        # The initial weights of an edge (input to unit) are one random number times `slopes`: 1 for a
        # single weight. An edge with a sum of Gaussians has weights that increase linearly over the
        # Gaussians' grid, so that the sum is a nearly linear function of the input.
        slopes = torch.ones((), dtype=torch.float64)
        if self.points:
            slopes = torch.linspace(-1, 1, self.points, dtype=torch.float64)
            self.grid = nn.Buffer(slopes / SPACING)
        masks = joint_masks(joints, scales, outputs, width, depth, min_units)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for index, mask in enumerate(masks):
            edges = mask.unsqueeze(-1) if self.points else mask
            weight = torch.randn(edges.shape, dtype=torch.float64, generator=generator)
            readable = (edges != 0).double().sum(dim=1, keepdim=True)
            self.weights.append(nn.Parameter(weight * slopes / readable.sqrt()))
            self.biases.append(nn.Parameter(torch.zeros(len(mask), dtype=torch.float64)))
            self.register_buffer(f"mask{index}", edges)
        nn.init.zeros_(self.weights[-1])  # The initial outputs of the network are zero.

    def prepare(self, output_map: Tensor, offset: Tensor) -> Layers:
        """Return the layers (masked weights and biases) of a network with outputs offset + output_map y.

        y, (..., outputs), are the outputs of this network. The weights of the last layer are multiplied by
        output_map, which saves an operation per evaluation.

        Args:
            output_map: (rows, outputs).
            offset: (rows,).
        """
        weights = [(w * self.get_buffer(f"mask{i}")).flatten(1) for i, w in enumerate(self.weights)]
        biases = list(self.biases)
        weights[-1], biases[-1] = output_map @ weights[-1], offset + output_map @ biases[-1]
        return tuple(zip(weights, biases, strict=True))


class MaskedMLP(MaskedNetwork):
    """A multilayer perceptron with tanh units; arguments: see ``MaskedNetwork``."""

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, Intermediates]:
        """Return the outputs, (..., rows), at the inputs ``encoded``, and values for the derivatives.

        encoded: inputs, (..., inputs). layers: from ``prepare``. ``vjp`` and ``jvp`` need the second result,
        the intermediate values of the layers.
        """
        layer, hidden = encoded, []
        for weight, bias in layers[:-1]:
            layer = torch.tanh(F.linear(layer, weight, bias))
            hidden.append(layer)
        return F.linear(layer, *layers[-1]), (hidden, layers)

    def vjp(self, intermediates: Intermediates, cotangent: Tensor) -> Tensor:
        """Return cotangent^T J, (..., inputs), with J = d outputs / d inputs; cotangent: (..., rows).

        intermediates: from ``forward`` at the same inputs.
        """
        hidden, layers = intermediates
        layer: Tensor = cotangent @ layers[-1][0]
        for (weight, _), value in zip(reversed(layers[:-1]), reversed(hidden), strict=True):
            # tanh_backward(x, y) is x (1 - y^2).
            layer = torch.ops.aten.tanh_backward(layer, value) @ weight
        return layer

    def jvp(self, intermediates: Intermediates, tangent: Tensor) -> Tensor:
        """Return J tangent, (..., rows), with J = d outputs / d inputs; tangent: (..., inputs).

        intermediates: from ``forward`` at the same inputs.
        """
        hidden, layers = intermediates
        for (weight, _), value in zip(layers[:-1], hidden, strict=True):
            tangent = torch.ops.aten.tanh_backward(F.linear(tangent, weight), value)
        return F.linear(tangent, layers[-1][0])


class Bumps(NamedTuple):
    """Arguments and values of the GRID Gaussians per input of a ``MaskedKAN`` layer, (..., inputs, GRID)."""

    distance: Tensor  # argument of the Gaussian: input minus grid point (signed), in grid spacings
    height: Tensor


class MaskedKAN(MaskedNetwork):
    """A Kolmogorov-Arnold network; arguments: see ``MaskedNetwork``.

    Each edge from an input to a unit has a learned function: a sum of ``GRID`` Gaussians on a grid over
    [-1, 1] (Li, arXiv 2405.06721, in place of the splines of Liu et al., arXiv 2404.19756). The initial
    functions are nearly linear with random slopes, because training on few samples does not smooth a
    function that is wavy at first. tanh keeps the outputs of a hidden layer within the grid.
    """

    points = GRID

    def _bumps(self, value: Tensor) -> Bumps:
        distance = (value / SPACING).unsqueeze(-1) - self.grid
        return Bumps(distance, torch.exp(-distance * distance))

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, Intermediates]:
        """Return the outputs, (..., rows), at the inputs ``encoded``, and values for the derivatives.

        encoded: inputs, (..., inputs). layers: from ``prepare``. ``vjp`` and ``jvp`` need the second result,
        the intermediate values of the layers.
        """
        bumps, hidden = [self._bumps(encoded)], []
        for weight, bias in layers[:-1]:
            hidden.append(torch.tanh(F.linear(bumps[-1].height.flatten(-2), weight, bias)))
            bumps.append(self._bumps(hidden[-1]))
        return F.linear(bumps[-1].height.flatten(-2), *layers[-1]), (bumps, hidden, layers)

    def vjp(self, intermediates: Intermediates, cotangent: Tensor) -> Tensor:
        """Return cotangent^T J, (..., inputs), with J = d outputs / d inputs; cotangent: (..., rows).

        intermediates: from ``forward`` at the same inputs.
        """
        bumps, hidden, layers = intermediates
        layer = self._bumps_vjp(bumps[-1], cotangent @ layers[-1][0])
        for index in reversed(range(len(hidden))):
            layer = layer * (1 - hidden[index] * hidden[index])
            layer = self._bumps_vjp(bumps[index], layer @ layers[index][0])
        return layer

    def _bumps_vjp(self, bumps: Bumps, cotangent: Tensor) -> Tensor:
        cotangent = cotangent.reshape(*cotangent.shape[:-1], *bumps.distance.shape[-2:])
        return (-2 / SPACING) * (bumps.distance * bumps.height * cotangent).sum(dim=-1)

    def jvp(self, intermediates: Intermediates, tangent: Tensor) -> Tensor:
        """Return J tangent, (..., rows), with J = d outputs / d inputs; tangent: (..., inputs).

        intermediates: from ``forward`` at the same inputs.
        """
        bumps, hidden, layers = intermediates
        for index, (weight, _) in enumerate(layers):
            slopes = bumps[index].distance * bumps[index].height
            tangent = F.linear((-2 / SPACING) * (slopes * tangent.unsqueeze(-1)).flatten(-2), weight)
            if index < len(hidden):
                tangent = tangent * (1 - hidden[index] * hidden[index])
        return tangent
