"""Sections: setting, headlines, parameters, identifiability, residuals, tests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.report import figures
from tvsbayes.report.tables import Section, TableView, concise, figure_view, interval_text, two_digits
from tvsbayes.results.estimates import CONTRACTION_LIMIT

if TYPE_CHECKING:
    from tvsbayes.report.evidence import Evidence


CORRELATED = (
    *("degrees_per_step.pan", "degrees_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    *("mirror_offset_mm", "tilt_zero_deg", "laser_tilt_deg.x", "laser_tilt_deg.y", "focal_scale"),
)
"""Parameters of the correlation matrix, in order; those that were not estimated are left out."""


def setup_section(e: Evidence) -> Section:
    campaign, header = e.campaign, e.campaign.header
    ok = sum(spot.status == "ok" for spot in campaign.spots)
    targets = sorted({spot.target for spot in campaign.spots if spot.target})
    rows = [
        [label, str(header[key])]
        for key, label in (
            *(
                ("instrument", "instrument"),
                ("serial", "serial number"),
                ("operator", "operator"),
                ("method", "method"),
            ),
            *(("created", "measured or made"), ("notes", "notes")),
        )
        if header.get(key)
    ]
    rows += [
        ["moves, segments", f"{len(campaign.moves)}, {1 + campaign.moves[-1].segment}"],
        ["spots used, in all", f"{ok - len(e.fit['excluded_spots'])}, {len(campaign.spots)}"],
        ["placements of the sheet", ", ".join(targets) or "not named"],
    ]
    environment = header.get("environment") or {}
    for key, unit in (("temperature_degC", "degC"), ("humidity_percent", "%")):
        stated = environment.get(key)
        if stated:
            rows.append([key.split("_")[0], f"{stated['value']:g} {unit}, u = {stated['u']:g} {unit}"])
    parameters = e.fit["parameters"]
    names = [f"extrinsics.translation_mm.{a}" for a in "xyz"]
    where = [parameters[n]["value"] for n in names] if all(n in parameters for n in names) else None
    baseline = campaign.rig.priors["baseline_mm"].value
    views = [
        figure_view(
            figures.setup(campaign, where, baseline),
            "Positions of cameras, positioner and spots from above and from the side; the coordinates are in spots.csv "
            "and in the table of results",
            "The rig as estimated, frame S: left camera at the origin, X depth, Y left, Z up.",
        ),
        figure_view(
            figures.coverage(campaign),
            "Counters at which spots were seen, and where the spots lie in both images",
            "Data coverage. What lies outside of it is extrapolated.",
        ),
    ]
    return Section("Set-up and data", tables=[TableView("What was measured", [], rows)], figures=views)


def results_section(e: Evidence) -> Section:
    ratios, rows = e.fit["effective_deg_per_step"], []
    for direction in DIRECTIONS:
        joint = ratios.get(direction)
        classic = None if e.classic is None else e.classic.directions[direction]
        row = [direction]
        if joint is None:
            row += ["never moved", "", ""]
        else:
            low, high = joint["interval95"]
            row += [
                concise(joint["value"], joint["sd"]),
                interval_text(low, high, joint["sd"]),
                two_digits(0.5 * (high - low)),
            ]
        if e.classic is None:
            row += ["not applicable", ""]
        elif classic is None:
            row += ["no experiment", ""]
        else:
            row += [concise(classic.mean_deg_per_step, classic.u_gum_deg_per_step or 0.0), str(classic.n)]
        rows.append(row)
    pose = e.fit["reference_pose_deg"]
    columns = ["direction", "joint value(u)", "95 % interval", "half of it", "classic value(u)", "n"]
    caption = (
        f"Effective degrees of the beam per motor step at pan {pose['pan']:.2f} deg, tilt {pose['tilt']:.2f} "
        "deg, deg/step"
    )
    tables = [TableView(caption, columns, rows), _parameters(e)]
    joint_view = {d: None if x is None else (x["value"], tuple(x["interval95"])) for d, x in ratios.items()}
    classic_view = {}
    if e.classic is not None:
        classic_view = {
            d: None if r is None else (r.mean_deg_per_step, r.interval95_gum) for d, r in e.classic.directions.items()
        }
    views = [
        figure_view(
            figures.intervals(joint_view, classic_view),
            "Ratios of both estimators with 95 % intervals; values in the table above",
            "Effective ratios, joint (circles) and classic (triangles).",
        )
    ]
    text = [
        (
            "value(u): the digits in brackets are the standard uncertainty in units of the last "
            "place, or with their decimal point the uncertainty itself."
        )
    ]
    if e.classic is None:
        text.append("Classic: not applicable, the campaign has no complete four-point experiment.")
    else:
        for direction in DIRECTIONS:
            result = e.classic.directions[direction]
            if result is None:
                continue
            joint = ratios.get(direction)
            alt = f"{result.n} experiments moving {direction}: mean {result.mean_deg_per_step:.6f} deg/step"
            if result.sd_deg_per_step is not None:
                alt += f", standard deviation {result.sd_deg_per_step:.6f}"
            pair = None if joint is None else (joint["value"], joint["sd"])
            views.append(
                figure_view(
                    figures.direction_scatter(e.classic, direction, pair),
                    alt,
                    f"Experiments moving {direction}, with the mean and bands of 1, 2 and 3 sigma.",
                )
            )
    gaps = e.fit.get("gap")
    if gaps:
        tables.append(_gap_table(gaps))
        views.append(
            figure_view(
                figures.gap_terms(gaps),
                "Terms of the difference between both estimators; values in the table above",
                "Why the classic differs from the joint.",
            )
        )
    if e.fit.get("curves"):
        views.append(
            figure_view(
                figures.ratio_curves(e.fit["curves"]["effective_deg_per_step"]),
                "Effective ratios over the range of pan and tilt angles; values in fit.json",
                "Effective ratios over the range that was seen.",
            )
        )
    return Section("Results, classic beside joint", text, tables=tables, figures=views)


def _gap_table(gaps: Mapping[str, Mapping[str, object] | None]) -> TableView:
    found = {d: g for d, g in gaps.items() if g is not None}
    names = [term["name"] for term in next(iter(found.values()))["terms"]]

    def cell(term: Mapping[str, float]) -> str:
        text = concise(term["value"], term["sd"])
        return text if text.startswith("-") else f"+{text}"

    rows = [["classic - joint", *(cell(g["total"]) for g in found.values())]]
    rows += [[name, *(cell(g["terms"][k]) for g in found.values())] for k, name in enumerate(names)]
    return TableView("The gap between both estimators by its terms, deg/step", ["term", *found], rows)


def _parameters(e: Evidence) -> TableView:
    rows = []
    for name, x in e.fit["parameters"].items():
        if name.startswith("stereo.") or x["sd"] == 0:
            continue
        set_by = "" if x["contraction"] is None else ("data" if x["contraction"] >= CONTRACTION_LIMIT else "prior")
        contraction = "" if x["contraction"] is None else f"{x['contraction']:.2f}"
        diagnosis = "" if x["rhat"] is None else f"{x['rhat']:.3f}"
        rows.append(
            [
                name,
                concise(x["value"], x["sd"]),
                interval_text(*x["interval95"], x["sd"]),
                f"{x['prior_sd']:.2g}",
                contraction,
                set_by,
                diagnosis,
            ]
        )
    columns = ["parameter", "value(u)", "95 % interval", "u of the prior", "contraction", "set by", "R-hat"]
    return TableView("Parameters of the joint model; the unit is in the name", columns, rows)


def identifiability_section(e: Evidence) -> Section:
    covariance = e.fit["covariance"]
    names, matrix = covariance["names"], np.array(covariance["matrix"])
    kept = [n for n in CORRELATED if n in names and matrix[names.index(n), names.index(n)] > 0]
    views, rows = [], []
    if len(kept) > 1:
        index = [names.index(n) for n in kept]
        part = matrix[np.ix_(index, index)]
        sd = np.sqrt(np.diag(part))
        correlation = part / np.outer(sd, sd)
        for i in range(len(kept)):
            for j in range(i):
                if abs(correlation[i, j]) > 0.8:
                    rows.append([f"{kept[j]} and {kept[i]}", f"{correlation[i, j]:+.3f}"])
        views.append(
            figure_view(
                figures.correlations(kept, correlation),
                "Correlation matrix; every cell holds its value in per cent",
                "Correlations of the posterior.",
            )
        )
    items = [w["text"] for w in e.fit["weak_directions"]] + [entry["text"] for entry in e.fit["leverage"]]
    sensitive = [
        [
            f"{x['parameter']}, {'twice' if x['factor'] > 1 else 'half'} its u",
            x["quantity"],
            f"{x['shift_sd']:+.2f}",
            f"{x['sd_ratio']:.2f}",
        ]
        for x in e.fit["prior_sensitivity"]
    ]
    text = []
    if not items:
        text.append("Every direction that matters is set by the data; no single stop rules a headline.")
    caption = "Headlines that another prior would move: by how many of their sds, and the factor on the sd"
    columns = ["prior", "headline", "shift, sd", "sd, factor"]
    priors = TableView(caption, columns, sensitive) if sensitive else None
    table = TableView("Correlations beyond 0.8", ["parameters", "correlation"], rows) if rows else None
    return Section("What the data tell apart", text, items, [table, priors], views)


def residuals_section(e: Evidence) -> Section:
    causes = e.fit.get("residual_causes") or []
    noise = e.fit["noise"]
    text = [
        (
            f"chi-square {noise['chi2']:.1f} for {noise['dof']:.1f} degrees of freedom; the pixel "
            f"noise is {noise['pixel_scale']:.2f} times the stated one."
        )
    ]
    rows = [
        [
            f"{c['axis']}: {c['name']}",
            str(len(c["groups"])),
            "not tested" if c["p"] is None else f"{c['p']:.3f}",
            "SUSPICIOUS" if c["suspicious"] else "" if c["p"] is None else "no sign",
        ]
        for c in causes
    ]
    tables = (
        [TableView("Do the deviations of the stops depend on ...", ["cause", "groups", "p", "verdict"], rows)]
        if rows
        else []
    )
    groups = [
        [f"{c['axis']}, {c['name']}: {g['label']}", str(g["count"]), f"{g['mean']:+.2f}", f"{g['standard_error']:.2f}"]
        for c in causes
        for g in c["groups"]
        if len(c["groups"]) > 1
    ]
    if groups:
        tables.append(
            TableView(
                "Mean deviation of stops in units of its standard deviation",
                ["group", "count", "mean", "standard error"],
                groups,
            )
        )
    views = []
    for axis in ("pan", "tilt"):
        if any(c["axis"] == axis for c in causes):
            alt = f"Mean deviation by group, {axis} axis; values in the table above"
            views.append(figure_view(figures.causes(causes, axis), alt, f"{axis} axis: mean deviation by group."))
        stops = [x for x in e.fit.get("residuals") or [] if x["axis"] == axis]
        if stops:
            views.append(
                figure_view(
                    figures.residuals(stops, axis),
                    (
                        f"Deviations of {len(stops)} stops of the {axis} axis over time and counter; "
                        "group means in the table above"
                    ),
                    f"Stops of the {axis} axis: observed minus fitted angle.",
                )
            )
    return Section("Residuals by cause", text, tables=tables, figures=views)


def validation_section(e: Evidence) -> Section:
    text, items, tables = [], [], []
    validation = e.fit.get("validation")
    if validation is None:
        text.append("The results hold no tests for model errors: run the command fit again.")
    else:
        text.append(
            f"A clean campaign fails the tests below with a probability of {100 * validation['level']:g} %, all "
            f"together. Factor on every u: {validation['inflation']:.2f}."
        )
        tables.append(_tests(validation))
    sampling = e.fit.get("sampling")
    if sampling is None:
        text.append("The posterior was not sampled: intervals are those of the Laplace approximation.")
    else:
        worst, bulk, tail = (sampling[k] for k in ("worst_rhat", "least_ess_bulk", "least_ess_tail"))
        text.append(
            f"{sampling['walkers']} walkers, {sampling['steps']} steps; worst R-hat {worst['value']:.3f} "
            f"({worst['quantity']}); least effective draws {bulk['value']:.0f} in the bulk "
            f"({bulk['quantity']}) and {tail['value']:.0f} in the tails ({tail['quantity']})."
        )
        items += [f"UNCONVERGED: {sentence}" for sentence in sampling["missing"]]
    predicted = e.fit.get("classic_predicted_deg_per_step") or {}
    rows = []
    if e.classic is not None:
        for direction in DIRECTIONS:
            told, seen = predicted.get(direction), e.classic.directions[direction]
            if told is not None and seen is not None:
                spread = np.hypot(told["sd"], seen.u_type_a_deg_per_step or 0.0)
                z = (seen.mean_deg_per_step - told["value"]) / spread if spread > 0 else 0.0
                rows.append(
                    [
                        direction,
                        concise(told["value"], told["sd"]),
                        concise(seen.mean_deg_per_step, seen.u_type_a_deg_per_step or 0.0),
                        f"{z:+.1f}",
                    ]
                )
    if rows:
        tables.append(
            TableView(
                "What the joint model says the classic estimator should report, and what it reports, deg/step",
                ["direction", "foretold", "reported, type A", "difference / u"],
                rows,
            )
        )
    if e.held_out is None:
        text.append(
            "Held-out experiments: not computed; run the command compare on the campaign and make the report again."
        )
    else:
        text.append(_held_out(e.held_out["held_out"], tables))
    return Section("Validation", text, items, tables)


def _held_out(held: Mapping[str, object], tables: list[TableView]) -> str:
    """Its tables are appended; the verdict is returned."""
    if held["classic"] is not None:
        rows = [
            [
                name,
                f"{held[name]['rms_deg']:.3f}",
                f"{held[name]['rms_block_deg']:.3f}",
                f"{100 * held[name]['coverage']:.0f} %",
            ]
            for name in ("classic", "joint")
        ]
        tables.append(
            TableView(
                "Angles of experiments that were left out, deg",
                ["estimator", "rms error", "rms of block means", "inside 95 % intervals"],
                rows,
            )
        )
    rows = [[d, f"{u:.1e}"] for d, u in held["unseen"].items()]
    tables.append(
        TableView(
            "What no hold-out sees: u by stereo calibration and focal scale, common to all spots, deg/step",
            ["direction", "u"],
            rows,
        )
    )
    return f"Held-out experiments: {held['verdict']}: {held['reason']}."


def _tests(validation: Mapping[str, object]) -> TableView:
    """Every test for a model error, the least p first."""
    rows = [
        [
            t["name"],
            t["where"],
            f"{t['chi2']:.1f}",
            str(t["dof"]),
            f"{t['p']:.2g}",
            "FAILED" if t["failed"] else "no sign",
        ]
        for t in validation["tests"]
    ]
    columns = ["sign of", "most at", "chi-square", "degrees of freedom", "p, all places", "verdict"]
    return TableView("Tests for errors that the model does not have", columns, rows)
