"""The rooms of the house stand in one order, and each third-party library has one home."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import gfnn_jax

PACKAGE = Path(gfnn_jax.__file__).parent

# A module imports only from those before it; the modules of a folder share its place.
ORDER = (
    "errors", "phase_space", "coordinates", "scenes", "trajectories", "outputs", "io",
    "predictions", "charts", "domain", "scalars", "starts", "checkpoints", "fitting", "implicit",
    "rollout", "maps", "models", "local_maps", "base_map", "preparation", "candidates", "selection",
    "baselines", "metrics", "figures", "report", "pipeline", "comparison", "cli", "__main__",
)  # fmt: skip
# A method that is a shorthand for a function of a later module imports it when called.
SHORTHANDS = {("maps", "models")}
HOMES = {
    "diffrax": {"trajectories"},
    "flax": {"scalars.mlp"},
    "optax": {"fitting.adam"},
    "orbax": {"checkpoints"},
    "matplotlib": {"figures"},
}


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        yield name.removesuffix(".__init__"), ast.parse(path.read_text(encoding="utf-8"))


def imports(tree):
    """Every module that is imported anywhere in the file, in functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            assert node.module is not None
            if node.module in ("gfnn_jax", *(f"gfnn_jax.{room}" for room in ORDER)):
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    path = PACKAGE.parent / inner.replace(".", "/")
                    is_module = path.is_dir() or path.with_suffix(".py").exists()
                    yield inner if is_module else node.module
            else:
                yield node.module


def test_every_module_has_a_place():
    rooms = {name.split(".")[0] for name, _ in modules()} - {"__init__"}
    assert rooms <= set(ORDER)


def test_imports_follow_the_order():
    wrong = []
    for name, tree in modules():
        if name == "__init__":  # the public names, each imported when first used
            continue
        room = name.split(".")[0]
        for imported in imports(tree):
            if not imported.startswith("gfnn_jax."):
                continue
            other = imported.split(".")[1]
            allowed = other == room or ORDER.index(other) < ORDER.index(room)
            if not allowed and (room, other) not in SHORTHANDS:
                wrong.append(f"{name} imports {imported}")
    assert not wrong


def test_fitting_never_solves():
    for name, tree in modules():
        if name.startswith("fitting"):
            rooms = {i.split(".")[1] for i in imports(tree) if i.startswith("gfnn_jax.")}
            assert not rooms & {"implicit", "maps", "rollout"}


def test_each_library_has_one_home():
    wrong = [
        f"{name} imports {imported}"
        for name, tree in modules()
        for imported in imports(tree)
        for library, homes in HOMES.items()
        if imported.split(".")[0] == library and name not in homes
    ]
    assert not wrong


@pytest.mark.parametrize(
    "statement",
    [
        "import gfnn_jax",
        "import gfnn_jax.cli; gfnn_jax.cli.main(['run', 'two-body', '--dt', '-1'])",
    ],
)
def test_costs_no_jax(statement):
    """Importing the package, and refusing bad usage, is a matter of milliseconds."""
    code = f"import sys; {statement}; sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0


def test_public_names():
    assert gfnn_jax.__version__.count(".") == 2
    assert all(getattr(gfnn_jax, name) is not None for name in gfnn_jax.__all__)
    assert set(gfnn_jax.__all__) <= set(dir(gfnn_jax))
    with pytest.raises(AttributeError, match="no attribute 'Mapp'"):
        gfnn_jax.Mapp  # noqa: B018
