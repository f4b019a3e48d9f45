"""The report page: structure, security policy, hostile text in campaigns, rendering in Chromium."""

from __future__ import annotations

import base64
import datetime
import hashlib
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.reported_twin import Nodes, evidence_of, first_words, report_html, words

from tvsbayes.errors import InputError
from tvsbayes.estimators.four_point import Outlier
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.metrology.positioning_table import positioning
from tvsbayes.metrology.traceability import traceability
from tvsbayes.pipeline import load_calibration
from tvsbayes.report.document import Issue
from tvsbayes.report.page import BROWSERS, replace_page, typeset
from tvsbayes.report.scanner_document import answer_table
from tvsbayes.report.tables import (
    cause_in_words,
    chance_text,
    name_in_words,
    sentence_in_words,
    share_in_words,
    source_in_words,
)

BYTES_MAX = 3_000_000


KNOWN = {
    *("html", "head", "meta", "title", "style", "body", "header", "main", "footer", "section", "figure", "figcaption"),
    *("h1", "h2", "p", "strong", "ul", "ol", "li", "dl", "dt", "dd", "div", "span", "img"),
    *("nav", "a", "details", "summary", "code"),
    *("table", "caption", "thead", "tbody", "tr", "th", "td"),
}


def test_the_command_writes_this_page(reported, page):
    """Made a second time from the same results, to the byte."""
    assert (reported / "results" / "report.html").read_bytes() == page
    assert len(page) < BYTES_MAX


def test_the_page_is_self_contained_and_so_is_its_policy(page):
    nodes = Nodes(page)
    assert {tag for tag, _ in nodes.elements} <= KNOWN and not nodes.open
    assert not any(name.startswith("on") for _, attributes in nodes.elements for name in attributes)
    for name in ("srcset", "action", "data", "style"):
        assert not any(name in attributes for _, attributes in nodes.elements)
    ids = {attributes.get("id") for _, attributes in nodes.elements}
    links = [attributes["href"] for _, attributes in nodes.elements if "href" in attributes]
    assert len(links) > 8 and all(link[0] == "#" and link[1:] in ids for link in links)
    policy = next(m["content"] for m in nodes.of("meta") if m.get("http-equiv") == "Content-Security-Policy")
    style = page.split(b"<style>")[1].split(b"</style>")[0]
    digest = base64.b64encode(hashlib.sha256(style).digest()).decode()
    assert (
        policy == f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    )
    assert b"url(" not in style and b"@import" not in style


def test_pictures_are_data_with_words(page):
    images = Nodes(page).of("img")
    assert len(images) >= 14
    for image in images:
        kind, content = image["src"].split(",", 1)
        assert kind == "data:image/svg+xml;base64" and len(image["alt"]) > 20
        root = ET.fromstring(base64.b64decode(content))
        for node in root.iter():
            assert not node.tag.endswith(("script", "foreignObject", "animate"))
            for name, value in node.attrib.items():
                # References inside the picture, and rasters that it carries itself.
                assert not name.endswith("href") or value.startswith(("#", "data:image/png;base64,"))


def test_the_page_is_accessible_to_screen_readers(page):
    nodes = Nodes(page)
    assert nodes.of("html")[0]["lang"] == "en"
    assert [len(nodes.of(tag)) for tag in ("h1", "main", "title")] == [1, 1, 1]
    ids = [a["id"] for _, a in nodes.elements if "id" in a]
    assert len(ids) == len(set(ids)) and all(a["aria-labelledby"] in ids for a in nodes.of("section"))
    assert len(nodes.of("caption")) == len(nodes.of("table")) > 10
    assert all(th.get("scope") in ("row", "col") for th in nodes.of("th"))
    assert len(nodes.of("figcaption")) == len(nodes.of("figure"))


def test_numbers_of_the_page_are_those_of_the_libraries(page, evidence):
    text = " ".join(Nodes(page).text)
    for direction in DIRECTIONS:
        joint = evidence.fit.summary.effective[direction]
        assert f"{joint.value:.6f}"[:7] in text
        assert f"{evidence.classic.directions[direction].mean_deg_per_step:.5f}"[:7] in text
    assert not re.search(r"\b(nan|inf|None|undefined)\b", text)
    assert text.count(f"of results {evidence.fit.results_id}") == 1
    for word in ("Not an accredited", "Simulated data: not traceable", "synthetic", "End of report", "Seed"):
        assert word in text
    for sha in evidence.fit.provenance.inputs.values():
        assert sha in text
    # One draw of a point within 1 mm, or none: the fit decides whether the chance is a bound or below what draws tell.
    (missed,) = (c for c in evidence.criteria if c.verdict == "not met")
    chance = chance_text(missed.probability)
    assert f"Not met: {missed.quantity} within 1 mm (probability {chance})" in text


def test_the_papers_table_and_figures_are_on_the_page(page, evidence, no_pictures):
    """Table 1 (n, mean, sd, type A), Figures 11 to 16 one by one, and the experiment that makes an sd."""
    text = words(page)
    for direction, result in evidence.classic.directions.items():
        spread = f"{result.sd_deg_per_step:.6f} {result.u_type_a_deg_per_step:.6f}"
        assert f"{direction} {result.n} {result.mean_deg_per_step:.6f} {spread}" in text
    assert [text.count(f"Figure {number}") for number in range(11, 17)] == [1] * 6
    left = evidence.classic.directions["left"]
    outlier = Outlier(1, 0.0644, 1e-6, 0.0602, 1.8e-4, "cleared")
    directions = evidence.classic.directions | {"left": structs.replace(left, outlier=outlier)}
    made = words(report_html(replace(evidence, classic=structs.replace(evidence.classic, directions=directions))))
    assert "Experiment 1 (left) with 0.064400 deg/step makes the sd" in made and "they lost no play" in made
    assert "makes the sd" not in text


def test_the_first_page_has_results_and_customer(page, evidence, no_pictures):
    """Before the contents: ratios, backlashes, millimetres, what to do next, day, laboratory, customer."""
    issued = report_html(evidence, Issue(datetime.date(2026, 1, 15), "Optics Lab", "Robotics group"))
    for source, phrase in (
        (issued, "issued 2026-01-15"),
        (issued, "laboratory Optics Lab customer Robotics group"),
        (page, "measured 2026-01-15 instrument not recorded serial number not recorded operator not recorded"),
        (page, "laboratory not stated customer not stated"),
    ):
        first = first_words(source)
        assert phrase in first and "What to do next" in first
        for row in (*(f"{d}, deg/step" for d in DIRECTIONS), "backlash pan, deg", "backlash tilt, deg"):
            assert row in first
        assert [first.count(f"{name} calibration") for name in ("nominal", "classic", "joint")] == [1, 1, 1]
        assert source.split(b"<nav")[0].count(b"<img") == 1
        # A command is marked as code, names the folder and repeats the options of `fit`.
        assert "`" not in first and "--no-sample" not in first and "tvsbayes fit twin" in first
        # What makes the millimetres: of the joint calibration, and why the classic is farther off.
        assert "Error of classic there" in first and "of the variance" in first


def test_warnings_of_check_are_on_the_first_page(evidence, no_pictures):
    """The page outlives the terminal: an interrupted run is not usable without a word of it."""
    doubted = replace(evidence, criteria=(), doubts=("whether steps were lost in segment 0 is not known",))
    first = first_words(report_html(doubted))
    assert "see the warnings of check. No limit" in first
    assert "check warns: whether steps were lost in segment 0" in first
    assert "check warns" not in words(report_html(replace(evidence, criteria=())))


def test_equal_ratios_share_a_row(evidence):
    """Without the classic method's own column; the contrast says what they differ by."""
    summary = evidence.fit.summary
    lower = structs.replace(summary.effective["up"], value=0.06, interval95=(0.0598, 0.0602))
    alike = structs.replace(summary, effective=summary.effective | {"right": summary.effective["left"], "down": lower})
    heads = [row[0] for row in answer_table(alike, None).rows]
    assert heads[0] == "left and right, deg/step" and {"up, deg/step", "down, deg/step"} <= set(heads)
    assert "left - right, \u00b5deg/step" in heads
    # A narrow screen hides one column by its place: every row has all cells.
    for shown in (answer_table(evidence.fit.summary, evidence.classic), answer_table(alike, None)):
        assert {len(row) for row in shown.rows} == {len(shown.columns)}
    apart = [row[0] for row in answer_table(alike, evidence.classic).rows]
    assert apart[:2] == ["left, deg/step", "right, deg/step"]


def test_causes_and_parameters_are_called_by_words():
    """Every prior and every parameter but the cameras'; budgets say the part and the unit as well."""
    labels = {cause: cause_in_words(cause) for cause in TWO_MIRROR.prior_groups if cause.startswith("prior of ")}
    assert all(words != cause for cause, words in labels.items())
    tables = [share_in_words(cause) for cause in labels] + [
        source_in_words(f"prior of {name}") for name in TWO_MIRROR.rig_names
    ]
    tables += [name_in_words(name) for name in TWO_MIRROR.rig_names]
    assert not any("_" in words for words in tables), tables
    assert len(set(tables[-len(TWO_MIRROR.rig_names) :])) == len(TWO_MIRROR.rig_names)
    assert share_in_words("prior of laser_tilt_deg") == "prior of the laser's direction"
    assert source_in_words("prior of laser_tilt_deg.x") == "prior of the laser's direction, x, deg"
    assert source_in_words("prior of something else") == "prior of something else"
    assert source_in_words("prior of ln stop_sd_deg.up") == "prior of ln scatter of stops, up, deg"
    assert source_in_words("pixel noise") == share_in_words("pixel noise") == "pixel noise"
    assert labels["prior of mirror2_error_deg"] == "the angle of mirror 2 as stated beforehand"
    assert cause_in_words("stereo calibration") == "stereo calibration"
    together = "laser_tilt_deg.x, extrinsics.rotation_rad.y move together; see `fit --without laser_tilt_deg`"
    assert sentence_in_words(together) == (
        "the laser's direction (x), the positioner's attitude (y) move together; see `fit --without laser_tilt_deg`"
    )


def test_files_of_an_earlier_page_are_removed(tmp_path):
    """A PDF or certificate of an older page is removed; files beside a page of another program are kept."""
    ours, newer = b'<meta name="generator" content="tvsbayes 1">old', b'<meta name="generator" content="tvsbayes 1">new'
    page, pdf, certificate = (tmp_path / name for name in ("report.html", "report.pdf", "dcc.xml"))
    for each in (pdf, certificate):
        each.write_bytes(b"made of the old one")
    page.write_bytes(ours)
    assert replace_page(page, ours, None) == [] and pdf.exists() and certificate.exists()
    assert replace_page(page, newer, None) == ["report.pdf", "dcc.xml"]
    assert page.read_bytes() == newer and not pdf.exists() and not certificate.exists()
    mine = tmp_path / "mine.html"
    for before, gone in ((b"<p>somebody else's</p>", []), (ours, ["mine.pdf", "mine.dcc.xml"])):
        mine.write_bytes(before)
        for name in ("mine.pdf", "mine.dcc.xml"):
            (tmp_path / name).write_bytes(b"")
        assert replace_page(mine, newer, mine) == gone
    # A report that had to fit first begins the folder; one that the user names must be there.
    assert replace_page(tmp_path / "results" / "report.html", newer, None) == []
    assert (tmp_path / "results" / "report.html").read_bytes() == newer
    with pytest.raises(InputError):
        replace_page(tmp_path / "missing" / "mine.html", newer, tmp_path / "missing" / "mine.html")


@pytest.mark.parametrize(
    ("plain", "set"),
    [
        ("-0.5 +- 0.1 <= 2", "\u22120.5 \u00b1 0.1 \u2264 2"),
        ("[-0.1, -0.00]", "[\u22120.1, 0.00]"),
        ("-0.00(12) and -0.01", "\u22120.00(12) and \u22120.01"),
        ("1e-05, 2026-01-15, --limit-mm, numpy 2.1.0-1, a-1", "1e-05, 2026-01-15, --limit-mm, numpy 2.1.0-1, a-1"),
        ("PTB 12/-3 <script>", "PTB 12/-3 <script>"),
    ],
)
def test_numbers_get_true_signs_and_names_stay(plain, set):
    assert typeset(plain) == set


def test_traceability_agrees_with_the_certificate(evidence, no_pictures):
    """No page may claim what the DCC of the same fit denies: simulated data, blanks for a certificate's number."""
    header = {k: v for k, v in evidence.campaign.header.items() if k not in ("synthetic", "traceability")}
    named = {"traceability": {"board_certificate": "PTB 123"}}
    for more, begin, declared in (
        (named, "As declared by the user and not verified here", True),
        (named | {"synthetic": True}, "Simulated data: not traceable.", False),
        ({"traceability": {"board_certificate": "   "}}, "Not traceable", False),
        ({}, "Not traceable", False),
    ):
        campaign = replace(evidence.campaign, header=header | more)
        text = words(report_html(replace(evidence, campaign=campaign)))
        trace = traceability(campaign)
        assert trace.declared is declared and trace.statement.startswith(begin)
        assert trace.statement in text and ("As declared by the user" in text) == declared


def test_axes_are_assessed_with_the_fitted_contrast(reported, evidence):
    """ISO 230-2 figures include the fitted contrast of the ratios, which shifts every run."""
    with np.load(reported / "results" / "draws.npz") as stored:
        names, physical = stored["names"].tolist(), stored["physical"]
        contrasts = {a: physical[:, names.index(f"ratio_contrast_deg_per_step.{a}")] for a in ("pan", "tilt")}
    for axis, table in zip(contrasts, evidence.fit.evidence.positioning, strict=True):
        with_contrast, untold = (
            positioning(load_calibration(reported), axis, contrast_deg_per_step=c).predicted
            for c in (contrasts[axis], None)
        )
        for name, figure in table.predicted.items():
            assert figure.median == pytest.approx(with_contrast[name].median, rel=1e-9), (axis, name)
        # 1e-6 deg: thousands of times the rounding above; this campaign leaves little room for unequal ratios.
        assert abs(table.predicted["accuracy_deg"].median - untold["accuracy_deg"].median) > 1e-6


def test_without_limit_no_verdict_and_without_convergence_no_results(evidence, no_pictures):
    assert "No limit was stated" in words(report_html(replace(evidence, criteria=())))
    astray = structs.replace(evidence.fit.summary, converged=False, problems=("the mode was not reached",))
    broken = replace(evidence, fit=replace(evidence.fit, summary=astray))
    text = words(report_html(broken))
    assert "NOT CONVERGED" in text and "the mode was not reached" in text


PAYLOADS = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "'><svg/onload=alert(1)>",
    "</style><script>alert(1)</script>",
    "</title><iframe src='javascript:alert(1)'></iframe>",
    "{{ 7 * 7 }}{% for x in range(9) %}A{% endfor %}",
    "]]><!--<a href=javascript:alert(1)>x</a>",
    "&lt;script&gt;&#x3c;b&#x3e;",
)


@pytest.mark.parametrize("shift", range(2))
def test_hostile_text_is_escaped(reported, page, shift, tmp_path, no_pictures):
    """Every text field of campaign.toml; results stay valid because texts are outside the hash.

    Shifted by one: each field gets a payload that shows without escaping, which braces alone do not.
    """
    campaign = read_campaign(reported)
    payloads = PAYLOADS[shift:] + PAYLOADS[:shift]
    header = dict(zip(("name", "operator", "instrument", "serial", "method", "notes"), payloads, strict=False))
    header |= {"created": campaign.header["created"], "traceability": {"board_certificate": payloads[6]}}
    place = tmp_path / "hostile"
    write_campaign(replace(campaign, header=header), place)
    shutil.copytree(reported / "results", place / "results")
    hostile = evidence_of(place)
    summary = structs.replace(hostile.fit.summary, prior_conflicts=payloads)
    provenance = structs.replace(hostile.fit.provenance, command=payloads[7])
    hostile = replace(hostile, fit=replace(hostile.fit, summary=summary, provenance=provenance))
    nodes, plain = Nodes(report_html(hostile)), Nodes(page)
    assert {tag for tag, _ in nodes.elements} <= KNOWN
    for tag in ("img", "style", "meta"):
        assert len(nodes.of(tag)) == len(plain.of(tag))
    assert not any(name.startswith("on") for _, attributes in nodes.elements for name in attributes)
    text = "".join(nodes.text)
    assert all(text.count(payload) >= 2 for payload in payloads)


def luminance(colour: str) -> float:
    """Relative luminance of an sRGB colour (WCAG 2.2)."""
    digits = colour.lstrip("#")
    digits = "".join(2 * c for c in digits) if len(digits) == 3 else digits
    parts = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_text_has_contrast_in_both_schemes():
    """4.5:1 for every text colour on the page and on its cards (WCAG 2.2, 1.4.3)."""
    css = (shipped_data() / "report" / "report.css").read_text()
    schemes = [dict(re.findall(r"--(\w+): (#[0-9a-f]+)", block)) for block in re.findall(r":root \{([^}]*)\}", css)]
    assert len(schemes) == 2
    for scheme in schemes:
        for ink in ("ink", "faint", "met", "not", "tell"):
            for ground in ("paper", "card"):
                high, low = sorted((luminance(scheme[ink]), luminance(scheme[ground])), reverse=True)
                assert (high + 0.05) / (low + 0.05) >= 4.5, (ink, ground)


PROBE = """<!DOCTYPE html><html><body>
<iframe id="f" src="report.html" style="width:{width}px;height:900px;border:0"></iframe>
<script>
document.getElementById("f").onload = function () {{
  const d = this.contentDocument, images = Array.from(d.images);
  const small = i => i.naturalWidth === 0 || i.getBoundingClientRect().width < 200;
  const broken = images.filter(i => !i.complete || small(i)).length;
  const answer = d.querySelector(".answer .scroll");
  document.title = JSON.stringify({{wide: d.documentElement.scrollWidth, images: images.length, broken: broken,
    scripts: d.scripts.length, cut: answer.scrollWidth - answer.clientWidth}});
}};
</script></body></html>"""


@pytest.mark.parametrize("width", [390, 1280])
def test_chromium_renders_the_page_without_overflow_or_error(reported, tmp_path, width):
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no Chromium or Chrome on the path (Debian's package: chromium)")
    shutil.copy(reported / "results" / "report.html", tmp_path / "report.html")
    (tmp_path / "probe.html").write_text(PROBE.format(width=width))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    flags += ["--disable-sync", "--disable-quic", "--allow-file-access-from-files", "--enable-logging=stderr"]
    flags += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1400,1000", "--virtual-time-budget=10000"]
    target = (tmp_path / "probe.html").as_uri()
    done = subprocess.run(
        [browser, *flags, "--dump-dom", target], capture_output=True, text=True, timeout=120, check=True
    )
    layout = json.loads(re.search(r"<title>(.*?)</title>", done.stdout)[1])
    assert layout["wide"] <= width and layout["broken"] == 0 and layout["scripts"] == 0
    assert layout["cut"] == 0, "the table of the answer scrolls sideways"
    assert layout["images"] == len(Nodes((tmp_path / "report.html").read_bytes()).of("img"))
    assert "CONSOLE" not in done.stderr
