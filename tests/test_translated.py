"""Compiled loops against the same functions in Python, which checks every place in an array."""

import ast
import importlib
import inspect
import linecache
import math
import re
import sys
import textwrap

import numpy as np
import pytest
from test_compiled_rollouts import arms
from test_kernel import lanes_of, law_of

from gfnn_jax.flows import compiled_steps, kernel, translated
from gfnn_jax.flows.translated import compiled, function

LIMIT = 3


class Checked(np.ndarray):
    """An array of which no place may be counted from its end."""

    def __getitem__(self, at):
        assert min(at if isinstance(at, tuple) else (at,)) >= 0
        return super().__getitem__(at)

    def __setitem__(self, at, value):
        assert min(at if isinstance(at, tuple) else (at,)) >= 0
        super().__setitem__(at, value)


@pytest.mark.parametrize(("d", "order"), [(2, 2), (2, 0), (3, 1)])
def test_steps_are_those_of_python(monkeypatch, d, order):
    """To the last bit, within all arrays."""
    (form, p), (x, h, u) = law_of(d, True, True, shapes=True), lanes_of(d, 6)
    found, whole = form.step(p, x, h, u[:, :1], order), kernel.follow.plain
    assert (found.modes == 0).any()  # friction that holds

    def plain(*arguments):
        def checked(one):
            if isinstance(one, tuple):
                items = map(checked, one)
                return one._make(items) if hasattr(one, "_make") else tuple(items)
            return one.view(Checked) if isinstance(one, np.ndarray) else one

        with np.errstate(all="ignore"):
            whole(*map(checked, arguments))

    monkeypatch.setattr(kernel, "follow", plain)
    for one, other in zip(form.step(p, x, h, u[:, :1], order), found, strict=True):
        np.testing.assert_array_equal(one, other)


@function
def shared(values, k):
    """Two numbers of a row."""
    if k > LIMIT:
        return 0, 1.5
    return k, values[k, 0] / 2


@compiled("a test", 1)
def loops(whole, rows, pair):
    (one, other), total, seen = pair, 0, False
    count, width = rows.shape
    one[:] = -1
    for k in range(count - 1, -1, -2):
        if k == LIMIT - 1:
            continue
        size, half = shared(rows, k)
        total += size
        rows[k, 0] = rows[k, -k + k] + half if not seen else -half
        rows[k, 1] = max(rows[k, 1], k, 2.5) - min(abs(-k), 4)
        seen = seen or k not in (9, count - 1)
        other[k], one[k] = one[k], 1 < k <= 4
        row = rows[k]
        row[1] -= len(row) - width if total else np.inf
    while True:
        total -= 1
        if total < -5:
            break
    whole[0] = int(rows[1, 0]) + total
    whole[1], whole[2] = whole[0] * (-2), whole[0] // 4 if seen else 0


def test_what_is_written_in_python_means_the_same():
    rng, found = np.random.default_rng(0), []
    rows = rng.normal(size=(7, 2))
    for loop in (loops, loops.plain):
        given = np.zeros(3, np.int64), rows.copy(), (np.zeros(7), np.zeros(7))
        loop(*given)
        found.append([given[0], given[1], *given[2]])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def other(rows, k):
    """Statements that no code stands for, one after another."""
    (
        rows[0] // 3,
        rows.shape[0] // -2,
        k**2,
        k or 1,
        rows[-1],
        rows[0.5],
        max(1, 2, key=abs),
        [k],
        rows + 1,
    )
    rows[1:] = 0.0
    for i in range(0, 3, k):
        rows[i] = 0.0
    for row in rows:
        rows[0] = row
    for i in range(2):
        rows[i] = 0.0
    else:
        rows[0] = 1.0
    k = rows
    LIMIT(k)
    if k > 2:
        return k


TREE = ast.parse(textwrap.dedent(inspect.getsource(other))).body[0].body
WRITTEN = [ast.unparse(node) for node in [*TREE[1].value.elts, *TREE[2:]]]


@pytest.mark.parametrize("written", WRITTEN)
def test_what_has_no_code_is_refused(tmp_path, monkeypatch, written):
    text = f"LIMIT = 3\ndef refused(rows, k):\n{textwrap.indent(written, '    ')}\n"
    (tmp_path / "refused_loops.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "refused_loops", raising=False)
    importlib.invalidate_caches()
    linecache.clearcache()
    plain = importlib.import_module("refused_loops").refused
    with pytest.raises(TypeError, match=r"(?s)^refused, line \d+: .* has no code$"):
        compiled("a test", 1)(plain)(np.zeros(3), 2)


def test_arrays_that_are_not_contiguous_are_refused():
    with pytest.raises(ValueError, match="contiguous"):
        loops(np.zeros(3, np.int64), np.zeros((2, 7)).T, (np.zeros(7), np.zeros(7)))


@compiled("a test", 1)
def calls(x):
    for i in range(len(x)):
        x[i] = math.sin(x[i]) + math.cos(x[i]) + math.exp(x[i]) ** x[i] + math.log(x[i])
        x[i] += math.tan(x[i]) + math.sinh(x[i]) + math.cosh(x[i]) + math.tanh(x[i])
        x[i] += math.atan(x[i]) + math.hypot(x[i], 2.0) + math.sqrt(x[i]) + np.rint(x[i])


@pytest.mark.parametrize("loop", [kernel.follow, compiled_steps.roll, calls])
def test_all_that_code_calls_is_known_beforehand(monkeypatch, loop):
    """LLVM looks for other functions itself, and ends the process where there is none."""
    texts, module = [], translated._module

    def kept(*given):
        texts.append(module(*given))
        return texts[-1]

    monkeypatch.setattr(translated, "_module", kept)
    monkeypatch.setattr(translated, "_folder", lambda: None)
    monkeypatch.setattr(loop, "made", {})
    if loop is calls:
        loop(np.ones(3))
    elif loop is kernel.follow:
        (form, p), (x, h, u) = law_of(2, True, True, shapes=True), lanes_of(2, 1)
        form.step(p, x, h, u[:, :1], 2)
    else:
        arms("alone")[0].rollout(np.zeros(4), 10_000)
    machine = translated._machine()
    code = machine.emit_assembly(translated._optimised(texts[0], machine))
    called = re.findall(r"(?:\$|:\w+:|\b(?:callq?|bl)[ \t]+)([A-Za-z_]\w*)(?![\w.])", code)
    names, mac = translated._library(), sys.platform == "darwin"
    called = {name[mac:] for name in called}
    assert {"tan", "tanh"} <= called <= {*names}
    declared = re.findall(r"^declare \w+ @(?:llvm\.)?(\w+)", texts[0], re.MULTILINE)
    assert {*declared} <= {*names} | {"fptosi"}
