"""Arms: rigid bodies on joints of known kinematics, their inertias and friction from a log."""
