// Runs the core without a board: reads a script from stdin, writes what happened to stdout.
// The motors drive a counter of true steps per axis, with a home switch below a position and limit switches outside a
// range. One order per line:
//   a US         advance to a time
//   x HEX        bytes from the host, all at the present time
//   k AXIS N     the motor misses its next N steps
//   q            print true steps and laser
// Output: "w US HEX" for bytes to the host, "l US 0|1" for the laser line, "q PAN TILT LASER".
//
//   g++ -std=c++11 -Wall -Wextra -I../tvs_positioner replay.cpp ../tvs_positioner/tvs_core.cpp -o replay
//   ./replay BOOT_ID PAN_SWITCH TILT_SWITCH LIMIT < script
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tvs_core.h"

namespace {

class Board : public tvs::Hooks {
 public:
  long true_steps[2] = {0, 0}, missing[2] = {0, 0}, home[2], limit;
  unsigned long long now_us = 0;
  bool laser_on = false;

  void step(int axis, bool positive) override {
    if (missing[axis] > 0) {
      --missing[axis];
    } else {
      true_steps[axis] += positive ? 1 : -1;
    }
  }
  bool home_switch(int axis) override { return true_steps[axis] <= home[axis]; }
  bool limit_switch(int axis) override { return labs(true_steps[axis]) > limit; }
  void laser(bool on) override {
    laser_on = on;
    printf("l %llu %d\n", now_us, on ? 1 : 0);
  }
  void write(const char* data, size_t size) override {
    printf("w %llu ", now_us);
    for (size_t i = 0; i < size; ++i) printf("%02x", static_cast<unsigned char>(data[i]));
    printf("\n");
  }
};

}  // namespace

int main(int count, char** words) {
  if (count != 5) return 2;
  Board board;
  board.home[0] = atol(words[2]);
  board.home[1] = atol(words[3]);
  board.limit = atol(words[4]);
  tvs::Core core(board, static_cast<uint32_t>(strtoul(words[1], nullptr, 10)));
  core.start(0);
  static char order[65536];
  while (fgets(order, sizeof order, stdin) != nullptr) {
    if (order[0] == 'a') {
      board.now_us = strtoull(order + 2, nullptr, 10);
      core.advance(board.now_us);
    } else if (order[0] == 'x') {
      for (const char* hex = order + 2; hex[0] > ' ' && hex[1] > ' '; hex += 2) {
        const char pair[3] = {hex[0], hex[1], '\0'};
        core.receive(static_cast<uint8_t>(strtoul(pair, nullptr, 16)), board.now_us);
      }
    } else if (order[0] == 'k') {
      char* rest;
      const long axis = strtol(order + 2, &rest, 10);
      board.missing[axis == 1] += strtol(rest, nullptr, 10);
    } else if (order[0] == 'q') {
      printf("q %ld %ld %d\n", board.true_steps[0], board.true_steps[1], board.laser_on ? 1 : 0);
    }
  }
  return 0;
}
