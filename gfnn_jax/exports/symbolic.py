"""Formulas for people, for parsers, and as sympy reads them: its home."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from xml.dom.minidom import parseString

from gfnn_jax.families.text import GREEK, Term, added, digits, in_letters, measured


def _math(inside: str) -> str:
    return f"<math><mrow>{inside}</mrow></math>"


def defines(name: str) -> str:
    """MathML of "name =", which stands before a formula."""
    return _math(f"<mi>{name}</mi><mo>=</mo>")


def _number(text: str) -> str:
    return f'<mn>{text}</mn><mspace width="0.17em"></mspace>' if text else ""


@dataclasses.dataclass(frozen=True)
class Formula:
    """A sum of terms, each as code in the names of its variables."""

    terms: tuple[Term, ...]

    @property
    def formula(self) -> str:
        """Formula as Python writes it, which ``--terms`` and sympy read."""
        return added(f"{digits(c, s)}*{t}" for t, c, s in self.terms) or "0"

    def __str__(self) -> str:
        """Formula as a person writes it: the last digits' standard errors in brackets."""
        return added(_times(c, s, in_letters(t)) for t, c, s in self.terms) or "0"

    def sympy(self) -> Any:
        """Formula as a sympy expression."""
        return as_sympy(self.formula)

    def latex(self) -> str:
        """Formula in LaTeX's notation, its terms in their order, with errors in the last digits."""
        wrap = r"\left({}\right)"
        texts = (wrap.format(as_latex(t)) if _is_sum(t) else as_latex(t) for t, _, _ in self.terms)
        return added(_times(c, s, t) for t, (_, c, s) in zip(texts, self.terms, strict=True)) or "0"

    def mathml(self) -> str:
        """Formula as presentation MathML that browsers typeset, with errors: an element for each
        term, so that a page can break lines between them."""
        parts = []
        for place, (term, c, s) in enumerate(self.terms):
            sign = "−" if c < 0 else "+" if place else ""
            number, _, _ = _times(abs(c), s, "").partition(" ")
            body = as_mathml(term) if term != "1" or not number else ""
            if _is_sum(term):
                body = f'<mo stretchy="false">(</mo>{body}<mo stretchy="false">)</mo>'
            parts.append(_math(f"<mo>{sign}</mo>" * bool(sign) + _number(number) + body))
        return " ".join(parts) or _math("<mn>0</mn>")

    def _repr_latex_(self) -> str:
        return f"${self.latex()}$"

    def _repr_html_(self) -> str:
        return self.mathml()


def _is_sum(term: str) -> bool:
    """Return whether a term is a sum, which a coefficient multiplies as a whole."""
    return bool(as_sympy(term).is_Add)


def _times(coefficient: float, std: float, term: str) -> str:
    """A coefficient with its standard error before a term, neither where it is 1."""
    number = "" if coefficient == 1 and std == 0 and term != "1" else measured(coefficient, std)
    return " ".join(filter(None, (number, "" if term == "1" else term)))


def as_sympy(text: str) -> Any:
    """The expression that a formula in Python's notation says; every name but a function's is a
    symbol, those that sympy has for its own (S, N, E, …) too."""
    import sympy  # loaded when first used

    named = re.findall(r"[A-Za-z_]\w*\b(?!\()", text)
    known: dict[str, Any] = {"arctan": sympy.atan} | {name: sympy.Symbol(name) for name in named}
    return sympy.sympify(text, locals=known)  # pyright: ignore[reportCallIssue]


def as_latex(text: str) -> str:
    """The formula in LaTeX's notation: names of several letters are upright, theta_dot is a
    derivative."""
    import sympy

    expression = as_sympy(text)
    names = {symbol: _typeset(symbol.name, _LATEX) for symbol in expression.free_symbols}
    return sympy.latex(expression, symbol_names=names)


def as_mathml(text: str) -> str:
    """The formula as presentation MathML; names as `as_latex` writes them."""
    from sympy.printing.mathml import MathMLPresentationPrinter

    class Printer(MathMLPresentationPrinter):
        def _print_Symbol(self, sym, style="plain"):
            return parseString(_typeset(sym.name, _MATHML)).documentElement

    tree: Any = Printer()._print(as_sympy(text))
    typeset = tree.toxml()
    # Names of several letters stand apart.
    typeset = typeset.replace("<mo>&InvisibleTimes;</mo>", '<mspace width="0.2em"/>')
    typeset = typeset.replace("<mo>(</mo>", '<mo stretchy="false">(</mo>')
    typeset = typeset.replace("<mo>)</mo>", '<mo stretchy="false">)</mo>')
    return typeset.replace("<mi>sign</mi>", "<mi>sgn</mi>")


class _Notation(NamedTuple):
    """Formats of a name of several letters, a letter, an index, first and second derivatives."""

    name: str
    letter: str
    index: str
    dot: str
    ddot: str


_LATEX = _Notation(r"\mathrm{{{}}}", "{}", "{}_{{{}}}", r"\dot{{{}}}", r"\ddot{{{}}}")
_MATHML = _Notation(
    "<mi>{}</mi>",
    "<mi>{}</mi>",
    "<msub>{}<mn>{}</mn></msub>",
    '<mover accent="true">{}<mo>˙</mo></mover>',
    '<mover accent="true">{}<mo>¨</mo></mover>',
)


def _typeset(name: str, notation: _Notation) -> str:
    """A symbol, as theta1, swing_angle or x_ddot, in a notation."""
    for suffix, form in (("_ddot", notation.ddot), ("_dot", notation.dot)):
        if name.endswith(suffix):
            return form.format(_typeset(name.removesuffix(suffix), notation))
    letters = name.rstrip("0123456789")
    index, letters = name[len(letters) :], letters.rstrip("_") or letters
    if letters in GREEK:
        latex = notation is _LATEX
        shown = f"\\{letters}" if latex else notation.letter.format(GREEK[letters])
    elif len(letters) == 1:
        shown = notation.letter.format(letters)
    else:
        shown = notation.name.format(letters.replace("_", r"\_" if notation is _LATEX else "_"))
    return notation.index.format(shown, index) if index else shown


class Equation(NamedTuple):
    """An equation of motion: terms with accelerations, x_ddot of x, equal forces."""

    left: Formula
    right: Formula

    def __str__(self) -> str:
        return f"{self.left} = {self.right}"

    def latex(self) -> str:
        """Equation in LaTeX's notation."""
        return f"{self.left.latex()} = {self.right.latex()}"

    def mathml(self) -> str:
        """Equation as presentation MathML."""
        return f"{self.left.mathml()} {_math('<mo>=</mo>')} {self.right.mathml()}"


def equations_of_motion(
    lagrangians: Sequence[Formula],
    friction: Formula,
    forces: Sequence[Sequence[Term]],
    coordinates: Sequence[str],
    speeds: Sequence[str],
) -> tuple[Equation, ...]:
    """d/dt ∂L/∂v − ∂L/∂q + ∂R/∂v = forces, an equation for each coordinate.

    lagrangians: the terms of L that act on each coordinate. forces: of inputs on it. Each term
    keeps the standard error of its coefficient.
    """
    import sympy

    named = coordinates, speeds, [f"{name}_ddot" for name in coordinates]
    q, v, a = ([sympy.Symbol(name, real=True) for name in names] for names in named)
    real = {sympy.Symbol(symbol.name): symbol for symbol in (*q, *v)}
    found = []
    for i, own in enumerate(forces):
        left: dict[Any, list[Term]] = {}
        right: dict[Any, list[Term]] = {}
        for term in lagrangians[i].terms:
            of_term = as_sympy(term.term).xreplace(real)
            push = sympy.diff(of_term, v[i])
            inertia = sympy.Add(*(sympy.diff(push, v[k]) * a[k] for k in range(len(q))))
            moved = sympy.Add(*(sympy.diff(push, q[k]) * v[k] for k in range(len(q))))
            _collect(left, sympy.expand(inertia), term, 1.0)
            force = sympy.expand(moved - sympy.diff(of_term, q[i]))
            for summand in sympy.Add.make_args(force):
                _collect(right, summand, term, -1.0)
        for term in friction.terms:
            _collect(right, _slope(as_sympy(term.term), sympy.Symbol(speeds[i])), term, -1.0)
        sides = [Formula(tuple(t for of in side.values() for t in of)) for side in (left, right)]
        found.append(_by_known_mass(Equation(sides[0], Formula((*sides[1].terms, *own)))))
    return tuple(found)


def _collect(side: dict[Any, list[Term]], expression: Any, term: Term, sign: float) -> None:
    """Add an expression, times the coefficient of a term, to a side."""
    import sympy

    number, rest = expression.as_coeff_Mul()
    if rest.is_Add:
        content, rest = rest.as_content_primitive()
        number *= content
    if expression.is_zero is not True:
        text, factor = sympy.sstr(rest).replace("Abs(", "abs("), sign * float(number)
        text = f"({text})" if rest.is_Add else text
        own = Term(text, factor * term.coefficient, abs(factor) * term.std)
        side.setdefault(rest, []).append(own)


def _slope(loss: Any, v: Any) -> Any:
    """Derivative of a term of R by a speed: s |s| of |s|³, the sign of s of |s|, and |s| + s of
    (|s| + s)²; times what does not depend on the speed, as a load."""
    import sympy

    load, loss = loss.as_independent(v, as_Add=False)
    base, power = loss.as_base_exp()
    if base.is_Add and base.has(sympy.Abs):
        return 4 * load * base * sympy.diff(base.replace(sympy.Abs, lambda s: 0), v)
    if not isinstance(base, sympy.Abs):
        return load * sympy.diff(loss, v)
    s = base.args[0]
    slope = sympy.sign(s) if power == 1 else s * base ** (power - 2)
    return load * power * slope * sympy.diff(s, v)


def _by_known_mass(equation: Equation) -> Equation:
    """The equation divided by its one inertia, where that is a number without an error."""
    first, *others = equation.left.terms
    if others or first.std > 0 or not first.term.endswith("_ddot"):
        return equation
    by = 1 / first.coefficient
    scaled = (Term(t, by * c, abs(by) * s) for t, c, s in equation.right.terms)
    return Equation(Formula((first._replace(coefficient=1.0),)), Formula(tuple(scaled)))


def hamiltonian(entries: Mapping[tuple[int, ...], Sequence[str]], potential: str, dim: int) -> Any:
    """½ (p − a)ᵀ M⁻¹ (p − a) + V in p1, …, pd: of V, and of the summands of the entries (i, j),
    i <= j, of M and (i,) of a."""
    import sympy

    mass, field = sympy.zeros(dim, dim), sympy.zeros(dim, 1)
    for axes, summands in entries.items():
        entry = sum(map(as_sympy, summands), sympy.Integer(0))
        if len(axes) == 1:
            field[axes[0]] = entry
        else:
            mass[axes], mass[axes[::-1]] = entry, entry
    p = sympy.Matrix(sympy.symbols(f"p1:{dim + 1}")) - field
    kinetic = (p.T * mass.inv() * p)[0, 0] / 2
    return kinetic + as_sympy(potential)
