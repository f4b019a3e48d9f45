// The parts of Arduino and of the Teensy's registers that the sketch uses, for the emulated board: see board.cpp.
#pragma once

#include <stddef.h>
#include <stdint.h>

#define HIGH 1
#define LOW 0
#define OUTPUT 1
#define INPUT_PULLUP 2

void pinMode(uint8_t pin, uint8_t mode);
void digitalWriteFast(uint8_t pin, uint8_t level);
uint8_t digitalReadFast(uint8_t pin);
void delayMicroseconds(uint32_t us);
uint32_t micros();
uint32_t millis();

// The line to the host: UART 0 of the board.
class HostSerial {
 public:
  void begin(uint32_t baud);
  int available();
  int read();
  int availableForWrite();
  size_t write(const char* data, size_t size);
  explicit operator bool() const { return true; }
};
extern HostSerial Serial;

// The parts of a Teensy 4.1's processor that the sketch uses: fault vectors and watchdog WDOG1. Registers are
// objects that drive the emulated board's own watchdog.
#define __IMXRT1062__
extern "C" {
extern void (*volatile _VectorsRam[])(void);
}
struct WatchdogControl {
  void operator=(unsigned value) const;
};
struct WatchdogService {
  void operator=(unsigned value) const;
};
extern const WatchdogControl WDOG1_WCR;
extern const WatchdogService WDOG1_WSR;
extern uint32_t CCM_CCGR3;
extern uint16_t WDOG1_WMCR;
#define CCM_CCGR_ON 3u
#define CCM_CCGR3_WDOG1(n) (static_cast<uint32_t>(n) << 16)
#define WDOG_WCR_WDE 0x4u
#define WDOG_WCR_SRS 0x10u
#define WDOG_WCR_WDA 0x20u
#define WDOG_WCR_WT(n) ((static_cast<unsigned>(n) & 0xFFu) << 8)

void setup();
void loop();
