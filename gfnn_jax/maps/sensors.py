"""What a map knows of the sensors that its data came from."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Sensors:
    """What was measured, and how well.

    positions, inputs, angles: names of columns. sigma: (d,) noise of the positions. omega: the
    fastest frequency, 1/s. window: seconds before a time from which a state is estimated best.
    hold, delay: inputs between samples, and the time by which they act later, in seconds. leads,
    misfit: (n,) times ahead, and (n, d) the standard deviation there of forecasts of the data that
    neither the noise nor the errors of state and coefficients explain: the law's own.
    """

    positions: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[str, ...]
    sigma: Any
    omega: float
    window: float
    hold: str
    delay: float
    leads: Any
    misfit: Any

    def misfit_at(self, ahead: np.ndarray) -> np.ndarray:
        """The law's own error (..., d) at times ``ahead`` (...); beyond the last lead it grows on
        as it did on the mean until there."""
        columns = [np.interp(ahead, self.leads, column) for column in self.misfit.T]
        beyond = np.maximum(1.0, ahead / self.leads[-1])
        return np.stack(columns, axis=-1) * beyond[..., None]
