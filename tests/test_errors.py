"""Errors state place, found, allowed and remedy, and are pickled completely."""

from __future__ import annotations

import inspect
import pickle

import pytest

import tvsbayes
from tvsbayes.errors import DeviceFault, InputError, NotConverged, NothingToEstimate, TvsError
from tvsbayes.files.csv_table import parse_table


def test_message_tells_place_found_allowed_and_remedy():
    table = parse_table(b"a,b\n1,2\n3,nan\n", "spots.csv", ("a", "b"))
    with pytest.raises(InputError) as caught:
        table.numbers("b", float, 0.0, 10.0)
    error = caught.value
    assert error.message == (
        'spots.csv line 3, b: found "nan"; allowed: a finite decimal number from 0 to 10; '
        "write a finite number; the pixels of a spot that was not seen are empty, its status says why"
    )
    assert (error.code, error.file, error.line, error.column) == ("number", "spots.csv", 3, "b")
    assert isinstance(error, TvsError) and error.exit_code == 2
    assert error.found and error.allowed and error.remedy and str(error) == error.message


@pytest.mark.parametrize("kind", [TvsError, InputError, NothingToEstimate, NotConverged, DeviceFault])
def test_errors_are_pickled_completely(kind):
    """A pool that cannot unpickle a worker's error never returns."""
    error = kind("code", "what was found", file="a.csv", line=3, column="u_px", found="x", allowed="y", remedy="z")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind and again.args == error.args and vars(again) == vars(error)


@pytest.mark.parametrize(
    ("called", "wanted"),
    [
        # As users call it: the tests' own check of types comes first.
        (lambda: inspect.unwrap(tvsbayes.fit)("data/twins/paper_twin"), "found str; wanted a campaign, as read"),
        (lambda: tvsbayes.sample("fit.json"), "found str; wanted a fit, as fit"),
        (lambda: tvsbayes.locate(3.0, 0, 0, 60.0), "found float; wanted a calibration, of calibration_of"),
    ],
)
def test_a_python_argument_of_the_wrong_type_is_named(called, wanted):
    with pytest.raises(TypeError, match=wanted):
        called()
