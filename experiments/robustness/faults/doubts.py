"""Faults of chances and of what is doubted."""

from experiments.robustness.faults.fault import Fault

FAULTS = (
    Fault(
        "gross defects infinitely improbable",
        "statistics/chances.py",
        "    found[beyond] = far\n",
        "",
        "two gross defects tie, the wrong one is named",
        ("statistics/chances",),
    ),
    Fault(
        "continued fraction with the sign of its terms turned",
        "statistics/chances.py",
        "rest = term * (term - a) / (x + 2 * term + 1 - a - rest)",
        "rest = term * (a - term) / (x + 2 * term + 1 - a - rest)",
        "p of gross defects off by orders",
        ("statistics/chances",),
    ),
    Fault(
        "quantile of a single draw is not a number",
        "statistics/weighted_draws.py",
        "reach = middle[-1] - middle[0] or 1.0",
        "reach = middle[-1] - middle[0]",
        "NaN for an interval where one draw has all weight",
        ("statistics/weighted_draws::test_one_draw_of_all_weight_is_every_quantile",),
    ),
    Fault(
        "doctor runs files of the working folder",
        "model/compilation_cache.py",
        '[sys.executable, "-P", "-c", code],',
        '[sys.executable, "-c", code],',
        "a stranger's json.py is executed",
        ("model/compilation_cache::test_what_one_process_leaves_the_next_one_takes",),
    ),
    Fault(
        "repeated look called a fault of the lens",
        "estimators/four_point.py",
        "lost = not np.isfinite(points[row]).all()",
        "lost = True",
        "somebody calibrates the cameras again because of a row written twice",
        ("estimators/four_point::test_a_look_written_down_twice_is_no_fault_of_the_lens",),
    ),
    Fault(
        "cameras calibrated after the campaign pass",
        "estimators/plausibility.py",
        "if days[1] <= days[0]:",
        "if days[1] >= days[0]:",
        "a calibration of moved cameras is believed, a good one doubted",
        ("estimators/plausibility::test_cameras_calibrated_after_the_campaign_are_named",),
    ),
    Fault(
        "a knock from the difference between sheets",
        "estimators/spot_pattern.py",
        "abs(step) < KNOCK_PX or abs(step) <",
        "abs(step) < KNOCK_PX / 1000 or abs(step) < 0 *",
        "good campaigns are said to have moved cameras",
        ("estimators/spot_pattern",),
    ),
    Fault(
        "waves over a range of nought",
        "assessment/score_tests.py",
        "periods = reach / np.arange(1, min(WAVES, 2 * stops) + 1) if reach else ()",
        "periods = reach / np.arange(1, min(WAVES, 2 * stops) + 1)",
        "warnings of NumPy instead of words",
        ("assessment/score_tests::test_an_axis_that_a_search_has_left_without_motion_has_no_waves",),
    ),
)
