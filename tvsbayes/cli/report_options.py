"""Options of `report` for limits and certificates, of any instrument."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tvsbayes.cli.app import check_word, refuse_options
from tvsbayes.cli.report_page import WrittenPage
from tvsbayes.errors import InputError, escaped
from tvsbayes.files.disk import read_bytes, write_atomically

if TYPE_CHECKING:
    from tvsbayes.metrology.conformity import Tolerance
    from tvsbayes.metrology.dcc import Embedded, Parties
    from tvsbayes.report.document import Issue

DCC_MESSAGES = 20
"""Largest number of messages of a schema validator to show."""
KEY_BYTES_MAX = 65_536
_NUMBER = re.compile(r"\s*([0-9]*[.,]?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(\S.*)?")


def tolerance_of(
    text: str | None, of: str | None, rule: str | None, guard: float | None, names: Mapping[str, tuple[str, str]]
) -> Tolerance | None:
    """The tolerance that the options state; None where they state none.

    Args:
        text: limit with or without a unit.
        of: what it limits.
        rule: decision rule.
        guard: guard band in standard uncertainties.
        names: name and unit of what can be limited, by what the user may write, in small letters.

    Raises:
        InputError: an option is missing, or has no meaning here.
    """
    from tvsbayes.metrology.conformity import GUARD_DEFAULT, RULES, Tolerance

    if text is None:
        refuse_options("for a tolerance", "add --tolerance", of=of, rule=rule, guard=guard)
        return None
    allowed = ", ".join(names)
    key = " ".join(re.split(r"[\s._-]+", (of or "").strip().lower()))
    if key not in names:
        found = "--tolerance needs --of" if of is None else f"--of {escaped(of)}"
        raise InputError("usage", found, column="--of", allowed=allowed, remedy=f"name one of {allowed}")
    check_word("--rule", rule, RULES, "simple: without uncertainty; guarded: less the guard band; probability: 0.95")
    name, unit = names[key]
    chosen = rule or "guarded"
    if chosen != "guarded":
        refuse_options("of the rule guarded", "leave it out, or write --rule guarded", guard=guard)
    return Tolerance(_limit(text, unit), name, chosen, GUARD_DEFAULT if guard is None else guard)


def _limit(text: str, unit: str) -> float:
    """A limit in a unit; without one it is in that unit."""
    from tvsbayes.importing.words import parse_unit

    match = _NUMBER.fullmatch(text)
    value = float(match[1].replace(",", ".")) if match else 0.0
    stated, wanted = (parse_unit(name) for name in ((match[2] or "") if match else "", unit))
    factor = 1.0 if match and (match[2] is None or match[2].strip() == unit) else None
    if factor is None and stated is not None and wanted is not None:
        factor = stated.in_units_of(wanted)
    if not value > 0 or factor is None:
        allowed = f"a number above 0, with or without a unit: 0.015, 15um; here {unit}"
        remedy = f"write the number alone for {unit}"
        raise InputError("usage", f"--tolerance {escaped(text)}", column="--tolerance", allowed=allowed, remedy=remedy)
    return value * factor


def parties_of(issue: Issue, countries: Mapping[str, str]) -> Parties:
    """Laboratory and customer of a page with stated countries."""
    from tvsbayes.metrology.dcc import Parties

    stated = {name: text for name in ("laboratory", "customer") if (text := getattr(issue, name))}
    return Parties(**stated, **countries)


@dataclass(frozen=True)
class Certification:
    """Options for the certificate.

    Attributes:
        dcc: whether it is asked for.
        schema: a schema to hold it against.
        countries: countries by their field of `Parties`.
        key, certificate: PEM of the signer's key and certificate; None for no signature.
    """

    dcc: bool
    schema: Path | None
    countries: Mapping[str, str]
    key: bytes | None = None
    certificate: bytes | None = None

    @property
    def wanted(self) -> bool:
        """Whether a certificate is written."""
        return self.dcc or self.schema is not None

    def written(self, page: WrittenPage, out: Path | None, make: Callable[[Embedded, bool], bytes]) -> Certified:
        """Write the certificate of a page: `make` gives its XML, with the page inside, to be signed or not."""
        from tvsbayes.metrology.dcc import Embedded, check_dcc
        from tvsbayes.report.page import certificate_place

        xml = make(Embedded(page.number, page.html), self.key is not None)
        lines, result, missed = [], {}, False
        if self.key is not None and self.certificate is not None:
            from tvsbayes.metrology.signature import signed_xml

            xml = signed_xml(xml, self.key, self.certificate)
            lines.append("DCC signed; the signature holds with the certificate")
        path = certificate_place(page.path, out)
        write_atomically(path, xml)
        page.files["dcc"] = str(path)
        if self.schema is not None:
            check = check_dcc(xml, self.schema)
            verdict = {True: "valid", False: "NOT VALID", None: "could not be checked"}[check.valid]
            lines += [f"DCC by {check.tool} against {self.schema}: {verdict}", *check.messages[:DCC_MESSAGES]]
            result["dcc_schema"], missed = asdict(check), not check.valid
        return Certified(lines, result, missed)


@dataclass(frozen=True)
class Certified:
    """What writing a certificate gave: lines, entries of the document, whether a check failed."""

    lines: list[str]
    result: dict[str, Any]
    missed: bool


def certification_of(
    dcc: bool, schema: Path | None, countries: Mapping[str, str], sign: Path | None, certificate: Path | None
) -> Certification:
    """The certificate that the options state; key and certificate are read before anything is computed.

    Raises:
        InputError: an option is missing, cannot be read, or the extra for signatures is not installed.
    """
    if not (dcc or schema):
        refuse_options("for a certificate", "add --dcc", **dict(countries), sign=sign, certificate=certificate)
        return Certification(dcc, schema, countries)
    if (sign is None) != (certificate is None):
        message = "--sign and --certificate belong together: a signature holds the signer's certificate"
        raise InputError("usage", message, remedy="give --sign KEY.pem --certificate CERT.pem, or neither")
    if sign is None or certificate is None:
        return Certification(dcc, schema, countries)
    from tvsbayes.metrology.signature import require_signer

    require_signer()
    key, public = read_bytes(sign, KEY_BYTES_MAX), read_bytes(certificate, KEY_BYTES_MAX)
    return Certification(dcc, schema, countries, key, public)
