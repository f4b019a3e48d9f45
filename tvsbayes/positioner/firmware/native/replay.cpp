// Runs the core without a board: reads a script from stdin, writes the events to stdout.
// The motors drive a counter of true steps per axis, with a home switch below a position and limit switches outside a
// range. One order per line:
//   a US         advance to a time, with a main loop that is never late
//   j US         the main loop hangs until then and runs once
//   d            the board's guard has switched the laser off
//   x HEX        bytes from the host, all at the present time
//   k AXIS N     the motor misses its next N steps
//   b AXIS N     the next N readings of the home switch are wrong
//   c AXIS 0|1   the limit circuit of an axis is whole (0) or cut (1)
//   e AXIS 0|1   the home switch is alive (0) or dead, never pressed (1)
//   q            print true steps and laser
// Output: "w US HEX" for bytes to the host, "l US 0|1" for the laser line, "t US 0|1" for the trigger line,
// "q PAN TILT LASER".
//
//   g++ -std=c++11 -Wall -Wextra -I../tvs_positioner replay.cpp ../tvs_positioner/tvs_*.cpp -o replay
//   ./replay BOOT_ID PAN_SWITCH TILT_SWITCH LIMIT < script
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tvs_core.h"

namespace {

class Board : public tvs::Hooks {
 public:
  long true_steps[2] = {0, 0}, missing[2] = {0, 0}, wrong_reads[2] = {0, 0}, home[2], limit;
  bool limit_cut[2] = {false, false}, home_dead[2] = {false, false};
  unsigned long long now_us = 0;
  bool laser_on = false;

  void step(int axis, bool positive) override {
    if (missing[axis] > 0) {
      --missing[axis];
    } else {
      true_steps[axis] += positive ? 1 : -1;
    }
  }
  bool home_switch(int axis) override {
    const bool pressed = !home_dead[axis] && true_steps[axis] <= home[axis];
    if (wrong_reads[axis] == 0) return pressed;
    --wrong_reads[axis];
    return !pressed;
  }
  bool limit_switch(int axis) override { return limit_cut[axis] || labs(true_steps[axis]) > limit; }
  void laser(bool on) override {
    laser_on = on;
    printf("l %llu %d\n", now_us, on ? 1 : 0);
  }
  void trigger(bool on) override { printf("t %llu %d\n", now_us, on ? 1 : 0); }
  void write(const char* data, size_t size) override {
    printf("w %llu ", now_us);
    for (size_t i = 0; i < size; ++i) printf("%02x", static_cast<unsigned char>(data[i]));
    printf("\n");
  }
};

// An axis and a number.
struct Pair {
  explicit Pair(const char* text) {
    char* rest;
    axis = strtol(text, &rest, 10) == 1;
    number = strtol(rest, nullptr, 10);
  }
  int axis;
  long number;
};

void advance(tvs::Core& core, Board& board, unsigned long long now_us) {
  while (core.next_us() <= now_us) {
    board.now_us = core.next_us();
    core.loop(board.now_us);
  }
  board.now_us = now_us;
  core.loop(now_us);
}

void receive(tvs::Core& core, const Board& board, const char* hex) {
  for (; hex[0] > ' ' && hex[1] > ' '; hex += 2) {
    const char pair[3] = {hex[0], hex[1], '\0'};
    core.receive(static_cast<uint8_t>(strtoul(pair, nullptr, 16)), board.now_us);
  }
}

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
    const Pair pair(order + 1);
    if (order[0] == 'a') {
      advance(core, board, strtoull(order + 2, nullptr, 10));
    } else if (order[0] == 'j') {
      board.now_us = strtoull(order + 2, nullptr, 10);
      core.loop(board.now_us);
    } else if (order[0] == 'd') {
      core.darkened();
    } else if (order[0] == 'x') {
      receive(core, board, order + 2);
    } else if (order[0] == 'k') {
      board.missing[pair.axis] += pair.number;
    } else if (order[0] == 'b') {
      board.wrong_reads[pair.axis] += pair.number;
    } else if (order[0] == 'c') {
      board.limit_cut[pair.axis] = pair.number != 0;
    } else if (order[0] == 'e') {
      board.home_dead[pair.axis] = pair.number != 0;
    } else if (order[0] == 'q') {
      printf("q %ld %ld %d\n", board.true_steps[0], board.true_steps[1], board.laser_on ? 1 : 0);
    }
  }
  return 0;
}
