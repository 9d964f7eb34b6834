"""The textbook of laws behind noise: which structures come out, and whether their errors are true.

    python benchmarks/textbook_noise.py                 every law that has no result yet
    python benchmarks/textbook_noise.py --only kepler   one of them
    python benchmarks/textbook_noise.py --quick         three of them, into runs/

See `textbook.py`, which has the laws and the measurement.
"""

from harness import main
from textbook import NOISY, QUICK, noisy_tables

if __name__ == "__main__":
    main(__doc__ or "", NOISY, "textbook-noise", noisy_tables, None, QUICK[:3])
