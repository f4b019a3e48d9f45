"""A GRBL board as positioner, against a model of its documented protocol: arrival, light, faults by name."""

from __future__ import annotations

import pytest
from support.grbl_board import BoardLink, GrblBoard
from support.pseudo_terminal import answered, needs_pseudo_terminals

from tvsbayes.acquisition.simulated_instrument import ModelLink, SimulatedDevice, VirtualClock
from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.positioner.firmware_model import Mechanics
from tvsbayes.positioner.grbl import (
    GrblPositioner,
    GrblSettings,
    parse_greeting,
    parse_modes,
    parse_setting,
    parse_status,
)
from tvsbayes.positioner.interface import PositionLost
from tvsbayes.positioner.serial_port import serial_opener

LIMITS = CounterLimits({"pan": (-500, 1000), "tilt": (-500, 500)})


def connected(board: GrblBoard, **changes) -> GrblPositioner:
    settings = GrblSettings(**{"unwatched": True, "limits": LIMITS, **changes})
    return GrblPositioner(lambda: BoardLink(board), settings, board.clock)


def homed(settings: dict[int, float] | None = None, **changes) -> tuple[GrblBoard, GrblPositioner]:
    board = GrblBoard(settings)
    positioner = connected(board, **changes)
    positioner.home()
    return board, positioner


def test_messages_of_a_board():
    status = parse_status("<Idle|MPos:5.529,-0.560,7.000|FS:0,0|WCO:0.000,1.551,5.664|Pn:XZ>")
    assert status is not None and (status.state, status.position_mm, status.pins) == ("Idle", (5.529, -0.56), "XZ")
    assert parse_status("<Hold:0|MPos:0.000,0.000,0.000>").state == "Hold"
    for line in ("<Idle|WPos:1,2,3>", "ok", "<Idle|MPos:1,x>", "[MSG:Reset to continue]"):
        assert parse_status(line) is None
    assert parse_setting("$100=250.000") == (100, 250.0) and parse_setting("$N0=G20") is None
    assert parse_modes("[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]") >= {"M5", "M9", "G90"}
    assert parse_greeting("Grbl 1.1h ['$' for help]") == "Grbl 1.1h"
    assert parse_greeting("GrblHAL 1.1f ['$' or '$HELP' for help]") == "GrblHAL 1.1f"


@pytest.mark.parametrize("laser", ["M3", "M8"])
@pytest.mark.parametrize("speed", [None, 400.0])
def test_a_session_from_connection_to_close(laser, speed):
    board = GrblBoard()
    positioner = connected(board, laser=laser, speed_steps_per_s=speed)
    assert positioner.identity["fw"] == "Grbl 1.1h" and positioner.identity["$100"] == "80"
    assert positioner.state().status == "alarm", "locked until homed"
    report = positioner.home()
    assert (report.state.pan_steps, report.state.tilt_steps) == (-80, -80) and not (report.known or report.compared)
    # Every counter, not only those that are whole micrometres.
    start_s = board.clock.monotonic()
    for target in ((801, 33), (-37, -101), (800, 33)):
        state = positioner.move_to(*target)
        assert (state.pan_steps, state.tilt_steps) == target == tuple(board.steps) and state.status == "idle"
    way = 881 + 838 + 837
    seconds = board.clock.monotonic() - start_s
    # At the rate of 8000 steps/s, or at the speed that the rig file states; a tenth of a second for each answer.
    assert way / (speed or 8000) < seconds < way / (speed or 8000) + 1.5
    assert positioner.laser(True).laser_on and board.laser_on
    assert not positioner.laser(False).laser_on and not board.laser_on
    positioner.laser(True)
    positioner.close()
    assert not board.laser_on and not board.lit_in_motion


@pytest.mark.parametrize("laser", ["M3", "M8"])
def test_a_laser_left_on_is_off_in_motion(laser):
    board, positioner = homed(laser=laser)
    positioner.laser(True)
    assert not positioner.move_to(100, 20).laser_on and not board.lit_in_motion
    assert positioner.laser(True).laser_on and board.laser_on


def test_light_behind_a_motion_is_cut_as_reported():
    """An order of another program, in mid-motion."""
    board, positioner = homed()
    reported = positioner._status_report

    def lit():
        status = reported()
        board._execute("M3 S1000", board.clock.monotonic())
        board.out.clear()
        return status

    positioner._status_report = lit
    with pytest.raises(DeviceFault, match="after a motion"):
        positioner.move_to(100, 20)
    board.advance()
    assert not board.laser_on


@pytest.mark.parametrize(
    ("homed_first", "change", "order", "code"),
    [
        (False, {}, ("move_to", 1, 1), "refused-unhomed"),
        (False, {}, ("laser", True), "refused-unhomed"),
        (False, {"home_fails": True}, ("home",), "alarm-9"),
        (True, {}, ("move_to", 0, 501), "refused-limit"),
        (True, {"limit_steps": 300}, ("move_to", 900, 0), "alarm-1"),
        (True, {"blocked": True}, ("move_to", 900, 0), "stall"),
        (True, {"missing_steps": 1}, ("move_to", 100, 0), "position"),
        (True, {"silent": True}, ("state",), "no-answer"),
    ],
)
def test_faults_are_named_and_end_in_time_and_darkness(homed_first, change, order, code):
    board = GrblBoard()
    positioner = connected(board)
    if homed_first:
        positioner.home()
    vars(board).update(change)
    check_fault(positioner, board, order, code)


def test_a_board_that_was_reset_has_lost_its_position():
    board, positioner = homed()
    board.power_on()
    assert isinstance(check_fault(positioner, board, ("move_to", 5, 5), "reset"), PositionLost)


def check_fault(positioner: GrblPositioner, board: GrblBoard, order: tuple, code: str) -> DeviceFault:
    name, *arguments = order
    with pytest.raises(DeviceFault) as caught:
        getattr(positioner, name)(*arguments)
    assert caught.value.code == code and caught.value.remedy and caught.value.message.isprintable()
    assert isinstance(caught.value, PositionLost) == (code == "reset")
    assert board.clock.monotonic() < 60.0
    positioner.close()
    assert not board.laser_on and not board.lit_in_motion
    return caught.value


def test_an_interrupted_order_does_not_answer_the_next():
    """Ctrl-C between an order and its ok, then laser off: that ok is not taken for this one's."""
    board, positioner = homed()
    positioner.laser(True)
    link, read = positioner._link, positioner._link.read

    def interrupted(timeout_s):
        link.read = read
        raise KeyboardInterrupt

    link.read = interrupted
    with pytest.raises(KeyboardInterrupt):
        positioner._order("G4 P0.5", 5.0)
    assert not positioner.laser(False).laser_on and not board.laser_on
    assert board.clock.monotonic() < 60


@pytest.mark.parametrize(
    ("settings", "column"),
    [
        *(({1: 25}, "$1"), ({10: 0}, "$10"), ({13: 1}, "$13"), ({22: 0}, "$22"), ({32: 1}, "$32")),
        *(({100: 640.0}, "$100"), ({101: 0.0}, "$101")),
    ],
)
def test_a_board_that_is_set_otherwise_is_refused_by_its_setting(settings, column):
    with pytest.raises(InputError) as caught:
        connected(GrblBoard(settings))
    assert caught.value.column == column and f"{column}=..." in caught.value.remedy


def test_light_without_a_watchdog_has_to_be_accepted():
    board, positioner = homed(unwatched=False)
    with pytest.raises(DeviceFault, match="unwatched_laser") as caught:
        positioner.laser(True)
    assert caught.value.code == "laser" and not board.laser_on


@pytest.mark.parametrize(
    ("entries", "column"),
    [
        ({"laser_watchdog_s": 1.0}, "positioner.laser_watchdog_s"),
        ({"pan_home_steps": 0}, "positioner.pan_home_steps"),
        ({"options.lazer": "M3"}, "positioner.options.lazer"),
        ({"options.laser": "M30"}, "positioner.options.laser"),
        *(({"options.unwatched_laser": entry}, "positioner.options.unwatched_laser") for entry in ("false", "no", 2)),
        *(({"options.laser_power": entry}, "positioner.options.laser_power") for entry in ("full", -1, float("nan"))),
    ],
)
def test_entries_that_a_board_does_not_have_are_refused(entries, column):
    with pytest.raises(InputError) as caught:
        GrblSettings.of(entries)
    assert caught.value.column == column and caught.value.allowed and caught.value.remedy


def test_more_power_than_the_board_has_is_refused():
    """$30 = 255 and a power in thousandths: GRBL would give all the light there is."""
    with pytest.raises(InputError, match=r"found 300; allowed: at most 255, the board's \$30") as caught:
        connected(GrblBoard({30: 255}), laser_power=300.0)
    assert caught.value.column == "positioner.options.laser_power"
    board, positioner = homed({30: 255}, laser_power=255.0)
    assert positioner.laser(True).laser_on and "M3 S255" in board.orders


def test_the_options_of_a_board():
    """A switch of a rig file comes as 0 or 1."""
    assert [GrblSettings.of({"options.unwatched_laser": entry}).unwatched for entry in (0, 1)] == [False, True]
    assert not GrblSettings.of({}).unwatched and GrblSettings.of({"options.laser_power": 300}).laser_power == 300.0


def test_our_own_firmware_under_this_driver_is_named():
    device = SimulatedDevice(VirtualClock(), Mechanics())
    with pytest.raises(DeviceFault, match='driver = "serial"'):
        GrblPositioner(lambda: ModelLink(device), GrblSettings(), device.clock)


def test_an_unplugged_board_is_named():
    _, positioner = homed()
    positioner._link.gone = True
    with pytest.raises(DeviceFault) as caught:
        positioner.move_to(1, 1)
    assert caught.value.code == "unplugged"
    positioner.close()


@pytest.mark.parametrize(("lost", "code"), [("gone", "unplugged"), ("silent", "no-answer")])
@pytest.mark.parametrize("lit", [True, False])
def test_loss_of_a_lit_board_has_the_remedy_to_cut_its_light_first(lost, code, lit):
    """No order reaches it any more, and it has no watchdog that ends the light."""
    board, positioner = homed()
    positioner.laser(lit)
    setattr(positioner._link if lost == "gone" else board, lost, True)
    with pytest.raises(DeviceFault) as caught:
        positioner.laser(False)
    assert caught.value.code == code and caught.value.remedy.startswith("cut the laser's supply") == lit


@needs_pseudo_terminals
def test_a_board_on_a_pseudo_terminal():
    """Pyserial and a real file descriptor; the board's time runs with the requests."""
    board = GrblBoard()

    def answer(data: bytes) -> bytes:
        board.clock.sleep(1.0)
        board.receive(data)
        sent, board.out = bytes(board.out), bytearray()
        return sent

    with answered(answer) as port:
        positioner = GrblPositioner(serial_opener(port, 115_200), GrblSettings(unwatched=True, limits=LIMITS))
        positioner.home()
        assert positioner.move_to(300, -20).pan_steps == 300
        assert positioner.laser(True).laser_on
        positioner.close()
        assert board.steps == [300, -20] and not board.lit_in_motion
