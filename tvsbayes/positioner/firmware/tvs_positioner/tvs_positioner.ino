// Positioner firmware for the Teensy 4.1: the board interface of tvs_core. See ../README.md for wiring and flashing.
// Adapt the pin numbers and the senses below; all else belongs in the core.
#include <EEPROM.h>
#include <IntervalTimer.h>

#include "tvs_core.h"

namespace {

const uint8_t kStepPin[] = {2, 4}, kDirectionPin[] = {3, 5};  // pan, tilt
const uint8_t kHomePin[] = {6, 7};   // switch to ground, closed at home
const uint8_t kLimitPin[] = {8, 9};  // switch to ground, normally closed: a broken wire reads as a limit
const uint8_t kLaserPin = 10;        // high = laser on; a 10 kOhm resistor to ground keeps it off during a reset
const uint8_t kTriggerPin = 11;      // high during a pulse of the order TRIG: the cameras' trigger input
const bool kDirectionHighIsPositive[] = {true, true};
// Length of a step pulse, and set-up time of the direction before it: 0.65 us for a DRV8825, 5 us for a DM542.
const unsigned kPulseUs = 3, kDirectionSetupUs = 5;
const uint32_t kStuckMs = 100;
// Number of half seconds within which loop() must be called, or the processor resets itself.
const unsigned kWatchdogHalfSeconds = 2;

volatile uint32_t alive_ms = 0;
volatile bool guard_darkened = false;

class Board : public tvs::Hooks {
 public:
  void step(int axis, bool positive) override {
    const uint8_t direction = positive == kDirectionHighIsPositive[axis] ? HIGH : LOW;
    if (direction != direction_[axis]) {
      digitalWriteFast(kDirectionPin[axis], direction);
      direction_[axis] = direction;
      delayMicroseconds(kDirectionSetupUs);
    }
    digitalWriteFast(kStepPin[axis], HIGH);
    delayMicroseconds(kPulseUs);
    digitalWriteFast(kStepPin[axis], LOW);
  }
  bool home_switch(int axis) override { return digitalReadFast(kHomePin[axis]) == LOW; }
  bool limit_switch(int axis) override { return digitalReadFast(kLimitPin[axis]) == HIGH; }
  void laser(bool on) override { digitalWriteFast(kLaserPin, on ? HIGH : LOW); }
  void trigger(bool on) override { digitalWriteFast(kTriggerPin, on ? HIGH : LOW); }
  void write(const char* data, size_t size) override {
    // Without a listening host the line is dropped: waiting would stop the motors within a ramp.
    if (Serial && static_cast<size_t>(Serial.availableForWrite()) >= size) Serial.write(data, size);
  }

 private:
  uint8_t direction_[tvs::kAxes] = {0xFF, 0xFF};  // neither level, so that the first step sets it
};

// A number that no earlier start had, from a counter in the EEPROM.
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

// In addition to the core's watchdog: laser off when the main loop hangs. The loop reports it to the core afterwards.
void dark_when_stuck() {
  if (millis() - alive_ms <= kStuckMs) return;
  digitalWriteFast(kLaserPin, LOW);
  guard_darkened = true;
}

#if defined(__IMXRT1062__)
// A fault stops all interrupts: the pin is set low here, and the processor's watchdog resets the board.
void dark_in_fault() {
  digitalWriteFast(kLaserPin, LOW);
  for (;;) {
  }
}

void feed_watchdog() {
  WDOG1_WSR = 0x5555;
  WDOG1_WSR = 0xAAAA;
}

void start_watchdog() {
  for (int vector = 3; vector <= 6; ++vector) _VectorsRam[vector] = dark_in_fault;  // hard fault to usage fault
  CCM_CCGR3 |= CCM_CCGR3_WDOG1(CCM_CCGR_ON);
  WDOG1_WMCR = 0;
  WDOG1_WCR = WDOG_WCR_WT(kWatchdogHalfSeconds - 1) | WDOG_WCR_SRS | WDOG_WCR_WDA | WDOG_WCR_WDE;
  feed_watchdog();
}
#else
// Insert the watchdog of another board here. Without it a crashed processor leaves the laser on.
void feed_watchdog() {}
void start_watchdog() {}
#endif

Board board;
tvs::Core* core = nullptr;
IntervalTimer guard;

void tell_if_darkened() {
  if (!guard_darkened) return;
  guard_darkened = false;
  core->darkened();
}

}  // namespace

void setup() {
  pinMode(kLaserPin, OUTPUT);
  digitalWriteFast(kLaserPin, LOW);
  pinMode(kTriggerPin, OUTPUT);
  digitalWriteFast(kTriggerPin, LOW);
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
  start_watchdog();
}

void loop() {
  feed_watchdog();
  tell_if_darkened();
  core->loop(now_us());
  // A flood of bytes must not delay the end of loop().
  for (int i = 0; i < 64 && Serial.available() > 0; ++i) {
    core->receive(static_cast<uint8_t>(Serial.read()), now_us());
    core->loop(now_us());
  }
  alive_ms = millis();
}
