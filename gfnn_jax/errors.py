"""Errors and the warning of the package, each a message of one line; and how messages name options.

A message is written once, with options as the command line has them: ``--degrees angle``. Who
calls from Python reads ``degrees=['angle']``.
"""

import contextlib
import difflib
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# An option with its value, up to the punctuation of a sentence; a value is no word of the sentence.
_WORDS = (
    "a|an|and|as|at|begins|discards|fit|for|gives?|goes|has|holds|if|in|is|keeps|learns|makes|names"
    "|needs|of|or|pays|replaces|takes|that|the|then|to|uses|whose|with"
)
_VALUE = rf"(?!(?:{_WORDS})\b)('[^']*'|[^\s()]+?)(?=[.,;:)]*(?:\s|$))"
_TYPED = re.compile(rf"--([a-z][a-z-]+)(?: {_VALUE})?")
_IN_PYTHON = {"from": "start", "event": "events", "states": "positions"}
_FLAGS = ("overwrite", "resume", "keep", "strict", "quick")
_TEXTS = (
    *("learn", "structure", "chart", "family", "time", "time_unit"),
    *("friction", "to", "scene", "base"),
)
_FORMULAS = ("observe", "events")  # one for each column
_PAIRS = ("guess", "mass", "std")
_PLACES = (None, "FILE", "NAME", "A,B")  # for a value that the reader knows
_readers = ["python"]  # of the messages; the innermost last


@contextlib.contextmanager
def read_in_a_shell() -> Iterator[None]:
    """Messages that are read meanwhile name options as the command line has them."""
    _readers.append("shell")
    try:
        yield
    finally:
        _readers.pop()


def said(text: str) -> str:
    """The text of a message for its reader: with keywords, or inside `read_in_a_shell` as is."""
    return text if _readers[-1] == "shell" else in_python(text)


def in_python(text: str) -> str:
    """Text with options of the command line as keywords.

    >>> in_python("If degrees: --degrees angle")
    "If degrees: degrees=['angle']"
    """
    return _TYPED.sub(_as_keyword, text)


def _as_keyword(found: re.Match[str]) -> str:
    name, value = _IN_PYTHON.get(found[1], found[1].replace("-", "_")), found[2]
    if name in _FLAGS:
        return f"{name}=True" + (f" {value}" if value else "")
    number = value is not None and re.fullmatch(r"[-+]?[\d.,]+(e[-+]?\d+)?", value)
    if name == "to" and (value is None or number):
        name = "stop"  # of rows; that of an export is a format
    if value in _PLACES:
        return f"{name}="
    value = shlex.split(value)[0]
    if name in _FORMULAS:
        return f"{name}={dict([value.split(' = ', 1)])!r}"
    if name in _PAIRS:
        pairs = (pair.split("=", 1) for pair in value.split(","))
        return f"{name}={{{', '.join(f'{of!r}: {_number(x)}' for of, x in pairs)}}}"
    if name in _TEXTS:
        return f"{name}={value!r}"
    if number and name != "angles":
        return f"{name}={value.replace(',', '')}"
    items = [] if value == "none" else value.split(",")
    return f"{name}={[int(x) if x.isdecimal() else x for x in items]!r}"


def as_typed(options: Mapping[str, Any]) -> str:
    """Keywords as options of the command line, with a blank before each: the way back.

    >>> as_typed({"degrees": ("angle",), "start": 2.5, "observe": {"x": "l*sin(theta)"}})
    " --degrees angle --from 2.5 --observe 'x = l*sin(theta)'"
    """
    words = {of: name for name, of in _IN_PYTHON.items() if of != "positions"} | {"stop": "to"}
    parts = []
    for option, value in options.items():
        name, each = words.get(option, option).replace("_", "-"), [value]
        if option in _FORMULAS:
            each = [f"{column} = {formula}" for column, formula in value.items()]
        elif isinstance(value, Mapping):
            number = {n: x if isinstance(x, str) else f"{x:g}" for n, x in value.items()}
            each = [",".join(f"{of}={text}" for of, text in number.items())]
        elif isinstance(value, (tuple, list)):
            each = [",".join(map(str, value)) or "none"]
        parts += [f" --{name} {shlex.quote(str(one))}" for one in each]
    return "".join(parts)


def advised(advice: str, options: Mapping[str, Any]) -> str:
    """Advice, with the options that follow it typed behind it where it ends in a colon.

    >>> advised("Its unit is degrees:", {"degrees": ("angle",)})
    'Its unit is degrees: --degrees angle'
    """
    return advice + as_typed(options) if advice.endswith(":") else advice


def _number(text: str) -> str:
    with contextlib.suppress(ValueError):
        return repr(float(text))
    return text


class _OfOneLine(Exception):
    """A message of one line, whose options its reader can type."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))

    def __str__(self) -> str:
        return said(super().__str__())


class InputError(_OfOneLine, ValueError):
    """Error of usage or input. The message names what was expected and what came."""


class WorkError(_OfOneLine, RuntimeError):
    """Failure during the work, such as a full disk. Files that existed before are unchanged."""


class FitError(_OfOneLine, ValueError):
    """Error of data or of a request that can give no map: what was expected and what came.

    verdict: what the data tell, ``no law`` or ``not mechanical`` with a reason, where the search
    has come to one; "" where the data or the request were refused. fit: the fit behind a verdict,
    where there is one.
    """

    def __init__(self, message: str, verdict: str = "", fit: Any = None):
        super().__init__(message)
        self._verdict, self.fit = " ".join(verdict.split()), fit

    @property
    def verdict(self) -> str:
        return said(self._verdict)


class OutOfTime(Exception):
    """The budget of a fit is spent; what was found so far stands."""


class FitWarning(_OfOneLine, UserWarning):
    """Warning about a fit that continued: what was found and what it means for the result."""


def unexpected(owner: str, name: str, names: Sequence[str]) -> str:
    """Message about a keyword that ``owner`` has not, with the nearest one that it has."""
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]}?" if near else f"expected {', '.join(names)}"
    return f"{owner}: unexpected keyword argument '{name}', {hint}"
