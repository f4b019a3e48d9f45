// Reset of the emulated board; newlib does the rest and calls main().
#include <stdint.h>
#include <string.h>

extern "C" {

extern uint32_t __stack, __data_start, __data_end, __data_load;
void _start();

void reset() {
  *reinterpret_cast<volatile uint32_t*>(0xE000ED88) |= 0xFu << 20;  // switch the floating point unit on
  const char *from = reinterpret_cast<const char*>(&__data_start), *to = reinterpret_cast<const char*>(&__data_end);
  memcpy(&__data_start, &__data_load, static_cast<size_t>(to - from));
  _start();
}

void unexpected() {
  for (;;) {
  }
}

// The hardware watchdog's first time-out causes an interrupt, the second one the reset.
void warned() {}

// Addresses that the processor reads at reset: stack, reset, NMI, faults.
__attribute__((section(".vectors"), used)) void (*const vectors[])() = {
    reinterpret_cast<void (*)()>(reinterpret_cast<uintptr_t>(&__stack)),
    reset,
    warned,
    unexpected,
    unexpected,
    unexpected,
    unexpected,
};
}
