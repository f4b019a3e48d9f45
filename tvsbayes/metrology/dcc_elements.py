"""Elements of a DCC: text that stays text, contacts, and numbers with their uncertainty as D-SI 2.2.1 wants them.

Units in D-SI's notation; standard and expanded uncertainties to two digits (GUM 7.2.6).
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET

from tvsbayes.metrology.budget_tables import PROBABILITY
from tvsbayes.metrology.traceability import plain_text

UNIT_SI = {"deg/step": r"\degree\per\one", "deg": r"\degree", "mm": r"\milli\metre"}
"""D-SI has no unit for a count: steps are `\\one`."""
EXPANDED_SYMMETRY = 0.25
"""Standard uncertainties by which the middle of the 95 % interval may lie off the value before an interval is given
instead of an expanded uncertainty."""
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, escaped or not."""


def _plain(value: object) -> str:
    """Text that the schema takes: no character XML cannot hold, single spaces, never empty."""
    return plain_text(_FORBIDDEN.sub("\ufffd", str(value)))


def add(parent: ET.Element, tag: str, text: object | None = None, **attributes: str) -> ET.Element:
    """A new last child, with text where there is some."""
    element = ET.SubElement(parent, tag, attributes)
    if text is not None:
        element.text = _plain(text)
    return element


def add_words(parent: ET.Element, tag: str, *texts: object, **attributes: str) -> ET.Element:
    """A `textType` or `richContentType`: all texts, with spaces between them, in one `dcc:content`."""
    element = add(parent, tag, **attributes)
    # The Schematron allows each language once per element.
    add(element, "dcc:content", " ".join(map(_plain, texts)), lang="en")
    return element


def _decimals(u: float) -> int:
    """Decimals at which u keeps two significant digits (GUM 7.2.6)."""
    return max(0, 1 - int(f"{u:.1e}".split("e")[1]))


def add_real(
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
    real = add(parent, "si:real")
    if not u:
        add(real, "si:value", repr(float(value)))
        add(real, "si:unit", unit)
        return
    low, high = interval95 or (value, value)
    expanded, middle = 0.5 * (high - low), 0.5 * (high + low)
    k = expanded / u
    # A coverage factor below 1 is no D-SI coverage factor.
    symmetric = interval95 is not None and k >= 1 and abs(middle - value) <= EXPANDED_SYMMETRY * u
    places = _decimals(expanded if symmetric else u)
    add(real, "si:value", f"{value:.{places}f}")
    add(real, "si:unit", unit)
    uncertainty = add(real, "si:measurementUncertaintyUnivariate")
    if interval95 is None:
        standard = add(uncertainty, "si:standardMU")
        add(standard, "si:valueStandardMU", f"{u:.{places}f}")
        add(standard, "si:distribution", distribution)
    elif symmetric:
        box = add(uncertainty, "si:expandedMU")
        add(box, "si:valueExpandedMU", f"{expanded:.{places}f}")
        add(box, "si:coverageFactor", f"{k:.2f}")
        add(box, "si:coverageProbability", f"{PROBABILITY:.2f}")
        add(box, "si:distribution", distribution)
    else:
        box = add(uncertainty, "si:coverageIntervalMU")
        add(box, "si:valueStandardMU", f"{u:.{places}f}")
        add(box, "si:intervalMin", f"{low:.{places}f}")
        add(box, "si:intervalMax", f"{high:.{places}f}")
        add(box, "si:coverageProbability", f"{PROBABILITY:.2f}")
        add(box, "si:distribution", distribution)


def add_contact(parent: ET.Element, tag: str, name: str, country: str | None = None) -> None:
    """Somebody with a name, and the country of the place where one is wanted."""
    contact = add(parent, tag)
    add_words(contact, "dcc:name", name)
    if country is not None:
        add(add(contact, "dcc:location"), "dcc:countryCode", country)
