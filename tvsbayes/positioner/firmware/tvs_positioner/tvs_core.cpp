#include "tvs_core.h"

#include <inttypes.h>
#include <stdio.h>
#include <string.h>

namespace tvs {

namespace {

const char kFirmwareVersion[] = "1.0.0";
const int kProtocolVersion = 1;
const uint64_t kNever = UINT64_MAX;
// Speed at which the motors start and stop without a ramp, and that of homing; steps per second.
const uint32_t kStartSpeed = 200, kHomeSlowSpeed = 50;
// Steps beyond the release of a home switch, and the most that one axis may travel while homing.
const int32_t kHomeClear = 20, kHomeTravelMax = 20000;

enum { kVmax, kAmax, kPmin, kPmax, kTmin, kTmax, kHp, kHt, kWd };
struct Setting {
  const char* name;
  int32_t low, high, boot;
};
// As SETTINGS in protocol.py.
const Setting kSettingTable[] = {
    {"vmax", 10, 20000, 800},
    {"amax", 10, 100000, 4000},
    {"pmin", -100000000, 100000000, -1000},
    {"pmax", -100000000, 100000000, 1000},
    {"tmin", -100000000, 100000000, -500},
    {"tmax", -100000000, 100000000, 500},
    {"hp", -100000000, 100000000, -1200},
    {"ht", -100000000, 100000000, -700},
    {"wd", 100, 10000, 2000},
};

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

// Digits without leading zeros up to `highest`; false for anything else.
bool digits(const char* text, uint64_t highest, uint64_t* value) {
  const size_t size = strlen(text);
  if (size == 0 || size > 10 || (text[0] == '0' && size > 1)) return false;
  uint64_t number = 0;
  for (size_t i = 0; i < size; ++i) {
    if (text[i] < '0' || text[i] > '9') return false;
    number = 10 * number + static_cast<uint64_t>(text[i] - '0');
  }
  if (number > highest) return false;
  *value = number;
  return true;
}

bool parse_unsigned(const char* text, uint32_t* value) {
  uint64_t number;
  if (!digits(text, UINT32_MAX, &number)) return false;
  *value = static_cast<uint32_t>(number);
  return true;
}

bool parse_signed(const char* text, int32_t* value) {
  const bool negative = text[0] == '-';
  uint64_t number;
  if (!digits(text + negative, negative ? 2147483648u : 2147483647u, &number)) return false;
  if (negative && number == 0) return false;
  const int64_t with_sign = negative ? -static_cast<int64_t>(number) : static_cast<int64_t>(number);
  *value = static_cast<int32_t>(with_sign);
  return true;
}

int hexadecimal(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'A' && c <= 'F') return c - 'A' + 10;
  return -1;
}

int find_setting(const char* name) {
  for (int i = 0; i <= kWd; ++i) {
    if (strcmp(kSettingTable[i].name, name) == 0) return i;
  }
  return -1;
}

}  // namespace

uint16_t crc16(const char* data, size_t size) {
  uint16_t crc = 0xFFFF;
  for (size_t i = 0; i < size; ++i) {
    crc = static_cast<uint16_t>(crc ^ (static_cast<uint16_t>(static_cast<uint8_t>(data[i])) << 8));
    for (int bit = 0; bit < 8; ++bit) {
      crc = static_cast<uint16_t>((crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1);
    }
  }
  return crc;
}

Core::Core(Hooks& hooks, uint32_t boot_id)
    : hooks_(hooks),
      boot_id_(boot_id),
      status_(kUnhomed),
      error_("none"),
      last_sequence_(0),
      motion_sequence_(0),
      done_sequence_(0),
      laser_(false),
      stopping_(false),
      homing_(false),
      homed_before_(false),
      home_axis_(kPan),
      home_phase_(kAway),
      home_clear_(0),
      home_travel_(0),
      home_due_us_(kNever),
      heard_us_(0),
      request_size_(0),
      last_request_size_(0),
      last_reply_size_(0),
      overlong_(false) {
  memset(axes_, 0, sizeof axes_);
  for (int i = 0; i < kSettings; ++i) settings_[i] = kSettingTable[i].boot;
}

void Core::start(uint64_t now_us) {
  heard_us_ = now_us;
  hooks_.laser(false);
  char body[64];
  const int size = snprintf(body, sizeof body, "!boot b=%" PRIu32 " fw=%s", boot_id_, kFirmwareVersion);
  send(body, static_cast<size_t>(size));
}

void Core::receive(uint8_t byte, uint64_t now_us) {
  if (byte == '\n') {
    line(now_us);
    request_size_ = 0;
    overlong_ = false;
  } else if (request_size_ < kRequestMax + 1) {
    // One more than allowed: a carriage return before the line feed does not count.
    request_[request_size_++] = static_cast<char>(byte);
  } else {
    overlong_ = true;
  }
}

void Core::line(uint64_t now_us) {
  size_t size = request_size_;
  if (!overlong_ && size > 0 && request_[size - 1] == '\r') --size;
  if (overlong_ || size > kRequestMax) return nak("long");
  if (size == 0) return;
  request_[size] = '\0';
  const char* star = static_cast<const char*>(memchr(request_, '*', size));
  if (request_[0] != '>' || star == nullptr || star + 5 != request_ + size) return nak("frame");
  uint16_t stated = 0;
  for (int i = 1; i <= 4; ++i) {
    const int digit = hexadecimal(star[i]);
    if (digit < 0) return nak("frame");
    stated = static_cast<uint16_t>(stated << 4 | digit);
  }
  const size_t body = static_cast<size_t>(star - request_);
  for (size_t i = 0; i < body; ++i) {
    if (request_[i] < ' ' || request_[i] > '~') return nak("frame");
  }
  if (crc16(request_, body) != stated) return nak("crc");
  heard_us_ = now_us;

  char copy[kRequestMax + 2];
  memcpy(copy, request_, body);
  copy[body] = '\0';
  const char* words[6];
  int count = 0;
  for (char* word = copy + 1; word != nullptr && count < 6; ++count) {
    words[count] = word;
    char* space = strchr(word, ' ');
    if (space != nullptr) *space++ = '\0';
    word = space;
  }
  uint32_t sequence;
  if (!parse_unsigned(words[0], &sequence) || count < 2) return nak("parse");
  if (sequence == 0) {
    const bool identify = count == 2 && strcmp(words[1], "ID") == 0;
    if (!identify) return reply(0, "seq", "");
    return execute(0, words, count, now_us);
  }
  if (sequence == last_sequence_ && size == last_request_size_ && memcmp(request_, last_request_, size) == 0) {
    hooks_.write(last_reply_, last_reply_size_);
    return;
  }
  if (sequence <= last_sequence_) return reply(sequence, "seq", "");
  last_sequence_ = sequence;
  memcpy(last_request_, request_, size);
  last_request_size_ = size;
  execute(sequence, words, count, now_us);
}

void Core::nak(const char* kind) {
  char body[32];
  const int size = snprintf(body, sizeof body, "!nak %s", kind);
  send(body, static_cast<size_t>(size));
}

void Core::send(const char* body, size_t size) {
  char text[kReplyMax + 8];
  memcpy(text, body, size);
  snprintf(text + size, sizeof text - size, "*%04X\n", crc16(body, size));
  hooks_.write(text, size + 6);
}

void Core::execute(uint32_t sequence, const char* words[], int count, uint64_t now_us) {
  char extra[64] = "";
  const char* error = command(sequence, words, count, now_us, extra);
  reply(sequence, error, extra);
}

void Core::reply(uint32_t sequence, const char* error, const char* extra) {
  static const char* const kNames[] = {"unhomed", "idle", "moving", "alarm"};
  char body[kReplyMax + 1];
  const Axis &pan = axes_[kPan], &tilt = axes_[kTilt];
  const int size = snprintf(
      body, sizeof body,
      "<%" PRIu32 " %s%s b=%" PRIu32 " st=%s p=%" PRId32 ",%" PRId32 " t=%" PRId32 ",%" PRId32 " d=%" PRIu32
      " l=%d h=%" PRId32 ",%" PRId32 " e=%s%s",
      sequence, error == nullptr ? "ok" : "err ", error == nullptr ? "" : error, boot_id_, kNames[status_],
      pan.position, tilt.position, pan.target, tilt.target, done_sequence_, laser_ ? 1 : 0, pan.home_deviation,
      tilt.home_deviation, error_, extra);
  const size_t length = static_cast<size_t>(size);
  if (sequence != 0 && sequence == last_sequence_ && (error == nullptr || strcmp(error, "seq") != 0)) {
    memcpy(last_reply_, body, length);
    snprintf(last_reply_ + length, sizeof last_reply_ - length, "*%04X\n", crc16(body, length));
    last_reply_size_ = length + 6;
  }
  send(body, length);
}

const char* Core::command(uint32_t sequence, const char* words[], int count, uint64_t now_us, char* extra) {
  const char* name = words[1];
  const int arguments = count - 2;
  if (strcmp(name, "ID") == 0) {
    if (arguments != 0) return "argument";
    snprintf(extra, 64, " fw=%s proto=%d q=%" PRIu32, kFirmwareVersion, kProtocolVersion, last_sequence_);
    return nullptr;
  }
  if (strcmp(name, "?") == 0) return arguments == 0 ? nullptr : "argument";
  if (strcmp(name, "MA") == 0) {
    int32_t pan, tilt;
    if (arguments != 2 || !parse_signed(words[2], &pan) || !parse_signed(words[3], &tilt)) return "argument";
    return move(sequence, pan, tilt, now_us);
  }
  if (strcmp(name, "HOME") == 0) {
    if (arguments != 0) return "argument";
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
  if (strcmp(name, "STOP") == 0) {
    if (arguments != 0) return "argument";
    if (homing_) {
      halt(kUnhomed, "stop");
    } else if (status_ == kMoving) {
      stopping_ = true;
      for (Axis& axis : axes_) {
        if (axis.direction != 0) axis.target = axis.position + axis.direction * (axis.level + 1);
      }
    }
    return nullptr;
  }
  if (strcmp(name, "ABORT") == 0) {
    if (arguments != 0) return "argument";
    halt(status_ == kUnhomed || homing_ ? kUnhomed : kAlarm, "abort");
    return nullptr;
  }
  if (strcmp(name, "L") == 0) {
    if (arguments != 1 || (strcmp(words[2], "0") != 0 && strcmp(words[2], "1") != 0)) return "argument";
    const bool on = words[2][0] == '1';
    if (on && status_ == kAlarm) return "alarm";
    if (on && (status_ == kUnhomed || homing_)) return "unhomed";
    if (on) error_ = "none";
    set_laser(on);
    return nullptr;
  }
  if (strcmp(name, "GET") == 0 || strcmp(name, "SET") == 0) {
    const bool set = name[0] == 'S';
    if (arguments != (set ? 2 : 1)) return "argument";
    const int index = find_setting(words[2]);
    if (index < 0) return "argument";
    if (set) {
      int32_t value;
      const Setting& setting = kSettingTable[index];
      if (!parse_signed(words[3], &value) || value < setting.low || value > setting.high) return "argument";
      if (status_ == kMoving) return "busy";
      settings_[index] = value;
    }
    snprintf(extra, 64, " v=%" PRId32, settings_[index]);
    return nullptr;
  }
  return "command";
}

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

void Core::advance(uint64_t now_us) {
  for (;;) {
    int next = -1;
    uint64_t due_us = kNever;
    if (homing_) {
      due_us = home_due_us_;
    } else {
      for (int i = 0; i < kAxes; ++i) {
        if (axes_[i].direction != 0 && axes_[i].due_us < due_us) {
          due_us = axes_[i].due_us;
          next = i;
        }
      }
    }
    const uint64_t off_us = laser_ ? heard_us_ + static_cast<uint64_t>(settings_[kWd]) * 1000 : kNever;
    if (off_us <= due_us) {
      if (off_us > now_us || off_us == kNever) return;
      set_laser(false);
      error_ = "watchdog";
    } else if (due_us > now_us) {
      return;
    } else if (homing_) {
      home_step();
    } else {
      step_axis(next);
    }
  }
}

void Core::step_axis(int index) {
  Axis& axis = axes_[index];
  hooks_.step(index, axis.direction > 0);
  axis.position += axis.direction;
  if (hooks_.limit_switch(index)) return halt(kAlarm, "limit");
  const int32_t remaining = (axis.target - axis.position) * axis.direction;
  if (remaining == 0) {
    axis.direction = 0;
    return finish_if_at_rest();
  }
  // Slow down so that the last step is done at the starting speed.
  int32_t level = axis.level + 1;
  if (level > top_level()) level = top_level();
  if (level > remaining - 1) level = remaining - 1;
  axis.level = level;
  axis.due_us += delay_us(level);
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

void Core::home_axis(int axis, uint64_t now_us) {
  home_axis_ = axis;
  home_travel_ = 0;
  home_limit_ = hooks_.limit_switch(axis);
  home_phase(hooks_.home_switch(axis) ? kAway : kFast, now_us);
}

void Core::home_phase(Phase phase, uint64_t now_us) {
  home_phase_ = phase;
  home_clear_ = kHomeClear;
  home_due_us_ = now_us + 1000000u / (phase == kSlow ? kHomeSlowSpeed : kStartSpeed);
}

void Core::home_step() {
  const uint64_t now_us = home_due_us_;
  const bool positive = home_phase_ == kAway || home_phase_ == kBack;
  Axis& axis = axes_[home_axis_];
  hooks_.step(home_axis_, positive);
  axis.position += positive ? 1 : -1;
  axis.target = axis.position;
  // Homing also leads back from an open limit; one that opens on the way means that no home switch will come.
  const bool limit = hooks_.limit_switch(home_axis_);
  if (limit && !home_limit_) return halt(kAlarm, "limit");
  home_limit_ = limit;
  if (++home_travel_ > kHomeTravelMax) return halt(kAlarm, "home");
  const bool pressed = hooks_.home_switch(home_axis_);
  if (positive && !pressed && --home_clear_ == 0) {
    return home_phase(home_phase_ == kAway ? kFast : kSlow, now_us);
  }
  if (!positive && pressed) {
    return home_phase_ == kFast ? home_phase(kBack, now_us) : home_found(now_us);
  }
  home_due_us_ += 1000000u / (home_phase_ == kSlow ? kHomeSlowSpeed : kStartSpeed);
}

void Core::home_found(uint64_t now_us) {
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
