"""The calibration certificate as DCC XML, held against the schema."""

from __future__ import annotations

import base64
import datetime
import hashlib
import importlib
import json
import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.errors import InputError, NotConverged, escaped
from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.metrology.budget_tables import PROBABILITY
from tvsbayes.metrology.iso230 import FIGURES
from tvsbayes.statistics.intervals import NORMAL_95

DCC_VERSION = "3.3.0"
DCC_NAMESPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
"""DCC 3.3.0 imports D-SI 2.2.1, whose namespace carries no version (research/report.md section 4)."""
UNIT_SI = {"deg/step": r"\degree\per\one", "deg": r"\degree", "mm": r"\milli\metre"}
"""D-SI has no unit for a count: steps are `\\one`."""
NOT_STATED = "not stated"
COUNTRY_NOT_STATED = "ZZ"
"""User-assigned in ISO 3166-1: valid for the schema, named by PTB's Schematron."""
EXPANDED_SYMMETRY = 0.25
"""Standard uncertainties by which the middle of the 95 % interval may lie off the value before an interval is given
instead of an expanded uncertainty."""
NOT_ACCREDITED = (
    "This document is not an accredited calibration certificate. It was written by software from a campaign of its "
    "user in the format of the DCC schema; it is not signed, and nobody but its user vouches for it."
)
ITEM_ONLY = "The results relate only to the item named here, in the state and under the conditions of the campaign."
METHOD = (
    "Joint Bayesian estimate of gear ratios, backlash, mirror geometry and camera pose from the pixels of laser spots "
    "seen by a calibrated stereo pair at several depths; angles are inferred through cameras and model, no angle "
    "standard measured them. Effective degrees of the beam per motor step hold at the stated pose of the mirrors. "
    "U is half the 95 % interval, k = U/u."
)
REFERENCE, NORMS = "doi:10.3390/metrology5040058", ("JCGM 100:2008", "JCGM 101:2008")
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, escaped or not."""
_RELEASE = re.compile(r"(?:[0-9]{1,3}\.){0,3}[0-9]{1,3}(?![0-9])")
_XSD_SECONDS = 60


def _plain(value: object) -> str:
    """Text that the schema takes: no character XML cannot hold, single spaces, never empty."""
    return " ".join(_FORBIDDEN.sub("\ufffd", str(value)).split()) or NOT_STATED


def _add(parent: ET.Element, tag: str, text: object | None = None, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, attributes)
    if text is not None:
        element.text = _plain(text)
    return element


def _words(parent: ET.Element, tag: str, *texts: object, **attributes: str) -> ET.Element:
    """A `textType` or `richContentType`: one `dcc:content` a paragraph."""
    element = _add(parent, tag, **attributes)
    # The Schematron allows each language once per element.
    _add(element, "dcc:content", " ".join(map(_plain, texts)), lang="en")
    return element


def _decimals(u: float) -> int:
    """Decimals at which u keeps two significant digits (GUM 7.2.6)."""
    return max(0, 1 - int(f"{u:.1e}".split("e")[1]))


def _real(
    parent: ET.Element,
    unit: str,
    value: float,
    u: float | None,
    interval95: tuple[float, float] | None = None,
    distribution: str = "normal",
) -> None:
    """An `si:real` with no, a standard, an expanded uncertainty or an interval, two digits of uncertainty."""
    numbers = [value, *(() if u is None else (u,)), *(interval95 or ())]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"a certificate needs finite numbers, not {numbers}")
    real = _add(parent, "si:real")
    if not u:
        _add(real, "si:value", repr(float(value)))
        _add(real, "si:unit", unit)
        return
    low, high = interval95 or (value, value)
    expanded, middle = 0.5 * (high - low), 0.5 * (high + low)
    k = expanded / u
    # A coverage factor below 1 is no D-SI coverage factor.
    symmetric = interval95 is not None and k >= 1 and abs(middle - value) <= EXPANDED_SYMMETRY * u
    places = _decimals(expanded if symmetric else u)
    _add(real, "si:value", f"{value:.{places}f}")
    _add(real, "si:unit", unit)
    uncertainty = _add(real, "si:measurementUncertaintyUnivariate")
    if interval95 is None:
        standard = _add(uncertainty, "si:standardMU")
        _add(standard, "si:valueStandardMU", f"{u:.{places}f}")
        _add(standard, "si:distribution", distribution)
    elif symmetric:
        box = _add(uncertainty, "si:expandedMU")
        _add(box, "si:valueExpandedMU", f"{expanded:.{places}f}")
        _add(box, "si:coverageFactor", f"{k:.2f}")
        _add(box, "si:coverageProbability", f"{PROBABILITY:.2f}")
        _add(box, "si:distribution", distribution)
    else:
        box = _add(uncertainty, "si:coverageIntervalMU")
        _add(box, "si:valueStandardMU", f"{u:.{places}f}")
        _add(box, "si:intervalMin", f"{low:.{places}f}")
        _add(box, "si:intervalMax", f"{high:.{places}f}")
        _add(box, "si:coverageProbability", f"{PROBABILITY:.2f}")
        _add(box, "si:distribution", distribution)


def _quantity(parent: ET.Element, name: str, entry: Mapping[str, object] | None, unit: str, estimator: str) -> None:
    """A measured value of `fit.json`; one that was never moved or never estimated says so instead of a number."""
    quantity = _add(parent, "dcc:quantity", refType="basic_measuredValue")
    _words(quantity, "dcc:name", name)
    if entry is None:
        _words(quantity, "dcc:noQuantity", "no value: the axis was never moved in this direction")
        return
    low, high = entry["interval95"]
    shape = "normal" if estimator == "laplace" else "sampled posterior"
    _real(quantity, UNIT_SI[unit], entry["value"], entry["sd"], (low, high), shape)


def _dates(campaign: Campaign, issued: datetime.date) -> tuple[datetime.date, datetime.date, bool]:
    """First and last day of the campaign, and whether they were recorded."""
    created = campaign.header.get("created")
    if created is None:
        return issued, issued, False
    if not isinstance(created, datetime.datetime):
        return created, created, True
    # Times of moves count from any instant: a clock, or the start of the campaign.
    seconds = campaign.moves[-1].time_s - campaign.moves[0].time_s if campaign.moves else 0.0
    try:
        return created.date(), (created + datetime.timedelta(seconds=seconds)).date(), True
    except OverflowError:
        return created.date(), created.date(), True


def _contact(parent: ET.Element, tag: str, name: str, country: str, *, place: bool = True) -> ET.Element:
    contact = _add(parent, tag)
    _words(contact, "dcc:name", name)
    if place:
        _add(_add(contact, "dcc:location"), "dcc:countryCode", country)
    return contact


def _software(parent: ET.Element, tag: str, document: Mapping[str, object], **attributes: str) -> None:
    versions = document["versions"]
    software = _add(_add(parent, tag), "dcc:software", **attributes)
    _words(software, "dcc:name", "tvsbayes")
    # PTB's Schematron wants a letter and up to four numbers; the whole version stands in the description.
    found = _RELEASE.match(str(versions["tvsbayes"]))
    _add(software, "dcc:release", f"v{found.group() if found else '0'}")
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    _words(software, "dcc:description", f"{listed}; seed {document['seed']}; command: {document['command']}")


def _administrative(
    root: ET.Element,
    campaign: Campaign,
    document: Mapping[str, object],
    issued: datetime.date,
    identifier: str,
    laboratory: str,
    customer: str,
    country: str,
) -> None:
    header = campaign.header
    data = _add(root, "dcc:administrativeData")
    _software(data, "dcc:dccSoftware", document)
    core = _add(data, "dcc:coreData")
    _add(core, "dcc:countryCodeISO3166_1", country)
    _add(core, "dcc:usedLangCodeISO639_1", "en")
    _add(core, "dcc:mandatoryLangCodeISO639_1", "en")
    _add(core, "dcc:uniqueIdentifier", identifier)
    begin, end, recorded = _dates(campaign, issued)
    _add(core, "dcc:beginPerformanceDate", begin.isoformat())
    _add(core, "dcc:endPerformanceDate", end.isoformat())
    _add(core, "dcc:performanceLocation", "other")
    _add(core, "dcc:issueDate", issued.isoformat())
    item = _add(_add(data, "dcc:items"), "dcc:item", id="item")
    _words(item, "dcc:name", header.get("instrument") or "stepper-driven two-mirror laser positioner")
    serials = _add(item, "dcc:identifications")
    for value, name in ((header.get("serial") or NOT_STATED, "serial"), (header.get("name") or NOT_STATED, "campaign")):
        identification = _add(serials, "dcc:identification")
        _add(identification, "dcc:issuer", "other")
        _add(identification, "dcc:value", value)
        _words(identification, "dcc:name", name)
    place = _add(data, "dcc:calibrationLaboratory")
    _contact(place, "dcc:contact", laboratory, country)
    for name in ("dcc:cryptElectronicSeal", "dcc:cryptElectronicSignature", "dcc:cryptElectronicTimeStamp"):
        _add(place, name, "false")
    person = _add(_add(data, "dcc:respPersons"), "dcc:respPerson")
    _contact(person, "dcc:person", str(header.get("operator") or NOT_STATED), country, place=False)
    _add(person, "dcc:role", "operator of the campaign")
    _add(person, "dcc:mainSigner", "false")
    _contact(data, "dcc:customer", customer, country)
    statements = _add(data, "dcc:statements")

    def state(name: str, text: str, traceable: bool | None = None) -> None:
        statement = _add(statements, "dcc:statement")
        _words(statement, "dcc:name", name)
        if traceable is not None:
            _add(statement, "dcc:traceable", "true" if traceable else "false")
        _words(statement, "dcc:declaration", text)

    state("accreditation", NOT_ACCREDITED)
    found = traceability(campaign)
    state("traceability", found.statement, found.declared)
    state("scope", ITEM_ONLY)
    validation = document.get("validation")
    if validation is not None and not validation["passed"]:
        text = f"VALIDATION FAILED: {validation['cause']}. Uncertainties are stated as fitted; multiply every one of "
        state("validation", f"{text}them by {validation['inflation']:.2f}.")
    if header.get("synthetic"):
        state("synthetic data", "The campaign was simulated: no instrument was measured.")
    if not recorded:
        state("dates", "The campaign does not record its date; the date of issue stands for it.")
    if country == COUNTRY_NOT_STATED:
        state("country", f"The country was not stated; {COUNTRY_NOT_STATED} stands for it.")


@dataclass(frozen=True)
class Traceability:
    """What may be said of traceability.

    Attributes:
        statement: a sentence for certificates and reports.
        declared: the campaign names the certificate of its length standard, which nobody checks here.
    """

    statement: str
    declared: bool


def traceability(campaign: Campaign) -> Traceability:
    """The campaign's word on its length standard, passed on, not checked; simulated data are never traceable."""
    declared = campaign.header.get("traceability", {})
    certificate = _plain(declared.get("board_certificate", ""))
    if campaign.header.get("synthetic"):
        return Traceability("Simulated data: not traceable.", False)
    if certificate == NOT_STATED:
        text = "Not traceable: the campaign names no certificate of the length standard (the calibration board)."
        return Traceability(text, False)
    text = f"As declared by the user and not verified here: length from the board with certificate {certificate}."
    return Traceability(text, True)


def _equipment(parent: ET.Element, campaign: Campaign) -> None:
    declared = campaign.header.get("traceability", {})
    stereo = campaign.stereo
    listed = _add(parent, "dcc:measuringEquipments")
    cameras = _add(listed, "dcc:measuringEquipment", id="cameras")
    _words(cameras, "dcc:name", "stereo camera pair")
    text = f"2 x {stereo.image_width} x {stereo.image_height} px, calibration residual {stereo.rms_px:.3g} px rms"
    if stereo.assumed:
        text += "; covariance of the calibration assumed, not estimated"
    if "stereo_calibrated" in declared:
        text += f"; calibrated {declared['stereo_calibrated']}"
    _words(cameras, "dcc:description", text)
    board = _add(listed, "dcc:measuringEquipment", id="board", refType="basic_normalUsed")
    _words(board, "dcc:name", "calibration board (length standard)")
    identification = _add(_add(board, "dcc:identifications"), "dcc:identification")
    _add(identification, "dcc:issuer", "other")
    _add(identification, "dcc:value", declared.get("board_certificate", NOT_STATED))
    _words(identification, "dcc:name", "certificate as declared by the user")
    if "pitch_mm" in declared:
        quantity = _add(_add(board, "dcc:measuringEquipmentQuantities"), "dcc:measuringEquipmentQuantity")
        _words(quantity, "dcc:name", "pitch")
        _real(quantity, UNIT_SI["mm"], declared["pitch_mm"]["value"], declared["pitch_mm"]["u"])


def _conditions(parent: ET.Element, campaign: Campaign) -> None:
    stated = campaign.header.get("environment", {})
    conditions = _add(parent, "dcc:influenceConditions")
    for key, name, unit, kind in (
        ("temperature_degC", "temperature", r"\degreecelsius", "basic_temperature"),
        ("humidity_percent", "relative humidity", r"\percent", "basic_humidityRelative"),
    ):
        condition = _add(conditions, "dcc:influenceCondition", refType=kind)
        _words(condition, "dcc:name", name)
        data = _add(condition, "dcc:data")
        if key in stated:
            quantity = _add(data, "dcc:quantity", refType="basic_measuredValue")
            _words(quantity, "dcc:name", name)
            _real(quantity, unit, stated[key]["value"], stated[key]["u"])
        else:
            _words(data, "dcc:text", "not recorded")


def certificate_identifier(campaign: Campaign, document: Mapping[str, object], issued: datetime.date) -> str:
    """A name that data, priors, results and date determine: `tvsbayes-` and 32 hexadecimal digits."""
    results = {key: document[key] for key in ("inputs", "effective_deg_per_step", "parameters", "estimator")}
    text = json.dumps([results, str(campaign.header.get("name")), issued.isoformat()], sort_keys=True)
    return f"tvsbayes-{hashlib.sha256(text.encode()).hexdigest()[:32]}"


def dcc_bytes(
    campaign: Campaign,
    document: Mapping[str, object],
    *,
    issued: datetime.date,
    identifier: str | None = None,
    laboratory: str = NOT_STATED,
    customer: str = NOT_STATED,
    country: str = COUNTRY_NOT_STATED,
    report: bytes | None = None,
) -> bytes:
    """DCC-schema XML of a fit: unsigned, not accredited, traceable only as far as the campaign declares.

    Args:
        campaign: what was fitted; names are taken as given and stay text.
        document: content of `results/fit.json`.
        issued: date of issue; the same inputs and date give the same bytes.
        identifier: unique identifier; None makes one from inputs, results and date.
        laboratory: name of who measured.
        customer: name of for whom.
        country: ISO 3166-1 code of the place, two capital letters.
        report: the HTML report to embed.

    Returns:
        UTF-8 XML, DCC 3.3.0.

    Raises:
        InputError: a country that is no code, or results of other data or priors than the campaign's.
        NotConverged: the fit behind the results has not converged.
    """
    if not re.fullmatch("[A-Z]{2}", country):
        raise InputError(
            "country",
            f"country {escaped(country)!r}",
            column="country",
            found=escaped(country),
            allowed="two capital letters of ISO 3166-1, such as MX or DE",
            remedy="give the country in which the campaign was measured",
        )
    if document["inputs"] != input_hashes(campaign):
        raise InputError(
            "stale-results",
            "results/fit.json belongs to other data or priors than the campaign",
            file="fit.json",
            remedy="run `tvsbayes fit` on the campaign again",
        )
    if not document["converged"]:
        raise NotConverged(
            "not-converged",
            "no certificate of a fit that has not converged",
            remedy="run `tvsbayes fit` on the campaign again",
        )
    names = {f"xmlns:{prefix}": uri for prefix, uri in DCC_NAMESPACES.items()}
    # Prefixes are written out: registering them would change ElementTree for the whole process.
    root = ET.Element("dcc:digitalCalibrationCertificate", {**names, "schemaVersion": DCC_VERSION})
    name = identifier or certificate_identifier(campaign, document, issued)
    _administrative(root, campaign, document, issued, name, laboratory, customer, country)
    part = _add(_add(root, "dcc:measurementResults"), "dcc:measurementResult", refId="item")
    _words(part, "dcc:name", "degrees of beam per motor step, and backlash")
    estimator, pose = str(document["estimator"]), document["reference_pose_deg"]
    where = f"at mirror angles pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    kind = "posterior draws" if estimator == "posterior" else "the Laplace approximation of the posterior"
    _words(part, "dcc:description", f"Effective ratios hold {where}. Values and intervals from {kind}.")
    method = _add(_add(part, "dcc:usedMethods"), "dcc:usedMethod", id="method")
    _words(method, "dcc:name", "joint estimate from stereo spots")
    texts = [METHOD, *(f"Method as named by the user: {t}" for t in [campaign.header.get("method")] if t)]
    _words(method, "dcc:description", *texts)
    for norm in NORMS:
        _add(method, "dcc:norm", norm)
    _add(method, "dcc:reference", REFERENCE)
    _software(part, "dcc:usedSoftware", document, id="software")
    _equipment(part, campaign)
    _conditions(part, campaign)
    results = _add(part, "dcc:results")
    data = _result(results, "effective degrees of beam per motor step")
    for direction, entry in document["effective_deg_per_step"].items():
        _quantity(data, f"effective degrees per step, {direction}", entry, "deg/step", estimator)
    data = _result(results, "backlash")
    for axis in AXES:
        moved = any(document["effective_deg_per_step"][d] is not None for d in SIDES[axis])
        entry = document["parameters"][f"backlash_deg.{axis}"] if moved else None
        _quantity(data, f"backlash of the {axis} axis", entry, "deg", estimator)
    for table in document.get("positioning", ()):
        _positioning_result(results, table)
    if report is not None:
        embedded = _add(root, "dcc:document")
        _add(embedded, "dcc:fileName", "report.html")
        _add(embedded, "dcc:mimeType", "text/html")
        _add(embedded, "dcc:dataBase64", base64.b64encode(report).decode())
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _result(results: ET.Element, name: str, *texts: str) -> ET.Element:
    """A result with its data element; it refers to method, software and equipment of the section."""
    result = _add(results, "dcc:result", refId="method software cameras board")
    _words(result, "dcc:name", name)
    if texts:
        _words(result, "dcc:description", *texts)
    return _add(result, "dcc:data")


def _positioning_result(results: ET.Element, table: Mapping[str, object]) -> None:
    if table["predicted"] is None:
        return
    notes = "; ".join(table["notes"])
    data = _result(results, f"ISO 230-2-style figures of the {table['axis']} axis, posterior predictive", notes)
    for name, (symbol, term) in FIGURES.items():
        found = table["predicted"][name]
        quantity = _add(data, "dcc:quantity", refType="basic_measuredValue")
        _words(quantity, "dcc:name", f"{symbol}, {term}")
        low, high = found["interval95"]
        # Medians and intervals of a simulation: the half width over 1.96 stands for u.
        _real(quantity, UNIT_SI["deg"], found["median"], (high - low) / (2 * NORMAL_95), (low, high), "simulated tests")


@dataclass(frozen=True)
class SchemaCheck:
    """What a schema validator said: `valid` is None where nothing could be checked, and `messages` say why."""

    tool: str | None
    valid: bool | None
    messages: tuple[str, ...]


def check_dcc(data: bytes, schema: Path) -> SchemaCheck:
    """Validate a certificate against the schema that the user names, without any network.

    xmllint where it is installed, else lxml; neither is a dependency. PTB's schema loads D-SI by URL: point to a folder
    in which the imports are relative paths.

    Args:
        data: of `dcc_bytes`.
        schema: `dcc.xsd`.

    Raises:
        InputError: there is no such file.
    """
    if not Path(schema).is_file():
        raise InputError(
            "missing-file",
            f"{escaped(str(schema), 200)}: no such file",
            file=escaped(str(schema), 200),
            remedy="give the path of dcc.xsd",
        )
    xmllint = shutil.which("xmllint")
    if xmllint:
        command = [xmllint, "--nonet", "--noout", "--schema", str(Path(schema).resolve()), "-"]
        try:
            done = subprocess.run(command, input=data, capture_output=True, timeout=_XSD_SECONDS, check=False)
        except subprocess.TimeoutExpired:
            return SchemaCheck("xmllint", None, (f"no answer within {_XSD_SECONDS} s",))
        messages = tuple(done.stderr.decode("utf-8", "replace").strip().splitlines())
        # 0 valid, 3 and 4 not valid; else the schema itself could not be used (xmllint(1), "Diagnostics").
        return SchemaCheck("xmllint", {0: True, 3: False, 4: False}.get(done.returncode), messages)
    try:
        etree = importlib.import_module("lxml.etree")
    except ImportError:
        return SchemaCheck(None, None, ("not checked: install xmllint (libxml2) or lxml to validate",))
    parser = etree.XMLParser(no_network=True, resolve_entities=False)
    try:
        checker = etree.XMLSchema(etree.parse(str(schema), parser))
    except (etree.XMLSchemaParseError, etree.XMLSyntaxError) as error:
        return SchemaCheck("lxml", None, (str(error),))
    valid = bool(checker.validate(etree.fromstring(data, parser)))
    return SchemaCheck("lxml", valid, tuple(str(entry) for entry in checker.error_log))
