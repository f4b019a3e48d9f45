// The unchanged sketch on QEMU's mps2-an500: pins, clock, watchdog, and motors with switches at the pins.
//
// UART 0 is the host's line, LED 0 the laser, LED 1 the trigger. UART 1 is a hand at the bench. Orders, a line each:
//   h AXIS N     the home switch of an axis (0 pan, 1 tilt) closes at N steps and below
//   m N          limits open beyond +-N steps
//   k AXIS N     the motor misses its next N steps
//   b AXIS N     the next N readings of the home switch are wrong
//   c AXIS 0|1   the limit circuit is whole or cut
//   e AXIS 0|1   the home switch is alive or dead
//   s MS         the main loop hangs for this time
//   g            the main loop hangs without end
//   f            a fault of the processor
//   r            reset
// Answers, a byte each: + - steps of pan, ^ v of tilt, L l laser on and off, T t trigger, B a start, V a direction that
// was set too late before its step.
#include <Arduino.h>
#include <EEPROM.h>
#include <IntervalTimer.h>
#include <stdlib.h>
#include <string.h>

namespace {

const uint32_t kClockHz = 25000000;
const uint8_t kStepPin[] = {2, 4}, kDirectionPin[] = {3, 5}, kHomePin[] = {6, 7}, kLimitPin[] = {8, 9};
const uint8_t kLaserPin = 10, kTriggerPin = 11;
const uint32_t kDirectionSetupUs = 5;

volatile uint32_t& at(uint32_t address) { return *reinterpret_cast<volatile uint32_t*>(address); }
const uint32_t kHostLine = 0x40004000, kHandLine = 0x40005000, kWatchdog = 0x40008000, kFpga = 0x40028000;
const uint32_t kSysTick = 0xE000E010, kVectors = 0xE000ED08, kReset = 0xE000ED0C;

// State that a reset of the processor leaves unchanged: motors, switches, wires, EEPROM. Zero when the emulator starts.
struct Bench {
  uint32_t known, boots;
  int32_t steps[2], home[2], limit, missing[2], wrong_reads[2], limit_cut[2], home_dead[2];
};
Bench& bench = *reinterpret_cast<Bench*>(0x60000000);
const uint32_t kKnown = 0x54565331;

uint8_t level[16];
uint32_t turned_us[2];
void (*tick)() = nullptr;

// Registers of a UART: data, state (1 cannot take a byte, 2 has one), control, and a divider of the clock.
void open_line(uint32_t line) {
  at(line + 16) = 16;
  at(line + 8) = 3;
}
bool has_byte(uint32_t line) { return (at(line + 4) & 2) != 0; }
void put(uint32_t line, char byte) {
  while ((at(line + 4) & 1) != 0) {
  }
  at(line) = static_cast<uint8_t>(byte);
}

void light(uint32_t led, bool on) {
  const uint32_t mask = 1u << led;
  at(kFpga) = on ? at(kFpga) | mask : at(kFpga) & ~mask;
}

void turn_motor(int axis) {
  const bool positive = level[kDirectionPin[axis]] == HIGH;
  if (micros() - turned_us[axis] < kDirectionSetupUs) put(kHandLine, 'V');
  if (bench.missing[axis] > 0) {
    --bench.missing[axis];
    return;
  }
  bench.steps[axis] += positive ? 1 : -1;
  put(kHandLine, "-+v^"[2 * axis + positive]);
}

void hang_ms(uint32_t ms) {
  const uint32_t start = millis();
  while (millis() - start < ms) {
  }
}

void obey(const char* line) {
  char* rest;
  const long first = strtol(line + 1, &rest, 10), second = strtol(rest, nullptr, 10);
  const int axis = first == 1, number = static_cast<int>(second);
  switch (line[0]) {
    case 'h': bench.home[axis] = number; break;
    case 'm': bench.limit = static_cast<int>(first); break;
    case 'k': bench.missing[axis] += number; break;
    case 'b': bench.wrong_reads[axis] += number; break;
    case 'c': bench.limit_cut[axis] = number; break;
    case 'e': bench.home_dead[axis] = number; break;
    case 's': hang_ms(static_cast<uint32_t>(first)); break;
    case 'g': hang_ms(UINT32_MAX); break;
    case 'f': __asm__ volatile("udf #0"); break;
    case 'r': at(kReset) = 0x05FA0004; break;
    default: break;
  }
}

void listen_to_hand() {
  static char line[32];
  static size_t size = 0;
  while (has_byte(kHandLine)) {
    const char byte = static_cast<char>(at(kHandLine));
    if (byte == '\n') {
      line[size] = '\0';
      size = 0;
      obey(line);
    } else if (size < sizeof line - 1) {
      line[size++] = byte;
    }
  }
}

void on_tick() {
  if (tick != nullptr) tick();
}

}  // namespace

extern "C" {
alignas(512) void (*volatile _VectorsRam[16])(void);
}
HostSerial Serial;
KeptNumber EEPROM;
const WatchdogControl WDOG1_WCR;
const WatchdogService WDOG1_WSR;
uint32_t CCM_CCGR3;
uint16_t WDOG1_WMCR;

void pinMode(uint8_t, uint8_t) {}

void digitalWriteFast(uint8_t pin, uint8_t value) {
  const bool edge = level[pin] != value;
  level[pin] = value;
  if (pin == kLaserPin || pin == kTriggerPin) {
    const bool laser = pin == kLaserPin;
    light(laser ? 0 : 1, value == HIGH);
    if (edge) put(kHandLine, laser ? (value == HIGH ? 'L' : 'l') : (value == HIGH ? 'T' : 't'));
  }
  for (int axis = 0; axis < 2 && edge; ++axis) {
    if (pin == kDirectionPin[axis]) turned_us[axis] = micros();
    if (pin == kStepPin[axis] && value == HIGH) turn_motor(axis);
  }
}

uint8_t digitalReadFast(uint8_t pin) {
  for (int axis = 0; axis < 2; ++axis) {
    const int32_t steps = bench.steps[axis];
    if (pin == kHomePin[axis]) {
      bool pressed = bench.home_dead[axis] == 0 && steps <= bench.home[axis];
      if (bench.wrong_reads[axis] > 0) {
        --bench.wrong_reads[axis];
        pressed = !pressed;
      }
      return pressed ? LOW : HIGH;
    }
    if (pin == kLimitPin[axis]) return bench.limit_cut[axis] != 0 || abs(steps) > bench.limit ? HIGH : LOW;
  }
  return level[pin];
}

// The counter of the FPGA, divided to microseconds in main().
uint32_t micros() { return at(kFpga + 0x18); }

// Time from the same counter, over its wraps. The tick calls it too, possibly between reading and storing: a backward
// step of less than half the counter's range has this cause and is not a wrap.
uint32_t millis() {
  static uint32_t last_us = 0, wraps = 0;
  const uint32_t now_us = micros();
  if (now_us < last_us && last_us - now_us > UINT32_MAX / 2) ++wraps;
  last_us = now_us;
  return static_cast<uint32_t>(((static_cast<uint64_t>(wraps) << 32) + now_us) / 1000);
}

void delayMicroseconds(uint32_t us) {
  const uint32_t start = micros();
  while (micros() - start <= us) {
  }
}

void HostSerial::begin(uint32_t) { open_line(kHostLine); }
int HostSerial::available() { return has_byte(kHostLine) ? 1 : 0; }
int HostSerial::read() { return static_cast<int>(at(kHostLine) & 0xFF); }
int HostSerial::availableForWrite() { return 1024; }
size_t HostSerial::write(const char* data, size_t size) {
  for (size_t i = 0; i < size; ++i) put(kHostLine, data[i]);
  return size;
}

void KeptNumber::get(int, uint32_t& value) { value = bench.boots; }
void KeptNumber::put(int, uint32_t value) { bench.boots = value; }

void IntervalTimer::begin(void (*function)(), uint32_t period_us) {
  tick = function;
  at(kSysTick + 4) = kClockHz / 1000000 * period_us - 1;
  at(kSysTick + 8) = 0;
  at(kSysTick) = 7;
}

// The board's watchdog warns after its load and resets after another: each takes half of the time.
void WatchdogControl::operator=(unsigned value) const {
  if ((value & WDOG_WCR_WDE) == 0) return;
  at(kWatchdog + 0xC00) = 0x1ACCE551;
  at(kWatchdog) = ((value >> 8) + 1) * (kClockHz / 4);
  at(kWatchdog + 8) = 3;
}

void WatchdogService::operator=(unsigned value) const {
  static unsigned before = 0;
  if (before == 0x5555 && value == 0xAAAA) at(kWatchdog + 0xC) = 1;
  before = value;
}

int main() {
  at(kFpga + 0x1C) = kClockHz / 1000000 - 1;
  light(0, false);
  light(1, false);
  open_line(kHandLine);
  if (bench.known != kKnown) {
    memset(&bench, 0, sizeof bench);
    bench.known = kKnown;
    bench.home[0] = -1200;
    bench.home[1] = -700;
    bench.limit = 30000;
  }
  for (uint32_t i = 0; i < 16; ++i) _VectorsRam[i] = *reinterpret_cast<void (*const*)()>(4 * i + (i == 0 ? 4 : 0));
  _VectorsRam[15] = on_tick;
  at(kVectors) = static_cast<uint32_t>(reinterpret_cast<uintptr_t>(_VectorsRam));
  put(kHandLine, 'B');
  setup();
  for (;;) {
    listen_to_hand();
    loop();
  }
}
