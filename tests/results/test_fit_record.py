"""The schema of `results/fit.json`: every old version stays valid and readable, and a fresh fit obeys it."""

from __future__ import annotations

import datetime
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.fit_documents import OLD, changed, kept, problems, schema_of
from support.small_results import small_record, whole_summary

from tvsbayes.errors import InputError
from tvsbayes.results.comparison_record import Gap, GapTerm
from tvsbayes.results.convergence import Agreement, Convergence, Importance, MonteCarloError, NamedValue, Reweighted
from tvsbayes.results.estimates import Cause, CauseGroup, StopResidual
from tvsbayes.results.fit_record import FIT_FORMAT, FIT_FORMATS, read_fit
from tvsbayes.results.records import plain


def test_every_readable_version_has_a_schema_and_kept_documents():
    for version in FIT_FORMATS:
        documents = [json.loads(path.read_text()) for path in OLD]
        mine = [d for d in documents if d["format"] == version]
        assert {d["estimator"] for d in mine} == {"laplace", "posterior"}
        schema = schema_of(mine[0])
        assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
        assert schema["properties"]["format"] == {"const": version}
    assert FIT_FORMAT in FIT_FORMATS


@pytest.mark.parametrize("path", OLD, ids=lambda p: p.stem)
def test_old_documents_stay_valid_and_readable(path):
    document = json.loads(path.read_text())
    assert problems(document, schema_of(document)) == []
    # Keys that came within the version, at their defaults; those of a diagnosis stay away.
    later = {"local_deg_per_step": {}, "range_steps": {}, "homing_side": {}, "answer": None, "monte_carlo_error": {}}
    later |= {"periods": [], "fit_id": None}
    assert read_fit(path).as_json() == {"validation": None, "few_stops": {}, "tier": None, **later, **document}


def test_a_new_document_obeys_the_schema(tmp_path):
    """The writer's own path, with everything that may be null; a real fit is checked in `cli`."""
    summary = whole_summary()
    (tmp_path / "fit.json").write_text(json.dumps(small_record(summary, seed=3).as_json()))
    document = json.loads((tmp_path / "fit.json").read_text())
    assert problems(document, schema_of(document)) == []
    assert json.dumps(read_fit(tmp_path / "fit.json").as_json()) == json.dumps(document), "in its order, too"


def test_both_tiers_obey_the_schema(tmp_path):
    """Weighted draws have no walkers and no R-hat; a chain says whether it agrees with them."""
    worst = NamedValue("backlash_deg.tilt", 0.41)
    importance = Importance(True, (), 4, 4096, 0.7, worst, 0.33, worst, 0.003, -1189.2, 0.01, 0, "accepted")
    effective = {"backlash_deg.tilt": 2100.0}
    errors = {"backlash_deg.tilt": MonteCarloError(0.02, (0.05, 0.11))}
    weighted = Reweighted(importance, effective, effective, errors)
    chain = Convergence(
        *(200, 20, 2, 3.1, {"backlash_deg.tilt": 1.002}, effective, effective, np.array([0.5, 0.6]), (), 0, ()),
        importance=importance,
        agreement=Agreement(True, 4.0, worst),
        monte_carlo_error=errors,
        rough=True,
    )
    assert weighted.answer == chain.answer == "accepted"
    for tier, draws in (("importance", weighted), ("emcee", chain)):
        answer = {"answer": draws.answer, "monte_carlo_error": draws.monte_carlo_error}
        summary = structs.replace(whole_summary(), estimator="posterior", tier=tier, sampling=draws.sampling, **answer)
        (tmp_path / "fit.json").write_text(json.dumps(small_record(summary, seed=3).as_json()))
        document = json.loads((tmp_path / "fit.json").read_text())
        assert problems(document, schema_of(document)) == []
        assert read_fit(tmp_path / "fit.json").summary == summary
        assert document["sampling"]["importance"]["log_evidence"] == -1189.2
        assert (document["answer"], document["sampling"]["importance"]["answer"]) == ("accepted", "accepted")
        error = {"mean": 0.02, "interval95": [0.05, 0.11]}
        assert document["monte_carlo_error"] == {"backlash_deg.tilt": error}
        for path, value in (
            ("answer", "good"),
            ("monte_carlo_error/backlash_deg.tilt/mean", -0.1),
            ("monte_carlo_error/backlash_deg.tilt/interval95", [0.1]),
        ):
            assert problems(changed(document, path, value), schema_of(document)), path
    assert weighted.sampling.worst_rhat is None and weighted.rhat == {}


def test_what_a_chain_lacks_leaves_a_rough_answer_or_none():
    """A chain has an answer while what it lacks is no more than a rough one may lack."""
    worst = NamedValue("backlash_deg.tilt", 0.41)
    importance = Importance(False, ("few",), 4, 4096, 0.7, worst, 0.33, worst, 0.003, -1189.2, 0.01, 0, "rough")
    effective = {"backlash_deg.tilt": 210.0}
    answers = {}
    for rough in (True, False):
        chain = Convergence(
            *(200, 20, 2, 3.1, {"backlash_deg.tilt": 1.02}, effective, effective, np.array([0.5]), (), 0, ("short",)),
            *(importance, None, {}, rough),
        )
        answers[rough] = chain.answer, chain.converged
    assert answers == {True: ("rough", True), False: ("laplace", False)}
    # Documents of 0.2.0 do not say: their weights were accepted or not.
    assert Reweighted(replace(importance, answer=None), effective, effective, {}).answer == "laplace"


def test_what_reports_show_besides_obeys_the_schema():
    """Keys that came within version 1, as the records behind them are written; older documents lack them."""
    term = GapTerm("backlash over N", -0.002, 1e-4, (-0.0022, -0.0018))
    stop = StopResidual("pan", (3, 4), -100, "", 0, (175.0, 276.5), (None, 0.3), 61.5, -0.01, 0.04)
    cause = Cause("depth", "tilt", (CauseGroup("175 to 276 mm", 12, 0.1, 0.3),), None, False)
    gap = {"left": plain(Gap(0.059, term, term, (term,))), "right": None}
    document = kept("fit-1-laplace.json")
    schema = schema_of(document)
    added = {"residuals": [plain(stop)], "residual_causes": [plain(cause)], "gap": gap, "few_stops": {"up": 3}}
    written = json.loads(json.dumps({**document, **added}))
    assert problems(written, schema) == []
    assert problems({**written, "gap": None}, schema) == []
    for path, value in (
        ("gap/left/terms/0/sd", -1.0),
        ("gap/forward", None),
        ("few_stops/forward", 3),
        ("few_stops/up", -1),
        ("residuals/0/axis", "z"),
        ("residual_causes/0/p", 2.0),
    ):
        assert problems(changed(written, path, value), schema), path


BROKEN = [
    ("format", "tvsbayes-fit/2"),
    ("format", ...),
    ("estimator", "guess"),
    ("converged", 1),
    ("problems", "none"),
    ("surprise", 1.0),
    ("effective_deg_per_step/left", ...),
    ("effective_deg_per_step/left/value", "0.06"),
    ("effective_deg_per_step/left/value", None),
    ("effective_deg_per_step/left/sd", -1e-4),
    ("effective_deg_per_step/left/interval95", [0.06]),
    ("effective_deg_per_step/left/interval95", [0.06, 0.06, 0.06]),
    ("effective_deg_per_step/left/contraction", 1.5),
    ("effective_deg_per_step/forward", None),
    ("effective_contrast_deg_per_step/pan", 0.1),
    ("effective_jacobian", [[1.0, 0.0]]),
    ("effective_jacobian", [[1.0], [0.0, 1.0]]),
    ("reference_pose_deg/pan", True),
    ("parameters/backlash_deg.pan", ...),
    ("parameters/backlash_deg.pan", None),
    ("parameters/Backlash!", {}),
    ("noise/chi2", -1.0),
    ("noise/stop_sd_deg/up", ...),
    ("weak_directions/0/loadings", [0.5]),
    ("weak_directions/0/text", ...),
    ("prior_sensitivity/0/factor", 0.0),
    ("excluded_spots", [1.5]),
    ("suspect_spots", [-1]),
    ("sampling/worst_rhat", 1.01),
    ("sampling/walkers", 0),
    ("curves/lost_motion/left/0/interval95_deg", [0.1]),
    ("curves/effective_deg_per_step/pan/0/left/sd", None),
    ("covariance/matrix", []),
    ("covariance/names", []),
    ("inputs/moves", "abc"),
    ("inputs/rig", ...),
    ("versions/tvsbayes", ...),
    ("versions/jax", 12),
    ("seed", -1),
    ("seed", 1.5),
    ("command", None),
]


@pytest.mark.parametrize(("path", "value"), BROKEN, ids=lambda x: x if isinstance(x, str) else None)
def test_the_schema_refuses(tmp_path, path, value):
    document = changed(kept("fit-1-posterior.json"), path, value)
    assert problems(document, schema_of(kept("fit-1-posterior.json")))
    file = tmp_path / "fit.json"
    file.write_text(json.dumps(document))
    with pytest.raises(InputError) as error:
        read_fit(file)
    # The message names the place, entries of a list by the list's key.
    assert error.value.column == ".".join(part for part in path.split("/") if not part.isdigit())


@pytest.mark.parametrize(("path", "value", "found"), [("noise/chi2", math.nan, '"NaN"'), ("command", "a\x00b", "")])
def test_what_no_schema_refuses_is_refused(tmp_path, path, value, found):
    file = tmp_path / "fit.json"
    file.write_text(json.dumps(changed(kept("fit-1-laplace.json"), path, value)))
    with pytest.raises(InputError) as error:
        read_fit(file)
    assert found in error.value.message and error.value.column == (None if found else path)


def test_a_failure_without_its_test_and_foreign_figures_are_refused(tmp_path):
    """What pages and certificates look up must be there; the schema does not require it."""
    failed = {"passed": False, "level": 0.01, "cause": "drift", "inflation": 2.0, "tests": []}
    axis = {"axis": "pan", "deg_per_step": 0.06, "target_steps": [0, 100], "runs": 5, "estimator": "laplace"}
    axis |= {"plug_in_steps": [], "plug_in_runs": [], "reading_u_deg": None, "missing": None, "notes": []}
    axis |= {"predicted": {"colour": {"median": 0.1, "interval95": [0.0, 0.2]}}, "plug_in": None}
    besides = {"residuals": [], "residual_causes": [], "gap": None, "budgets": [], "positioning": [axis]}
    for column, added in (("validation", {"validation": failed}), ("positioning", besides)):
        document = {**kept("fit-1-laplace.json"), **added}
        assert problems(document, schema_of(document)) == []
        (tmp_path / "fit.json").write_text(json.dumps(document))
        with pytest.raises(InputError) as error:
            read_fit(tmp_path / "fit.json")
        assert error.value.column == column


def test_one_identity_of_results_names_report_and_certificate():
    """Twelve digits of one digest; another seed, version or word besides is another document."""
    record = small_record()
    day = datetime.date(2026, 11, 22)
    assert record.results_id == record.digest[:12].upper()
    assert record.certificate_id(day, ["a"]) == small_record().certificate_id(day, ["a"])
    other = small_record(seed=1)
    ids = {record.certificate_id(day, [name]) for name in "ab"} | {other.certificate_id(day, ["a"])}
    assert len(ids) == 3 and other.results_id != record.results_id
