"""The planted faults: what a user would suffer in a sentence, where, what changes, and a test that must fail.

A place is a qualified name and a test the name of a function: moving or renaming files leaves the entries.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from experiments.common.rows import ROOT
from experiments.robustness.faults.changes import (
    Argument,
    Call,
    Change,
    Constant,
    Keyword,
    Local,
    Never,
    NoPlace,
    Reads,
    Returns,
    Sources,
    Uncalled,
)


class Fault(NamedTuple):
    """A bug as behaviour: what it does, in a unique sentence; where; what becomes of it; the test that must fail."""

    sentence: str
    place: str
    change: Change
    test: str


FAULTS = (
    # Heads: their URDF, and what is watched of them.
    Fault("the azimuth zero of a URDF has the wrong sign", "urdf.head_joints", Reads("azimuth", "-value"),
          "test_terms_of_joints_are_those_of_the_chain"),
    Fault("a quaternion of a calibration turns the other way", "stereo_programs.rigid", Reads("w", "-value"),
          "test_the_same_pair_in_the_files_of_every_program"),
    Fault("a correction is applied to a model that has it", "HeadModel.urdf", Never("before"),
          "test_an_estimated_head_is_what_another_parser_reads"),
    # Mirrors, gears, cameras: the model.
    Fault("the contrast of the ratios has the wrong sign", "laser_path.followed",
          Reads("transmission.contrast_rad_per_step", "-value"),
          "test_contrast_is_positive_minus_negative_ratio"),
    Fault("the backlash has the wrong sign", "laser_path.followed", Local("half", "-value"),
          "test_first_row_of_a_segment_rehomes_with_the_mean_ratio"),
    Fault("the creep of the zeros has the wrong sign", "shift_rad", Local("share", "-value"), "test_zeros_in_time"),
    Fault("the mirror offset has the wrong sign", "beam_angles", Local("offset", "-value"),
          "test_beam_angles_of_the_nominal_chain"),
    Fault("the right camera stands on the left", "geometry.image", Reads("cameras.translation_mm", "-value"),
          "test_projection_is_opencvs"),
    Fault("the effective ratio leaves out the slope of the beam", "headlines.effective_deg_per_step",
          Local("slope", "value**0"), "test_headlines_of_a_fit"),
    Fault("the play's variation has the sign of the other side", "places.seen_places", Local("sign", "-value"),
          "test_looks_have_the_error_of_their_counter_and_half_the_play_of_their_side"),
    Fault("the transmission error is rougher than stated", "matern52", Returns("(1 + scaled) * np.exp(-scaled)"),
          "test_the_factor_is_that_of_the_covariance_of_both_processes"),
    # Stops, homings, likelihood, priors.
    Fault("a homing is drawn once instead of anew", "redraws", Local("homed", "value & (np.cumsum(value) <= 1)"),
          "test_filter_equals_dense_gaussian"),
    Fault("a stop error is drawn anew while its axis stands", "redraws", Local("redraw", "value | value[:, ::-1]"),
          "test_filter_equals_dense_gaussian"),
    Fault("the drift of the zero is left out of the filter", "zero_variances", Reads("spots.hours", "0 * value"),
          "test_log_density_is_that_of_the_dense_gaussian"),
    Fault("the log-determinant of the stop errors is dropped", "campaign_sums",
          Reads("after.log_variance", "0 * value"), "test_filter_equals_dense_gaussian"),
    Fault("stop errors and zeros are forgotten between blocks of spots", "campaign_sums",
          Call("filtered", "function(arg0, jax.tree.map(jnp.zeros_like, arg1))"),
          "test_blocks_of_spots_are_one_campaign"),
    Fault("a spot counts four residuals instead of three", "spot_residuals.spot_residuals",
          Reads("model.noise.pixel_scale", "value ** (4 / 3)"), "test_range_is_flat_in_image_displacement"),
    Fault("the Jacobian of the aperture's range is dropped", "spot_residuals.spot_residuals",
          Call("log1p", "0 * value"), "test_range_is_flat_in_image_displacement"),
    Fault("the right camera has the left one's correlation", "Spot.pixel_covariance",
          Reads("self.ruv_right", "self.ruv_left"), "test_range_is_flat_in_image_displacement"),
    Fault("the stereo covariance enters with its root transposed", "look_jacobian.look_jacobian",
          Reads("space.stereo_root.T", "space.stereo_root"), "test_parts_make_the_whole"),
    Fault("degrees are taken for radians", "parameter_space.scale_of", Returns("value**0"),
          "test_every_name_drives_its_field_and_nothing_else"),
    Fault("prior sds count twice", "parameter_space._values", Reads("space.u", "2 * value"),
          "test_physical_values_are_scipys_quantiles"),
    Fault("the half-normal prior has the wrong tail", "priors.half_normal", Argument("z", "-value"),
          "test_physical_values_are_scipys_quantiles"),
    # Pictures: which camera, which look.
    Fault("directions beside up and down are taken for cameras", "named_cameras", Local("directions", "False"),
          "test_one_direction_is_a_camera_only_without_up_and_down"),
    Fault("a direction before an experiment is taken for the camera", "picture_pairs._marks",
          Local("is_prefix", "False"), "test_a_direction_is_no_camera"),
    Fault("numbers of experiments in names of pictures are taken for moves", "look_pictures._counted", Returns("''"),
          "test_numbers_of_experiments_are_no_moves"),
    Fault("pairs of pictures that are guessed are not asked about", "paired_pictures", Local("guessed", "{}"),
          "test_names_that_do_not_decide_are_asked"),
    Fault("of pictures with one name in several folders the first is taken", "book_pictures._meant",
          Local("found", "value[:1]"), "test_a_book_names_either_picture_or_what_both_share"),
    Fault("a picture of two looks is taken for both", "book_pictures._refuse_shared", Local("other", "spot"),
          "test_a_picture_of_two_looks_is_refused_by_name"),
    Fault("looks of a lab book are dropped", "look_rows", Local("is_book", "False"),
          "test_what_is_read_of_a_table"),
    Fault("pictures that are mixed up are refused without a word", "Detection.warnings", Returns("[]"),
          "test_pictures_that_are_mixed_up_are_said"),
    # The classic estimator and its uncertainty.
    Fault("left and right of the triangulated points are exchanged", "triangulate", Local("x", "-value"),
          "test_worked_example_of_the_paper"),
    Fault("the second slope of the four points has the wrong sign", "four_point_angle_deg", Local("after", "-value"),
          "test_worked_example_of_the_paper"),
    Fault("experiments of two directions with one number are taken for one", "experiments_of", Local("seen", "[set()]"),
          "test_numbers_that_begin_anew_in_each_direction_are_read"),
    Fault("a plot of an experiment takes the first direction with its number", "figures._row_of",
          Local("rows", "value[:1]"), "test_the_papers_figures_for_any_campaign"),
    Fault("the mean of repeats is as uncertain as one of them", "four_point._direction", Local("type_a", "sd"),
          "test_statistics_of_known_ratios"),
    Fault("correlations of the stereo calibration are left out", "stereo_variance",
          Local("covariance", "np.diag(np.diag(value))"), "test_the_stereo_covariance_counts_with_its_correlations"),
    Fault("U95 is taken with k = 1.64", "NORMAL_95", Constant("1.6448536269514722"),
          "test_95_percent_are_two_sided_and_normal"),
    # Sampling, weights, convergence.
    Fault("the Jacobian of the map is dropped", "Target.at", Reads("mapped.log_jacobian", "0 * value"),
          "test_the_density_of_walkers_is_the_models_times_the_jacobian"),
    Fault("the acceptance of independent proposals is upside down", "Proposal.__call__",
          Returns("(value[0], -value[1])"), "test_the_proposal_density_and_draws_agree_in_many_dimensions"),
    Fault("rounds of importance sampling of other sizes count the same", "Pool.log_weights",
          Local("share", "0 * value - np.log(len(value))"),
          "test_weights_are_the_target_over_the_mixture_of_all_proposals"),
    Fault("homing hypotheses are as probable as their evidence alone", "Way.log_evidence",
          Returns("value - np.log(prior_chance(self.pool.density.fit.sides))"),
          "test_a_way_is_as_probable_as_firmware_homes_that_way"),
    Fault("what is integrated out is drawn from the same numbers for every seed", "Pool.extended",
          Local("integrated_out", "random_stream(len(self.drawn), Stream.POOLED_ROUNDS)"),
          "test_numbers_of_what_is_integrated_out_are_of_the_seed_and_of_no_other_round"),
    Fault("weights with a Pareto k of 2 pass", "importance.K_MAX", Constant("2.0"),
          "test_the_tail_index_that_draws_can_bear_grows_with_their_number"),
    Fault("posterior sds are a fifth too small", "weighted_summary", Keyword("sd", "0.8 * value"),
          "test_equal_weights_are_none"),
    Fault("intervals called 95 % hold 90 %", "weighted_draws.TAILS", Constant("(0.05, 0.95)"),
          "test_monte_carlo_errors_are_those_of_draws_with_memory"),
    Fault("R-hat up to 1.1 passes", "RHAT_LIMIT", Constant("1.1"), "test_groups_of_other_means_are_told_by_r_hat"),
    Fault("predicted spots leave out the homing's scatter", "looks_again", Local("home", "0 * value"),
          "test_every_look_scatters_by_its_direction_its_homing_and_its_play"),
    # Judging a fit, comparing, watching.
    Fault("a fit's degrees of freedom are n instead of n - p", "summarise", Local("determined", "0.0"),
          "test_dof_counts_spots_less_what_they_determine"),
    Fault("a failed validation is no verdict", "fit_text.failed", Returns("None"),
          "test_no_reader_of_the_text_can_miss_a_failure"),
    Fault("cameras that two campaigns share count twice", "changes.compare", Local("shared", "False"),
          "test_a_calibration_has_not_changed_from_itself"),
    Fault("the classic and the joint estimate change places in the hold-out", "held_out.judge",
          Local("ratio", "1 / value"), "test_scores_of_predictions_by_hand"),
    Fault("watching ignores that it tests many things", "null_distribution", Call("min", "own[0]"),
          "test_false_alarms_and_power_are_those_of_the_linear_model"),
    Fault("a watched change was there from the first day", "WatchedLooks.linear", Reads("self.first", "0"),
          "test_the_departure_is_that_of_a_dense_gaussian"),
    # Locating, aiming, loading a robot.
    Fault("a stop is taken for one from the other side", "Calibration.noisy_beam",
          Argument("sides", "tuple(-side for side in value)"), "test_every_draw_goes_through_the_twins_optics"),
    Fault("a reading leads to the other root of the cone", "range_components", Local("root", "-value"),
          "test_the_reading_of_a_point_leads_back_to_it"),
    Fault("steps to a point are those of the other approach", "Drive.counter", Argument("side", "-value"),
          "test_steps_for_a_point_come_back_to_it"),
    Fault("the run-up begins on the wrong side", "Drive.arrival", Reads("self.overshoot_steps", "-value"),
          "test_the_approach_is_obeyed_or_the_other_side_is_taken"),
    Fault("errors of the gears are taken off instead of added", "optics.output_deg", Reads("error", "-value"),
          "test_a_constant_error_is_a_zero_and_a_constant_change_is_play"),
    Fault("counters that were never seen are not named", "counter_limits.unseen", Returns("''"),
          "test_counters_that_no_look_reached_are_told"),
    # Planning.
    Fault("the information of the last row is dropped", "expectation.information_of", Local("rows", "value[:-1]"),
          "test_a_plans_information_is_the_fits_own"),
    Fault("a study's assurance leaves out the fits that failed", "study_result", Keyword("assurance", "hits / n"),
          "test_failures_count_against_the_assurance"),
    # Reports, certificates, exit codes.
    Fault("ISO 230-2 accuracy is taken with one sd", "iso230.iso230", Local("high_up", "mean_up + s_up"),
          "test_figures_of_the_published_readings"),
    Fault("deviations of ISO 230-2 are taken off a line", "position_runs",
          Argument("deviation", "value - np.polyval(np.polyfit(rows.command, value, 1), rows.command)"),
          "test_figures_are_those_of_the_standard"),
    Fault("a certificate states the whole width as expanded uncertainty", "dcc_real", Local("expanded", "2 * value"),
          "test_ratios_stand_with_expanded_uncertainty_and_backlash_with_its_own"),
    Fault("uncertainties are printed twice as large", "display.concise", Argument("sd", "2 * value"),
          "test_concise_shows_two_digits_of_the_uncertainty"),
    Fault("what must not be used ends with exit code 0", "app.finish", Call("Ended", "function(0)"),
          "test_a_fit_that_did_not_converge_is_exit_4"),
    Fault("numbers of an axis that must not be used are offered to firmware", "axis_fit_text",
          Reads("summary.explained", "True"), "test_what_the_text_of_an_axis_adds"),
    # Files and their refusals.
    Fault("a cell that is no number is accepted", "Table.numbers", Never("isfinite"),
          "test_message_tells_place_found_allowed_and_remedy"),
    Fault("a mirrored rotation of the cameras is accepted", "stereo_pair._rotation", Call("det", "1.0"),
          "test_stereo_refusals_name_line_and_key"),
    Fault("pixels counted from 1 are moved the wrong way", "importing.looks._looks",
          Reads("cells.wishes.pixels_from", "-value"), "test_what_is_read_of_a_table"),
    Fault("an expanded uncertainty is taken for a standard one", "axis_units._standard_u", Local("coverage", "None"),
          "test_forty_tables_are_read_rightly_or_asked_about"),
    Fault("decimal commas are dropped", "importing.table._with_point",
          Returns("value.replace('.', '') if commas else value"), "test_every_notation_gives_the_same_table"),
    Fault("runs below each other lose the directions of their titles", "importing.table.side_named", Returns("''"),
          "test_what_is_read_of_a_table"),
    Fault("the mount of a guide log leads where it lags", "guide.rows_of_run", Local("sign", "-value"),
          "test_the_uncorrected_motion_is_that_of_the_mount"),
    Fault("a clock set back from summer time loses its hour", "clock.forward", Local("is_summer", "False"),
          "test_the_end_of_summer_time_is_an_hour_less_the_usual_step"),
    Fault("a file is renamed before it is on the disk", "written_whole", Call("fsync", "None"),
          "test_interrupted_write_leaves_the_old_file_whole"),
    Fault("a second import puts its files among those of the first", "disk._move_into",
          Keyword("exist_ok", "True"), "test_of_two_writers_of_a_new_folder_one_wins_whole"),
    # Results that belong together.
    Fault("a fit takes draws of another id", "store._of_one_fit", Returns("True"),
          "test_files_of_two_fits_are_not_taken_together"),
    Fault("fit.json is written before its draws", "store.write_fit",
          Call("write_together", "write_together(arg0, dict(reversed(arg1.items())))"),
          "test_a_process_that_ends_between_two_files_leaves_no_fit_that_is_taken"),
    Fault("two processes fit into one folder at once", "store.sole_writer", Never("is_alone"),
          "test_two_fits_of_a_folder_are_refused_and_two_folders_are_not"),
    Fault("Python takes the fit of data that were edited since", "pipeline._loaded", Local("inputs", "None"),
          "test_python_refuses_the_fit_of_edited_data"),
    Fault("an output replaces the data of a campaign", "app.check_output", Never("is_input"),
          "test_no_output_replaces_the_data_of_a_campaign"),
    # Acquisition: light, positions, lost events.
    Fault("the laser stays on when a camera fails", "CameraObserver.observe", Call("laser", "value if arg0 else None"),
          "test_pictures_of_the_twin"),
    Fault("a laser that was left on stays on in motion", "SerialPositioner.move_to", Never("_lit"),
          "test_a_laser_left_on_is_off_in_motion"),
    Fault("the firmware's guard darkens the laser and replies say light", "Core::darkened", Uncalled("set_laser"),
          "test_replies_say_that_the_guard_has_darkened_the_laser"),
    Fault("the sketch has no watchdog of the processor", "setup", Uncalled("start_watchdog"),
          "test_sketch_resets_itself_and_darkens_in_a_fault"),
    Fault("arrival is not compared with the order", "SerialPositioner.move_to", Never("reached"),
          "test_done_at_another_place_is_no_arrival"),
    Fault("a reset of the device is not noticed", "SerialPositioner._check", Never("boot"),
          "test_refusals_and_alarms_are_named"),
    Fault("a line of the journal with a wrong CRC counts", "parse_line", Never("crc"),
          "test_every_byte_flipped_is_found"),
    Fault("lost events inside the journal are not noticed", "journal._following", Never("previous"),
          "test_lost_doubled_swapped_and_foreign_lines_are_found"),
    Fault("a lost end of the journal is not noticed", "journal_check._compared", Never("looks"),
          "test_a_journal_that_lost_its_end_is_told_from_tables_behind"),
    Fault("spots behind lost steps stay good", "Recorded.spots", Never("lost"),
          "test_pictures_of_a_segment_with_lost_steps_no_longer_wait_for_detection"),
    Fault("a proposal is followed that the rig cannot run", "Acquisition._update_estimate", Call("check_plan", "None"),
          "test_a_proposal_that_the_rig_cannot_run_is_not_followed"),
    # Pictures.
    Fault("centres of spots are half a pixel off", "fit_spot", Local("centre", "value + 0.5"),
          "test_stated_sd_is_the_actual_error_without_speckle"),
    Fault("any pair of spots passes the epipolar test", "epipolar_refused", Returns("value & False"),
          "test_a_pair_off_its_epipolar_lines_is_refused"),
    Fault("the stereo calibration divides by n instead of n - p", "bundle_adjustment.bundle_adjustment",
          Local("dof", "int(seen.sum())"), "test_degrees_of_freedom_are_coordinates_less_unknowns"),
    # Outputs and plans.
    Fault("an output replaces whatever file is there", "app.check_output", Call("require_own", "None"),
          "test_a_page_replaces_pages_only"),
    Fault("a plan goes by moves that an import added", "AxisCampaign.range_allowed",
          Returns("self.limits or (min(m.command for m in self.moves), max(m.command for m in self.moves))"),
          "test_no_plan_goes_where_an_import_thought_that_the_axis_was"),
    Fault("the run-ups of a verification leave the limits", "verification.reachable_stops",
          Argument("run_up", "0.0 * value"), "test_a_verification_stays_within_the_limits"),
    Fault("an absolute zero stands still between two folders", "PredictedAxis.read", Local("pause", "0.0"),
          "test_an_absolute_zero_walks_on_between_the_folders"),
    Fault("the promise of an absolute axis forgets the walk in its campaign", "PredictedAxis._walked_hours",
          Returns("0.0"), "test_an_absolute_encoder_promises_of_all_errors"),
    # A run.
    Fault("a program under the place command's wrapper moves on", "place_command._signalled",
          Call("killpg", "process.send_signal(arg1)"), "test_the_program_below_a_wrapper_is_ended_with_it"),
    Fault("a place command's whole output is held", "place_command.OUTPUT_BYTES_MAX", Constant("10**9"),
          "test_a_flood_is_read_and_never_more_than_64_kb_of_it_held"),
    # The twin.
    Fault("simulated stop errors are drawn anew while the axis stands", "physics.stop_errors",
          Argument("counters", "value + 1e-9 * np.arange(len(value))"), "test_stop_errors_persist_and_are_redrawn"),
    Fault("simulated drift goes on over a homing", "gear_errors.drift_deg", Argument("first", "0 * value"),
          "test_drift_grows_with_the_root_of_time_and_restarts_at_a_homing"),
    Fault("true ratios of two directions are exchanged", "true_headlines.effective_deg_per_step",
          Local("half", "-value"), "test_the_headline_is_the_line_through_the_looks"),
    # Studies.
    Fault("a row of a study counts whatever its numbers are", "StudyRows._take", Call("_digest", "stated"),
          "test_a_row_that_does_not_say_what_was_written_is_made_again"),
    # One axis.
    Fault("an axis is homed from the wrong side", "play_places", Local("approach", "-value"),
          "test_play_is_the_clip_of_the_definition"),
    Fault("an axis' stop error is drawn anew while it stands", "axis_rows._redrawn", Returns("value | True"),
          "test_repeats_at_one_stop_share_its_error"),
    Fault("a left-out reading is predicted on its other side", "AxisModel.left_out", Local("expected", "-value"),
          "test_rows_left_out_are_the_conditional_of_the_dense_gaussian"),
    # Data that say less than they seem to.
    Fault("a sensor's code is taken for a temperature", "conditions.FAR_K", Constant("1e12"),
          "test_codes_of_a_sensor_are_doubted_where_neighbours_are_far"),
    Fault("a campaign's own looks confirm it", "copies.COPIED_SHARE", Constant("2.0"),
          "test_looks_that_were_seen_before_are_refused"),
    Fault("a term that sightings do not determine is fitted", "pointing_model.OWN_SHARE", Constant("-1.0"),
          "test_least_squares_hold_what_one_axis_does_not_determine"),
    Fault("a command with a digit too many is believed", "stops.LONE_RANGES", Constant("1e12"),
          "test_a_command_with_a_digit_too_many_is_doubted"),
    Fault("compiled code under another function's name is run", "own_folder._seal", Reads("name", "''"),
          "test_a_file_under_anothers_name_is_none"),
    Fault("a homing sets an absolute zero", "redraws", Argument("absolute", "()"),
          "test_homings_shift_the_zeros_by_their_scatter"),
    Fault("a homing sets the absolute zero of an axis", "axis_rows._hours", Argument("zero", "np.arange(len(value))"),
          "test_the_filter_is_the_dense_gaussian"),
    Fault("a table holds another state at every place", "PredictedAxis.expected",
          Local("state", "value._replace(warm_hours=np.arange(len(command)) % 5 / 5)"),
          "test_a_table_is_of_one_state_while_the_zero_grows"),
    Fault("homings scatter by their median, whatever is estimated", "zero_variances",
          Reads("model.noise.home_sd_rad", "0 * value + 0.05 * jnp.pi / 180"),
          "test_homings_shift_the_zeros_by_their_scatter"),
    Fault("the scatter of homings is estimated of a single one", "Problem.__init__", Local("homed", "value | True"),
          "test_the_scatter_of_homings_is_estimated_where_several_were_seen"),
    Fault("a homing hypothesis of an absolute encoder is weighed", "homing.unrecorded", Reads("rig.absolute", "()"),
          "test_no_way_of_homing_is_weighed_of_an_absolute_encoder_or_without_play"),
    Fault("errors that the priors fix at 0 have columns", "vary_by_position", Returns("np.ones((2, 2), dtype=bool)"),
          "test_errors_that_the_priors_fix_have_no_column"),
    # Compensation.
    Fault("corrections of both sides change places", "Correction.sent", Argument("side", "-value"),
          "test_both_sides_are_linear_between_lines_and_constant_beyond"),
    Fault("LinuxCNC's table has the wrong sign", "formats._triplets",
          Local("sides", "(-value[0], -value[1])"), "test_linuxcnc_sends_the_corrected_command_by_its_rule"),
    Fault("a table is made of a fit that is not accepted", "refuse_answer", Never("answer"),
          "test_no_table_is_made_of_what_is_not_accepted"),
    Fault("a scanner's lost play goes for a kept promise", "AimedLooks.off_deg", Local("half", "0 * value"),
          "test_every_world_is_named"),
    Fault("a calibration stands at the homing, not at its state", "states.shifts_at",
          Local("shifts", "[0 * each for each in value]"), "test_a_calibration_is_of_one_state"),
    Fault("a table by phase serves one turn alone", "Correction.sent", Local("at", "command"),
          "test_the_correction_repeats_with_the_period"),
    Fault("the camera's ray has the axes of the stereo frame", "frames.OPENCV_AXES", Constant("np.eye(3)"),
          "test_frame_s_is_where_the_twins_light_goes"),
    Fault("stored draws that are repeats count once", "stored_posterior._merged",
          Local("weights", "value * 0 + 1 / len(value)"), "test_a_scanners_draws_and_what_is_carried"),
    Fault("a fault of the play alone goes for a kept promise", "verification.SEPARATE", Constant("1e12"),
          "test_every_world_is_named"),
)  # fmt: skip


def tests_of(name: str, root: Path = ROOT) -> list[str]:
    """Arguments of pytest for the test functions of a name, wherever they stand."""
    places = (path for path in sorted((root / "tests").rglob("test_*.py")) if f"def {name}(" in path.read_text("utf-8"))
    return [f"{path.relative_to(root)}::{name}" for path in places]


def misfits(root: Path = ROOT) -> list[str]:
    """Entries that stand twice, find no place or no test, or leave no Python; empty if the list fits the tree."""
    sources, problems = Sources(root), []
    tests = " ".join(path.read_text("utf-8") for path in (root / "tests").rglob("test_*.py"))
    names = set(re.findall(r"^def (test_\w+)", tests, re.MULTILINE))
    for fault in FAULTS:
        try:
            path, text = fault.change.planted(sources, fault.place)
            if path.suffix == ".py":
                compile(text, path, "exec")
        except (NoPlace, SyntaxError) as error:
            problems.append(f"{fault.sentence}: {error}")
        if fault.test not in names:
            problems.append(f"{fault.sentence}: no {fault.test}")
        if sum(fault.sentence == other.sentence for other in FAULTS) > 1:
            problems.append(f"{fault.sentence}: twice")
    return problems
