"""The matrix that makes torques of the inertial parameters of a chain of bodies, as fits to torques need it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.port_hamiltonian import applied
from spelgen.runtime.rigid_body import pushed_along, spatial_inertia


def regressor_of(chain: BodyChain, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return Y, (..., n, 10 bodies): Y @ inertial parameters is the bodies' torque.

    ``chain`` is that of this package or of an emitted module.
    """
    basis = spatial_inertia(torch.eye(10).to(q))
    pose = chain.forward(q)
    rises = chain.accelerations(pose, qd, chain.turning(pose, qd)[1]) + applied(pose.twists.mT, qdd)
    rises, twists = (torch.unflatten(rows, -1, (-1, 6)) for rows in (rises, applied(pose.twists.mT, qd)))
    # by body and parameter: (..., bodies, 6, 10)
    momenta = torch.tensordot(twists, basis, dims=([-1], [2])).mT
    wrenches = torch.tensordot(rises, basis, dims=([-1], [2])).mT
    wrenches = wrenches + pushed_along(twists.unsqueeze(-1), momenta)
    columns = torch.unflatten(pose.twists, -1, (-1, 6)).transpose(-3, -2)  # (..., bodies, n, 6)
    rows: Tensor = (columns @ wrenches).transpose(-3, -2)
    return rows.reshape(*q.shape, 10 * len(chain.parents))


def chain_regressor(chain: BodyChain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return the same (T, n, 10 bodies) of arrays (T, n)."""
    # copies: torch takes no views that run backwards, as filters give them
    states = [torch.from_numpy(np.array(x, dtype=float)) for x in (q, qd, qdd)]
    with torch.no_grad():
        return np.asarray(regressor_of(chain, *states))
