"""Rules of the DCC schema for a certificate, as far as one is written here: order, number and content of elements."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

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
"""Children in order, of DCC 3.3.0 and D-SI 2.2.1 as far as we write them (order of the
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
    faults = []
    si = {"real", *ORDER["real"].replace("?", "").split(), "measurementUncertaintyUnivariate", "standardMU"}
    si |= {"expandedMU", "coverageIntervalMU", "distribution", "intervalMin", "intervalMax"}
    si |= {"valueStandardMU", "valueExpandedMU", "coverageFactor", "coverageProbability"}
    parent = {child: element for element in root.iter() for child in element}
    for element in root.iter():
        name = local(element)
        inside = parent.get(element)
        is_si = name in si and not (name == "value" and local(inside) == "identification")
        if not element.tag.startswith(URI["si" if is_si else "dcc"]):
            faults.append(f"{element.tag}: wrong namespace")
        children = "".join(local(child) + " " for child in element)
        if name in ORDER:
            pattern = re.sub(r"[A-Za-z_0-9]+", lambda m: f"(?:{m.group()} )", ORDER[name]).replace(" )", "\0")
            pattern = pattern.replace(" ", "").replace("\0", " )")
            if not re.fullmatch(pattern, children):
                faults.append(f"{name}: children {children}")
            if (element.text or "").strip():
                faults.append(f"{name}: text between elements")
            continue
        if children:
            faults.append(f"{name}: unknown to the table of children: {children}")
        leaf = NOT_EMPTY if name == "value" and not is_si else NUMBER if name == "value" else LEAVES.get(name)
        if leaf is None or not re.fullmatch(leaf, element.text or ""):
            faults.append(f"{name}: content {element.text!r}")
    ids = [e.get("id") for e in root.iter() if e.get("id")]
    references = {r for e in root.iter() for r in (e.get("refId") or "").split()}
    if len(ids) != len(set(ids)) or set(ids) != references:
        faults.append(f"ids {ids} against references {references}")
    languages = {e.get("lang") for e in root.iter(URI["dcc"] + "content")}
    if languages != {e.text for e in root.iter(URI["dcc"] + "usedLangCodeISO639_1")}:
        faults.append(f"languages {languages}")
    if any(list(map(local, e)).count("content") > 1 for e in root.iter()):
        faults.append("a language twice")
    known = {"id", "refId", "refType", "lang"}
    for element in root.iter():
        if element is not root and set(element.attrib) - known:
            faults.append(f"{element.tag}: attributes {element.attrib}")
    return faults
