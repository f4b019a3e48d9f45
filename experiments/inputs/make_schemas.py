"""Write data/schemas: the JSON schemas of documents, as the records in the package declare them.

python -m experiments.inputs.make_schemas
"""

from __future__ import annotations

import json
from typing import Any

from experiments.common.command_line import print_only
from experiments.common.rows import ROOT
from tvsbayes.results.compensation_record import (
    AIMED_FORMAT,
    COMPENSATION_FORMAT,
    AimedPromise,
    Compensation,
    Verification,
)
from tvsbayes.results.fit_record import Provenance, fit_schema
from tvsbayes.results.records import schema_of
from tvsbayes.results.watch_record import Watch, WatchPlan
from tvsbayes.single_axis.axis_summary import AxisInputs, axis_fit_schema

FOLDER = ROOT / "data" / "schemas"
GROWTH = (
    "Every number is finite. Units stand in the names and descriptions. Within a version keys may be added, never "
    "removed or given another meaning."
)


def schemas() -> dict[str, dict[str, Any]]:
    """Every schema by the name of its document and version."""
    documents = {
        "fit-1": ("results/fit.json of a campaign, tvsbayes-fit/1", fit_schema()),
        "axis-fit-1": ("results/fit.json of an axis folder, tvsbayes-axis-fit/1", axis_fit_schema()),
        "watch-1": ("watch --json", schema_of(Watch)),
        "compensation-1": (
            f"results/compensation.json of an axis folder, {COMPENSATION_FORMAT}",
            schema_of(Compensation, Provenance, format={"const": COMPENSATION_FORMAT}, inputs=AxisInputs),
        ),
        "aimed-promise-1": (
            f"results/compensation.json of a scanner or head, {AIMED_FORMAT}",
            schema_of(AimedPromise, Provenance, format={"const": AIMED_FORMAT}),
        ),
        "verification-1": ("verify --json", schema_of(Verification)),
        "watch-plan-1": ("plan --watch --json", schema_of(WatchPlan)),
    }
    return {
        name: {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "$id": f"urn:tvsbayes:schema:{name}",
            "title": title,
            "description": GROWTH,
            **schema,
        }
        for name, (title, schema) in documents.items()
    }


def files() -> dict[str, str]:
    """The content of every file in `data/schemas`, by its name."""
    return {f"{name}.schema.json": json.dumps(schema, indent=1) + "\n" for name, schema in schemas().items()}


def main() -> None:
    """Replace the files."""
    print_only(__doc__)
    for name, text in files().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
        print(FOLDER / name)


if __name__ == "__main__":
    main()
