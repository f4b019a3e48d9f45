"""The DCC-schema XML: structure, numbers, what it claims, text that stays text."""

from __future__ import annotations

import copy
import datetime
import math
import os
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec import structs
from support.certified_campaign import certified, texts
from support.dcc_structure import local, structure_problems
from support.refusals import refusal

from tvsbayes.errors import InputError, NotConverged
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.metrology.dcc import COUNTRY_NOT_STATED, NOT_ACCREDITED, Embedded, Parties, check_dcc
from tvsbayes.results.estimates import Validation


def test_the_structure_is_the_schemas():
    for header in ({}, {"environment": {}, "traceability": {}, "created": None}):
        root = certified(**header).with_positioning().root(report=Embedded("0123456789AB", b"<html></html>"))
        assert structure_problems(root) == []
        assert root.get("schemaVersion") == "3.3.0"
        assert root.tag == "{https://ptb.de/dcc}digitalCalibrationCertificate"


def test_the_structural_check_sees_damage():
    """Each defect alone must be seen: order, missing and foreign elements, namespaces, numbers, identifiers."""
    good = certified().root()
    assert structure_problems(good) == []
    path = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}

    def damaged(change):
        root = copy.deepcopy(good)
        change(root)
        return structure_problems(root)

    core = ".//dcc:coreData"

    def text(where, value):
        return lambda root: setattr(root.find(where, path), "text", value)

    damage = [
        lambda r: r.find(core, path).insert(0, r.find(core, path)[-1]),
        lambda r: r.find(core, path).remove(r.find(f"{core}/dcc:performanceLocation", path)),
        lambda r: r.find(".//dcc:result", path).insert(0, r.find(".//dcc:result/dcc:data", path)),
        lambda r: ET.SubElement(r.find(".//dcc:item", path), "{https://ptb.de/dcc}colour"),
        lambda r: setattr(r.find(".//si:value", path), "tag", "{https://ptb.de/dcc}value"),
        lambda r: r.find(".//dcc:item", path).set("id", "method"),
        lambda r: r.find(".//dcc:result", path).set("refId", "nowhere"),
        lambda r: r.find(".//dcc:content", path).set("lang", "de"),
        lambda r: r.find(".//dcc:item", path).set("onclick", "x"),
        text(".//si:value", "nan"),
        text(".//si:coverageFactor", "0.9"),
        text(".//si:coverageProbability", "95"),
        text(".//si:valueExpandedMU", "-1"),
        text(".//si:unit", "deg"),
        text(".//dcc:release", "0.1.0.dev3"),
        text(".//dcc:uniqueIdentifier", " a "),
        text(".//dcc:issuer", "me"),
    ]
    assert [k for k, change in enumerate(damage) if not damaged(change)] == []


def test_ratios_stand_with_expanded_uncertainty_and_backlash_with_its_own():
    case = certified()
    root, summary = case.root(), case.fit.summary
    quantities = root.findall(".//dcc:result/dcc:data/dcc:quantity", {"dcc": "https://ptb.de/dcc"})
    named = {texts(q, "dcc:name/dcc:content")[0]: q for q in quantities}
    assert len(named) == 6
    for direction, entry in summary.effective.items():
        quantity = named[f"effective degrees per step, {direction}"]
        (value,), (unit,) = texts(quantity, ".//si:value"), texts(quantity, ".//si:unit")
        expanded, k = (float(texts(quantity, f".//si:{n}")[0]) for n in ("valueExpandedMU", "coverageFactor"))
        assert unit == r"\degree\per\one"
        low, high = entry.interval95
        # U to two digits, the value to the same place (GUM 7.2.6); k to two decimals.
        assert expanded == pytest.approx((high - low) / 2, rel=0.05)
        assert k == pytest.approx((high - low) / 2 / entry.sd, abs=0.005)
        places = len(value.partition(".")[2])
        assert abs(float(value) - entry.value) <= 0.5 * 10.0**-places * (1 + 1e-9)
        assert len(texts(quantity, ".//si:valueExpandedMU")[0].partition(".")[2]) == places
        assert f"{expanded:.{places}f}".replace(".", "").lstrip("0").__len__() == 2
        assert texts(quantity, ".//si:coverageProbability") == ["0.95"]
        assert texts(quantity, ".//si:distribution") == ["normal"]
    backlash = named["backlash of the tilt axis"]
    assert float(texts(backlash, ".//si:value")[0]) == pytest.approx(
        summary.parameters["backlash_deg.tilt"].value, abs=0.001
    )
    assert texts(backlash, ".//si:unit") == [r"\degree"]


@pytest.mark.parametrize(
    ("play", "interval"),
    [
        ((0.02, 0.02, (0.001, 0.08)), ["0.020", "0.001", "0.080", "0.95", "normal"]),
        # Of a heavy tail the 95 % interval may be shorter than u on either side; D-SI takes k >= 1 only.
        ((0.5, 0.2, (0.4, 0.6)), ["0.20", "0.40", "0.60", "0.95", "normal"]),
    ],
)
def test_a_quantity_of_skewed_or_heavy_tails_gets_an_interval(play, interval):
    root = certified().with_play(*play).root()
    assert structure_problems(root) == []
    (box,) = root.findall(".//si:coverageIntervalMU", {"si": "https://ptb.de/si"})
    assert [child.text for child in box] == interval


def test_a_fixed_quantity_has_no_uncertainty_and_an_unmoved_axis_no_number():
    case = certified().with_play(0.0, 0.0, (0.0, 0.0))
    root = case.with_summary(effective={**case.fit.summary.effective, "up": None, "down": None}).root()
    assert structure_problems(root) == []
    assert "0.0" in texts(root, ".//si:value")
    # Up, down and the backlash of their axis.
    assert len(texts(root, ".//dcc:noQuantity/dcc:content")) == 3


def declared(root: ET.Element) -> dict[str, tuple[str, str | None]]:
    path = {"dcc": "https://ptb.de/dcc"}
    return {
        texts(s, "dcc:name/dcc:content")[0]: (
            texts(s, "dcc:declaration/dcc:content")[0],
            s.findtext("dcc:traceable", None, path),
        )
        for s in root.findall(".//dcc:statement", path)
    }


def test_nothing_is_claimed_without_a_declaration():
    statements = declared(certified().root())
    assert statements["accreditation"][0] == NOT_ACCREDITED
    # small_campaign names certificate B-17 of its board.
    assert statements["traceability"] == (
        "As declared by the user and not verified here: length from the board with certificate B-17.",
        "true",
    )
    for header in ({"traceability": {}}, {"traceability": {"board_certificate": "  "}}):
        text, traceable = declared(certified(**header).root())["traceability"]
        assert traceable == "false" and text.startswith("Not traceable")
    text, traceable = declared(certified(synthetic=True).root())["traceability"]
    assert (text, traceable) == ("Simulated data: not traceable.", "false")
    root = certified().root()
    assert not any("Signature" in local(e) and e.text != "false" for e in root.iter())
    assert set(texts(root, ".//dcc:mainSigner")) == {"false"}


def test_administrative_data_are_the_campaigns():
    root = certified(operator="A. Ünal", instrument="TVS 3", serial="007", method="grid of 4 poses").root()
    assert texts(root, ".//dcc:item/dcc:name/dcc:content") == ["TVS 3"]
    assert texts(root, ".//dcc:item/dcc:identifications/dcc:identification/dcc:value")[0] == "007"
    assert texts(root, ".//dcc:person/dcc:name/dcc:content") == ["A. Ünal"]
    assert "grid of 4 poses" in texts(root, ".//dcc:usedMethod/dcc:description/dcc:content")[0]
    assert texts(root, ".//dcc:beginPerformanceDate") == texts(root, ".//dcc:endPerformanceDate") == ["2026-01-15"]
    conditions = root.findall(".//dcc:influenceCondition", {"dcc": "https://ptb.de/dcc"})
    assert [texts(c, ".//si:value") for c in conditions] == [["21.00"], []]
    assert texts(conditions[0], ".//si:valueStandardMU") == ["0.50"]
    assert texts(conditions[1], ".//dcc:text/dcc:content") == ["not recorded"]
    assert "calibrated 2026-01-03" in texts(root, ".//dcc:measuringEquipment/dcc:description/dcc:content")[0]


def test_dates_run_on_with_the_campaign_or_say_that_they_are_not_known():
    late = datetime.datetime(2026, 1, 15, 23, 59, 30, tzinfo=datetime.UTC)
    root = certified(created=late).root()
    assert texts(root, ".//dcc:endPerformanceDate") == ["2026-01-16"]
    root = certified(created=None).root()
    assert texts(root, ".//dcc:beginPerformanceDate") == ["2026-11-21"]
    assert "dates" in declared(root)


@pytest.mark.parametrize(("first_s", "last_s", "end"), [(1.768e9, 1.768e9 + 86400, 16), (-5.0, 1e12, 15)])
def test_dates_follow_the_time_that_moves_took(first_s, last_s, end):
    """Times may be those of a clock (seconds since 1970); a span beyond the calendar is no date."""
    case = certified(created=datetime.datetime(2026, 1, 15, 10, tzinfo=datetime.UTC))
    moves = case.campaign.moves
    moves = (*(replace(m, time_s=first_s) for m in moves[:-1]), replace(moves[-1], time_s=last_s))
    campaign = replace(case.campaign, moves=moves)
    root = replace(case, campaign=campaign).with_provenance(inputs=input_hashes(campaign)).root()
    assert texts(root, ".//dcc:beginPerformanceDate") == ["2026-01-15"]
    assert texts(root, ".//dcc:endPerformanceDate") == [f"2026-01-{end}"]


def test_the_same_inputs_and_date_give_the_same_bytes():
    case = certified()
    assert case.certificate() == copy.deepcopy(case).certificate()
    names = set()
    for day, fit in ((1, case), (2, case), (1, case.with_summary(estimator="posterior"))):
        root = fit.root(issued=datetime.date(2026, 11, day))
        names |= set(texts(root, ".//dcc:uniqueIdentifier"))
    assert len(names) == 3
    assert ET.register_namespace.__module__ == "xml.etree.ElementTree"
    assert "https://ptb.de/dcc" not in ET._namespace_map


PAYLOADS = (
    "</dcc:content><script>alert(1)</script>",
    '"><svg onload=alert(1)>',
    "&xxe; &#0; &lt;b&gt;",
    "]]><!-- --> <![CDATA[x]]>",
    "<?xml version='1.0'?><!DOCTYPE x [<!ENTITY y SYSTEM 'file:///etc/passwd'>]>",
    "line\r\nbreak\x00\x1b[31m\ud800\ufffe end",
)


@pytest.mark.parametrize("payload", PAYLOADS)
def test_text_stays_text(payload):
    """Every text of campaign and fit filled with markup: the same elements, the payload as content only."""
    plain = dict.fromkeys(("name", "operator", "instrument", "serial", "method", "notes"), "plain")
    board = {"board_certificate": "plain", "stereo_calibrated": datetime.date(2026, 1, 3)}

    def certificate(text):
        header = {**dict.fromkeys(plain, text), "traceability": {**board, "board_certificate": text}}
        fit = certified(**header)
        fit = fit.with_provenance(command=text, versions={**fit.fit.provenance.versions, "jax": text})
        data = fit.certificate(identifier=text, parties=Parties(text, text))
        return data, ET.fromstring(data)

    data, root = certificate(payload)
    _, benign = certificate("plain")
    assert structure_problems(root) == []
    assert [e.tag for e in root.iter()] == [e.tag for e in benign.iter()]
    assert [sorted(e.attrib.items()) for e in root.iter()] == [sorted(e.attrib.items()) for e in benign.iter()]
    shown = " ".join(re.sub("[\x00\x1b\ud800\ufffe]", "\ufffd", payload).split())
    # Five texts of the campaign, its certificate twice, three of the call, two of the fit in both lists of software.
    assert sum((e.text or "").count(shown) for e in root.iter()) == 14
    assert b"<script" not in data and b"<svg" not in data and b"<!" not in data
    # The value of a release stays what the Schematron requires, whatever the version is.
    assert set(texts(root, ".//dcc:release")) == {"v0.1.0"}


def test_what_must_not_be_certified_is_refused():
    case = certified()
    with pytest.raises(NotConverged):
        case.with_summary(converged=False).certificate()
    with pytest.raises(InputError, match="other data"):
        case.with_provenance(inputs={**case.fit.provenance.inputs, "rig": "0" * 64}).certificate()
    for country in ("de", "DEU", "", "D\n"):
        with pytest.raises(InputError, match="country"):
            case.certificate(parties=Parties(country=country))
        with pytest.raises(InputError, match="country"):
            case.certificate(parties=Parties(customer_country=country))
    assert "two letters" in refusal(lambda: case.certificate(parties=Parties(country="Mexico"))).remedy
    effective = case.fit.summary.effective
    bad = structs.replace(effective["left"], value=math.inf)
    with pytest.raises(ValueError, match="finite"):
        case.with_summary(effective={**effective, "left": bad}).certificate()


def test_each_country_stands_with_its_own_party():
    """The place of the measurement is not where the customer lives."""
    case, path = certified(), {"dcc": "https://ptb.de/dcc"}
    for parties, codes, undeclared in (
        (Parties(country="MX"), ("MX", COUNTRY_NOT_STATED), {"country of the customer"}),
        (Parties(country="MX", customer_country="DE"), ("MX", "DE"), set()),
        (Parties(), (COUNTRY_NOT_STATED, COUNTRY_NOT_STATED), {"country", "country of the customer"}),
    ):
        root = case.root(parties=parties)
        place = "dcc:location/dcc:countryCode"
        places = [root.findtext(f".//{where}/{place}", None, path) for where in ("dcc:contact", "dcc:customer")]
        assert tuple(places) == codes and texts(root, ".//dcc:countryCodeISO3166_1") == [codes[0]]
        statements = declared(root)
        assert {name for name in statements if name.startswith("country")} == undeclared
        assert all(COUNTRY_NOT_STATED in statements[name][0] for name in undeclared)


def test_the_number_of_the_report_is_in_the_certificate_that_carries_it():
    """And another report, customer or country makes another identifier."""
    case, names = certified(), set()
    for number, parties in (
        ("A1", Parties()),
        ("B2", Parties()),
        ("A1", Parties("Lab")),
        ("A1", Parties(country="MX")),
    ):
        root = case.root(report=Embedded(number, b"<html></html>"), parties=parties)
        assert texts(root, ".//dcc:coreData/dcc:identifications/dcc:identification/dcc:value") == [number]
        assert texts(root, ".//dcc:document/dcc:name/dcc:content") == [f"report {number}"]
        names |= set(texts(root, ".//dcc:uniqueIdentifier"))
    assert len(names) == 4


def test_development_versions_are_cut_to_a_release():
    case = certified()
    for version, release in (
        ("0.1.0.dev3+g1a2b", "v0.1.0"),
        ("2026.1.0", "v0"),
        ("12", "v12"),
        ("1.2.3.4.5", "v1.2.3.4"),
    ):
        root = case.with_provenance(versions={**case.fit.provenance.versions, "tvsbayes": version}).root()
        assert structure_problems(root) == [], version
        assert set(texts(root, ".//dcc:release")) == {release}


def test_a_failed_validation_is_declared_with_its_factor():
    failed = Validation(False, 0.01, "the cameras moved: from spot 9 on", 3.25, ())
    root = certified().with_summary(validation=failed).root()
    assert "multiply every one of them by 3.25" in declared(root)["validation"][0]
    for validation in (None, structs.replace(failed, passed=True)):
        assert "validation" not in declared(certified().with_summary(validation=validation).root())


SMALL_XSD = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" xmlns:dcc="https://ptb.de/dcc"
 targetNamespace="https://ptb.de/dcc" elementFormDefault="qualified">
<xs:element name="digitalCalibrationCertificate"><xs:complexType><xs:sequence>
<xs:any maxOccurs="unbounded" processContents="skip"/></xs:sequence>
<xs:attribute name="schemaVersion" type="xs:string" fixed="VERSION"/></xs:complexType></xs:element></xs:schema>"""


def test_a_schema_that_the_user_names_is_used(tmp_path, monkeypatch):
    data = certified().certificate()
    right, wrong, broken = (tmp_path / name for name in ("right.xsd", "wrong.xsd", "broken.xsd"))
    right.write_text(SMALL_XSD.replace("VERSION", "3.3.0"))
    wrong.write_text(SMALL_XSD.replace("VERSION", "2.4.0"))
    broken.write_text("<nothing/>")
    with pytest.raises(InputError, match="no such file"):
        check_dcc(data, tmp_path / "missing.xsd")
    for hidden in (False, True):
        if hidden:
            monkeypatch.setattr(shutil, "which", lambda name: None)
        check = check_dcc(data, right)
        if check.tool is None:
            assert check.valid is None and "install xmllint" in check.messages[0]
            continue
        assert check.valid is True
        assert check_dcc(data, wrong).valid is False and check_dcc(data, wrong).messages
        assert check_dcc(data, broken).valid is None
    monkeypatch.setattr(shutil, "which", lambda name: "xmllint")
    answers = {
        "timeout": subprocess.TimeoutExpired("xmllint", 60),
        "valid": SimpleNamespace(returncode=0, stderr=b"- validates\n"),
        "invalid": SimpleNamespace(returncode=3, stderr=b"a\nb\n"),
        "schema": SimpleNamespace(returncode=5, stderr=b"failed to compile\n"),
    }

    def answer(kind):
        def run(command, **options):
            assert "--nonet" in command and options["input"] == data
            if isinstance(answers[kind], Exception):
                raise answers[kind]
            return answers[kind]

        return run

    for kind, valid in (("timeout", None), ("valid", True), ("invalid", False), ("schema", None)):
        monkeypatch.setattr(subprocess, "run", answer(kind))
        check = check_dcc(data, right)
        assert (check.tool, check.valid) == ("xmllint", valid) and check.messages


@pytest.mark.skipif("TVSBAYES_DCC_SCHEMA" not in os.environ, reason="TVSBAYES_DCC_SCHEMA names no dcc.xsd")
def test_ptbs_schema_where_it_is_at_hand():
    data = certified().with_positioning().certificate(report=b"<html/>")
    check = check_dcc(data, Path(os.environ["TVSBAYES_DCC_SCHEMA"]))
    assert check.valid is True, check
