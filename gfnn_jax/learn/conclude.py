"""Conclusion of a fit: why the search ended, and the residuals where nothing is met."""

from typing import NamedTuple

import numpy as np

from gfnn_jax.budget import SOLVE, Budget, within
from gfnn_jax.candidates.assemble import Candidate, stepped
from gfnn_jax.coordinates import nearest_image
from gfnn_jax.diagnosis.residuals import (
    differs_between_sequences,
    hidden_friction,
    is_noise,
    is_smooth,
    noise_of_sites,
    state_noise,
)
from gfnn_jax.families.expressions import coordinate_names
from gfnn_jax.learn.choose import Chosen
from gfnn_jax.learn.request import Request, not_radians, proposed, wrapped
from gfnn_jax.learn.searches import Searched
from gfnn_jax.models.generating_functions.sweeps import OF_SOLVE, OF_STEPS
from gfnn_jax.models.hamiltonians.covariance import leaves_white
from gfnn_jax.models.hamiltonians.learned_law import TURNS
from gfnn_jax.models.hamiltonians.search import long_step
from gfnn_jax.search.search import GAINED, MET, Entry

_NO_MORE = {
    False: "no larger set of terms promises to meet it",
    True: "the network's training gains no more",
}
_LOOK = "the test whether the residuals are noise"
_WHITE = "the residuals of H are white, as noise is"


class Options:
    """Limits by which what a map leaves over is told apart, and how many pairs are looked at."""

    share: float = 0.1  # of the residual, that a change of volume must explain
    known: float = 1.5  # times the noise that was given: up to it, what is left over is that noise
    # Times the noise: above it a map's own error is not what noise makes of it, √(2m/N) with N
    # rows, three or more for each of the m terms.
    own_error: float = 1.5
    roundoff: float = 1e-12  # of the data's spread: below it a stall is arithmetic, not noise
    residual_pairs: int = 2_000  # whose residuals are looked at
    friction_pairs: int = 1_000  # where the tolerance is met
    noise_pairs: int = 1_024  # from which the noise of the states is measured
    noise_numbers: int = 8_192  # the same of many sites: numbers of so many pairs


class Conclusion(NamedTuple):
    """Reason why the search ended; the noise (2d,) that the residuals suggest, or None; warnings;
    and whether H leaves no more than white noise."""

    ended: str
    noise: np.ndarray | None
    messages: list[str]
    white: bool = False


def conclude(chosen: Chosen, searched: Searched, request: Request) -> Conclusion:
    """Conclude on the chosen map."""
    candidate, law, found = chosen.candidate, searched.law, searched.found
    met = searched.tolerance.met_by(candidate)
    ended, noise, messages, unmet, reason = found.ended, None, [], "", ""
    if not searched.swept:
        cut = request.budget.ended or (law.ended if law is not None else "")
        ended = MET if met else cut or _NO_MORE[request.of_network]
    if ended.startswith(MET) and not met:
        ended = (
            "the map meets the tolerance on the pairs that chose it, and not on the test pairs, "
            "which chose nothing: more pairs narrow the bound"
            if np.isfinite(candidate.validation_relative)
            else "the implicit step of the map that should meet it fails for some of the states: "
            "a smaller dt, or a smaller region, helps"
        )
    if met and not ended.startswith(MET):  # by the pairs that state the error
        ended = MET
    if law is not None and searched.of_terms is None and searched.linear is None:
        on_law = chosen.entry is None or searched.met_by_law
        law_matters = on_law or (law.fast and not met)
        messages += law.messages if law_matters else ()
        unmet = law.unmet if law_matters else ""
    structured = request.structure is not None  # too few pairs to look at their neighbours
    if met:
        messages += [] if structured else _hidden(chosen, searched)
        ended = _with_clock(ended, request.budget)
        messages += request.budget.left_out
        return Conclusion(ended, searched.data.noise_of_channels, messages)
    diagnosis: list[str] = []
    if wrapped(request.pairs, request.coordinates):
        messages = []  # of a law that misses them
        ended = reason = "no map follows the jumps of an angle that is wrapped and was not named"
    elif candidate.validation_relative > Options.roundoff and searched.linear is None:
        stalled = _stalled(candidate, chosen.entry, searched)
        left = _left_of_sites if structured else _what_is_left
        work = _work(chosen.entry or next(iter(found.ranking), None))
        last = request.budget.last(_LOOK, SOLVE, work)
        known = within(last, lambda: left(chosen, searched, stalled))
        noise, diagnosis, reason = known or _LeftOver(None, [])  # else told as left out
        if reason and stalled:
            ended = f"larger models are no more accurate: {reason}"
        elif reason:
            ended = f"{ended}; {reason}"
    ended = _with_clock(ended, request.budget)
    if request.seeks_law and not structured and not searched.met_by_law:
        diagnosis += long_step(searched.data, request.scene)
    messages += not_radians(chosen.data.pairs, request.coordinates)
    if not structured:
        diagnosis += proposed(searched.data)
    if unmet and noise is None and not reason:  # else it is known why
        messages = [unmet, *messages]
    unmet = request.tolerance.missed_by(candidate, ended)
    white = reason == _WHITE
    messages = [*diagnosis, *messages, unmet] if white else [*messages, unmet, *diagnosis]
    messages += request.budget.left_out
    return Conclusion(ended, noise, messages, reason == _WHITE)


def _hidden(chosen: Chosen, searched: Searched) -> list[str]:
    """Warn of friction that the tolerance hides."""
    candidate, data = chosen.candidate, searched.data
    lossy = chosen.law is not None and bool(chosen.law.friction)
    compiled = candidate.microseconds_per_step is not None
    if lossy or not compiled or data.varied or not candidate.validation_relative > Options.roundoff:
        return []
    if not data.coordinates.plain:
        return []
    sample = _residuals_of_sample(candidate, None, searched, Options.friction_pairs)
    found = hidden_friction(sample.image, sample.residual, sample.angles)
    if found is None:
        return []
    change, error = found
    return [
        f"phase-space volumes change by {change:.2g} ± {error:.1g} (relative) in a step, as by "
        "friction. The map keeps volumes: it meets the tolerance of one step, and long rollouts "
        "miss the decay. With a smaller --tolerance a fit looks for friction"
    ]


def _with_clock(ended: str, budget: Budget) -> str:
    """Reason why the search ended, and that a budget did, wherever a unit of it was left out."""
    clock = budget.ended
    if not clock or clock in ended:
        return ended
    return f"{ended}; {clock}" if ended.startswith(MET) else f"{clock}; {ended}"


def only_noise(entry: Entry, searched: Searched) -> bool:
    """Return whether what this entry leaves over is noise, as far as its residuals tell."""
    if not _stalled(entry.candidate, entry, searched):
        return False
    return _no_noise(_residuals_of_sample(entry.candidate, entry, searched), True) is None


def _work(entry: Entry | None) -> float:
    """Operations of a look at what an entry's map leaves over, of H few: the solutions of either
    half of the rows, steps in NumPy, and compiled ones for the derivative of a step."""
    if entry is None:
        return 0.0
    width, count = 2 * entry.sweep.data.dim, entry.candidate.num_parameters
    rows = len(entry.sweep.data.training) * width
    steps = OF_STEPS * (Options.residual_pairs + Options.noise_pairs * width / 10)
    return 2 * OF_SOLVE * count**3 + 2 * rows * count**2 + steps * entry.size.operations


def _stalled(candidate: Candidate, entry: Entry | None, searched: Searched) -> bool:
    """Return whether larger models stopped helping: in the chosen sweep, in another that has come
    as far, or, where no S was found, among the libraries of H."""
    found = searched.found
    if searched.of_terms is not None and candidate.learns == "map":
        return searched.of_terms.stalled
    if entry is None and not found.ranking:
        return searched.law is not None and searched.law.stalled
    limit = candidate.validation_relative / GAINED
    near = [e.candidate for e in found.entries if e.candidate.validation_relative <= limit]
    return any((candidate.chart, candidate.family) in found.stalled for candidate in near)


class _LeftOver(NamedTuple):
    """Findings in the residuals: the noise (2d,), messages, and the reason why no
    larger model would help where that is known."""

    noise: np.ndarray | None
    messages: list[str]
    reason: str = ""


class _Sample(NamedTuple):
    """Rows of training pairs (n,), their states, predicted images and residuals (n, 2d), sizes of
    these (2d,), the sequence that each is of and its place there (n,); angles: of the states."""

    rows: np.ndarray
    y0: np.ndarray
    image: np.ndarray
    residual: np.ndarray
    scale: np.ndarray
    sequence: np.ndarray
    place: np.ndarray
    angles: tuple[int, ...]


def _residuals_of_sample(
    candidate: Candidate,
    entry: Entry | None,
    searched: Searched,
    most: int = Options.residual_pairs,
) -> _Sample:
    """The residuals of the steps that were solved: of the entry's map in inner coordinates, or of
    the candidate's, where there is none, in the user's."""
    data = searched.data if entry is None else entry.sweep.data
    rows = np.sort(data.training)[:most]
    if entry is not None:
        y0, scale = data.y0[rows], data.scale
        image, solved = entry.sweep.images(entry.size, rows)
        residual, angles = data.y1[rows] - image, data.coordinates.angles
    else:
        pairs, scale = data.pairs.take(rows), data.spread
        y0 = np.asarray(pairs.z0)
        steps = stepped(candidate.map, y0, pairs.dt, pairs.args, timed=False)
        image = steps.images
        angles = data.user_angles
        residual = nearest_image(np.asarray(pairs.z1) - image, angles)
        solved = ~steps.failed & np.isfinite(residual).all(axis=1)
    rows, y0, image, residual = rows[solved], y0[solved], image[solved], residual[solved]
    place = np.asarray(data.pairs.place)[rows]
    return _Sample(rows, y0, image, residual, scale, data.run[rows], place, angles)


def _no_noise(sample: _Sample, stalled: bool) -> _LeftOver | None:
    """Describe these residuals, where they are something else than noise."""
    _, y0, image, residual, scale, sequence, _, _ = sample
    if differs_between_sequences(y0 / scale, residual / scale, sequence):
        message = (
            "the residuals are alike within a sequence and differ between sequences: a quantity "
            "that the states do not hold (a mass, a length, a field) differs. Give it as a "
            "parameter (a column of its own, args=), or fit the sequences of one value alone"
        )
        ended = "a quantity that the states do not hold differs between the sequences"
        return _LeftOver(None, [message], ended)
    if not stalled:
        return _LeftOver(None, [])
    size = float(np.sqrt(np.mean((residual / scale) ** 2)))
    some = slice(Options.friction_pairs)
    smooth = is_smooth(y0, residual)
    found = hidden_friction(image[some], residual[some], sample.angles) if smooth else None
    # Friction shrinks every coordinate by a part of what is left over of it.
    if found is not None and abs(found[0]) > Options.share * residual.shape[1] * size:
        change, error = found
        message = (
            f"the residuals are no noise: phase-space volumes change by {change:.2g} ± {error:.1g} "
            "(relative) in a step, as by friction, and a symplectic map keeps them. The law of a "
            "recording of the positions has friction (--positions, gfnn.Recording)"
        )
        return _LeftOver(None, [message], "volumes of phase space change, as by friction")
    if smooth or _noise_by_neighbours(sample) is False:
        message = (
            "the residuals are no noise: neighbouring pairs have similar ones. Either the terms "
            "tried cannot represent the motion (give known ones: --terms), or it is not "
            "symplectic (friction, a missing coordinate)"
        )
        return _LeftOver(None, [message], "the residuals are a function of the states")
    return None


def _noise_by_neighbours(sample: _Sample) -> bool | None:
    """Return whether the residuals are noise; None where the pairs lie too far apart to tell."""
    _, y0, _, residual, scale, sequence, place, _ = sample
    return is_noise(y0 / scale, residual / scale, sequence, place)


def _what_is_left(chosen: Chosen, searched: Searched, stalled: bool) -> _LeftOver:
    """Noise, where larger models no longer helped, friction, or a parameter that differs between
    sequences.

    The residuals are those of the chosen map, or of the best generated one where H was chosen."""
    candidate, data, law = chosen.candidate, searched.data, chosen.law
    entry = chosen.entry or next(iter(searched.found.ranking), None)
    if law is not None and law.turns:
        return _LeftOver(None, [], TURNS)
    if law is not None and law.friction:
        entry = None  # S has none
    if entry is not None:
        data = entry.sweep.data
    sample = _residuals_of_sample(candidate, entry, searched)
    of_h = law if entry is None else None
    if not stalled and of_h is not None and not of_h.misfit:
        # The search for H ended before it met the noise.
        stalled = _noise_by_neighbours(sample) is True and leaves_white(of_h.flow, data)
    known = _no_noise(sample, stalled)
    if known is not None:
        return known
    if data.noise_of_channels is None and _noise_by_neighbours(sample) is None:
        apart = "the pairs lie too far apart to distinguish noise from what these functions lack"
        return _LeftOver(None, [], apart)
    rows, sequence = sample.rows, sample.sequence
    taken = candidate.num_parameters / (data.training.size * 2 * data.dim)
    noise = state_noise(candidate.map, data.pairs.take(rows[: Options.noise_pairs]), taken)
    if law is not None and law.noise is not None:
        # Along an arc what the law misses adds up, and looks like noise.
        noise = np.minimum(law.noise, noise)
    known_noise = data.noise_of_channels
    if known_noise is not None:
        return _beside_known(noise, known_noise)
    own, names = "", coordinate_names(data.dim)
    sizes_of_noise = ", ".join(f"{s:.1e} ({n})" for n, s in zip(names, noise, strict=True))
    if law is None and entry is not None and entry.sweep.linear:
        part = entry.sweep.error_by_noise(entry.size) / np.sqrt(np.mean((noise / data.spread) ** 2))
        if part > Options.own_error:
            message = (
                "the residuals look like noise, but fits to halves of the pairs differ by "
                f"{part:.1g} times as much, more than noise makes them. The terms tried cannot "
                "follow some of the states, as of close passages"
            )
            return _LeftOver(None, [message], "the terms tried cannot follow some of the states")
        own = f". The map's own error is then about {part:.1g} of this noise"
    hidden, reason = "", "the residuals are noise"
    if len(np.unique(sequence)) == len(sequence):
        hidden = ". Single pairs cannot tell noise from what states do not hold (a drive, say)"
        reason += ", or something that the states do not hold"
    alone = law is not None and not (hidden or law.misfit)
    if law is not None and alone and leaves_white(law.flow, searched.data):
        white = "the residuals of H are white: these pairs do not contradict H"
        message = f"{white}. They are noise of about {sizes_of_noise}"
        return _LeftOver(noise, [message], _WHITE)
    message = f"the residuals are noise of about {sizes_of_noise}{own}{hidden}"
    return _LeftOver(noise, [message], reason)


def _beside_known(found: np.ndarray, known: np.ndarray) -> _LeftOver:
    """Noise (2d,) that was given, beside what the residuals suggest (2d,)."""
    ratio = float(np.max(found / known))
    if ratio <= Options.known:
        reason = "the residuals are the noise that was given"
        return _LeftOver(known, [f"larger models are no more accurate: {reason}"], reason)
    name = coordinate_names(len(found) // 2)[int(np.argmax(found / known))]
    message = (
        f"larger models are no more accurate, and the residuals are up to {ratio:.2g} times the "
        f"noise that was given ({name}): std is too small, or the terms tried cannot represent "
        "the motion (give known ones: --terms)"
    )
    return _LeftOver(known, [message])


def _left_of_sites(chosen: Chosen, searched: Searched, stalled: bool) -> _LeftOver:
    """Noise, where other libraries of the structure leave as much."""
    if not stalled:
        return _LeftOver(None, [])
    data = chosen.data
    few = max(1, Options.noise_numbers // (2 * data.dim))
    rows = np.sort(data.training)[:few]
    noise = noise_of_sites(chosen.candidate.map, data.pairs.take(rows))
    message = (
        "other terms of the structure are no more accurate: the residuals are noise of about "
        f"{noise[0]:.1e} on positions and {noise[-1]:.1e} on momenta, or terms that were not tried "
        "(give known ones: --terms)"
    )
    return _LeftOver(noise, [message])
