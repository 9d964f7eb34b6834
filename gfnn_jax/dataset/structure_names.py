"""Names of structures of many degrees of freedom, as a user writes them. JAX is not loaded."""

import re

STRUCTURES = (
    *("poisson", "ring", "chain", "bodies:N"),
    *("ring:FIELDS", "chain:FIELDS", "bodies:N:SPECIES"),
)
EXPECTED = f"a structure among {', '.join(STRUCTURES)} (one alone)"
_SITES, _BODIES = r"(ring|chain)(:[1-9][0-9]?)?", r"bodies:0*([2-9]|[1-9][0-9]+)(:[A-Za-z]+)?"


def names_structure(text: object) -> bool:
    """Return whether this is the name of a structure."""
    return isinstance(text, str) and bool(re.fullmatch(f"poisson|{_SITES}|{_BODIES}", text))
