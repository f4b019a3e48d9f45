"""Tables as people and programs keep them, a habit each: what `test_kept_tables.py` reads of them is frozen.

A key begins with the kind of table: "axis", "looks", "head", or "table" where the cells alone are of interest.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from importing.samples import lines

from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.table import ForeignTable


class Case(NamedTuple):
    """A table as a text or as cells, what its user states, and the number of moves that there are already."""

    content: str | ForeignTable
    wishes: Wishes
    listed: int | None = None


CASES: dict[str, Case] = {}


def add(key: str, content: str | ForeignTable, *, listed: int | None = None, **wishes: Any) -> None:
    assert key not in CASES, key
    CASES[key] = Case(content, Wishes(**wishes), listed)


def answered(key: str, content: str, *answers: dict[str, Any]) -> None:
    """A table that is asked about, and with each of the answers."""
    add(key, content)
    for answer in answers:
        add(f"{key}: {answer}", content, **answer)


def sheet(names: str, *columns: Iterable[object]) -> str:
    return "\n".join([names, *(",".join(map(str, row)) for row in zip(*columns, strict=True)), ""])


def cells(header: str, *rows: str) -> ForeignTable:
    """A table of one-word cells; - is an empty one."""
    columns = zip(*(["" if cell == "-" else cell for cell in row.split()] for row in rows), strict=True)
    return ForeignTable(
        "t.csv", "drawn", tuple(range(2, 2 + len(rows))), dict(zip(header.split(), columns, strict=True))
    )


def each(count: int, *words: object) -> list[object]:
    return [word for word in words for _ in range(count)]


def bad(good: object, other: object) -> list[object]:
    """A column of eleven rows of which two are not to be used."""
    return [other if row in (3, 7) else good for row in range(11)]


# --- an axis that goes up and down once: twelve readings, or eleven without the first of the way down -----------------
POS = [0, 10, 20, 30, 40, 50]
UP, DOWN = ([round(1.0002 * p - side, 4) for p in POS] for side in (0.02, -0.02))
ERR = [round(1000 * (v - p), 1) for p, v in zip(POS, UP, strict=True)]
CMD, READ = POS + POS[::-1], UP + DOWN[::-1]
PLACES = np.array([0.0, 10, 20, 30, 40, 50, 40, 30, 20, 10, 0])
FOUND = np.round(PLACES * 1.0002 - 0.02 * np.r_[np.ones(6), -np.ones(5)] + 0.003 * (np.arange(11) % 3), 4)
HEAD = "command (mm),reading (mm)"


def to_and_fro(form: str) -> str:
    return "".join(form.format(c=c, v=v, k=k) for k, (c, v) in enumerate(zip(CMD, READ, strict=True)))


for key, text in {
    "words and numbers": "TARGET {c} / ANGLE {v}\n",
    "words and numbers in turn": "SETPOINT {c}\nANGLE {v}\n",
    "levels": "INFO target={c} actual={v}\n",
    "a logger's lines": "2026-01-02 10:{k:02d}:00,123 - stage - INFO - target: {c}, actual: {v}\n",
    "a logger's names": "INFO:stage:target: {c} actual: {v}\n",
    "moves by their word": "MOVE {c} / ANGLE {v}\n",
    "semicolons in a serial monitor": "Step: {c}; Angle: {v} deg\n",
}.items():
    add(f"axis, {key}", to_and_fro(text))
for below in ("s;mm;mm", "TIME;LREAL;LREAL", "LREAL;LREAL;LREAL\nUnit;mm;mm"):
    add(f"axis, a controller's {below}", f"t;Axis.SetPos;Axis.ActPos\n{below}\n" + to_and_fro("{k};{c};{v}\n"))
for form in ("3/14/2026 1:{:02d}:00 PM", "14/3/2026 13:{:02d}", "3/4/2026 13:{:02d}", "17000000{:02d}000"):
    add(f"axis, at {form}", sheet("time,Pos (mm),Ist (mm)", [form.format(k) for k in range(12)], CMD, READ))
add("axis, inches in cells", "step;reading\n" + to_and_fro('{c};{v}"\n'))
add("axis, uncertainty of last digits", sheet("Pos (mm),Ist (mm)", CMD, [f"{v:.4f}(20)" for v in READ]))
add("axis, degrees and decimal minutes", "step\tangle\tdir\n" + lines("{c}\t{m}\t{word}\n"))
add("axis, no number at the end", "steps;mm;dir\n" + lines("{c};{v:.4f};{s}\n") + "0;NaN;-\n")
add("axis, the command again", "target,actual\n0,0\n1,1\n2,2\n")
add("axis, a doubted reading", sheet("Pos (mm),Ist (mm)", CMD, [f"{v}?" if v == READ[3] else v for v in READ]))
for name in ("2 sd (um)", "2s (\u00b5m)", "95% CI (\u00b1\u00b5m)"):
    add(f"axis, {name}", sheet(f"Pos (mm),Ist (mm),{name}", CMD, READ, each(12, 3)))
add("axis, u in each cell", sheet(HEAD, PLACES, [f"{v} \u00b1 0.004" for v in FOUND]))

# Sides.
for words in (
    each(6, "0", "1"),
    each(6, "1", "0"),
    each(6, "out", "in"),
    each(6, "hin", "her"),
    each(6, "andata", "ritorno"),
):
    add(f"axis, sides {words[0]} and {words[-1]}", sheet("Pos (mm),dir,Ist (mm)", CMD, words, READ))
BLOCKS = ["vor", *[""] * 5, "zur\u00fcck", *[""] * 5]
add(
    "axis, sides in the first row of a block",
    sheet("Pos (mm),dir,Ist (mm)", CMD, ["up", *[""] * 5, "down", *[""] * 5], READ),
)
add("axis, a block sorted upwards", sheet("Pos (mm),Richtung,Ist (mm)", POS * 2, BLOCKS, UP + DOWN))
add(
    "axis, the same after a homing",
    sheet("Pos (mm),approach,Ist (mm),segment", POS * 2, BLOCKS, UP + DOWN, each(6, "0", "1")),
)
add(
    "axis, words of nobody that follow the commands",
    sheet("vaihe,target (mm),measured (mm)", each(6, "edes", "taka"), CMD, READ),
)
for name, words in {
    "Anfahrt von": ("unten", "oben"),
    "approach from": "-+",
    "from": ("below", "above"),
    "dir": "+-",
}.items():
    paired = [v for pair in zip(UP, DOWN, strict=True) for v in pair]
    add(
        f"axis, {name} {words}",
        sheet(f"target (mm),{name},measured (mm)", [p for p in POS for _ in "ab"], [*words] * 6, paired),
    )
SIDED = [(c, "forward", f"{c + 0.1:.1f}") for c in range(6)]
SIDED += [(5, "backward", "5.1"), *((c, "backward", f"{c - 0.1:.1f}") for c in range(4, -1, -1))]
add("axis, a reading at standstill", sheet("target (mm),direction,measured (mm)", *zip(*SIDED, strict=True)))
for names in ("target,direction,measured (mm)", "target,cycle,measured (mm)", "target,measured (mm)"):
    four = [
        (t, w, n, f"{t + off + 0.001 * (k % 3):.4f}")
        for t in range(6)
        for w, n, off in (("forward", 1, -0.03), ("backward", 2, 0.03))
        for k in range(4)
    ]
    target, word, cycle, value = zip(*four, strict=True)
    chosen = {"direction": [word], "cycle": [cycle]}.get(names.split(",")[1], [])
    add(f"axis, two levels of a position by {names}", sheet(names, target, *chosen, value), units={"value": "mm"})

# Runs side by side, across, and between titles.
add("axis, one-way runs in groups", sheet("Pos (mm),Hin 1,Hin 2,Hin 3,Her 1,Her 2", POS, UP, UP, UP, DOWN, DOWN))
for names in ("Pos (mm),Wyjazd (mm),Powrot (mm)", "Cote (mm),A1,R1", "X (mm),moving left,moving right"):
    answered(f"axis, runs {names}", sheet(names, POS, UP, DOWN), {"order": "alternate"})
names = "Pos (mm),Wyj 1 (mm),Backward 1 (mm),Wyj 2 (mm),Backward 2 (mm)"
answered("axis, runs of which one word is known", sheet(names, POS, UP, DOWN, UP, DOWN), {"order": "alternate"})
for word in ("lost", "#REF!", "nan", "n/a", "---", "19.99*", "(19.99)"):
    names, runs = "Pos (mm),Forward 1,Backward 1,Forward 2", [UP, DOWN, [word if v == UP[2] else v for v in UP]]
    add(f"axis, {word} in a run", sheet(names, POS, *runs))
for names in ("vor Justage (mm),nach Justage (mm)", "As found (mm),As left (mm)", "left scale (mm),right scale (mm)"):
    add(f"axis, {names}", sheet(f"Pos (mm),{names}", PLACES, np.round(1.002 * PLACES, 3), FOUND))
RUN = to_and_fro("{c} {v}\n")
add(
    "axis, homings in remarks",
    f"# cmd(mm) read(mm)\n# --- home ---\n{RUN}# lamp off\n# --- home again ---\n{RUN}# 5 5.1\n",
)
halves = ["".join(RUN.splitlines(keepends=True)[part]) for part in (slice(6), slice(6, None))]
add("axis, directions in remarks", f"# run 1 up\n# pos_mm read_mm\n{halves[0]}# run 1 down\n{halves[1]}")
titled = ["Avant 1", "Cote (mm);Lecture (mm)", *(f"{t};{t + 0.25}" for t in range(5))]
titled += ["Arri\u00e8re 1", "Cote (mm);Lecture (mm)", *(f"{t};{t + 0.5}" for t in range(4, -1, -1))]
add("axis, titles of direction above dimensions", "\n".join(titled))
add("axis, titles of two machines", f"X axis\n{sheet(HEAD, CMD, READ)}Y axis\n{sheet(HEAD, CMD, READ)}")
add("axis, titles of two states", f"As found\n{sheet(HEAD, CMD, READ)}As left\n{sheet(HEAD, CMD, READ)}")
marks = [f"{k} | {1000 * k + 1} | {1000 * k + 2}|" for k in range(5)]
add(
    "axis, thousandths in Markdown",
    "\n".join(['Position [inch] | Run 1 [0.001"] | Run 2 [0.001"]|', ":---: | :---: | :---:|", *marks]),
    order="forward",
)

# Rows that are not to be used.
MARKS = {
    **dict.fromkeys(("Outlier?", "exclude", "Verworfen", "saturated", "failed"), ("no", "yes")),
    **dict.fromkeys(("rejected", "skip", "err", "Alarm"), ("", "x")),
    **{"fault_code": (0, 17), "Error code": ("", "E03"), "err flag": (0, 1), "errors": (0, 4)},
    **{"use": ("y", "n"), "OK?": ("\u2713", "\u2717"), "Valid": ("WAHR", "FALSCH"), "beam": ("ok", "lost")},
    **{"solved": ("True", "False"), "Bewertung": ("i.O.", "n.i.O.")},
}
for name, words in MARKS.items():
    add(f"axis, marked by {name}", sheet(f"{HEAD},{name}", PLACES, FOUND, bad(*words)))
add("axis, out of tolerance", sheet(f"{HEAD},Tolerance (um),Result", PLACES, FOUND, [25] * 11, bad("PASS", "FAIL")))
for word in ("wrong - see next row", "bad reading", "nicht verwenden", "\u00e0 ignorer", "discard"):
    remarks = ["lamp off" if k == 1 else word if k in (3, 7) else "" for k in range(11)]
    add(f"axis, remark {word}", sheet(f"{HEAD},remark", PLACES, FOUND, remarks))
for fill in ("-9999", "9.9E+37", "999.999", "0.000", "-1"):
    filled = sheet(HEAD, PLACES, [a or b for a, b in zip(bad("", fill), FOUND, strict=True)])
    answered(
        f"axis, {fill} for no reading", filled, {"no_reading": float(fill)}, {"columns": {"value": "reading (mm)"}}
    )
ways = [np.r_[[a] * 8, np.linspace(a, a + 10, 6)[1:-1]] for a in (0.0, 10.0, 20.0, 30.0)]
ramp = np.concatenate(ways)[:-4]
add("axis, ramps", sheet("setpoint (deg),encoder (deg)", ramp, ramp - 0.1))
add(
    "axis, repeated readings",
    sheet("target (mm),read (mm)", np.repeat(PLACES, 2), np.r_[0.01, np.repeat(FOUND, 2)[:-1]]),
)
pairs = [line for c, v in zip(PLACES, FOUND, strict=True) for line in (f"target: {c}", f"pos: {v}")]
add("axis, a lost line", "\n".join([*pairs[:5], *pairs[7:]]))
moving = [(1000, 994), *[(1000, 996)] * 9]
for at in range(1200, 2000, 200):
    moving += [(at, at - 170 + 40 * n) for n in range(4)] + [(at, at - 4 + (at == 1600) * (n % 3)) for n in range(9)]
add("axis, rows that still move", sheet("target pos,pos", *zip(*moving, strict=True)))
add("axis, a first row without a value", sheet("Ist (mm),Soll (mm)", ["#N/A", *READ], [-1, *CMD]))
STATES = {
    "state": "found left",
    "Zustand": "vorher nachher",
    "condition": "before after",
    "machine": "A B",
    "S/N": "20714 20715",
}
for name, words in (STATES | {"Spindel": "1 2", "Pr\u00fcfling": "a b"}).items():
    add(
        f"axis, rows of two by {name}",
        sheet(f"target (mm),reading (mm),{name}", CMD * 2, READ * 2, each(12, *words.split())),
    )
crossed = "".join(f"X,{c},{v}\nY,{c / 2},{v / 2:.4f}\n" for c, v in zip(CMD, READ, strict=True))
add("axis, rows of two axes", f"axis,target (mm),actual (mm)\n{crossed}")
add("axis, rows of one axis by name", f"axis,target (mm),actual (mm)\n{crossed}".replace("Y", "X"))

# Order, times, homings.
order = np.argsort(PLACES, kind="stable")
add("axis, order in a column", sheet(f"Order,{HEAD}", 1 + order, PLACES[order], FOUND[order]))
add("axis, newest first", sheet(f"time (s),{HEAD}", range(10, -1, -1), PLACES[::-1], FOUND[::-1]))
number = np.array([2, 0, 4, 1, 5, 3])
add("axis, numbers of positions", sheet(f"No.,{HEAD}", 1 + number, 10.0 * number, np.round(10.002 * number, 3)))
add("axis, Julian days", sheet(f"JD,{HEAD}", [f"{2461100.5 + k / 720:.8f}" for k in range(11)], PLACES, FOUND))
add(
    "axis, days of a spreadsheet",
    sheet(f"Time,{HEAD}", [f"{46085.5 + k / 1440:.8f}" for k in range(11)], PLACES, FOUND),
)
add("axis, a homing in a line", sheet(HEAD, PLACES, FOUND) + "HOME,\n" + sheet("", PLACES, FOUND).lstrip())
add(
    "axis, a homing in a note",
    sheet(f"{HEAD},note", PLACES, FOUND, ["homed again" if k == 4 else "" for k in range(11)]),
)
add("axis, homings with a sign", sheet("homing,target (mm),measured (mm)", each(12, "+1", "+2"), CMD * 2, READ * 2))
clock = 30.0 * np.arange(11)
warming = np.round(21.5 + 0.02 * np.arange(11), 2)
answered("axis, T of a thermometer", sheet(f"{HEAD},T", PLACES, FOUND, warming), {"columns": {"temperature_degC": "T"}})
add("axis, T of a clock", sheet(f"{HEAD},T", PLACES, FOUND, clock))
add("axis, a temperature called T", sheet("target_mm,laser_mm,T_scale_C", PLACES, FOUND, warming))

# Units.
answered(
    "axis, one unit behind a column's name",
    sheet('cmd (deg),read ("),check (")', CMD, [round(3600 * v, 1) for v in READ], [round(3240 * v, 1) for v in READ]),
    {"columns": {"value": 'read (")'}},
)
add("axis, a unit in a column", sheet("Target,Reading,Unit", PLACES, FOUND, ["mm"] * 11))
add(
    "axis, two units in columns",
    sheet("Target,Unit,Reading,Unit", PLACES, ["mm"] * 11, np.round(1000 * FOUND), ["um"] * 11),
)
scaled = zip(PLACES, FOUND, strict=True)
add(
    "axis, units that change with the row",
    "\n".join(f"cmd: {c:g} mm reading: " + (f"{v} mm" if c > 20 else f"{1000 * v:g} um") for c, v in scaled),
)
add("axis, one unit behind all names", "# x_cmd x_meas [mm]\n" + to_and_fro("{c} {v}\n") + "# break\n")
add(
    "axis, readings in um, positions in mm",
    "Messwerte in \u00b5m, Position in mm\n" + sheet("Position,Messwert", CMD, [1000 * v for v in READ]),
)
add(
    "axis, brackets above the names",
    "Position [mm] vs error [um], axis Z\n" + sheet("Pos,Err", POS, ERR),
    deviations=True,
)
said = "Units,mm\nTarget units,mm\nError units,\u00b5m\n\n" + sheet("Target,Run 1 (+),Run 1 (-)", POS, ERR, ERR)
add("axis, units of targets and errors", said, deviations=True)
above = "Einheit Position: mm,,Abweichung: \u00b5m\n,,\nPosition,1\u2191,1\u2193\n"
add(
    "axis, units by column above the names",
    above + sheet("", POS, ERR, [e + 40 for e in ERR]).lstrip(),
    deviations=True,
)
for said in (
    "Units: um deviations, positions in mm",
    "Deviations in um, positions in mm",
    "Positions [mm], mm deviations in um",
    "Position : mm, deviation : um",
):
    add(f"axis, {said}", f"{said}\n" + sheet("Target,Deviation", POS, ERR), deviations=True)
for name in ("reading [mm]", "angle_arcsec", "encoder", "Messwert [\u00b5m]", "reading [\u03bcm]", "encoder_nm"):
    add(f"axis, {name}", sheet(f"steps,{name}", [0, 20000, 40000, 20000, 0], [0, 10, 20, 10, 0]))
add("axis, gon beside degrees", sheet("Command (grad),Read (deg)", PLACES, 0.9 * PLACES + 0.01))
add("axis, a mil beside degrees", sheet("Command (deg),Read (mil)", PLACES, FOUND / 0.05625))
add("axis, a mil of an angle", sheet("steps,angle (mil)", CMD, READ))
add("axis, thousands of pulses", sheet("pulses,read (mm)", [f"{c:g}k" for c in PLACES], FOUND))
add("axis, minutes beside degrees", "steps,deg,min\n0,0,2.5\n500,1,1.0\n1000,2,3.5\n1500,3,2.0\n")
for names in ("Ist Grad,Ist Min", "Lecture degr\u00e9s,Lecture minutes"):
    add(f"axis, {names}", sheet(f"Soll (deg),{names}", PLACES, PLACES // 1, np.round(3 + 0.3 * (np.arange(11) % 3), 1)))
hours = [f"{int(c // 15):02d}:{int(c % 15 * 4):02d}:{1.3 * (k % 3):04.1f}" for k, c in enumerate(PLACES)]
add("axis, hours of right ascension", sheet("Target (deg),Read RA", PLACES, hours))
add("axis, hours that may be commands", sheet("Encoder (deg),RA", PLACES, hours))
add("axis, tenths beside inches", sheet("X (in),dial (tenths)", [0, 1, 2, 1, 0], [0, 1, 3, 4, 2]), deviations=True)
for separator, rows in (
    (";", ("1.250,00", "2.000,94", "3.000,94")),
    (",", ('"1,250.00"', '"2,000.94"', '"3,000.94"')),
    (";", ("1'250.00", "2'000.94", "3'000.94")),
):
    add(
        f"axis, thousands as in {rows[0]}",
        "\n".join([f"Soll (mm){separator}Ist (mm)", *(f"{r[: -3 - r.endswith(chr(34))]}{separator}{r}" for r in rows)]),
    )
for read in ("0.002 10,004 20,001 30.003", "0 10.000 20.010 30.000", "3 10,004 20,000 7"):
    add(
        f"axis, thousands or decimals in {read}",
        "\n".join(["target;read", *(f"{10 * k};{v}" for k, v in enumerate(read.split()))]),
    )
for name in ("dial (div 0.01mm)", "dial (1 div = 0.01 mm)", "dial (mm)"):
    parts = sheet(f"command (mm),{name}", PLACES, np.round(100 * FOUND, 2))
    answered(f"axis, a {name} of hundredths", parts, {"units": {"value": "0.01 mm"}}, {"units": {"value": "mm"}})
add("axis, a dial of hundredths beside steps", sheet("steps,dial (div 0.01mm)", 80 * PLACES, np.round(100 * FOUND, 2)))
for factor in (1.5, 25.4, 0.0125):
    add(f"axis, a ratio of {factor}", sheet(HEAD, PLACES, np.round(factor * FOUND, 5)))

# Commands and readings: which is which, positions or lengths or deviations, turns.
add("axis, a step that counts rows beside a goto", sheet("step,goto (mm),dial (mm)", range(1, 13), CMD, READ))
add(
    "axis, a step that counts rows beside positions", sheet("Step,Position (mm),Measured (mm)", range(1, 13), CMD, READ)
)
add("axis, a current position", sheet("SetpointPosition\tCurrentPosition", CMD, READ).replace(",", "\t"))
add("axis, MOV beside POS?", sheet("MOV 1,POS? 1,Interferometer", CMD, [c + 0.0002 for c in CMD], READ))
joints = "Joint 1 DEMAND\tJoint 1 FEEDBACK\tJoint 2 DEMAND\tJoint 2 FEEDBACK"
for unit in ("", " mm"):
    rows = [f"{c}{unit}\t{v}{unit}\t{c}{unit}\t{v}{unit}" for c, v in zip(CMD, READ, strict=True)]
    first = {"command": "Joint 1 DEMAND", "value": "Joint 1 FEEDBACK"}
    add(f"axis, one joint of two, unit{unit}", "\n".join([joints, *rows]), columns=first)
odd = [f"{v - c:.3f}" for c, v in zip(CMD, READ, strict=True)]
add(
    "axis, words of nobody beside a deviation",
    sheet("Fahrwunsch (mm);Winkel (mm);Abw (mm)", CMD, READ, odd).replace(",", ";"),
)
angles = [0.002 * c for c in CMD]
add(
    "axis, a deviation beside other readings",
    sheet("Position,Linear Error (um),Pitch (arcsec),Yaw (arcsec)", CMD, ERR + ERR[::-1], angles, angles),
)
hardly = [round(0.0098 * p + 0.2 * (k % 2), 2) for k, p in enumerate(POS)]
add("axis, readings that hardly follow", "Units: um\n\n" + sheet("Target (mm),Run 1 +,Run 1 -", POS, hardly, hardly))
for unit, scale in (("mil", 1.0), ("0.001 in", 1.0), ("in", 1e-3)):
    small = np.round(scale * (-2.8 * PLACES - 0.3 * np.r_[np.ones(6), -np.ones(5)]), 5)
    answered(
        f"axis, small readings in {unit}",
        sheet(f"command (in),reading [{unit}]", PLACES, small),
        {"deviations": True},
        {"deviations": False},
    )
apart = sheet("Soll (mm),Soll-Ist (um)", PLACES, np.round(1000 * (PLACES - FOUND), 1))
answered("axis, deviations of the other sign", apart, {"deviations": True, "deviation_sign": -1.0})
own = sheet("steps,angle_deg", np.abs(np.arange(-400, 500, 100)), np.round(0.018 * np.arange(-400, 500, 100), 3))
answered("axis, readings that go their own way", own, {"columns": {"command": "steps", "value": "angle_deg"}})
lengths = np.diff(PLACES)[:-1]
for names, columns in (
    (HEAD, [lengths, FOUND[1:-1]]),
    (f"{HEAD},segment", [np.tile(lengths, 2), np.tile(FOUND[1:-1], 2), each(9, 0, 1)]),
):
    answered(
        f"axis, lengths of moves, {names}",
        sheet(names, *columns),
        {"relative": True},
        {"columns": {"command": "command (mm)"}},
    )
add("axis, lengths by option", sheet("Move (mm),Reading (mm)", np.r_[0.0, np.diff(PLACES)], FOUND), relative=True)
for places in (np.tile([0.0, 10.0], 6), np.arange(1.0, 9.0)):
    add(f"axis, positions {places[:3]}", sheet(HEAD, places, np.round(places * 1.0002, 4)))
seam = np.array([330.0, 340, 350, 0, 10, 20, 10, 0, 350, 340, 330])
round_ = sheet("Command (deg),Encoder (deg)", seam, np.round((seam - 0.04) % 360, 2))
answered("axis, commands through the seam", round_, {"command_turn": 360.0}, {"command_turn": 0.0})
add("axis, a circle twice", sheet("Command (deg),Encoder (deg)", *[np.tile(np.arange(0.0, 360, 30), 2)] * 2))
turned = sheet(
    "rev,angle,encoder_deg", each(4, "0", "1", "2"), [0, 90, 180, 270] * 3, [a + 0.01 for a in (0, 90, 180, 270)] * 3
)
answered("axis, turns beside angles", turned, {"command_turn": 360.0})
dial = sheet("command (mm),dial (mm)", np.round(PLACES / 25, 3), np.round((PLACES / 25 + 0.285) % 1.0, 4))
answered("axis, a dial that goes round", dial, {"counts_per_turn": 1.0})
for unit in ("", " (deg)"):
    jump = [*(10 * c + 0.5 for c in range(8)), *(10 * c + 360.5 for c in range(6, -1, -1))]
    add(f"axis, a jump at the turn, unit{unit}", sheet(f"steps,reading{unit}", [*range(8), *range(6, -1, -1)], jump))

# --- a head ----------------------------------------------------------------------------------------------------------
PAN = np.array([-900, -400, 100, 600, 1100, 600, 100, -400])
AZ, EL, ZERO = np.round(10 + 0.06 * PAN, 3), np.full(8, 5.5), np.zeros(8, int)
SKY = "pan_steps,tilt_steps,az (deg),el (deg)"
add("head, zenith distances", sheet("pan_steps,tilt_steps,az (deg),zenith distance (deg)", PAN, ZERO, AZ, 90 - EL))
parts = [AZ % 360 // 1, np.round(AZ % 360 % 1 * 60, 4), EL // 1, EL % 1 * 60]
add("head, angles in parts", sheet("pan_steps,tilt_steps,az_d,az_m,el_d,el_m", PAN, ZERO, *parts))
lost = np.isin(np.arange(8), (2, 4))
add("head, directions of nothing", sheet(SKY, PAN, ZERO, np.where(lost, 0, AZ), np.where(lost, 0, EL)))
add("head, errors in place of directions", sheet('az cmd (deg),el cmd (deg),dAz ("),dEl (")', PAN / 10, EL, AZ, EL))
add("head, errors by name", sheet("pan_steps,tilt_steps,az_err_deg,el_err_deg", PAN, PAN, AZ / 100, EL / 100))
small = sheet("az cmd (deg),el cmd (deg),a,b", PAN / 10 + 0.001, EL, AZ / 1000, EL / 1000)
add("head, directions that hardly change", small, columns={"azimuth_deg": "a", "elevation_deg": "b"}, angle_unit="deg")
ticks = np.arange(3600, 5400, 120)
add(
    "head, counters that restart",
    sheet(SKY, ticks % 4096, 0 * ticks, np.round(ticks * 360 / 4096 % 360, 3), 0 * ticks + 5),
)
far = np.array([2150, -1100, 2350, -2400, 2900, -600, 550, 2050])
add("head, large moves", sheet(SKY, far, ZERO, np.round(0.05 * far % 360, 3), EL))
moved = np.r_[PAN[0], np.diff(PAN)]
answered("head, lengths of moves", sheet(SKY, moved, ZERO, AZ, EL), {"relative": True})
add("head, half steps", sheet(SKY, PAN / 8, ZERO, AZ, EL))
for name in ("T degC", "T_K", "T cam", "t_amb_C", "T"):
    add(f"head, warming {name}", sheet(f"{SKY},{name}", PAN, ZERO, AZ, EL, [f"{20 + 0.1 * k:.1f}" for k in range(8)]))
for name in ("azimuth (h)", "azimuth (mil)", "azimuth (mm)"):
    add(f"head, {name}", sheet(f"pan,tilt,{name},el (deg)", PAN, ZERO, np.round(0.5 + 0.0005 * PAN, 3), EL))
for word in ("converged", "failed"):
    add(f"head, status {word}", sheet(f"{SKY},status", PAN, ZERO, AZ, EL, [word] * 8))
STEPS = "pan_steps tilt_steps az el"
WAY = [(-9000, 100), (0, 2000), (9000, 4000), (25000, 6000), (41000, 8000)]
"""Of ratios 0.01 and 0.005 deg: the azimuth passes 360 deg on the way."""
for unit, scale, angle_unit in (("rad", np.pi / 180, "rad"), ("arcmin", 60.0, "arcmin"), ("deg", 1.0, "deg")):
    ways = [f"{p} {t} {scale * (0.01 * p + 90):.6f} {scale * 0.005 * t:.6f}" for p, t in WAY]
    add(f"head, no unit, {unit} by numbers", cells(STEPS, *ways))
    add(f"head, {unit} by option", cells(STEPS, *ways), angle_unit=angle_unit)
for first in ("95", "-"):
    add(
        f"head, elevation {first}", cells(STEPS, *(f"{p} {t} {k} {10 if k else first}" for k, (p, t) in enumerate(WAY)))
    )
sky = [
    f"{p} {t} {np.radians((0.01 * p + 20) % 360):.9f} {10 * k}:30:0 3 {'clouds' if k == 4 else 'ok'}"
    for k, (p, t) in enumerate(WAY)
]
add("head, radians, minutes, a refused row", cells("pan_count tilt_count az_rad el sd_(arcmin) status", *sky))
turns = ("-0.5 0.1 331 6", "0 0.2 0 11", "7 0.3 41 17")
add("head, encoders in radians", cells("enc_az_[rad] enc_el_[rad] az el", *turns), u_deg=0.002)

# --- looks -----------------------------------------------------------------------------------------------------------
FOUR = "Pan Tilt XL YL XR YR"
SEEN = ("0 0 641 361 501 360 near", "0 0 651 361 561 360 far", "200 0 701 361 571 360 far", "200 30 1 361 2 360 far")
add("looks, after one move", cells(f"{FOUR} Sheet", *SEEN), approach=("left", "up"))
other = (
    "0 0 641 2 3 4 1.5 1000 1 1",
    "200 0 1 2 3 4 - 2500 1 0",
    "-150 5 1 2 3 4 0.5 4000 1 1",
    "10 0 5 6 7 8 0 5000 2 1",
)
notations = cells(f"{FOUR} B_rad t_ms home valid", *other)
add("looks, notations of others", notations, pixels_from=1, relative=True)
add("looks, degrees by option", cells(f"{FOUR} B_rad", "0 0 1 1 1 1 1.5"), angle_unit="deg")
for name in ("t_h", "t_us", "t_min", "t_s"):
    add(f"looks, {name}", cells(f"Pan Tilt {name}", "0 0 2", "5 0 4"))
for unit, turn in {"mrad": 6283.185, "arcmin": 21600, "arcsec": 1296000}.items():
    add(f"looks, aperture in {unit}", cells(f"{FOUR} B_{unit}", f"0 0 1 2 3 4 {turn / 4}"))
for homed in ("1 0 0 0", "0 1 0 1", "1 - - 1", "true false false true", "0 0 1 1", "1 1 2 3"):
    add(f"looks, homings {homed}", cells("Pan Tilt home", *(f"{10 * k} 0 {m}" for k, m in enumerate(homed.split()))))
add("looks, no spread without a spot", cells(f"{FOUR} std_XL valid", "0 0 1 2 3 4 0.2 1", "5 0 0 0 0 0 0 0"))
add("looks, rows without pixels", cells(FOUR, "0 0 1 2 3 4", "50 0 - - - -", "20 0 1 2 3 4"))
dated = ("0 0 1 2 3 4 0.3 2026-01-02T03:04:05", "9 0 1 2 3 4 0.4 2026-01-02T03:05:07")
add("looks, dates and spreads", cells(f"{FOUR} std_XL time", *dated))
numbered = f"{FOUR} Spot Exp Point"
add("looks, numbers missing or twice", cells(numbered, "0 0 1 1 1 1 7 3 1", "0 0 1 1 1 1 7 3 -", "0 0 1 1 1 1 8 - 2"))
add("looks, a move without a number", cells(numbered, "0 0 1 1 1 1 7 3 1", "50 0 - - - - - - -", "0 0 1 1 1 1 9 3 2"))
add("looks, points without experiments", cells(f"{FOUR} Point", *(f"{10 * k} 0 1 1 1 1 {k}" for k in range(1, 9))))
add("looks, of moves by number", cells("XL YL XR YR move", "1 2 3 4 2", "5 6 - - 0"), listed=3)
add("looks, of moves in order", cells("XL YL XR YR", *["1 2 3 4"] * 3), listed=3)
for order in ("0 1 2 3", "1 2 3 4", "0 1 3 4", "0 a - 3"):
    add(
        f"looks, moves numbered {order}",
        cells("Nr Pan Tilt", *(f"{n} {100 * k} 0" for k, n in enumerate(order.split()))),
    )
add("looks, moves numbered beside pixels", cells(f"Nr {FOUR}", *(f"{k + 1} {100 * k} 0 1 2 3 4" for k in range(4))))
for header, rows in {
    "Pan Tilt": ("0.5 0",),
    "Tilt Pan": ("x 0",),
    "Pan Tilt t": ("0 0 5", "1 0 4"),
    "Pan Tilt time": ("0 0 yesterday",),
    "Pan Tilt move": ("0 0 3", "5 0 3"),
    "Pan Tilt pan_approach": ("0 0 up",),
    f"{FOUR} status": ("0 0 1 2 3 - ok",),
    f"{FOUR} exp pt": ("0 0 1 2 3 4 1 0",),
    f"{FOUR} pt exp": ("0 0 1 2 3 4 1 -1",),
    f"{FOUR} spot": ("0 0 1 2 3 4 -1",),
    f"{FOUR} B": ("0 0 1 2 3 4 500",),
    f"{FOUR} std_XL": ("0 0 1 2 3 4 0",),
    f"std_XL {FOUR}": ("- 0 0 1 2 3 4",),
    **{"Pan": ("1",), "XL": ("1",)},
}.items():
    add(f"looks, refused {header}", cells(header, *rows))
for header, row in {"XL YL XR YR": "1 2 3 4", "XL YL XR YR move": "1 2 3 4 7", "YL": "1", "remark": "1"}.items():
    add(f"looks, refused of two moves {header}", cells(header, row), listed=2)
two = cells("pan_pos pan_goal tilt", "0 1 2")
for columns in ({}, {"pan_steps": "pan_goal"}, {"tilt_steps": ""}, {"pan": "tilt"}, {"pan_steps": "Pan"}):
    add(f"looks, two columns of pan, {columns}", two, columns=columns)
add("looks, a reference in each row", cells("Pan Tilt Reference", "0 0 17", "1 0 18", "2 0 25", "3 0 31"))
BOOKED = (
    "2025-07-24T09:00:00 - - - 0 0 - -",
    "2025-07-24T09:01:00 1 P1 d1 10 0 left/exp01_P1_L.png -",
    "2025-07-24T09:01:30 exp01 P2 d2 0 0 left/exp01_P2_L.png -",
    "2025-07-24T09:02:00 1 3 d2 200 0 left/exp01_P3_L.png shiny",
    "2025-07-24T09:02:30 1 4 d1 0 0 - -",
    "2025-07-24T09:03:00 - - - -200 0 - back",
)
book = cells("Time Experiment Point Plane Pan Tilt Picture Remark", *BOOKED)
add("looks, a lab book", book, relative=True, pictures=True)
merged = ("0 0 7 P1 17.5", "0 0 - P2 27.5", "200 0 - P3 27.5", "200 0 - P4 17.5", "0 0 - - -", "5 0 - P1 17.5")
add("looks, merged cells and distances", cells("Pan Tilt Exp Point Distance_cm", *merged))
ways = [-60, 0, 60, 0] * 2
for distances in (each(4, 17.5, 27.5), [17.5, 27.5] * 4, [17.5 + k for k in range(8)]):
    # Each in one run is a placement; put back to a distance is another one; a distance of every look is none.
    px = [[centre + way for way in ways] if k % 2 == 0 else [360] * 8 for k, centre in enumerate((640, 0, 500, 0))]
    table = sheet("Pan,Tilt,XL,YL,XR,YR,Abstand [cm]", ways, [0] * 8, *px, distances)
    answered(f"looks, at {distances} cm", table, {"columns": {"target": ""}})
add("looks, that wait for pictures", cells("Pan Tilt Exp Pt File State", "0 0 1 1 a.png ok", "0 0 1 2 b.png bad"))
for pictures in (False, True):
    add(f"looks, names of pictures, {pictures}", cells("Pan Tilt File", "0 0 a.png", "5 0 -"), pictures=pictures)
for names, day in (("Date Time", "24.07.2025 09:00:01"), ("Uhrzeit Datum", "09:00:01 2025-07-24")):
    add(f"looks, {names}", cells(f"{names} Pan Tilt", f"{day} 0 0", f"{day.replace(':01', ':31')} 5 0"))
for time in ("2025-07-24T09:00:00Z", "09:00:00", "20250724", "12.5"):
    add(f"looks, the day of {time}", cells("Pan Tilt time", f"0 0 {time}"))
apart = [f"{e},P{p},{200 * (p == 3)},0" for e in (1, 2, 3) for p in (1, 2, 3, 4)]
add("looks, lengths in a book", "\n".join(["Experiment,Point,Pan,Tilt", *apart]))
N = range(0, 900, 100)
PX = [[300.5 + 10 * k + 7 * column for k in range(9)] for column in range(4)]
for names, scale in {
    "xL_mm,yL_mm,xR_mm,yR_mm": 0.01,
    "xL,yL,xR,yR": 0.001,
    "xL_rect,yL_rect,xR_rect,yR_rect": 1,
    "x left,y left (from bottom),x right,y right": 1,
}.items():
    add(f"looks, {names} by {scale}", sheet(f"pan,tilt,{names}", N, [0] * 9, *(np.round(scale * np.array(PX), 5))))
pair = [f"({300 + k}.5 {200 + k}.25)" for k in range(9)]
add("looks, pairs in cells", sheet("pan,tilt,left,right", N, [0] * 9, pair, pair))
add("looks, unnamed pixels", sheet("pan,tilt,cx0,cy0,cx1,cy1", N, [0] * 9, *PX))
add("looks, cameras counted from 0", sheet("pan,tilt,cam0_x,cam0_y,cam1_x,cam1_y", N, [0] * 9, *PX))
add("looks, angles for counters", sheet("pan_deg,tilt_deg,xl,yl,xr,yr", range(0, 54, 6), [0] * 9, *PX))
add("looks, merged sheets", sheet("pan,tilt,sheet,xl,yl,xr,yr", N, [0] * 9, ["near", *[""] * 4, "far", *[""] * 3], *PX))
answered(
    "looks, lengths of moves",
    sheet("pan,tilt,xl,yl,xr,yr", moved, [0] * 8, *(np.array(PX)[:, :8] - 0.7 * PAN)),
    {"relative": True},
)
both = [[0 if row == miss else 1 for row in range(9)] for miss in (3, 7)]
add("looks, valid in both cameras", sheet("pan,tilt,xl,yl,xr,yr,valid_l,valid_r", N, [0] * 9, *PX, *both))
for fill in (-1, 0, 65535):
    holes = [[fill if k in (3, 7) else x for k, x in enumerate(column)] for column in PX]
    add(f"looks, {fill} for no spot", sheet("pan,tilt,xl,yl,xr,yr", N, [0] * 9, *holes))
for names in ("pan,tilt,u,v", "pan,tilt,x,y"):
    add(f"looks, {names} of no camera", sheet(names, [0, 100], [0, 0], [600, 800], [400, 400]))
block = to_and_fro("{c} 0 6{c} 400\n")
add("looks, a block for each camera", f"# left camera\n# pan tilt x y\n{block}# right camera\n{block}")


def a_row_a_camera(names: str, order: str, targets: str = "near far") -> list[str]:
    target, left = targets.split(" "), order.split(" ")[0]
    rows = [
        (100 * k, target[k % 2], camera, 600 + 30 * (camera == left)) for k in range(4) for camera in order.split(" ")
    ]
    with_target = "target" in names
    return [names, *(f"{p},0,{f'{t},' * with_target}{camera},{u + p},{400 + p}" for p, t, camera, u in rows)]


for names in ("pan,tilt,camera,u,v", "pan,tilt,cam,x_px,y_px", "pan,tilt,Kamera,Spalte,Zeile"):
    for order in ("left right", "R L"):
        add(f"looks, {names} of {order}", "\n".join(a_row_a_camera(names, order)))
add("looks, a row of a camera is missing", "\n".join(a_row_a_camera("pan,tilt,camera,u,v", "left right")[:-1]))
for order in ("left right", "L R", "0 1", "1 2", "cam0 cam1"):
    for targets in ("T1 T2", "R-Leo L-Pup"):
        add(f"looks, {targets} beside {order}", "\n".join(a_row_a_camera("pan,tilt,target,camera,u,v", order, targets)))

# --- cells alone -----------------------------------------------------------------------------------------------------
for key, text in {
    "thousands and decimal commas": "x;y\n1.024,50;a\n2,25;b\n",
    "thousands with commas": "x;y\n1,024.50;a\n",
    "mixed decimals": "x;y\n1,5;a\n1.5;b\n",
    "remarks, empty lines, no names": "sep=;\n# bench 3\n\n1;2,5\n3;4,5\n;\n",
    "blanks between cells": " x  y\n 1  2\n",
    "a name twice and none": "x,x,\n1,2,3\n",
    "commas in numbers": "t,day,n,v\n" + "0,d1,5,7\n" * 3 + "# later\n0,5,d1,5,7,25\n",
    "blanks in dates": "time n v\n" + "2026-01-02 10:00 5 7\n" * 20,
    "separators in cells": "n;v\n" + "1;2\n" * 20 + "1;2;a;b\n",
    "separators in cells below a remark": "# unit deg\nn;v\n0;0,1\n1;0,7;5\n2;1,3\n",
    "separators at the ends": "n;v\n" + "1;2;;\n" * 5,
    "remarks in few rows": "bench 3\n\nn;v;remark\n" + "1;2;\n" * 9 + "3;;not seen\n",
    **{
        f"{k} lines above": above + "n;v;w\n" + "1;2,5;3\n" * (4 + k)
        for k, above in {1: "bench 3\n", 3: "Serial;117\n\nOperator: A. B.\n", 30: "a\n" * 30}.items()
    },
    "a serial monitor": "boot\nStep: 0, Angle: 1.5\nStep: 200, Angle: 2.5\n",
    "a serial monitor with tabs": "Step=0\tAngle=1.5\nStep=9\tAngle=-2\n",
    "a serial monitor in turns": "Target: 0\nRead: 1.5 deg\nTarget: 5\nTarget: 9\nRead: 2 deg\n",
    "a serial monitor past midnight": "23:59:59.500 -> n: 1 v: 2\n00:00:01.000 -> n: 3 v: 4\n",
    # The experiment of a lab book stands alone above its rows: no title to leave out.
    "an experiment above its rows": "exp;point;pan\nE1;1;0\n;2;5\nE2;;\n;1;0\n",
    "words below the rows": "n;mm\n0;1\n5;2\nChecked by: A. B.;\n",
    "words among the rows": "n;mm\n0;1\nafter lunch;\n5;2\n9;3\n",
    "titles of directions": "Run up\nn;mm\n0;1\n5;2\nRun down\nn;mm\n5;2\n0;1\n",
    "a title without a direction": "Run up\nn;mm\n0;1\n5;2\nRun 2\nn;mm\n5;2\n0;1\n",
    "positions across": "target;0;5;9;12\nup 1;0,1;5,1;9,1;12,1\n",
    "labels of rows": "point A;0;5;9\npoint A;1;5;9\n",
    "objects of JSON": '[{"a": 1, "b": {"c": "x"}}, {"a": null, "b": {"c": true}}]',
}.items():
    add(f"table, {key}", text)
