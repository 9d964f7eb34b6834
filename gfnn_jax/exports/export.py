"""Function ``gfnn.export``: a map for programs that know nothing of this package."""

import io
import json
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export as exporting

from gfnn_jax.errors import InputError
from gfnn_jax.exports import SUFFIXES
from gfnn_jax.exports.c_source import c_source
from gfnn_jax.exports.casadi_function import casadi_function
from gfnn_jax.exports.fmu import fmu
from gfnn_jax.exports.graph import graph_of
from gfnn_jax.exports.javascript import javascript
from gfnn_jax.exports.jax_source import jax_source
from gfnn_jax.exports.robots import mjcf, urdf
from gfnn_jax.maps import saved
from gfnn_jax.maps.piece import FLOWS
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.phase_space import require_x64
from gfnn_jax.storage.outputs import atomic_write, ensure_new


def _c_of_law(map_: SymplecticMap, name: str, about: Mapping[str, Any]) -> str:
    """Write the C of a map that is the flow of a law. Raises InputError for another."""
    graph_of(map_)
    return c_source(map_, name, about)


Printer = Callable[[SymplecticMap, str, Mapping[str, Any]], str | bytes]
_PRINTERS: dict[str, Printer] = {"c": c_source, "c-taylor": _c_of_law, "js": javascript}
_PRINTERS |= {"jax": jax_source, "casadi": casadi_function, "fmu": fmu, "mjcf": mjcf, "urdf": urdf}
_KEYWORDS_OF_C = re.compile(
    r"auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for"
    r"|goto|if|inline|int|long|register|restrict|return|short|signed|sizeof|static|struct"
    r"|switch|typedef|union|unsigned|void|volatile|while"
)


def export(
    map_: SymplecticMap | str | Path,
    to: str,
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
) -> Path:
    """Write a map as one file, and return its path.

    map_: a map, or the folder of a saved one, whose record then goes into the file.
    to:   a format, of docs/export.md:
          "c": a C99 file with ``int NAME_step(const double z[2d], double Z[2d])`` and
          ``NAME_inverse``, NAME that of the file; for float64 maps whose functions are polynomials,
          Fourier harmonics or formulas. The flow of a law is a Taylor series to roundoff, with
          events of dry friction.
          "c-taylor": the same of a law alone.
          "js": a law as JavaScript, "jax": as a plain JAX function, "casadi": as a CasADi function,
          "fmu": as an FMU of FMI 3.0, all with inputs and coefficients as arguments.
          "mjcf", "urdf": an arm, or a law that is a planar chain of links, for robotics.
          "latex": the law of a fit as a formula.
          "stablehlo": step and inverse of batches of any size, for ``jax.export.deserialize``; for
          any map.
    out:  the file; with None a file beside the folder, of its name.

    Raises InputError, in one line, where the file exists (unless ``overwrite``) or the map cannot
    be exported in this form, WorkError where writing fails.
    """
    if to not in SUFFIXES:
        raise InputError(f"expected one of {', '.join(SUFFIXES)} to export to, got '{to}'")
    law: Any = getattr(map_, "law", None)
    if to == "latex" and law is None:
        raise InputError("a formula is that of a fit with a law: gfnn.export(gfnn.load(...), …)")
    map_ = getattr(map_, "map", map_)  # a fit
    folder = None if isinstance(map_, SymplecticMap) else Path(map_)
    if out is None and folder is None:
        raise InputError("expected a file to write (out=...): a map in memory has no folder")
    out = Path(out) if out is not None else default_out(Path(folder or ""), to)
    if out.suffix != SUFFIXES[to]:
        raise InputError(f"{out}: is written as {SUFFIXES[to]}, got the suffix '{out.suffix}'")
    ensure_new(out, overwrite)
    if to == "latex":
        if hasattr(law, "lagrangian"):
            text = f"L = {law.lagrangian.latex()}\n"
            text += f"R = {law.friction.latex()}\n" if law.friction.terms else ""
        else:
            text = f"H = {law.latex()}\n"
        atomic_write(out, text)
        return out
    map_ = map_ if isinstance(map_, SymplecticMap) else saved.load(map_)
    about = _about(folder)
    of_law = isinstance(map_.pieces[0], FLOWS)
    if to in _PRINTERS and map_.bracket is not None and (to not in ("c", "c-taylor") or not of_law):
        raise InputError(
            f"this map has a bracket of its own, {map_.bracket.name}, of which --to {to} makes no "
            "step: use --to stablehlo"
            + ", --to c-taylor or, for the formula of its law, --to latex"
            * of_law
        )
    if to in _PRINTERS:
        name = out.stem
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) or _KEYWORDS_OF_C.fullmatch(name):
            raise InputError(
                f"{out}: expected a name of letters, digits and _: functions are named so"
            )
        atomic_write(out, _PRINTERS[to](map_, name, about))
    else:
        known = {"dim": map_.dim, "dt": float(np.asarray(map_.dt))}
        names = map_.parameters.names if map_.parameters is not None else ()
        atomic_write(out, stablehlo(map_, {**known, "parameters": list(names), **about}))
    return out


def default_out(folder: Path, to: str) -> Path:
    """Path of the file beside a model's folder, of the folder's name."""
    folder = folder.absolute()
    return folder.with_name(folder.name + SUFFIXES[to])


def _about(folder: Path | None) -> dict[str, Any]:
    """Origin and accuracy of a map, by name, from the record of its folder."""
    about: dict[str, Any] = {"written by": f"gfnn_jax {saved.versions()['gfnn_jax']}"}
    if folder is None:
        return about
    about["model"] = f"{folder.name}, SHA-256 {saved.digest(folder)}"
    record = saved.record(folder)
    fit = record.get("fit")
    relative = not isinstance(fit, Mapping) or fit.get("tolerance_is_relative", True)
    unit = "relative to each coordinate's spread" if relative else "in the data's units"
    for part, key, title in (
        ("data", "source", "data"),
        ("data", "units", "units"),
        ("fit", "tolerance", f"tolerance asked for, {unit}"),
        ("fit", "validation_relative", "one-step error of held-out pairs, relative"),
        ("fit", "validation_rms", "one-step error of held-out pairs, in the data's units"),
    ):
        inside = record.get(part)
        if isinstance(inside, Mapping) and inside.get(key) not in (None, {}):
            about[title] = inside[key]
    return about


PLATFORMS = ("cpu", "cuda")


def stablehlo(map_: SymplecticMap, about: dict[str, Any]) -> bytes:
    """Make the zip archive of a map as StableHLO, by ``jax.export``, which needs nothing of this
    package.

    ``jax.export.deserialize`` reads ``step.jax`` and ``inverse.jax``: functions of states (B, 2d),
    for any B, and of the parameters' values (B, k) where the map has some, which return images
    (B, 2d) and statuses (B,). ``about.json`` holds ``about``, JSON-able, the map's description.
    """
    dtype = np.dtype(map_.scale.dtype)
    if dtype == np.float64:
        require_x64("a float64 map")
    (batch,) = exporting.symbolic_shape("b")
    shapes = [(batch, map_.width)]
    if map_.parameters is not None:
        shapes.append((batch, len(map_.parameters.names)))
    given = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, function in (("step", map_.step), ("inverse", map_.inverse)):

            def applied(z, *args, function=function):
                image, info = function(z, *args)
                return image, info.status

            exported = exporting.export(jax.jit(applied), platforms=PLATFORMS)(*given)
            archive.writestr(f"{name}.jax", bytes(exported.serialize()))
        archive.writestr("about.json", json.dumps(about, indent=1))
    return packed.getvalue()
