"""Results that a report reads from `results/`: only complete ones of the same data."""

from __future__ import annotations

import numpy as np
import pytest
from support.reported_twin import BATCH, PLANNED, evidence_of, stored
from support.small_results import small_summary

from tvsbayes.calibration.calibration_file import calibration_json, content_sha256
from tvsbayes.errors import InputError
from tvsbayes.pipeline import load_calibration
from tvsbayes.report.evidence import CANNOT_TELL, MET, NOT_MET, Criterion, criterion
from tvsbayes.report.scanner_document import criteria_table, report_document, verdict_of
from tvsbayes.results.comparison_record import stored_hold_out
from tvsbayes.results.compensation_record import APPLIED, KEPT, VERIFICATION_FORMAT, WORLDS
from tvsbayes.results.plan_record import stored_plan

READERS = {"compare.json": stored_hold_out, "plan.json": stored_plan}


def test_results_that_belong_to_other_data_are_not_reported(reported):
    """Results of another campaign are left out."""
    other = {"inputs": {"moves": "0"}}
    with stored(reported, {name: other for name in (*READERS, "verification.json")}):
        shown = evidence_of(reported)
    assert (shown.held_out, shown.planned, shown.verified) == (None, None, None)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("content", [{}, {"held_out": None, "target": 3}, {"held_out": {"verdict": "x"}, "target": {}}])
def test_results_of_unknown_origin_are_refused_by_name(reported, evidence, name, content):
    inputs = evidence.fit.provenance.inputs
    document = {"inputs": inputs, **content}
    with stored(reported, {name: document}), pytest.raises(InputError, match=f"results/{name}"):
        READERS[name](evidence.campaign, inputs)


@pytest.mark.parametrize(
    ("key", "value", "column"),
    [
        ("now", None, "now"),
        ("target", {"text": 3, "unit": "mm"}, "target.text"),
        ("stop", {"now": "no", "reason": "", "rule": ""}, "stop.now"),
        ("limited_by", {"needed": ["a"]}, "limited_by.needed"),
        ("next", {}, "next"),
        ("next", [{**BATCH, "gain": "high"}], "next.gain"),
    ],
)
def test_a_damaged_plan_is_refused_by_key(reported, evidence, key, value, column):
    inputs = evidence.fit.provenance.inputs
    document = {"inputs": inputs, **PLANNED, key: value}
    with stored(reported, {"plan.json": document}), pytest.raises(InputError) as caught:
        stored_plan(evidence.campaign, inputs)
    assert caught.value.column == column


@pytest.mark.parametrize(
    ("share", "verdict"), [(1.0, "met"), (0.95, "met"), (0.94, "cannot tell"), (0.06, "cannot tell"), (0.05, "not met")]
)
def test_criterion_follows_its_rule(share, verdict):
    errors = np.where(np.arange(1000) < 1000 * share, 0.5, -2.0)
    judged = criterion("x", errors, 1.0, "mm")
    assert (judged.probability, judged.verdict) == (pytest.approx(share), verdict)


def test_headline_and_table_write_a_probability_alike():
    """All draws lie within a limit."""
    sure = Criterion("ratio left", 1e-3, "deg/step", 1.0, MET)
    assert verdict_of(small_summary(), (sure,)).text.endswith("(probability above 0.999)")
    assert criteria_table((sure,)).rows[0][2] == "above 0.999"
    open_ = Criterion("3D point", 60.0, "mm", 0.551, CANNOT_TELL)
    assert criteria_table((open_,)).rows[0][2] == "0.551: 45 of 100 are off by more"
    assert verdict_of(small_summary(), (open_,)).text.endswith("(probability 0.551)")
    far = Criterion("ratio left", 1e-3, "deg/step", 0.0, NOT_MET)
    assert verdict_of(small_summary(), (far,)).text.endswith("(probability below 0.001)")


@pytest.mark.thorough
def test_a_verification_of_this_calibration_is_reported_with_millimetres(reported, evidence):
    """A verification of another calibration is not reported."""
    size = {"rms": 0.0123, "worst": 0.045}
    mm = {"distance_mm": 1000.0, "before": {"rms": 37.7, "worst": 60.2}, "after": {"rms": 1.83, "worst": 4.1}}
    mm["promised95"] = 5.18
    worlds = dict.fromkeys(WORLDS, 0.01) | {APPLIED: 0.96}
    file = {"verdict": KEPT, "p": 0.4, "worlds": worlds, "before": size, "after": size, "promised95": 0.05}
    file |= {"readings": 12, "millimetres": mm, "format": VERIFICATION_FORMAT, "inputs": evidence.fit.provenance.inputs}
    table = content_sha256(calibration_json(load_calibration(reported)))
    with stored(reported, {"verification.json": {**file, "table": table}}):
        [section] = [s for s in report_document(evidence_of(reported)).sections if s.title.startswith("Applied")]
    with stored(reported, {"verification.json": {**file, "table": "0" * 64}}):
        assert evidence_of(reported).verified is None
    assert "KEPT: 12 fresh looks" in section.text[0] and "at 1000 mm 5.2 mm" in section.text[0]
    cells = [cell for row in section.tables[0].rows for cell in row]
    assert {"38", "1.8", "4.1"} <= set(cells)
