"""The DCC-schema XML: structure, numbers, what it claims, text that stays text, and the user's own schema."""

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
from metrology.test_iso230 import known_calibration
from support.small_campaign import small_campaign

from tvsbayes.errors import InputError, NotConverged
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.metrology.dcc import COUNTRY_NOT_STATED, NOT_ACCREDITED, check_dcc, dcc_bytes
from tvsbayes.metrology.positioning_table import positioning
from tvsbayes.results.fit_record import read_fit

KEPT = Path(__file__).parents[1] / "data"

WORDS = "content+"
CONTACT = "name eMail? phone? fax? location descriptionData?"
ORDER = {
    "digitalCalibrationCertificate": "administrativeData measurementResults comment? document? Signature*",
    "administrativeData": "dccSoftware refTypeDefinitions? coreData items calibrationLaboratory respPersons customer "
    "statements?",
    "dccSoftware": "software+",
    "usedSoftware": "software+",
    "software": "name release type? description?",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1+ mandatoryLangCodeISO639_1+ uniqueIdentifier "
    "identifications? receiptDate? beginPerformanceDate endPerformanceDate performanceLocation issueDate? "
    "reportAmendedSubstituted? previousReport?",
    "items": "name? equipmentClass* description? owner? manufacturer? identifications? item+",
    "item": "name equipmentClass* description? installedSoftwares? manufacturer? model? identifications "
    "itemQuantities?",
    "identifications": "identification+",
    "identification": "issuer value name?",
    "calibrationLaboratory": "calibrationLaboratoryCode? contact cryptElectronicSeal? cryptElectronicSignature? "
    "cryptElectronicTimeStamp?",
    "contact": CONTACT,
    "customer": CONTACT,
    "person": CONTACT.replace("location", "location?"),
    "location": "countryCode",
    "respPersons": "respPerson+",
    "respPerson": "person description? role? mainSigner? cryptElectronicSeal? cryptElectronicSignature? "
    "cryptElectronicTimeStamp?",
    "statements": "statement+",
    "statement": "name? description? countryCodeISO3166_1* convention? traceable? norm* reference* declaration? valid? "
    "date? period? respAuthority? conformity? data? nonSIDefinition? nonSIUnit? location?",
    "measurementResults": "measurementResult+",
    "measurementResult": "name description? usedMethods? usedSoftware? measuringEquipments? influenceConditions? "
    "results measurementMetaData?",
    "usedMethods": "usedMethod+",
    "usedMethod": "name description? norm* reference*",
    "measuringEquipments": "name? equipmentClass* description? owner? identifications? measuringEquipment+",
    "measuringEquipment": "name equipmentClass* description? certificate? manufacturer? model? identifications? "
    "measuringEquipmentQuantities?",
    "measuringEquipmentQuantities": "measuringEquipmentQuantity+",
    "measuringEquipmentQuantity": "name? description? real",
    "influenceConditions": "influenceCondition+",
    "influenceCondition": "name description? status? certificate? data",
    "results": "result+",
    "result": "name description? data",
    "quantity": "name? description? (noQuantity|real) relativeUncertainty? usedMethods? usedSoftware? "
    "measuringEquipments? influenceConditions? measurementMetaData?",
    "data": "(text|quantity)+",
    **dict.fromkeys(("name", "description", "declaration", "text", "noQuantity"), WORDS),
    "document": "name? description? fileName mimeType dataBase64",
    "real": "label? quantityTypeQUDT? value unit significantDigit? dateTime? measurementUncertaintyUnivariate?",
    "measurementUncertaintyUnivariate": "(standardMU|expandedMU|coverageIntervalMU)",
    "standardMU": "valueStandardMU distribution?",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability distribution?",
    "coverageIntervalMU": "valueStandardMU intervalMin intervalMax coverageProbability distribution?",
}
"""Children in order, of DCC 3.3.0 and D-SI 2.2.1 as far as we write them (research/report.md section 4; order of the
parts inside from the published 3.2.1 schema, whose names 3.3.0 keeps)."""
NOT_EMPTY = r"[^\s]+(\s+[^\s]+)*"
NUMBER = r"[-+]?((\d*\.\d+)|(\d+\.?\d*))([Ee][-+]?\d+)?"
LEAVES = {
    "countryCodeISO3166_1": "[A-Z]{2}",
    "countryCode": "[A-Z]{2}",
    **dict.fromkeys(("usedLangCodeISO639_1", "mandatoryLangCodeISO639_1"), "[a-z]{2}"),
    **dict.fromkeys(("uniqueIdentifier", "role", "norm", "reference", "fileName", "mimeType", "content"), NOT_EMPTY),
    **dict.fromkeys(("beginPerformanceDate", "endPerformanceDate", "issueDate"), r"\d{4}-\d\d-\d\d"),
    "performanceLocation": "laboratory|customer|laboratoryBranch|customerBranch|other",
    "issuer": "manufacturer|calibrationLaboratory|customer|owner|other",
    "release": r"[a-zA-Z]( )?([0-9]{1,3}\.){0,3}[0-9]{1,3}",
    **dict.fromkeys(
        ("traceable", "mainSigner", "cryptElectronicSeal", "cryptElectronicSignature", "cryptElectronicTimeStamp"),
        "true|false",
    ),
    "dataBase64": r"[A-Za-z0-9+/=\s]+",
    "unit": r"\\(degree(\\per\\one)?|milli\\metre|degreecelsius|percent)",
    **dict.fromkeys(("intervalMin", "intervalMax"), NUMBER),
    **dict.fromkeys(("valueStandardMU", "valueExpandedMU"), NUMBER.removeprefix("[-+]?")),
    "coverageFactor": r"[1-9]\d*(\.\d*)?",
    "coverageProbability": r"0(\.\d*)?|1(\.0*)?",
    "distribution": NOT_EMPTY,
}
URI = {"dcc": "{https://ptb.de/dcc}", "si": "{https://ptb.de/si}"}


def local(element: ET.Element) -> str:
    return element.tag.split("}")[1]


def structure_problems(root: ET.Element) -> list[str]:
    """What the schema would not take: order, number and content of elements, prefixes, identifiers, languages."""
    found = []
    si = {"real", *ORDER["real"].replace("?", "").split(), "measurementUncertaintyUnivariate", "standardMU"}
    si |= {"expandedMU", "coverageIntervalMU", "distribution", "intervalMin", "intervalMax"}
    si |= {"valueStandardMU", "valueExpandedMU", "coverageFactor", "coverageProbability"}
    parent = {child: element for element in root.iter() for child in element}
    for element in root.iter():
        name = local(element)
        inside = parent.get(element)
        is_si = name in si and not (name == "value" and local(inside) == "identification")
        if not element.tag.startswith(URI["si" if is_si else "dcc"]):
            found.append(f"{element.tag}: wrong namespace")
        children = "".join(local(child) + " " for child in element)
        if name in ORDER:
            pattern = re.sub(r"[A-Za-z_0-9]+", lambda m: f"(?:{m.group()} )", ORDER[name]).replace(" )", "\0")
            pattern = pattern.replace(" ", "").replace("\0", " )")
            if not re.fullmatch(pattern, children):
                found.append(f"{name}: children {children}")
            if (element.text or "").strip():
                found.append(f"{name}: text between elements")
            continue
        if children:
            found.append(f"{name}: unknown to the table of children: {children}")
        leaf = NOT_EMPTY if name == "value" and not is_si else NUMBER if name == "value" else LEAVES.get(name)
        if leaf is None or not re.fullmatch(leaf, element.text or ""):
            found.append(f"{name}: content {element.text!r}")
    ids = [e.get("id") for e in root.iter() if e.get("id")]
    references = {r for e in root.iter() for r in (e.get("refId") or "").split()}
    if len(ids) != len(set(ids)) or set(ids) != references:
        found.append(f"ids {ids} against references {references}")
    languages = {e.get("lang") for e in root.iter(URI["dcc"] + "content")}
    if languages != {e.text for e in root.iter(URI["dcc"] + "usedLangCodeISO639_1")}:
        found.append(f"languages {languages}")
    if any(list(map(local, e)).count("content") > 1 for e in root.iter()):
        found.append("a language twice")
    known = {"id", "refId", "refType", "lang"}
    for element in root.iter():
        if element is not root and set(element.attrib) - known:
            found.append(f"{element.tag}: attributes {element.attrib}")
    return found


ISSUED = datetime.date(2026, 11, 21)


def campaign_and_fit(**header: object) -> tuple[Campaign, dict]:
    """The small campaign and a kept fit whose inputs are said to be its own."""
    campaign = small_campaign()
    campaign = replace(campaign, header={**campaign.header, **header})
    document = read_fit(KEPT / "fit-1-laplace.json")
    return campaign, {**document, "inputs": input_hashes(campaign)}


def certificate(**header: object) -> ET.Element:
    campaign, document = campaign_and_fit(**header)
    return ET.fromstring(dcc_bytes(campaign, document, issued=ISSUED))


def texts(root: ET.Element, path: str) -> list[str]:
    """Text of all elements under a path of local names, prefixes as in the document."""
    return [e.text for e in root.findall(path, {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"})]


def predicted_tables() -> dict[str, object]:
    """The key of `fit.json` that holds ISO 230-2-style tables."""
    known = known_calibration(**{"backlash_deg.pan": 0.3, "stop_sd_deg.left": 0.1})
    return {"positioning": [positioning(known, "pan", tests=200).as_json()]}


def test_the_structure_is_the_schemas():
    for header in ({}, {"environment": {}, "traceability": {}, "created": None}):
        campaign, document = campaign_and_fit(**header)
        kept = {key: value for key, value in campaign.header.items() if value is not None}
        campaign = replace(campaign, header=kept)
        data = dcc_bytes(campaign, document | predicted_tables(), issued=ISSUED, report=b"<html></html>")
        root = ET.fromstring(data)
        assert structure_problems(root) == []
        assert root.get("schemaVersion") == "3.3.0"
        assert root.tag == "{https://ptb.de/dcc}digitalCalibrationCertificate"


def test_the_structural_check_sees_damage():
    """Each defect alone must be seen: order, missing and foreign elements, namespaces, numbers, identifiers."""
    good = certificate()
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
    campaign, document = campaign_and_fit()
    root = ET.fromstring(dcc_bytes(campaign, document, issued=ISSUED))
    quantities = root.findall(".//dcc:result/dcc:data/dcc:quantity", {"dcc": "https://ptb.de/dcc"})
    named = {texts(q, "dcc:name/dcc:content")[0]: q for q in quantities}
    assert len(named) == 6
    for direction, entry in document["effective_deg_per_step"].items():
        quantity = named[f"effective degrees per step, {direction}"]
        (value,), (unit,) = texts(quantity, ".//si:value"), texts(quantity, ".//si:unit")
        expanded, k = (float(texts(quantity, f".//si:{n}")[0]) for n in ("valueExpandedMU", "coverageFactor"))
        assert unit == r"\degree\per\one"
        low, high = entry["interval95"]
        # U to two digits, the value to the same place (GUM 7.2.6); k to two decimals.
        assert expanded == pytest.approx((high - low) / 2, rel=0.05)
        assert k == pytest.approx((high - low) / 2 / entry["sd"], abs=0.005)
        places = len(value.partition(".")[2])
        assert abs(float(value) - entry["value"]) <= 0.5 * 10.0**-places * (1 + 1e-9)
        assert len(texts(quantity, ".//si:valueExpandedMU")[0].partition(".")[2]) == places
        assert f"{expanded:.{places}f}".replace(".", "").lstrip("0").__len__() == 2
        assert texts(quantity, ".//si:coverageProbability") == ["0.95"]
        assert texts(quantity, ".//si:distribution") == ["normal"]
    backlash = named["backlash of the tilt axis"]
    assert float(texts(backlash, ".//si:value")[0]) == pytest.approx(
        document["parameters"]["backlash_deg.tilt"]["value"], abs=0.001
    )
    assert texts(backlash, ".//si:unit") == [r"\degree"]


def test_a_skewed_quantity_gets_an_interval_and_an_unmoved_one_no_number():
    campaign, document = campaign_and_fit()
    skewed = {**document["parameters"]["backlash_deg.pan"], "value": 0.02, "sd": 0.02, "interval95": [0.001, 0.08]}
    effective = {**document["effective_deg_per_step"], "up": None, "down": None}
    parameters = {**document["parameters"], "backlash_deg.pan": skewed}
    root = ET.fromstring(
        dcc_bytes(campaign, {**document, "parameters": parameters, "effective_deg_per_step": effective}, issued=ISSUED)
    )
    assert structure_problems(root) == []
    (box,) = root.findall(".//si:coverageIntervalMU", {"si": "https://ptb.de/si"})
    assert [child.text for child in box] == ["0.020", "0.001", "0.080", "0.95", "normal"]
    # Up, down and the backlash of their axis.
    assert len(texts(root, ".//dcc:noQuantity/dcc:content")) == 3


def test_no_coverage_factor_below_one_is_written():
    """Of a heavy tail the 95 % interval may be shorter than u on either side; D-SI takes k >= 1 only."""
    campaign, document = campaign_and_fit()
    heavy = {**document["parameters"]["backlash_deg.pan"], "value": 0.5, "sd": 0.2, "interval95": [0.4, 0.6]}
    parameters = {**document["parameters"], "backlash_deg.pan": heavy}
    root = ET.fromstring(dcc_bytes(campaign, {**document, "parameters": parameters}, issued=ISSUED))
    assert structure_problems(root) == []
    (box,) = root.findall(".//si:coverageIntervalMU", {"si": "https://ptb.de/si"})
    assert [child.text for child in box] == ["0.20", "0.40", "0.60", "0.95", "normal"]


def test_a_fixed_quantity_has_no_uncertainty():
    campaign, document = campaign_and_fit()
    fixed = {**document["parameters"]["backlash_deg.pan"], "value": 0.0, "sd": 0.0, "interval95": [0.0, 0.0]}
    parameters = {**document["parameters"], "backlash_deg.pan": fixed}
    root = ET.fromstring(dcc_bytes(campaign, {**document, "parameters": parameters}, issued=ISSUED))
    assert structure_problems(root) == []
    assert "0.0" in texts(root, ".//si:value")


def declared(root: ET.Element) -> dict[str, tuple[str, str | None]]:
    path = {"dcc": "https://ptb.de/dcc"}
    return {
        texts(s, "dcc:name/dcc:content")[0]: (
            texts(s, "dcc:declaration/dcc:content")[0],
            s.findtext("dcc:traceable", None, path),
        )
        for s in root.findall(".//dcc:statement", path)
    }


def test_nothing_is_claimed_that_nobody_vouches_for():
    statements = declared(certificate())
    assert statements["accreditation"][0] == NOT_ACCREDITED
    # small_campaign names certificate B-17 of its board.
    assert statements["traceability"] == (
        "As declared by the user and not verified here: length from the board with certificate B-17.",
        "true",
    )
    for header in ({"traceability": {}}, {"traceability": {"board_certificate": "  "}}):
        text, traceable = declared(certificate(**header))["traceability"]
        assert traceable == "false" and text.startswith("Not traceable")
    text, traceable = declared(certificate(synthetic=True))["traceability"]
    assert (text, traceable) == ("Simulated data: not traceable.", "false")
    root = certificate()
    assert not any("Signature" in local(e) and e.text != "false" for e in root.iter())
    assert set(texts(root, ".//dcc:mainSigner")) == {"false"}


def test_administrative_data_are_the_campaigns():
    root = certificate(operator="A. Ünal", instrument="TVS 3", serial="007", method="grid of 4 poses")
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
    root = certificate(created=late)
    assert texts(root, ".//dcc:endPerformanceDate") == ["2026-01-16"]
    campaign, document = campaign_and_fit()
    header = {key: value for key, value in campaign.header.items() if key != "created"}
    root = ET.fromstring(dcc_bytes(replace(campaign, header=header), document, issued=ISSUED))
    assert texts(root, ".//dcc:beginPerformanceDate") == ["2026-11-21"]
    assert "dates" in declared(root)


@pytest.mark.parametrize(("first_s", "last_s", "end"), [(1.768e9, 1.768e9 + 86400, 16), (-5.0, 1e12, 15)])
def test_dates_follow_the_time_that_moves_took(first_s, last_s, end):
    """Times may be those of a clock (seconds since 1970); a span beyond the calendar is no date."""
    campaign, document = campaign_and_fit(created=datetime.datetime(2026, 1, 15, 10, tzinfo=datetime.UTC))
    moves = (*(replace(m, time_s=first_s) for m in campaign.moves[:-1]), replace(campaign.moves[-1], time_s=last_s))
    campaign = replace(campaign, moves=moves)
    root = ET.fromstring(dcc_bytes(campaign, {**document, "inputs": input_hashes(campaign)}, issued=ISSUED))
    assert texts(root, ".//dcc:beginPerformanceDate") == ["2026-01-15"]
    assert texts(root, ".//dcc:endPerformanceDate") == [f"2026-01-{end}"]


def test_the_same_inputs_and_date_give_the_same_bytes():
    campaign, document = campaign_and_fit()
    one = dcc_bytes(campaign, document, issued=ISSUED)
    assert one == dcc_bytes(campaign, copy.deepcopy(document), issued=ISSUED)
    names = set()
    for day, fit in ((1, document), (2, document), (1, {**document, "estimator": "posterior"})):
        root = ET.fromstring(dcc_bytes(campaign, fit, issued=datetime.date(2026, 11, day)))
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

    def made(text):
        campaign, document = campaign_and_fit(
            **dict.fromkeys(plain, text), traceability={**board, "board_certificate": text}
        )
        document = {**document, "command": text, "versions": {**document["versions"], "jax": text}}
        data = dcc_bytes(campaign, document, issued=ISSUED, identifier=text, laboratory=text, customer=text)
        return data, ET.fromstring(data)

    data, root = made(payload)
    _, benign = made("plain")
    assert structure_problems(root) == []
    assert [e.tag for e in root.iter()] == [e.tag for e in benign.iter()]
    assert [sorted(e.attrib.items()) for e in root.iter()] == [sorted(e.attrib.items()) for e in benign.iter()]
    shown = " ".join(re.sub("[\x00\x1b\ud800\ufffe]", "\ufffd", payload).split())
    # Five texts of the campaign, its certificate twice, three of the call, two of the fit in both lists of software.
    assert sum((e.text or "").count(shown) for e in root.iter()) == 14
    assert b"<script" not in data and b"<svg" not in data and b"<!" not in data
    # The value of a release stays what the Schematron wants, whatever the version says.
    assert set(texts(root, ".//dcc:release")) == {"v0.1.0"}


def test_what_must_not_be_certified_is_refused():
    campaign, document = campaign_and_fit()
    with pytest.raises(NotConverged):
        dcc_bytes(campaign, {**document, "converged": False}, issued=ISSUED)
    with pytest.raises(InputError, match="other data"):
        dcc_bytes(campaign, {**document, "inputs": {**document["inputs"], "rig": "0" * 64}}, issued=ISSUED)
    for country in ("de", "DEU", "", "D\n"):
        with pytest.raises(InputError, match="country"):
            dcc_bytes(campaign, document, issued=ISSUED, country=country)
    root = ET.fromstring(dcc_bytes(campaign, document, issued=ISSUED, country="MX"))
    assert set(texts(root, ".//dcc:countryCode")) == {"MX"} and "country" not in declared(root)
    assert COUNTRY_NOT_STATED in declared(certificate())["country"][0]
    bad = {**document["effective_deg_per_step"]["left"], "value": math.inf}
    with pytest.raises(ValueError, match="finite"):
        dcc_bytes(
            campaign,
            {**document, "effective_deg_per_step": {**document["effective_deg_per_step"], "left": bad}},
            issued=ISSUED,
        )


def test_development_versions_are_cut_to_a_release():
    campaign, document = campaign_and_fit()
    for version, release in (
        ("0.1.0.dev3+g1a2b", "v0.1.0"),
        ("2026.1.0", "v0"),
        ("12", "v12"),
        ("1.2.3.4.5", "v1.2.3.4"),
    ):
        changed = {**document, "versions": {**document["versions"], "tvsbayes": version}}
        root = ET.fromstring(dcc_bytes(campaign, changed, issued=ISSUED))
        assert structure_problems(root) == [], version
        assert set(texts(root, ".//dcc:release")) == {release}


SMALL_XSD = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" xmlns:dcc="https://ptb.de/dcc"
 targetNamespace="https://ptb.de/dcc" elementFormDefault="qualified">
<xs:element name="digitalCalibrationCertificate"><xs:complexType><xs:sequence>
<xs:any maxOccurs="unbounded" processContents="skip"/></xs:sequence>
<xs:attribute name="schemaVersion" type="xs:string" fixed="VERSION"/></xs:complexType></xs:element></xs:schema>"""


def test_a_schema_that_the_user_names_is_used(tmp_path, monkeypatch):
    data = dcc_bytes(*campaign_and_fit(), issued=ISSUED)
    right, wrong, broken = (tmp_path / name for name in ("right.xsd", "wrong.xsd", "broken.xsd"))
    right.write_text(SMALL_XSD.replace("VERSION", "3.3.0"))
    wrong.write_text(SMALL_XSD.replace("VERSION", "2.4.0"))
    broken.write_text("<nothing/>")
    with pytest.raises(InputError, match="no such file"):
        check_dcc(data, tmp_path / "missing.xsd")
    for hidden in (False, True):
        if hidden:
            monkeypatch.setattr(shutil, "which", lambda name: None)
        found = check_dcc(data, right)
        if found.tool is None:
            assert found.valid is None and "install xmllint" in found.messages[0]
            continue
        assert found.valid is True
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
        found = check_dcc(data, right)
        assert (found.tool, found.valid) == ("xmllint", valid) and found.messages


@pytest.mark.skipif("TVSBAYES_DCC_SCHEMA" not in os.environ, reason="TVSBAYES_DCC_SCHEMA names no dcc.xsd")
def test_ptbs_schema_where_it_is_at_hand():
    campaign, document = campaign_and_fit()
    data = dcc_bytes(campaign, document | predicted_tables(), issued=ISSUED, report=b"<html/>")
    found = check_dcc(data, Path(os.environ["TVSBAYES_DCC_SCHEMA"]))
    assert found.valid is True, found


def test_a_failed_validation_is_declared_with_its_factor():
    campaign, document = campaign_and_fit()
    failed = {
        "passed": False,
        "level": 0.01,
        "cause": "the cameras moved: from spot 9 on",
        "inflation": 3.25,
        "tests": [],
    }
    root = ET.fromstring(dcc_bytes(campaign, {**document, "validation": failed}, issued=ISSUED))
    assert "multiply every one of them by 3.25" in declared(root)["validation"][0]
    for validation in (None, {**failed, "passed": True}):
        root = ET.fromstring(dcc_bytes(campaign, {**document, "validation": validation}, issued=ISSUED))
        assert "validation" not in declared(root)
