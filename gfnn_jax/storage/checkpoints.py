"""Model folders and training checkpoints: saved whole, verified bit for bit when loaded.

A folder holds

- ``arrays.npz``: the arrays, under their names in the tree; of a model that 0.3 saved, ``arrays/``,
  by Orbax;
- ``model.json``: everything else in plain text, with shape, dtype and SHA-256 of every array;
- ``SHA256SUMS``: the digest of every file (``sha256sum -c SHA256SUMS`` checks it too).

It appears under its name only when it is complete. Loading reads data only: no code runs from a
loaded file.
"""

import hashlib
import json
import re
import shutil
import warnings
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gfnn_jax.errors import InputError
from gfnn_jax.storage import outputs

# Formats of folders, with where their arrays are: that of 0.3, read only, and that of 0.4.
_FORMAT, _ARRAYS = 3, {2: "arrays", 3: "arrays.npz"}
_SUMS = "SHA256SUMS"
_JSON = "model.json"


def save_model(folder, arrays: dict[str, Any], description: dict[str, Any]) -> None:
    """Save nested dicts of arrays and a JSON-able description as a model folder.

    An existing ``folder`` is replaced; `outputs.ensure_new` checks first. Raises WorkError if
    writing fails; an existing folder is then unchanged.
    """
    _write(Path(folder), arrays, {"description": description})


def load_model(folder) -> tuple[dict[str, Any], dict[str, Any]]:
    """Load the arrays (NumPy, with the bits and dtypes that were saved) and the description.

    Raises InputError, in one line, where anything is missing, changed, or of another format, and
    where the arrays are float64 while JAX's x64 mode is off, which would round them.
    """
    tree, record = _read(Path(folder))
    dtypes = [leaf.dtype for leaf in jax.tree.leaves(tree) if isinstance(leaf, np.ndarray)]
    wide = [dtype for dtype in dtypes if jax.dtypes.canonicalize_dtype(dtype) != dtype]
    if wide:
        raise InputError(
            f"{folder}: holds {wide[0]} arrays: switch on JAX's float64 first "
            '(jax.config.update("jax_enable_x64", True))'
        )
    return tree, record["description"]


class TrainingCheckpoints:
    """Store of the last two checkpoints of a training, in ``folder/step_...``.

    identity: a JSON-able dict that says which training this is (digests of data and settings);
    `latest` refuses the checkpoints of another one.

    A tree is made of dicts, lists, tuples and None, with arrays, Python numbers and booleans as
    leaves.
    """

    def __init__(self, folder, identity: dict[str, Any]):
        self.folder = Path(folder)
        self.identity = json.loads(json.dumps(identity))

    def save(self, step: int, tree: Any) -> None:
        """Save the tree of ``step``; it and the checkpoint before it remain. Raises WorkError."""
        _write(self._path(step), tree, {"step": int(step), "identity": self.identity})
        before = [old for old in self._steps() if old < step]
        # Later steps are damaged ones that were passed over; a kill leaves hidden folders.
        unused = [self._path(s) for s in self._steps() if s != step and s not in before[-1:]]
        for path in [*unused, *self.folder.glob(".step_*")]:
            shutil.rmtree(path, ignore_errors=True)

    def latest(self) -> tuple[int, Any] | None:
        """Load the newest undamaged checkpoint as (step, tree), or None.

        Arrays come back as NumPy's, bit for bit as they were saved. A damaged checkpoint is passed
        over with a warning. Raises InputError where the checkpoint is of another training.
        """
        for step in reversed(self._steps()):
            path = self._path(step)
            try:
                tree, record = _read(path)
            except Damaged as error:
                warnings.warn(f"{error}: the checkpoint before it is used", stacklevel=2)
                continue
            identity = record.get("identity", {})
            keys = {**identity, **self.identity}
            other = [k for k in keys if identity.get(k) != self.identity.get(k)]
            if other:
                raise InputError(f"{path}: belongs to another training ({', '.join(other)} differ)")
            return step, tree
        return None

    def _path(self, step: int) -> Path:
        return self.folder / f"step_{step:012d}"

    def _steps(self) -> list[int]:
        return sorted(int(p.name[5:]) for p in self.folder.glob("step_*") if p.name[5:].isdigit())


class Damaged(InputError):
    """Error of a folder that is incomplete or has changed since it was saved."""


def _write(folder: Path, tree: Any, record: dict[str, Any]) -> None:
    named, _ = jax.tree_util.tree_flatten_with_path(tree)
    leaves, stored = [], {}
    for number, (path, leaf) in enumerate(named):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        entry, array = _describe(name, leaf)
        leaves.append(entry)
        # The number keeps apart names that are equal once other characters are gone.
        if array is not None and array.size:
            entry["key"] = f"{number:04d}.{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
            stored[entry["key"]] = array
    structure = _structure(tree, iter(range(len(leaves))))
    record = {"format": _FORMAT, **record, "leaves": leaves, "structure": structure}
    text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
    with outputs.atomic_folder(folder) as new:
        if stored:
            np.savez(new / _ARRAYS[_FORMAT], allow_pickle=False, **stored)
        (new / _JSON).write_text(text, encoding="utf-8")
        files = (f for f in sorted(new.rglob("*")) if f.is_file())
        whole = ((f, hashlib.sha256(f.read_bytes()).hexdigest()) for f in files)
        sums = [f"{digest}  {file.relative_to(new).as_posix()}\n" for file, digest in whole]
        (new / _SUMS).write_text("".join(sums), encoding="utf-8")


def _read(folder: Path) -> tuple[Any, dict[str, Any]]:
    """Read the tree, with NumPy leaves, and the content of ``model.json``; verify both."""
    with outputs.failures_as_work_errors(folder):
        outputs.restore_interrupted(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if not (folder / _JSON).is_file():
        raise Damaged(f"{folder}: holds no {_JSON}")
    try:
        version = json.loads((folder / _JSON).read_bytes())["format"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Damaged(f"{folder}: {_JSON} is damaged or unreadable ({error})") from error
    if version not in _ARRAYS:
        other = f"{folder}: has format {version!r}, this release reads formats 2 and 3"
        try:
            _verify_files(folder)
        except Damaged as error:
            raise Damaged(f"{other}; or damaged: {error}") from error
        raise InputError(other)
    _verify_files(folder)
    record = json.loads((folder / _JSON).read_bytes())
    try:
        any_stored = any("key" in entry for entry in record["leaves"])
        stored = _stored(folder / _ARRAYS[version]) if any_stored else {}
        leaves = [_restored(folder, entry, stored) for entry in record["leaves"]]
        return _rebuild(record["structure"], leaves), record
    except InputError:
        raise
    except Exception as error:
        raise Damaged(f"{folder}: cannot be restored ({str(error)[:200]})") from error


def _stored(path: Path) -> dict[str, Any]:
    """Arrays by key, of an ``.npz`` or of a folder of Orbax's."""
    if path.suffix != ".npz":
        return _orbax().restore(path.absolute())
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


def _orbax():
    import orbax.checkpoint as ocp  # takes half a second

    if jax.process_count() == 1:
        return ocp.PyTreeCheckpointer()
    # Else it would wait for all processes of a job, which know nothing of this folder.
    own = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=alone)
    return ocp.Checkpointer(handler, multiprocessing_options=alone)


def _verify_files(folder: Path) -> None:
    """Verify that every file listed in SHA256SUMS is there and unchanged. Raises Damaged.

    Files that are not listed are ignored."""
    try:
        listed = (folder / _SUMS).read_text(encoding="utf-8").splitlines()
        sums = {name: digest for digest, name in (line.split("  ", 1) for line in listed)}
    except (OSError, ValueError) as error:
        raise Damaged(f"{folder}: {_SUMS} is missing or damaged") from error
    if _JSON not in sums:
        raise Damaged(f"{folder}: {_SUMS} does not list {_JSON}")
    for name, digest in sums.items():
        try:
            content = (folder / name).read_bytes()
        except (OSError, ValueError) as error:
            raise Damaged(f"{folder}: {name} is missing or unreadable") from error
        if hashlib.sha256(content).hexdigest() != digest:
            raise Damaged(f"{folder}: {name} has changed since it was saved (digest differs)")


def _describe(name: str, leaf: Any) -> tuple[dict[str, Any], np.ndarray | None]:
    """Make the entry of a leaf in ``model.json``, and the array to store or None."""
    if isinstance(leaf, (bool, int, float)) and not isinstance(leaf, np.generic):
        return {"name": name, "kind": "number", "value": leaf}, None
    if not isinstance(leaf, (jax.Array, np.ndarray, np.generic)):
        raise TypeError(f"{name}: a leaf must be an array or a number, got {type(leaf).__name__}")
    array = np.ascontiguousarray(leaf).reshape(np.shape(leaf))  # raises TypeError for a random key
    if array.dtype.kind not in "fiubc":
        raise TypeError(f"{name}: a leaf must hold numbers, got dtype {array.dtype}")
    return {
        "name": name,
        "kind": "numpy",
        "shape": list(array.shape),
        "dtype": str(array.dtype),
        "sha256": hashlib.sha256(array.tobytes()).hexdigest(),
    }, array


def _restored(folder: Path, entry: dict[str, Any], stored: dict[str, Any]) -> Any:
    name = entry["name"]
    if entry["kind"] == "number":
        return entry["value"]
    shape, dtype = tuple(entry["shape"]), np.dtype(entry["dtype"])
    array = np.asarray(stored[entry["key"]]) if "key" in entry else np.empty(shape, dtype)
    if array.shape != shape or array.dtype != dtype:
        raise Damaged(
            f"{folder}: {name} should be {dtype} of shape {shape}, found {array.dtype} of shape "
            f"{array.shape}"
        )
    if hashlib.sha256(array.tobytes()).hexdigest() != entry["sha256"]:
        raise Damaged(f"{folder}: {name} has changed since it was saved (digest differs)")
    return array


def _structure(tree: Any, numbers) -> Any:
    """Write the tree as JSON, each leaf as its number. Raises TypeError for other nodes."""
    if tree is None:
        return None
    if type(tree) is dict and all(type(key) is str for key in tree):
        return {"dict": {key: _structure(tree[key], numbers) for key in sorted(tree)}}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [_structure(item, numbers) for item in tree]}
    if not jax.tree_util.all_leaves([tree]):
        raise TypeError(f"expected dicts by text, lists and tuples, got a {type(tree).__name__}")
    return next(numbers)


def _rebuild(structure: Any, leaves: list[Any]) -> Any:
    if structure is None or isinstance(structure, int):
        return None if structure is None else leaves[structure]
    ((kind, content),) = structure.items()
    if kind == "dict":
        return {key: _rebuild(item, leaves) for key, item in content.items()}
    items = [_rebuild(item, leaves) for item in content]
    return tuple(items) if kind == "tuple" else items


class KeptFactors:
    """Store of pairs of factors by name, in ``folder/factors``. A damaged one counts as missing."""

    def __init__(self, folder):
        self.folder = Path(folder) / "factors"

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """Load the arrays that were saved under this name; None where there are none."""
        try:
            with np.load(self._path(name), allow_pickle=False) as stored:
                return dict(stored)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None

    def save(self, name: str, **arrays) -> None:
        """Save these arrays under this name. Raises WorkError."""
        with outputs.atomic_file(self._path(name)) as stream:
            np.savez(stream, **arrays)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.npz"
