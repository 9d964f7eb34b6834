"""Names of the structures of many degrees of freedom, which the command line reads without JAX."""

STRUCTURES = ("ring", "chain", "bodies:N", "ring:FIELDS", "chain:FIELDS", "bodies:N:SPECIES")
EXPECTED = f"a structure among {', '.join(STRUCTURES)}"
