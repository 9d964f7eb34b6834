"""Fits on disk: the folder of a map (`maps.saved`), with the law, the verdict and the report.

What was found is a tree of registered types, as a map is. The data are not in the folder, nor what
only the search needed; the kinds of friction that are seen are computed before.
"""

import dataclasses
from typing import Any

from gfnn_jax.learn.fitted import Choice, Fit
from gfnn_jax.maps import saved as maps
from gfnn_jax.maps.symplectic_map import SymplecticMap
from gfnn_jax.models.arms.learned_arm import LearnedArm
from gfnn_jax.models.lagrangians.learned_law import LearnedLaw
from gfnn_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class WithoutMap:
    """Findings of the class ``kind`` as fields, without the map, which a folder holds once."""

    kind: str
    fields: dict[str, Any]

    def of(self, map_: SymplecticMap) -> LearnedLaw | LearnedArm:
        """The findings with their map."""
        kind = LearnedArm if self.kind == LearnedArm.__name__ else LearnedLaw
        return kind(map=map_, **self.fields)


_KNOWN = """
    candidates.assemble.Candidate dataset.measured_error.Tolerance
    diagnosis.damping.LearnedDamping diagnosis.local_jacobians.ChartDeterminant
    diagnosis.symmetries.SymmetryOfPairs exports.symbolic.Formula families.text.Term
    fitting.evidence.Rival fitting.triangle.Triangle learn.fitted.Choice learn.fitted.OfPositions
    learn.saved.WithoutMap models.arms.identify.BaseParameters models.arms.identify.Columns
    models.arms.identify.Identified models.arms.identify.Prior
    models.hamiltonians.fitted_law.Dropped models.hamiltonians.fitted_law.PartialLaw
    models.hamiltonians.learned_law.LearnedHamiltonian models.lagrangians.calibration.Horizon
    models.lagrangians.friction_choice.WhichFriction models.lagrangians.learned_law.Hamiltonian
    models.lagrangians.learned_law.NextMotion models.lagrangians.residuals.OfInput
    models.lagrangians.residuals.Whiteness models.lagrangians.velocities.Velocity
"""
maps.know(_KNOWN)


def save(
    fit: Fit,
    folder,
    *,
    scene: Scene | None = None,
    record: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Save a fit as a model folder. record: its report with whatever is worth keeping beside;
    None: the report, without what takes long to compute. The rest as of `maps.saved.save`."""
    record = _record(fit) if record is None else record
    beside = {"verdict": fit.verdict, "found": _portable(fit.found)}
    maps.save(fit.map, folder, scene=scene, record=record, overwrite=overwrite, beside=beside)


def _record(fit: Fit) -> dict[str, Any]:
    """The report, without what takes long to compute and is not known; {} of a map alone."""
    known = "symplecticity_defect" in fit.__dict__
    if isinstance(fit.found, Choice) and not known:
        fit = fit.replaced(defect_known=False)
    return {} if fit.found is None and "record" not in fit.stored else fit.report()


def state_of(fit: Fit) -> dict[str, Any]:
    """Fields of the fit as a folder would give it back, for pickles."""
    stored = {"verdict": fit.verdict, "record": fit.stored.get("record") or _record(fit)}
    stored = {name: value for name, value in stored.items() if value}
    found = _portable(fit.found)
    if isinstance(found, WithoutMap):
        found = found.of(fit.map)
    return {"map": fit.map, "found": found, "stored": stored}


def load(folder, scene: Scene | None = None) -> Fit:
    """Load the fit of a model folder: its map predicts the same bits as the saved one, and its law,
    verdict, table and messages are those of the fit.

    A folder that holds a map alone, as one of `SymplecticMap.save` or of release 0.3, gives a fit
    with no more than that. scene: the scene that the map was learned in, where it is not one of the
    package's own.

    Raises InputError, in one line, where the folder is damaged, of a newer format, or needs a scene
    that was not given.
    """
    map_, beside = maps.load_beside(folder, scene)
    found = beside.get("found")
    if isinstance(found, Choice):
        found = dataclasses.replace(found, scene=scene)
    elif found is not None:
        found = found.of(map_)
    kept = {name: beside[name] for name in ("verdict", "record") if beside.get(name)}
    return Fit(map_, found, kept)


def _portable(found: Choice | LearnedLaw | LearnedArm | None) -> Any:
    """Strip what was found of the data, the map and the functions that compute from the data."""
    if found is None:
        return None
    if not isinstance(found, Choice):
        fields = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
        del fields["map"]
        own = {"traces": ()} if "traces" in fields else {}
        return WithoutMap(type(found).__name__, fields | own)
    law = found.hamiltonian
    if law is not None:
        bare = dataclasses.replace(law.candidate, map=None)
        law = dataclasses.replace(law, candidate=bare, covariance=None, kinds=law.which_friction)
        law = law if maps.can_be_saved(law) else None  # a user's functions of z cannot
    of_data = ("pairs", "validation_pairs", "test_pairs", "scene", "budget")
    return dataclasses.replace(found, hamiltonian=law, **dict.fromkeys(of_data))
