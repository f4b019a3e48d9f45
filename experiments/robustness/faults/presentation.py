"""Faults of what people see: terminal, report."""

from experiments.robustness.faults.fault import Fault

FAULTS = (
    Fault(
        "a failed validation is no verdict",
        "report/advice.py",
        "return None if validation is None or validation.passed else validation",
        "return None",
        "the last line of a fit calls results usable whose model is wrong",
        ("assessment/score_tests", "report/fit_text"),
    ),
    Fault(
        "hyphens of names become minus signs",
        "report/page.py",
        'r"(?<![\\w.)/-])-(?=\\d)"',
        'r"-(?=\\d)"',
        "dates and versions of a report cannot be copied",
        ("report/page::test_numbers_get_true_signs_and_names_stay",),
    ),
    Fault(
        "colour where nobody wants it",
        "cli/terminal.py",
        'not os.environ.get("NO_COLOR") and ',
        "",
        "escape sequences in logs of those who forbade them",
        ("cli/terminal",),
    ),
    Fault(
        "cut-outs of spots with rows for columns",
        "report/spot_pictures.py",
        "picture[top : round(v) + HALF_PX + 1, left : round(u) + HALF_PX + 1]",
        "picture[left : round(u) + HALF_PX + 1, top : round(v) + HALF_PX + 1]",
        "the report shows empty paper under the cross",
        ("report/spot_crops",),
    ),
)
