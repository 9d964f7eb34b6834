"""Recordings with known mistakes, and clean ones: what `gfnn look` says of them.

    python benchmarks/recordings_mistakes.py            45 files with a mistake, 40 without

Every file is generated (recordings/generated.py): six systems, 1 to 5 runs, noise, jitter, gaps. A
mistake is named where its own line is among those that are said; a clean file has a false alarm
where anything is said at all. The seeds are ones that no threshold was chosen on.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from harness import TABLES, Numbers, between_markers, main, markdown, number, results
from recordings.generated import MISTAKES, Sheet, sheet

import gfnn_jax as gfnn

FIRST = 5_000  # seed
OF_EACH, CLEAN = 3, 40


def said(wanted: Sheet, has_runs: bool = True) -> list[tuple[str, str]]:
    """(kind, line) of each fault that is found in the file of a sheet, or of its refusal."""
    with tempfile.TemporaryDirectory() as folder:
        path = wanted.written(Path(folder) / "recording.csv", with_runs=has_runs)
        try:
            summary = gfnn.read(path).summary()
        except gfnn.InputError as error:
            return [("refused", str(error).removeprefix(str(path)))]
    return [(fault.kind, str(fault)) for fault in summary.faults]


def mistakes(quick: bool) -> Numbers:
    """Of each mistake how many files name it, and what else is said."""
    started, found = time.process_time(), {}
    for name, (kinds, make) in MISTAKES.items():
        seeds = range(FIRST, FIRST + (1 if quick else OF_EACH))
        lines = [said(*make(seed)) for seed in seeds]
        named = [any(k in kinds or any(w in text for w in kinds) for k, text in of) for of in lines]
        found[name] = {
            "files": len(lines),
            "named": sum(named),
            "beside": sorted({k for of in lines for k, _ in of} - {*kinds, "refused"}),
            "line": next((of[0][1] for of in lines if of), None),
        }
    return {"of": found, "processor_seconds": time.process_time() - started}


def clean(quick: bool) -> Numbers:
    """Clean files of which something is said."""
    started = time.process_time()
    count = 6 if quick else CLEAN
    alarms = {seed: of for seed in range(FIRST, FIRST + count) if (of := said(sheet(seed)))}
    seconds = time.process_time() - started
    return {"files": count, "alarms": alarms, "processor_seconds": seconds}


PIECES = {"mistakes": mistakes, "clean": clean}


def tables() -> None:
    """The table of RESULTS.md."""
    found = {name: result["measured"] for name, result in results(PIECES, "recordings").items()}
    rows = [
        [name, f"{of['named']} of {of['files']}", ", ".join(of["beside"]) or "–"]
        for name, of in found["mistakes"]["of"].items()
    ]
    seconds = sum(of["processor_seconds"] for of in found.values())
    files = found["clean"]["files"] + sum(of["files"] for of in found["mistakes"]["of"].values())
    text = markdown(("mistake", "named", "said beside it"), rows)
    text += (
        f"\n\nFalse alarms: {len(found['clean']['alarms'])} of {found['clean']['files']} clean "
        f"files; {number(seconds / files)} CPU seconds a file, generating it included."
    )
    between_markers(TABLES, "recordings", text)


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "recordings", tables, None)
