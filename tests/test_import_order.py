"""The rooms of the house stand in one order, and each third-party library has one home."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

import gfnn_jax

PACKAGE = Path(gfnn_jax.__file__).parent

# A module imports only from rooms before its own; the modules of a room share its place.
ROOMS = """
    arrays errors phase_space coordinates brackets compiling threads processes budget storage
    signals data records scenes families solve generating flows maps dataset exports fitting
    candidates diagnosis models.model models.parameters models.arms models.positions
    models.lagrangians models.textbook models.brackets models.generating_functions
    models.hamiltonians search models.maps_of_laws learn baselines evaluate jobs cli_parser
    cli_summary cli __main__
"""
ORDER = ROOMS.split()
# A method that is a shorthand for a function of another module imports it when called.
SHORTHANDS = {
    ("maps.symplectic_map", f"maps.{name}")
    for name in ("saved", "estimates", "forecasts", "events", "laws")
}
SHORTHANDS |= {
    ("data.recording", "data.recording_summary"),
    ("learn.fitted", "learn.fit"),
    ("learn.fitted", "learn.saved"),
    ("learn.fitted", "evaluate.report"),
    ("learn.fitted", "evaluate.page"),
}
HOMES = {  # the module, and those whose names begin as its own does
    "argparse": "cli",
    "charset_normalizer": "data.texts",
    "narwhals": "data.tables",
    "casadi": "exports.casadi_function",
    "diffrax": "scenes.trajectories",
    "flax": "families.mlp",
    "jinja2": "evaluate.page",
    "llvmlite": "flows.translated",
    "matplotlib": "evaluate.figures",
    "optax": "fitting.adam",
    "orbax": "storage.checkpoints",
    "pandas": "data.text",
    "sympy": "exports.symbolic",
    "yourdfpy": "models.arms.kinematics",
}


@functools.cache
def modules():
    """(name, syntax tree) of every module."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found.append((name.removesuffix(".__init__"), tree))
    return found


def statements(node):
    """The statements below a node, also inside functions, without what is inside expressions."""
    for part in ("body", "orelse", "handlers", "finalbody", "cases"):
        for child in getattr(node, part, ()):
            yield child
            yield from statements(child)


@functools.cache
def imports(tree):
    """List all modules that a file imports, also inside functions."""
    return tuple(_imports(tree))


def _imports(tree):
    for node in statements(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            if node.module.split(".")[0] == "gfnn_jax":
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    path = PACKAGE.parent / inner.replace(".", "/")
                    is_module = path.is_dir() or path.with_suffix(".py").exists()
                    yield inner if is_module else node.module
            else:
                yield node.module


def room_of(name):
    """The room of a module; None of the package itself, and of a package of rooms."""
    parts = name.split(".")
    rooms = (".".join(parts[:count]) for count in (2, 1))
    return next((room for room in rooms if room in ORDER), None)


def test_every_module_has_a_place():
    names = {name for name, _ in modules()} - {"__init__", "models"}
    assert not {name for name in names if room_of(name) is None}


@pytest.mark.slow
def test_imports_follow_the_order():
    wrong = []
    for name, tree in modules():
        if name == "__init__":  # the public names, each imported when first used
            continue
        room = room_of(name)
        for imported in imports(tree):
            if not imported.startswith("gfnn_jax."):
                continue
            other = room_of(imported.removeprefix("gfnn_jax."))
            later = (name, imported.removeprefix("gfnn_jax.")) in SHORTHANDS
            allowed = later or other == room or ORDER.index(other) < ORDER.index(room)
            if not allowed:
                wrong.append(f"{name} imports {imported}")
    assert not wrong


def test_fitting_never_solves():
    for name, tree in modules():
        if name.startswith("fitting"):
            of_steps = ("newton", "fixed_point", "krylov")
            steps = (
                "gfnn_jax.generating.generated",
                "gfnn_jax.maps.symplectic",
                *(f"gfnn_jax.solve.{name}" for name in of_steps),
            )
            assert not [i for i in imports(tree) if i.startswith(steps)], name


def test_no_two_modules_import_each_other():
    """Inside a room too: what each module needs, and what that needs in turn."""
    needs = {
        name: {i.removeprefix("gfnn_jax.") for i in imports(tree) if i.startswith("gfnn_jax.")}
        for name, tree in modules()
        if name != "__init__"
    }
    for name, other in SHORTHANDS:
        needs[name].discard(other)
    for name in needs:
        reached, ahead = set(), set(needs[name])
        while ahead:
            reached |= ahead
            ahead = set().union(*(needs.get(n, ()) for n in ahead)) - reached
        assert name not in reached, name


def test_each_library_has_one_home():
    wrong = [
        f"{name} imports {imported}"
        for name, tree in modules()
        for imported in imports(tree)
        for library, home in HOMES.items()
        if imported.split(".")[0] == library and not name.startswith(home)
    ]
    assert not wrong


def test_costs_no_jax():
    """Importing the package, and refusing bad usage, is a matter of milliseconds."""
    refused = "from gfnn_jax.cli import main; main(['run', 'two-body', '--dt', '-1'])"
    refused += "; main(['fit', 'nowhere.npz', '--out', 'm'])"
    code = f"import sys, gfnn_jax.data.files; {refused}; sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0


def test_public_names():
    assert gfnn_jax.__version__.count(".") == 2
    assert all(getattr(gfnn_jax, name) is not None for name in gfnn_jax.__all__)
    assert set(gfnn_jax.__all__) <= set(dir(gfnn_jax))
    with pytest.raises(AttributeError, match="no attribute 'Mapp'"):
        gfnn_jax.Mapp  # noqa: B018


def models_told_apart():
    """``isinstance`` with a class of `models` in the search and in what follows it."""
    for name, tree in modules():
        if room_of(name) not in ("search", "learn"):
            continue
        of_models = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            and (node.module or "").startswith("gfnn_jax.models.")
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
                classes = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}
                yield from (f"{name} asks for {model}" for model in classes & of_models)


def test_search_and_choice_know_no_model_by_name():
    assert list(models_told_apart()) == []
