"""Options of a fit, each named once: its default, what it may be, its help.

`gfnn.fit`, ``gfnn run``, ``gfnn fit`` and the record of a job take them from `FitOptions`. JAX is
not loaded.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import time
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

from gfnn_jax.budget import Budget, seconds_allowed
from gfnn_jax.dataset.structure_names import EXPECTED, STRUCTURES, names_structure
from gfnn_jax.errors import FitError, unexpected

P = ParamSpec("P")
T = TypeVar("T")
RUN, FIT = ("gfnn run", "gfnn fit"), ("gfnn fit",)


class Kind(NamedTuple):
    """Values of an option: their description, the test of one, how text gives one, the list of
    them where they are few, and the description of those that text can give, where Python takes
    more."""

    words: str
    holds: Callable[[Any], bool]
    read: Callable[[str], Any] = str
    choices: tuple[str, ...] = ()
    typed: str = ""


def _one_of(*choices: str, or_holds: Callable[[Any], bool] = lambda value: False) -> Kind:
    """Kind of one of these texts, or of an object of one's own."""

    def holds(value: Any) -> bool:
        return value in choices if isinstance(value, str) else or_holds(value)

    return Kind(f"one of {', '.join(choices)}", holds, choices=choices)


def _whole(low: int, bits: int) -> Kind:
    words = f"a whole number from {low} to 2**{bits} - 1"
    return Kind(words, lambda v: isinstance(v, Integral) and low <= int(v) < 2**bits, int)


def _is_positive(value: Any) -> bool:
    return isinstance(value, Real) and 0 < float(value) < math.inf


def _is_text_or_function(value: Any) -> bool:
    return isinstance(value, str) or callable(value)


def _are(test: Callable[[Any], bool], *kinds: type) -> Callable[[Any], bool]:
    return lambda values: isinstance(values, kinds) and all(test(value) for value in values)


POSITIVE = Kind("a finite number > 0", _is_positive, float)
COUNT, SEED = _whole(1, 53), _whole(0, 32)
DEVICES = Kind(
    "all, or a whole number from 1 to 2**31 - 1",
    lambda v: v == "all" or _whole(1, 31).holds(v),
    lambda text: "all" if text == "all" else int(text),
)
STRUCTURE = Kind(EXPECTED, names_structure)
_SECONDS = Kind(
    "a finite number > 0, or None for no limit",
    lambda v: v in ("auto", None) or _is_positive(v),
    float,
    typed="a finite number > 0, in seconds",
)
_OPERATIONS = Kind(
    "a whole number of operations, or None for no limit",
    lambda v: isinstance(v, Integral) and int(v) >= 0,
    int,
    typed="a whole number of operations",
)
_TERMS = Kind(
    "a sequence of texts or functions of z, () for none, or a mapping of texts to coefficients",
    lambda v: not isinstance(v, str) and _are(_is_text_or_function, Sequence, Mapping)(v),
    lambda text: tuple(filter(None, map(str.strip, text.split(";")))),
)
_TEXT = Kind("text", lambda v: isinstance(v, str))
_LAW = Kind("a Hamiltonian as text or a function of z", _is_text_or_function)
_BRACKET = Kind(
    "a gfnn.Bracket, as Bracket.so3(), or None",
    lambda v: v is None or (hasattr(v, "matrix") and hasattr(v, "casimirs")),
)
_INDICES = Kind("a tuple of indices", _are(lambda i: isinstance(i, int), tuple, list))
_MASSES = Kind("a mapping of a position's name to its mass", lambda v: isinstance(v, Mapping))
_LOSS = Kind(
    "a loss with of(residuals) and weights(residuals)",
    lambda v: all(hasattr(v, name) for name in ("of", "weights")),
)


class About(NamedTuple):
    """Facts about an option beside its default.

    kind: of its values. help: for the reader. metavar: placeholder of the value in a usage line.
    commands: that have it. decides: whether the model that comes out depends on it.
    """

    kind: Kind
    help: str
    metavar: str | None = None
    commands: tuple[str, ...] = RUN
    decides: bool = True


class Between(NamedTuple):
    """Bounds of a coefficient, as `between` makes them."""

    low: float
    high: float


def between(low: float | None, high: float | None) -> Between:
    """Bounds of a coefficient in ``terms``; None: no bound on that side.

        model = gfnn.Hamiltonian(terms={"q1**4": gfnn.between(0, None), "p1**2": 0.5})

    Raises ValueError where no number is between them.
    """
    ends = (-math.inf if low is None else float(low), math.inf if high is None else float(high))
    if not ends[0] < ends[1]:
        raise ValueError(f"expected low < high, got between({low}, {high})")
    return Between(*ends)


def told(terms: Sequence[Any] | Mapping[Any, Any]) -> Sequence[Any]:
    """Terms as texts, with what a mapping tells of their coefficients: None, a number, `between`,
    or the text of a multiple of another term."""
    if not isinstance(terms, Mapping):
        return terms
    texts = []
    for term, value in terms.items():
        if value is not None and not isinstance(term, str):
            raise FitError("terms: expected text as a term that is given with its coefficient")
        if isinstance(value, Between):
            texts.append(f"{value.low!r} <= {term} <= {value.high!r}")
        elif value is None:
            texts.append(term)
        elif isinstance(value, (int, float, str)) and not isinstance(value, bool):
            texts.append(f"{term} = {value}")
        else:
            raise FitError(
                f"terms: expected None, a number, gfnn.between(low, high), or a multiple of "
                f"another term as text for {term}, got {value!r}"
            )
    return tuple(texts)


def _named(cls: type[T]) -> type[T]:
    """Make a dataclass tell, of a wrong name, the nearest right one."""
    init, names = cls.__init__, [field.name for field in dataclasses.fields(cls)]  # pyright: ignore[reportArgumentType]

    @functools.wraps(init)
    def checked(self: T, **given: Any) -> None:
        for name in set(given) - set(names):
            raise TypeError(unexpected(cls.__name__, name, names))
        init(self, **given)

    cls.__init__ = checked
    return cls


@_named
@dataclasses.dataclass(frozen=True, kw_only=True)
class Hamiltonian:
    """H(z), whose flow is the map: of known ``terms``, of those that a library has, or a network
    (family "mlp"); with a ``bracket`` (`gfnn.Bracket`) of states that are no (q, p). Options as of
    `gfnn.fit`."""

    terms: Sequence[str | Callable] | Mapping[str, Any] = ()
    bracket: Any = None
    structure: str | None = None
    family: str = "auto"
    max_iterations: int = 250


@_named
@dataclasses.dataclass(frozen=True, kw_only=True)
class Lagrangian:
    """L(q, v) of a recording, with ``friction`` and inputs. Options as of `gfnn.fit`."""

    terms: Sequence[str] | Mapping[str, Any] = ()
    friction: str = "auto"
    input_hold: str = "auto"
    mass: Mapping[str, float] | None = None
    loss: Any = None
    hidden: int | None = None


@_named
@dataclasses.dataclass(frozen=True, kw_only=True)
class GeneratingFunction:
    """S, whose step is an implicit equation: of a ``family`` in a ``chart``, beside the flow of a
    known ``base``; with a ``bracket`` (`gfnn.Bracket`) of states that are no (q, p). Options as of
    `gfnn.fit`."""

    bracket: Any = None
    family: Any = "auto"
    chart: str = "auto"
    base: str | Callable | None = None
    structure: str | None = None
    ensemble: int = 1
    max_iterations: int = 250


MODELS = {"hamiltonian": Hamiltonian, "lagrangian": Lagrangian, "map": GeneratingFunction}
_OF_MODEL = {n: tuple(f.name for f in dataclasses.fields(model)) for n, model in MODELS.items()}
_MODEL = Kind(
    "gfnn.Hamiltonian(), Lagrangian(), GeneratingFunction(), Arm(), or a model with a name, "
    "sizes(data) and fit(data, size)",
    lambda v: (
        isinstance(v, tuple(MODELS.values()))
        or hasattr(v, "fit_recording")
        or all(hasattr(v, name) for name in ("name", "sizes", "fit"))
    ),
)


OPTIONS: dict[str, About] = {
    "tolerance": About(
        POSITIVE,
        "largest one-step error of a map of states, RMS over coordinates of error divided by "
        "spread; its upper 95 % bound must not exceed it",
        "E",
    ),
    "absolute_tolerance": About(
        POSITIVE,
        "instead of the tolerance: largest RMS error per coordinate, in the data's units",
        "E",
        FIT,
    ),
    "learn": About(
        _one_of("auto", "map", "hamiltonian", "lagrangian"),
        "what is learned: map (S, whose step is an implicit equation), hamiltonian (H, whose flow "
        "is the map) or auto (both: H where it meets the tolerance at no more than four times the "
        "cost of a step, for it holds outside the data and at any time step); for a recording its "
        "law (lagrangian, auto) or the map of its positions (map)",
    ),
    "terms": About(
        _TERMS,
        'known terms of H: "p1**2; 1/sqrt(q1**2 + q2**2)"; in Python also functions of z; for a '
        'recording those of its law: "omega**2; V: cos(theta); R: omega**2"; a coefficient by '
        'its value "cos(theta) = 20", bounds "0 <= cos(theta)" or "cos(a) = 2*cos(b)"',
        "TEXT",
    ),
    "bracket": About(
        _BRACKET,
        "known bracket of states that are no positions and momenta: gfnn.Bracket.so3(2)",
        commands=(),
    ),
    "base": About(
        _LAW,
        'known part of H: "p1**2/2 - cos(q1)"; its flow is factored out, and S learns the '
        "remainder",
        "TEXT",
    ),
    "structure": About(
        STRUCTURE,
        "poisson: states that are no positions and momenta, whose bracket is learned too; or a "
        "structure of many degrees of freedom: H is a sum over equal sites, with terms in q1, p1 "
        "of a site and q2, p2, … of the next ones (ring:2 has two q at every site, side by side); "
        "or over bodies and pairs of bodies (bodies:4:abbb: the last three are alike). For a ring "
        "or a chain S is learned instead where a map is asked for or no H meets the tolerance. "
        "Default: that of the scene",
        "|".join(STRUCTURES),
    ),
    "family": About(
        _one_of(
            *("auto", "polynomial", "features", "sines", "mlp"),
            or_holds=lambda value: callable(value) or hasattr(value, "term_gradients"),
        ),
        "family of the generating function: polynomial (Fourier in angles), features (the "
        "scene's), sines, mlp (also of an H that is a network); in Python also a family of one's "
        "own that is linear in its parameters, or a function of Inputs that gives such families",
    ),
    "model": About(
        _MODEL,
        "model that is learned, with options of its own; or one of one's own; None: what the data "
        "are decides",
        commands=(),
    ),
    "chart": About(
        _one_of("auto", "type1", "type2", "type3", "midpoint"), "chart that S is evaluated in"
    ),
    "ensemble": About(
        COUNT,
        "with family mlp: number of networks trained together; their mean is the map, their "
        "spread its bands",
        "N",
    ),
    "angles": About(_INDICES, "without a scene: indices in z of what has period 2π", commands=()),
    "seed": About(SEED, "seed of what is drawn at random", "N"),
    "max_seconds": About(
        _SECONDS,
        "time for the fit in seconds, after which the best map so far is kept (default 120, or no "
        "limit with a maximum of operations); in Python None: no limit, and the same map on a "
        "busy machine and an idle one",
        "S",
        decides=False,
    ),
    "max_operations": About(
        _OPERATIONS,
        "counted operations for the fit: the value of fit.max_operations in a report gives the "
        "same model again, also where time had ended that fit",
        "N",
        decides=False,
    ),
    "max_iterations": About(COUNT, "iterations of a network's training", commands=()),
    "friction": About(
        _TEXT,
        "for a recording, friction by its force: auto, none, linear (viscous, ∝ v), quadratic "
        "(drag, ∝ v |v|), isotropic (drag of a plane or of space), cubic, dry (Coulomb), stribeck "
        "(beside dry: what it loses at speed), load-dependent (dry, ∝ the size of an input), "
        "place-dependent (viscous, ∝ x²), one-sided (viscous, of one direction), uniform (R = γT); "
        "several joined by +",
        "KIND",
    ),
    "input_hold": About(
        _one_of("auto", "hold", "linear", "band"),
        "for a recording, inputs between samples: hold (zero order), linear, band (band-limited), "
        "or auto, by held-out data",
    ),
    "mass": About(_MASSES, "for a recording: the known mass of one position", commands=()),
    "loss": About(
        _LOSS,
        "for a recording whose law is learned: the loss of residuals in units of their noise, of "
        "one's own",
        commands=(),
    ),
    "hidden": About(
        _whole(0, 2),
        "for a recording of one position: the number of coordinates beside it that no column "
        "shows; by default as many as the record asks for",
        "N",
    ),
    "devices": About(
        DEVICES,
        "number of devices that share the rows, and the networks of an ensemble; on a CPU these "
        "are its cores; the same bits on any number",
        "all|N",
        FIT,
        decides=False,
    ),
}


@_named
@dataclasses.dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of a fit, checked once, when they are made. Each is a keyword of `gfnn.fit`, and most
    are options of ``gfnn run`` and ``gfnn fit``, written --max-seconds.

    Raises FitError, in one line, for a value that an option cannot have, and for options that no
    one model has.
    """

    tolerance: float = 1e-6
    absolute_tolerance: float | None = None
    learn: str = "auto"
    terms: Sequence[str | Callable] | Mapping[str, Any] = ()
    bracket: Any = None
    base: str | Callable | None = None
    structure: str | None = None
    family: Any = "auto"
    model: Any = None
    chart: str = "auto"
    ensemble: int = 1
    angles: Sequence[int] = ()
    seed: int = 0
    max_seconds: float | Literal["auto"] | None = "auto"
    max_operations: int | None = None
    max_iterations: int = 250
    friction: str = "auto"
    input_hold: str = "auto"
    mass: Mapping[str, float] | None = None
    loss: Any = None
    hidden: int | None = None
    devices: int | str | None = None

    def __post_init__(self):
        for option in dataclasses.fields(self):
            value, kind = getattr(self, option.name), OPTIONS[option.name].kind
            if not (value is None and option.default is None) and not kind.holds(value):
                raise FitError(f"expected {kind.words} as {option.name}, got {value!r}")
        object.__setattr__(self, "terms", told(self.terms))
        self._take_from_model()
        self.refuse_others(tuple(MODELS), "one model")
        if self.ensemble > 1 and self.family != "mlp":
            raise FitError("ensemble: of networks S, expected family='mlp'")
        if self.learn == "hamiltonian" and self.family not in ("auto", "mlp"):
            raise FitError(f"family={self.family!r}: of S; H has terms, or is a network ('mlp')")

    def _take_from_model(self) -> None:
        """Take the options of a model of the package's own as though they were named here."""
        if self.model is None:
            return
        learn = next((n for n, kind in MODELS.items() if isinstance(self.model, kind)), None)
        if self._of_models or self.learn != "auto":
            given = ", ".join([*self._of_models, *(["learn"] if self.learn != "auto" else [])])
            raise FitError(f"model: nothing else is learned beside it, expected no {given}")
        if learn is not None:
            own = {name: getattr(self.model, name) for name in _OF_MODEL[learn]}
            for name, value in {**own, "learn": learn, "model": None}.items():
                object.__setattr__(self, name, value)
            self.__post_init__()

    @property
    def _of_models(self) -> list[str]:
        names = dict.fromkeys(name for own in _OF_MODEL.values() for name in own)
        fields = {option.name: option.default for option in dataclasses.fields(self)}
        values = ((name, getattr(self, name), fields[name]) for name in names)
        # An option has its default, or nothing where the default is nothing.
        return [
            n
            for n, v, default in values
            if not (v is default or not (default or v) or v == default)
        ]

    def refuse_others(
        self, learns: Sequence[str], of_what: str, error: type[ValueError] = FitError
    ) -> None:
        """Raise an error where none of the models ``learns`` has all options that were given."""
        given = set(self._of_models)
        asked = learns if self.learn == "auto" else [n for n in learns if n == self.learn]
        if not any(given <= set(_OF_MODEL[n]) for n in asked):
            known = {n: ", ".join(_OF_MODEL[n]) for n in asked or learns}
            listed = "; ".join(f"{MODELS[n].__name__}({own})" for n, own in known.items())
            shown = [f"learn={self.learn!r}"] * (self.learn != "auto") + sorted(given)
            raise error(f"{', '.join(shown)}: not options of {of_what}, expected {listed}")

    @property
    def deciding(self) -> dict[str, Any]:
        """Options that the model depends on, by name, as JSON holds them: what identifies a job."""
        values = {name: getattr(self, name) for name, about in OPTIONS.items() if about.decides}
        if self.bracket is None:
            del values["bracket"]  # jobs of canonical data are what they were
        if self.hidden is None:
            del values["hidden"]
        return {n: list(v) if isinstance(v, (tuple, list)) else v for n, v in values.items()}

    def budget(self, watch: Watch, dim: int | None) -> Budget:
        """Start the budget of a fit whose map has ``dim`` degrees of freedom."""
        seconds = seconds_allowed(self.max_seconds, self.max_operations)
        return Budget(seconds, self.max_operations, watch.clock, dim, watch.spent)


@_named
@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch:
    """Facts about a fit that decide nothing of its model: who watches it, and what it goes on from.

    clock: gives the seconds that max_seconds is held against. spent: seconds of them that are gone
    already, as on reading files. checkpoints, factors: a ``TrainingCheckpoints`` and a
    ``KeptFactors``, which an interrupted fit has saved to and the same fit goes on from.
    on_progress, on_candidate: called with what is being done, and with every candidate. on_better:
    called with a map and its candidate whenever steps have shown one that is more accurate than
    those before, so that it can be kept should the fit be interrupted.
    """

    clock: Callable[[], float] = time.perf_counter
    spent: float = 0.0
    checkpoints: Any = None
    factors: Any = None
    on_progress: Callable[[str], Any] = lambda message: None
    on_candidate: Callable[[Any], Any] = lambda candidate: None
    on_better: Callable[[Any, Any], Any] | None = None

    @classmethod
    def taken_from(cls, changes: dict[str, Any]) -> Watch:
        """Take those of these keywords that are of a watch, out of them."""
        names = {field.name for field in dataclasses.fields(cls)} & set(changes)
        return cls(**{name: changes.pop(name) for name in names})


_LISTED = "\n".join(f"    {name}: {about.help}." for name, about in OPTIONS.items())
FitOptions.__doc__ = f"{FitOptions.__doc__}\n{_LISTED}\n    "


_WATCHED = ("on_progress", "on_candidate")  # of a `Watch`; jobs give the others


def with_options(function: Callable[P, T]) -> Callable[P, T]:
    """Show the options in the signature and the documentation of a function that takes them by
    ``**options``."""
    shown = inspect.signature(function)
    own = [p for p in shown.parameters.values() if p.kind is not p.VAR_KEYWORD]
    watched = inspect.signature(Watch).parameters
    options = [*inspect.signature(FitOptions).parameters.values(), *map(watched.get, _WATCHED)]
    ordered = sorted([*own, *options], key=lambda p: p.kind is p.KEYWORD_ONLY)
    function.__signature__ = shown.replace(parameters=ordered)  # pyright: ignore[reportFunctionMemberAccess]
    function.__doc__ = f"{function.__doc__}\n    Options:\n\n{_LISTED}\n    "
    return function
