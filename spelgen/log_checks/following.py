"""How joints follow commanded positions: sums over recordings, from which delays and distances come."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from spelgen.logs.commands import delayed_commands
from spelgen.logs.smoothing import derivative
from spelgen.logs.trajectory import Trajectory, require_commands, split_at_gaps

DELAYS = np.arange(-10, 41) / 100  # s that commands may come before positions
NOW = int(np.argmin(np.abs(DELAYS)))
SHORTEST = 12  # samples of a piece
STILL = 0.25  # s that a command rests before a joint under it is taken to rest
SLOW = 0.02  # rad/s, m/s: below it a joint rests
CLEAR = 0.1  # of the mean square error that a delay leaves, in logarithms
MOVES = 1e-2  # rad, m: commands that move less tell nothing of delays


class Likeness(NamedTuple):
    """place: among `DELAYS`, where the correlation is largest; factor: how far the position moves by the command."""

    place: int
    correlation: float
    factor: float


class Following:
    """Sums over recordings of n joints. count: of samples; far: of those that far from the command, (n,); rest: of
    each joint, distances u - q while both rest.
    """

    def __init__(self, reaches: np.ndarray) -> None:
        """reaches: (n,) distances that are far."""
        delays, n = len(DELAYS), len(reaches)
        self._reaches, self.count, self.far = reaches, 0, np.zeros(n)
        self.rest: list[list[np.ndarray]] = [[] for _ in range(n)]
        # of commands at each delay, of positions, and of both
        self._u, self._uu, self._uq = np.zeros((delays, n)), np.zeros((delays, n)), np.zeros((delays, n, n))
        self._q, self._qq = np.zeros(n), np.zeros(n)
        # of what is between them, and of velocity, acceleration, the sense of motion and 1
        self._squares, self._smooth_squares = np.zeros((2, delays, n))
        self._products = np.zeros((delays, n, 4))
        self._columns = np.zeros((n, 4, 4))

    def add(self, trajectory: Trajectory) -> None:
        """One more recording, piece by piece."""
        for piece in split_at_gaps(trajectory):
            if len(piece) >= SHORTEST:
                self._add(piece)

    def _add(self, piece: Trajectory) -> None:
        commands, q = require_commands(piece)[:-1], _between(piece.q)
        velocity = np.gradient(piece.q, piece.t, axis=0)
        # one filter over all of an equation changes nothing of what it says
        rate = piece.sample_rate
        smooth = derivative(piece.q, rate, 0)
        qd = np.gradient(smooth, piece.t, axis=0)
        slopes = (qd, np.gradient(qd, piece.t, axis=0), derivative(np.tanh(velocity / SLOW), rate, 0))
        columns = np.stack([*(_between(x) for x in slopes), np.ones_like(q)], axis=-1)  # (T, n, 4)
        self._columns += np.einsum("tni,tnj->nij", columns, columns)
        self.count += len(q)
        self._q, self._qq = self._q + q.sum(axis=0), self._qq + np.square(q).sum(axis=0)
        for k, delay in enumerate(DELAYS):
            u = delayed_commands(piece, slice(0, len(piece)), delay, 1)[:, 0]
            self._u[k] += u.sum(axis=0)
            self._uu[k] += np.square(u).sum(axis=0)
            self._uq[k] += u.T @ q
            self._squares[k] += np.square(u - q).sum(axis=0)
            apart = derivative(u - q, rate, 0)
            self._smooth_squares[k] += np.square(apart).sum(axis=0)
            self._products[k] += np.einsum("tn,tni->ni", apart, columns)
        self.far += (np.abs(commands - q) > self._reaches).sum(axis=0)
        span = max(1, round(STILL * piece.sample_rate))
        moved = np.abs(commands - np.roll(commands, span, axis=0)) > 0
        moved[:span] = True
        for joint, rest in enumerate(self.rest):
            rests = ~moved[:, joint] & (np.abs(qd[1:, joint]) < SLOW)
            rest.append((commands - q)[rests, joint])

    def moves(self) -> np.ndarray:
        """Whether a joint's command moves, (n,)."""
        count = max(self.count, 1)
        variance = self._uu[NOW] / count - np.square(self._u[NOW] / count)
        moves: np.ndarray = variance > MOVES**2
        return moves

    def apart(self, joint: int) -> np.ndarray:
        """Root mean square of u - q at each delay, (D,)."""
        apart: np.ndarray = np.sqrt(self._squares[:, joint] / max(self.count, 1))
        return apart

    def likeness(self, joint: int, other: int) -> Likeness:
        """Of the command of one joint with the position of another, maybe itself."""
        count = max(self.count, 1)
        together = self._uq[:, joint, other] - self._u[:, joint] * self._q[other] / count  # (D,)
        own = self._uu[:, joint] - np.square(self._u[:, joint]) / count
        its = self._qq[other] - self._q[other] ** 2 / count
        alike = together / np.sqrt(np.maximum(own * its, 1e-12))
        place = int(np.argmax(np.abs(alike)))
        return Likeness(place, float(alike[place]), float(together[place] / max(own[place], 1e-12)))

    def delay(self) -> tuple[float, float] | None:
        """Between which delays [s] commands act: those where velocity, acceleration and dry friction, none of which
        pushes, explain u - q as well as at the best one, but for `CLEAR`. None where no command moves.
        """
        moving = np.flatnonzero(self.moves()).tolist()
        if not moving:
            return None
        late = np.flatnonzero(DELAYS > -1e-9)
        cost = np.array(
            [np.mean([np.log(self._unexplained(k, joint)) for joint in moving]) for k in late.tolist()]
        )
        good = DELAYS[late[cost < cost.min() + CLEAR]]
        return max(0.0, float(good.min())), float(good.max())

    def _unexplained(self, k: int, joint: int) -> float:
        """The sum of squares of u - q that is left at a delay."""
        columns, products = self._columns[joint], self._products[k, joint]
        count = columns[3, 3]  # of ones: the mean is taken out
        matrix = columns[:3, :3] - np.outer(columns[:3, 3], columns[3, :3]) / count
        target = products[:3] - columns[:3, 3] * products[3] / count
        square = self._smooth_squares[k, joint] - products[3] ** 2 / count
        # what a column's mean was taken from rounds
        factor = np.linalg.cholesky(matrix + np.diag(1e-9 * columns.diagonal()[:3] + 1e-12))
        slopes, _ = nnls(factor.T, np.linalg.solve(factor, target))
        left = square - 2 * target @ slopes + slopes @ matrix @ slopes
        return max(float(left), 1e-12)


def _between(x: np.ndarray) -> np.ndarray:
    """In the middle between samples, where delayed commands are."""
    middle: np.ndarray = (x[1:] + x[:-1]) / 2
    return middle
