"""Text of any file: its encoding, its compression, its sheets, the tables that programs frame.

A workbook is read as the text of its largest sheet, an archive as its only table, an ephemeris as
the rows between its marks. Lines that are none of the table are blank, so that the numbers of lines
stay those of the file.
"""

import dataclasses
import gzip
import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TextIO

from gfnn_jax.data.blocks import damage
from gfnn_jax.errors import InputError

WORKBOOKS = (".xlsx", ".xlsm", ".xls", ".ods")
_HORIZONS = "$$SOE", "$$EOE"
_OEM = "CCSDS_OEM_VERS"
_OEM_NAMES = "EPOCH X[km] Y[km] Z[km] X_DOT[km/s] Y_DOT[km/s] Z_DOT[km/s] X_DDOT Y_DDOT Z_DDOT"
# One state of an ephemeris that is written in several lines: 2458398.5 = A.D. 2018 …, X = 1 Y = 2.
_EPOCH = re.compile(r"^\s*([\d.]+) = ")
_LABELLED = re.compile(r"([A-Z]+) *= *([-+]?[\d.]+(?:E[-+]?\d+)?)")
# Encodings of instruments beside UTF-8, tried before all others.
_ENCODINGS = ["utf_16", "utf_16_le", "utf_16_be", "cp1252"]


_SNIFFED = 1 << 20  # bytes of a file's begin that tell its encoding


@dataclasses.dataclass(frozen=True)
class Text:
    """Text of a file: ``open`` gives it from its begin; notes: what was chosen of the file."""

    open: Callable[[], TextIO]
    notes: tuple[str, ...] = ()


def text_of(path: Path) -> Text:
    """Text of a file. Raises InputError where it holds none, or needs a reader that is absent."""
    suffix = path.suffix.lower()
    with damage(path, "the file"):
        if suffix in WORKBOOKS:
            return _of_sheets(path)
        opened, notes = _opener(path, suffix)
        with opened() as stream:
            head = stream.read(_SNIFFED)
    encoding = _encoding(path, head)

    def text() -> Any:  # a TextIO, which io.TextIOWrapper is not at run time
        return io.TextIOWrapper(opened(), encoding, errors="strict")

    begin = head.decode(encoding, "ignore")
    if _HORIZONS[0] in begin or begin.lstrip().startswith(_OEM):
        with text() as stream:
            lines = stream.read().split("\n")
        lines = _between_marks(lines) if _HORIZONS[0] in begin else _of_oem(lines)
        framed = "\n".join(lines)
        return Text(lambda: io.StringIO(framed), notes)
    return Text(text, notes)


def _opener(path: Path, suffix: str) -> tuple[Callable[[], BinaryIO], tuple[str, ...]]:
    """The function that opens the bytes, and notes.

    Raises InputError where an archive has not one table."""
    if suffix == ".gz":
        return (lambda: gzip.open(path, "rb")), ()  # type: ignore[return-value]
    if suffix != ".zip":
        return (lambda: open(path, "rb")), ()
    with zipfile.ZipFile(path) as archive:
        tables = [n for n in archive.namelist() if n.lower().endswith((".csv", ".txt", ".dat"))]
    found = [name for name in tables if "/" not in name] or tables  # phyphox: meta/device.csv
    if len(found) != 1:
        shown = ", ".join(found[:8]) or "no text"
        raise InputError(f"{path}: expected one table in the archive, found {shown}. Unpack one")
    notes = (f"the table is {found[0]} of the archive",)
    return (lambda: zipfile.ZipFile(path).open(found[0])), notes  # type: ignore[return-value]


def _encoding(path: Path, head: bytes) -> str:
    """The encoding of bytes. Raises InputError where they are no text."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        head[: -4 if len(head) == _SNIFFED else None].decode("utf-8")
    except UnicodeDecodeError as error:
        import charset_normalizer  # loaded when first needed

        part = head[: 1 << 16]
        best = charset_normalizer.from_bytes(part, cp_isolation=_ENCODINGS).best()
        best = best or charset_normalizer.from_bytes(part).best()
        if best is None:
            raise InputError(f"{path}: header cannot be read: damaged? ({error})"[:300]) from None
        return best.encoding
    return "utf-8-sig" if b"\0" not in head[:1000] else "utf-16-le"


def _of_sheets(path: Path) -> Text:
    """The sheet of a workbook that has most cells, tabs between them."""
    import pandas as pd

    try:
        sheets = pd.read_excel(path, sheet_name=None, header=None, engine="calamine")
    except ImportError:
        raise InputError(f"{path}: needs python-calamine: pip install 'gfnn_jax[files]'") from None
    name = max(sheets, key=lambda name: int(sheets[name].notna().to_numpy().sum()))
    text = sheets[name].to_csv(index=False, header=False, sep="\t")
    notes = (f"the table is the sheet {name}, of {', '.join(sheets)}",) if len(sheets) > 1 else ()
    return Text(lambda: io.StringIO(text), notes)


def _between_marks(lines: list[str]) -> list[str]:
    """Lines of an ephemeris between its marks, and the line of names above them."""
    stripped = [line.strip() for line in lines]
    begin = stripped.index(_HORIZONS[0])
    end = stripped.index(_HORIZONS[1]) if _HORIZONS[1] in stripped else len(lines)
    kept = ["" for _ in lines]
    if not any(map(_EPOCH.match, lines[begin:end])):
        names = next((k for k in range(begin - 1, -1, -1) if "," in lines[k]), begin)
        kept[begin + 1 : end] = lines[begin + 1 : end]
        kept[names] = lines[names]
        return kept
    row, names = begin, ["JDTDB"]  # a state takes several lines
    for k in range(begin + 1, end):
        if epoch := _EPOCH.match(lines[k]):
            row, kept[k] = k, epoch[1]
        for name, value in _LABELLED.findall(lines[k]):
            kept[row] += f",{value}"
            names.append(name)
    kept[begin] = ",".join(dict.fromkeys(names))
    return kept


def _of_oem(lines: list[str]) -> list[str]:
    """States of an orbit ephemeris message below their names; segments begin anew in time."""
    kept, in_data = ["" for _ in lines], False
    for k, line in enumerate(lines):
        word = line.strip().split(" ")[0]
        if word in ("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP"):
            in_data = word == "META_STOP"
        elif in_data and word[:1].isdigit():
            kept[k] = line
    width = max((len(line.split()) for line in kept), default=0)
    kept[0] = " ".join(_OEM_NAMES.split()[:width])
    return kept
