"""The search for laws of physics behind noisy sequences and pairs: which few atoms are worth a fit.

Gradients of H are known in weak form. The equation of motion times a bump φ, integrated by parts
over a window of a sequence,

    ∫ φ J∇H(z) dt = −∫ φ̇ z dt,

asks for no derivative of the measured states, so that their noise is averaged and not divided by
the time step (Messenger & Bortz, SIAM Multiscale Model. Simul. 19 (2021) 1474). The bumps
φ = (1 − u²)⁶ and their slopes are summed over the states, to 1e-5 of the integrals. The left-hand
side is evaluated at states that are smoothed where the orbit is smooth: noise e there moves the
columns by ∫ φ J H'' e dt.

Atoms are matched, as in `models.textbook.search`, to the gradients of H along sequences. These
have no error of a midpoint: one round is enough. The
noise of the states is known too: columns are in its units, and an atom has to bring as much
likelihood as there is to say of it. Noise does not tell the right law from one that is within it,
so that several are handed on; whole sequences choose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count, islice
from typing import Any, NamedTuple

import numpy as np

from gfnn_jax.families.terms import Terms
from gfnn_jax.fitting.significance import significant
from gfnn_jax.fitting.triangle import Triangle
from gfnn_jax.models.textbook.atoms import Atom, complexity_of, constants_of, with_constants
from gfnn_jax.models.textbook.dictionary import Setting
from gfnn_jax.models.textbook.matching import Match, Matching
from gfnn_jax.phase_space import apply_j


class Options:
    """Tuned on the laws of benchmarks/textbook.py with noise of 1e-3 of the spread.

    atoms: of a law, beside the
    coordinates and products of two. penalty: natural logarithms of likelihood that a unit of
    complexity must bring. finalists: laws that are handed on. explained: RMS of what a match leaves
    over, in units of the noise, from which on products of shapes are looked at too. kept: standard
    errors of a coordinate, or a product of two, that a law is handed on with. exchanged:
    matches whose atoms are tried in other shapes; looked_at: that are read as laws. far:
    deviations, beyond which a row has less weight.

    Weak gradients: states: of a window. power: of the bump, with 4 the sums over its slope are off
    by 2e-4. every: states, at which windows begin. most: windows. smoothed, degree: states and
    degree of local polynomials that smooth a sequence; biased: times the noise, that one leaves
    over where it is not the orbit. follows: degree of the polynomials that are to follow the states
    of a window, and over: what they may leave over, in units of the noise; where an orbit turns
    faster, as at a pole or in a close passage, the sums over the window are no integrals.
    """

    atoms: int = 5
    penalty: float = 5.0
    finalists: int = 6
    explained: float = 1.5
    kept: float = 2.0
    exchanged: int = 4
    looked_at: int = 30
    far: float = 3.0
    states: int = 15
    power: int = 6
    every: int = 6
    most: int = 320
    smoothed: tuple[int, ...] = (9, 7)
    degree: int = 4
    biased: float = 1.3
    follows: int = 8
    over: float = 2.0


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
    u = np.arange(1, Options.states + 1) / (Options.states + 1) * 2 - 1
    bump = (1 - u**2) ** Options.power
    bump /= bump.sum()
    slope = u * (1 - u**2) ** (Options.power - 1)
    time = np.arange(Options.states) * dt
    slope /= slope @ time  # of a state that moves at rate 1 the mean rate is 1
    states, noises, measured, places, count = [], [], [], [], 0
    for sequence in sequences:
        if len(sequence) < Options.states:
            continue
        smooth, left = _smoothed(sequence, noise)
        states.append(smooth)
        noises.append(np.tile(left, (len(sequence), 1)))
        measured.append(sequence)
        first = count + np.arange(0, len(sequence) - Options.states + 1, Options.every)
        places.append(first[:, None] + np.arange(Options.states))
        count += len(sequence)
    if not states:
        return None
    own, whole = np.concatenate(places), np.concatenate(measured)
    own = own[_followed(whole[own], noise)]
    if not len(own):
        return None
    own = own[:: -(-len(own) // Options.most)]
    used, place = np.unique(own, return_inverse=True)
    rate = np.einsum("w,rwi->ri", slope, whole[own])
    deviation = np.roll(noise, len(noise) // 2) * np.linalg.norm(slope)
    at = np.concatenate(states)[used], np.concatenate(noises)[used]
    return WeakGradients(*at, -apply_j(rate), deviation, place.reshape(own.shape), bump)


def gradients_of_pairs(
    pairs: tuple[np.ndarray, np.ndarray],
    dt: float,
    noise: np.ndarray,
    off: np.ndarray,
    gradient: Callable[[np.ndarray], np.ndarray],
) -> WeakGradients:
    """Each pair z0 -> z1 (N, 2d) as a window of one state, its middle, with noise (2d,).

    The rate of a pair is that of its middle to O(dt²), which a law that is close corrects: what its
    flow leaves ``off`` (N, 2d) of z1 is left of its ``gradient`` (deferred correction).
    """
    middle = 0.5 * (pairs[0] + pairs[1])
    return WeakGradients(
        middle,
        np.broadcast_to(noise / np.sqrt(2), middle.shape),
        gradient(middle) - apply_j(off) / dt,
        np.sqrt(2) * np.roll(noise, len(noise) // 2) / dt,
        np.arange(len(middle))[:, None],
        np.ones(1),
    )


def _followed(windows: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(R,) which windows (R, w, 2d) polynomials follow to their noise (2d,)."""
    count = windows.shape[1]
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, count), Options.follows + 1))[0]
    over = windows - np.einsum("wk,vk,rvi->rwi", basis, basis, windows)
    left = np.sqrt(np.sum(over**2, axis=1) / (count - basis.shape[1]))
    return (left <= Options.over * noise).all(axis=1)


def _smoothed(sequence: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sequence (L, 2d) smoothed as far as its orbit allows, and the noise (2d,) left on it."""
    from scipy.signal import savgol_coeffs, savgol_filter  # takes a second: loaded when first used

    for size in Options.smoothed:
        kept = float(savgol_coeffs(size, Options.degree)[size // 2])  # of a state's own noise
        smooth = np.asarray(savgol_filter(sequence, size, Options.degree, axis=0))
        left = np.sqrt(np.mean((sequence - smooth) ** 2, axis=0))
        if (left <= Options.biased * np.sqrt(1 - kept) * noise).all():
            return smooth, np.sqrt(kept) * noise
    return sequence, noise


class Formula(NamedTuple):
    """H = Σ c_j φ_j of atoms of a setting: products of coordinates, then others, with constants.

    left: RMS of what it leaves over of the weak gradients, in units of their noise; rows: so many
    numbers.
    """

    setting: Setting
    atoms: tuple[Atom, ...]
    coefficients: np.ndarray
    left: float
    rows: int

    @property
    def complexity(self) -> float:
        """Complexity, in units of `shapes.complexity`, of the atoms that not every law has."""
        return complexity_of([atom for atom in self.atoms if atom not in self.setting.base])

    @property
    def is_polynomial(self) -> bool:
        """Return whether the law is a sum of products of coordinates."""
        return all(self.setting.powers(atom) is not None for atom in self.atoms)

    @property
    def length(self) -> float:
        """Description length: natural logarithms."""
        penalty = Options.penalty * self.complexity + 0.5 * np.log(self.rows) * len(self.p)
        return self.rows * np.log(self.left) + penalty

    @property
    def constants(self) -> np.ndarray:
        """(k,): the constants inside the atoms."""
        return np.array([c for atom in self.atoms for c in constants_of(atom)])

    @property
    def numbers(self) -> list[list[int]]:
        """Places among coefficients and constants of the constants of each term."""
        ahead = count(len(self.atoms))
        return [list(islice(ahead, len(constants_of(atom)))) for atom in self.atoms]

    @property
    def p(self) -> np.ndarray:
        """(n,): coefficients, then constants."""
        return np.concatenate([self.coefficients, self.constants])

    def at(self, p: np.ndarray) -> Formula:
        """The same with these coefficients and constants."""
        terms = len(self.atoms)
        return self._replace(coefficients=p[:terms], atoms=_with(self.atoms, p[terms:]))

    def family(self, constants: np.ndarray) -> Terms:
        """The terms, with these constants inside. Raises InputError for one that has run away."""
        return self.setting.terms(_with(self.atoms, constants))

    @property
    def kind(self) -> frozenset:
        """The terms without their constants."""
        shapes = [tuple(sorted(f.form for f in atom)) for atom in self.atoms]
        return frozenset((shape, shapes.count(shape)) for shape in shapes)

    def take(self, kept: Sequence[int]) -> Formula:
        """Take these terms alone."""
        atoms = tuple(self.atoms[j] for j in kept)
        return self._replace(atoms=atoms, coefficients=self.coefficients[list(kept)])


def _with(atoms: Sequence[Atom], constants: np.ndarray) -> tuple[Atom, ...]:
    """The atoms with these constants (k,) inside."""
    given = iter(constants.tolist())
    return tuple(with_constants(atom, given) for atom in atoms)


class NoisyTextbook:
    """The search among the windows of noisy sequences. angles, cyclic: indices of z."""

    def __init__(
        self,
        weak: WeakGradients,
        *,
        angles: Sequence[int] = (),
        cyclic: Sequence[int] = (),
        on_progress: Callable[[str], Any] = lambda message: None,
    ):
        self._weak, self._on_progress = weak, on_progress
        given = weak.states, 1.0 / weak.deviation, angles, cyclic, weak.average
        self._setting = Setting(*given)
        self._weigh(weak.deviation)

    def polynomial(self, family: Terms, coefficients: np.ndarray) -> Formula:
        """The law of products of the coordinates."""
        atoms = tuple(map(self._setting.product, family.powers))
        return Formula(self._setting, atoms, coefficients, 1.0, self._target.size)

    def formulas(self) -> list[Formula]:
        """The laws that are worth a fit, the likeliest for their complexity first."""
        with np.errstate(all="ignore"):
            found: list[Formula] = []
            for products in (False, True):
                self._weigh(self._weak.deviation)
                first = self._searched(products)[0]
                self._weigh(self._deviations(first))
                found = self._searched(products)
                if found[0].left <= Options.explained:
                    break
            return found[: Options.finalists]

    def _searched(self, products: bool) -> list[Formula]:
        """The laws of each kind, by rising length."""
        found: dict[frozenset, Formula] = {}
        for match in sorted(self._matches(products), key=self._length_of_match)[
            : Options.looked_at
        ]:
            formula = self._formula(match)
            if found.setdefault(formula.kind, formula).left > formula.left:
                found[formula.kind] = formula
        return sorted(found.values(), key=lambda formula: formula.length)

    def _weigh(self, deviations: np.ndarray) -> None:
        """Weigh the rows by their noise (2d,) or (R, 2d)."""
        self._setting.weigh(1.0 / deviations)
        self._target = (self._weak.target * self._setting.weight).ravel()

    def _deviations(self, formula: Formula) -> np.ndarray:
        """(R, 2d) of the noise of the rows, as far as this law tells how states move them; more
        of those that it misses by far, as where an orbit turns too fast for a window's sums."""
        family, c = formula.family(formula.constants), formula.coefficients
        gradient, hessian = family.gradient_and_hessian(c, self._weak.states)
        found = self._weak.deviations(hessian)
        off = np.abs(self._weak.average(gradient) - self._weak.target) / found
        return found * np.maximum(1.0, np.where(np.isfinite(off), off, np.inf) / Options.far)

    def _matches(self, products: bool) -> list[Match]:
        setting = self._setting
        dictionary = setting.dictionary(products=products)
        self._on_progress(f"H: trying {len(dictionary.atoms)} functions of laws of physics")
        matching = Matching(
            setting, self._target, Options.penalty / (len(self._target) * np.log(2))
        )
        found = matching.best(dictionary, Options.atoms)
        if not products:
            most = len(self._target) / 4 - len(setting.base)
            blocks = [*setting.blocks(), *setting.turning()]
            found += [matching.refined(b) for b in blocks if len(b) < most]
        likeliest = sorted(found, key=self._length_of_match)[: Options.exchanged]
        return found + [m for best in likeliest for m in matching.exchanged(best, dictionary)]

    def _length_of_match(self, match: Match) -> float:
        return len(self._target) * np.log(match.left) + Options.penalty * match.complexity

    def _formula(self, match: Match) -> Formula:
        """The law of a match, without the coordinates and products that it does not ask for."""
        atoms = self._setting.ordered(match.atoms)
        whole = Formula(self._setting, atoms, np.zeros(len(atoms)), np.inf, len(self._target))
        columns, nothing = self._setting.columns(self._setting.terms(atoms)), whole.coefficients
        triangle = Triangle.of(np.column_stack([columns, -self._target]))
        kept, c = significant(triangle, nothing, Options.kept)
        if not len(kept):  # none stands out
            kept, c = significant(triangle, nothing, 0.0)
        left = np.linalg.norm(columns[:, kept] @ c - self._target)
        left = float(left / np.sqrt(len(self._target) - len(kept)))
        return whole.take(kept.tolist())._replace(coefficients=c, left=left)
