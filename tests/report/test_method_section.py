"""Traceability and limits on the page."""

from __future__ import annotations

from types import SimpleNamespace

from support.small_results import small_record

from tvsbayes.files.documents import StatedValue
from tvsbayes.report.scanner_sections import method_section
from tvsbayes.report.tables import sentences


def test_a_stated_length_is_printed_with_its_unit_and_u():
    """As temperature and humidity of the set-up are."""
    stated = {"board_certificate": "PTB 123", "pitch_mm": StatedValue(30.0, 0.02)}
    e = SimpleNamespace(fit=small_record(), campaign=SimpleNamespace(header={"traceability": stated}))
    rows = {row[1]: row[2] for row in method_section(e).tables[0].rows if row[0] == "traceability"}
    assert rows == {"board_certificate": "PTB 123", "pitch": "30 mm, u = 0.02 mm"}


def test_limits_use_only_symbols_that_the_page_explains():
    items = sentences("sections")["limits"]
    assert any("emission angle at pan 0 (C0)" in item for item in items)
