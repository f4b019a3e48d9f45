// Motion of tvs_core: ramps, limit switches, homing, timing of laser and trigger. Every delay counts from the preceding
// step, so that a delayed main loop continues late and never catches up with a burst of steps.
#include "tvs_core.h"

namespace tvs {

namespace {

// Speed at which the motors start and stop without a ramp, and speed of the last approach in homing; steps per second.
const uint32_t kStartSpeed = 200, kHomeSlowSpeed = 50;
// Steps beyond the release of a home switch; largest travel of one axis while homing; the same with a limit switch
// open from the start: it leaves the switch without reaching the end stop, should a wire be broken.
const int32_t kHomeClear = 20, kHomeTravelMax = 20000, kHomeOpenMax = 200;
// A home switch counts as pressed after one reading and this many more at this interval (us): spikes are rejected.
const int32_t kHomeReads = 4;
const uint32_t kHomeReadUs = 500;
// A limit switch that opens at rest counts after this time (us).
const uint32_t kLimitOpenUs = 5000;

uint32_t square_root(uint32_t value) {
  uint32_t root = 0;
  for (uint32_t bit = 1u << 30; bit != 0; bit >>= 2) {
    if (value >= root + bit) {
      value -= root + bit;
      root = (root >> 1) + bit;
    } else {
      root >>= 1;
    }
  }
  return root;
}

}  // namespace

const char* Core::move(uint32_t sequence, int32_t pan, int32_t tilt, uint64_t now_us) {
  if (status_ == kAlarm) return "alarm";
  if (status_ == kUnhomed || homing_) return "unhomed";
  if (status_ == kMoving) return "busy";
  if (pan < settings_[kPmin] || pan > settings_[kPmax] || tilt < settings_[kTmin] || tilt > settings_[kTmax]) {
    return "limit";
  }
  const int32_t targets[kAxes] = {pan, tilt};
  error_ = "none";
  motion_sequence_ = sequence;
  stopping_ = false;
  status_ = kMoving;
  for (int i = 0; i < kAxes; ++i) {
    Axis& axis = axes_[i];
    axis.target = targets[i];
    axis.level = 0;
    axis.direction = axis.target > axis.position ? 1 : axis.target < axis.position ? -1 : 0;
    axis.due_us = now_us + delay_us(0);
  }
  finish_if_at_rest();
  return nullptr;
}

void Core::stop() {
  if (homing_) return halt(kUnhomed, "stop");
  if (status_ != kMoving) return;
  stopping_ = true;
  for (Axis& axis : axes_) {
    if (axis.direction != 0) axis.target = axis.position + axis.direction * (axis.level + 1);
  }
}

uint32_t Core::delay_us(int32_t level) const {
  const uint32_t top = static_cast<uint32_t>(settings_[kVmax]);
  const uint32_t speed =
      square_root(kStartSpeed * kStartSpeed + 2 * static_cast<uint32_t>(settings_[kAmax]) * static_cast<uint32_t>(level));
  return 1000000u / (speed < top ? speed : top);
}

int32_t Core::top_level() const {
  const int32_t top = settings_[kVmax], start = static_cast<int32_t>(kStartSpeed);
  return top <= start ? 0 : (top * top - start * start) / (2 * settings_[kAmax]);
}

uint64_t Core::laser_off_us() const {
  return laser_ ? heard_us_ + static_cast<uint64_t>(settings_[kWd]) * 1000 : kNever;
}

uint64_t Core::step_us(int* axis) const {
  *axis = home_axis_;
  if (homing_) return home_due_us_;
  uint64_t due_us = kNever;
  for (int i = 0; i < kAxes; ++i) {
    if (axes_[i].direction != 0 && axes_[i].due_us < due_us) {
      due_us = axes_[i].due_us;
      *axis = i;
    }
  }
  return due_us;
}

uint64_t Core::next_us() const {
  int axis;
  uint64_t next = step_us(&axis);
  const uint64_t others[] = {laser_off_us(), trigger_off_us_, limit_due_us_};
  for (uint64_t other : others) next = other < next ? other : next;
  return next;
}

void Core::loop(uint64_t now_us) {
  if (trigger_off_us_ <= now_us) {
    trigger_off_us_ = kNever;
    hooks_.trigger(false);
  }
  for (;;) {
    int axis;
    const uint64_t due_us = step_us(&axis), off_us = laser_off_us();
    if (off_us <= due_us && off_us <= now_us) {
      set_laser(false);
      error_ = "watchdog";
    } else if (due_us > now_us) {
      break;
    } else if (homing_) {
      home_step(now_us);
    } else {
      step_axis(axis, now_us);
    }
  }
  watch_limits(now_us);
}

void Core::darkened() {
  if (!laser_) return;
  set_laser(false);
  error_ = "stall";
}

bool Core::limit_open() { return hooks_.limit_switch(kPan) || hooks_.limit_switch(kTilt); }

void Core::watch_limits(uint64_t now_us) {
  if (status_ != kIdle || !limit_open()) {
    limit_due_us_ = kNever;
  } else if (limit_due_us_ == kNever) {
    limit_due_us_ = now_us + kLimitOpenUs;
  } else if (limit_due_us_ <= now_us) {
    limit_due_us_ = kNever;
    halt(kAlarm, "limit");
  }
}

void Core::step_axis(int index, uint64_t now_us) {
  Axis& axis = axes_[index];
  hooks_.step(index, axis.direction > 0);
  axis.position += axis.direction;
  if (limit_open()) return halt(kAlarm, "limit");
  const int32_t remaining = (axis.target - axis.position) * axis.direction;
  if (remaining == 0) {
    axis.direction = 0;
    return finish_if_at_rest();
  }
  // A motor whose step is late has stopped: the ramp restarts.
  const bool stalled = now_us - axis.due_us > delay_us(0);
  int32_t level = stalled ? 0 : axis.level + 1;
  // Decelerate so that the last step is done at the starting speed.
  if (level > top_level()) level = top_level();
  if (level > remaining - 1) level = remaining - 1;
  axis.level = level;
  axis.due_us = now_us + delay_us(level);
}

void Core::finish_if_at_rest() {
  if (axes_[kPan].direction != 0 || axes_[kTilt].direction != 0) return;
  status_ = kIdle;
  if (stopping_) {
    error_ = "stop";
  } else {
    done_sequence_ = motion_sequence_;
  }
}

void Core::halt(Status status, const char* error) {
  for (Axis& axis : axes_) axis.direction = 0;
  homing_ = false;
  status_ = status;
  error_ = error;
  set_laser(false);
}

void Core::set_laser(bool on) {
  laser_ = on;
  hooks_.laser(on);
}

const char* Core::home(uint32_t sequence, uint64_t now_us) {
  if (status_ == kMoving) return "busy";
  homed_before_ = status_ == kIdle;
  status_ = kMoving;
  homing_ = true;
  stopping_ = false;
  error_ = "none";
  motion_sequence_ = sequence;
  set_laser(false);
  home_axis(kPan, now_us);
  return nullptr;
}

void Core::home_axis(int axis, uint64_t now_us) {
  home_axis_ = axis;
  home_travel_ = 0;
  home_reads_ = 0;
  home_limit_ = hooks_.limit_switch(axis);
  home_phase(hooks_.home_switch(axis) ? kAway : kFast, now_us);
}

void Core::home_phase(Phase phase, uint64_t now_us) {
  home_phase_ = phase;
  home_clear_ = kHomeClear;
  home_due_us_ = now_us + home_delay_us();
}

uint32_t Core::home_delay_us() const { return 1000000u / (home_phase_ == kSlow ? kHomeSlowSpeed : kStartSpeed); }

void Core::home_step(uint64_t now_us) {
  if (home_reads_ > 0) return home_read(now_us);
  const bool positive = home_phase_ == kAway || home_phase_ == kBack;
  Axis& axis = axes_[home_axis_];
  hooks_.step(home_axis_, positive);
  axis.position += positive ? 1 : -1;
  axis.target = axis.position;
  // Homing may begin behind an open limit switch and leave it; a limit switch that opens on the way means that the home
  // switch was missed.
  const bool limit = hooks_.limit_switch(home_axis_);
  ++home_travel_;
  if (limit && (!home_limit_ || home_travel_ > kHomeOpenMax)) return halt(kAlarm, "limit");
  home_limit_ = limit;
  if (home_travel_ > kHomeTravelMax) return halt(kAlarm, "home");
  const bool pressed = hooks_.home_switch(home_axis_);
  home_due_us_ = now_us + home_delay_us();
  if (positive) {
    home_clear_ = pressed ? kHomeClear : home_clear_ - 1;
    if (home_clear_ == 0) home_phase(home_phase_ == kAway ? kFast : kSlow, now_us);
  } else if (pressed) {
    home_reads_ = kHomeReads;
    home_due_us_ = now_us + kHomeReadUs;
  }
}

void Core::home_read(uint64_t now_us) {
  if (!hooks_.home_switch(home_axis_)) {
    home_reads_ = 0;
    home_due_us_ = now_us + home_delay_us();
  } else if (--home_reads_ > 0) {
    home_due_us_ = now_us + kHomeReadUs;
  } else if (home_phase_ == kFast) {
    home_phase(kBack, now_us);
  } else {
    home_found(now_us);
  }
}

void Core::home_found(uint64_t now_us) {
  // The home switch is never beyond an open limit: a wire is broken, or the wrong switch was found.
  if (home_axis_ == kTilt ? limit_open() : hooks_.limit_switch(kPan)) return halt(kAlarm, "limit");
  Axis& axis = axes_[home_axis_];
  const int32_t home = settings_[home_axis_ == kPan ? kHp : kHt];
  axis.home_deviation = homed_before_ ? axis.position - home : 0;
  axis.position = axis.target = home;
  if (home_axis_ == kPan) return home_axis(kTilt, now_us);
  homing_ = false;
  status_ = kIdle;
  done_sequence_ = motion_sequence_;
}

}  // namespace tvs
