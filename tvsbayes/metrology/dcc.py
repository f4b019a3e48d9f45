"""The calibration certificate as DCC XML (schema 3.3.0 of PTB): unsigned, not accredited, of a campaign's own words.

Ratios in degrees per step, backlash in degrees, lengths in mm; uncertainties to two digits (GUM 7.2.6). Every text is
escaped by ElementTree and stays text.
"""

from __future__ import annotations

import base64
import datetime
import re
import xml.etree.ElementTree as ET
from dataclasses import astuple, dataclass

from tvsbayes.errors import InputError, NotConverged, escaped
from tvsbayes.instrument.axes import AXES, SIDES
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.metrology.dcc_elements import UNIT_SI, add, add_contact, add_real, add_words
from tvsbayes.metrology.traceability import (
    NOT_STATED,
    Performance,
    header_table,
    performed,
    stated_value,
    traceability,
)
from tvsbayes.results.estimates import Estimate
from tvsbayes.results.fit_record import FitRecord, Provenance
from tvsbayes.results.metrology_tables import FIGURES, AxisPositioning
from tvsbayes.statistics.intervals import NORMAL_95

DCC_VERSION = "3.3.0"
DCC_NAMESPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
"""DCC 3.3.0 imports D-SI 2.2.1, whose namespace carries no version."""
COUNTRY_NOT_STATED = "ZZ"
"""User-assigned in ISO 3166-1: valid for the schema, named by PTB's Schematron."""
NOT_ACCREDITED = (
    "This document is not an accredited calibration certificate. It was written by software from a campaign of its "
    "user in the format of the DCC schema; it is not signed, and nobody but its user vouches for it."
)
ITEM_ONLY = "The results relate only to the item named here, in the state and under the conditions of the campaign."
COVERAGE = (
    "An expanded uncertainty is half the 95 % interval, its coverage factor that half over the standard uncertainty: "
    "1.96 where the posterior is normal, a little more or less where it is not."
)
METHOD = (
    "Joint Bayesian estimate of gear ratios, backlash, mirror geometry and camera pose from the pixels of laser spots "
    "seen by a calibrated stereo pair at several depths; angles are inferred through cameras and model, no angle "
    "standard measured them. Effective degrees of the beam per motor step hold at the stated pose of the mirrors. "
    "U is half the 95 % interval, k = U/u."
)
REFERENCE, NORMS = "doi:10.3390/metrology5040058", ("JCGM 100:2008", "JCGM 101:2008")
_RELEASE = re.compile(r"(?:[0-9]{1,3}\.){0,3}[0-9]{1,3}(?![0-9])")
_RESULT_TITLE = "degrees of beam per motor step, and backlash"


@dataclass(frozen=True)
class Parties:
    """Who issues a certificate for whom.

    Attributes:
        laboratory: name of who measured.
        customer: name of for whom.
        country: ISO 3166-1 code of the place where it was measured, two capital letters.
        customer_country: the same of the customer.
    """

    laboratory: str = NOT_STATED
    customer: str = NOT_STATED
    country: str = COUNTRY_NOT_STATED
    customer_country: str = COUNTRY_NOT_STATED


@dataclass(frozen=True)
class Embedded:
    """The HTML report that a certificate carries, and the number on its first page."""

    number: str
    html: bytes


@dataclass(frozen=True)
class _Core:
    """By what a certificate is known: its identifier, its day of issue, the number of the report that it carries."""

    identifier: str
    issued: datetime.date
    report: str | None


def _software(parent: ET.Element, tag: str, made: Provenance, **attributes: str) -> None:
    software = add(add(parent, tag), "dcc:software", **attributes)
    add_words(software, "dcc:name", "tvsbayes")
    # PTB's Schematron wants a letter and up to four numbers; the whole version stands in the description.
    release = _RELEASE.match(made.versions["tvsbayes"])
    add(software, "dcc:release", f"v{release.group() if release else '0'}")
    listed = ", ".join(f"{name} {version}" for name, version in made.versions.items())
    add_words(software, "dcc:description", f"{listed}; seed {made.seed}; command: {made.command}")


def _administrative(root: ET.Element, campaign: Campaign, fit: FitRecord, core: _Core, parties: Parties) -> None:
    data = add(root, "dcc:administrativeData")
    _software(data, "dcc:dccSoftware", fit.provenance)
    when = performed(campaign, core.issued)
    _core_data(data, core, when, parties.country)
    _item(data, campaign)
    place = add(data, "dcc:calibrationLaboratory")
    add_contact(place, "dcc:contact", parties.laboratory, parties.country)
    for name in ("dcc:cryptElectronicSeal", "dcc:cryptElectronicSignature", "dcc:cryptElectronicTimeStamp"):
        add(place, name, "false")
    person = add(add(data, "dcc:respPersons"), "dcc:respPerson")
    add_contact(person, "dcc:person", str(campaign.header.get("operator") or NOT_STATED))
    add(person, "dcc:role", "operator of the campaign")
    add(person, "dcc:mainSigner", "false")
    add_contact(data, "dcc:customer", parties.customer, parties.customer_country)
    _statements(data, campaign, fit, when, parties)


def _core_data(data: ET.Element, named: _Core, when: Performance, country: str) -> None:
    core = add(data, "dcc:coreData")
    add(core, "dcc:countryCodeISO3166_1", country)
    add(core, "dcc:usedLangCodeISO639_1", "en")
    add(core, "dcc:mandatoryLangCodeISO639_1", "en")
    add(core, "dcc:uniqueIdentifier", named.identifier)
    if named.report is not None:
        number = add(add(core, "dcc:identifications"), "dcc:identification")
        add(number, "dcc:issuer", "calibrationLaboratory")
        add(number, "dcc:value", named.report)
        add_words(number, "dcc:name", "number of the report")
    add(core, "dcc:beginPerformanceDate", when.begin.isoformat())
    add(core, "dcc:endPerformanceDate", when.end.isoformat())
    add(core, "dcc:performanceLocation", "other")
    add(core, "dcc:issueDate", named.issued.isoformat())


def _item(data: ET.Element, campaign: Campaign) -> None:
    header = campaign.header
    item = add(add(data, "dcc:items"), "dcc:item", id="item")
    add_words(item, "dcc:name", header.get("instrument") or "stepper-driven two-mirror laser positioner")
    serials = add(item, "dcc:identifications")
    for value, name in ((header.get("serial") or NOT_STATED, "serial"), (campaign.title, "campaign")):
        identification = add(serials, "dcc:identification")
        add(identification, "dcc:issuer", "other")
        add(identification, "dcc:value", value)
        add_words(identification, "dcc:name", name)


def _statements(data: ET.Element, campaign: Campaign, fit: FitRecord, when: Performance, parties: Parties) -> None:
    statements = add(data, "dcc:statements")

    def state(name: str, text: str, traceable: bool | None = None) -> None:
        statement = add(statements, "dcc:statement")
        add_words(statement, "dcc:name", name)
        if traceable is not None:
            add(statement, "dcc:traceable", "true" if traceable else "false")
        add_words(statement, "dcc:declaration", text)

    state("accreditation", NOT_ACCREDITED)
    trace = traceability(campaign)
    state("traceability", trace.statement, trace.declared)
    state("scope", ITEM_ONLY)
    validation = fit.summary.validation
    if validation is not None and not validation.passed:
        text = f"VALIDATION FAILED: {validation.cause}. Uncertainties are stated as fitted; multiply every one of "
        state("validation", f"{text}them by {validation.inflation:.2f}.")
    if campaign.header.get("synthetic"):
        state("synthetic data", "The campaign was simulated: no instrument was measured.")
    if not when.recorded:
        state("dates", "The campaign does not record its date; the date of issue stands for it.")
    for name, country in (("country", parties.country), ("country of the customer", parties.customer_country)):
        if country == COUNTRY_NOT_STATED:
            state(name, f"The {name} was not stated; {COUNTRY_NOT_STATED} stands for it.")


def _equipment(parent: ET.Element, campaign: Campaign) -> None:
    declared, stereo = header_table(campaign, "traceability"), campaign.stereo
    listed = add(parent, "dcc:measuringEquipments")
    cameras = add(listed, "dcc:measuringEquipment", id="cameras")
    add_words(cameras, "dcc:name", "stereo camera pair")
    text = f"2 x {stereo.image_width} x {stereo.image_height} px, calibration residual {stereo.rms_px:.3g} px rms"
    if stereo.assumed:
        text += "; covariance of the calibration assumed, not estimated"
    if "stereo_calibrated" in declared:
        text += f"; calibrated {declared['stereo_calibrated']}"
    add_words(cameras, "dcc:description", text)
    board = add(listed, "dcc:measuringEquipment", id="board", refType="basic_normalUsed")
    add_words(board, "dcc:name", "calibration board (length standard)")
    identification = add(add(board, "dcc:identifications"), "dcc:identification")
    add(identification, "dcc:issuer", "other")
    add(identification, "dcc:value", declared.get("board_certificate", NOT_STATED))
    add_words(identification, "dcc:name", "certificate as declared by the user")
    pitch = stated_value(campaign, "traceability", "pitch_mm")
    if pitch is not None:
        quantity = add(add(board, "dcc:measuringEquipmentQuantities"), "dcc:measuringEquipmentQuantity")
        add_words(quantity, "dcc:name", "pitch")
        add_real(quantity, UNIT_SI["mm"], pitch.value, pitch.u)


def _conditions(parent: ET.Element, campaign: Campaign) -> None:
    conditions = add(parent, "dcc:influenceConditions")
    for key, name, unit, kind in (
        ("temperature_degC", "temperature", r"\degreecelsius", "basic_temperature"),
        ("humidity_percent", "relative humidity", r"\percent", "basic_humidityRelative"),
    ):
        condition = add(conditions, "dcc:influenceCondition", refType=kind)
        add_words(condition, "dcc:name", name)
        data = add(condition, "dcc:data")
        stated = stated_value(campaign, "environment", key)
        if stated is not None:
            quantity = add(data, "dcc:quantity", refType="basic_measuredValue")
            add_words(quantity, "dcc:name", name)
            add_real(quantity, unit, stated.value, stated.u)
        else:
            add_words(data, "dcc:text", "not recorded")


def _check_certifiable(campaign: Campaign, fit: FitRecord, parties: Parties) -> None:
    """Refuse what no certificate may be made of; errors as in `dcc_bytes`."""
    where = "in which the campaign was measured", "of the customer"
    for country, place in zip((parties.country, parties.customer_country), where, strict=True):
        if not re.fullmatch("[A-Z]{2}", country):
            raise InputError(
                "country",
                f"country {escaped(country)!r}",
                column="country",
                found=escaped(country),
                allowed="two capital letters of ISO 3166-1, such as MX or DE",
                remedy=f"write the two letters of the country {place}: MX for Mexico",
            )
    again = "run `tvsbayes fit` on the campaign again"
    if fit.provenance.inputs != input_hashes(campaign):
        message = "results/fit.json belongs to other data or priors than the campaign"
        raise InputError("stale-results", message, file="fit.json", remedy=again)
    if not fit.summary.converged:
        raise NotConverged("not-converged", "no certificate of a fit that has not converged", remedy=again)


def dcc_bytes(
    campaign: Campaign,
    fit: FitRecord,
    *,
    issued: datetime.date,
    identifier: str | None = None,
    parties: Parties = Parties(),
    report: Embedded | None = None,
) -> bytes:
    """DCC-schema XML of a fit: unsigned, not accredited, traceable only as far as the campaign declares.

    Args:
        campaign: what was fitted; names are taken as given and stay text.
        fit: its `results/fit.json`.
        issued: date of issue; the same inputs and date give the same bytes.
        identifier: unique identifier; None makes one from results, name, date, parties and report.
        parties: laboratory, customer, countries.
        report: the HTML report to embed; its number stands among the core data.

    Returns:
        UTF-8 XML, DCC 3.3.0.

    Raises:
        InputError: a country that is no code, or results of other data or priors than the campaign's.
        NotConverged: the fit behind the results has not converged.
    """
    _check_certifiable(campaign, fit, parties)
    names = {f"xmlns:{prefix}": uri for prefix, uri in DCC_NAMESPACES.items()}
    # Prefixes are written out: registering them would change ElementTree for the whole process.
    root = ET.Element("dcc:digitalCalibrationCertificate", {**names, "schemaVersion": DCC_VERSION})
    number = None if report is None else report.number
    besides = [campaign.title, *astuple(parties), number]
    core = _Core(identifier or fit.certificate_id(issued, besides), issued, number)
    _administrative(root, campaign, fit, core, parties)
    _measurement(root, campaign, fit)
    if report is not None:
        embedded = add(root, "dcc:document")
        add_words(embedded, "dcc:name", f"report {report.number}")
        add(embedded, "dcc:fileName", "report.html")
        add(embedded, "dcc:mimeType", "text/html")
        add(embedded, "dcc:dataBase64", base64.b64encode(report.html).decode())
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _measurement(root: ET.Element, campaign: Campaign, fit: FitRecord) -> None:
    """Method, equipment, conditions and the results themselves."""
    summary = fit.summary
    part = add(add(root, "dcc:measurementResults"), "dcc:measurementResult", refId="item")
    add_words(part, "dcc:name", _RESULT_TITLE)
    pose = summary.reference_pose_deg
    where = f"at mirror angles pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} deg"
    kind = "posterior draws" if summary.estimator == "posterior" else "the Laplace approximation of the posterior"
    scope = f"Effective ratios hold {where}. Values and intervals from {kind}. {COVERAGE}"
    add_words(part, "dcc:description", scope)
    method = add(add(part, "dcc:usedMethods"), "dcc:usedMethod", id="method")
    add_words(method, "dcc:name", "joint estimate from stereo spots")
    texts = [METHOD, *(f"Method as named by the user: {t}" for t in [campaign.header.get("method")] if t)]
    add_words(method, "dcc:description", *texts)
    for norm in NORMS:
        add(method, "dcc:norm", norm)
    add(method, "dcc:reference", REFERENCE)
    _software(part, "dcc:usedSoftware", fit.provenance, id="software")
    _equipment(part, campaign)
    _conditions(part, campaign)
    results = add(part, "dcc:results")
    data = _result(results, "effective degrees of beam per motor step")
    for direction, entry in summary.effective.items():
        _quantity(data, f"effective degrees per step, {direction}", entry, "deg/step", summary.estimator)
    data = _result(results, "backlash")
    for axis in AXES:
        moved = any(summary.effective[d] is not None for d in SIDES[axis])
        play = summary.parameters[f"backlash_deg.{axis}"] if moved else None
        _quantity(data, f"backlash of the {axis} axis", play, "deg", summary.estimator)
    for table in () if fit.evidence is None else fit.evidence.positioning:
        _positioning_result(results, table)


def _result(results: ET.Element, name: str, *texts: str) -> ET.Element:
    """A result with its data element; it refers to method, software and equipment of the section."""
    result = add(results, "dcc:result", refId="method software cameras board")
    add_words(result, "dcc:name", name)
    if texts:
        add_words(result, "dcc:description", *texts)
    return add(result, "dcc:data")


def _quantity(parent: ET.Element, name: str, estimate: Estimate | None, unit: str, estimator: str) -> None:
    """A measured value; one that was never moved or never estimated says so instead of a number."""
    quantity = add(parent, "dcc:quantity", refType="basic_measuredValue")
    add_words(quantity, "dcc:name", name)
    if estimate is None:
        add_words(quantity, "dcc:noQuantity", "no value: the axis was never moved in this direction")
        return
    shape = "normal" if estimator == "laplace" else "sampled posterior"
    add_real(quantity, UNIT_SI[unit], estimate.value, estimate.sd, estimate.interval95, shape)


def _positioning_result(results: ET.Element, table: AxisPositioning) -> None:
    if table.predicted is None:
        return
    title = f"ISO 230-2-style figures of the {table.axis} axis, posterior predictive"
    data = _result(results, title, "; ".join(table.notes))
    for name, (symbol, term) in FIGURES.items():
        figure = table.predicted[name]
        quantity = add(data, "dcc:quantity", refType="basic_measuredValue")
        add_words(quantity, "dcc:name", f"{symbol}, {term}")
        low, high = figure.interval95
        # Medians and intervals of a simulation: the half width over 1.96 stands for u.
        u = (high - low) / (2 * NORMAL_95)
        add_real(quantity, UNIT_SI["deg"], figure.median, u, figure.interval95, "simulated tests")
