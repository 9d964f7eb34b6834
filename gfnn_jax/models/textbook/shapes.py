"""Shapes of laws: functions f(x; θ) of one argument, with a constant θ inside or none.

A shape is a name and an exponent n; `values` computes f and f' for many arguments and constants at
once. All are written for complex θ too: ∂/∂θ is the imaginary part of a step along iε, exact to
roundoff (Squire & Trapp 1998).
"""

import numpy as np

Kind = tuple[str, float]  # name and exponent n
COSH: Kind = ("cosh", 0.0)
TURNING: Kind = ("cos", 1.0)  # of period 2π


def values(kind: Kind, x, theta):
    """(f, f') of the shape at x, with the constant θ, None where the shape has none."""
    name, n = kind
    match name:
        case "power":
            return x**n, n * x ** (n - 1)
        case "log":
            return np.log(x), 1 / x
        case "exp":  # xⁿ e^(θx)
            grown = np.exp(theta * x)
            slope = theta * x**n + (n * x ** (n - 1) if n else 0.0)
            return x**n * grown, slope * grown
        case "root":  # √(θ ± x²)
            root = np.sqrt(theta + n * x * x)
            return root, n * x / root
        case "softened":  # 1/√(θ + x²), of Plummer
            under = theta + x * x
            return under**-0.5, -x * under**-1.5
        case "sin":
            return np.sin(theta * x), theta * np.cos(theta * x)
        case "cos":
            k = n or theta  # 1: of an angle
            return np.cos(k * x), -k * np.sin(k * x)
        case "cosh":
            return np.cosh(theta * x), theta * np.sinh(theta * x)
        case "pole":
            return 1 / (theta + x), -1 / (theta + x) ** 2
        case "lorentz":
            under = 1 + theta * x * x
            return 1 / under, -2 * theta * x / under**2
        case "gauss":
            bell = np.exp(-theta * x * x)
            return bell, -2 * theta * x * bell
    raise ValueError(f"expected a shape, got {name}")


def has_constant(kind: Kind) -> bool:
    return kind[0] not in ("power", "log") and kind != TURNING


def complexity(kind: Kind) -> float:
    """Complexity of a shape: its name 1, a constant, an unusual exponent, a period of 2π more."""
    name, n = kind
    if name != "power":
        return 1.0 + has_constant(kind) + 0.5 * (name in ("exp", "cos") and n != 0)
    return 1.0 + 0.1 * min(abs(n), 6.0) + (1.0 if n % 1 else 0.0)


def kinds_for(x: np.ndarray, *, distance: bool = False, circular: bool = False) -> list[Kind]:
    """The shapes that have values at all of these x (N,). circular: x is a sine or a cosine."""
    low, high = float(x.min()), float(x.max())
    one_signed = low > 1e-3 * high or high < 1e-3 * low  # and not close to the pole at 0
    if circular:
        powers = [1.0, 2.0, 3.0] + ([-1.0, -2.0] if one_signed else [])
        return [("power", n) for n in powers]
    whole = range(1, 1 + (12 if distance else 8))
    found: list[Kind] = [("power", float(n)) for n in whole]
    if one_signed:
        found += [("power", -float(n)) for n in range(1, 13)]
    if one_signed and low > 0:
        found += [("power", n + 0.5) for n in range(-6, 6)]
        found += [("log", 0.0), ("exp", -2.0), ("exp", -1.0)]
    if not distance:
        found += [("sin", 0.0), ("cos", 0.0)]
    found += [("exp", 0.0), ("exp", 1.0), ("root", 1.0), ("root", -1.0), ("pole", 0.0)]
    return [*found, ("softened", 0.0), ("lorentz", 0.0), ("gauss", 0.0)]


def constants_for(kind: Kind, x: np.ndarray) -> np.ndarray:
    """The θ that a shape is first tried with at x (N,), close enough for Gauss–Newton to go on."""
    size, spread = float(np.abs(x).max()), float(np.ptp(x))
    match kind[0]:
        case "exp":
            rates = np.geomspace(0.15, 12.0, 14) / size
            return np.concatenate([-rates[::-1], rates])
        case "cosh":
            return np.geomspace(0.5, 8.0, 4) / size
        case "root":
            around = np.geomspace(0.02, 10.0, 14) if kind[1] > 0 else 1 + np.geomspace(0.002, 5, 14)
            return around * size**2
        case "softened":
            return np.geomspace(0.001, 5.0, 16) * size**2
        case "sin" | "cos":
            return np.geomspace(0.5, 12.0, 16) / size
        case "pole":
            beyond = np.geomspace(0.03, 4.0, 10) * spread
            return np.concatenate([-x.min() + beyond, -x.max() - beyond])
        case "lorentz" | "gauss":
            return np.geomspace(0.1, 20.0, 14) / size**2
    raise ValueError(f"expected a shape with a constant, got {kind[0]}")


# Shapes as formulas write them


def number(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def text_of(kind: Kind, x: str, square: str, theta: float | None) -> str:
    """The shape of the argument with the text x, and of a distance that of its ``square``."""
    name, n = kind
    t = "" if theta is None else number(theta)
    inner = f"({x})" if " " in x and not square else x
    squared = f"({square})" if square else f"{inner}**2"
    if name == "power":
        return f"1/{_power(inner, square, -n)}" if n < 0 else _power(inner, square, n)
    match name:
        case "log":
            return f"log({square or x})"
        case "exp":
            if theta is not None and theta < 0 and " - " in x and not square and n == 0:
                first, second = x.split(" - ")  # of a difference: its opposite
                inner, t = f"({second} - {first})", number(-theta)
            grown = f"exp({t}*{inner})"
            if n == 0:
                return grown
            power = _power(inner, square, abs(n))
            return f"{power}*{grown}" if n > 0 else f"{grown}/{power}"
        case "root":
            return f"sqrt({t} {'+' if n > 0 else '-'} {squared})"
        case "softened":
            return f"1/sqrt({t} + {squared})"
        case "sin" | "cos" | "cosh":
            return f"{name}({x})" if 1 in (n, theta) else f"{name}({t}*{inner})"
        case "pole":
            return f"1/({t} + {inner})"
        case "lorentz":
            return f"1/(1 + {t}*{squared})"
        case "gauss":
            return f"exp(-{t}*{squared})"
    raise ValueError(f"expected a shape, got {name}")


def _power(inner: str, square: str, n: float) -> str:
    """xⁿ for n > 0."""
    if square and n % 2 == 0:
        return f"({square})" if n == 2 else f"({square})**{number(n / 2)}"
    return inner if n == 1 else f"{inner}**{number(n)}"
