"""Preprocessing of logs for training, identification and evaluation: cuts at gaps, filter, decimation, torque delay."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import inf

from spelgen.errors import Diagnostic, SettingsError, SpelgenError, collect
from spelgen.logs.filtering import low_pass
from spelgen.logs.trajectory import GAP, Trajectory, split_at_gaps
from spelgen.logs.tuning import FAST, TUNING


@dataclass(frozen=True)
class Preprocessing:
    """Options for cutting, filtering and decimating logs. Raises SettingsError for invalid values.

    Attributes:
        cutoff: cutoff [Hz] of the zero-phase low-pass on q, qd and tau; 0: no filter; None: 8 Hz, but no filter for
            windows (segments of logs for momentum and rollout fits) if a log is sampled at 50 Hz or less.
        decimation: number of log samples from one sample of a window to the next; None: 1 without a filter, otherwise
            the largest number with at least three samples per period of the cutoff.
        gap: a time step longer than this multiple of the median step is a gap, at which a recording is cut.
        torque_delay: delay of logged torques relative to positions [s]; None: estimated in fits to torques.
    """

    cutoff: float | None = None
    decimation: int | None = None
    gap: float = GAP
    torque_delay: float | None = None

    def __post_init__(self) -> None:
        limits = [
            ("cutoff", self.cutoff is None or 0 <= self.cutoff < inf, "a frequency [Hz], or 0 for none"),
            ("decimation", self.decimation is None or self.decimation >= 1, "1 or more samples"),
            ("gap", self.gap > 1, "more than 1 median step"),
        ]
        for name, is_possible, expected in limits:
            if not is_possible:
                raise SettingsError(repr(getattr(self, name)), element=name, expected=expected)

    def resolved(self, rates: Iterable[float]) -> Preprocessing:
        """Return the options in which defaults (None) are replaced, for windows of logs of these sample `rates` [Hz].

        A torque delay of None becomes 0. A cutoff of None becomes 8 Hz if all logs are sampled above 50 Hz; otherwise
        it remains None, and the logs are not filtered. For a decimation of None see the class. The record of a training
        run contains the resolved options.
        """
        rates = list(rates)
        cutoff, decimation = self.cutoff, self.decimation or 1
        if cutoff is None and all(rate > TUNING.dense_rate * FAST for rate in rates):
            cutoff = TUNING.automatic_cutoff
        # By default, filtered logs are decimated to the lowest rate that the cutoff permits; other logs are not
        # decimated.
        if self.decimation is None and cutoff:
            decimation = max(1, int(min(rates) * FAST / (TUNING.samples_per_period * cutoff)))
        return replace(self, cutoff=cutoff, decimation=decimation, torque_delay=self.torque_delay or 0.0)

    @property
    def acceleration_cutoff(self) -> float | None:
        """Cutoff [Hz] of the low-pass filter for `DynamicsSamples`, which contain accelerations; None: no filter."""
        if self.cutoff is None:
            return TUNING.automatic_cutoff
        return self.cutoff or None

    @property
    def filtered(self) -> bool:
        """True if q, qd and tau are filtered before windows are cut from the logs.

        This object must be a result of ``resolved``: in other options, a cutoff of None may still become 8 Hz.
        """
        return bool(self.cutoff)

    @property
    def diagnostics(self) -> list[Diagnostic]:
        """A list with a remark that states the cutoff; [] if the logs are not filtered.

        This object must be a result of ``resolved``.
        """
        if not self.cutoff:
            return []
        message = f"q, qd and tau filtered at {self.cutoff:g} Hz, zero phase"
        return [Diagnostic("info", "filter", "logs", None, message)]

    def pieces(self, trajectories: Sequence[Trajectory], *, shortest: int) -> list[Trajectory]:
        """Return the filtered gap-free pieces of the trajectories that have at least `shortest` samples.

        This object must be a result of ``resolved``. Raises LogError for a trajectory without a piece of this length.
        """
        prepared: list[Trajectory] = []
        errors: list[SpelgenError] = []
        for trajectory in self.moved(trajectories):
            pieces = split_at_gaps(trajectory, self.gap)
            if max(map(len, pieces)) < shortest:
                got = f"{max(map(len, pieces))} samples without a gap"
                do = "record longer or train with a shorter window"
                errors.append(trajectory.error(got, f"at least {shortest}, one window", do))
            for piece in pieces:
                if len(piece) >= shortest:
                    prepared.append(low_pass(piece, self.cutoff) if self.cutoff else piece)
        collect(errors)
        return prepared

    def moved(self, trajectories: Sequence[Trajectory]) -> Sequence[Trajectory]:
        """Return the trajectories with torques shifted back in time by `torque_delay`."""
        delay = self.torque_delay
        # Most logs have no delay: the unchanged trajectories are returned, which need not be validated again.
        if not delay:
            return trajectories
        from spelgen.logs.recording import earlier

        return [replace(x, tau=earlier(x.t, x.tau, delay)) for x in trajectories]
