// The EEPROM of the emulated board: memory that a reset leaves unchanged.
#pragma once

#include <stdint.h>

class KeptNumber {
 public:
  void get(int address, uint32_t& value);
  void put(int address, uint32_t value);
};
extern KeptNumber EEPROM;
