"""Names of the structures of many degrees of freedom, as a user writes them. JAX is not loaded."""

import re

STRUCTURES = ("ring", "chain", "bodies:N", "ring:FIELDS", "chain:FIELDS", "bodies:N:SPECIES")
EXPECTED = f"a structure among {', '.join(STRUCTURES)}"
_SITES, _BODIES = r"(ring|chain)(:[1-9][0-9]?)?", r"bodies:0*([2-9]|[1-9][0-9]+)(:[A-Za-z]+)?"


def is_structure(text: str) -> bool:
    """Return whether this is the name of a structure."""
    return bool(re.fullmatch(f"{_SITES}|{_BODIES}", text))
