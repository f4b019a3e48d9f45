"""Faults of axis campaigns: play, processes, filter, what is foretold."""

from experiments.robustness.faults.fault import Fault

FAULTS = (
    Fault(
        "homed side the wrong way round",
        "single_axis/axis_rows.py",
        "side = -float(legs.side[move]) * turned",
        "side = float(legs.side[move]) * turned",
        "the first stops of an axis off by the whole play",
        ("single_axis/axis_rows::test_play_is_the_clip_of_the_definition",),
    ),
    Fault(
        "play that varies counted twice",
        "single_axis/axis_model.py",
        "= 0.5 * play.share[:, :, None] * self._weights",
        "= play.share[:, :, None] * self._weights",
        "half the variation of the play, and u of reversals wrong",
        ("single_axis/axis_model::test_the_filter_is_the_dense_gaussian",),
    ),
    Fault(
        "drift that goes on over a homing",
        "single_axis/axis_model.py",
        "if k and rows.segment[k] != rows.segment[k - 1]:",
        "if k and rows.segment[k] < rows.segment[k - 1]:",
        "zeros of homings tied to each other, u too small",
        ("single_axis/axis_model::test_the_filter_is_the_dense_gaussian",),
    ),
    Fault(
        "held stop errors drawn anew",
        "single_axis/axis_rows.py",
        "return np.array([True, *(changes[after] > changes[before] for before, after in pairwise(moves))])",
        "return np.array([True, *(changes[after] >= changes[before] for before, after in pairwise(moves))])",
        "repeats at one standstill count as independent stops: u too small",
        ("single_axis/axis_rows::test_repeats_at_one_stop_share_its_error",),
    ),
    Fault(
        "half-normal taken for the normal",
        "single_axis/axis_parameters.py",
        "log_ndtr(-z) - np.log(2.0)",
        "log_ndtr(-z)",
        "negative sds, and priors twice as wide",
        ("single_axis/axis_parameters::test_coordinates_have_the_quantiles_of_their_priors",),
    ),
    Fault(
        "foretold on the wrong side of the reading",
        "single_axis/axis_model.py",
        "means[part] = self.rows.value[rows] - found[:, self.columns :]",
        "means[part] = self.rows.value[rows] + found[:, self.columns :]",
        "every hold-out off by twice its miss",
        ("single_axis/axis_model::test_rows_left_out_are_the_conditional_of_the_dense_gaussian",),
    ),
    Fault(
        "between positions an axis is as certain as its positions say",
        "single_axis/axis_model.py",
        "covariances[part, own[:, None], own] += free @ np.swapaxes(free, 1, 2)",
        "covariances[part, own[:, None], own] += 0 * free @ np.swapaxes(free, 1, 2)",
        "the band of the error by position is too narrow where nothing was read",
        ("single_axis/axis_model::test_places_that_no_row_hangs_on_are_foretold_from_those_that_rows_do",),
    ),
)
