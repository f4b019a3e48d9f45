"""The calibration certificate of any instrument as DCC XML (schema 3.3.0 of PTB): not accredited, as the user declares.

`data/export/certificate.xml` is its template, filled with the `Content` that an instrument gives. Uncertainties to two
digits (GUM 7.2.6). Every text is escaped. A certificate is validated against a local schema that its reader names,
without network.
"""

from __future__ import annotations

import base64
import datetime
import importlib
import math
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from tvsbayes.errors import InputError, NotConverged, escaped
from tvsbayes.files.disk import shipped_data
from tvsbayes.metrology.budget_tables import PROBABILITY
from tvsbayes.metrology.traceability import NOT_STATED, Performance, Traceability, plain_text, stated_in
from tvsbayes.results.fit_record import Provenance

COUNTRY_NOT_STATED = "ZZ"
"""User-assigned code of ISO 3166-1: valid for the schema, reported by PTB's Schematron."""
NOT_ACCREDITED = (
    "This document is not an accredited calibration certificate. It was written by software from a campaign of its "
    "user in the format of the DCC schema; it is not signed, and its user alone is responsible for it."
)
ITEM_ONLY = "The results relate only to the item named here, in the state and under the conditions of the campaign."
COVERAGE = (
    "An expanded uncertainty is half the 95 % interval, its coverage factor that half over the standard uncertainty: "
    "1.96 where the posterior is normal, a little more or less where it is not."
)
CONDITIONS = {
    "basic_temperature": ("temperature_degC", "temperature", r"\degreecelsius"),
    "basic_humidityRelative": ("humidity_percent", "relative humidity", r"\percent"),
}
"""Key of `[environment]`, name and unit of the conditions that a certificate states, by their kind in the DCC."""
EXPANDED_SYMMETRY = 0.25
"""Largest distance of the middle of the 95 % interval from the value, in standard uncertainties, for an expanded
uncertainty instead of an interval."""
_RELEASE = re.compile(r"(?:[0-9]{1,3}\.){0,3}[0-9]{1,3}(?![0-9])")
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, escaped or not."""


@dataclass(frozen=True)
class Parties:
    """Issuer and customer of a certificate.

    Attributes:
        laboratory: name of the laboratory.
        customer: name of the customer.
        country: ISO 3166-1 code of the place of measurement, two capital letters.
        customer_country: code of the customer's country.
    """

    laboratory: str = NOT_STATED
    customer: str = NOT_STATED
    country: str = COUNTRY_NOT_STATED
    customer_country: str = COUNTRY_NOT_STATED


NO_PARTIES = Parties()


@dataclass(frozen=True)
class Embedded:
    """The HTML report that a certificate carries, and the number on its first page."""

    number: str
    html: bytes

    @property
    def encoded(self) -> str:
        """Return the report in base64."""
        return base64.b64encode(self.html).decode()


@dataclass(frozen=True)
class Statement:
    """A declaration with its name; `traceable` if it states whether the results are."""

    name: str
    text: str
    traceable: bool | None = None


@dataclass(frozen=True)
class Real:
    """An `si:real` of D-SI 2.2.1, with the entries of its uncertainty in the element `kind`; "" for none."""

    value: str
    unit: str
    kind: str = ""
    entries: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Quantity:
    """A named value; None where there is none."""

    name: str
    real: Real | None


@dataclass(frozen=True)
class Result:
    """A result: its quantities, and a description where it needs one."""

    name: str
    quantities: Sequence[Quantity]
    description: str = ""


def dcc_real(
    unit: str,
    value: float,
    u: float | None,
    interval95: tuple[float, float] | None = None,
    distribution: str = "normal",
) -> Real:
    """Build a number with no, a standard or an expanded uncertainty or an interval, to two digits of uncertainty."""
    numbers = [value, *(() if u is None else (u,)), *(interval95 or ())]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"a certificate needs finite numbers, not {numbers}")
    if not u:
        return Real(repr(float(value)), unit)
    low, high = interval95 or (value, value)
    expanded, middle = 0.5 * (high - low), 0.5 * (high + low)
    k = expanded / u
    # D-SI does not allow coverage factors below 1.
    symmetric = interval95 is not None and k >= 1 and abs(middle - value) <= EXPANDED_SYMMETRY * u
    # Decimals that give the uncertainty two significant digits (GUM 7.2.6).
    places = max(0, 1 - int(f"{expanded if symmetric else u:.1e}".split("e")[1]))
    text, standard = f"{value:.{places}f}", f"{u:.{places}f}"
    covered = {"coverageProbability": f"{PROBABILITY:.2f}", "distribution": distribution}
    if interval95 is None:
        return Real(text, unit, "standardMU", {"valueStandardMU": standard, "distribution": distribution})
    if symmetric:
        half = {"valueExpandedMU": f"{expanded:.{places}f}", "coverageFactor": f"{k:.2f}"}
        return Real(text, unit, "expandedMU", {**half, **covered})
    ends = {"intervalMin": f"{low:.{places}f}", "intervalMax": f"{high:.{places}f}"}
    return Real(text, unit, "coverageIntervalMU", {"valueStandardMU": standard, **ends, **covered})


@dataclass(frozen=True)
class Equipment:
    """A thing that measured; `certificate` None where it has none of its own."""

    identifier: str
    name: str
    description: str
    certificate: str | None = None
    quantities: Sequence[Quantity] = ()
    normal: bool = False


@dataclass(frozen=True)
class Content:
    """What an instrument certifies.

    Attributes:
        title: name of the campaign.
        header: keys of `campaign.toml` outside the instrument's.
        item: name of the measured object where the header has no `instrument`.
        measured: name of the result.
        scope: under which conditions it holds.
        method: name, description.
        references: norms and papers of the method, by their element.
        equipment: what measured.
        results: results.
        statements: declarations besides those that every certificate has.
        performance: when it was measured.
        traceability: of the length standard.
        provenance: how the results were made.
    """

    title: str
    header: Mapping[str, object]
    item: str
    measured: str
    scope: str
    method: tuple[str, str]
    references: Sequence[tuple[str, str]]
    equipment: Sequence[Equipment]
    results: Sequence[Result]
    statements: Sequence[Statement]
    performance: Performance
    traceability: Traceability
    provenance: Provenance


def common_statements(content: Content, parties: Parties) -> list[Statement]:
    """Declarations of every certificate."""
    statements = [
        Statement("accreditation", NOT_ACCREDITED),
        Statement("traceability", content.traceability.statement, content.traceability.declared),
        Statement("scope", ITEM_ONLY),
        *content.statements,
    ]
    if content.header.get("synthetic"):
        statements.append(Statement("synthetic data", "The campaign was simulated: no instrument was measured."))
    if not content.performance.recorded:
        text = "The campaign does not record its date; the date of issue stands for it."
        statements.append(Statement("dates", text))
    for name, country in (("country", parties.country), ("country of the customer", parties.customer_country)):
        if country == COUNTRY_NOT_STATED:
            text = f"The {name} was not stated; {COUNTRY_NOT_STATED} stands for it."
            statements.append(Statement(name, text))
    return statements


def check_certifiable(parties: Parties, *, own: bool, converged: bool) -> None:
    """Refuse inputs that allow no certificate.

    Args:
        parties: issuer and customer.
        own: whether the results belong to the data.
        converged: whether their fit has converged.

    Raises:
        InputError: a country is not a code, or the results belong to other data or priors.
        NotConverged: the fit of the results has not converged.
    """
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
    if not own:
        message = "results/fit.json belongs to other data or priors than the campaign"
        raise InputError("stale-results", message, file="fit.json", remedy=again)
    if not converged:
        raise NotConverged("not-converged", "no certificate of a fit that has not converged", remedy=again)


def certificate_xml(
    content: Content,
    identifier: str,
    *,
    issued: datetime.date,
    parties: Parties,
    report: Embedded | None,
    signed: bool = False,
) -> bytes:
    """Write DCC-schema XML: not accredited, traceable only as far as the campaign declares.

    Args:
        content: what is certified; names are used as given, as text.
        identifier: unique identifier.
        issued: date of issue; the same inputs and date give the same bytes.
        parties: laboratory, customer, countries.
        report: the HTML report to embed; its number is part of the core data.
        signed: whether a signature will be added.

    Returns:
        UTF-8 XML, DCC 3.3.0.
    """
    made = content.provenance
    # PTB's Schematron requires a letter and up to four numbers; the whole version is in the description.
    release = _RELEASE.match(made.shown_versions["tvsbayes"])
    listed = ", ".join(f"{name} {version}" for name, version in made.shown_versions.items())
    return _rendered(
        content=content,
        parties=parties,
        report=report,
        issued=issued,
        identifier=identifier,
        release=f"v{release.group() if release else '0'}",
        software=f"{listed}; seed {made.seed}; command: {made.command}",
        statements=common_statements(content, parties),
        signed=signed,
        used=" ".join(("method", "software", *(each.identifier for each in content.equipment))),
        conditions={
            refers: Quantity(name, stated(content.header, "environment", key, unit))
            for refers, (key, name, unit) in CONDITIONS.items()
        },
    )


def stated(header: Mapping[str, object], table: str, key: str, unit: str) -> Real | None:
    """A quantity of a table of `campaign.toml`; None where it is not stated."""
    found = stated_in(header, table, key)
    return None if found is None else dcc_real(unit, found.value, found.u)


def _text(value: object) -> Markup:
    """Convert a value for the schema: escaped, on one line, never empty, without characters that XML cannot hold."""
    return value if isinstance(value, Markup) else Markup(escape(plain_text(_FORBIDDEN.sub("\ufffd", str(value)))))


def _rendered(**content: object) -> bytes:
    """Fill the template with its content and indent it; parsing checks that it is well-formed."""
    environment = Environment(
        loader=FileSystemLoader(str(shipped_data() / "export")),
        autoescape=True,
        finalize=_text,
        undefined=StrictUndefined,
    )
    builder = ET.TreeBuilder()
    # Not ElementTree's parser, which would replace the prefixes.
    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(environment.get_template("certificate.xml").render(**content), True)
    root = builder.close()
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


XSD_SECONDS = 60


@dataclass(frozen=True)
class SchemaCheck:
    """Result of a schema validator: `valid` is None where nothing could be checked, for the reason in `messages`."""

    tool: str | None
    valid: bool | None
    messages: tuple[str, ...]


def check_dcc(data: bytes, schema: Path) -> SchemaCheck:
    """Validate a certificate against the schema that the user names.

    It uses xmllint if installed, else lxml; neither is a dependency. PTB's schema loads D-SI by URL: use a folder in
    which the imports are relative paths.

    Args:
        data: output of `dcc_bytes`.
        schema: path of `dcc.xsd`.

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
    return _by_lxml(data, schema) if xmllint is None else _by_xmllint(xmllint, data, schema)


def _by_xmllint(program: str, data: bytes, schema: Path) -> SchemaCheck:
    command = [program, "--nonet", "--noout", "--schema", str(Path(schema).resolve()), "-"]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=XSD_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return SchemaCheck("xmllint", None, (f"no answer within {XSD_SECONDS} s",))
    messages = tuple(done.stderr.decode("utf-8", "replace").strip().splitlines())
    # 0 valid, 3 and 4 not valid; else the schema itself could not be used (xmllint(1), "Diagnostics").
    return SchemaCheck("xmllint", {0: True, 3: False, 4: False}.get(done.returncode), messages)


def _by_lxml(data: bytes, schema: Path) -> SchemaCheck:
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
