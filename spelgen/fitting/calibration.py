"""Windows of the training logs that are kept with a fit, for what is to be known of predictions before any test."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.errors import RunError
from spelgen.files import write_bytes
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, split_at_gaps
from spelgen.logs.windows import Windows, cut_windows, joined

PAST, AHEAD = 0.1, 1.0  # s
FASTEST = 100.0  # Hz
FEW, MOST = 128, 512  # windows: between these, they begin no closer than a past is long
MOST_BLOCKS = 16
PROBED = 5  # samples
WRITTEN = "a file of `spelgen train`"
COLUMNS = ("dt", "q", "qd", "tau", "z")


@dataclass(frozen=True)
class Source:
    """A recording of so many samples at this rate [Hz], read when it is wanted."""

    samples: int
    rate: float
    load: Callable[[], Trajectory]

    @property
    def decimation(self) -> int:
        """Samples from one sample of a window to the next."""
        return max(1, math.ceil(self.rate / FASTEST - 1e-6))


@dataclass(frozen=True, eq=False)
class CalibrationWindows:
    """An even sample of training logs: windows of `past` steps, the present sample and what came after.

    blocks: (W,) the stretch of time that each is of. Windows of one block overlap or follow at once, so that their
    errors are alike; those of different blocks hardly share samples.
    """

    windows: Windows
    past: int
    blocks: np.ndarray

    @property
    def probe(self) -> Windows:
        """The first few samples of each window, which tell how many steps the integrator needs."""
        x = self.windows
        return Windows(x.dt[:, : PROBED - 1], x.q[:, :PROBED], x.qd[:, :PROBED], x.tau[:, : PROBED - 1], x.z)

    def save(self, path: Path) -> None:
        """As one .npz, all or nothing."""
        columns: dict[str, Any] = dict(
            zip(COLUMNS, (x.numpy() for x in self.windows.columns()), strict=False)
        )
        buffer = io.BytesIO()
        np.savez_compressed(buffer, past=np.array(self.past), blocks=self.blocks, **columns)
        write_bytes(path, buffer.getvalue())


def read_calibration(path: Path, joints: int) -> CalibrationWindows | None:
    """What `CalibrationWindows.save` wrote of so many joints; None: there is no such file. Raises RunError where it is
    broken.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = [torch.from_numpy(file[name]) for name in COLUMNS]
            found = CalibrationWindows(Windows(*columns), int(file["past"]), file["blocks"])
    except Exception as error:  # numpy and zipfile name no common type for what a broken file raises
        raise RunError(f"unreadable ({type(error).__name__})", file=path, expected=WRITTEN) from error
    if not _fits_together(found, joints):
        raise RunError("arrays that do not fit together", file=path, expected=WRITTEN)
    return found


def _fits_together(found: CalibrationWindows, joints: int) -> bool:
    dt, q, qd, tau, z = found.windows.columns()
    count, samples = len(found.blocks), q.shape[1] if q.ndim == 3 else 0
    shapes: list[tuple[torch.Tensor, tuple[int, ...]]] = [
        (dt, (count, samples - 1)),
        (q, (count, samples, joints)),
        (qd, (count, samples, joints)),
        (tau, (count, samples - 1, joints)),
        (z[..., 0], (count, joints)),
    ]
    whole = np.unique(found.blocks)
    return (
        0 < found.past < samples - 1
        and all(
            x.dtype == torch.float64 and tuple(x.shape) == shape and bool(x.isfinite().all())
            for x, shape in shapes
        )
        and bool((dt > 0).all())
        and np.array_equal(whole, np.arange(len(whole)))
    )


def held_sources(trajectories: Iterable[Trajectory]) -> list[Source]:
    """Recordings in memory."""
    return [Source(len(x), x.sample_rate, partial(_same, x)) for x in trajectories]


def calibration_windows(
    sources: Sequence[Source], preprocessing: Preprocessing, reach: BristleReach
) -> CalibrationWindows | None:
    """`FEW` to `MOST` windows, evenly spread over all samples; None: no recording is long enough.

    Samples are at most `FASTEST` apart [Hz]; windows are shorter where all recordings are. preprocessing: a resolved
    one. reach: see `cut_windows`. One source at a time is in memory.
    """
    rate = min(x.rate / x.decimation for x in sources)
    past = max(1, round(PAST * rate))
    samples = min(past + 1 + round(AHEAD * rate), max(x.samples // x.decimation for x in sources))
    if samples < past + 2:
        return None
    total = sum(x.samples for x in sources)
    count = min(max(FEW, round(sum(x.samples / x.rate for x in sources) / PAST)), MOST)
    wanted = (np.arange(count) + 0.5) * total / count  # the windows' middles, counted over all samples
    cut, blocks, start, block = [], [], 0, 0
    for source in sources:
        middles = wanted[(wanted >= start) & (wanted < start + source.samples)] - start
        start += source.samples
        if len(middles) and source.samples > (samples - 1) * source.decimation:
            for windows, stretch in _cut(source, middles, samples, preprocessing, reach):
                cut.append(windows)
                blocks.append(block + stretch)
                block += int(stretch[-1]) + 1
    if not cut:
        return None
    return CalibrationWindows(joined(cut), past, np.concatenate(blocks) * min(block, MOST_BLOCKS) // block)


def _cut(
    source: Source, middles: np.ndarray, samples: int, preprocessing: Preprocessing, reach: BristleReach
) -> Iterator[tuple[Windows, np.ndarray]]:
    """The windows about these samples, piece by piece, and of each the stretch that it is of."""
    span, measured = (samples - 1) * source.decimation, preprocessing.filtered
    start = 0
    for whole in split_at_gaps(source.load(), preprocessing.gap):
        inside = middles[(middles >= start) & (middles < start + len(whole))] - start
        start += len(whole)
        if not len(inside) or len(whole) <= span:
            continue
        (piece,) = preprocessing.pieces([whole], shortest=span + 1)
        firsts = np.unique(np.clip(inside - span / 2, 0, len(piece) - 1 - span).astype(int))
        parts = [piece[first : first + span + 1] for first in firsts]
        windows = joined(
            [cut_windows([part], samples, decimation=source.decimation, measured=measured) for part in parts]
        )
        z = torch.from_numpy(bristles_along(piece.q, reach)[firsts])
        length = firsts[-1] - firsts[0] + 1
        stretches = max(1, round((length + span) / span))  # as long as a window
        yield replace(windows, z=z), (firsts - firsts[0]) * stretches // length


def _same(trajectory: Trajectory) -> Trajectory:
    return trajectory
