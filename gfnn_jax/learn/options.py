"""Options of a fit, each named once: its default, what it may be, its help.

`gfnn.fit`, ``gfnn run``, ``gfnn fit`` and the record of a job take them from `FitOptions`. JAX is
not loaded.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from numbers import Integral, Real
from typing import Any, Literal, NamedTuple

from gfnn_jax.budget import Budget, seconds_allowed
from gfnn_jax.dataset.structure_names import EXPECTED, STRUCTURES, names_structure
from gfnn_jax.errors import FitError

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
    def holds(value: Any) -> bool:
        return isinstance(value, Integral) and low <= int(value) < 2**bits

    return Kind(f"a whole number from {low} to 2**{bits} - 1", holds, int)


def _is_positive(value: Any) -> bool:
    return isinstance(value, Real) and 0 < float(value) < math.inf


def _is_text_or_function(value: Any) -> bool:
    return isinstance(value, str) or callable(value)


def _is_family(value: Any) -> bool:
    return callable(value) or hasattr(value, "term_gradients")


def _are(test: Callable[[Any], bool], *kinds: type) -> Callable[[Any], bool]:
    return lambda values: isinstance(values, kinds) and all(test(value) for value in values)


def _texts(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(";") if part.strip())


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
    "a sequence of texts or functions of z, () for none",
    lambda v: not isinstance(v, str) and _are(_is_text_or_function, Sequence)(v),
    _texts,
)
_TEXT = Kind("text", lambda v: isinstance(v, str))
_LAW = Kind("a Hamiltonian as text or a function of z", _is_text_or_function)
_INDICES = Kind("a tuple of indices", _are(lambda i: isinstance(i, int), tuple, list))
_MASSES = Kind("a mapping of a position's name to its mass", lambda v: isinstance(v, Mapping))
_MODEL = Kind(
    "a model with a name, sizes(data) and fit(data, size)",
    lambda v: all(hasattr(v, name) for name in ("name", "sizes", "fit")),
)
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
    metavar: str | None
    commands: tuple[str, ...]
    decides: bool


def _about(
    kind: Kind,
    help_: str,
    metavar: str | None = None,
    commands: tuple[str, ...] = RUN,
    *,
    decides: bool = True,
) -> dict[str, About]:
    return {"about": About(kind, help_, metavar, commands, decides)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of a fit, checked once, when they are made. Each is a keyword of `gfnn.fit`, and most
    are options of ``gfnn run`` and ``gfnn fit``, written --max-seconds.

    Raises FitError, in one line, for a value that an option cannot have, and for options that
    exclude one another.
    """

    tolerance: float = field(
        default=1e-6,
        metadata=_about(
            POSITIVE,
            "largest one-step error of a map of states, RMS over coordinates of error divided by "
            "spread; its upper 95 % bound must not exceed it",
            "E",
        ),
    )
    absolute_tolerance: float | None = field(
        default=None,
        metadata=_about(
            POSITIVE,
            "instead of the tolerance: largest RMS error per coordinate, in the data's units",
            "E",
            FIT,
        ),
    )
    learn: str = field(
        default="auto",
        metadata=_about(
            _one_of("auto", "map", "hamiltonian", "lagrangian"),
            "what is learned: map (S, whose step is an implicit equation), hamiltonian (H, "
            "whose flow "
            "is the map) or auto (both: H where it meets the tolerance at no more than four "
            "times the "
            "cost of a step, for it holds outside the data and at any time step); of a "
            "recording its "
            "law (lagrangian, auto) or the map of its positions (map)",
        ),
    )
    terms: Sequence[str | Callable] = field(
        default=(),
        metadata=_about(
            _TERMS,
            'known terms of H: "p1**2; 1/sqrt(q1**2 + q2**2)"; in Python also functions of z; of a '
            'recording those of its law: "omega**2; V: cos(theta); R: omega**2"',
            "TEXT",
        ),
    )
    base: str | Callable | None = field(
        default=None,
        metadata=_about(
            _LAW,
            'known part of H: "p1**2/2 - cos(q1)"; its flow is factored out, and S learns the '
            "remainder",
            "TEXT",
        ),
    )
    structure: str | None = field(
        default=None,
        metadata=_about(
            STRUCTURE,
            "structure of many degrees of freedom: H is a sum over equal sites, with terms "
            "in q1, p1 "
            "of a site and q2, p2, … of the next ones (ring:2 has two q at every site, side "
            "by side); "
            "or over bodies and pairs of bodies (bodies:4:abbb: the last three are alike). "
            "Of a ring "
            "or a chain S is learned instead where a map is asked for or no H meets the tolerance. "
            "Default: that of the scene",
            "|".join(STRUCTURES),
        ),
    )
    family: Any = field(
        default="auto",
        metadata=_about(
            _one_of("auto", "polynomial", "features", "sines", "mlp", or_holds=_is_family),
            "family of the generating function: polynomial (Fourier in angles), features (the "
            "scene's), sines, mlp (also of an H that is a network); in Python also a family "
            "of one's "
            "own that is linear in its parameters, or a function of Inputs that gives such "
            "families",
        ),
    )
    model: Any = field(
        default=None,
        metadata=_about(
            _MODEL, "a model of one's own, which is then all that is learned", commands=()
        ),
    )
    chart: str = field(
        default="auto",
        metadata=_about(
            _one_of("auto", "type1", "type2", "type3", "midpoint"),
            "chart that S is evaluated in",
        ),
    )
    ensemble: int = field(
        default=1,
        metadata=_about(
            COUNT,
            "with family mlp: number of networks trained together; their mean is the map, their "
            "spread its bands",
            "N",
        ),
    )
    angles: Sequence[int] = field(
        default=(),
        metadata=_about(
            _INDICES, "without a scene: indices in z of what has period 2π", commands=()
        ),
    )
    seed: int = field(
        default=0,
        metadata=_about(
            SEED,
            "seed of what is drawn at random",
            "N",
        ),
    )
    max_seconds: float | Literal["auto"] | None = field(
        default="auto",
        metadata=_about(
            _SECONDS,
            "time for the fit in seconds, after which the best map so far is kept (default "
            "120, or no "
            "limit with a maximum of operations); in Python None: no limit, and the same map "
            "on a busy "
            "machine and an idle one",
            "S",
            decides=False,
        ),
    )
    max_operations: int | None = field(
        default=None,
        metadata=_about(
            _OPERATIONS,
            "counted operations for the fit: the value of fit.max_operations in a report gives the "
            "same model again, also where time had ended that fit",
            "N",
            decides=False,
        ),
    )
    max_iterations: int = field(
        default=250,
        metadata=_about(
            COUNT,
            "iterations of a network's training",
            commands=(),
        ),
    )
    friction: str = field(
        default="auto",
        metadata=_about(
            _TEXT,
            "of a recording, friction by its force: auto, none, linear (viscous, ∝ v), quadratic "
            "(drag, "
            "∝ v |v|), dry (Coulomb), uniform (R = γT); several joined by +",
            "KIND",
            FIT,
        ),
    )
    input_hold: str = field(
        default="auto",
        metadata=_about(
            _one_of("auto", "hold", "linear", "band"),
            "of a recording, inputs between samples: hold (zero order), linear, band "
            "(band-limited), "
            "or "
            "auto, by held-out data",
            None,
            FIT,
        ),
    )
    mass: Mapping[str, float] | None = field(
        default=None,
        metadata=_about(_MASSES, "of a recording: the known mass of one position", commands=()),
    )
    loss: Any = field(
        default=None,
        metadata=_about(
            _LOSS,
            "of a recording whose law is learned: the loss of residuals in units of their "
            "noise, of "
            "one's own",
            commands=(),
        ),
    )
    devices: int | str | None = field(
        default=None,
        metadata=_about(
            DEVICES,
            "number of devices that share the rows, and the networks of an ensemble; on a "
            "CPU these "
            "are its cores; the same bits on any number",
            "all|N",
            FIT,
            decides=False,
        ),
    )

    def __post_init__(self):
        for option in dataclasses.fields(self):
            value, kind = getattr(self, option.name), option.metadata["about"].kind
            if not (value is None and option.default is None) and not kind.holds(value):
                raise FitError(f"expected {kind.words} as {option.name}, got {value!r}")
        self._refuse_contradictions()

    def _refuse_contradictions(self) -> None:
        of_h, plain = self.learn == "hamiltonian", (self.family, self.chart) == ("auto", "auto")
        if self.model is not None and not (
            plain
            and (self.learn, self.base) == ("auto", None)
            and not self.terms
            and self.structure is None
        ):
            raise FitError(
                "model: nothing else is learned beside it, expected no learn, terms, base, "
                "structure, family or chart"
            )
        if self.ensemble > 1 and (self.family != "mlp" or of_h):
            raise FitError(
                "an ensemble is of networks S: expected family='mlp' and no learn='hamiltonian', "
                f"got {self._given}"
            )
        if self.terms and (self.learn == "map" or not plain):
            raise FitError(
                "terms are those of H: expected no learn='map', family or chart beside them, got "
                f"{self._given}"
            )
        if self.base is not None and (of_h or self.terms):
            raise FitError(
                "base is factored out of a map S: expected no terms or learn='hamiltonian' beside "
                f"it, got {self._given or 'terms'}"
            )
        if of_h and (self.family not in ("auto", "mlp") or self.chart != "auto"):
            raise FitError(
                "learn='hamiltonian' has no chart, and no family but 'mlp': these are of S; got "
                f"{self._given}"
            )

    @property
    def _given(self) -> str:
        """Names of learn, family and chart that were asked for."""
        asked = {"learn": self.learn, "family": self.family, "chart": self.chart}
        return ", ".join(f"{n}={value!r}" for n, value in asked.items() if value != "auto")

    @property
    def deciding(self) -> dict[str, Any]:
        """Options that the model depends on, by name, as JSON holds them: what identifies a job."""
        values = {name: getattr(self, name) for name, about in OPTIONS.items() if about.decides}
        return {n: list(v) if isinstance(v, (tuple, list)) else v for n, v in values.items()}

    def budget(self, clock: Callable[[], float], dim: int | None, spent: float = 0.0) -> Budget:
        """Start the budget of a fit whose map has ``dim`` degrees of freedom, ``spent`` seconds
        ago."""
        seconds = seconds_allowed(self.max_seconds, self.max_operations)
        return Budget(seconds, self.max_operations, clock, dim, spent)


OPTIONS: dict[str, About] = {f.name: f.metadata["about"] for f in dataclasses.fields(FitOptions)}
_LISTED = "\n".join(f"    {name}: {about.help}." for name, about in OPTIONS.items())
FitOptions.__doc__ = f"{FitOptions.__doc__}\n{_LISTED}\n    "


def with_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Show the options in the signature and the documentation of a function that takes them by
    ``**options``."""
    shown = inspect.signature(function)
    own = [p for p in shown.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = list(inspect.signature(FitOptions).parameters.values())
    ordered = sorted([*own, *options], key=lambda p: p.kind is p.KEYWORD_ONLY)
    function.__signature__ = shown.replace(parameters=ordered)  # pyright: ignore[reportFunctionMemberAccess]
    function.__doc__ = f"{function.__doc__}\n    Options:\n\n{_LISTED}\n    "
    return function
