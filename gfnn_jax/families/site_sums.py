"""Sums over the sites of a lattice as text that sympy reads too, and as Python's syntax trees.

    Sum(0.5*p(i)**2, (i, 1, 8)) + Sum(0.5*(q(i + 1) - q(i))**2, (i, 0, 8))

q(k) and p(k) are the k-th position and momentum. On a ring an index goes on behind the last site by
``Mod``; fixed ends are q(0) = q(d + 1) = 0, p as well.
"""

import ast
import copy
import re
from collections.abc import Callable

from gfnn_jax.errors import InputError

_MOST_SITES = 10_000


def site_sum(text: str, dim: int, ends: str, reach: int, fields: int) -> str:
    """Sum over all windows of ``reach`` + 1 successive sites of a text in a window's q1, p1, q2, …

    dim: degrees of freedom, ``fields`` of them a site. ends: "ring", "free" or "fixed".
    """
    sites = dim // fields
    first, last = {
        "ring": (1, sites),
        "free": (1, sites - reach),
        "fixed": (int(reach == 0), sites + int(reach > 0) - reach),
    }[ends]

    def of_site(found: re.Match) -> str:
        ahead, field = divmod(int(found[2]) - 1, fields)
        return f"{found[1]}({_index(ahead, field, sites, ends, fields)})"

    summand = re.sub(r"\b([qp])([0-9]+)\b", of_site, text)
    return f"Sum({summand}, (i, {first}, {last}))"


def _index(ahead: int, field: int, sites: int, ends: str, fields: int) -> str:
    """The index, from 1, of a field of the site that is so far ahead of site i."""
    times = f"{fields}*" if fields > 1 else ""
    if ends == "ring" and ahead:
        after = f"i + {ahead - 1}" if ahead > 1 else "i"
        return f"{times}Mod({after}, {sites}) + {field + 1}"
    behind = fields * (ahead - 1) + field + 1
    shift = f" {'+' if behind > 0 else '-'} {abs(behind)}" if behind else ""
    return f"{times}i{shift}"


def written_out(tree: ast.expr, dim: int) -> ast.expr:
    """The tree, every ``Sum(…, (i, first, last))`` in it the sum of its summands in q1..qd, p1..pd.

    Raises InputError for bounds that are no whole numbers, and for an index without a site.
    """

    def named(letter: str, index: int) -> ast.expr:
        if 1 <= index <= dim:
            return ast.Name(f"{letter}{index}", ast.Load())
        if abs(2 * index - 1 - dim) <= 2 * dim:  # a wall, of several coordinates for several fields
            return ast.Constant(0.0)
        raise InputError(f"expected {letter}(1) to {letter}({dim}), got {letter}({index})")

    if not _has_sum(tree):
        return tree
    return _Sums(named, lambda first, last: range(first, last + 1)).visit(tree)


def of_a_window(tree: ast.expr) -> list[ast.expr]:
    """Summands of the sums over sites in the q1, p1, q2, … of a site and the next ones, which
    `dataset.structures` sums over its own sites; of any other expression itself."""

    def named(letter: str, index: int) -> ast.expr:
        return ast.Name(f"{letter}{index}", ast.Load())

    if not _has_sum(tree):
        return [tree]
    addends, ahead = [], [tree]
    while ahead:
        node = ahead.pop()
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            ahead += [node.right, node.left]
        else:
            addends.append(node)
    return [_Sums(named, lambda *_: range(1, 2)).visit(node) for node in addends]


def _has_sum(tree: ast.expr) -> bool:
    return any(_calls(node, "Sum") for node in ast.walk(tree))


def _calls(node: ast.AST, *names: str) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names


class _Sums(ast.NodeTransformer):
    """Writes sums out: the sites of a sum by its first and last, the name of a coordinate by its
    letter and index."""

    def __init__(self, named: Callable[[str, int], ast.expr], sites: Callable[[int, int], range]):
        self._named, self._sites, self._at = named, sites, {}

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if _calls(node, "q", "p") and len(node.args) == 1 and isinstance(node.func, ast.Name):
            return self._named(node.func.id, _whole(node.args[0], self._at))
        if not _calls(node, "Sum"):
            return self.generic_visit(node)
        over = node.args[1] if len(node.args) == 2 else None
        if not (
            isinstance(over, ast.Tuple)
            and len(over.elts) == 3
            and isinstance(over.elts[0], ast.Name)
        ):
            raise InputError(
                f"expected a sum over sites as Sum(p(i)**2, (i, 1, 8)), got '{ast.unparse(node)}'"
            )
        sites = self._sites(*(_whole(bound, {}) for bound in over.elts[1:]))
        if not 0 < len(sites) <= _MOST_SITES:
            raise InputError(f"expected a sum over 1 to {_MOST_SITES:,} sites, got {len(sites):,}")
        summands = []
        for site in sites:
            self._at = {over.elts[0].id: site}
            summands.append(self.visit(copy.deepcopy(node.args[0])))
        self._at = {}
        return balanced(summands)


def balanced(addends: list[ast.expr]) -> ast.expr:
    """Sum of many addends as a tree that is not deep."""
    if len(addends) == 1:
        return addends[0]
    half = len(addends) // 2
    return ast.BinOp(balanced(addends[:half]), ast.Add(), balanced(addends[half:]))


def _whole(node: ast.expr, at: dict[str, int]) -> int:
    """Value of an index: whole numbers, the site, + - * and Mod."""
    match node:
        case ast.Constant(value=int(value)):
            return value
        case ast.Name(id=name) if name in at:
            return at[name]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_whole(operand, at)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() as op, right=right):
            a, b = _whole(left, at), _whole(right, at)
            return a + b if isinstance(op, ast.Add) else a - b if isinstance(op, ast.Sub) else a * b
        case ast.Call(func=ast.Name(id="Mod"), args=[value, divisor]) if _whole(divisor, at):
            return _whole(value, at) % _whole(divisor, at)
    raise InputError(f"expected a whole number as the index of a site, got '{ast.unparse(node)}'")
