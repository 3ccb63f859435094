"""The payload filter, and two more filters for the hypotheses of a changed load and of a contact."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator

from spelgen.live.blocks import Block
from spelgen.live.filters import LoadFilter
from spelgen.live.noise import NoiseLevels
from spelgen.live.tuning import TUNING


class PayloadEstimate:
    """The payload filter, and two more filters for the hypotheses of a changed load and of a contact.

    The rows of a block (one per joint and filter) are spread over the samples of the next block, to bound the time per
    sample. moved: time in motion since the start or the last change of load [s].
    """

    def __init__(self, levels: NoiseLevels) -> None:
        self.levels = levels
        self.filters = [LoadFilter(levels.load, levels.effort)]
        self.block: Block | None = None
        self.rows: Iterator[None] = iter(())
        self.moved = self.hypotheses_moved = 0.0
        self.changed = False
        self.samples = self.per_sample = 0

    def start(self, block: Block) -> None:
        """Process the remaining rows of the former block, and begin with this block."""
        self.advance(len(self.filters) * len(self.levels.effort))
        if block.moving.any():
            self.moved += block.duration
            self.hypotheses_moved += block.duration
        self.block = block
        rows = len(self.filters) * len(self.levels.effort)
        self.per_sample = -(-rows // max(self.samples - 1, 1))
        self.samples = 0
        self.rows = self._rows(block)

    def step(self) -> None:
        """Process the share of rows of one sample."""
        self.samples += 1
        self.advance(self.per_sample)

    def advance(self, rows: int) -> None:
        """Process the next `rows` rows of the block."""
        for _ in range(rows):
            next(self.rows, None)

    def _rows(self, block: Block) -> Iterator[None]:
        for each in self.filters:
            each.predict(block.duration)
        for each in self.filters:
            for joint in range(len(block.y)):
                each.update(block, joint)
                if each is self.filters[-1] and joint == len(block.y) - 1:
                    self._compare(int(block.moving.sum()))
                yield

    def _compare(self, moving: int) -> None:
        """Begin, accept or drop the hypotheses of a changed load and of a contact; moving: number of moving joints."""
        main = self.filters[0]
        if len(self.filters) > 1:
            _, candidate, contact = self.filters
            ratio = candidate.log_likelihood - max(main.log_likelihood, contact.log_likelihood)
            if self.hypotheses_moved >= TUNING.changed_after and ratio > TUNING.changed:
                self.filters = [candidate]
                self.changed = True
                self.moved = self.hypotheses_moved
                return
            if self.hypotheses_moved >= (
                TUNING.changed_after if ratio < TUNING.unlikely else TUNING.dropped_after
            ):
                self.filters = [main]
        if len(self.filters) == 1:
            # not before the payload filter has used the first second of motion
            is_surprise = moving and main.surprise > moving + TUNING.surprise * math.sqrt(2 * moving)
            if is_surprise and self.moved >= TUNING.changed_after:
                main.log_likelihood = self.hypotheses_moved = 0.0
                candidate, contact = copy.deepcopy(main), copy.deepcopy(main)
                candidate.forget_load()
                contact.disturbance = main.disturbance * TUNING.contact_disturbance**2
                self.filters = [main, candidate, contact]
