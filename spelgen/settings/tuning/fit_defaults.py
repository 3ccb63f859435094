"""Defaults of fits to windows."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FitDefaults:
    """What optimizers take where nobody says (`settings.fits`); measured on the arms of `benchmarks/arms.py`."""

    few_windows: int = 1024  # of which L-BFGS takes all at once
    lbfgs_decay: float = 2e-5  # [1] of half the sum of squared weights, in units of the loss
    adamw_decay: float = 0.2  # [1] of AdamW (Loshchilov and Hutter, ICLR 2019)
    batch: int = 256  # windows in a step of AdamW
    learning_rate: float = 1e-3  # of AdamW, at its largest (its authors')
