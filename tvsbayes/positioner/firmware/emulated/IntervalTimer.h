// A periodic interrupt on the emulated board: SysTick.
#pragma once

#include <stdint.h>

class IntervalTimer {
 public:
  void begin(void (*function)(), uint32_t period_us);
};
