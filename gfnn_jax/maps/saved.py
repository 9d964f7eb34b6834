"""Symplectic maps on disk: a model folder with a description that a human can read.

A map is a tree of frozen dataclasses. Its arrays go to the folder's arrays, bit for bit. The rest,
the type of every node and its constants, is text. Loading builds only the types of a fixed table,
and no code runs from a loaded file. The two kinds of function that a map may hold, a scene's change
of coordinates and its features, are taken from a scene, by its name.
"""

import dataclasses
import hashlib
import importlib
import json
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gfnn_jax.coordinates import CARTESIAN, LOG, Coordinates
from gfnn_jax.errors import InputError
from gfnn_jax.families.inputs import Inputs
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.scenes import SCENES
from gfnn_jax.scenes.scene import Scene
from gfnn_jax.storage.checkpoints import load_model, save_model
from gfnn_jax.storage.outputs import ensure_new

# Types of the package that maps may hold, each imported where one is saved or loaded.
_KNOWN = """
    brackets.Constant brackets.LieAlgebra brackets.Log brackets.Magnetic
    families.displacements.OfDisplacement families.friction.Friction families.inputs.Inputs
    families.lagrangian.Lagrangian families.mlp.Ensemble families.mlp.Mlp
    families.products.Products families.rigid_bodies.Bodies families.sines.Sines
    families.sums.Groups families.sums.Part families.sums.Sums families.sums.Windows
    families.terms.Terms families.time_step.OfTimeStep flows.bodies.OfBodies
    flows.collective.Casimirs flows.collective.Collective flows.damped.DampedFlow
    flows.damped.Dilations flows.damped.InRestingFrame flows.flow.Flow flows.forces.Forced
    flows.legendre.Legendre flows.lie.LieFlow flows.lie.LieGenerated flows.lifts.Itself
    flows.lifts.Logarithms flows.lifts.Quadratic flows.lifts.Shear flows.systems.OfSystems
    flows.uniform.Uniform generating.charts.Chart generating.charts.TypeOne
    generating.generated.Generated generating.predictor.PolynomialModel
    generating.predictor.Predictor maps.domain.Domain maps.domain.Ranges maps.inputs.Signals
    maps.observation.Crossing maps.observation.Hidden maps.observation.Observation
    maps.parameters.Parameters maps.piece.Affine maps.piece.Damping maps.piece.FunctionsOfArgs
    maps.posterior.Posterior maps.sensors.OtherLaw maps.sensors.Sensors
    maps.stroboscopic.OverPhases maps.symplectic_map.SymplecticMap maps.unseen.Swing
    solve.noise.Biweight solve.noise.SoftL1 solve.noise.Wander
"""
_TYPES: dict[str, type] = {}  # those that were looked up or registered, by name
# Name -> where the type is, and the reverse. Damping was DampingOfArgs in maps that 0.3 saved.
_HOMES = {"LagrangianTerms": "families.lagrangian.Terms", "DampingOfArgs": "maps.piece.Damping"}
_NAMES = {"families.lagrangian.Terms": "LagrangianTerms"}
# What stands beside the items of a dict; and a field of laws that 0.4.0 saved.
_ASIDE = {("dict", "keys"), ("LearnedHamiltonian", "proposals")}


def register(kind: type) -> type:
    """Register a dataclass of one's own, a family, a piece or a loss, for `save` and `load`, by its
    name.

    It is a decorator of the class, in a module that is imported before such a map is loaded. Fields
    of the class are arrays, numbers, text, tuples of these, or of other registered types. Raises
    InputError where it is no dataclass, or another type has its name.
    """
    if not (isinstance(kind, type) and (dataclasses.is_dataclass(kind) or _is_tuple(kind))):
        raise InputError(f"expected a dataclass to register, got {kind!r}")
    name, path = kind.__name__, _path(kind)
    if _HOMES.get(name, path) != path:
        raise InputError(f"another type is registered as {name}: choose another name")
    _TYPES[name], _HOMES[name], _NAMES[path] = kind, path, name
    return kind


def know(paths: str) -> None:
    """Make types of the package known, by their paths in it, which blanks separate."""
    for path in paths.split():
        name = path.rpartition(".")[2]
        _HOMES[name], _NAMES[path] = path, name


know(_KNOWN)


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__name__}".removeprefix("gfnn_jax.")


def _type(name: str) -> type | None:
    """The type that is saved under a name; None where it is not known."""
    if name not in _TYPES and name in _HOMES:
        module, _, kind = _HOMES[name].rpartition(".")
        _TYPES[name] = getattr(importlib.import_module(f"gfnn_jax.{module}"), kind)
    return _TYPES.get(name)


def _is_tuple(kind: type) -> bool:
    """Return whether a type is a ``NamedTuple``."""
    return issubclass(kind, tuple) and hasattr(kind, "_fields")


# Stands in the description where a function of the scene belongs.
_OF_SCENE = "of the scene"
_DESCRIBED = "described"  # name of the text among the arrays of `packed`
_PACKAGES = ("gfnn_jax", "jax", "jaxlib", "flax", "optax", "diffrax", "numpy", "scipy")


def save(
    map_: SymplecticMap,
    folder,
    *,
    scene: Scene | None = None,
    record: dict[str, Any] | None = None,
    overwrite: bool = False,
    beside: dict[str, Any] | None = None,
) -> None:
    """Save a map as a model folder.

    scene:  the scene whose coordinates or features the map uses, where it is not one of the
            package's own; `load` needs it too.
    record: JSON-able, anything worth keeping, such as the origin of the data and the fit's report.
    beside: further trees of registered types, by name.

    Raises InputError where ``folder`` exists (unless ``overwrite``) or the map holds a function
    that cannot be found again by a name, WorkError where writing fails.
    """
    ensure_new(folder, overwrite, folder=True)
    lender = _lender(map_, scene)
    text, arrays = _encode(map_)
    description = {
        "scene": lender,
        "map": text,
        "record": record or {},
        "versions": versions(),
    }
    if beside:
        description["beside"], arrays["beside"] = _encode_all(beside, {"type": "dict"})
    save_model(folder, arrays, description)


def load(folder, scene: Scene | None = None) -> SymplecticMap:
    """Load the map of a model folder; it predicts the same bits as the saved one.

    scene: the scene that the map was learned in, where it is not one of the package's own.

    Raises InputError, in one line, where the folder is damaged, of a newer format, or needs a scene
    that was not given.
    """
    return load_beside(folder, scene)[0]


def load_beside(folder, scene: Scene | None = None) -> tuple[SymplecticMap, dict[str, Any]]:
    """Load the map of a model folder, and what it holds beside by name, the ``record`` among it.
    Raises InputError as `load` does."""
    arrays, description = load_model(folder)
    name = description.get("scene")
    if scene is None and name is not None:
        if name not in SCENES:
            raise InputError(
                f"{folder}: was learned in the scene '{name}', which the package has not. Load it "
                "in Python: gfnn.load(folder, scene=...)"
            )
        scene = SCENES[name]()
    if scene is not None and name is not None and scene.name != name:
        raise InputError(f"{folder}: was learned in the scene '{name}', not in '{scene.name}'")
    texts, trees = description.get("beside", {}), arrays.pop("beside", None) or {}
    try:
        map_ = _decode(description["map"], arrays, scene)
        names = [name for name in {**texts, **trees} if name != "type"]
        beside = {name: _decode(texts.get(name), trees.get(name), scene) for name in names}
        return map_, {**beside, "record": description["record"]}
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{folder}: does not describe a map of this release ({error}). Fit it again"
        ) from error


def can_be_saved(tree: Any) -> bool:
    """Return whether a tree is of registered types alone."""
    try:
        _encode(tree)
    except InputError:
        return False
    return True


def packed(map_: SymplecticMap, scene: Scene | None = None) -> dict[str, np.ndarray]:
    """Pack a map into arrays by name, to send it to another process; `unpacked` is the inverse."""
    text, arrays = _encode(map_)
    named, _ = jax.tree_util.tree_flatten_with_path(arrays)
    described = json.dumps({"scene": _lender(map_, scene), "map": text})
    found = {jax.tree_util.keystr(n, simple=True, separator="/"): np.asarray(a) for n, a in named}
    return {**found, _DESCRIBED: np.array(described)}


def unpacked(arrays: dict[str, np.ndarray], scene: Scene | None = None) -> SymplecticMap:
    """Rebuild the map of `packed`; ``scene`` has the meaning of that of `load`."""
    described = json.loads(str(arrays[_DESCRIBED]))
    if scene is None and described["scene"] is not None:
        scene = SCENES[described["scene"]]()
    tree: dict[str, Any] = {}
    for name, array in arrays.items():
        *folders, last = name.split("/")
        inside = tree
        for folder in folders:
            inside = inside.setdefault(folder, {})
        if name != _DESCRIBED:
            inside[last] = array
    return _decode(described["map"], tree, scene)


def record(folder) -> dict[str, Any]:
    """Load the record that was saved beside a map. Raises InputError as `load` does."""
    return load_model(folder)[1]["record"]


def digest(folder) -> str:
    """SHA-256 of a saved model's description, which contains that of every array."""
    return hashlib.sha256((Path(folder) / "model.json").read_bytes()).hexdigest()


def versions() -> dict[str, str | None]:
    """Versions of the packages that a result depends on; None for one that is not installed."""
    found: dict[str, str | None] = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def _lender(map_: SymplecticMap, scene: Scene | None) -> str | None:
    """Name of the scene that lends the map its functions; None where it needs none."""
    inputs = jax.tree.leaves(map_, is_leaf=lambda node: isinstance(node, Inputs))
    features = [i.features for i in inputs if isinstance(i, Inputs) and i.features is not None]
    changed = map_.coordinates.forward not in (CARTESIAN.forward, LOG.forward)
    if not (features or changed):
        return None
    for lender in [scene] if scene is not None else [make() for make in SCENES.values()]:
        same_coordinates = not changed or lender.coordinates == map_.coordinates
        if same_coordinates and all(f is lender.features for f in features):
            return lender.name
    what = "coordinates" if changed else "features"
    raise InputError(
        f"the map uses {what} of a scene that is not known: pass the scene (scene=...) to save and "
        "to load"
    )


# A tree of dataclasses <-> text and arrays.


def _encode(value: Any) -> tuple[Any, Any]:
    """Encode a node as (text, arrays); either is None where there is none."""
    if isinstance(value, (jax.Array, np.ndarray)) and value.ndim > 0:
        return None, value
    if isinstance(value, dict):
        if value and all(map(_is_array, jax.tree.leaves(value))):
            return None, value  # the parameters of a network
        items = {str(i): item for i, item in enumerate(value.values())}
        return _encode_all(items, {"type": "dict", "keys": list(value)})
    if isinstance(value, (np.generic, np.ndarray, jax.Array)):
        return value.item(), None
    if isinstance(value, Coordinates):
        text = {"name": value.name, "angles": list(value.angles), "cyclic": list(value.cyclic)}
        known = {CARTESIAN.forward: None, LOG.forward: LOG.name}
        change = known.get(value.forward, _OF_SCENE)
        return {"type": "Coordinates", **text, "change": change}, None
    if (path := _path(type(value))) in _NAMES:
        names = _fields_of(type(value))
        items = {name: getattr(value, name) for name in names}
        if items.get("features") is not None:
            items["features"] = _OF_SCENE  # _lender has found whose they are
        return _encode_all(items, {"type": _NAMES[path]})
    if isinstance(value, tuple) and any(
        _path(type(item)) in _NAMES or isinstance(item, dict) or _is_array(item) for item in value
    ):  # items that need places of their own among the arrays
        return _encode_all({str(i): item for i, item in enumerate(value)}, {"type": "tuple"})
    if isinstance(value, tuple):
        return [_encode(item)[0] for item in value], None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value, None
    kind = "function" if callable(value) else type(value).__name__
    raise InputError(
        f"a map that holds a {kind} of your own cannot be saved: gfnn_jax.register makes a "
        "dataclass known"
    )


def _is_array(value: Any) -> bool:
    return isinstance(value, (jax.Array, np.ndarray))


def _fields_of(kind: Any) -> tuple[str, ...]:
    """Names of the fields of a dataclass or a named tuple."""
    return kind._fields if _is_tuple(kind) else tuple(f.name for f in dataclasses.fields(kind))


def _encode_all(items: dict[str, Any], text: dict[str, Any]) -> tuple[Any, Any]:
    arrays = {}
    for name, item in items.items():
        words, numbers = _encode(item)
        if numbers is not None:
            arrays[name] = numbers
        if words is not None or numbers is None:
            text[name] = words
    return text, arrays or None


def _decode(text: Any, arrays: Any, scene: Scene | None) -> Any:
    if isinstance(text, list):
        return tuple(_decode(item, None, scene) for item in text)
    if not isinstance(text, dict):
        return text
    kind = text["type"]
    if kind == "Coordinates":
        return _decode_coordinates(text, scene)
    items = {}
    for name in {**text, **(arrays or {})}:
        numbers = (arrays or {}).get(name)
        if name == "type" or (kind, name) in _ASIDE:
            continue
        if name == "features" and text[name] == _OF_SCENE:
            if scene is None or scene.features is None:
                raise InputError("needs the features of its scene, which has none")
            items[name] = scene.features
        elif name in text:
            items[name] = _decode(text[name], numbers, scene)
        else:
            items[name] = numbers
    if kind == "tuple":
        return tuple(items[str(i)] for i in range(len(items)))
    if kind == "dict":
        return {key: items[str(i)] for i, key in enumerate(text["keys"])}
    if (made := _type(kind)) is None:
        raise InputError(
            f"holds a {kind}, which is not known: import the module that registers it "
            "(gfnn_jax.register)"
        )
    return made(**items)


def _decode_coordinates(text: dict[str, Any], scene: Scene | None) -> Coordinates:
    angles, cyclic = tuple(text["angles"]), tuple(text["cyclic"])
    if text["change"] is None:
        return Coordinates(text["name"], angles, cyclic)
    if text["change"] == LOG.name:
        return LOG
    if scene is None or (scene.coordinates.angles, scene.coordinates.cyclic) != (angles, cyclic):
        raise InputError(f"needs the {text['name']} coordinates of its scene, which has others")
    return scene.coordinates
