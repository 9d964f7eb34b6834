"""Gradients of H along noisy sequences, in weak form: what matching is given instead of midpoints.

The equation of motion times a bump φ, integrated by parts over a window of a sequence,

    ∫ φ J∇H(z) dt = −∫ φ̇ z dt,

asks for no derivative of the measured states, so that their noise is averaged and not divided by
the time step (Messenger & Bortz, SIAM Multiscale Model. Simul. 19 (2021) 1474). The bumps
φ = (1 − u²)⁶ and their slopes are summed over the states, to 1e-5 of the integrals. The left-hand
side is evaluated at states that are smoothed where the orbit is smooth: noise e there moves the
columns by ∫ φ J H'' e dt.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gfnn_jax.phase_space import apply_j

_STATES = 15  # of a window
_POWER = 6  # of the bump: with 4 the sums over its slope are off by 2e-4
_EVERY = 6  # states, at which windows begin
_SMOOTHED, _DEGREE = (9, 7), 4  # states and degree of local polynomials that smooth a sequence
_BIASED = 1.3  # times the noise, that a local polynomial leaves over where it is not the orbit
_MOST = 320  # windows
# Of a window that is looked at: the degree of the polynomials that are to follow its states, and
# what they may leave over, in units of the noise. Where an orbit turns faster, as at a pole or in a
# close passage, the sums over the window are no integrals.
_FOLLOWS, _LEFT = 8, 2.0


class WeakGradients(NamedTuple):
    """The windows of some sequences.

    states: (N, 2d), smoothed; noise: (N, 2d) what is left on them. target: (R, 2d), the mean of ∇H
    over each window, as the motion tells it. deviation: (2d,) of its noise. places: (R, w) of each
    window's states. bump: (w,), whose sum is 1.
    """

    states: np.ndarray
    noise: np.ndarray
    target: np.ndarray
    deviation: np.ndarray
    places: np.ndarray
    bump: np.ndarray

    def deviations(self, hessian: np.ndarray) -> np.ndarray:
        """(R, 2d) of the noise of both sides, with H'' (N, 2d, 2d) at the states."""
        moved = np.einsum("nij,nj->ni", hessian**2, self.noise**2)
        of_states = np.einsum("w,rwi->ri", self.bump**2, moved[self.places])
        return np.sqrt(self.deviation**2 + np.where(np.isfinite(of_states), of_states, np.inf))

    def average(self, gradients: np.ndarray) -> np.ndarray:
        """The means (…, R, 2d) over the windows of gradients (…, N, 2d) at the states."""
        total = self.bump[0] * gradients[..., self.places[:, 0], :]
        for weight, own in zip(self.bump[1:], self.places.T[1:], strict=True):
            total = total + weight * gradients[..., own, :]
        return total


def weak_gradients(
    sequences: list[np.ndarray], dt: float, noise: np.ndarray
) -> WeakGradients | None:
    """The windows of sequences (L, 2d) of states dt apart, with noise (2d,) on each coordinate.
    None where no sequence is as long as a window, or turns slowly enough for one."""
    u = np.arange(1, _STATES + 1) / (_STATES + 1) * 2 - 1
    bump = (1 - u**2) ** _POWER
    bump /= bump.sum()
    slope = u * (1 - u**2) ** (_POWER - 1)
    time = np.arange(_STATES) * dt
    slope /= slope @ time  # of a state that moves at rate 1 the mean rate is 1
    states, noises, measured, places, count = [], [], [], [], 0
    for sequence in sequences:
        if len(sequence) < _STATES:
            continue
        smooth, left = _smoothed(sequence, noise)
        states.append(smooth)
        noises.append(np.tile(left, (len(sequence), 1)))
        measured.append(sequence)
        first = count + np.arange(0, len(sequence) - _STATES + 1, _EVERY)
        places.append(first[:, None] + np.arange(_STATES))
        count += len(sequence)
    if not states:
        return None
    own, whole = np.concatenate(places), np.concatenate(measured)
    own = own[_followed(whole[own], noise)]
    if not len(own):
        return None
    own = own[:: -(-len(own) // _MOST)]
    used, place = np.unique(own, return_inverse=True)
    rate = np.einsum("w,rwi->ri", slope, whole[own])
    deviation = np.roll(noise, len(noise) // 2) * np.linalg.norm(slope)
    return WeakGradients(
        np.concatenate(states)[used],
        np.concatenate(noises)[used],
        -apply_j(rate),
        deviation,
        place.reshape(own.shape),
        bump,
    )


def _followed(windows: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(R,) which windows (R, w, 2d) polynomials follow to their noise (2d,)."""
    count = windows.shape[1]
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, count), _FOLLOWS + 1))[0]
    over = windows - np.einsum("wk,vk,rvi->rwi", basis, basis, windows)
    left = np.sqrt(np.sum(over**2, axis=1) / (count - basis.shape[1]))
    return (left <= _LEFT * noise).all(axis=1)


def _smoothed(sequence: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sequence (L, 2d) smoothed as far as its orbit allows, and the noise (2d,) left on it."""
    from scipy.signal import savgol_coeffs, savgol_filter  # takes a second: loaded when first used

    for size in _SMOOTHED:
        kept = float(savgol_coeffs(size, _DEGREE)[size // 2])  # of a state's own noise
        smooth = np.asarray(savgol_filter(sequence, size, _DEGREE, axis=0))
        left = np.sqrt(np.mean((sequence - smooth) ** 2, axis=0))
        if (left <= _BIASED * np.sqrt(1 - kept) * noise).all():
            return smooth, np.sqrt(kept) * noise
    return sequence, noise
