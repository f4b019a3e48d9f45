"""Defects that a trial of acquisition and firmware from outside had found, planted again one by one.

`experiments/robustness/defects_seen_red.py` has the list with what was found then.
"""

from __future__ import annotations

from experiments.robustness.faults.fault import Fault

_SKETCH = "positioner/firmware/tvs_positioner/tvs_positioner.ino"
_CORE = "positioner/firmware/tvs_positioner/tvs_core.cpp"
_MOTION = "positioner/firmware/tvs_positioner/tvs_motion.cpp"

FAULTS = (
    Fault(
        "resume: another port is another rig",
        "acquisition/run_identity.py",
        'return key in HOME_KEYS.values() or key.startswith("options.")',
        "return True",
        "a board that comes back as ttyACM1 ends the campaign",
        ("acquisition/session::test_a_rig_that_is_reached_or_driven_otherwise_goes_on",),
    ),
    Fault(
        "resume: the entry that changed is not named",
        "acquisition/run_identity.py",
        'refusal("changed", file="rig file", column=_place(key), found=found, allowed=_value(old), remedy=remedy)',
        'refusal("changed", file="rig file", found="another rig", allowed="the rig before", remedy=remedy)',
        "nobody knows what to put back",
        ("acquisition/session::test_what_changes_the_data_is_refused_by_name",),
    ),
    Fault(
        "sketch: no watchdog of the processor",
        _SKETCH,
        "  guard.begin(dark_when_stuck, 10000);\n  start_watchdog();\n",
        "  guard.begin(dark_when_stuck, 10000);\n",
        "a crashed processor leaves the laser on for ever",
        ("positioner/firmware_safety::test_sketch_resets_itself_and_darkens_in_a_fault",),
        survived="reading: the sketch's text was searched for parts of the watchdog, not for the call that starts it.",
    ),
    Fault(
        "sketch: a fault of the processor keeps the pin as it stood",
        _SKETCH,
        "  for (int vector = 3; vector <= 6; ++vector) _VectorsRam[vector] = dark_in_fault;",
        "  (void)dark_in_fault;",
        "the laser stays on until the processor is reset",
        ("positioner/firmware_safety::test_sketch_resets_itself_and_darkens_in_a_fault",),
        survived="reading: the handler was looked for, not its place among the vectors.",
    ),
    Fault(
        "core: homing goes on behind an open limit",
        _MOTION,
        "if (limit && (!home_limit_ || home_travel_ > kHomeOpenMax)) return",
        "if (limit && !home_limit_) return",
        "20 000 steps into the stop with a broken wire",
        ("positioner/firmware_safety::test_homing_with_a_cut_limit_wire_is_short_and_ends_in_alarm",),
    ),
    Fault(
        "core: homing ends behind an open limit",
        _MOTION,
        '  if (home_axis_ == kTilt ? limit_open() : hooks_.limit_switch(kPan)) return halt(kAlarm, "limit");\n',
        "",
        "the axis counts as homed, the laser may go on, and the first move alarms, endlessly",
        ("positioner/firmware_safety::test_homing_does_not_end_behind_an_open_limit",),
    ),
    Fault(
        "network camera: a dropped stream is not opened again",
        "cameras/network_stream.py",
        "elif fresh and not self._stopped:",
        "elif False:",
        "a server that drops its viewer once ends the run",
        ("cameras/network_stream",),
    ),
    Fault(
        "core: overdue steps made up in a burst",
        _MOTION,
        "  axis.due_us = now_us + delay_us(level);",
        "  axis.due_us += delay_us(level);",
        "a motor loses steps after a stall",
        ("positioner/firmware_safety::test_overdue_steps_never_come_in_a_burst",),
        survived="run: of the core's steps only replies tell, and none was asked for while they were late.",
    ),
    Fault(
        "driver: no answer, whatever was heard",
        "positioner/driver.py",
        "heard = explained(bytes(self._heard))",
        'heard = explained(b"")',
        "GRBL, a wrong baud rate, other line ends: all are a cable to be checked",
        ("positioner/silence",),
    ),
    Fault(
        "driver: a used-up sequence has no name",
        "positioner/driver.py",
        "            raise _used_up(self._sequence)\n        return reply",
        '            raise fault("no-answer", "no answer to SET", "check the cable")\n        return reply',
        "nobody says that a reset helps",
        ("positioner/silence",),
    ),
    Fault(
        "core: light off, stop and abort need a number",
        _CORE,
        'if (!unnumbered(words, count)) return reply(0, "seq", "");',
        'if (strcmp(words[1], "ID") != 0) return reply(0, "seq", "");',
        "a host that has lost its number cannot switch the laser off",
        ("positioner/firmware_safety::test_orders_that_make_safe_need_no_number",),
    ),
    Fault(
        "core: light kept on by refused and unnumbered requests",
        _CORE,
        "if (sequence != 0 && !refused_) heard_us_ = now_us;",
        "heard_us_ = now_us;",
        "a host that is obeyed no more keeps the laser on for ever",
        ("positioner/firmware_safety::test_only_a_host_that_is_obeyed_keeps_the_light_on",),
    ),
    Fault(
        "sketch: the direction stands no time before the step",
        _SKETCH,
        "      delayMicroseconds(kDirectionSetupUs);\n",
        "",
        "a drive that asks for 5 us loses a step at every reversal, which looks like backlash",
        ("positioner/firmware_safety::test_direction_stands_before_the_step",),
        survived="reading: no test read the sketch for it.",
    ),
    Fault(
        "resume: unfinished files of killed runs stay",
        "acquisition/campaign_files.py",
        "        remove_unfinished(folder, _DERIVED)\n",
        "        remove_unfinished(folder, ())\n",
        "hidden files pile up in the folder",
        ("acquisition/campaign_files::test_what_a_killed_run_left_unfinished_is_removed_at_its_resume",),
    ),
    Fault(
        "check: an empty journal is to be resumed",
        "acquisition/journal_check.py",
        'warnings.append(f"{LOG} holds no event; {EMPTY_REMEDY}")',
        'warnings.append(f"{LOG} holds no event; go on with --resume")',
        "--resume then says to begin anew",
        ("acquisition/campaign_files::test_an_empty_journal_has_one_remedy",),
    ),
    Fault(
        "core: one reading makes a home switch",
        _MOTION,
        "const int32_t kHomeReads = 4;",
        "const int32_t kHomeReads = 1;",
        "bounce makes a wrong zero",
        ("positioner/firmware_safety::test_bounce_of_the_home_switch_makes_no_wrong_zero",),
        survived="run: a core that takes another place for home says the same counter; only the next homing tells.",
    ),
    Fault(
        "core: replies say light after the guard has darkened it",
        _MOTION,
        '  if (!laser_) return;\n  set_laser(false);\n  error_ = "stall";',
        '  error_ = "stall";',
        "dark pictures are taken for lit ones",
        ("positioner/firmware_safety::test_replies_say_that_the_guard_has_darkened_the_laser",),
    ),
    Fault(
        "core: a limit that opens at rest is not seen",
        _MOTION,
        "  watch_limits(now_us);\n}",
        "}",
        "somebody opens the circuit, and the laser stays on",
        ("positioner/firmware_safety::test_a_limit_that_opens_at_rest_darkens_and_alarms",),
    ),
    Fault(
        "rig file: counters at home, ramp and watchdog stay the board's",
        "positioner/protocol.py",
        "for key, name, unit in OTHER_SETTINGS:\n        if name in positioner:",
        "for key, name, unit in OTHER_SETTINGS:\n        if False:",
        "who needs another ramp has to edit C++ and flash",
        ("positioner/protocol::test_settings_of_a_rig_file",),
    ),
)
