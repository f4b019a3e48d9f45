"""A metrologist's afternoon: sheet, ISO 230-2, tolerance, table, fresh runs, certificate with a signature.

    python -m experiments.compensation.metrologist [--schema dcc.xsd] > experiments/compensation/metrologist.md

A screw of 400 mm is drawn (scale 40 um/m, play 6 um, errors by position of 3 um) and read by a laser in five cycles
with a sheet as a laboratory keeps it: dates, decimal commas, expanded uncertainties. The table of `compensate` is taken
as by a LinuxCNC controller, and the same test is made again. The key of the signature is made here. PTB's schema is
not part of this package: `--schema` names a copy.
"""

from __future__ import annotations

import datetime
import os
import tempfile
from pathlib import Path

import numpy as np

from experiments.common.command_line import parser
from experiments.common.commands import console, quietly
from experiments.common.drawn_axes import read, stands
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.verification import stored_compensation
from tvsbayes.metrology.signature import verify_signature
from tvsbayes.single_axis.axis_campaign import AxisMove, read_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.twin.simulated_axis import AxisTruth, draw_axis

TRAVEL, SEED, SCALE, CYCLES, TARGETS = 400.0, 7, 1.00004, 5, 9
BEYOND, BEGUN = 10.0, datetime.datetime(2026, 11, 20, 13, 0)
TRUE = {
    "backlash": AxisPrior(0.006, 0.0),
    "transmission_error": AxisPrior(0.003, 0.0),
    "play_variation": AxisPrior(0.0, 0.0),
    "ratio_contrast": AxisPrior(0.0, 0.0),
    "creep": AxisPrior(0.0, 0.0),
    "stop_sd": AxisPrior(0.0006, 0.1),
    "home_sd": AxisPrior(0.001, 0.1),
    "drift_per_root_hour": AxisPrior(0.0005, 0.0),
}
HEADER = """serial = "KGT-16-05"
environment = { temperature_degC = { value = 20.3, u = 0.3 } }
traceability = { reference_calibrated = 2026-02-03 }
"""
REFERENCE = """certificate = "K 2026-0417"
valid_until = 2027-02-28
"""
TOLERANCE = ("--tolerance", "15um", "--of", "A")


def cycle() -> tuple[AxisMove, ...]:
    """Five times to and fro through the targets, beyond both ends, a move in 20 s."""
    places, low, high = np.linspace(0.0, TRAVEL, TARGETS), -BEYOND, TRAVEL + BEYOND
    commands = [low] + [float(c) for _ in range(CYCLES) for c in (*places, high, *places[::-1], low)]
    return tuple(AxisMove(k, 0, 20.0 * k, c, "" if k else "backward") for k, c in enumerate(commands))


def sheet(truth: AxisTruth, rng: np.random.Generator, by: Correction | None = None, after_h: float = 0.0) -> bytes:
    """The laboratory's sheet of a test; the laser errs by one normal number for the day, times its u."""
    moves = cycle()
    sent = moves if by is None else by.moved(moves, 1.0, 1.0)
    which = [m.move for m in moves if 0.0 <= m.command <= TRAVEL]
    campaign = read(moves, stands(truth, tuple(sent), rng), which, rng, u=0.0001)
    common, rows = rng.standard_normal(), ["Zeit;Sollposition (mm);Laser (mm);Richtung;U k=2 (\u00b5m)"]
    for reading in campaign.readings:
        move = moves[reading.move]
        u = 0.5 * (0.0004 + 0.8e-6 * move.command)
        side = "vorw\u00e4rts" if move.command > moves[move.move - 1].command else "r\u00fcckw\u00e4rts"
        at = BEGUN + datetime.timedelta(hours=after_h, seconds=move.time_s)
        numbers = (f"{move.command:.3f}", f"{(reading.value or 0.0) + u * common:.5f}", side, f"{2000 * u:.2f}")
        rows.append(f"{at:%d.%m.%Y %H:%M:%S};" + ";".join(numbers).replace(".", ","))
    return ("\r\n".join(rows) + "\r\n").encode("cp1252")


def described(folder: str) -> None:
    """State what the laboratory knows besides in a folder's header."""
    file = Path(folder) / "campaign.toml"
    text = file.read_text(encoding="utf-8")
    text = text.replace('name = "my axis"\n', f'name = "{folder}"\n{HEADER}')
    file.write_text(text.replace("[reference]\n", f"[reference]\n{REFERENCE}", 1), encoding="utf-8")


def key_pair() -> None:
    """Write `key.pem` and `cert.pem` of a laboratory."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, "Length laboratory")])
    builder = x509.CertificateBuilder(name, name, key.public_key(), 1)
    builder = builder.not_valid_before(datetime.datetime(2026, 1, 1)).not_valid_after(datetime.datetime(2036, 1, 1))
    form = serialization.Encoding.PEM
    secret = key.private_bytes(form, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    Path("key.pem").write_bytes(secret)
    Path("cert.pem").write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(form))


def signed_and_unchanged() -> str:
    """What a reader of the certificate finds."""
    data, public = Path("after/results/dcc.xml").read_bytes(), Path("cert.pem").read_bytes()
    verify_signature(data, public)
    try:
        verify_signature(data.replace(b"KGT-16-05", b"KGT-16-06", 1), public)
    except Exception as error:
        return f"The signature holds with `cert.pem`. With another serial number in it: {error}.\n"
    raise AssertionError("a changed certificate passes")


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--schema", type=Path, help="PTB's dcc.xsd")
    schema = arguments.parse_args().schema
    checked = () if schema is None else ("--dcc-schema", str(schema.resolve()))
    rng = np.random.default_rng([SEED, 1])
    truth = draw_axis(np.linspace(-0.1 * TRAVEL, 1.1 * TRAVEL, 601).tolist(), TRUE, SCALE, TRAVEL, rng)
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        print(BEGIN)
        Path("before.csv").write_bytes(sheet(truth, rng))
        print("```text\n" + "\n".join(Path("before.csv").read_text("cp1252").splitlines()[:4]) + "\n...\n```\n")
        print(console("import", "before.csv", "--axis", "--to", "before", "--yes"))
        described("before")
        print(f"{STATED}\n```toml\n{HEADER}[reference]\n{REFERENCE}```\n")
        print(console("classic", "before"))
        print(FIT)
        quietly("fit", "before", "--quick")
        print(console("report", "before", *TOLERANCE))
        print(TABLE)
        print(console("compensate", "before", "--to", "linuxcnc", "-o", "screw.comp"))
        by = Correction.of(stored_compensation(read_axis(Path("before"))))
        Path("after.csv").write_bytes(sheet(truth, rng, by, after_h=2.0))
        print(FRESH)
        quietly("import", "after.csv", "--axis", "--to", "after", "--yes")
        described("after")
        print(console("verify", "before", "after"))
        quietly("fit", "after", "--quick")
        key_pair()
        issued = ("--laboratory", "Length", "--country", "DE", "--customer", "Mill", "--customer-country", "DE")
        signature = ("--sign", "key.pem", "--certificate", "cert.pem")
        print(CERTIFICATE)
        print(console("report", "after", *TOLERANCE, "--dcc", *checked, *issued, *signature))
        print(signed_and_unchanged())


BEGIN = """# A metrologist's afternoon

`experiments.compensation.metrologist` prints this page. The screw is drawn, the commands are those for a real one.

## The sheet
"""
STATED = """What the sheet does not say goes into `campaign.toml`:
"""
FIT = """## The tolerance

A of the standard must be at most 15 um. `tvsbayes fit before --quick`, then:
"""
TABLE = """## The table
"""
FRESH = """## The same test with the table in force

`import after.csv` as above, with the same entries.
"""
CERTIFICATE = """## The certificate
"""

if __name__ == "__main__":
    main()
