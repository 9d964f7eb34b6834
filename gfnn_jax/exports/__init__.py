"""Printers of maps and laws for other programs; the formats, with the suffixes of their files."""

SUFFIXES = {"c": ".c", "c-taylor": ".c", "js": ".js", "jax": ".py", "casadi": ".casadi"}
SUFFIXES |= {"fmu": ".fmu", "mjcf": ".xml", "urdf": ".urdf", "latex": ".tex", "stablehlo": ".zip"}
