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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import escape

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from tvsbayes.errors import InputError, NotConverged, escaped
from tvsbayes.files.disk import shipped_data
from tvsbayes.metrology.budget_tables import PROBABILITY
from tvsbayes.metrology.traceability import (
    NOT_STATED,
    Measured,
    Performance,
    Traceability,
    performed,
    plain_text,
    stated_value,
)
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


class Parties(NamedTuple):
    """Issuer and customer of a certificate, and ISO 3166-1 codes, two capital letters, of the countries.

    `country` is that of the measurement.
    """

    laboratory: str = NOT_STATED
    customer: str = NOT_STATED
    country: str = COUNTRY_NOT_STATED
    customer_country: str = COUNTRY_NOT_STATED


NO_PARTIES = Parties()


class Embedded(NamedTuple):
    """The HTML report that a certificate carries, and the number on its first page."""

    number: str
    html: bytes

    @property
    def encoded(self) -> str:
        """Return the report in base64."""
        return base64.b64encode(self.html).decode()


class Issue(NamedTuple):
    """An issue of a certificate: its day, for and by whom, the report to embed, whether a signature will be added.

    The same inputs and issue give the same bytes. The report's number is part of the core data.
    """

    issued: datetime.date
    parties: Parties = NO_PARTIES
    report: Embedded | None = None
    signed: bool = False


class Statement(NamedTuple):
    """A declaration with its name; `traceable` if it states whether the results are."""

    name: str
    text: str
    traceable: bool | None = None


class Real(NamedTuple):
    """An `si:real` of D-SI 2.2.1, with the entries of its uncertainty in the element `kind`; "" for none."""

    value: str
    unit: str
    kind: str = ""
    entries: Mapping[str, str] = {}


class Quantity(NamedTuple):
    """A named value; None where there is none."""

    name: str
    real: Real | None


class Result(NamedTuple):
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


class Equipment(NamedTuple):
    """A thing that measured; `certificate` None where it has none of its own."""

    identifier: str
    name: str
    description: str
    certificate: str | None = None
    quantities: Sequence[Quantity] = ()
    normal: bool = False


class Content(NamedTuple):
    """What an instrument certifies.

    Attributes:
        item: name of the measured object where the header has no `instrument`.
        measured: name of the result.
        scope: under which conditions it holds.
        method: name, description.
        references: norms and papers of the method, by their element.
        equipment: what measured.
        results: results.
        statements: declarations besides those that every certificate has.
        traceability: of the length standard.
        provenance: how the results were made.
    """

    item: str
    measured: str
    scope: str
    method: tuple[str, str]
    references: Sequence[tuple[str, str]]
    equipment: Sequence[Equipment]
    results: Iterable[Result]
    statements: Iterable[Statement]
    traceability: Traceability
    provenance: Provenance


def common_statements(
    content: Content, parties: Parties, *, synthetic: bool, performance: Performance
) -> Iterator[Statement]:
    """Declarations of every certificate."""
    yield Statement("accreditation", NOT_ACCREDITED)
    yield Statement("traceability", content.traceability.statement, content.traceability.declared)
    yield Statement("scope", ITEM_ONLY)
    yield from content.statements
    if synthetic:
        yield Statement("synthetic data", "The campaign was simulated: no instrument was measured.")
    if not performance.recorded:
        yield Statement("dates", "The campaign does not record its date; the date of issue stands for it.")
    for name, country in (("country", parties.country), ("country of the customer", parties.customer_country)):
        if country == COUNTRY_NOT_STATED:
            yield Statement(name, f"The {name} was not stated; {COUNTRY_NOT_STATED} stands for it.")


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


def certificate_xml(content: Content, campaign: Measured, title: str, identifier: str, issue: Issue) -> bytes:
    """Write DCC-schema XML: not accredited, traceable only as far as the campaign declares.

    Args:
        content: what is certified; names are used as given, as text.
        campaign: the measured campaign.
        title: its name.
        identifier: unique identifier.
        issue: see there.

    Returns:
        UTF-8 XML, DCC 3.3.0.
    """
    made, header, when = content.provenance, campaign.header, performed(campaign, issue.issued)
    # PTB's Schematron requires a letter and up to four numbers; the whole version is in the description.
    release = _RELEASE.match(made.shown_versions["tvsbayes"])
    listed = ", ".join(f"{name} {version}" for name, version in made.shown_versions.items())
    named = f" Method as named by the user: {header['method']}" if header.get("method") else ""
    synthetic = bool(header.get("synthetic"))
    return _rendered(
        **issue._asdict(),
        content=content,
        title=title,
        header=header,
        performance=when,
        named=named,
        identifier=identifier,
        release=f"v{release.group() if release else '0'}",
        software=f"{listed}; seed {made.seed}; command: {made.command}",
        statements=common_statements(content, issue.parties, synthetic=synthetic, performance=when),
        used=" ".join(("method", "software", *(each.identifier for each in content.equipment))),
        conditions={
            refers: Quantity(name, stated(campaign, "environment", key, unit))
            for refers, (key, name, unit) in CONDITIONS.items()
        },
    )


def stated(campaign: Measured, table: str, key: str, unit: str) -> Real | None:
    """A quantity of a table of `campaign.toml`; None where it is not stated."""
    found = stated_value(campaign, table, key)
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
