// Positioner firmware for the Teensy 4.1: the board's side of tvs_core. See ../README.md for wiring and flashing.
// Adapt the pin numbers and the senses below; everything else belongs into the core.
#include <EEPROM.h>
#include <IntervalTimer.h>

#include "tvs_core.h"

namespace {

const uint8_t kStepPin[] = {2, 4}, kDirectionPin[] = {3, 5};  // pan, tilt
const uint8_t kHomePin[] = {6, 7};   // switch to ground, closed at home
const uint8_t kLimitPin[] = {8, 9};  // switch to ground, normally closed: a broken wire reads as a limit
const uint8_t kLaserPin = 10;        // high = light; a 10 kOhm resistor to ground keeps it dark while the board resets
const bool kDirectionHighIsPositive[] = {true, true};
const unsigned kPulseUs = 3;
const uint32_t kStuckMs = 100;

volatile uint32_t alive_ms = 0;

class Board : public tvs::Hooks {
 public:
  void step(int axis, bool positive) override {
    digitalWriteFast(kDirectionPin[axis], positive == kDirectionHighIsPositive[axis] ? HIGH : LOW);
    delayMicroseconds(1);
    digitalWriteFast(kStepPin[axis], HIGH);
    delayMicroseconds(kPulseUs);
    digitalWriteFast(kStepPin[axis], LOW);
  }
  bool home_switch(int axis) override { return digitalReadFast(kHomePin[axis]) == LOW; }
  bool limit_switch(int axis) override { return digitalReadFast(kLimitPin[axis]) == HIGH; }
  void laser(bool on) override { digitalWriteFast(kLaserPin, on ? HIGH : LOW); }
  void write(const char* data, size_t size) override {
    // Without a listening host the line is dropped: waiting would stop the motors in mid-ramp.
    if (Serial && static_cast<size_t>(Serial.availableForWrite()) >= size) Serial.write(data, size);
  }
};

// A number that no earlier start had: a counter in the EEPROM.
uint32_t next_boot_id() {
  uint32_t id = 0;
  EEPROM.get(0, id);
  ++id;
  EEPROM.put(0, id);
  return id;
}

// The 32 bit microseconds of the board wrap after 71 minutes.
uint64_t now_us() {
  static uint32_t last = 0;
  static uint64_t wraps = 0;
  const uint32_t now = micros();
  if (now < last) wraps += UINT64_C(1) << 32;
  last = now;
  return wraps + now;
}

// Last resort beside the core's own watchdog: no light when the main loop hangs.
void dark_when_stuck() {
  if (millis() - alive_ms > kStuckMs) digitalWriteFast(kLaserPin, LOW);
}

Board board;
tvs::Core* core = nullptr;
IntervalTimer guard;

}  // namespace

void setup() {
  pinMode(kLaserPin, OUTPUT);
  digitalWriteFast(kLaserPin, LOW);
  for (int axis = 0; axis < tvs::kAxes; ++axis) {
    pinMode(kStepPin[axis], OUTPUT);
    pinMode(kDirectionPin[axis], OUTPUT);
    pinMode(kHomePin[axis], INPUT_PULLUP);
    pinMode(kLimitPin[axis], INPUT_PULLUP);
  }
  Serial.begin(115200);
  static tvs::Core instance(board, next_boot_id());
  core = &instance;
  core->start(now_us());
  alive_ms = millis();
  guard.begin(dark_when_stuck, 10000);
}

void loop() {
  core->advance(now_us());
  while (Serial.available() > 0) {
    core->receive(static_cast<uint8_t>(Serial.read()), now_us());
    core->advance(now_us());
  }
  alive_ms = millis();
}
