"""Files of measuring instruments: LabVIEW measurement files (.lvm), Renishaw laser files (.rtl)."""

from __future__ import annotations

import re

from tvsbayes.errors import refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.table import Row, Rows

_UNITS = {"LINEAR": ("mm", "mm"), "ANGULAR": ("deg", "arcsec")}
"""Units of targets and deviations by file type (Renishaw, LaserXL file formats)."""


def labview_rows(text: str, file: str) -> Rows | None:
    """Rows below the last header of a LabVIEW measurement file (NI, "LabVIEW Measurement File specification")."""
    if not text.startswith("LabVIEW Measurement"):
        return None
    lines = text.splitlines()
    header = {key: value for key, _, value in (line.partition("\t") for line in lines[:40])}
    separator = {"Tab": "\t", "Comma": ","}.get(header.get("Separator", "Tab").strip(), header.get("Separator", "\t"))
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")]
    if len(ends) < 2:
        remedy = "export it as text with one header, or as CSV"
        raise refusal("csv", file=file, found="no names below a second header", allowed="a .lvm file", remedy=remedy)
    rows = []
    for number, line in enumerate(lines[ends[-1] + 1 :], start=ends[-1] + 2):
        cells = [cell.strip() for cell in line.split(separator)]
        if any(cells):
            rows.append(Row(number, cells))
    labels = next((line.split(separator) for line in lines[ends[-2] :] if line.startswith("Y_Unit_Label")), [])
    for k, label in enumerate(labels[1:], start=1):
        if rows and label.strip() and k < len(rows[0].cells) and "(" not in rows[0].cells[k]:
            rows[0].cells[k] += f" ({label.strip()})"
    date = " ".join(header.get(key, "").strip() for key in ("Date", "Time"))
    return Rows(rows, ["LabVIEW measurement file", *([f"begun {date.strip()}"] if date.strip() else [])])


def renishaw_rows(text: str, file: str) -> Rows | None:
    """Targets and positions of a Renishaw laser file, in the order of its runs."""
    if not text.startswith("HEADER::") or "DEVIATIONS::" not in text:
        return None
    kind = re.search(r"Filetype:\s*(\w+)", text)
    targets = re.search(r"Targets\s*:\s*((?:[-+.\d eE]+\s*\n)+)", text.replace("\r", ""))
    units = _UNITS.get(kind[1].upper() if kind else "")
    if units is None or targets is None:
        found = f"a file of {kind[1] if kind else 'an unnamed type'}"
        raise refusal("kind", file=file, found=found, allowed="linear or angular targets", remedy="export it as CSV")
    target = targets[1].split()
    lines = text.splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("DEVIATIONS::"))
    scale = 1.0 if units[0] == units[1] else 1 / 3600
    rows = [Row(begin + 1, [f"target ({units[0]})", f"measured ({units[0]})", "cycle"])]
    for number, line in enumerate(lines[begin + 1 :], start=begin + 2):
        if line.rstrip().endswith("::"):
            break
        cells = line.split()
        if len(cells) != 3 or not all(map(NUMBER.fullmatch, cells)):
            continue
        run, point, deviation = cells
        if not (point.isdigit() and 1 <= int(point) <= len(target)):
            allowed, remedy = f"a target from 1 to {len(target)}", "correct the number"
            raise refusal("cell", file=file, line=number, found=f"target {point}", allowed=allowed, remedy=remedy)
        at = float(target[int(point) - 1])
        rows.append(Row(number, [target[int(point) - 1], repr(round(at + scale * float(deviation), 12)), run]))
    return Rows(rows, ["Renishaw laser file: measured = target + deviation, runs in the order of the file"])
