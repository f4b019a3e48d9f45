"""The page of a report, of any instrument: limits, writing, printing, certificate; the parts of `calibrate`."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from tvsbayes.cli.app import TARGET_MISSED, Ended, check_word, finish, print_part, refuse_options, report_line
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.errors import InputError, TvsError, escaped
from tvsbayes.files.disk import output_place, read_bytes, require_writable, write_atomically
from tvsbayes.progress import Job
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

if TYPE_CHECKING:
    from tvsbayes.metrology.conformity import Criterion, Tolerance
    from tvsbayes.metrology.dcc import Embedded, Parties
    from tvsbayes.report.document import Document, Issue
    from tvsbayes.results.records import Tier

DRAWING, PRINTING = "drawing the page", "printing to PDF"
DCC_MESSAGES = 20
"""Largest number of messages of a schema validator to show."""
KEY_BYTES_MAX = 65_536
_NUMBER = re.compile(r"\s*([0-9]*[.,]?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(\S.*)?")


@dataclass(frozen=True)
class Part:
    """A part of `calibrate`: key, document and text, and the error that ends the sequence, else None."""

    key: str
    document: Mapping[str, Any] | None
    text: str
    error: TvsError | None = None


def print_parts(parts: Iterable[Part], as_json: bool) -> None:
    """Print the parts of `calibrate`, each as soon as it is made; an error ends them, and there is no report."""
    documents: dict[str, Any] = {}
    for part in parts:
        documents[part.key] = part.document
        if part.error is not None:
            finish({**documents, "report": None}, part.text, as_json, part.error)
        elif part.key == "report":
            finish(documents, part.text, as_json)
        else:
            print_part(part.text, as_json)


@dataclass(frozen=True)
class WrittenPage:
    """A page on disk.

    Attributes:
        number: number on its first page.
        html: its bytes.
        path: its file.
        files: the page and the files made from it, by kind.
        removed: names of removed files of an earlier page.
    """

    number: str
    html: bytes
    path: Path
    files: dict[str, str]
    removed: list[str]

    def as_json(self, criteria: Sequence[Criterion] = ()) -> dict[str, Any]:
        """The document of `report --json`, with the limits that the user gave, judged."""
        return {"criteria": [asdict(c) for c in criteria], "number": self.number, "files": self.files}

    def report_removed(self, *, certificates: bool = False) -> None:
        """Report the removed files, except those written again; `certificates` where the command makes them."""
        written = {Path(place).name for place in self.files.values()}
        if removed := [name for name in self.removed if name not in written]:
            command = "`tvsbayes report --pdf`" + " or `--dcc`" * certificates
            report_line(f"removed: {', '.join(removed)}, made of an earlier report; {command} makes them again")

    def part(self, lines: Sequence[str] = (), criteria: Sequence[Criterion] = ()) -> Part:
        """The last part of `calibrate`, with the verdicts on the limits, as lines and as criteria."""
        text = "\n".join([*lines, f"next: open {', '.join(self.files.values())} in a browser"])
        return Part("report", self.as_json(criteria), text)


def written_page(
    folder: Path, out: Path | None, pdf: bool, stages: Mapping[str, float], make: Callable[[Job], Document]
) -> WrittenPage:
    """Write the page of a campaign, and print it if requested.

    Args:
        folder: of the campaign.
        out: path stated by the user; None for `results/report.html`.
        pdf: whether to print it.
        stages: expected durations of the stages before printing, of which `make` begins each.
        make: makes the document.

    Raises:
        InputError: no browser can print it, or it cannot be written.
    """
    from tvsbayes.report.page import find_browser, page_html, print_to_pdf, replace_page

    if pdf:
        find_browser()
    path = out or output_place(folder, "results") / "report.html"
    require_writable(path.parent)
    files = {"report": str(path)}
    with waiting() as progress, Job({**stages, PRINTING: 3.0 if pdf else 0.0}, progress) as job:
        document = make(job)
        html = page_html(document)
        removed = replace_page(path, html, out)
        if pdf:
            job.begin(PRINTING)
            files["pdf"] = str(print_to_pdf(path))
    return WrittenPage(document.number, html, path, files, removed)


@dataclass
class Page(ABC):
    """The page of one kind of instrument.

    Attributes:
        folder: campaign folder.
        issue: laboratory, customer and day.
        quick: whether a fit that has to be made first makes no chain.
        criteria: limits with their verdicts, once the document is made.
        stages: expected durations of the stages of the document.
        certifiable: whether there are certificates, as of a `CertifiedPage`.
    """

    folder: Path
    issue: Issue
    quick: bool
    criteria: Sequence[Criterion] = field(default=(), init=False)
    stages: ClassVar[Mapping[str, float]]
    certifiable: ClassVar[bool] = False

    @property
    def tier(self) -> Tier:
        """How a fit that has to be made first is sampled."""
        return IMPORTANCE if self.quick else CHAIN

    @abstractmethod
    def document(self, job: Job) -> Document:
        """Make the document; fits first where results are missing."""

    def lines(self, number: str, certified: Sequence[str] = ()) -> list[str]:
        """What a terminal says of the page: its number, verdicts, and what was said of its certificate."""
        return [*certified, f"report {number}"]

    def certified(
        self, page: WrittenPage, out: Path | None, certification: Certification | None
    ) -> tuple[list[str], dict[str, Any], bool]:
        """What was said of a certificate, its part of the document, and whether it failed; nothing without one."""
        return [], {}, False

    @property
    def missed(self) -> bool:
        """Whether a limit that the user gave is not met."""
        from tvsbayes.report.evidence import SATISFIED

        return any(c.verdict not in SATISFIED for c in self.criteria)

    def written(self, pdf: bool, out: Path | None = None) -> WrittenPage:
        """Write the page; options as of `report`."""
        return written_page(self.folder, out, pdf, self.stages, self.document)

    def finish(self, pdf: bool, out: Path | None, as_json: bool, certification: Certification | None = None) -> None:
        """Write the page, with its certificate where one is asked for, and print the result: the end of `report`."""
        page = self.written(pdf, out)
        said, result, failed = self.certified(page, out, certification)
        page.report_removed(certificates=self.certifiable)
        lines = [*self.lines(page.number, said), f"written: {', '.join(page.files.values())}"]
        finish(page.as_json(self.criteria) | result, "\n".join(lines), as_json)
        if failed or self.missed:
            raise Ended(TARGET_MISSED)


class CertifiedPage(Page):
    """The page of an instrument that has certificates."""

    certifiable = True

    @abstractmethod
    def certificate(self, parties: Parties, report: Embedded, signed: bool) -> bytes:
        """DCC-schema XML with the page inside, issued on its day (UTC)."""

    def certified(
        self, page: WrittenPage, out: Path | None, certification: Certification | None
    ) -> tuple[list[str], dict[str, Any], bool]:
        """As of every page; writes the certificate where one is asked for."""
        if certification is None or not certification.wanted:
            return super().certified(page, out, certification)
        parties = parties_of(self.issue, certification.countries)
        return certification.written(page, out, partial(self.certificate, parties))


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
        wanted: whether one is written.
        schema: a schema to hold it against.
        countries: countries by their field of `Parties`.
        key, certificate: PEM of the signer's key and certificate; None for no signature.
    """

    wanted: bool
    schema: Path | None
    countries: Mapping[str, str]
    key: bytes | None = None
    certificate: bytes | None = None

    def written(
        self, page: WrittenPage, out: Path | None, make: Callable[[Embedded, bool], bytes]
    ) -> tuple[list[str], dict[str, Any], bool]:
        """Write the certificate of a page: `make` gives its XML, with the page inside, to be signed or not.

        Returns:
            Lines, entries of the document, whether a check failed.
        """
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
        return lines, result, missed


def certification_of(
    dcc: bool, schema: Path | None, countries: Mapping[str, str], sign: Path | None, certificate: Path | None
) -> Certification:
    """The certificate that the options state; key and certificate are read before anything is computed.

    Raises:
        InputError: an option is missing, cannot be read, or the extra for signatures is not installed.
    """
    wanted = dcc or schema is not None
    if not wanted:
        refuse_options("for a certificate", "add --dcc", **dict(countries), sign=sign, certificate=certificate)
    elif (sign is None) != (certificate is None):
        message = "--sign and --certificate belong together: a signature holds the signer's certificate"
        raise InputError("usage", message, remedy="give --sign KEY.pem --certificate CERT.pem, or neither")
    if sign is None or certificate is None:
        return Certification(wanted, schema, countries)
    from tvsbayes.metrology.signature import require_signer

    require_signer()
    key, public = read_bytes(sign, KEY_BYTES_MAX), read_bytes(certificate, KEY_BYTES_MAX)
    return Certification(wanted, schema, countries, key, public)
