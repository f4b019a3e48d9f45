#include "tvs_core.h"

#include <inttypes.h>
#include <stdio.h>
#include <string.h>

namespace tvs {

namespace {

const char kFirmwareVersion[] = "1.1.0";
const int kProtocolVersion = 2;
// Shortest and longest pulse to the cameras, microseconds.
const uint32_t kTriggerMin = 10, kTriggerMax = 1000000;

struct Setting {
  const char* name;
  int32_t low, high, boot;
};
// The settings of SETTINGS in protocol.py, in the order of Core's enum.
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
const int kSettingCount = sizeof kSettingTable / sizeof kSettingTable[0];

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

// Requests allowed with sequence 0, at any time and any number of times: they start neither laser nor motion.
bool unnumbered(const char* words[], int count) {
  if (count == 3) return strcmp(words[1], "L") == 0 && strcmp(words[2], "0") == 0;
  if (count != 2) return false;
  return strcmp(words[1], "ID") == 0 || strcmp(words[1], "STOP") == 0 || strcmp(words[1], "ABORT") == 0;
}

int hexadecimal(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'A' && c <= 'F') return c - 'A' + 10;
  return -1;
}

int find_setting(const char* name) {
  for (int i = 0; i < kSettingCount; ++i) {
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
      refused_(false),
      stopping_(false),
      homing_(false),
      homed_before_(false),
      home_axis_(kPan),
      home_phase_(kAway),
      home_clear_(0),
      home_travel_(0),
      home_reads_(0),
      home_limit_(false),
      home_due_us_(kNever),
      heard_us_(0),
      trigger_off_us_(kNever),
      limit_due_us_(kNever),
      request_size_(0),
      last_request_size_(0),
      last_reply_size_(0),
      overlong_(false) {
  static_assert(kSettings == kSettingCount, "a setting without a row");
  memset(axes_, 0, sizeof axes_);
  for (int i = 0; i < kSettings; ++i) settings_[i] = kSettingTable[i].boot;
}

void Core::start(uint64_t now_us) {
  heard_us_ = now_us;
  hooks_.laser(false);
  hooks_.trigger(false);
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
    // One byte more than allowed, since a carriage return before the line feed does not count.
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
    if (!unnumbered(words, count)) return reply(0, "seq", "");
    return execute(0, words, count, now_us);
  }
  if (sequence == last_sequence_ && size == last_request_size_ && memcmp(request_, last_request_, size) == 0) {
    if (!refused_) heard_us_ = now_us;
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
  // Only numbered, accepted requests feed the laser watchdog.
  if (sequence != 0) refused_ = error != nullptr;
  if (sequence != 0 && !refused_) heard_us_ = now_us;
  reply(sequence, error, extra);
}

void Core::reply(uint32_t sequence, const char* error, const char* extra) {
  static const char* const kNames[] = {"unhomed", "idle", "moving", "alarm"};
  char body[kReplyMax + 1];
  const Axis &pan = axes_[kPan], &tilt = axes_[kTilt];
  const int size = snprintf(
      body, sizeof body,
      "<%" PRIu32 " %s%s b=%" PRIu32 " st=%s p=%" PRId32 ",%" PRId32 " t=%" PRId32 ",%" PRId32 " d=%" PRIu32
      " l=%d h=%" PRId32 ",%" PRId32 " s=%d,%d e=%s%s",
      sequence, error == nullptr ? "ok" : "err ", error == nullptr ? "" : error, boot_id_, kNames[status_],
      pan.position, tilt.position, pan.target, tilt.target, done_sequence_, laser_ ? 1 : 0, pan.home_deviation,
      tilt.home_deviation, switches(kPan), switches(kTilt), error_, extra);
  const size_t length = static_cast<size_t>(size);
  if (sequence != 0 && sequence == last_sequence_ && (error == nullptr || strcmp(error, "seq") != 0)) {
    memcpy(last_reply_, body, length);
    snprintf(last_reply_ + length, sizeof last_reply_ - length, "*%04X\n", crc16(body, length));
    last_reply_size_ = length + 6;
  }
  send(body, length);
}

int Core::switches(int axis) {
  return (hooks_.home_switch(axis) ? 1 : 0) + (hooks_.limit_switch(axis) ? 2 : 0);
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
    return home(sequence, now_us);
  }
  if (strcmp(name, "STOP") == 0) {
    if (arguments != 0) return "argument";
    stop();
    return nullptr;
  }
  if (strcmp(name, "ABORT") == 0) {
    if (arguments != 0) return "argument";
    halt(status_ == kUnhomed || homing_ ? kUnhomed : kAlarm, "abort");
    return nullptr;
  }
  if (strcmp(name, "L") == 0) return arguments == 1 ? light(words[2]) : "argument";
  if (strcmp(name, "TRIG") == 0) {
    uint32_t width_us;
    if (arguments != 1 || !parse_unsigned(words[2], &width_us)) return "argument";
    if (width_us < kTriggerMin || width_us > kTriggerMax) return "argument";
    trigger_off_us_ = now_us + width_us;
    hooks_.trigger(true);
    return nullptr;
  }
  if (strcmp(name, "GET") == 0) return arguments == 1 ? setting(words[2], nullptr, extra) : "argument";
  if (strcmp(name, "SET") == 0) return arguments == 2 ? setting(words[2], words[3], extra) : "argument";
  return "command";
}

const char* Core::light(const char* word) {
  if (strcmp(word, "0") != 0 && strcmp(word, "1") != 0) return "argument";
  const bool on = word[0] == '1';
  if (on && status_ == kAlarm) return "alarm";
  if (on && (status_ == kUnhomed || homing_)) return "unhomed";
  if (on) error_ = "none";
  set_laser(on);
  return nullptr;
}

const char* Core::setting(const char* name, const char* word, char* extra) {
  const int index = find_setting(name);
  if (index < 0) return "argument";
  if (word != nullptr) {
    int32_t value;
    const Setting& setting = kSettingTable[index];
    if (!parse_signed(word, &value) || value < setting.low || value > setting.high) return "argument";
    if (status_ == kMoving) return "busy";
    settings_[index] = value;
  }
  snprintf(extra, 64, " v=%" PRId32, settings_[index]);
  return nullptr;
}

}  // namespace tvs
