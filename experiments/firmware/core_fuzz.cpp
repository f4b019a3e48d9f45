// Random hosts and benches against the firmware core, with invariants; built by core_fuzz.py under ASan and UBSan.
//
//   ./fuzz SEED SECONDS      every input is a session of its own; prints inputs, bytes, loops, steps, replies
//
// A violation is printed with the seed of its input, and ends the run with 1.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <string>

#include "tvs_core.h"

namespace {

unsigned long long inputs, bytes, loops, steps, replies, dark_by_watchdog, current_seed;

[[noreturn]] void fail(const char* what) {
  printf("violation: %s, input seed %llu\n", what, current_seed);
  exit(1);
}
void require(bool held, const char* what) {
  if (!held) fail(what);
}

struct Random {
  uint64_t state;
  uint32_t next() {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return static_cast<uint32_t>(state >> 16);
  }
  uint32_t below(uint32_t n) { return next() % n; }
  bool chance(uint32_t percent) { return below(100) < percent; }
};

struct Board : tvs::Hooks {
  Random* random = nullptr;
  long at[2] = {0, 0}, counted[2] = {0, 0}, home[2], limit;
  bool cut[2] = {false, false}, dead[2] = {false, false}, light = false;
  uint32_t glitch_percent = 0, loss_percent = 0;
  int stepped[2] = {0, 0}, into_limit[2] = {0, 0};
  std::string sent;

  bool glitch() { return glitch_percent != 0 && random->chance(glitch_percent); }
  void step(int axis, bool positive) override {
    require(axis == 0 || axis == 1, "axis");
    ++steps;
    ++stepped[axis];
    into_limit[axis] = limit_switch(axis) ? into_limit[axis] + 1 : 0;
    require(into_limit[axis] <= 202, "no long way with an open limit");
    if (loss_percent == 0 || !random->chance(loss_percent)) at[axis] += positive ? 1 : -1;
  }
  bool home_switch(int axis) override { return (!dead[axis] && at[axis] <= home[axis]) != glitch(); }
  bool limit_switch(int axis) override { return cut[axis] || labs(at[axis]) > limit; }
  void laser(bool on) override { light = on; }
  void trigger(bool) override {}
  void write(const char* data, size_t size) override {
    ++replies;
    require(size >= 6 && size <= 200 && data[size - 1] == '\n' && data[size - 6] == '*', "form of a reply");
    char crc[8];
    snprintf(crc, sizeof crc, "%04X", tvs::crc16(data, size - 6));
    require(memcmp(crc, data + size - 5, 4) == 0, "CRC of a reply");
    sent.assign(data, size);
  }
};

struct Reply {
  unsigned sequence = 0, done = 0;
  bool ok = false;
  char status[10] = "";
  int p[2], t[2], light = 0;
};

bool parse(const std::string& text, Reply* reply) {
  char verdict[24];
  if (text.empty() || text[0] != '<' || sscanf(text.c_str(), "<%u %23s", &reply->sequence, verdict) != 2) return false;
  reply->ok = strcmp(verdict, "ok") == 0;
  const char* state = strstr(text.c_str(), " st=");
  return state != nullptr && sscanf(state, " st=%9s p=%d,%d t=%d,%d d=%u l=%d", reply->status, &reply->p[0],
                                    &reply->p[1], &reply->t[0], &reply->t[1], &reply->done, &reply->light) == 7;
}

class Session {
 public:
  explicit Session(uint64_t seed) : random_{seed * 0x9E3779B97F4A7C15ull + 1}, core_(board_, random_.next()) {
    board_.random = &random_;
    board_.home[0] = -10 - static_cast<long>(random_.below(100));
    board_.home[1] = -10 - static_cast<long>(random_.below(60));
    board_.limit = 150 + random_.below(1500);
    if (random_.chance(30)) board_.glitch_percent = random_.below(4);
    if (random_.chance(20)) board_.loss_percent = random_.below(10);
    core_.start(0);
    require(!board_.light, "dark at the start");
    order("SET hp -60");
    order("SET ht -40");
    order("HOME");
    loop_for(12000000);
  }

  void run() {
    for (int turn = 0; turn < 60; ++turn) {
      disturb();
      if (random_.chance(60)) {
        order(command());
      } else {
        noise();
      }
      loop_for(random_.chance(10) ? 3000000 : random_.below(400000));
    }
  }

 private:
  std::string command() {
    char text[64];
    const int pan = static_cast<int>(random_.below(1600)) - 400, tilt = static_cast<int>(random_.below(900)) - 400;
    static const char* const kPlain[] = {"HOME", "?", "L 1", "L 0", "STOP", "ABORT", "ID", "L 1", "L 1", "GET wd"};
    static const char* const kNames[] = {"vmax", "amax", "pmin", "pmax", "tmin", "tmax", "hp", "ht"};
    switch (random_.below(6)) {
      case 0:
      case 1: snprintf(text, sizeof text, "MA %d %d", pan, tilt); break;
      case 2: snprintf(text, sizeof text, "SET %s %d", kNames[random_.below(8)], pan * (random_.chance(50) ? 1 : 97)); break;
      case 3: snprintf(text, sizeof text, "TRIG %u", random_.below(2000000)); break;
      default: return kPlain[random_.below(10)];
    }
    return text;
  }

  void order(const std::string& words) {
    const bool unnumbered = random_.chance(10);
    std::string body = ">" + std::to_string(unnumbered ? 0 : ++sequence_) + " " + words;
    if (random_.chance(3)) body = ">" + std::to_string(random_.next()) + " " + words;
    char tail[8];
    snprintf(tail, sizeof tail, "*%04X\n", tvs::crc16(body.data(), body.size()));
    std::string line = body + tail;
    if (random_.chance(10)) line[random_.below(static_cast<uint32_t>(line.size()))] ^= static_cast<char>(1 << random_.below(8));
    if (random_.chance(5)) line += line;
    ordered_ = words;
    ordered_sequence_ = unnumbered ? 0 : sequence_;
    send(line);
    ordered_sequence_ = 0;
  }

  void noise() {
    std::string line;
    const uint32_t size = random_.below(150);
    for (uint32_t i = 0; i < size; ++i) line += static_cast<char>(random_.chance(70) ? 32 + random_.below(95) : random_.next());
    send(line + (random_.chance(80) ? "\n" : ""));
  }

  void send(const std::string& line) {
    for (const char byte : line) {
      ++bytes;
      board_.sent.clear();
      core_.receive(static_cast<uint8_t>(byte), now_us_);
      if (!board_.sent.empty()) heard(board_.sent);
    }
    require(board_.stepped[0] == 0 && board_.stepped[1] == 0, "no step while receiving");
  }

  void heard(const std::string& text) {
    Reply reply;
    if (!parse(text, &reply)) {
      require(text[0] == '!', "a line of another kind");
      return;
    }
    if (reply.ok && reply.sequence != 0) fed_us_ = now_us_;
    const bool cached = reply.ok && reply.sequence == last_.sequence && reply.sequence != 0;
    last_ = reply;
    if (cached) return;
    if (reply.ok) board_.into_limit[0] = board_.into_limit[1] = 0;
    if (reply.ok && reply.sequence == ordered_sequence_ && reply.sequence != 0) obeyed(reply);
    require((reply.light == 1) == board_.light, "the reply says what the laser does");
    const bool moving = strcmp(reply.status, "moving") == 0;
    may_move_ = moving;
    if (strcmp(reply.status, "idle") != 0 && !moving) require(!board_.light, "dark unhomed and in alarm");
    if (strcmp(reply.status, "idle") == 0) require(reply.p[0] == reply.t[0] && reply.p[1] == reply.t[1], "at rest on target");
  }

  // Soft limits as they were set, and targets within them.
  void obeyed(const Reply& reply) {
    static const char* const kLimits[] = {"SET pmin %d", "SET pmax %d", "SET tmin %d", "SET tmax %d"};
    int value, pan, tilt;
    for (int i = 0; i < 4; ++i) {
      if (sscanf(ordered_.c_str(), kLimits[i], &value) == 1) limits_[i] = value;
    }
    if (sscanf(ordered_.c_str(), "MA %d %d", &pan, &tilt) != 2) return;
    require(reply.t[0] == pan && reply.t[1] == tilt, "targets as ordered");
    require(limits_[0] <= pan && pan <= limits_[1] && limits_[2] <= tilt && tilt <= limits_[3], "targets in the limits");
  }

  void disturb() {
    if (random_.chance(3)) board_.cut[random_.below(2)] ^= true;
    if (random_.chance(2)) board_.dead[random_.below(2)] ^= true;
    if (random_.chance(10)) board_.cut[0] = board_.cut[1] = board_.dead[0] = board_.dead[1] = false;
    if (random_.chance(2)) {
      core_.darkened();
      require(!board_.light, "dark when the board says so");
    }
  }

  void loop_for(uint64_t us) {
    const uint64_t end_us = now_us_ + us;
    while (now_us_ < end_us) {
      const uint64_t due_us = core_.next_us();
      uint64_t next_us = due_us < end_us ? due_us : end_us;
      if (random_.below(2000) == 0) next_us += random_.below(500000);  // a stall
      now_us_ = next_us > now_us_ ? next_us : now_us_ + 1;
      loop();
    }
  }

  void loop() {
    ++loops;
    const bool lit = board_.light;
    board_.stepped[0] = board_.stepped[1] = 0;
    core_.loop(now_us_);
    require(board_.stepped[0] <= 1 && board_.stepped[1] <= 1, "one step of an axis in a loop: no bursts");
    for (int axis = 0; axis < 2; ++axis) {
      if (board_.stepped[axis] == 0) continue;
      require(may_move_, "motion only when ordered");
      require(now_us_ - stepped_us_[axis] >= 50 || stepped_us_[axis] == 0, "no gap shorter than at top speed");
      stepped_us_[axis] = now_us_;
      board_.stepped[axis] = 0;
    }
    require(!board_.light || now_us_ - fed_us_ < 2000000, "dark 2 s after the last request obeyed");
    require(lit || !board_.light, "no light without an order");
    if (lit && !board_.light) ++dark_by_watchdog;
  }

  Random random_;
  Board board_;
  tvs::Core core_;
  uint64_t now_us_ = 1, fed_us_ = 1, stepped_us_[2] = {0, 0};
  uint32_t sequence_ = 0;
  bool may_move_ = false;
  std::string ordered_;
  uint32_t ordered_sequence_ = 0;
  int limits_[4] = {-1000, 1000, -500, 500};
  Reply last_;
};

}  // namespace

int main(int count, char** words) {
  if (count != 3) return 2;
  const time_t end = time(nullptr) + atol(words[2]);
  for (current_seed = strtoull(words[1], nullptr, 10); time(nullptr) < end; ++current_seed, ++inputs) {
    Session session(current_seed);
    session.run();
  }
  printf("%llu inputs, %llu bytes, %llu loops, %llu steps, %llu replies, %llu times darkened in loop(), 0 violations\n",
         inputs, bytes, loops, steps, replies, dark_by_watchdog);
  return 0;
}
