"""Exports of other programs, made anew in their dialects with numbers of our own, and read.

    python benchmarks/exports_of_others.py            a few seconds
    python benchmarks/exports_of_others.py --quick    into runs/

Each file is read by `gfnn.read` without an option; where that is refused, with the option that the
message names. It counts as read where times and values agree with what was written to the digits of
the file. Workbooks need openpyxl, odfpy and xlwt to be written, python-calamine to be read.
"""

from __future__ import annotations

import dataclasses
import gzip
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from harness import TABLES, Numbers, between_markers, main, markdown, provenance
from harness import results as results_of
from scipy.io import savemat

import gfnn_jax as gfnn
from gfnn_jax.errors import InputError

Columns = Mapping[str, np.ndarray]
T = 0.02 * np.arange(240)
SWING = 0.7 * np.exp(-0.1 * T) * np.cos(4.4 * T)
RATE = np.gradient(SWING, T)
DAY = 86_400.0


@dataclasses.dataclass(frozen=True)
class Export:
    """A kind of file: ``write`` puts it into a folder and returns its path.

    runs: what is in it, times in the unit of `gfnn_jax.Recording.times` from the first on, and
    columns. digits: absolute error of the values that are written. options: of `gfnn_jax.read`,
    needed where the first try is refused, whose message must name each.
    """

    write: Callable[[Path], Path]
    runs: tuple[tuple[np.ndarray, Columns], ...]
    digits: float = 1e-9
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def rows(*columns, form: str = "%.6f", separator: str = ",", decimal: str = ".") -> str:
    table = zip(*columns, strict=True)
    lines = ([form % x if isinstance(x, float) else str(x) for x in row] for row in table)
    return "".join(separator.join(line).replace(".", decimal) + "\n" for line in lines)


def clock(form: str, begin: str, step: float = 0.02) -> list[str]:
    """Moments in words."""
    moments = pd.Timestamp(begin) + pd.to_timedelta(round(1e9 * step) * np.arange(len(T)), "ns")
    return [m.strftime(form) for m in moments]


def text(name: str, content: str, encoding: str = "utf-8") -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content.encode(encoding))
        return folder / name

    return write


def packed(name: str, content: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        with gzip.open(folder / name, "wt") as stream:
            stream.write(content)
        return folder / name

    return write


def archive(folder: Path) -> Path:
    """An experiment of phyphox, zipped, with its files about the device."""
    with zipfile.ZipFile(folder / "swing.zip", "w") as found:
        head = '"Time (s)","Position (m)"\n'
        found.writestr("Raw Data.csv", head + rows(T, SWING, form="%.9E"))
        found.writestr("meta/device.csv", '"property","value"\n"version","1.1.11"\n')
        found.writestr("meta/time.csv", '"event","experiment time"\n"START",0.0\n')
    return folder / "swing.zip"


def workbook(name: str, engine: str, frame: pd.DataFrame, sheet: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        about = pd.DataFrame({"property": ["version", "build"], "value": ["1.1.11", "1011104"]})
        with pd.ExcelWriter(folder / name, engine=engine) as book:  # type: ignore[arg-type]
            about.to_excel(book, sheet_name="Metadata", index=False)
            frame.to_excel(book, sheet_name=sheet, index=False)
        return folder / name

    return write


def old_workbook(folder: Path) -> Path:
    """A workbook of Excel 97, as phyphox writes it."""
    import xlwt  # only for this kind

    book = xlwt.Workbook()
    sheet = book.add_sheet("Raw Data")
    for k, (name, column) in enumerate((("Time (s)", T), ("Position (m)", SWING))):
        sheet.write(0, k, name)
        for i, x in enumerate(column):
            sheet.write(i + 1, k, float(x))
    book.add_sheet("Metadata Device").write(0, 0, "property")
    book.save(str(folder / "swing.xls"))
    return folder / "swing.xls"


def matlab(folder: Path) -> Path:
    table = {"t": T[:, None], "theta": SWING, "omega": RATE[None]}
    savemat(folder / "swing.mat", {"data": table, "Ts": 0.02, "comment": "second try"})
    return folder / "swing.mat"


def side_by_side() -> Export:
    """PASCO Capstone: runs of different length beside each other."""
    lengths, amplitudes = (200, 140, 240), (1.0, 0.6, 1.5)
    head = ";".join(f'"Time (s) Run #{k}";"Angle, Ch 1 (rad) Run #{k}"' for k in (1, 2, 3))
    cells = pd.DataFrame(
        {
            (k, name): pd.Series(column[:n])
            for k, (n, a) in enumerate(zip(lengths, amplitudes, strict=True))
            for name, column in (("t", T), ("x", a * SWING))
        }
    )
    body = cells.to_csv(sep=";", decimal=",", index=False, header=False, float_format="%.6f")
    runs = tuple(
        (T[:n], {"Angle, Ch 1": a * SWING[:n]}) for n, a in zip(lengths, amplitudes, strict=True)
    )
    return Export(text("runs.csv", f"{head}\n{body}", "utf-8-sig"), runs, 1e-6)


def orbit() -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (240, 3) along an ellipse, in two units."""
    phase = np.linspace(0, 9, len(T))
    rate = 9 / (len(T) - 1)
    x = np.stack([np.cos(phase), 0.8 * np.sin(phase), 0.1 * np.sin(phase)], 1)
    v = rate * np.stack([-np.sin(phase), 0.8 * np.cos(phase), 0.1 * np.cos(phase)], 1)
    return x, v


def horizons(csv: bool) -> Export:
    x, v = orbit()
    stars, dates = 79 * "*", clock("A.D. %Y-%b-%d %H:%M:%S.0000", "2018-10-07", DAY)
    table = []
    for k, date in enumerate(dates):
        numbers = [f"{value: .15E}" for value in (*x[k], *v[k])]
        if csv:
            table.append(f"{2458398.5 + k:.9f}, {date}, {', '.join(numbers)},")
            continue
        named = [f"{n}={value}" for n, value in zip(("X", "Y", "Z"), numbers, strict=False)]
        speeds = [f"{n}={value}" for n, value in zip(("VX", "VY", "VZ"), numbers[3:], strict=True)]
        table += [f"{2458398.5 + k:.9f} = {date} TDB ", f" {' '.join(named)}"]
        table += [f" {' '.join(speeds)}"]
    head = f"{stars}\nTarget body name: TEST (1)\nOutput units    : AU-D\n{stars}\n"
    names = (
        "            JDTDB,            Calendar Date (TDB), X, Y, Z, VX, VY, VZ,\n" if csv else ""
    )
    content = f"{head}{names}{stars}\n$$SOE\n" + "\n".join(table) + f"\n$$EOE\n{stars}\n"
    columns: Columns = dict(
        zip(["X", "Y", "Z", "VX", "VY", "VZ"], np.hstack([x, v]).T, strict=True)
    )
    days = np.arange(len(T)) * 1.0
    return Export(text("horizons.txt", content + " Reference frame : ICRF\n"), ((days, columns),))


def oem() -> Export:
    x, v = orbit()
    x, v = 7000 * x, 7000 * v / 60
    lines = (
        f"{m} {' '.join(f'{value:.9f}' for value in (*x[k], *v[k]))}"
        for k, m in enumerate(clock("%Y-%m-%dT%H:%M:%S.%f", "2019-12-18 12:00:00.331", 60.0))
    )
    head = (
        "CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 1996-11-04T17:22:31\nORIGINATOR = TEST\n\n"
        "META_START\nOBJECT_NAME = TEST\nCENTER_NAME = EARTH\nREF_FRAME = ICRF\nTIME_SYSTEM = UTC\n"
        "START_TIME = 2019-12-18T12:00:00.331\nMETA_STOP\nCOMMENT own numbers\n\n"
    )
    covariance = "\n\nCOVARIANCE_START\nEPOCH = 2019-12-28T21:29:07\n3.3e-04\nCOVARIANCE_STOP\n"
    names = ["X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"]
    columns: Columns = dict(zip(names, np.hstack([x, v]).T, strict=True))
    content = head + "\n".join(lines) + covariance
    return Export(text("orbit.oem", content), ((60.0 * np.arange(len(T)), columns),), 1e-9)


def exports() -> dict[str, Export]:
    """The kinds of files by name."""
    swing = ((T, {"Winkel": SWING}),)
    remarks = ["Start" if k == 0 else "" for k in range(len(T))]
    scope = T * 1e-4
    preamble = (
        "waveform,V_S,V_C\nt0,5/7/2021  09:33:31.638054,5/7/2021  09:33:31.638054\n"
        "delta t,2.000000E-6,2.000000E-6\n\ntime,V_S,V_C\n"
    )
    logger = (
        '"TOA5","CR1000","CR1000","E3812","CR1000.Std.32","CPU:swing.CR1","7511","Raw","x"\n'
        '"TIMESTAMP","RECORD","x"\n"TS","RN","mm"\n"","","Smp"\n'
    )
    tracker = "\tmass_A\t\tmass_B\t\nt\tx\ty\tx\ty\n"
    two = {"x1": SWING, "y1": RATE, "x2": 2 * SWING, "y2": 0.5 * RATE}
    hobo = '"Plot Title: swing"\n"#","Date","Time","Height (cm)"\n'
    moments = pd.Timestamp("2024-02-29 23:59:58") + pd.to_timedelta(T, "s")
    years = 1900 + np.arange(len(T))
    return {
        "German Excel, cp1252, ° and remarks": Export(
            text(
                "swing.csv",
                "Zeit t [s];Winkel [°];Bemerkung\n"
                + rows(T, np.degrees(SWING), remarks, separator=";", decimal=","),
                "cp1252",
            ),
            swing,
            1e-6,
        ),
        "Unicode text, UTF-16": Export(
            text("swing.txt", "temps\tx\n" + rows(T, SWING, separator="\t", decimal=","), "utf-16"),
            ((T, {"x": SWING}),),
            1e-6,
        ),
        "oscilloscope, preamble, m/d/yyyy with µs": Export(
            text(
                "scope.csv",
                preamble
                + rows(
                    clock("%-m/%-d/%Y  %H:%M:%S.%f", "2021-05-07 09:33:31.638054", 2e-6),
                    np.full(len(T), 5.0),
                    SWING,
                ),
            ),
            ((scope, {"V_C": SWING}),),
            1e-6,
        ),
        "data logger TOA5": Export(
            text(
                "logger.dat",
                logger
                + rows(
                    clock('"%Y-%m-%d %H:%M:%S.%f"', "2021-12-31 23:59:59"),
                    list(range(len(T))),
                    SWING,
                ),
            ),
            ((T, {"x": SWING}),),
            1e-6,
        ),
        "data logger, date and time of day apart": Export(
            text(
                "hobo.csv",
                hobo
                + rows(
                    list(range(1, len(T) + 1)),
                    clock("%m/%d/%y", "2024-02-29 23:59:58"),
                    clock("%H:%M:%S.%f", "2024-02-29 23:59:58"),
                    SWING,
                ),
            ),
            ((T, {"Height": SWING}),),
            1e-6,
        ),
        "Horizons, table": horizons(csv=True),
        "Horizons, labelled": horizons(csv=False),
        "CCSDS orbit ephemeris message": oem(),
        "Tracker, two masses": Export(
            text("tracker.txt", tracker + rows(T, *two.values(), form="%.9E", separator="\t")),
            ((T, two),),
            1e-8,
        ),
        "phyphox, zip": Export(archive, ((T, {"Position": SWING}),), 1e-8),
        "phyphox, xls": Export(old_workbook, ((T, {"Position": SWING}),)),
        "PASCO, runs side by side": side_by_side(),
        "Excel, xlsx with dates": Export(
            workbook(
                "swing.xlsx", "openpyxl", pd.DataFrame({"Date": moments, "x (cm)": SWING}), "Data"
            ),
            ((T, {"x": SWING}),),
            1e-9,
        ),
        "LibreOffice, ods": Export(
            workbook("swing.ods", "odf", pd.DataFrame({"Zeit": T, "x": SWING}), "Blatt1"),
            ((T, {"x": SWING}),),
            1e-9,
        ),
        "MATLAB, a structure": Export(matlab, ((T, {"theta": SWING, "omega": RATE}),)),
        "compressed, comments": Export(
            packed("swing.csv.gz", "# own numbers\nt_ms,x\n" + rows(1e3 * T, SWING)),
            ((T, {"x": SWING}),),
            1e-6,
        ),
        "years": Export(
            text("hare.csv", "Year,Height (cm),Remark\n" + rows(list(years), SWING, remarks)),
            ((years - 1900.0, {"Height": SWING}),),
            1e-6,
        ),
        "no line of names": Export(
            text("bare.csv", rows(T, SWING)),
            ((T, {"x": SWING}),),
            1e-6,
            {"columns": ("t", "x")},
        ),
        "one column": Export(
            text("one.csv", "x\n" + rows(SWING)), ((T, {"x": SWING}),), 1e-6, {"dt": 0.02}
        ),
        "oscilloscope that counts its rows": Export(
            text(
                "counted.csv",
                "Model,DS1000Z\nX,CH1,CH2,Start,Increment\nSequence,Volt,Volt,-4.0e-01,2.0e-02\n"
                + "".join(f"{k},{x:.6f},{3.3 * (k > 9)},,\n" for k, x in enumerate(SWING)),
            ),
            ((T, {"CH1": SWING}),),
            1e-6,
            {"dt": 0.02},
        ),
        "a name of time of its own": Export(
            text("own.csv", "lap [s],x\n" + rows(T, SWING)),
            ((T, {"x": SWING}),),
            1e-6,
            {"time": "lap"},
        ),
    }


def case(export: Export, folder: Path) -> Numbers:
    """How a file is read: the option that was needed, and the largest errors."""
    path = export.write(folder)
    options: dict[str, Any] = {}
    refused = ""
    try:
        found = gfnn.read(path)
    except InputError as error:
        refused, options = str(error), dict(export.options)
        if not options or not all(f"{name}=" in refused for name in options):
            return {"read": False, "refused": refused}
        found = gfnn.read(path, **options)
    times, values = [], []
    for run, (t, columns) in zip(found.runs, export.runs, strict=True):
        times.append(float(np.max(np.abs(found.times(run) - found.times(run)[0] - t))))
        for name, x in columns.items():
            values.append(float(np.max(np.abs(found.values(name, run) - x))))
    step = float(np.median(np.diff(export.runs[0][0])))
    good = max(times) < 1e-3 * step and max(values) <= export.digits
    return {
        "read": good,
        "options": list(options),
        "notes": list(found.notes),
        "time_error": max(times),
        "value_error": max(values),
    }


def measure(quick: bool) -> Numbers:
    del quick
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, export in exports().items():
            found[name] = case(export, Path(folder))
            print(f"  {name}: {found[name]}", flush=True)
    return {"cases": found, "read": sum(one["read"] for one in found.values())}


PIECES = {"files": measure}


def tables() -> None:
    """The table of RESULTS.md."""
    found = results_of(PIECES, "exports_of_others")
    if not found:
        return
    cases = found["files"]["measured"]["cases"]
    lines = [
        [
            name,
            "yes" if one["read"] else "no",
            ", ".join(f"`--{o}`" for o in one.get("options", ())) or "none",
            "; ".join(one.get("notes", ())).replace("|", "/") or "–",
        ]
        for name, one in cases.items()
    ]
    heads = ("export", "read", "option named by the message", "what reading says")
    total = f"{found['files']['measured']['read']} of {len(cases)} are read."
    table = f"{markdown(heads, lines)}\n\n{total} {provenance(found)}"
    between_markers(TABLES, "exports_of_others", table)


if __name__ == "__main__":
    main(__doc__ or "", PIECES, "exports_of_others", tables, None)
