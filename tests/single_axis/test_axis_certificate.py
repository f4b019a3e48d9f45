"""The certificate of an axis: structure of the schema, what is stated of figures, reference and conformity."""

from __future__ import annotations

import datetime
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from support.axes import runs
from support.dcc_structure import structure_problems
from support.refusals import refusal

from tvsbayes.metrology.conformity import Tolerance
from tvsbayes.metrology.dcc import Embedded, Parties
from tvsbayes.report.axis_document import axis_document, criteria_of, curve_commands
from tvsbayes.report.document import Issue
from tvsbayes.report.page import page_html
from tvsbayes.single_axis.axis_campaign import AxisCampaign, Reading, Reference, axis_bytes, read_axis, write_axis
from tvsbayes.single_axis.axis_certificate import axis_certificate
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_record import AxisResults, summarise_axis

PATH = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
DAY = datetime.date(2026, 11, 28)
REPORT = Embedded("A1", b"<html></html>")
HEADER = {
    "created": datetime.datetime(2026, 11, 20, 13, 0),
    "serial": "KGT-16",
    "environment": {"temperature_degC": {"value": 20.3, "u": 0.3}},
    "traceability": {"reference_calibrated": datetime.date(2026, 2, 3)},
}
KNOWN = Reference(u_per_unit=2e-6, certificate="K 17", valid_until=datetime.date(2027, 2, 28))


@pytest.fixture(scope="module")
def results() -> AxisResults:
    """A screw in mm, read in three cycles."""
    moves = runs(3, (0.0, 50.0, 100.0, 150.0, 200.0), beyond=5.0)
    rng, command = np.random.default_rng(8), np.array([m.command for m in moves])
    side = np.r_[-1.0, np.sign(np.diff(command))]
    value = command * (1 + 4e-5) - 0.003 * side + rng.normal(0, 0.001, len(moves))
    read = [k for k, c in enumerate(command) if 0 <= c <= 200]
    readings = tuple(Reading(n, k, float(value[k])) for n, k in enumerate(read))
    campaign = AxisCampaign("mm", moves, readings, header=HEADER, command_unit="mm", reference=KNOWN)
    fit = fit_axis(campaign, sampled=False, more=curve_commands(0.0, 200.0))
    return AxisResults(summarise_axis(fit), fit)


def with_campaign(results: AxisResults, **changes: object) -> AxisResults:
    return replace(results, fit=replace(results.fit, campaign=replace(results.fit.campaign, **changes)))


def root(results: AxisResults, **options: object) -> ET.Element:
    return ET.fromstring(axis_certificate(results, issued=DAY, **{"parties": Parties(), "report": REPORT, **options}))


def named(element: ET.Element) -> dict[str, ET.Element]:
    quantities = element.findall(".//dcc:result/dcc:data/dcc:quantity", PATH)
    return {q.findtext("dcc:name/dcc:content", "", PATH): q for q in quantities}


def declared(element: ET.Element) -> dict[str, str]:
    statements = element.findall(".//dcc:statement", PATH)
    return {
        s.findtext("dcc:name/dcc:content", "", PATH): s.findtext("dcc:declaration/dcc:content", "", PATH)
        for s in statements
    }


def test_figures_stand_with_their_expanded_uncertainty(results):
    xml = root(results)
    assert [p for p in structure_problems(xml) if "metre" not in p] == []
    classic, quantities = results.summary.classic, named(xml)
    accuracy = quantities["A, bidirectional accuracy"]
    expanded = float(accuracy.findtext(".//si:valueExpandedMU", "", PATH))
    assert expanded == pytest.approx(2 * classic.iso230_u["accuracy"], rel=0.05)
    # The scale of the reference, 2e-6 of 200 mm.
    assert expanded == pytest.approx(8e-4, rel=0.05)
    assert float(accuracy.findtext(".//si:value", "", PATH)) == pytest.approx(classic.iso230["accuracy"], abs=5e-5)
    assert {q.findtext(".//si:unit", "", PATH) for q in quantities.values()} == {
        *(r"\milli\metre", r"\milli\metre\per\one")
    }
    assert "mean deviation at 50, backward" in quantities and len(quantities) == 2 + 1 + 12 + 20


def test_the_reference_is_what_the_results_are_traced_to(results):
    xml = root(results)
    statements = declared(xml)
    assert "K 17" in statements["traceability"] and "2027-02-28" in statements["validity of the reference"]
    assert "2026-02-03" in statements["calibration of the reference"]
    assert [e.text for e in xml.iter(f"{{{PATH['dcc']}}}traceable")] == ["true"]
    assert xml.findtext(".//dcc:beginPerformanceDate", "", PATH) == "2026-11-20"
    assert "20.30" in [e.text for e in xml.findall(".//dcc:influenceCondition//si:value", PATH)]
    for reference in (Reference(), replace(KNOWN, valid_until=datetime.date(2026, 11, 19))):
        xml = root(with_campaign(results, reference=reference))
        assert declared(xml)["traceability"].startswith("Not traceable")
        assert [e.text for e in xml.iter(f"{{{PATH['dcc']}}}traceable")] == ["false"]


def test_conformity_is_stated_with_rule_and_risk(results):
    criteria = criteria_of(results.summary, Tolerance(0.05, "accuracy", "guarded"))
    text = declared(root(results, criteria=criteria))["conformity"]
    assert text.startswith("A conforms to 0.05 mm by the decision rule guarded, guard band 0.0008") and "risk" in text
    page = page_html(axis_document(results, Issue(DAY), criteria)).decode()
    assert "conforms to 0.05 mm" in page and "No limit was stated" not in page and "K 17" in page
    small = criteria_of(results.summary, Tolerance(0.001, "accuracy", "guarded"))
    assert small[0].verdict == "does not conform"


def test_what_allows_no_certificate_is_refused(results):
    assert "D-SI" in str(refusal(lambda: root(with_campaign(results, unit="furlong"))))
    assert refusal(lambda: root(results, parties=Parties(country="Mexico"))).code == "country"


def test_tables_of_the_header_are_read_and_checked(results, tmp_path):
    write_axis(results.fit.campaign, tmp_path / "a")
    assert read_axis(tmp_path / "a").header == HEADER
    file = tmp_path / "a" / "campaign.toml"
    text = axis_bytes(replace(results.fit.campaign, header={}))["campaign.toml"].decode()
    for table in ("environment = { pressure = 1 }", "traceability = { board_certificate = 'x' }"):
        file.write_text(f"{table}\n{text}")
        assert refusal(lambda: read_axis(tmp_path / "a")).code == "unknown-key"
